//! The open connections of a port: what each of them does, and which one makes room for another.
//!
//! The limits of a socket do not see HTTP/2: a stream without a window writes nothing, and a client
//! that answers pings is never silent. So every connection is looked at for what it asks and takes.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;

use crate::job::Tenant;

/// The open connections of one port.
#[derive(Default)]
pub(super) struct Connections {
    open: Mutex<HashMap<u64, Arc<Connection>>>,
    next: AtomicU64,
}

/// One open connection. Requests carry it as an extension.
pub(in crate::api) struct Connection {
    opened: Instant,
    address: IpAddr,
    state: Mutex<State>,
    /// Cancelled when it has to make room.
    evicted: CancellationToken,
}

struct State {
    /// Whose key it has shown.
    tenant: Option<Tenant>,
    /// Requests that are being answered, and when a piece of each one's answer was handed over.
    requests: HashMap<u64, Option<Instant>>,
    next: u64,
    /// Since when there is none.
    idle_since: Instant,
}

/// How long a connection may be without what it is for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patience {
    /// Without a request.
    pub(super) idle: Duration,
    /// Without a good key; none where no key is needed.
    pub(super) unknown: Option<Duration>,
    /// Without taking the next piece of an answer.
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
pub(super) struct OpenRequest {
    connection: Arc<Connection>,
    number: u64,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Connections {
    pub(super) fn enter(self: &Arc<Self>, address: IpAddr) -> Entry {
        let now = Instant::now();
        let connection = Arc::new(Connection {
            opened: now,
            address,
            state: Mutex::new(State {
                tenant: None,
                requests: HashMap::new(),
                next: 0,
                idle_since: now,
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

    /// Ends the connection that is needed least, so that one from `address` has room: one that has
    /// shown no key, else one without a request, else one of whoever holds more than half of all.
    /// The oldest of several. False where there is none.
    pub(super) fn make_room(&self, address: IpAddr) -> bool {
        let mut open = locked(&self.open);
        let all = open.len();
        let mut held: HashMap<Holder, usize> = HashMap::new();
        for connection in open.values() {
            *held.entry(connection.holder()).or_default() += 1;
        }
        let newcomer = Holder::Address(address);
        let rank = |connection: &Connection| {
            let holder = connection.holder();
            let state = locked(&connection.state);
            if state.tenant.is_none() && state.requests.is_empty() {
                Some(0)
            } else if state.tenant.is_none() {
                Some(1)
            } else if state.requests.is_empty() {
                Some(2)
            } else if held[&holder] * 2 > all && holder != newcomer {
                Some(3)
            } else {
                None
            }
        };
        let least = open
            .iter()
            .filter_map(|(number, one)| Some((rank(one)?, one.opened, *number)))
            .min();
        let Some((.., number)) = least else {
            return false;
        };
        if let Some(evicted) = open.remove(&number) {
            evicted.evicted.cancel();
        }
        true
    }
}

/// Who holds a connection: the tenant whose key it has shown, else the address it came from.
#[derive(PartialEq, Eq, Hash)]
enum Holder {
    Tenant(Tenant),
    Address(IpAddr),
}

impl Connection {
    fn holder(&self) -> Holder {
        match &locked(&self.state).tenant {
            Some(tenant) if *tenant != Tenant::default() => Holder::Tenant(tenant.clone()),
            _ => Holder::Address(self.address),
        }
    }

    /// A good key was shown, or none is needed.
    pub(in crate::api) fn is_known(&self, tenant: &Tenant) {
        locked(&self.state).tenant = Some(tenant.clone());
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
        state.requests.insert(number, None);
        OpenRequest {
            connection: Arc::clone(self),
            number,
        }
    }

    /// What is to be done with it now.
    pub(super) fn verdict(&self, patience: &Patience) -> Verdict {
        let state = locked(&self.state);
        let mut handed = state.requests.values().flatten();
        if handed.any(|at| at.elapsed() >= patience.unread) {
            return Verdict::End;
        }
        let unknown = patience.unknown.filter(|_| state.tenant.is_none());
        if unknown.is_some_and(|longest| self.opened.elapsed() >= longest) {
            return Verdict::End;
        }
        let idle = state.requests.is_empty() && state.idle_since.elapsed() >= patience.idle;
        if idle { Verdict::Close } else { Verdict::Keep }
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        locked(&self.connections.open).remove(&self.number);
    }
}

impl OpenRequest {
    /// A piece of the answer was handed over, or (none) the piece before has been taken.
    pub(super) fn handed(&self, at: Option<Instant>) {
        if let Some(request) = locked(&self.connection.state)
            .requests
            .get_mut(&self.number)
        {
            *request = at;
        }
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        let mut state = locked(&self.connection.state);
        state.requests.remove(&self.number);
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
    fn a_connection_ends_when_it_is_idle_unknown_or_does_not_read() {
        let connections = Arc::new(Connections::default());
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
        connection.is_known(&Tenant::default());
        for patience in [idle, unknown, unread] {
            assert_eq!(connection.verdict(&patience), Verdict::Keep);
        }
        request.handed(Some(Instant::now()));
        assert_eq!(connection.verdict(&unread), Verdict::End);
        request.handed(None);
        assert_eq!(connection.verdict(&unread), Verdict::Keep);
        drop(request);
        assert_eq!(connection.verdict(&idle), Verdict::Close);
    }

    #[test]
    fn whoever_is_needed_least_makes_room_and_who_works_alone_does_not() {
        let connections = Arc::new(Connections::default());
        let tenant = |name: &str| name.parse::<Tenant>().expect("a good name");
        let enter = |last| connections.enter(address(last));
        let [greedy, also_greedy, modest] = [1, 2, 3].map(enter);
        for entry in [&greedy, &also_greedy] {
            entry.connection.is_known(&tenant("greedy"));
        }
        modest.connection.is_known(&tenant("modest"));
        let _requests = [&greedy, &also_greedy, &modest].map(|entry| entry.connection.begin());
        let (unknown, idle) = (enter(4), enter(5));
        idle.connection.is_known(&tenant("idle"));
        let is_evicted = |entry: &Entry| entry.connection.evicted.is_cancelled();
        for gone in [&unknown, &idle, &greedy] {
            assert!(!is_evicted(gone));
            assert!(connections.make_room(address(9)));
            assert!(is_evicted(gone));
        }
        assert!(!connections.make_room(address(9)));
        assert!(!is_evicted(&also_greedy) && !is_evicted(&modest));
    }
}
