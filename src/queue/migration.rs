//! The upgrade of a queue's schema, by itself.

/// The schema versions before and after an upgrade.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Migration {
    /// The version that was found; 0 if there was no queue.
    pub from: i64,
    /// The version of this program.
    pub to: i64,
}
