//! The context of a gRPC call: caller, arrival time and deadline.

use std::pin::Pin;
use std::time::{Duration, Instant};

use tokio_stream::Stream;
use tonic::{Request, Status};

use super::requests;
use crate::api::admission::Durability;
use crate::api::auth::Caller;
use crate::api::error::ApiError;
use crate::api::job_request::{Received, Request as JobRequest};
use crate::job::JobOptions;
use crate::queue::PairOf;

/// A stream of responses.
pub(super) type ResultBudget<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// The caller, the arrival, and the remaining time of a call.
#[derive(Clone)]
pub(super) struct Call {
    pub(super) caller: Caller,
    pub(super) received: Received,
    time_left: Option<Duration>,
}

impl Call {
    /// The context of a request.
    ///
    /// # Errors
    /// [`ApiError::Unauthenticated`] if the middleware has not identified a caller.
    pub(super) fn of<T>(request: &Request<T>) -> Result<Self, ApiError> {
        let extensions = request.extensions();
        let caller = extensions.get::<Caller>().cloned();
        let received = extensions.get::<Received>().cloned();
        Ok(Self {
            caller: caller.ok_or(ApiError::Unauthenticated)?,
            received: received.unwrap_or_else(|| Received {
                at: Instant::now(),
                trace: None,
            }),
            time_left: requests::time_left(request.metadata()),
        })
    }

    /// The parameters of a job that this call submits. The deadline of the call applies only if the
    /// caller waits for the result.
    pub(super) fn job_request(&self, options: JobOptions, durability: Durability) -> JobRequest {
        let awaited = durability == Durability::Ephemeral;
        JobRequest {
            options,
            durability,
            idempotency_key: None,
            received: self.received.clone(),
            time_left: self.time_left.filter(|_| awaited),
            link: None,
            pair: PairOf::ALONE,
        }
    }
}

/// The error for a stream that does not begin with exactly one `begin` message.
pub(super) fn no_begin() -> ApiError {
    ApiError::BadRequest("the first message is begin, and there is one of it".to_owned())
}
