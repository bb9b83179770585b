//! A prepared target's words of the GPU's store.

use std::sync::Arc;

use super::device::Device;
use crate::flow::data::Control;
use crate::flow::field::BackendError;

/// 32-bit words of a point.
pub(super) const POINT_WORDS: u64 = 3;

/// Consecutive words of the store, among them those of the source points. Released on drop.
pub(super) struct Allocation {
    device: Arc<Device>,
    pub(super) offset: u32,
    words: u64,
}

impl Allocation {
    /// Takes `words` words for a target of the kind `what`.
    ///
    /// # Errors
    /// As [`super::allocator::Allocator::take`].
    pub(super) fn take(
        device: &Arc<Device>,
        what: &'static str,
        words: u64,
        control: &dyn Control,
    ) -> Result<Self, BackendError> {
        let offset = device.context.allocator.take(what, words, control)?;
        Ok(Self {
            device: Arc::clone(device),
            offset: offset as u32,
            words,
        })
    }

    /// Offset in the store of `points` source points, which follow the first `before` words.
    ///
    /// # Errors
    /// [`BackendError::Memory`] if the rest of the words cannot hold them.
    pub(super) fn room_for(&self, points: usize, before: u64) -> Result<u32, BackendError> {
        let (needed, available) = (points as u64 * POINT_WORDS, self.words - before);
        if needed > available {
            return Err(BackendError::Memory {
                what: "points",
                needed: needed * 4,
                available: available * 4,
            });
        }
        Ok(self.offset + before as u32)
    }
}

impl Drop for Allocation {
    fn drop(&mut self) {
        let allocator = &self.device.context.allocator;
        allocator.give_back(self.offset.into(), self.words);
    }
}
