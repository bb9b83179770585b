//! One connection that is opened again when it is lost, and the transactions on it.

use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use postgres::Client;

use super::statements::{Fault, PostgresSql, fault, refused};
use super::target::Target;
use super::this_node::ThisNode;
use crate::queue::effects::Effects;
use crate::queue::sql::{Sql, values};
use crate::queue::types::QueueError;

/// For how long a change waits for a database that does not answer. A restart of the database takes
/// less.
pub(super) const PATIENCE: Duration = Duration::from_secs(10);

/// The pause before a connection is opened again.
const PAUSE: Duration = Duration::from_millis(100);

/// How often a change is made again after a conflict with another transaction.
const MAX_CONFLICTS: u32 = 10;

/// Whether a change is on disk before it is acknowledged.
///
/// Transactions are committed without waiting for the disk, so that their locks are free at once. A
/// flush afterwards waits for the disk, which then has this commit and all before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Flush {
    /// Also if nothing was written: what was read may be a commit that is not on disk.
    Always,
    /// If something was written.
    IfWritten,
    /// Not at all.
    Never,
}

/// A call of a change: when it was made, and whether its caller has left meanwhile.
#[derive(Clone, Copy)]
pub(super) struct Call<'a> {
    pub(super) at: Instant,
    pub(super) has_left: &'a dyn Fn() -> bool,
}

impl Call<'_> {
    /// A call of the thread that makes the change, which does not leave.
    pub(super) fn own() -> Self {
        Self {
            at: Instant::now(),
            has_left: &|| false,
        }
    }

    fn is_late(&self) -> bool {
        self.at.elapsed() > PATIENCE
    }

    /// An error if the caller has left: it was told that the change failed.
    fn check(&self) -> Result<(), QueueError> {
        match (self.has_left)() {
            true => Err(QueueError::Store("the caller has left".to_owned())),
            false => Ok(()),
        }
    }
}

/// A change that was committed.
pub(super) struct Commit<T> {
    pub(super) value: T,
    pub(super) effects: Effects,
    /// The number of the transaction; `None` if it has written nothing.
    pub(super) transaction: Option<u64>,
}

/// Why a transaction was not committed.
enum Failed {
    /// The change is refused, or the database refuses a statement of it.
    Refused(QueueError),
    /// It was rolled back, and may be made again.
    Again(Fault, QueueError),
    /// The connection was lost during the commit of the transaction with this token.
    Unknown(Option<Token>, QueueError),
}

/// Names one transaction of one session: what the session's row in `commits` holds if the
/// transaction was committed. Numbers of transactions do not: after a crash the database gives
/// those again that had not reached its disk.
#[derive(Clone, Copy, Debug)]
struct Token {
    node: i64,
    count: i64,
}

/// A connection, at most one at a time.
pub(super) struct Session {
    target: Target,
    me: Arc<ThisNode>,
    /// The number of the session among those of its node.
    place: i64,
    /// Transactions so far.
    count: i64,
    client: Option<Client>,
    opened: Instant,
    opens: u64,
}

impl Session {
    /// A connection that is opened when it is first used, on the thread that uses it. `place` is the
    /// number of the session in this node.
    pub(super) fn new(target: Target, me: Arc<ThisNode>, place: i64) -> Self {
        Self {
            target,
            me,
            place,
            count: 0,
            client: None,
            opened: Instant::now(),
            opens: 0,
        }
    }

    /// The open connection.
    pub(super) fn client(&mut self) -> Result<&mut Client, QueueError> {
        let client = match self.client.take() {
            Some(client) if !client.is_closed() => client,
            _ => {
                let mut client = self.target.connect()?;
                // The database ends the connection of a machine that is gone, and of a process that
                // does not read.
                let settings = format!(
                    "SET tcp_keepalives_idle = 5; SET tcp_keepalives_interval = 1; \
                     SET tcp_keepalives_count = 5; SET tcp_user_timeout = 10000; {}",
                    self.me.query()
                );
                let answer = client.simple_query(&settings);
                self.me.read(&answer.map_err(|error| refused(&error))?)?;
                self.opened = Instant::now();
                self.opens += 1;
                client
            }
        };
        Ok(self.client.insert(client))
    }

