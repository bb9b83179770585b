//! The advisory locks of the queue.
//!
//! The first number of a lock says what it is for; the second one is a node, the hash of a share,
//! or 0.

/// A node is alive. The second number is that of the node.
pub(super) const NODES: i32 = 0x666e_7301;

/// A transaction gives fair tags to the jobs of one tenant and priority.
pub(super) const SHARES: i32 = 0x666e_7302;

/// A node creates the tables.
pub(super) const SCHEMA: i32 = 0x666e_7303;

/// A transaction handles a row that is due.
pub(super) const SWEEP: i32 = 0x666e_7304;

/// A node counts the load.
pub(super) const COUNT: i32 = 0x666e_7305;

/// A node recovers the jobs of a dead node, whose number is the second one.
pub(super) const RECOVERY: i32 = 0x666e_7306;
