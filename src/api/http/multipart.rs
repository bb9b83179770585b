//! Multipart request bodies, read part by part within the limits of the service.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::multipart::{Field, Multipart, MultipartError};
use axum::extract::{FromRequest, Request};
use axum::http::{HeaderValue, header};
use futures_util::stream::{self, Stream, StreamExt, TryStreamExt};
use tokio::time::timeout;
use utoipa::ToSchema;

use super::metered::{Meter, metered};
use crate::api::auth::Caller;
use crate::api::codec;
use crate::api::error::ApiError;
use crate::api::fetch::append;
use crate::api::pending_job::PendingJob;
use crate::api::service::Service;
use crate::api::upload_budget::UploadReservation;
use crate::formats;
use crate::formats::{FormatError, PoseFile};
use crate::job::JobOptions;
use crate::payload::StoredCloud;

/// The required media type.
const MULTIPART: &[u8] = b"multipart/form-data";

/// Maximum size of the `options` part, bytes.
const MAX_OPTIONS: usize = 64 << 10;

/// Maximum length of a URI, bytes.
const MAX_URI: usize = 4 << 10;

/// Maximum size of the `poses` part, bytes: more than 2,500 poses as JSON.
const MAX_POSES: usize = 1 << 20;

/// The parts of a request with one pair.
#[derive(ToSchema)]
#[expect(dead_code, reason = "it describes a body that is read part by part")]
pub(super) struct PairBody {
    /// The earlier sweep, in any supported file format. Alternatively an .npz file with both sweeps
    /// as `pc1` and `pc2`; then `target` is omitted.
    #[schema(value_type = String, format = Binary, required = false)]
    source: Vec<u8>,
    /// The later sweep.
    #[schema(value_type = String, format = Binary, required = false)]
    target: Vec<u8>,
    /// URI of the earlier sweep, in place of `source`; `#blake3=` and its hash may follow.
    source_uri: Option<String>,
    /// URI of the later sweep, in place of `target`.
    target_uri: Option<String>,
    /// The options of the estimate, as one JSON object.
    options: Option<JobOptions>,
}

/// The parts of a request with a sequence.
#[derive(ToSchema)]
#[expect(dead_code, reason = "it describes a body that is read part by part")]
pub(super) struct SequenceBody {
    /// The options of the estimate, as one JSON object. This part must precede the sweeps.
    options: Option<JobOptions>,
    /// The poses `world_from_sensor` of the sweeps: KITTI's text, a JSON array of 4 x 4 matrices, or
    /// Argoverse 2's table. Text and JSON have one pose for each sweep, in order; the table has them
    /// by the timestamps in the names of the sweeps. This part must precede the sweeps. By default
    /// the ego motion is estimated.
    #[schema(value_type = String, format = Binary, required = false)]
    poses: Vec<u8>,
    /// The sweeps in the order of time, in any supported file format. Each sweep is a separate part
    /// named `sweep`.
    #[schema(value_type = Vec<String>, format = Binary, required = false)]
    sweep: Vec<Vec<u8>>,
    /// URIs of sweeps, each in place of a part `sweep`.
    #[schema(required = false)]
    sweep_uri: Vec<String>,
}

/// A multipart body that is being read.
pub(super) struct Body {
    service: Arc<Service>,
    multipart: Multipart,
    meter: Meter,
    room: UploadReservation,
    has_options: bool,
    has_poses: bool,
    decode_seconds: f64,
}

/// One part of a body.
pub(super) enum Part {
    /// The options.
    Options(Box<JobOptions>),
    /// The poses of the sweeps.
    Poses(PoseFile),
    /// A file: the name of the part, the name of the file, and the contents.
    File(String, Option<String>, Vec<u8>),
}

