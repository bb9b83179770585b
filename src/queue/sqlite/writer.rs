//! The one thread that writes: it gathers what is asked at the same time into one transaction.
//!
//! A commit waits for the disk only if somebody was promised something by it: leases, signs of
//! life and jobs that die with their caller do not wait. It must not know what is written.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

use rusqlite::Connection;
use tokio::sync::oneshot;

use super::Shared;
use super::sweep;
use super::transitions::Effects;
use crate::clock::Timestamp;
use crate::queue::{QueueError, QueueOptions};

/// Changes that one transaction takes at most.
const AT_ONCE: usize = 64;

/// The longest sleep: how late a clock that was set may be noticed.
const MAX_SLEEP: Duration = Duration::from_secs(1);

/// What a change does, inside a transaction.
type Change = Box<dyn FnOnce(&Connection, &mut Effects) -> Reply + Send>;

/// Tells the caller, once it is known whether the transaction stands.
type Reply = Box<dyn FnOnce(Result<(), QueueError>) + Send>;

struct Command {
    durable: bool,
    change: Change,
}

/// The way to the thread. It ends when the last of these is gone.
#[derive(Clone)]
pub(super) struct Writer {
    commands: Sender<Command>,
}

impl Writer {
    /// Starts the thread. `connection` is already recovered.
    pub(super) fn start(
        connection: Connection,
        options: QueueOptions,
        shared: Arc<Shared>,
    ) -> Result<Self, QueueError> {
        let (commands, inbox) = channel();
        let thread = thread::Builder::new().name("queue".to_owned());
        let ended = shared.ended.clone();
        thread
            .spawn(move || {
                let _even_by_a_panic = ended.drop_guard();
                run(&connection, &options, &shared, &inbox);
            })
            .map_err(|error| QueueError::Store(error.to_string()))?;
        Ok(Self { commands })
    }

    /// Makes a change and waits until it stands; until it is on disk, where it is `durable`.
    pub(super) async fn write<T: Send + 'static>(
        &self,
        durable: bool,
        change: impl FnOnce(&Connection, &mut Effects) -> Result<T, QueueError> + Send + 'static,
    ) -> Result<T, QueueError> {
        let (answer, answered) = oneshot::channel();
        let change: Change = Box::new(move |connection, effects| {
            let mut own = Effects::default();
            let done = in_savepoint(connection, || change(connection, &mut own));
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

    /// Makes a change that nobody waits for.
    pub(super) fn write_later(
        &self,
        change: impl FnOnce(&Connection, &mut Effects) -> Result<(), QueueError> + Send + 'static,
    ) {
        let change: Change = Box::new(move |connection, effects| {
            let done = in_savepoint(connection, || change(connection, effects));
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

/// Undoes what a change did if it fails half-way, and leaves the transaction alone.
fn in_savepoint<T>(
    connection: &Connection,
    change: impl FnOnce() -> Result<T, QueueError>,
) -> Result<T, QueueError> {
    connection.prepare_cached("SAVEPOINT change")?.execute([])?;
    let done = change();
    if done.is_err() {
        connection
            .prepare_cached("ROLLBACK TO change")?
            .execute([])?;
    }
    connection.prepare_cached("RELEASE change")?.execute([])?;
    done
}

fn run(
    connection: &Connection,
    options: &QueueOptions,
    shared: &Shared,
    inbox: &Receiver<Command>,
) {
    let mut next_due = sweep::next_due(connection).unwrap_or(None);
    let mut awake = Instant::now();
    loop {
        let now = Timestamp::now();
        let sleep = next_due
            .map_or(MAX_SLEEP, |due| now.until(due))
            .min(MAX_SLEEP);
        let first = match inbox.recv_timeout(sleep) {
            Ok(command) => Some(command),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        let mut commands: Vec<Command> = first.into_iter().collect();
        while commands.len() < AT_ONCE
            && let Ok(command) = inbox.try_recv()
        {
            commands.push(command);
        }
        // A delay of half a lease means that the process was paused, and its workers with it.
        let was_away = awake.elapsed() > MAX_SLEEP + options.lease / 2;
        awake = Instant::now();
        if was_away {
            shared.all_are_alive();
        }
        let sweeping = next_due.is_some_and(|due| due <= Timestamp::now());
        if commands.is_empty() && !sweeping {
            continue;
        }
        let mut effects = Effects::default();
        let mut replies = Vec::with_capacity(commands.len());
        let mut swept = false;
        let lease_left = |id| shared.lease_left(id, options.lease, awake);
        let done = transact(
            connection,
            commands,
            &mut effects,
            &mut replies,
            |effects| {
                if !sweeping {
                    swept = true;
                    return;
                }
                let mut own = Effects::default();
                let sweep = || sweep::sweep(connection, &mut own, options, lease_left);
                match in_savepoint(connection, sweep) {
                    Ok(()) => {
                        swept = true;
                        effects.merge(own);
                    }
                    // What others asked for at the same time stands all the same.
                    Err(error) => {
                        tracing::error!(%error, "the queue cannot look after what is due");
                    }
                }
            },
        );
        if done.is_ok() {
            shared.apply(effects);
        } else if !connection.is_autocommit() {
            let _rolled_back = connection.execute_batch("ROLLBACK");
        }
        for reply in replies {
            reply(done.clone());
        }
        // A store that fails is not asked again at once.
        let later = Some(Timestamp::now().after(MAX_SLEEP));
        next_due = match sweep::next_due(connection) {
            Ok(due) if swept && done.is_ok() => due,
            Ok(due) => due.max(later),
            Err(error) => {
                tracing::error!(%error, "the queue's store cannot be read");
                later
            }
        };
    }
}

/// Refuses to go on where the transaction is gone: SQLite takes all of it back when a statement meets
/// a fault of the disk or of memory, and what came next would stand alone.
fn check_transaction(connection: &Connection) -> Result<(), QueueError> {
    if connection.is_autocommit() {
        let gone = "a fault has taken the transaction back".to_owned();
        return Err(QueueError::Store(gone));
    }
    Ok(())
}

/// One transaction over all commands.
fn transact(
    connection: &Connection,
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
            let done = in_savepoint(connection, || {
                Ok(connection.execute("INSERT INTO t VALUES (1)", [])?)
            });
            Box::new(move |committed| assert!(committed.and(done.map(drop)).is_err()))
        };
        // What SQLite does by itself when it meets a fault of the disk.
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
