//! Actions outside the queue that its outbox holds.

use std::sync::Arc;
use std::time::Duration;

use crate::job::{Job, JobId};

/// An action outside the queue that a commit has promised. It stays in the outbox of the queue until
/// [`Queue::settle`](super::Queue::settle) reports it done, so it may be done more than once.
#[derive(Clone, Debug, PartialEq)]
pub struct Outgoing {
    /// Its number: no other action of the queue has it, and repetitions keep it.
    pub number: i64,
    /// The job that it is about.
    pub job: JobId,
    /// Number of times that it was taken, this one included.
    pub attempts: u32,
    /// What to do.
    pub action: Action,
}

/// The longest delay of an action: a longer one is cut where the wall clock is set back.
pub const MAX_OUTGOING_DELAY: Duration = Duration::from_secs(2 * 3600);

/// What has become of an [`Outgoing`] action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Settled {
    /// It is done.
    Done,
    /// It failed, and is not tried again.
    GivenUp,
    /// It failed, and is due again after a delay.
    Again(Duration),
    /// It was not tried, and is due after a delay. The attempt does not count.
    NotTried(Duration),
}

/// What an [`Outgoing`] action does.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Removes payload, snapshot and result of a job that the queue has deleted.
    RemoveFiles,
    /// Writes the result of a job that has succeeded to the URI of its [`Job::delivery`].
    Deliver(Arc<Job>),
    /// Sends a body to a URL: that of a job that has ended. What the job delivers was delivered before,
    /// or given up.
    Notify {
        /// Where to.
        url: String,
        /// The JSON of [`crate::job::ended_notice`].
        body: String,
    },
}