    /// Whether a connection is open.
    pub(super) fn is_open(&self) -> bool {
        self.client
            .as_ref()
            .is_some_and(|client| !client.is_closed())
    }

    /// For how long the connection has been open.
    pub(super) fn age(&self) -> Duration {
        self.opened.elapsed()
    }

    /// How often the connection was opened.
    pub(super) fn opens(&self) -> u64 {
        self.opens
    }

    /// Closes the connection: the next use opens another one.
    pub(super) fn close(&mut self) {
        self.client = None;
    }

    /// Makes a change in a transaction. While the database is away it is tried again, until
    /// [`PATIENCE`] has passed since the call. If the answer to the commit is lost, another connection
    /// asks whether the transaction was committed. A change whose caller has left is rolled back.
    pub(super) fn transact<T>(
        &mut self,
        flush: Flush,
        call: Call<'_>,
        change: impl Fn(&dyn Sql, &mut Effects) -> Result<T, QueueError>,
    ) -> Result<Commit<T>, QueueError> {
        let mut conflicts = 0;
        loop {
            let mut made = None;
            let failed = self.attempt(flush, call, &change, &mut made).err();
            let error = match failed {
                None => return made.ok_or(QueueError::Closed),
                Some(Failed::Refused(error)) => return Err(error),
                Some(Failed::Again(Fault::Conflict, error)) => {
                    conflicts += 1;
                    if conflicts > MAX_CONFLICTS || call.is_late() {
                        return Err(error);
                    }
                    continue;
                }
                Some(Failed::Again(_, error)) => {
                    self.close();
                    error
                }
                Some(Failed::Unknown(token, error)) => {
                    self.close();
                    match token.map(|token| self.was_committed(token, call.at)) {
                        Some(Ok(true)) => return made.ok_or(error),
                        Some(Ok(false)) | None => error,
                        Some(Err(_)) => return Err(error),
                    }
                }
            };
            if call.is_late() {
                return Err(error);
            }
            thread::sleep(PAUSE);
        }
    }

    /// Makes the change once. What it made is in `made` if only the answer to the commit is missing.
    fn attempt<T>(
        &mut self,
        flush: Flush,
        call: Call<'_>,
        change: impl Fn(&dyn Sql, &mut Effects) -> Result<T, QueueError>,
        made: &mut Option<Commit<T>>,
    ) -> Result<(), Failed> {
        let lost = |error| Failed::Again(Fault::Lost, error);
        self.begin("off").map_err(lost)?;
        let node = self.me.number();
        self.count += 1;
        let (place, count) = (self.place, self.count);
        let client = in_transaction(&mut self.client).map_err(lost)?;
        let mut effects = Effects::default();
        let sql = PostgresSql::new(client, &self.me);
        let mut token = None;
        let done = change(&sql, &mut effects).and_then(|value| {
            let mut transaction = None;
            if sql.wrote() && flush != Flush::Never {
                let row = sql.only(NOTE_COMMIT, values![node, place, count])?;
                let number: String = row.get(0)?;
                transaction = number.parse().ok();
                token = Some(Token { node, count });
            }
            call.check()?;
            Ok((value, transaction))
        });
        let (value, transaction) = match (done, sql.fault()) {
            (Ok(done), None) => done,
            (done, found) => {
                let _a_lost_connection_does_it_too = client.batch_execute("ROLLBACK");
                let error = done.err().unwrap_or(QueueError::Closed);
                return Err(match found {
                    None | Some(Fault::Refused) => Failed::Refused(error),
                    Some(fault) => Failed::Again(fault, error),
                });
            }
        };
        *made = Some(Commit {
            value,
            effects,
            transaction,
        });
        let unknown = |error| Failed::Unknown(token, refused(&error));
        let committed = client.batch_execute("COMMIT");
        committed.map_err(|error| match fault(&error) {
            Fault::Lost => unknown(error),
            // The database has answered: the transaction is rolled back.
            Fault::Conflict => Failed::Again(Fault::Conflict, refused(&error)),
            Fault::Refused => Failed::Refused(refused(&error)),
        })?;
        match flush {
            Flush::IfWritten if token.is_none() => Ok(()),
            Flush::Never => Ok(()),
            // It is committed, and may not be on disk.
            _ => client.batch_execute(FLUSH).map_err(unknown),
        }
    }

