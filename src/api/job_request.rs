//! The parameters of a job that a request submits.

use std::time::{Duration, Instant};

use super::admission::Durability;
use crate::job::{JobId, JobOptions};
use crate::queue::PairOf;

/// The parameters of a job, without its clouds.
#[derive(Clone, Debug)]
pub(super) struct Request {
    /// The options of the estimate.
    pub options: JobOptions,
    /// Whether the caller waits for the result.
    pub durability: Durability,
    /// The idempotency key: a repeated submission with the same key finds the job of the first one.
    pub idempotency_key: Option<String>,
    /// When the request arrived, and in which trace. Deadlines count from its arrival.
    pub received: Received,
    /// The deadline of the call itself, relative to its arrival, if there is one.
    pub time_left: Option<Duration>,
    /// The position in a chain of pairs that are submitted one by one. `None` outside of a chain.
    pub link: Option<ChainLink>,
    /// The pair and its window within the clouds that follow. [`PairOf::ALONE`] for the first two
    /// clouds.
    pub pair: PairOf,
}

/// The position of a pair in a chain.
#[derive(Clone, Copy, Debug)]
pub(super) struct ChainLink {
    /// The pair before it, if there is one.
    pub after: Option<JobId>,
}

/// The arrival of a request: a request extension.
#[derive(Clone, Debug)]
pub(super) struct Received {
    /// When it arrived.
    pub(super) at: Instant,
    /// Its span, as the value of a `traceparent` header. `None` if it belongs to no trace.
    pub(super) trace: Option<String>,
}
