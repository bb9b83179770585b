//! All that is known about a job, and how it goes through its states.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::device::DeviceKind;
use super::id::{JobId, Tenant};
use super::options::Priority;
use crate::clock::Timestamp;

/// Where a job is on its way. The last four are ends: nothing leaves them but by being asked for
/// again.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Waits for a device.
    Queued,
    /// A device works on it.
    Running,
    /// Its flow can be fetched.
    Succeeded,
    /// It was tried as often as is allowed, or cannot be done.
    Failed,
    /// Somebody did not want it any more.
    Cancelled,
    /// Its time was up before a device was free.
    Expired,
}

impl State {
    /// All states.
    pub const ALL: [Self; 6] = [
        Self::Queued,
        Self::Running,
        Self::Succeeded,
        Self::Failed,
        Self::Cancelled,
        Self::Expired,
    ];

    /// Whether nothing more will happen.
    pub fn is_end(self) -> bool {
        !matches!(self, Self::Queued | Self::Running)
    }

    /// The name that answers and metrics use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
            Self::Expired => "expired",
        }
    }
}

/// What a job works on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Two sweeps.
    Pair,
    /// Sweeps in order; its consecutive pairs are jobs of their own.
    Sequence,
}

/// How far an optimization has come.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, ToSchema)]
pub struct JobProgress {
    /// Iterations done.
    pub iteration: u32,
    /// Iterations at most.
    pub max_iterations: u32,
    /// Mean loss of the latest iteration, metres.
    pub loss: f64,
}

/// Why a job did not succeed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct JobError {
    /// A stable name for programs.
    pub code: String,
    /// What a person reads.
    pub message: String,
    /// Whether the same job may succeed when it is asked for again.
    pub retryable: bool,
}

/// A job, as the queue knows it.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// Its name.
    pub id: JobId,
    /// Whose it is.
    pub tenant: Tenant,
    /// A pair or a sequence.
    pub kind: Kind,
    /// The sequence that it is a pair of.
    pub parent: Option<JobId>,
    /// The earlier of its two sweeps in that sequence, from 0.
    pub place: u32,
    /// Whether it goes back in time, from the later sweep to the earlier one.
    pub backward: bool,
    /// The sweeps that it is found from: the first, and the one after the last.
    pub sees: [u32; 2],
    /// Pairs of a sequence, those that go back in time included; 0 for a pair.
    pub pairs: u32,
    /// Pairs of a sequence that have not ended yet.
    pub pairs_left: u32,
    /// The job that has to end before it is started.
    pub after: Option<JobId>,
    /// Whether another job may come after it, and use what it leaves behind.
    pub followed: bool,
    /// Since when nothing but a device is missing; none while it comes after a job that has not
    /// ended, and for a sequence until it has something of its own to do.
    pub ready: Option<Timestamp>,
    /// How urgent it is.
    pub priority: Priority,
    /// The kind of device that it has to be done on; none where any will do.
    pub device: Option<DeviceKind>,
    /// Where it is on its way.
    pub state: State,
    /// Whether it outlives its caller: a job that was promised, not one that somebody waits for.
    pub durable: bool,
    /// How often it was started; the fence token of the latest start.
    pub attempt: u32,
    /// How often what it ran on died under it, process or device, since its latest snapshot.
    pub crashes: u32,
    /// Predicted compute seconds.
    pub cost_seconds: f64,
    /// The options, as JSON.
    pub options: String,
    /// When it was accepted.
    pub created: Timestamp,
    /// When it was first started.
    pub started: Option<Timestamp>,
    /// When it ended.
    pub finished: Option<Timestamp>,
    /// When the best flow so far is wanted.
    pub deadline: Option<Timestamp>,
    /// How far it has come.
    pub progress: Option<JobProgress>,
    /// Why its optimization stopped.
    pub stop_reason: Option<String>,
    /// Why it did not succeed.
    pub error: Option<JobError>,
    /// Whether it lies in the dead letters: given up after too many attempts.
    pub dead: bool,
    /// Whether its end is asked for.
    pub cancel_requested: bool,
    /// What the solver reports, as JSON.
    pub report: Option<String>,
}

impl Job {
    /// Under whose name a pair's sweeps lie, and which of them are source and target.
    pub fn sweeps(&self) -> (JobId, [u32; 2]) {
        let owner = self.parent.unwrap_or(self.id);
        match self.backward {
            false => (owner, [self.place, self.place + 1]),
            true => (owner, [self.place + 1, self.place]),
        }
    }
}