impl Body {
    /// Starts to read the body of a request. If the headers are refused, the body is drained first.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`], [`ApiError::UnsupportedMedia`] or [`ApiError::TooLarge`].
    pub(super) async fn of(
        service: &Arc<Service>,
        caller: &Caller,
        request: Request,
    ) -> Result<Self, ApiError> {
        if let Err(error) = check_head(service, caller, &request) {
            let body = request.into_body().into_data_stream();
            drain(body.map_ok(|piece| piece.len())).await;
            return Err(error);
        }
        let (request, meter) = metered(request);
        let multipart = Multipart::from_request(request, &()).await;
        Ok(Self {
            service: Arc::clone(service),
            multipart: multipart.map_err(|_| not_multipart())?,
            meter,
            room: service.uploads.room(&caller.tenant),
            has_options: false,
            has_poses: false,
            decode_seconds: 0.0,
        })
    }

    /// Reads the next part completely. `None` at the end of the body.
    ///
    /// # Errors
    /// [`ApiError::BadRequest`] for an unknown, repeated or malformed part,
    /// [`ApiError::InvalidOptions`], or the errors of [`UploadReservation::take`] and [`UploadReservation::wait`].
    pub(super) async fn next(&mut self) -> Result<Option<Part>, ApiError> {
        let field = self.multipart.next_field();
        let field = self.room.wait(field).await?;
        let Some(field) = field.map_err(broken)? else {
            return Ok(None);
        };
        self.meter.understood();
        let mut reading = Reading {
            room: &mut self.room,
            meter: &self.meter,
        };
        let name = field.name().unwrap_or_default().to_owned();
        let file = field.file_name().map(str::to_owned);
        match name.as_str() {
            "options" if self.has_options => {
                Err(ApiError::BadRequest("options is there twice".to_owned()))
            }
            "options" => {
                self.has_options = true;
                let bytes = reading.whole(field, MAX_OPTIONS).await?;
                let options = JobOptions::from_json(&bytes)?;
                Ok(Some(Part::Options(Box::new(options))))
            }
            "poses" if self.has_poses => {
                Err(ApiError::BadRequest("poses is there twice".to_owned()))
            }
            "poses" => {
                self.has_poses = true;
                let bytes = reading.whole(field, MAX_POSES).await?;
                let read = move || PoseFile::open(&bytes).map_err(bad_poses);
                Ok(Some(Part::Poses(self.timed(read).await?)))
            }
            "source" | "target" | "sweep" => {
                let bytes = reading.whole(field, usize::MAX).await?;
                Ok(Some(Part::File(name, file, bytes)))
            }
            "source_uri" | "target_uri" | "sweep_uri" => {
                let uri = reading.whole(field, MAX_URI).await?;
                let uri = String::from_utf8_lossy(&uri);
                let fetched = self.service.fetch(&mut self.room, &name, uri.trim());
                let (file, bytes) = fetched.await?;
                let part = name.trim_end_matches("_uri").to_owned();
                Ok(Some(Part::File(part, Some(file), bytes)))
            }
            other => Err(ApiError::BadRequest(format!(
                "there is no part named {other:?}; known are source, target, sweep, each also with \
                 _uri, poses and options"
            ))),
        }
    }

    /// Decodes one cloud on a blocking thread. Also returns the memory reservation for the cloud.
    ///
    /// # Errors
    /// [`ApiError::BadInput`], [`ApiError::TooLarge`] or [`ApiError::ServerFull`].
    pub(super) async fn cloud(
        &mut self,
        part: String,
        name: Option<String>,
        bytes: Vec<u8>,
    ) -> Result<(StoredCloud, UploadReservation), ApiError> {
        let began = Instant::now();
        let room = self.room.another();
        let decoded = self.service.decode(room, part, name, bytes).await?;
        self.decode_seconds += began.elapsed().as_secs_f64();
        Ok(decoded)
    }

