//! The nodes of a queue, and what they can do.

use crate::clock::Timestamp;
use crate::job::DeviceKind;

/// What the devices of one kind can do.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Capacity {
    /// Number of pairs that they compute at the same time.
    pub lanes: u32,
    /// Nominal seconds of work that they complete per second ([`crate::cost`]).
    pub rate: f64,
}

/// What a node can do, by kind of device in the order of [`DeviceKind::ALL`].
pub type Capacities = [Capacity; DeviceKind::ALL.len()];

/// A process that has the queue open.
#[derive(Clone, Debug, PartialEq)]
pub struct Node {
    /// Its number.
    pub number: i64,
    /// Its name, for operators.
    pub name: String,
    /// The version of its program.
    pub version: String,
    /// When it opened the queue.
    pub started: Timestamp,
    /// Whether it is this process.
    pub is_this: bool,
    /// What it can do.
    pub capacities: Capacities,
}
