//! A request body whose messages lie in the memory budget of its caller.
//!
//! Tonic collects a message until it is complete, and keeps that memory for the next one. A stream
//! may stop within a message or after it, and would hold the memory for as long as it likes.

use std::pin::Pin;
use std::task::{Context, Poll, ready};

use axum::BoxError;
use bytes::Bytes;
use hyper::body::{Body, Frame, SizeHint};
use tonic::Status;

use crate::api::error::ApiError;
use crate::api::upload_budget::{MessageMemory, UploadReservation};

/// Bytes before a message: a flag for compression, and the length of the message.
const PREFIX: usize = 5;

/// Messages up to this size are in no budget, bytes.
const SMALL: u64 = 64 << 10;

/// The body of a call that takes clouds.
pub(super) struct MessageBody<B> {
    body: B,
    /// Largest message, bytes. A larger one is left to tonic, which refuses it.
    most: u64,
    frames: Frames,
    room: UploadReservation,
    memory: MessageMemory,
}

/// Follows the borders of the messages.
#[derive(Default)]
struct Frames {
    prefix: [u8; PREFIX],
    /// Bytes of the prefix so far.
    known: usize,
    /// Bytes that are missing from the message.
    missing: u64,
    /// Bytes of the largest message so far, as it came.
    largest: u64,
    /// Whether a message was compressed.
    is_compressed: bool,
}

impl Frames {
    /// Moves on by the next bytes of the body.
    fn pass(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            if self.known < PREFIX {
                let (now, rest) = bytes.split_at(bytes.len().min(PREFIX - self.known));
                self.prefix[self.known..][..now.len()].copy_from_slice(now);
                self.known += now.len();
                bytes = rest;
                if self.known == PREFIX {
                    let [flag, length @ ..] = self.prefix;
                    self.missing = u32::from_be_bytes(length).into();
                    self.largest = self.largest.max(self.missing);
                    self.is_compressed |= flag != 0;
                }
            } else {
                let now = self.missing.min(bytes.len() as u64);
                self.missing -= now;
                bytes = &bytes[now as usize..];
            }
            if self.known == PREFIX && self.missing == 0 {
                self.known = 0;
            }
        }
    }

    /// Memory that tonic needs for the messages so far, bytes. `most` is the size of the largest
    /// message, which a compressed one may unfold to.
    fn memory(&self, most: u64) -> u64 {
        let unfolded = if self.is_compressed { most } else { 0 };
        match self.largest.min(most) + unfolded {
            0..=SMALL => 0,
            bytes => bytes,
        }
    }
}

impl<B> MessageBody<B> {
    /// `room` is an empty reservation of the caller, and `memory` shows what it has.
    pub(super) fn new(
        body: B,
        most: usize,
        room: UploadReservation,
        memory: MessageMemory,
    ) -> Self {
        Self {
            body,
            most: most as u64,
            frames: Frames::default(),
            room,
            memory,
        }
    }

    /// Reserves memory for the messages that begin in `bytes`, as long as they have announced.
    fn take(&mut self, bytes: &[u8]) -> Result<(), ApiError> {
        self.frames.pass(bytes);
        self.room.hold(self.frames.memory(self.most))?;
        self.memory.set(self.room.bytes());
        Ok(())
    }
}

impl<B: Body<Data = Bytes, Error: Into<BoxError>> + Unpin> Body for MessageBody<B> {
    type Data = Bytes;
    type Error = BoxError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, BoxError>>> {
        let frame = ready!(Pin::new(&mut self.body).poll_frame(context));
        if let Some(Ok(frame)) = &frame
            && let Some(bytes) = frame.data_ref()
            && let Err(error) = self.take(bytes)
        {
            return Poll::Ready(Some(Err(Status::from(error).into())));
        }
        Poll::Ready(frame.map(|frame| frame.map_err(Into::into)))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A body of messages of these lengths.
    fn messages(lengths: &[u32]) -> Vec<u8> {
        let mut body = Vec::new();
        for &length in lengths {
            body.push(0);
            body.extend(length.to_be_bytes());
            body.extend(vec![9; length as usize]);
        }
        body
    }

    #[test]
    fn the_borders_of_messages_are_found_in_pieces_of_any_size() {
        let body = messages(&[0, 1, 5, 300, 0, 7]);
        for size in [1, 2, 4, 5, 6, 11, 1000] {
            let mut frames = Frames::default();
            for piece in body.chunks(size) {
                frames.pass(piece);
            }
            assert_eq!((frames.known, frames.largest), (0, 300), "{size}");
            frames.pass(&[0, 0, 0, 1, 45]);
            assert_eq!((frames.known, frames.missing), (PREFIX, 301), "{size}");
        }
    }

    #[test]
    fn the_memory_is_that_of_the_largest_message_and_of_what_it_may_unfold_to() {
        const MOST: u64 = 1 << 20;
        let mut frames = Frames::default();
        frames.pass(&messages(&[100, SMALL as u32]));
        assert_eq!(frames.memory(MOST), 0);
        // It is announced, and has not come.
        frames.pass(&messages(&[80_000])[..PREFIX]);
        assert_eq!(frames.memory(MOST), 80_000);
        frames.pass(&messages(&[80_000, 3])[PREFIX..]);
        assert_eq!(frames.memory(MOST), 80_000);
        frames.pass(&[1, 0, 0, 0, 1, 9]);
        assert_eq!(frames.memory(MOST), 80_000 + MOST);
        frames.pass(&[0, 255, 255, 255, 255]);
        assert_eq!(frames.memory(MOST), 2 * MOST);
    }
}
