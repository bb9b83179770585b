//! The table of open connections of a port: their activity, timeouts, and eviction.
//!
//! Socket timeouts do not cover HTTP/2: a stream without a flow-control window writes nothing, and
//! a client that replies to pings is never idle. The activity of each connection is therefore
//! tracked by its requests and responses.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;

use crate::job::Tenant;
use crate::sync::locked;

/// The lowest eviction rank of a connection with a valid key.
const KNOWN: u8 = 2;

/// The open connections of one port.
pub(super) struct Connections {
    most: usize,
    open: Mutex<HashMap<u64, Arc<Connection>>>,
    next: AtomicU64,
}

/// One open connection.
pub(super) struct Connection {
    opened: Instant,
    address: IpAddr,
    connections: Weak<Connections>,
    state: Mutex<State>,
    /// Cancelled when the connection is evicted.
    evicted: CancellationToken,
}

struct State {
    /// The tenant of the latest valid key. `None` before a key is received.
    tenant: Option<Tenant>,
    /// The open requests.
    requests: HashMap<u64, Open>,
    next: u64,
    /// The time since which there has been no open request. Meaningful only without open requests.
    idle_since: Instant,
    /// When the client last took a chunk of any response.
    taken: Instant,
}

/// An open request.
#[derive(Default)]
struct Open {
    /// When the latest chunk of the response was handed to the connection. `None` once it was
    /// taken.
    handed: Option<Instant>,
    /// Whether the request only observes a job or health, so that its client can repeat it at any
    /// time.
    observes: bool,
    /// Whether the client may leave the response unread.
    may_wait: bool,
}

/// A handle to an open request for its handlers: a request extension.
#[derive(Clone)]
pub(in crate::api) struct Asking {
    connection: Arc<Connection>,
    number: u64,
}

/// The timeouts of a connection.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patience {
    /// Maximum time without a request.
    pub(super) idle: Duration,
    /// Maximum time without a valid key. `None` if no key is needed.
    pub(super) unknown: Option<Duration>,
    /// Maximum time with an unread chunk in which no chunk of any response is taken.
    pub(super) unread: Duration,
}

/// The result of a check of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// The connection remains open.
    Keep,
    /// The connection is shut down gracefully: open requests are finished.
    Close,
    /// The connection is terminated.
    End,
}

/// The entry of a connection in the table, removed when dropped.
pub(super) struct Entry {
    connections: Arc<Connections>,
    number: u64,
    pub(super) connection: Arc<Connection>,
}

/// An open request, which ends when dropped.
pub(super) struct OpenRequest(Asking);

impl Connections {
    /// An empty table for at most `most` connections.
    pub(super) fn new(most: usize) -> Self {
        Self {
            most,
            open: Mutex::default(),
            next: AtomicU64::new(0),
        }
    }

    /// Adds a connection from `address`.
    pub(super) fn enter(self: &Arc<Self>, address: IpAddr) -> Entry {
        let now = Instant::now();
        let connection = Arc::new(Connection {
            opened: now,
            address,
            connections: Arc::downgrade(self),
            state: Mutex::new(State {
                tenant: None,
                requests: HashMap::new(),
                next: 0,
                idle_since: now,
                taken: now,
            }),
            evicted: CancellationToken::new(),
        });
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        locked(&self.open).insert(number, Arc::clone(&connection));
        Entry {
            connections: Arc::clone(self),
            number,
            connection,
        }
    }

    /// Evicts one connection to admit a new one. Candidates in order: without a key and without a
    /// request, without a key, without a request, with observing requests only. Among equals it
    /// evicts the longest idle. Connections with other requests of an authenticated tenant are
    /// never evicted. Returns false if there is no candidate.
    pub(super) fn make_room(&self) -> bool {
        let mut open = locked(&self.open);
        let rank = |connection: &Connection| {
            let state = locked(&connection.state);
            match (&state.tenant, state.requests.is_empty()) {
                (None, true) => Some(0),
                (None, false) => Some(1),
                (Some(_), true) => Some(KNOWN),
                (Some(_), false) if state.requests.values().all(|open| open.observes) => {
                    Some(KNOWN + 1)
                }
                (Some(_), false) => None,
            }
        };
        let ranked: Vec<_> = open
            .iter()
            .filter_map(|(number, one)| Some((rank(one)?, one.address, one.idle_since(), *number)))
            .collect();
        // Among connections without a key, the address with the most such connections is chosen
        // first. A connection flood thus evicts itself.
        let mut held: HashMap<IpAddr, usize> = HashMap::new();
        for (_, address, ..) in ranked.iter().filter(|(rank, ..)| *rank < KNOWN) {
            *held.entry(*address).or_default() += 1;
        }
        let least = ranked.into_iter().min_by_key(|(rank, address, since, _)| {
            let unknown = held.get(address).copied().filter(|_| *rank < KNOWN);
            (*rank, Reverse(unknown), *since)
        });
        let Some((.., number)) = least else {
            return false;
        };
        if let Some(evicted) = open.remove(&number) {
            evicted.evicted.cancel();
        }
        true
    }

