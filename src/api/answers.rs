//! Room for the answers that are being made and sent, and the last ones that were made.
//!
//! A client may read as slowly as its connection is allowed to; until it has, its answer is held.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::error::ApiError;
use crate::job::JobId;

/// The unit in which room is counted, bytes.
const UNIT: usize = 1 << 10;

/// The part of all room that answers which nobody reads any more may keep, for the next range of
/// the same result.
const KEPT: usize = 4;

/// Which answer: the job, its attempt, and the format's ending.
pub(super) type Name = (JobId, u32, &'static str);

/// Room for all answers.
pub(super) struct Answers {
    units: usize,
    patience: Duration,
    free: Arc<Semaphore>,
    kept: Mutex<VecDeque<(Name, Bytes)>>,
}

/// Room for one answer, given back when it is dropped.
#[derive(Debug)]
pub(super) struct AnswerRoom(OwnedSemaphorePermit);

/// Bytes and the room that they take, as long as any of them is held.
struct Held {
    bytes: Vec<u8>,
    _room: AnswerRoom,
}

impl AsRef<[u8]> for Held {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Answers {
    /// Room of `bytes`; an answer waits for others to be taken, but not longer than `patience`.
    pub(super) fn new(bytes: u64, patience: Duration) -> Self {
        let units = usize::try_from(bytes).unwrap_or(usize::MAX) / UNIT;
        let units = units.clamp(1, u32::MAX as usize);
        Self {
            units,
            patience,
            free: Arc::new(Semaphore::new(units)),
            kept: Mutex::default(),
        }
    }

    fn kept(&self) -> MutexGuard<'_, VecDeque<(Name, Bytes)>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Room for an answer that takes `bytes` while it is made; one that takes more than all has to
    /// be alone.
    ///
    /// # Errors
    /// [`ApiError::ServerFull`] where others are not read in time.
    pub(super) async fn room(&self, bytes: usize) -> Result<AnswerRoom, ApiError> {
        let units = bytes.div_ceil(UNIT).clamp(1, self.units) as u32;
        if let Ok(permit) = Arc::clone(&self.free).try_acquire_many_owned(units) {
            return Ok(AnswerRoom(permit));
        }
        self.kept().clear();
        let free = Arc::clone(&self.free).acquire_many_owned(units);
        match tokio::time::timeout(self.patience, free).await {
            Ok(Ok(permit)) => Ok(AnswerRoom(permit)),
            _ => Err(ApiError::ServerFull(Duration::from_secs(5))),
        }
    }

    /// An answer that was made before.
    pub(super) fn made(&self, name: &Name) -> Option<Bytes> {
        let kept = self.kept();
        let found = kept.iter().find(|(known, _)| known == name);
        found.map(|(_, bytes)| bytes.clone())
    }

    /// Keeps an answer for whoever asks for it next, in place of the oldest.
    pub(super) fn keep(&self, name: Name, bytes: &Bytes) {
        let most = self.units / KEPT * UNIT;
        if bytes.len() > most {
            return;
        }
        let mut kept = self.kept();
        kept.retain(|(known, _)| *known != name);
        kept.push_back((name, bytes.clone()));
        let mut all: usize = kept.iter().map(|(_, bytes)| bytes.len()).sum();
        while all > most
            && let Some((_, oldest)) = kept.pop_front()
        {
            all -= oldest.len();
        }
    }
}

impl AnswerRoom {
    /// Gives back what an answer of `bytes` does not need.
    pub(super) fn shrink(&mut self, bytes: usize) {
        let needed = bytes.div_ceil(UNIT).max(1);
        let spare = self.0.num_permits().saturating_sub(needed);
        drop(self.0.split(spare));
    }

    /// The bytes of an answer, which keep their room as long as any part of them is held.
    pub(super) fn hold(mut self, bytes: Vec<u8>) -> Bytes {
        self.shrink(bytes.len());
        Bytes::from_owner(Held { bytes, _room: self })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn answers_that_are_not_read_keep_the_next_one_out_until_they_are() {
        let answers = Answers::new(1 << 20, Duration::from_millis(50));
        let room = answers.room(1 << 20).await.expect("room");
        let held = room.hold(vec![0; 600 << 10]);
        let part = held.slice(5..10);
        drop(held);
        let refused = answers.room(600 << 10).await;
        assert!(matches!(refused, Err(ApiError::ServerFull(_))));
        let small = answers.room(400 << 10).await.expect("what was spare");
        drop((part, small));
        // One that is larger than all is alone, and not refused for ever.
        answers.room(1 << 30).await.expect("room");
    }

    #[tokio::test]
    async fn answers_are_kept_for_the_next_range_unless_room_is_needed() {
        let answers = Answers::new(1 << 20, Duration::from_millis(50));
        let name = |attempt| (JobId::fresh(), attempt, "npz");
        let [first, second, third, large] = [1, 2, 3, 4].map(name);
        for name in [first, second, third] {
            let room = answers.room(100 << 10).await.expect("room");
            answers.keep(name, &room.hold(vec![0; 100 << 10]));
        }
        assert!(answers.made(&first).is_none());
        assert_eq!(
            answers.made(&third).map(|bytes| bytes.len()),
            Some(100 << 10)
        );
        let room = answers.room(1 << 20).await.expect("room");
        assert!(answers.made(&third).is_none());
        answers.keep(large, &room.hold(vec![0; 300 << 10]));
        assert!(answers.made(&large).is_none());
    }
}
