//! A request body in small chunks, with a limit on the bytes that the multipart parser consumes
//! without result.
//!
//! The multipart parser buffers unparsed input and searches it again with every chunk. Without the
//! limit, an endless preamble or endless part headers would be buffered and searched forever.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};

use axum::BoxError;
use axum::body::{Body, BodyDataStream, Bytes};
use axum::extract::Request;
use futures_util::Stream;

/// Maximum size of a chunk, bytes.
const PIECE: usize = 16 << 10;

/// Maximum number of bytes without a parsed part or chunk of data: the headers of a part and one
/// chunk, bytes.
const MAX_UNREAD: usize = 2 * PIECE;

/// The number of bytes since the parser last made progress.
#[derive(Clone, Default)]
pub(super) struct Meter(Arc<AtomicUsize>);

impl Meter {
    /// Records that the parser has made progress.
    pub(super) fn understood(&self) {
        self.0.store(0, Ordering::Relaxed);
    }
}

struct Metered {
    body: BodyDataStream,
    rest: Bytes,
    meter: Meter,
    pause: bool,
}

/// Replaces the body of a request by a metered one.
pub(super) fn metered(request: Request) -> (Request, Meter) {
    let meter = Meter::default();
    let request = request.map(|body| {
        Body::from_stream(Metered {
            body: body.into_data_stream(),
            rest: Bytes::new(),
            meter: meter.clone(),
            pause: false,
        })
    });
    (request, meter)
}

impl Stream for Metered {
    type Item = Result<Bytes, BoxError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        // The parser consumes all ready input before it parses any of it. Every second poll is
        // therefore pending.
        self.pause = !self.pause;
        if !self.pause {
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        if self.rest.is_empty() {
            match Pin::new(&mut self.body).poll_next(context) {
                Poll::Ready(Some(Ok(piece))) => self.rest = piece,
                Poll::Ready(Some(Err(error))) => return Poll::Ready(Some(Err(error.into()))),
                Poll::Ready(None) => return Poll::Ready(None),
                Poll::Pending => {
                    self.pause = false;
                    return Poll::Pending;
                }
            }
        }
        let length = self.rest.len().min(PIECE);
        let piece = self.rest.split_to(length);
        if self.meter.0.fetch_add(length, Ordering::Relaxed) + length > MAX_UNREAD {
            return Poll::Ready(Some(Err("the headers of a part are too long".into())));
        }
        Poll::Ready(Some(Ok(piece)))
    }
}
