//! Tracks of sequences, computed from the stored results of their pairs when they are asked for.
//!
//! Independent of HTTP and gRPC types.

use std::sync::Arc;

use super::error::ApiError;
use super::lost::{damaged, lost_or};
use super::result_budget::{Encoded, ResultReservation};
use super::service::Service;
use crate::flow::tracks::{ClusteredSweep, Track, Tracker};
use crate::formats::write_tracks;
use crate::job::{Job, Kind, State};
use crate::payload::{StoredCloud, StoredFlow};
use crate::storage::Blob;

/// Bytes of a state and of a track in an answer, at most.
const STATE_BYTES: usize = 400;
const TRACK_BYTES: usize = 200;

/// The tracks of a sequence as far as its pairs have succeeded.
#[derive(Debug)]
pub(super) struct SequenceTracks {
    pub(super) tracks: Vec<Track>,
    /// Pairs that the tracks are from: the first ones of the sequence.
    pub(super) pairs: usize,
}

impl Service {
    /// The tracks of a sequence, from its pairs up to the first that has not succeeded. The memory
    /// for one pair at a time is reserved.
    ///
    /// # Errors
    /// - [`ApiError::BadRequest`] for a pair, and for a sequence without clusters or ego motions.
    /// - [`ApiError::ServerFull`] if too many archives and tracks are under way.
    /// - [`ApiError::NotEnded`] or the error of the sequence if its first pair has not succeeded.
    /// - As for [`Service::answer`] for the results of the pairs.
    pub(super) async fn tracks(&self, sequence: &Job) -> Result<SequenceTracks, ApiError> {
        if sequence.kind != Kind::Sequence {
            let text = "tracks are of a sequence, and this job is a pair";
            return Err(ApiError::BadRequest(text.to_owned()));
        }
        let _turn = self.archives.take(&sequence.tenant)?;
        let pairs = self.pairs(sequence).await?;
        let succeeded = pairs
            .iter()
            .take_while(|pair| pair.state == State::Succeeded);
        let pairs: Vec<&Arc<Job>> = succeeded.collect();
        if pairs.is_empty() {
            Self::check_success(sequence)?;
        }
        let mut tracker = Tracker::default();
        for pair in &pairs {
            tracker = self.track(tracker, pair).await?;
        }
        Ok(SequenceTracks {
            tracks: tracker.finish(),
            pairs: pairs.len(),
        })
    }

    /// The tracks as JSON, with the number of pairs that they are from.
    ///
    /// # Errors
    /// As for [`Service::tracks`]; [`ApiError::ServerFull`] if there is no memory for the text.
    pub(super) async fn encoded_tracks(
        &self,
        sequence: &Job,
    ) -> Result<(Encoded, usize), ApiError> {
        let SequenceTracks { tracks, pairs } = self.tracks(sequence).await?;
        let room = self.room_for_tracks(sequence, &tracks).await?;
        let mut text = Vec::new();
        write_tracks(&tracks, &mut text).map_err(ApiError::internal)?;
        Ok((room.hold(text), pairs))
    }

    /// Memory for an answer with tracks.
    ///
    /// # Errors
    /// [`ApiError::ServerFull`] if there is none in time.
    pub(super) async fn room_for_tracks(
        &self,
        sequence: &Job,
        tracks: &[Track],
    ) -> Result<ResultReservation, ApiError> {
        let states: usize = tracks.iter().map(|track| track.states.len()).sum();
        let bytes = states * STATE_BYTES + (tracks.len() + 1) * TRACK_BYTES;
        self.answers.room(&sequence.tenant, bytes).await
    }

    /// Adds the source sweep of a pair to the tracker.
    async fn track(&self, mut tracker: Tracker, pair: &Arc<Job>) -> Result<Tracker, ApiError> {
        let dt_s = Self::report(pair)?.dt_s as f32;
        let room = self.room_for_result(pair).await?;
        let turn = self.encoding.wait(&pair.tenant).await;
        let flow = self.result_bytes(pair).await?;
        let (owner, [source, _]) = pair.sweeps();
        let cloud = self.blobs.get(owner, Blob::Sweep(source)).await;
        let cloud = cloud.map_err(|error| lost_or(pair.id, error))?;
        let id = pair.id;
        let track = move || {
            // The work goes on when its caller has gone, and so do its turn and its memory.
            let _held = (turn, room);
            let flow = StoredFlow::from_bytes(&flow).map_err(|error| damaged(id, error))?;
            let cloud = StoredCloud::from_bytes(&cloud).map_err(|error| damaged(id, error))?;
            let (Some(objects), Some(ego)) = (&flow.objects, &flow.ego) else {
                return Err(ApiError::BadRequest(format!(
                    "tracks need clusters and the ego motion, which pair {id} has not: use the preset \
                     default or label, and no deadline"
                )));
            };
            let sweep = ClusteredSweep {
                points: &cloud.points,
                objects,
                ego,
                dt_s,
            };
            tracker.push(&sweep).map_err(ApiError::internal)?;
            Ok(tracker)
        };
        let done = tokio::task::spawn_blocking(track).await;
        done.map_err(ApiError::internal)?
    }
}
