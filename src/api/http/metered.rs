//! A body that is handed on in small pieces, and given up when nothing comes of them.
//!
//! The multipart reader keeps what it does not understand yet: a preamble or a part's headers that
//! never end would be kept and searched again with every piece.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};

use axum::BoxError;
use axum::body::{Body, BodyDataStream, Bytes};
use axum::extract::Request;
use futures_util::Stream;

/// The largest piece that is handed on.
const PIECE: usize = 16 << 10;

/// What may be handed on before something is understood: headers of a part, and a piece.
const MAX_UNREAD: usize = 2 * PIECE;

/// What has been handed on since something was understood.
#[derive(Clone, Default)]
pub(super) struct Meter(Arc<AtomicUsize>);

impl Meter {
    /// The pieces so far have led to something.
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

/// The same request with a metered body.
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
        // The reader takes all that is ready before it looks at any of it.
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
