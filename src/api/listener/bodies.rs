//! Wrappers for bodies: a request body ends at its first error and yields to other tasks, and a
//! response body is sent in chunks with its read progress recorded.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use axum::BoxError;
use axum::body::Body as AnyBody;
use bytes::Bytes;
use hyper::body::{Body, Frame, SizeHint};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::coop::poll_proceed;
use tokio::time::{Sleep, sleep};

use super::connections::OpenRequest;

/// Maximum size of a response chunk, bytes. It bounds the memory of a stream that is not read.
const PIECE: usize = 64 << 10;

/// A request body that cannot keep its reader busy forever.
///
/// After an error the body ends, although HTTP/2 repeats the error at every poll. Each frame costs
/// cooperative task budget, so a source that is always ready cannot starve timers and other tasks.
pub(in crate::api) struct RequestBody<B> {
    body: B,
    ended: bool,
}

impl<B> RequestBody<B> {
    pub(in crate::api) fn new(body: B) -> Self {
        Self { body, ended: false }
    }
}

impl<B: Body<Data = Bytes> + Unpin> Body for RequestBody<B> {
    type Data = Bytes;
    type Error = B::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, B::Error>>> {
        if self.ended {
            return Poll::Ready(None);
        }
        let budget = ready!(poll_proceed(context));
        let frame = ready!(Pin::new(&mut self.body).poll_frame(context));
        budget.made_progress();
        self.ended = !matches!(frame, Some(Ok(_)));
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.ended || self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// The error of a body that has not come in time.
#[derive(Debug, thiserror::Error)]
#[error("the request did not come in time")]
pub(in crate::api) struct NotInTime;

/// A request body that has to come in time, or it ends with [`NotInTime`].
pub(in crate::api) struct TimedBody<B> {
    body: B,
    end: Pin<Box<Sleep>>,
}

impl<B> TimedBody<B> {
    /// `most` is the time for the whole body, from now on.
    pub(in crate::api) fn new(body: B, most: Duration) -> Self {
        Self {
            body,
            end: Box::pin(sleep(most)),
        }
    }
}

impl<B: Body<Data = Bytes, Error: Into<BoxError>> + Unpin> Body for TimedBody<B> {
    type Data = Bytes;
    type Error = BoxError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, BoxError>>> {
        if self.end.as_mut().poll(context).is_ready() {
            return Poll::Ready(Some(Err(NotInTime.into())));
        }
        let frame = ready!(Pin::new(&mut self.body).poll_frame(context));
        Poll::Ready(frame.map(|frame| frame.map_err(Into::into)))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// A response body in chunks. Its request is open until it is dropped.
///
/// A frame of the inner body that is larger than a chunk is held until it is sent, and is charged
/// to the port's budget. If the budget is exhausted, the response ends with an error.
pub(super) struct AnswerBody {
    body: AnyBody,
    rest: Bytes,
    room: Option<Arc<Semaphore>>,
    held: Option<OwnedSemaphorePermit>,
    request: OpenRequest,
}

impl AnswerBody {
    /// `room` is the budget in bytes. `None` if the body has its own reservation.
    pub(super) fn new(body: AnyBody, request: OpenRequest, room: Option<Arc<Semaphore>>) -> Self {
        Self {
            body,
            rest: Bytes::new(),
            room,
            held: None,
            request,
        }
    }

    /// Charges the current frame to the budget, and releases the frame before.
    fn hold(&mut self) -> Result<(), BoxError> {
        self.held = None;
        if self.rest.len() <= PIECE {
            return Ok(());
        }
        if let Some(room) = &self.room {
            let bytes = u32::try_from(self.rest.len()).unwrap_or(u32::MAX);
            let held = Arc::clone(room).try_acquire_many_owned(bytes);
            self.held = Some(held.map_err(|_| "too many answers are not read")?);
        }
        Ok(())
    }
}

impl Body for AnswerBody {
    type Data = Bytes;
    type Error = BoxError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, BoxError>>> {
        // A poll for more means that the connection has taken the chunk before.
        self.request.handed(None);
        let budget = ready!(poll_proceed(context));
        if self.rest.is_empty() {
            let frame = match ready!(Pin::new(&mut self.body).poll_frame(context)) {
                None => return Poll::Ready(None),
                Some(Err(error)) => return Poll::Ready(Some(Err(error.into()))),
                Some(Ok(frame)) => frame,
            };
            match frame.into_data() {
                Ok(data) => {
                    self.rest = data;
                    if let Err(error) = self.hold() {
                        self.rest = Bytes::new();
                        return Poll::Ready(Some(Err(error)));
                    }
                }
                Err(trailers) => return Poll::Ready(Some(Ok(trailers))),
            }
        }
        budget.made_progress();
        let length = self.rest.len().min(PIECE);
        let piece = self.rest.split_to(length);
        if self.rest.is_empty() {
            self.held = None;
        }
        self.request.handed(Some(Instant::now()));
        Poll::Ready(Some(Ok(Frame::data(piece))))
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        let (rest, hint) = (self.rest.len() as u64, self.body.size_hint());
        let mut all = SizeHint::new();
        if let Some(upper) = hint.upper() {
            all.set_upper(upper + rest);
        }
        all.set_lower(hint.lower() + rest);
        all
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use http_body_util::BodyExt;
    use tokio::time::timeout;

    use super::*;
    use crate::api::listener::connections::Connections;
    use crate::api::tests::ForEver;

    #[tokio::test]
    async fn a_body_ends_after_its_first_error_and_a_ready_one_lets_timers_run() {
        let mut broken = RequestBody::new(ForEver(Err("reset")));
        assert!(broken.frame().await.expect("the error").is_err());
        assert!(broken.frame().await.is_none() && broken.is_end_stream());
        let mut endless = RequestBody::new(ForEver(Ok::<_, Infallible>(Bytes::new())));
        let reading = async { while endless.frame().await.is_some() {} };
        // On one thread: without the task budget this would never return.
        let read = timeout(Duration::from_millis(20), reading).await;
        assert!(read.is_err());
    }

    #[tokio::test]
    async fn an_answer_comes_in_pieces_and_says_its_length() {
        let bytes: Vec<u8> = (0..3 * PIECE + 5).map(|at| (at % 251) as u8).collect();
        let connections = Arc::new(Connections::new(1));
        let entry = connections.enter(std::net::IpAddr::from([127, 0, 0, 1]));
        let body = AnyBody::from(bytes.clone());
        let room = Arc::new(Semaphore::new(bytes.len() + 10));
        let full = Some(Arc::clone(&room));
        let mut answer = AnswerBody::new(body, entry.connection.begin(), full.clone());
        let mut read = Vec::new();
        loop {
            let left = (bytes.len() - read.len()) as u64;
            assert_eq!(answer.size_hint().exact(), Some(left));
            let Some(frame) = answer.frame().await else {
                break;
            };
            let piece = frame.expect("no error").into_data().expect("data");
            assert!(piece.len() <= PIECE);
            read.extend_from_slice(&piece);
            if read.len() < bytes.len() {
                // A second response of that size exceeds the budget.
                let body = AnyBody::from(bytes.clone());
                let request = entry.connection.begin();
                let mut other = AnswerBody::new(body, request, full.clone());
                assert!(other.frame().await.expect("an end").is_err());
            }
        }
        assert_eq!(room.available_permits(), bytes.len() + 10);
        assert!(read == bytes && answer.is_end_stream());
    }
}
