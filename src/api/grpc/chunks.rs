//! Conversion between chunks on the wire, and clouds and flow.

use std::sync::Arc;
use std::time::Duration;

use prost::Message;
use tokio::sync::mpsc;
use tonic::{Code, Status, Streaming};

use super::{convert, proto, status};
use crate::api::codec;
use crate::api::error::ApiError;
use crate::api::result_budget::ReadProgress;
use crate::api::results::Answer;
use crate::api::service::Service;
use crate::api::upload_budget::UploadReservation;
use crate::flow::{DenseCloud, Point, RigidTransform};
use crate::formats::SweepTime;
use crate::payload::{StoredCloud, points_from_le_bytes};

/// Maximum length of the name of a sweep, bytes. Each pair and some errors repeat the name.
const MAX_NAME: usize = 255;

/// Rows of flow, or of a dense cloud, in one chunk: about 25 kB with all columns. An answer that is
/// not read keeps some chunks in memory that no budget has, so they are small.
const ROWS: usize = 1000;

/// Receives the next message, within the time limits of a body.
///
/// # Errors
/// [`ApiError::TooSlow`], [`ApiError::TooLarge`] for a message above a size limit, or
/// [`ApiError::BadRequest`] if the stream is broken.
pub(super) async fn next<T>(
    room: &mut UploadReservation,
    inbound: &mut Streaming<T>,
) -> Result<Option<T>, ApiError> {
    let came = room.wait(inbound.message()).await?;
    came.map_err(|status| broken(&status))
}

/// The error of a stream of requests, which may be that of a [`super::message_body::MessageBody`].
pub(super) fn broken(status: &Status) -> ApiError {
    match (status.code(), status::own_code(status)) {
        (_, Some("too_slow")) => ApiError::TooSlow,
        (_, Some("server_full")) => ApiError::ServerFull(Duration::from_secs(1)),
        (_, Some("too_large")) => ApiError::TooLarge(status.message().to_owned()),
        (Code::OutOfRange, _) => {
            let text = "a message is larger than 1 MiB: send smaller chunks";
            ApiError::TooLarge(text.to_owned())
        }
        _ => ApiError::BadRequest(format!("the stream is broken: {}", status.message())),
    }
}

/// A cloud that is assembled from chunks.
#[derive(Default)]
pub(super) struct CloudBuilder {
    points: Vec<u8>,
    ground: Vec<bool>,
    pose: Option<RigidTransform>,
    time: Option<SweepTime>,
}

impl CloudBuilder {
    /// A cloud with a name, or without one where it is empty. A timestamp in it is the time of the cloud.
    ///
    /// # Errors
    /// [`ApiError::BadRequest`] for a name of more than [`MAX_NAME`] bytes.
    pub(super) fn named(name: &str) -> Result<Self, ApiError> {
        if name.len() > MAX_NAME {
            let text = format!("the name of a sweep has more than {MAX_NAME} bytes");
            return Err(ApiError::BadRequest(text));
        }
        Ok(Self {
            time: SweepTime::from_name(name),
            ..Self::default()
        })
    }

    /// With the pose `world_from_sensor`, or none.
    pub(super) fn with_pose(self, pose: Option<RigidTransform>) -> Self {
        Self { pose, ..self }
    }

    /// Adds a chunk. `part` is the name of the cloud for error messages.
    ///
    /// # Errors
    /// [`ApiError::BadInput`] for a malformed chunk, [`ApiError::TooLarge`] or
    /// [`ApiError::ServerFull`] at a limit.
    pub(super) fn take(
        &mut self,
        service: &Service,
        room: &mut UploadReservation,
        part: &str,
        chunk: &proto::Chunk,
    ) -> Result<(), ApiError> {
        const POINT: usize = size_of::<Point>();
        let bytes = chunk.points.len();
        room.take(bytes + chunk.ground.len())?;
        if !bytes.is_multiple_of(POINT) {
            return Err(ApiError::BadInput(format!(
                "{part}: a chunk has {bytes} bytes of points, not a multiple of {POINT}"
            )));
        }
        if !chunk.ground.is_empty() && chunk.ground.len() != bytes / POINT {
            return Err(ApiError::BadInput(format!(
                "{part}: a chunk has {} points but {} ground flags",
                bytes / POINT,
                chunk.ground.len()
            )));
        }
        self.points.extend_from_slice(&chunk.points);
        let points = self.points.len() / POINT;
        service.admission.check_points(points)?;
        self.ground
            .extend(chunk.ground.iter().map(|&flag| flag != 0));
        Ok(())
    }

    /// The number of points so far.
    pub(super) fn points(&self) -> u64 {
        (self.points.len() / size_of::<Point>()) as u64
    }