    /// Decodes the sweep with index `index` as [`Body::cloud`], and gives it its pose.
    ///
    /// # Errors
    /// Also [`ApiError::BadInput`] if `poses` has none for it.
    pub(super) async fn sweep(
        &mut self,
        index: u32,
        name: Option<String>,
        bytes: Vec<u8>,
        poses: Option<&Arc<PoseFile>>,
    ) -> Result<(StoredCloud, UploadReservation), ApiError> {
        let part = format!("sweep {index}");
        let (mut cloud, room) = self.cloud(part, name.clone(), bytes).await?;
        if let Some(poses) = poses {
            let poses = Arc::clone(poses);
            let name = name.unwrap_or_default();
            let read = move || poses.pose(index as usize, &name).map_err(bad_poses);
            cloud.pose = Some(self.timed(read).await?);
        }
        Ok((cloud, room))
    }

    /// Decodes a file that contains both clouds of a pair.
    ///
    /// # Errors
    /// As for [`Body::cloud`].
    pub(super) async fn pair(
        &mut self,
        bytes: Vec<u8>,
    ) -> Result<([StoredCloud; 2], UploadReservation), ApiError> {
        const PART: &str = "source";
        let most = self.service.admission.limits().max_points;
        let mut room = self.room.another();
        self.timed(move || {
            // Pairs are decoded piece by piece.
            room.hold(codec::decoding_memory(PART, &bytes, None, most)?.clouds)?;
            Ok((codec::read_pair(PART, &bytes, most)?, room))
        })
        .await
    }

    async fn timed<T: Send + 'static>(
        &mut self,
        read: impl FnOnce() -> Result<T, ApiError> + Send + 'static,
    ) -> Result<T, ApiError> {
        let began = Instant::now();
        let done = self.service.compute(self.room.tenant(), read).await?;
        self.decode_seconds += began.elapsed().as_secs_f64();
        Ok(done)
    }

    /// Reads and discards the remaining body, within a time limit.
    pub(super) async fn drain(self) {
        // A part is discarded as one item, so the byte limit does not apply within it. The time
        // limit does.
        let meter = self.meter;
        let pieces = stream::try_unfold(self.multipart, async |mut multipart| {
            let Some(mut field) = multipart.next_field().await? else {
                return Ok::<_, MultipartError>(None);
            };
            let mut bytes = 0;
            while let Some(piece) = field.chunk().await? {
                meter.understood();
                bytes += piece.len();
            }
            drop(field);
            Ok(Some((bytes, multipart)))
        });
        drain(pieces).await;
    }

    /// The total time for decoding files, seconds.
    pub(super) fn decode_seconds(&self) -> f64 {
        self.decode_seconds
    }
}

/// The checks on the request headers, before the body is read.
fn check_head(service: &Service, caller: &Caller, request: &Request) -> Result<(), ApiError> {
    caller.may_write()?;
    let headers = request.headers();
    if headers.contains_key(header::CONTENT_ENCODING) {
        let text = "the body is compressed; send the files as they are";
        return Err(ApiError::UnsupportedMedia(text.to_owned()));
    }
    let media = headers.get(header::CONTENT_TYPE);
    let is_form = |media: &HeaderValue| {
        let kind = media.as_bytes().get(..MULTIPART.len());
        kind.is_some_and(|kind| kind.eq_ignore_ascii_case(MULTIPART))
    };
    if !media.is_some_and(is_form) {
        return Err(not_multipart());
    }
    let length = headers.get(header::CONTENT_LENGTH);
    let length = length.and_then(|value| value.to_str().ok()?.parse::<u64>().ok());
    let limit = service.limits.max_upload_bytes;
    if length.is_some_and(|length| length > limit) {
        return Err(ApiError::TooLarge(format!(
            "the request's body has more than the {} MiB that this server takes",
            limit >> 20
        )));
    }
    Ok(())
}

/// Poses that came with source and target.
pub(super) fn poses_of_a_pair() -> ApiError {
    let text = "poses are those of a sequence's sweeps; a pair takes its motion as the option ego";
    ApiError::BadRequest(text.to_owned())
}

/// The error of a file of poses.
pub(super) fn bad_poses(error: FormatError) -> ApiError {
    codec::in_part("poses", error)
}

