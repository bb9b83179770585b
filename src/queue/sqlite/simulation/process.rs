//! A process that has the queue open, its disk, and what may go wrong with both.

use std::cell::RefCell;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex};

use rusqlite::Connection;
use tokio::sync::mpsc;

use super::engine::SimulatedEngine;
use crate::queue::database::DatabaseQueue;
use crate::queue::interface::Queue;
use crate::queue::local::Local;
use crate::queue::sqlite::engine::recover;
use crate::queue::sqlite::schema::create;
use crate::queue::sqlite::writer::{Command, Turns, Writer};
use crate::queue::types::{Event, QueueOptions};
use crate::sync::locked;

const DATABASE: &str = "main";

/// A database in memory. A commit is on the disk once it, or a later one, has waited for it.
pub(super) struct Disk {
    connection: Connection,
    /// The database as it is on the disk.
    image: Vec<u8>,
    commits: Arc<AtomicU64>,
    fails: Arc<AtomicBool>,
}

thread_local! {
    /// Kept from schedule to schedule, with its prepared statements.
    static SPARE: RefCell<Option<Disk>> = const { RefCell::new(None) };
}

impl Disk {
    /// An empty database.
    pub(super) fn new() -> Self {
        let mut disk = SPARE.take().unwrap_or_else(Self::create);
        disk.empty();
        disk
    }

    fn create() -> Self {
        let mut connection = Connection::open_in_memory().expect("a database");
        connection.set_prepared_statement_cache_capacity(128);
        create(&connection).expect("the tables");
        let commits = Arc::new(AtomicU64::new(0));
        let fails = Arc::new(AtomicBool::new(false));
        let (counted, asked) = (Arc::clone(&commits), Arc::clone(&fails));
        let hook = move || {
            let fails = asked.swap(false, Relaxed);
            counted.fetch_add(u64::from(!fails), Relaxed);
            fails
        };
        connection.commit_hook(Some(hook)).expect("a hook");
        Self {
            connection,
            image: Vec::new(),
            commits,
            fails,
        }
    }

    fn empty(&mut self) {
        let all = "DELETE FROM jobs; DELETE FROM labels; DELETE FROM outbox;";
        self.fails.store(false, Relaxed);
        self.connection.execute_batch(all).expect("no rows");
        self.image = image_of(&mut self.connection);
    }

    /// Reads rows.
    pub(super) fn with<T>(&self, read: impl FnOnce(&Connection) -> T) -> T {
        read(&self.connection)
    }

    /// Keeps the database for the next schedule.
    pub(super) fn keep(self) {
        SPARE.set(Some(self));
    }

    /// What was not waited for is lost.
    pub(super) fn lose_power(&mut self) {
        let image = self.image.as_slice();
        let restored = self
            .connection
            .deserialize_read_exact(DATABASE, image, image.len(), false);
        restored.expect("the database is restored");
    }
}

fn image_of(connection: &mut Connection) -> Vec<u8> {
    let image = connection.serialize(DATABASE).expect("an image");
    image.to_vec()
}

/// A process that has the queue open.
pub(super) struct Process {
    pub(super) queue: Arc<dyn Queue>,
    pub(super) local: Arc<Local>,
    pub(super) events: mpsc::UnboundedReceiver<Event>,
    turns: Arc<Mutex<Turns>>,
    inbox: Receiver<Command>,
    image: Vec<u8>,
    commits: Arc<AtomicU64>,
    fails: Arc<AtomicBool>,
}

impl Process {
    /// Opens the queue and recovers what the last process left behind. `orderly` tells whether that one
    /// had stopped in order.
    pub(super) fn start(disk: Disk, options: &QueueOptions, orderly: bool) -> Self {
        let (sender, events) = mpsc::unbounded_channel();
        let local = Arc::new(Local::new(sender));
        recover(&disk.connection, options, &local, || orderly).expect("a recovery");
        let turns = Turns::new(disk.connection, options.clone(), Arc::clone(&local));
        let turns = Arc::new(Mutex::new(turns));
        let (writer, inbox) = Writer::new();
        let engine = SimulatedEngine {
            writer,
            turns: Arc::clone(&turns),
            local: Arc::clone(&local),
            options: options.clone(),
        };
        Self {
            queue: Arc::new(DatabaseQueue::new(engine, options.clone())),
            local,
            events,
            turns,
            inbox,
            image: disk.image,
            commits: disk.commits,
            fails: disk.fails,
        }
    }

    /// Lets the writer commit what is pending and do what is due. `fails`: the commit does not work.
    pub(super) fn turn(&mut self, fails: bool) {
        self.fails.store(fails, Relaxed);
        let before = self.commits.load(Relaxed);
        let mut turns = locked(&self.turns);
        turns.turn(None, &self.inbox);
        self.fails.store(false, Relaxed);
        let connection = turns.connection();
        let waits: i64 = connection
            .prepare_cached("PRAGMA synchronous")
            .and_then(|mut level| level.query_row([], |row| row.get(0)))
            .expect("a level");
        if self.commits.load(Relaxed) > before && waits >= 2 {
            self.image = image_of(connection);
        }
    }

    /// Reads rows.
    pub(super) fn with<T>(&self, read: impl FnOnce(&Connection) -> T) -> T {
        read(locked(&self.turns).connection())
    }

    /// Ends the process. All calls must have been dropped.
    pub(super) fn end(self) -> Disk {
        drop(self.queue);
        let turns = Arc::into_inner(self.turns).expect("all other handles are dropped");
        Disk {
            connection: turns
                .into_inner()
                .expect("no panic before")
                .into_connection(),
            image: self.image,
            commits: self.commits,
            fails: self.fails,
        }
    }
}