    /// The complete cloud, with the same checks as for a file.
    ///
    /// # Errors
    /// [`ApiError::BadInput`] for unusable coordinates or an incomplete ground mask.
    pub(super) fn finish(self, part: &str) -> Result<StoredCloud, ApiError> {
        let points = points_from_le_bytes(&self.points);
        codec::check_points(part, &points)?;
        let ground = match self.ground.len() {
            0 => None,
            flags if flags == points.len() => Some(self.ground),
            flags => {
                return Err(ApiError::BadInput(format!(
                    "{part}: {} points but {flags} ground flags",
                    points.len()
                )));
            }
        };
        Ok(StoredCloud {
            points,
            ground,
            pose: self.pose,
            time: self.time,
        })
    }
}

/// The chunks of a dense cloud from row `first`.
pub(super) fn dense_pieces(
    cloud: Arc<DenseCloud>,
    first: usize,
) -> impl Iterator<Item = proto::DenseChunk> {
    let rows = cloud.points.len();
    (first.min(rows)..rows).step_by(ROWS).map(move |from| {
        let piece = from..(from + ROWS).min(rows);
        let points = cloud.points[piece.clone()].as_flattened().iter();
        let points: Vec<u8> = points.flat_map(|value| value.to_le_bytes()).collect();
        let sweep = cloud.sweep[piece.clone()].iter();
        let sweep: Vec<u8> = sweep.flat_map(|sweep| sweep.to_le_bytes()).collect();
        let age = cloud.age[piece.clone()].iter();
        let age: Vec<u8> = age.flat_map(|age| age.to_le_bytes()).collect();
        let flags: Vec<u8> = piece
            .map(|row| u8::from(cloud.dynamic[row]) | u8::from(cloud.converged[row]) << 1)
            .collect();
        proto::DenseChunk {
            points: points.into(),
            sweep: sweep.into(),
            age: age.into(),
            flags: flags.into(),
        }
    })
}

/// Sends the messages of a result in their order. Returns false if the client disconnects.
///
/// # Errors
/// [`ApiError::TakenTooSlowly`] if the result is evicted for a slow client.
pub(super) async fn send<M: Message>(
    messages: impl Iterator<Item = M>,
    answers: &mpsc::Sender<Result<M, Status>>,
    taking: &ReadProgress,
) -> Result<bool, ApiError> {
    taking.begin();
    for message in messages {
        let length = message.encoded_len();
        tokio::select! {
            sent = answers.send(Ok(message)) => match sent {
                Ok(()) => taking.took(length),
                Err(_) => return Ok(false),
            },
            () = taking.evicted() => return Err(ApiError::TakenTooSlowly),
        }
    }
    Ok(true)
}

/// The chunks of a flow from row `first`.
pub(super) fn pieces(
    answer: &Answer,
    first: usize,
) -> impl Iterator<Item = proto::FlowChunk> + use<> {
    let (flow, room) = (Arc::clone(&answer.flow), Arc::clone(&answer.room));
    let rows = flow.flow.len();
    (first.min(rows)..rows).step_by(ROWS).map(move |from| {
        // Moved into the closure: the reservation is held until the iterator is dropped.
        let _room = &room;
        let to = (from + ROWS).min(rows);
        let values = flow.flow[from..to].as_flattened().iter();
        let bytes: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
        let flags: Vec<u8> = (from..to)
            .map(|row| {
                let dynamic = flow.dynamic.as_ref().is_some_and(|dynamic| dynamic[row]);
                u8::from(flow.valid[row]) | u8::from(dynamic) << 1
            })
            .collect();
        let (mut cluster, mut clusters) = (Vec::new(), Vec::new());
        let (mut confidence, mut moving) = (Vec::new(), Vec::new());
        if let Some(objects) = &flow.objects {
            // The clusters are distributed over the rows by row index alone. A client that resumes
            // at a row has received the clusters of the rows before it.
            let part = |row: usize| objects.clusters.len() * row / rows;
            let described = &objects.clusters[part(from)..part(to)];
            clusters.extend(described.iter().map(convert::cluster));
            let ids = objects.cluster[from..to].iter();
            cluster.extend(ids.flat_map(|id| id.to_le_bytes()));
            for (bytes, probabilities) in [
                (&mut confidence, &objects.confidence),
                (&mut moving, &objects.moving),
            ] {
                let probabilities = probabilities[from..to].iter();
                bytes.extend(probabilities.flat_map(|probability| probability.to_le_bytes()));
            }
        }
        proto::FlowChunk {
            flow: bytes.into(),
            flags: flags.into(),
            cluster: cluster.into(),
            confidence: confidence.into(),
            moving: moving.into(),
            clusters,
        }
    })
}
