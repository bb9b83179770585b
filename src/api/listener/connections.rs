//! The open connections of a port: what each of them does, and which one makes room for another.
//!
//! The limits of a socket do not see HTTP/2: a stream without a window writes nothing, and a client
//! that answers pings is never silent. So every connection is looked at for what it asks and takes.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;

use crate::job::Tenant;

/// The rank from which on a connection has shown a key.
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
    /// Cancelled when it has to make room.
    evicted: CancellationToken,
}

struct State {
    /// Whose key it has shown.
    tenant: Option<Tenant>,
    /// Requests that are being answered.
    requests: HashMap<u64, Open>,
    next: u64,
    /// Since when there is none.
    idle_since: Instant,
    /// When a piece of any answer was taken last.
    taken: Instant,
}

/// A request that is being answered.
#[derive(Default)]
struct Open {
    /// When a piece of its answer was handed over that has not been taken yet.
    handed: Option<Instant>,
    /// Whether it only observes: its client can ask again at any time.
    observes: bool,
    /// Whether its client may leave the answer unread.
    may_wait: bool,
}

/// A request, for those who answer it: a request extension.
#[derive(Clone)]
pub(in crate::api) struct Asking {
    connection: Arc<Connection>,
    number: u64,
}

/// How long a connection may be without what it is for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patience {
    /// Without a request.
    pub(super) idle: Duration,
    /// Without a good key; none where no key is needed.
    pub(super) unknown: Option<Duration>,
    /// Without taking a piece of any answer.
    pub(super) unread: Duration,
}

/// What is to be done with a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    Keep,
    /// It is idle: it may end what is on its way.
    Close,
    /// It is to end now.
    End,
}

/// A connection's place in the table, until it is dropped.
pub(super) struct Entry {
    connections: Arc<Connections>,
    number: u64,
    pub(super) connection: Arc<Connection>,
}

/// A request that is being answered, until it is dropped.
pub(super) struct OpenRequest(Asking);

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Connections {
    /// No connection yet, of so many at most.
    pub(super) fn new(most: usize) -> Self {
        Self {
            most,
            open: Mutex::default(),
            next: AtomicU64::new(0),
        }
    }

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

    /// Evicts one connection so that a new one has room. Candidates in order: without a key, without
    /// a request, with observing requests alone. Of several it takes the longest idle. It never evicts
    /// a connection with other requests of a known tenant. False without a candidate.
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
        // Of those without a key, one of the address that has most: a flood evicts itself.
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

    /// Whether a tenant is being answered on more than half of all connections.
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
    /// A good key was shown, or none is needed. Says whether its tenant may have one more connection
    /// at work: of several tenants one may have half of all.
    fn is_known(&self, tenant: &Tenant, several: bool) -> bool {
        locked(&self.state).tenant = Some(tenant.clone());
        let Some(connections) = self.connections.upgrade().filter(|_| several) else {
            return true;
        };
        !connections.is_crowded_by(tenant)
    }

    /// Since when it has no request.
    fn idle_since(&self) -> Instant {
        locked(&self.state).idle_since
    }

    /// Returns when it has to make room.
    pub(super) async fn evicted(&self) {
        self.evicted.cancelled().await;
    }

    /// A request begins; it ends when the guard is dropped.
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

    /// What is to be done with it now.
    pub(super) fn verdict(&self, patience: &Patience) -> Verdict {
        let state = locked(&self.state);
        // One stream that its reader has paused does not end those beside it.
        let mut handed = state.requests.values().filter_map(|open| open.handed);
        let waits = handed.any(|at| at.elapsed() >= patience.unread);
        if waits && state.taken.elapsed() >= patience.unread {
            return Verdict::End;
        }
        let unknown = patience.unknown.filter(|_| state.tenant.is_none());
        if let Some(longest) = unknown {
            // It may end what it asks, and not ask for ever.
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

    /// Its caller has shown a good key, or none is needed. Says whether the tenant may have one more
    /// connection at work: of `several` tenants one may have half of all.
    pub(in crate::api) fn is_known(&self, tenant: &Tenant, several: bool) -> bool {
        self.connection.is_known(tenant, several)
    }

    /// It only observes a job or health: event streams, long polls and the like. Its connection may
    /// have to make room, and its client asks again.
    pub(in crate::api) fn observes(&self) {
        self.update(|open| open.observes = true);
    }

    /// Its answer holds little and may be left unread: a stream whose client works on each message
    /// before it takes the next one.
    pub(in crate::api) fn may_wait(&self) {
        self.update(|open| open.may_wait = true);
    }
}

impl OpenRequest {
    /// What those who answer it see of it.
    pub(super) fn asking(&self) -> Asking {
        self.0.clone()
    }

    /// A piece of the answer was handed over, or (none) the piece before has been taken.
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
        // Beside a stream that is taken, one that is not may wait.
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
        let follows = connections.enter(address(1));
        assert!(follows.connection.is_known(&tenant("a"), true));
        let events = follows.connection.begin();
        events.asking().observes();
        let [waits, unknown] = [connections.enter(address(1)), connections.enter(address(1))];
        let _request_of_nobody = waits.connection.begin();
        let is_evicted = |entry: &Entry| entry.connection.evicted.is_cancelled();
        for gone in [&unknown, &waits, &idle, &follows] {
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
