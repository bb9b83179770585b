//! A prepared target's words of the GPU's store.

use std::sync::Arc;

use super::device::Device;
use crate::flow::data::{Control, Point};
use crate::flow::field::BackendError;

/// 32-bit words of a point.
pub(super) const POINT_WORDS: u64 = 3;

/// Consecutive words of the store: those of a target, and then those of the source points. Released
/// on drop.
pub(super) struct Allocation {
    device: Arc<Device>,
    pub(super) offset: u32,
    target_words: u64,
    point_words: u64,
}

impl Allocation {
    /// Takes `target_words` words for a target of the kind `what`, and those of `points` source
    /// points.
    ///
    /// # Errors
    /// As [`super::allocator::Allocator::take`].
    pub(super) fn take(
        device: &Arc<Device>,
        what: &'static str,
        target_words: u64,
        points: usize,
        control: &dyn Control,
    ) -> Result<Self, BackendError> {
        let point_words = points as u64 * POINT_WORDS;
        let words = target_words + point_words;
        let offset = device.context.allocator.take(what, words, control)?;
        Ok(Self {
            device: Arc::clone(device),
            offset: offset as u32,
            target_words,
            point_words,
        })
    }

    /// Bytes of the target.
    pub(super) fn target_bytes(&self) -> usize {
        self.target_words as usize * 4
    }

    /// Writes the source points that are fitted, and returns their offset in words.
    ///
    /// # Errors
    /// [`BackendError::Memory`] if there are more than the words were taken for.
    /// [`BackendError`] also as [`super::context::Context::write`].
    pub(super) fn write_points(&self, points: &[Point]) -> Result<u32, BackendError> {
        let (needed, available) = (points.len() as u64 * POINT_WORDS, self.point_words);
        if needed > available {
            return Err(BackendError::Memory {
                what: "points",
                needed: needed * 4,
                available: available * 4,
            });
        }
        let offset = u64::from(self.offset) + self.target_words;
        let context = &self.device.context;
        let (store, bytes) = (&context.buffers.store, bytemuck::cast_slice(points));
        context.write(&[(store, offset * 4, bytes)])?;
        Ok(offset as u32)
    }
}

impl Drop for Allocation {
    fn drop(&mut self) {
        let allocator = &self.device.context.allocator;
        allocator.give_back(self.offset.into(), self.target_words + self.point_words);
    }
}
