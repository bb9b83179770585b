//! What every call has: who calls, since when, until when.

use std::pin::Pin;
use std::time::{Duration, Instant};

use tokio_stream::Stream;
use tonic::{Request, Status};

use super::convert;
use crate::api::admission::Promise;
use crate::api::auth::Caller;
use crate::api::draft::{Arrived, Request as DraftRequest};
use crate::api::error::ApiError;
use crate::job::JobOptions;
use crate::queue::PairOf;

/// A stream of answers.
pub(super) type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Who calls, and until when.
#[derive(Clone)]
pub(super) struct Call {
    pub(super) caller: Caller,
    pub(super) arrived: Instant,
    time_left: Option<Duration>,
}

impl Call {
    pub(super) fn of<T>(request: &Request<T>) -> Result<Self, ApiError> {
        let extensions = request.extensions();
        let caller = extensions.get::<Caller>().cloned();
        let arrived = extensions.get::<Arrived>().map(|arrived| arrived.0);
        Ok(Self {
            caller: caller.ok_or(ApiError::Unauthenticated)?,
            arrived: arrived.unwrap_or_else(Instant::now),
            time_left: convert::time_left(request.metadata()),
        })
    }

    /// What is asked of a job of this call.
    pub(super) fn draft_request(&self, options: JobOptions, promise: Promise) -> DraftRequest {
        let awaited = promise == Promise::WhileAwaited;
        DraftRequest {
            options,
            promise,
            idempotency_key: None,
            arrived: self.arrived,
            time_left: self.time_left.filter(|_| awaited),
            link: None,
            pair: PairOf::ALONE,
        }
    }
}

/// The first message of a stream has to begin it.
pub(super) fn no_begin() -> ApiError {
    ApiError::BadRequest("the first message is begin, and there is one of it".to_owned())
}
