//! The writer thread: groups concurrent changes into one transaction (group commit).
//!
//! A commit waits for the disk only if it contains a durable change. Leases, heartbeats and
//! ephemeral jobs do not wait. Independent of the content of the changes.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

use rusqlite::Connection;
use tokio::sync::oneshot;

use super::statements::SqliteSql;
use crate::clock::Timestamp;
use crate::queue::effects::Effects;
use crate::queue::local::Local;
use crate::queue::sql::Sql;
use crate::queue::time;
use crate::queue::transitions::{clock, expiry};
use crate::queue::types::{QueueError, QueueOptions};

/// Maximum number of changes in one transaction.
const AT_ONCE: usize = 64;

/// Maximum sleep, and so the delay until a change of the wall clock is noticed.
const MAX_SLEEP: Duration = Duration::from_secs(1);

/// A step of the wall clock that what is due follows, milliseconds. A smaller one is within the
/// precision of the times of a job.
const STEP_MS: u64 = 10_000;

/// A change, run inside a transaction.
type Change = Box<dyn FnOnce(&Connection, &mut Effects) -> Reply + Send>;

/// Sends the result to the caller after the commit or rollback.
type Reply = Box<dyn FnOnce(Result<(), QueueError>) + Send>;

/// A change, and whether its commit waits for the disk.
pub(super) struct Command {
    durable: bool,
    change: Change,
}

/// Handle to the writer thread, which ends when the last handle is dropped.
#[derive(Clone)]
pub(super) struct Writer {
    commands: Sender<Command>,
}

impl Writer {
    /// A handle, and the inbox of its commands.
    pub(super) fn new() -> (Self, Receiver<Command>) {
        let (commands, inbox) = channel();
        (Self { commands }, inbox)
    }

    /// Starts the thread. The recovery of `connection` must be complete.
    pub(super) fn start(
        connection: Connection,
        options: QueueOptions,
        local: Arc<Local>,
    ) -> Result<Self, QueueError> {
        let (writer, inbox) = Self::new();
        let thread = thread::Builder::new().name("queue".to_owned());
        let ended = local.ended.clone();
        thread
            .spawn(move || {
                let _even_by_a_panic = ended.drop_guard();
                Turns::new(connection, options, local).run(&inbox);
            })
            .map_err(|error| QueueError::Store(error.to_string()))?;
        Ok(writer)
    }

    /// Makes a change and waits for its commit; if `durable`, until it is on disk.
    pub(super) async fn write<T: Send + 'static>(
        &self,
        durable: bool,
        change: impl FnOnce(&dyn Sql, &mut Effects) -> Result<T, QueueError> + Send + 'static,
    ) -> Result<T, QueueError> {
        let (answer, answered) = oneshot::channel();
        let change: Change = Box::new(move |connection, effects| {
            let mut own = Effects::default();
            let done = in_savepoint(connection, |sql| change(sql, &mut own));
            if done.is_ok() {
                effects.merge(own);
            }
            Box::new(move |committed| {
                let _gone_is_fine = answer.send(committed.and(done));
            })
        });
        let command = Command { durable, change };
        self.commands
            .send(command)
            .map_err(|_| QueueError::Closed)?;
        let lost = || QueueError::Store("the change was not written".to_owned());
        answered.await.map_err(|_| lost())?
    }

    /// Makes a change without waiting for it.
    pub(super) fn write_later(
        &self,
        change: impl FnOnce(&dyn Sql, &mut Effects) -> Result<(), QueueError> + Send + 'static,
    ) {
        let change: Change = Box::new(move |connection, effects| {
            let done = in_savepoint(connection, |sql| change(sql, effects));
            Box::new(move |committed| {
                if let Err(error) = committed.and(done) {
                    tracing::warn!(%error, "a note of progress was not kept");
                }
            })
        });
        let command = Command {
            durable: false,
            change,
        };
        let _closed_is_fine = self.commands.send(command);
    }
}

/// Runs a change in a savepoint. If it fails, its statements are undone and the transaction
/// continues.
fn in_savepoint<T>(
    connection: &Connection,
    change: impl FnOnce(&dyn Sql) -> Result<T, QueueError>,
) -> Result<T, QueueError> {
    connection.prepare_cached("SAVEPOINT change")?.execute([])?;
    let done = change(&SqliteSql(connection));
    if done.is_err() {
        connection
            .prepare_cached("ROLLBACK TO change")?
            .execute([])?;
    }
    connection.prepare_cached("RELEASE change")?.execute([])?;
    done
}