    /// Whether a tenant has open requests on more than half of the maximum number of connections.
    fn is_crowded_by(&self, tenant: &Tenant) -> bool {
        let half = self.most.div_ceil(2);
        let open = locked(&self.open);
        if open.len() <= half {
            return false;
        }
        let is_busy = |connection: &&Arc<Connection>| {
            let state = locked(&connection.state);
            state.tenant.as_ref() == Some(tenant) && !state.requests.is_empty()
        };
        open.values().filter(is_busy).count() > half
    }
}

impl Connection {
    /// Records the tenant of a valid key (the default tenant if no key is needed). Returns whether
    /// the tenant may use one more busy connection: with `several` tenants, each may use half of
    /// them.
    fn is_known(&self, tenant: &Tenant, several: bool) -> bool {
        locked(&self.state).tenant = Some(tenant.clone());
        let Some(connections) = self.connections.upgrade().filter(|_| several) else {
            return true;
        };
        !connections.is_crowded_by(tenant)
    }

    /// The time since which the connection has been without a request.
    fn idle_since(&self) -> Instant {
        locked(&self.state).idle_since
    }

    /// Completes when the connection is evicted.
    pub(super) async fn evicted(&self) {
        self.evicted.cancelled().await;
    }

    /// Registers a request, which ends when the guard is dropped.
    pub(super) fn begin(self: &Arc<Self>) -> OpenRequest {
        let mut state = locked(&self.state);
        let number = state.next;
        state.next += 1;
        state.requests.insert(number, Open::default());
        OpenRequest(Asking {
            connection: Arc::clone(self),
            number,
        })
    }

    /// Checks the connection against the timeouts.
    pub(super) fn verdict(&self, patience: &Patience) -> Verdict {
        let state = locked(&self.state);
        // A single stream that its reader has paused does not end the other streams of the
        // connection.
        let mut handed = state.requests.values().filter_map(|open| open.handed);
        let waits = handed.any(|at| at.elapsed() >= patience.unread);
        if waits && state.taken.elapsed() >= patience.unread {
            return Verdict::End;
        }
        let unknown = patience.unknown.filter(|_| state.tenant.is_none());
        if let Some(longest) = unknown {
            // Without a key, open requests may finish, but not for longer than twice the limit.
            let age = self.opened.elapsed();
            if age >= longest * 2 {
                return Verdict::End;
            } else if age >= longest && state.requests.is_empty() {
                return Verdict::Close;
            }
        }
        let idle = state.requests.is_empty() && state.idle_since.elapsed() >= patience.idle;
        if idle { Verdict::Close } else { Verdict::Keep }
    }
}

impl Asking {
    fn update(&self, change: impl FnOnce(&mut Open)) {
        if let Some(open) = locked(&self.connection.state)
            .requests
            .get_mut(&self.number)
        {
            change(open);
        }
    }

    /// Records the tenant of the request's valid key (the default tenant if no key is needed).
    /// Returns whether the tenant may use one more busy connection: with `several` tenants, each
    /// may use half of them.
    pub(in crate::api) fn is_known(&self, tenant: &Tenant, several: bool) -> bool {
        self.connection.is_known(tenant, several)
    }

    /// Marks the request as an observer of a job or health, such as an event stream or a long poll.
    /// Its connection may be evicted, since the client can repeat the request.
    pub(in crate::api) fn observes(&self) {
        self.update(|open| open.observes = true);
    }

    /// Allows the client to leave the response unread. For streams that hold little memory and
    /// whose client processes each message before it reads the next one.
    pub(in crate::api) fn may_wait(&self) {
        self.update(|open| open.may_wait = true);
    }
}

impl OpenRequest {
    /// A handle for the handlers of the request.
    pub(super) fn asking(&self) -> Asking {
        self.0.clone()
    }