    /// Begins a transaction, and reads the clock of the database. `synchronous` is `on` if its
    /// commit waits for the disk.
    fn begin(&mut self, synchronous: &str) -> Result<(), QueueError> {
        // A process that is stopped in the middle of a transaction must not hold its locks for long.
        let text = format!(
            "BEGIN; SET LOCAL synchronous_commit = {synchronous}; SET LOCAL lock_timeout = '10s'; \
             SET LOCAL idle_in_transaction_session_timeout = '5s'; {}",
            self.me.query()
        );
        let answer = self.client()?.simple_query(&text);
        let answer = answer.map_err(|error| refused(&error))?;
        self.me.read(&answer)
    }

    /// Runs queries, each for itself.
    pub(super) fn read<T>(
        &mut self,
        asked: Instant,
        query: impl Fn(&dyn Sql) -> Result<T, QueueError>,
    ) -> Result<T, QueueError> {
        loop {
            let me = Arc::clone(&self.me);
            let (done, is_lost) = match self.client() {
                Err(error) => (Err(error), true),
                Ok(client) => {
                    let sql = PostgresSql::new(client, &me);
                    let done = query(&sql);
                    let is_lost = sql.fault() == Some(Fault::Lost);
                    (done, is_lost)
                }
            };
            if !is_lost || asked.elapsed() > PATIENCE {
                return done;
            }
            self.close();
            thread::sleep(PAUSE);
        }
    }

    /// Whether a transaction was committed, asked on another connection. The old connection is gone
    /// or about to end its transaction: the row is locked until then.
    fn was_committed(&mut self, token: Token, asked: Instant) -> Result<bool, QueueError> {
        let place = self.place;
        loop {
            let last = self.transact_once(|sql| {
                let row = sql.only(LAST_COMMIT, values![token.node, place])?;
                row.get::<i64>(0)
            });
            match last {
                Ok(last) => return Ok(last == token.count),
                Err(error) if asked.elapsed() > 2 * PATIENCE => return Err(error),
                Err(_) => self.close(),
            }
            thread::sleep(PAUSE);
        }
    }

    /// Runs a statement in a transaction of its own, once. What it finds is on disk when it
    /// returns.
    fn transact_once<T>(
        &mut self,
        query: impl Fn(&dyn Sql) -> Result<T, QueueError>,
    ) -> Result<T, QueueError> {
        self.begin("on")?;
        let client = in_transaction(&mut self.client)?;
        let done = query(&PostgresSql::new(client, &self.me));
        let ended = client.batch_execute("COMMIT");
        ended.map_err(|error| refused(&error)).and(done)
    }
}

/// The connection on which a transaction is open: never a new one.
fn in_transaction(client: &mut Option<Client>) -> Result<&mut Client, QueueError> {
    let gone = || QueueError::Store("the connection is gone".to_owned());
    client.as_mut().ok_or_else(gone)
}

/// Waits until every commit so far is on disk. It commits an empty message, because that waits for
/// the disk.
const FLUSH: &str = "BEGIN; SET LOCAL synchronous_commit = on; \
    SELECT pg_logical_emit_message(true, 'fnsf', ''); COMMIT";

/// Notes a commit in its own transaction, and gives the number of the transaction.
const NOTE_COMMIT: &str = "INSERT INTO commits (node, place, count) VALUES (?1, ?2, ?3) \
    ON CONFLICT (node, place) DO UPDATE SET count = excluded.count \
    RETURNING pg_current_xact_id()::text";

/// Finds the last commit of a session. It waits for the end of a transaction that is still open.
const LAST_COMMIT: &str = "INSERT INTO commits (node, place, count) VALUES (?1, ?2, 0) \
    ON CONFLICT (node, place) DO UPDATE SET count = commits.count RETURNING count";