/// What a turn does besides its commands.
#[derive(Clone, Copy, Debug)]
struct Upkeep {
    /// By how many milliseconds the wall clock was set. What is due moves with it: it would be due at
    /// once, and results be removed before their time, or not for as long as the clock was set back.
    clock_step: Option<i64>,
    /// Does what is due at this time.
    sweep_at: Option<Instant>,
}

/// What of a turn was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Done {
    Nothing,
    /// The commands, and not what is due.
    Commands,
    All,
}

/// Commits the commands and the upkeep in one transaction.
fn commit(
    connection: &Connection,
    options: &QueueOptions,
    local: &Local,
    commands: Vec<Command>,
    upkeep: Upkeep,
) -> Done {
    let mut effects = Effects::default();
    let mut replies = Vec::with_capacity(commands.len());
    let mut swept = false;
    let follow = |sql: &dyn Sql| match upkeep.clock_step {
        None => Ok(()),
        Some(step) => clock::follow(sql, options, step),
    };
    let done = transact(
        connection,
        follow,
        commands,
        &mut effects,
        &mut replies,
        |effects| {
            let Some(now) = upkeep.sweep_at else {
                swept = true;
                return;
            };
            let mut own = Effects::default();
            let sweep = |sql: &dyn Sql| {
                let due = expiry::due(sql)?;
                for id in due.open.into_iter().chain(due.ended) {
                    let left = local.lease_left(id, options.lease, now);
                    expiry::look_after(sql, &mut own, options, id, left)?;
                }
                Ok(())
            };
            match in_savepoint(connection, sweep) {
                Ok(()) => {
                    swept = true;
                    effects.merge(own);
                }
                // The commands of the same transaction are committed all the same.
                Err(error) => {
                    tracing::error!(%error, "the queue cannot look after what is due");
                }
            }
        },
    );
    if done.is_ok() {
        local.apply(effects);
    } else if !connection.is_autocommit() {
        let _rolled_back = connection.execute_batch("ROLLBACK");
    }
    for reply in replies {
        reply(done.clone());
    }
    match done {
        Err(_) => Done::Nothing,
        Ok(()) if swept => Done::All,
        Ok(()) => Done::Commands,
    }
}

/// The work of the writer thread.
pub(super) struct Turns {
    connection: Connection,
    options: QueueOptions,
    local: Arc<Local>,
    next_due: Option<Timestamp>,
    /// When the last turn began.
    awake: Instant,
    /// Both clocks when they were last compared.
    clocks: (Timestamp, Instant),
}

impl Turns {
    /// The recovery of `connection` must be complete.
    pub(super) fn new(connection: Connection, options: QueueOptions, local: Arc<Local>) -> Self {
        Self {
            next_due: expiry::next_due(&SqliteSql(&connection)).unwrap_or(None),
            connection,
            options,
            local,
            awake: time::monotonic(),
            clocks: (time::wall(), time::monotonic()),
        }
    }

    /// By how many milliseconds the wall clock was set since the clocks were last compared.
    fn clock_step(&self, clocks: (Timestamp, Instant)) -> Option<i64> {
        let expected = self.clocks.0.after(clocks.1 - self.clocks.1);
        let step = clocks.0.as_millis() - expected.as_millis();
        (step.unsigned_abs() >= STEP_MS).then_some(step)
    }

    /// The connection, between two turns.
    #[cfg(any(test, feature = "fuzzing"))]
    pub(super) fn connection(&mut self) -> &mut Connection {
        &mut self.connection
    }

    /// Ends the work.
    #[cfg(any(test, feature = "fuzzing"))]
    pub(super) fn into_connection(self) -> Connection {
        self.connection
    }

    /// Takes turns until the last handle is dropped.
    fn run(&mut self, inbox: &Receiver<Command>) {
        loop {
            let now = time::wall();
            let sleep = self.next_due.map_or(MAX_SLEEP, |due| now.until(due));
            let first = match inbox.recv_timeout(sleep.min(MAX_SLEEP)) {
                Ok(command) => Some(command),
                Err(RecvTimeoutError::Timeout) => None,
                Err(RecvTimeoutError::Disconnected) => return,
            };
            self.turn(first, inbox);
        }
    }

