//! Writes to the GPU's buffers.
//!
//! They go through upload buffers of their own. With `Queue::write_buffer` of wgpu, a lack of
//! memory for its staging buffer loses the device, and with it the pairs of all lanes.

use super::buffers::{Mapping, Write, allocated};
use super::context::Context;
use crate::flow::field::BackendError;

/// The most bytes in upload buffers at the same time, for one call.
const UPLOADED_AT_ONCE: usize = 64 << 20;

impl Context {
    /// Writes to buffers with the usage `COPY_DST`. Commands that are submitted later see the
    /// contents.
    ///
    /// # Errors
    /// [`BackendError::Busy`] if the GPU has no free memory now; the device stays. Some of the
    /// contents may then be written. [`BackendError::Lost`] if the GPU does not answer.
    pub(super) fn write(&self, writes: &[Write<'_>]) -> Result<(), BackendError> {
        self.write_in_pieces(writes, UPLOADED_AT_ONCE)
    }

    /// As [`Self::write`], with at most `most` bytes in upload buffers at the same time.
    pub(super) fn write_in_pieces(
        &self,
        writes: &[Write<'_>],
        most: usize,
    ) -> Result<(), BackendError> {
        let mut group = Vec::new();
        let mut bytes = 0;
        for &(buffer, at, contents) in writes {
            for (piece, from) in contents.chunks(most).zip((at..).step_by(most)) {
                if bytes + piece.len() > most {
                    let uploaded = self.upload(&group, bytes)?;
                    self.wait(&uploaded)?;
                    group.clear();
                    bytes = 0;
                }
                bytes += piece.len();
                group.push((buffer, from, piece));
            }
        }
        if bytes > 0 {
            self.upload(&group, bytes)?;
        }
        Ok(())
    }

    /// Copies the contents of `group`, `bytes` bytes together, through one upload buffer.
    fn upload(
        &self,
        group: &[Write<'_>],
        bytes: usize,
    ) -> Result<wgpu::SubmissionIndex, BackendError> {
        // A lost device reports no error of a buffer.
        self.watchdog.check()?;
        let usage = wgpu::BufferUsages::MAP_WRITE | wgpu::BufferUsages::COPY_SRC;
        let upload = allocated(
            &self.device,
            "upload",
            bytes as u64,
            usage,
            Mapping::AtCreation,
        );
        let upload = upload.map_err(|error| self.busy_if_it_fits(error, usage))?;
        let unmapped = |error: wgpu::MapRangeError| {
            let lost = self.watchdog.check().err();
            lost.unwrap_or_else(|| BackendError::Device(error.to_string()))
        };
        let mut view = upload.get_mapped_range_mut(..).map_err(unmapped)?;
        let mut encoder = self.encoder();
        let mut from = 0;
        for &(buffer, at, contents) in group {
            view.slice(from..from + contents.len())
                .copy_from_slice(contents);
            let size = contents.len() as u64;
            encoder.copy_buffer_to_buffer(&upload, from as u64, buffer, at, size);
            from += contents.len();
        }
        drop(view);
        upload.unmap();
        Ok(self.queue.submit([encoder.finish()]))
    }
}
