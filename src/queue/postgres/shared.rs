//! What the threads of a node share.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use super::backlog::Ledger;
use super::beats::Beats;
use super::bell::{Bell, Changes};
use super::session::{Call, Flush, Session};
use super::this_node::ThisNode;
use crate::queue::effects::Effects;
use crate::queue::local::Local;
use crate::queue::sql::Sql;
use crate::queue::types::{QueueError, QueueOptions};

/// What the threads of a node share.
pub(super) struct Shared {
    pub(super) local: Arc<Local>,
    pub(super) options: QueueOptions,
    pub(super) name: String,
    pub(super) me: Arc<ThisNode>,
    pub(super) ledger: Ledger,
    pub(super) bell: Bell,
    pub(super) beats: Beats,
    /// Number of nodes, as last counted.
    pub(super) nodes: AtomicU32,
    stopping: AtomicBool,
}

impl Shared {
    pub(super) fn new(
        local: Arc<Local>,
        options: QueueOptions,
        name: &str,
        me: &Arc<ThisNode>,
    ) -> Self {
        Self {
            local,
            options,
            name: name.to_owned(),
            me: Arc::clone(me),
            ledger: Ledger::default(),
            bell: Bell::default(),
            beats: Beats::default(),
            nodes: AtomicU32::new(1),
            stopping: AtomicBool::default(),
        }
    }

    /// The number of this node.
    pub(super) fn node(&self) -> i64 {
        self.me.number()
    }

    pub(super) fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }

    /// Ends the threads.
    pub(super) fn stop(&self) {
        self.stopping.store(true, Ordering::Relaxed);
        self.bell.wake();
    }

    /// Makes a change on a connection of this node and applies its effects.
    pub(super) fn change<T>(
        &self,
        session: &mut Session,
        flush: Flush,
        call: Call<'_>,
        change: impl Fn(&dyn Sql, &mut Effects) -> Result<T, QueueError>,
    ) -> Result<T, QueueError> {
        let commit = session.transact(flush, call, change)?;
        self.committed(commit.effects, commit.transaction);
        Ok(commit.value)
    }

    /// Applies the effects of a commit of this node. The subscribers are told by the upkeep, which
    /// reads the jobs again: commits of several connections come here in any order.
    fn committed(&self, effects: Effects, transaction: Option<u64>) {
        self.ledger.add(&self.local, &effects, transaction);
        self.local.apply_to_running(&effects);
        let changes = Changes::of(&effects);
        if !changes.is_empty() {
            self.bell.here(changes);
        }
        self.local.tell(effects);
    }
}