    /// Records that a chunk of the response was handed to the connection (`Some`), or that the
    /// chunk before was taken (`None`).
    pub(super) fn handed(&self, at: Option<Instant>) {
        let mut state = locked(&self.0.connection.state);
        let Some(request) = state.requests.get_mut(&self.0.number) else {
            return;
        };
        let before = std::mem::replace(&mut request.handed, at.filter(|_| !request.may_wait));
        if before.is_some() && at.is_none() {
            state.taken = Instant::now();
        }
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        locked(&self.connections.open).remove(&self.number);
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        let mut state = locked(&self.0.connection.state);
        state.requests.remove(&self.0.number);
        state.idle_since = Instant::now();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: Duration = Duration::from_secs(3600);
    const PATIENCE: Patience = Patience {
        idle: LONG,
        unknown: None,
        unread: LONG,
    };

    fn address(last: u8) -> IpAddr {
        IpAddr::from([127, 0, 0, last])
    }

    #[test]
    fn who_knocks_quickly_keeps_nobody_else_out() {
        let connections = Arc::new(Connections::new(4));
        let modest = connections.enter(address(1));
        let quick: Vec<_> = (0..3).map(|_| connections.enter(address(2))).collect();
        for gone in &quick[..2] {
            assert!(connections.make_room());
            assert!(gone.connection.evicted.is_cancelled());
        }
        assert!(!modest.connection.evicted.is_cancelled());
    }

    #[test]
    fn a_connection_ends_when_it_is_idle_unknown_or_does_not_read() {
        let connections = Arc::new(Connections::new(4));
        let entry = connections.enter(address(1));
        let connection = &entry.connection;
        let never = Duration::ZERO;
        let idle = Patience {
            idle: never,
            ..PATIENCE
        };
        let unknown = Patience {
            unknown: Some(never),
            ..PATIENCE
        };
        let unread = Patience {
            unread: never,
            ..PATIENCE
        };
        assert_eq!(connection.verdict(&PATIENCE), Verdict::Keep);
        assert_eq!(connection.verdict(&idle), Verdict::Close);
        assert_eq!(connection.verdict(&unknown), Verdict::End);
        let request = connection.begin();
        assert!(connection.is_known(&Tenant::default(), false));
        for patience in [idle, unknown, unread] {
            assert_eq!(connection.verdict(&patience), Verdict::Keep);
        }
        request.handed(Some(Instant::now()));
        assert_eq!(connection.verdict(&unread), Verdict::End);
        request.handed(None);
        assert_eq!(connection.verdict(&unread), Verdict::Keep);
        // An unread stream may wait while another stream of the connection is read.
        let short = Patience {
            unread: Duration::from_millis(100),
            ..PATIENCE
        };
        let stalled = connection.begin();
        stalled.handed(Some(Instant::now()));
        for _ in 0..4 {
            std::thread::sleep(Duration::from_millis(40));
            request.handed(Some(Instant::now()));
            request.handed(None);
            assert_eq!(connection.verdict(&short), Verdict::Keep);
        }
        std::thread::sleep(Duration::from_millis(120));
        assert_eq!(connection.verdict(&short), Verdict::End);
        drop((request, stalled));
        assert_eq!(connection.verdict(&idle), Verdict::Close);
    }

    #[test]
    fn whoever_is_needed_least_makes_room_and_who_works_does_not() {
        let connections = Arc::new(Connections::new(4));
        let tenant = |name: &str| name.parse::<Tenant>().expect("a good name");
        let [works, idle] = [connections.enter(address(1)), connections.enter(address(1))];
        let _request = works.connection.begin();
        for entry in [&works, &idle] {
            assert!(entry.connection.is_known(&tenant("a"), true));
        }
        let chained = connections.enter(address(1));
        assert!(chained.connection.is_known(&tenant("a"), true));
        let events = chained.connection.begin();
        events.asking().observes();
        let [waits, unknown] = [connections.enter(address(1)), connections.enter(address(1))];
        let _request_of_nobody = waits.connection.begin();
        let is_evicted = |entry: &Entry| entry.connection.evicted.is_cancelled();
        for gone in [&unknown, &waits, &idle, &chained] {
            assert!(!is_evicted(gone));
            assert!(connections.make_room());
            assert!(is_evicted(gone));
        }
        assert!(!connections.make_room());
        assert!(!is_evicted(&works));
    }

    #[test]
    fn one_of_several_tenants_has_half_of_the_connections_at_work() {
        let connections = Arc::new(Connections::new(4));
        let tenant = |name: &str| name.parse::<Tenant>().expect("a good name");
        let mut held = Vec::new();
        let mut asks = |name: &str, several: bool| {
            let entry = connections.enter(address(1));
            let request = entry.connection.begin();
            let may = entry.connection.is_known(&tenant(name), several);
            held.push((entry, request));
            may
        };
        assert!(asks("a", true) && asks("a", true));
        assert!(!asks("a", true) && asks("a", false));
        assert!(asks("b", true));
    }
}
