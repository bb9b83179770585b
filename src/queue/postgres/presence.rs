//! The thread that shows that this node is alive and hears the others: their changes, and their
//! ends.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use postgres::fallible_iterator::FallibleIterator;

use super::backlog;
use super::bell::Changes;
use super::nodes::{GRACE, GRACE_AFTER_AN_END, SECOND_LOOK, Silent, look, recover, show};
use super::session::Session;
use super::shared::Shared;
use super::statements::refused;
use crate::queue::types::QueueError;

/// The channel of the notifications.
pub(super) const CHANNEL: &str = "fnsf";

/// How long one wait for a notification takes at most.
const TICK: Duration = Duration::from_millis(50);

/// The pause after an error.
const PAUSE: Duration = Duration::from_millis(200);

/// The presence of a node, on its own connection.
pub(super) struct Presence {
    shared: Arc<Shared>,
    session: Session,
    /// The opening of the connection on which the node was last shown.
    shown: u64,
    /// The nodes that did not hold their locks when last looked at.
    suspects: Vec<Silent>,
    looked: Instant,
    counted: Instant,
}

impl Presence {
    pub(super) fn new(shared: Arc<Shared>, session: Session) -> Self {
        let long_ago = Instant::now();
        Self {
            shared,
            session,
            shown: 0,
            suspects: Vec::new(),
            looked: long_ago,
            counted: long_ago,
        }
    }

    /// Shows the node, recovers the jobs of nodes that have ended, and counts the load. The queue
    /// is then ready for use.
    pub(super) fn open(&mut self) -> Result<(), QueueError> {
        let grace = match backlog::was_counted_lately(&mut self.session)? {
            true => GRACE_AFTER_AN_END,
            false => GRACE,
        };
        self.show()?;
        loop {
            let node = self.shared.node();
            let first = look(&mut self.session, node)?;
            // Others that are alive know whether the silent ones have only lost their connections.
            if first.silent.is_empty() || first.alive > 0 {
                break;
            }
            thread::sleep(SECOND_LOOK);
            let second = look(&mut self.session, node)?;
            let is_early = second.is_young || self.session.age() < grace;
            for dead in second.silent {
                // One that said that it stops does not come back.
                if first.silent.contains(&dead) && (dead.stopped || !is_early) {
                    recover(&mut self.session, dead, &self.shared)?;
                }
            }
        }
        self.count(true)
    }

    /// Goes on until the queue is dropped.
    pub(super) fn run(mut self) {
        while !self.shared.is_stopping() {
            if let Err(error) = self.turn() {
                tracing::warn!(%error, "the queue's database cannot be heard");
                self.session.close();
                thread::sleep(PAUSE);
            }
        }
    }

    fn turn(&mut self) -> Result<(), QueueError> {
        self.show()?;
        self.listen()?;
        if self.looked.elapsed() >= SECOND_LOOK {
            self.look_for_the_dead()?;
            self.looked = Instant::now();
        }
        if self.counted.elapsed() >= backlog::INTERVAL {
            self.count(false)?;
            self.counted = Instant::now();
        }
        Ok(())
    }

    fn count(&mut self, at_once: bool) -> Result<(), QueueError> {
        let (ledger, local) = (&self.shared.ledger, &self.shared.local);
        backlog::refresh(&mut self.session, ledger, local, at_once)
    }

    /// Shows the node and listens, on a connection that was opened since the last time.
    fn show(&mut self) -> Result<(), QueueError> {
        self.session.client()?;
        if self.session.opens() == self.shown {
            return Ok(());
        }
        let opens = self.session.opens();
        show(&mut self.session, &self.shared.me, &self.shared.name)?;
        let listen = format!("LISTEN {CHANNEL}");
        let listening = self.session.client()?.batch_execute(&listen);
        listening.map_err(|error| refused(&error))?;
        if self.session.opens() != opens {
            return Err(QueueError::Store(
                "the connection was lost again".to_owned(),
            ));
        }
        self.shown = opens;
        self.suspects.clear();
        // What happened meanwhile was not heard.
        self.shared.bell.wake();
        self.shared.local.wake();
        Ok(())
    }

    /// Waits for notifications, at most one tick.
    fn listen(&mut self) -> Result<(), QueueError> {
        let client = self.session.client()?;
        let mut heard = Changes::default();
        let mut notifications = client.notifications();
        let mut next = notifications.timeout_iter(TICK).next();
        while let Some(notification) = next.map_err(|error| refused(&error))? {
            heard.merge(Changes::from_payload(notification.payload()));
            next = notifications.iter().next();
        }
        if heard.ready {
            self.shared.local.wake();
        }
        if !heard.is_empty() {
            self.shared.bell.elsewhere(heard);
        }
        Ok(())
    }

    /// Recovers the jobs of the nodes that were without their locks at this look and the last one.
    fn look_for_the_dead(&mut self) -> Result<(), QueueError> {
        let look = look(&mut self.session, self.shared.node())?;
        self.shared.nodes.store(look.alive + 1, Ordering::Relaxed);
        if look.is_young || self.session.age() < GRACE {
            return Ok(());
        }
        let now = look.silent;
        let before = std::mem::replace(&mut self.suspects, now.clone());
        for dead in now.into_iter().filter(|node| before.contains(node)) {
            recover(&mut self.session, dead, &self.shared)?;
        }
        Ok(())
    }
}