    /// Commits `first` and what is in the inbox, and does what is due.
    pub(super) fn turn(&mut self, first: Option<Command>, inbox: &Receiver<Command>) {
        let mut commands: Vec<Command> = first.into_iter().collect();
        while commands.len() < AT_ONCE
            && let Ok(command) = inbox.try_recv()
        {
            commands.push(command);
        }
        // A delay of half a lease means that the process was paused, and its workers with it.
        let now = time::monotonic();
        if now - self.awake > MAX_SLEEP + self.options.lease / 2 {
            self.local.all_are_alive();
        }
        self.awake = now;
        let clocks = (time::wall(), now);
        let clock_step = self.clock_step(clocks);
        let sweeping = self.next_due.is_some_and(|due| due <= clocks.0);
        if commands.is_empty() && !sweeping && clock_step.is_none() {
            self.clocks = clocks;
            return;
        }
        let upkeep = Upkeep {
            clock_step,
            sweep_at: sweeping.then_some(now),
        };
        let (connection, options) = (&self.connection, &self.options);
        let done = commit(connection, options, &self.local, commands, upkeep);
        if clock_step.is_none() || done != Done::Nothing {
            self.clocks = clocks;
        }
        if let Some(milliseconds) = clock_step {
            tracing::warn!(
                milliseconds,
                ?done,
                "the wall clock was set: what is due moves with it"
            );
        }
        // A store that fails is not asked again at once.
        let later = Some(time::wall().after(MAX_SLEEP));
        self.next_due = match expiry::next_due(&SqliteSql(&self.connection)) {
            Ok(due) if done == Done::All => due,
            Ok(due) => due.max(later),
            Err(error) => {
                tracing::error!(%error, "the queue's store cannot be read");
                later
            }
        };
    }
}

/// Fails if the transaction is gone. SQLite rolls it back when a statement meets a disk or memory
/// fault, and later statements would run outside of it.
fn check_transaction(connection: &Connection) -> Result<(), QueueError> {
    if connection.is_autocommit() {
        let gone = "a fault has taken the transaction back".to_owned();
        return Err(QueueError::Store(gone));
    }
    Ok(())
}

/// Runs all commands in one transaction, after `first` and before `sweep`.
fn transact(
    connection: &Connection,
    first: impl FnOnce(&dyn Sql) -> Result<(), QueueError>,
    commands: Vec<Command>,
    effects: &mut Effects,
    replies: &mut Vec<Reply>,
    sweep: impl FnOnce(&mut Effects),
) -> Result<(), QueueError> {
    let durable = commands.iter().any(|command| command.durable);
    let level = if durable { "FULL" } else { "NORMAL" };
    connection
        .prepare_cached(&format!("PRAGMA synchronous = {level}"))?
        .execute([])?;
    connection.prepare_cached("BEGIN IMMEDIATE")?.execute([])?;
    first(&SqliteSql(connection))?;
    for command in commands {
        replies.push((command.change)(connection, effects));
        check_transaction(connection)?;
    }
    sweep(effects);
    check_transaction(connection)?;
    connection.prepare_cached("COMMIT")?.execute([])?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_of_a_batch_stands_whose_transaction_is_gone() {
        let connection = Connection::open_in_memory().expect("a database");
        connection
            .execute_batch("CREATE TABLE t (x)")
            .expect("a table");
        let insert = |connection: &Connection, _: &mut Effects| -> Reply {
            let done = in_savepoint(connection, |_| {
                Ok(connection.execute("INSERT INTO t VALUES (1)", [])?)
            });
            Box::new(move |committed| assert!(committed.and(done.map(drop)).is_err()))
        };
        // SQLite does this by itself after a disk fault.
        let fault = |connection: &Connection, _: &mut Effects| -> Reply {
            connection.execute_batch("ROLLBACK").expect("a transaction");
            Box::new(|committed| assert!(committed.is_err()))
        };
        let changes: [Change; 3] = [Box::new(insert), Box::new(fault), Box::new(insert)];
        let commands = changes.map(|change| Command {
            durable: false,
            change,
        });
        let mut replies = Vec::new();
        let done = transact(
            &connection,
            |_| Ok(()),
            commands.into(),
            &mut Effects::default(),
            &mut replies,
            |_| {},
        );
        assert!(done.is_err() && replies.len() == 2);
        for reply in replies {
            reply(done.clone());
        }
        let rows: i64 = connection
            .query_row("SELECT count(*) FROM t", [], |row| row.get(0))
            .expect("a number");
        assert_eq!(rows, 0);
    }
}
