//! Files of sweeps: fetched where a request names them by URI, and decoded.
//!
//! Independent of HTTP and gRPC types.

use std::future::Future;
use std::time::Duration;

use futures_util::StreamExt;
use tokio::time::timeout;
use url::{Position, Url};

use super::codec;
use super::error::ApiError;
use super::service::Service;
use super::upload_budget::UploadReservation;
use crate::payload::StoredCloud;

/// Waits for a source, within the time limits of a body.
async fn wait<T>(
    room: &mut UploadReservation,
    part: &str,
    more: impl Future<Output = T>,
) -> Result<T, ApiError> {
    let text = || format!("{part}: the file cannot be fetched: its source is too slow");
    let came = room.wait(more).await;
    came.map_err(|_| ApiError::SourceUnavailable(text()))
}

impl Service {
    /// Fetches the file that the part `part` names. It counts as if it were sent in its place. Returns
    /// the name of the file and its content.
    ///
    /// # Errors
    /// [`ApiError::BadRequest`], [`ApiError::BadInput`] or [`ApiError::SourceUnavailable`] for a file that
    /// is not allowed, not there or not to be had in time, [`ApiError::ServerFull`] where too many are
    /// being fetched, or the errors of [`UploadReservation::take`].
    pub(super) async fn fetch(
        &self,
        room: &mut UploadReservation,
        part: &str,
        uri: &str,
    ) -> Result<(String, Vec<u8>), ApiError> {
        let refused = |error| ApiError::source(part, &error);
        let tenant = room.tenant().clone();
        let source = Url::parse(uri).map(|url| url[..Position::BeforePath].to_owned());
        let of_source = (tenant.clone(), source.unwrap_or_default());
        let turns = async {
            let of_source = self.sources.wait(&of_source).await;
            (of_source, self.fetches.wait(&tenant).await)
        };
        let turns = timeout(self.limits.body_idle, turns).await;
        let _turns = turns.map_err(|_| ApiError::ServerFull(Duration::from_secs(1)))?;
        let opened = wait(room, part, self.remotes.sources.open(uri)).await?;
        let mut download = opened.map_err(refused)?;
        let mut bytes = Vec::new();
        while let Some(piece) = wait(room, part, download.pieces.next()).await? {
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