fn not_multipart() -> ApiError {
    let text = "send multipart/form-data, as curl -F source=@a.pcd -F target=@b.pcd does";
    ApiError::UnsupportedMedia(text.to_owned())
}

/// Reads and discards the remaining body, so that a client that is still sending can read the
/// response. Stops after 2 s or 16 MiB, or when the body ends or fails.
async fn drain<E>(pieces: impl Stream<Item = Result<usize, E>>) {
    const LONGEST: Duration = Duration::from_secs(2);
    const MOST: usize = 16 << 20;
    let mut pieces = std::pin::pin!(pieces);
    let drained = async {
        let mut bytes = 0;
        while let Some(Ok(piece)) = pieces.next().await {
            bytes += piece;
            if bytes > MOST {
                return;
            }
        }
    };
    let _cut_off_is_fine = timeout(LONGEST, drained).await;
}

/// The reservation and the meter that reading a part updates.
struct Reading<'a> {
    room: &'a mut UploadReservation,
    meter: &'a Meter,
}

impl Reading<'_> {
    /// Reads one part completely, chunk by chunk.
    async fn whole(&mut self, mut field: Field<'_>, limit: usize) -> Result<Vec<u8>, ApiError> {
        let mut bytes = Vec::new();
        loop {
            let piece = self.room.wait(field.chunk()).await?;
            let Some(piece) = piece.map_err(broken)? else {
                return Ok(bytes);
            };
            self.meter.understood();
            self.room.take(piece.len())?;
            if bytes.len() + piece.len() > limit {
                return Err(ApiError::TooLarge(format!(
                    "a part has more than {limit} bytes"
                )));
            }
            append(&mut bytes, &piece);
        }
    }
}

#[expect(clippy::needless_pass_by_value, reason = "it is for map_err")]
fn broken(error: MultipartError) -> ApiError {
    ApiError::BadRequest(format!("the body is broken: {}", error.body_text()))
}

/// The files of a pair, in the order in which they arrive.
#[derive(Default)]
pub(super) struct PairFiles {
    source: Option<(Option<String>, Vec<u8>)>,
    target: Option<(Option<String>, Vec<u8>)>,
}

impl PairFiles {
    /// Adds a file.
    pub(super) fn take(
        &mut self,
        part: &str,
        name: Option<String>,
        bytes: Vec<u8>,
    ) -> Result<(), ApiError> {
        let index = match part {
            "source" => &mut self.source,
            "target" => &mut self.target,
            _ => {
                let text = "a pair is source and target; sweeps make a sequence, at /v1/sequences";
                return Err(ApiError::BadRequest(text.to_owned()));
            }
        };
        if index.replace((name, bytes)).is_some() {
            return Err(ApiError::BadRequest(format!("{part} is there twice")));
        }
        Ok(())
    }

    /// Whether no file has been added.
    pub(super) fn is_empty(&self) -> bool {
        self.source.is_none() && self.target.is_none()
    }

    /// Decodes the clouds and adds them to a draft.
    pub(super) async fn push_to(
        self,
        body: &mut Body,
        pending: &mut PendingJob,
    ) -> Result<(), ApiError> {
        let missing = |part: &str| {
            ApiError::BadRequest(format!(
                "the part {part} is missing: send source and target"
            ))
        };
        let (name, bytes) = self.source.ok_or_else(|| missing("source"))?;
        let Some((target_name, target)) = self.target else {
            if !formats::is_pair(&bytes) {
                return Err(missing("target"));
            }
            let ([source, target], _room) = body.pair(bytes).await?;
            pending.push(source, None).await?;
            pending.push(target, None).await?;
            return Ok(());
        };
        // One file at a time: a request does not hold a decoded cloud while it waits for a permit
        // to decode the other one.
        let (source, room) = body.cloud("source".to_owned(), name, bytes).await?;
        pending.push(source, Some(room)).await?;
        let (target, room) = body.cloud("target".to_owned(), target_name, target).await?;
        pending.push(target, Some(room)).await?;
        Ok(())
    }
}
