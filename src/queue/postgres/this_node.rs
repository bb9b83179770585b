//! What all connections of this node know of it: its number, whether it is alive for the others, and
//! how its clock differs from the database's.

use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};

use postgres::SimpleQueryMessage;

use crate::clock::Timestamp;
use crate::queue::types::QueueError;

/// This node.
#[derive(Debug)]
pub(super) struct ThisNode {
    /// 0 before it is shown to the others.
    number: AtomicI64,
    is_alive: AtomicBool,
    /// The time of the database less that of this process, milliseconds, as last measured.
    ahead_ms: AtomicI64,
}

impl ThisNode {
    pub(super) fn new() -> Self {
        Self {
            number: AtomicI64::new(0),
            is_alive: AtomicBool::new(true),
            ahead_ms: AtomicI64::new(0),
        }
    }

    pub(super) fn number(&self) -> i64 {
        self.number.load(Ordering::Relaxed)
    }

    pub(super) fn set_number(&self, number: i64) {
        self.number.store(number, Ordering::Relaxed);
        self.is_alive.store(true, Ordering::Relaxed);
    }

    /// Whether the others have not taken it for dead, as last read.
    pub(super) fn is_alive(&self) -> bool {
        self.is_alive.load(Ordering::Relaxed)
    }

    /// The time of the database.
    pub(super) fn now(&self) -> Timestamp {
        Timestamp::now().on_clock_ahead(self.ahead_ms.load(Ordering::Relaxed))
    }

    /// The query that [`ThisNode::read`] takes the answer of.
    pub(super) fn query(&self) -> String {
        let stopped = match self.number() {
            0 => "0".to_owned(),
            number => format!("(SELECT stopped FROM nodes WHERE id = {number})"),
        };
        format!("SELECT (extract(epoch FROM clock_timestamp()) * 1000)::bigint, {stopped}")
    }

    /// Reads the clock of the database, and whether this node is alive.
    pub(super) fn read(&self, answer: &[SimpleQueryMessage]) -> Result<(), QueueError> {
        let row = answer.iter().find_map(|message| match message {
            SimpleQueryMessage::Row(row) => Some(row),
            _ => None,
        });
        let time = row.and_then(|row| row.get(0)?.parse::<i64>().ok());
        let no_time = || QueueError::Store("the database has no time".to_owned());
        let ahead = time.ok_or_else(no_time)? - Timestamp::now().as_millis();
        self.ahead_ms.store(ahead, Ordering::Relaxed);
        let is_alive = row.is_some_and(|row| row.get(1) == Some("0"));
        self.is_alive.store(is_alive, Ordering::Relaxed);
        Ok(())
    }
}
