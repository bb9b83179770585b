//! Calls of the queue that have begun, polled by hand.

use std::pin::Pin;
use std::task::{Context, Poll, Waker};

use std::sync::Arc;

use crate::job::{Job, JobId};
use crate::queue::lease::Lease;
use crate::queue::outgoing::Outgoing;
use crate::queue::types::{Committed, Outcome, QueueError, Submission, Submitted};

/// What a call asks for.
#[derive(Debug)]
pub(super) enum Asked {
    Submit(Box<Submission>),
    Lease(usize),
    Finish(JobId, u32, Outcome),
    Cancel(JobId),
    MakeDurable(JobId),
    Requeue(JobId),
    Other,
}

/// The answer to a call.
#[derive(Debug)]
pub(super) enum Answer {
    Submitted(Submitted),
    Leased(Lease),
    Finished(Committed),
    Job(Arc<Job>),
    Taken(Vec<Outgoing>),
    Done,
}

type Answering = dyn Future<Output = Result<Answer, QueueError>> + Send;

/// A call that has begun. Dropping it is a caller that goes away.
pub(super) struct Call {
    pub(super) asked: Asked,
    answering: Pin<Box<Answering>>,
}

impl Call {
    pub(super) fn new(
        asked: Asked,
        answering: impl Future<Output = Result<Answer, QueueError>> + Send + 'static,
    ) -> Self {
        Self {
            asked,
            answering: Box::pin(answering),
        }
    }

    /// Continues the call as far as it goes.
    pub(super) fn poll(&mut self) -> Option<Result<Answer, QueueError>> {
        let mut context = Context::from_waker(Waker::noop());
        match self.answering.as_mut().poll(&mut context) {
            Poll::Ready(answer) => Some(answer),
            Poll::Pending => None,
        }
    }
}
