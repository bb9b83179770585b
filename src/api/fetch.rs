//! Files of sweeps: fetched where a request names them by URI, and decoded.
//!
//! Independent of HTTP and gRPC types.

use futures_util::StreamExt;

use super::codec;
use super::error::ApiError;
use super::service::Service;
use super::upload_budget::UploadReservation;
use crate::payload::StoredCloud;

impl Service {
    /// Fetches the file that the part `part` names. It counts as if it were sent in its place. Returns
    /// the name of the file and its content.
    ///
    /// # Errors
    /// [`ApiError::BadRequest`], [`ApiError::BadInput`] or [`ApiError::SourceUnavailable`] for a file that
    /// is not allowed, not there or not to be had, or the errors of [`UploadReservation::take`] and
    /// [`UploadReservation::wait`].
    pub(super) async fn fetch(
        &self,
        room: &mut UploadReservation,
        part: &str,
        uri: &str,
    ) -> Result<(String, Vec<u8>), ApiError> {
        let refused = |error| ApiError::source(part, &error);
        let tenant = room.tenant().clone();
        let _turn = self.fetches.wait(&tenant).await;
        let opened = room.wait(self.remotes.sources.open(uri)).await?;
        let mut download = opened.map_err(refused)?;
        let mut bytes = Vec::new();
        while let Some(piece) = room.wait(download.pieces.next()).await? {
            let piece = piece.map_err(refused)?;
            room.take(piece.len())?;
            append(&mut bytes, &piece);
        }
        match download.blake3 {
            Some(expected) if blake3::hash(&bytes) != expected => Err(ApiError::BadInput(format!(
                "{part}: the file has another hash than the URI"
            ))),
            _ => Ok((download.name, bytes)),
        }
    }

    /// Decodes one cloud on a blocking thread. `room` is a reservation for it, which is returned with it.
    ///
    /// # Errors
    /// [`ApiError::BadInput`], [`ApiError::TooLarge`] or [`ApiError::ServerFull`].
    pub(super) async fn decode(
        &self,
        mut room: UploadReservation,
        part: String,
        name: Option<String>,
        bytes: Vec<u8>,
    ) -> Result<(StoredCloud, UploadReservation), ApiError> {
        let most = self.admission.limits().max_points;
        let tenant = room.tenant().clone();
        let decode = move || {
            // A small compressed file may decode to a large cloud.
            let memory = codec::decoding_memory(&part, &bytes, name.as_deref(), most)?;
            room.check(memory.clouds.saturating_add(memory.meanwhile))?;
            room.hold(memory.clouds)?;
            let mut meanwhile = room.another();
            meanwhile.hold(memory.meanwhile)?;
            let cloud = codec::read_cloud(&part, &bytes, name.as_deref(), most)?;
            drop(meanwhile);
            Ok((cloud, room))
        };
        self.compute(&tenant, decode).await
    }
}

/// Appends a piece of a file.
pub(super) fn append(bytes: &mut Vec<u8>, piece: &[u8]) {
    if bytes.capacity() - bytes.len() < piece.len() {
        // Doubling the capacity would take twice the size of a large file.
        bytes.reserve_exact(piece.len().max(bytes.len() / 4));
    }
    bytes.extend_from_slice(piece);
}
