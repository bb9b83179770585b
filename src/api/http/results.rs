//! Responses with results: content negotiation, range requests, entity tags, and zip archives of
//! sequences.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::{Extension, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use tokio_stream::wrappers::ReceiverStream;

use super::named::Named;
use super::problem::Problem;
use crate::api::auth::Caller;
use crate::api::codec::AnswerFormat;
use crate::api::dense;
use crate::api::error::ApiError;
use crate::api::listener::HasRoom;
use crate::api::result_budget::{Encoded, ReadProgress};
use crate::api::service::Service;
use crate::formats::DenseFormat;
use crate::job::{DenseReport, Job, Kind, State as JobState};
use crate::sync::locked;

/// The media type of the archive with the flows of a sequence.
pub(super) const ARCHIVE: &str = "application/zip";

/// The headers of responses with results, and their meanings.
pub(super) const RESULT_HEADERS: [(&str, &str); 9] = [
    ("Fnsf-Job-Id", "The id of the job."),
    ("Fnsf-Stop-Reason", "Of a flow: why the estimate stopped."),
    ("Fnsf-Seconds", "Compute time, seconds."),
    (
        "Fnsf-Overlap",
        "Of a flow with ego motion: the overlap of the pair, 0 to 1.",
    ),
    (
        "Fnsf-Clusters",
        "Of an object search: the number of clusters.",
    ),
    ("Fnsf-Iterations", "Of a fit: the number of iterations."),
    (
        "Fnsf-Warnings",
        "Of a flow: the warnings of the report, with semicolons between them.",
    ),
    (
        "ETag",
        "The entity tag of the result, for If-None-Match and If-Range.",
    ),
    (
        "Accept-Ranges",
        "`bytes` where ranges of the result can be requested.",
    ),
];

/// A response with the complete flow of a pair.
pub(super) async fn flow(
    service: &Arc<Service>,
    job: &Arc<Job>,
    format: AnswerFormat,
) -> Result<Response, ApiError> {
    let head = Head::of_flow(job, format)?;
    let encoded = service.encoded(job, format).await?;
    let mut response = whole(encoded);
    head.describe(&mut response);
    Ok(response)
}

/// The metadata of a result: the basis of the response headers.
struct Head {
    job: Arc<Job>,
    media_type: &'static str,
    ending: &'static str,
    own: Vec<(&'static str, String)>,
}

impl Head {
    fn of_flow(job: &Arc<Job>, format: AnswerFormat) -> Result<Self, ApiError> {
        let report = Service::report(job)?;
        let mut own = vec![
            ("fnsf-stop-reason", report.stop_reason.clone()),
            ("fnsf-seconds", format!("{:.6}", report.seconds.total)),
        ];
        own.extend(
            report
                .overlap
                .map(|overlap| ("fnsf-overlap", format!("{overlap:.3}"))),
        );
        own.extend(
            report
                .objects
                .map(|o| ("fnsf-clusters", o.clusters.to_string())),
        );
        own.extend(
            report
                .field
                .map(|f| ("fnsf-iterations", f.iterations.to_string())),
        );
        if !report.warnings.is_empty() {
            own.push(("fnsf-warnings", report.warnings.join("; ")));
        }
        Ok(Self {
            job: Arc::clone(job),
            media_type: format.media_type(),
            ending: format.ending(),
            own,
        })
    }

    fn of_cloud(job: &Arc<Job>, report: &DenseReport, format: DenseFormat) -> Self {
        Self {
            job: Arc::clone(job),
            media_type: format.media_type(),
            ending: format.ending(),
            own: vec![("fnsf-seconds", format!("{:.6}", report.seconds))],
        }
    }

    /// The entity tag. A result is immutable; another attempt or another format is another entity.
    fn entity_tag(&self) -> String {
        format!("\"{}-{}-{}\"", self.job.id, self.job.attempt, self.ending)
    }

    /// Sets the headers that every response with a result has.
    fn describe(&self, response: &mut Response) {
        let mut set = |name, value| set_header(response, name, value);
        set("content-type", self.media_type.to_owned());
        set("fnsf-job-id", self.job.id.to_string());
        set("etag", self.entity_tag());
        set("accept-ranges", "bytes".to_owned());
        set("vary", "accept".to_owned());
        let name = format!("attachment; filename=\"{}.{}\"", self.job.id, self.ending);
        set("content-disposition", name);
        for (name, value) in &self.own {
            set(name, value.clone());
        }
    }

    /// The response to a request with `headers`: the complete result, a range of it, or 304 if the
    /// client has a current copy.
    async fn answer(
        &self,
        headers: &HeaderMap,
        encoded: impl Future<Output = Result<Encoded, ApiError>>,
    ) -> Result<Response, ApiError> {
        let text =
            |name: header::HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
        let tag = self.entity_tag();
        let mut response = if is_known(headers, &tag) {
            StatusCode::NOT_MODIFIED.into_response()
        } else {
            let encoded = encoded.await?;
            let fresh = text(header::IF_RANGE).is_none_or(|known| known == tag);
            part(encoded, text(header::RANGE).filter(|_| fresh))?
        };
        self.describe(&mut response);
        Ok(response)
    }
}

/// Whether the client has the entity with this tag, by `If-None-Match`. Weak comparison, as RFC 9110
/// (13.1.2) requires: a proxy may have marked the tag as weak.
pub(super) fn is_known(headers: &HeaderMap, tag: &str) -> bool {
    let tags = headers.get(header::IF_NONE_MATCH);
    let tags = tags.and_then(|tags| tags.to_str().ok()).unwrap_or_default();
    tags.split(',').map(str::trim).any(|one| {
        let one = one.strip_prefix("W/").unwrap_or(one);
        one == tag || one == "*"
    })
}

/// Sets a header, unless its value has characters that no header can have.
pub(super) fn set_header(response: &mut Response, name: &'static str, value: String) {
    if let Ok(value) = HeaderValue::try_from(value) {
        response.headers_mut().insert(name, value);
    }
}

/// A response with all bytes and their number.
pub(super) fn whole(encoded: Encoded) -> Response {
    let length = HeaderValue::from(encoded.len());
    let mut response = Body::from_stream(encoded.into_pieces()).into_response();
    response
        .headers_mut()
        .insert(header::CONTENT_LENGTH, length);
    response.extensions_mut().insert(HasRoom);
    response
}

/// A response with all bytes of a result, or with a range of them.
fn part(encoded: Encoded, range: Option<&str>) -> Result<Response, ApiError> {
    let length = encoded.len() as u64;
    match range.and_then(|range| parse_range(range, length)) {
        None => Ok(whole(encoded)),
        Some(None) => Err(ApiError::Range(length)),
        Some(Some((first, last))) => {
            let mut response = whole(encoded.slice(first as usize..last as usize + 1));
            *response.status_mut() = StatusCode::PARTIAL_CONTENT;
            let range = format!("bytes {first}-{last}/{length}");
            if let Ok(range) = HeaderValue::from_str(&range) {
                response.headers_mut().insert(header::CONTENT_RANGE, range);
            }
            Ok(response)
        }
    }
}

/// Returns the result of a job: the flow of a pair, or a zip archive with one flow per pair of a
/// sequence.
///
/// For a sequence with `densify` the result is one dense cloud, as npz, ply, pcd, laz or las
/// according to `Accept`. With `application/zip` in `Accept` it is the zip archive.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/result",
    tag = "jobs",
    params(
        ("id" = String, Path, description = "The job's name"),
        ("Accept" = Option<String>, Header, description = "The format of the flow; application/x-npz by default"),
        ("Range" = Option<String>, Header, description = "bytes=FROM-TO, for anything but an archive"),
        ("If-None-Match" = Option<String>, Header, description = "The entity tag of a copy that is there already"),
    ),
    responses(
        (status = 200, description = "The flow, or the dense cloud", content_type = "application/x-npz"),
        (status = 206, description = "A part of it"),
        (status = 304, description = "The copy is still good"),
        (status = 409, description = "The job has not ended, or was cancelled", body = Problem, content_type = "application/problem+json"),
        (status = "4XX", description = "A refusal", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn result(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Named(id): Named,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let text = |name: header::HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
    let job = service.job(&caller, id).await?;
    if job.state == JobState::Expired {
        return Err(ApiError::HasExpired(id));
    }
    let accept = text(header::ACCEPT);
    let wants_archive = accept.is_some_and(|accept| accept.contains(ARCHIVE));
    if dense::is_dense(&job) && !wants_archive {
        let format = dense::accepted(accept)?;
        let head = Head::of_cloud(&job, &service.dense_report(&job)?, format);
        return head
            .answer(&headers, service.encode_dense(&job, format))
            .await;
    }
    if job.kind == Kind::Sequence && job.state.is_end() {
        return archive(&service, &job, entries_format(accept)?).await;
    }
    let format = AnswerFormat::accepted(accept)?;
    let head = Head::of_flow(&job, format)?;
    head.answer(&headers, service.encoded(&job, format)).await
}

/// Returns the tracks of a sequence's moving objects as JSON.
///
/// While the sequence runs, the tracks are those of its first pairs, up to the first that has not
/// succeeded. The header `fnsf-pairs` has their number.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/tracks",
    tag = "jobs",
    params(("id" = String, Path, description = "The sequence's name")),
    responses(
        (status = 200, description = "The tracks", content_type = "application/json"),
        (status = 409, description = "No pair has succeeded", body = Problem, content_type = "application/problem+json"),
        (status = "4XX", description = "A refusal", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn tracks(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Named(id): Named,
) -> Result<Response, ApiError> {
    let job = service.job(&caller, id).await?;
    let (encoded, pairs) = service.encoded_tracks(&job).await?;
    let mut response = whole(encoded);
    for (name, value) in [
        ("content-type", "application/json".to_owned()),
        ("fnsf-pairs", pairs.to_string()),
        ("fnsf-job-id", job.id.to_string()),
    ] {
        set_header(&mut response, name, value);
    }
    Ok(response)
}

/// The format of the flows in a zip archive, from the media types in `Accept` other than
/// `application/zip`.
fn entries_format(accept: Option<&str>) -> Result<AnswerFormat, ApiError> {
    let others = accept.unwrap_or_default().split(',').filter(|one| {
        let media = one.split(';').next().unwrap_or_default().trim();
        !media.eq_ignore_ascii_case(ARCHIVE)
    });
    let others: Vec<&str> = others.collect();
    AnswerFormat::accepted(Some(&others.join(",")))
}

/// Parses a `Range` header into the first and last byte. `None` if the header is to be ignored,
/// `Some(None)` if the range is not satisfiable.
fn parse_range(range: &str, length: u64) -> Option<Option<(u64, u64)>> {
    let (from, to) = range.strip_prefix("bytes=")?.split_once('-')?;
    if to.contains(',') {
        return None;
    }
    let (first, last) = match (from.trim(), to.trim()) {
        ("", last) => (
            length.saturating_sub(last.parse().ok()?),
            length.checked_sub(1)?,
        ),
        (first, "") => (first.parse().ok()?, length.checked_sub(1)?),
        (first, last) => {
            let last: u64 = last.parse().ok()?;
            (first.parse().ok()?, last.min(length.checked_sub(1)?))
        }
    };
    Some((first <= last && first < length).then_some((first, last)))
}

/// A response with the flows of a sequence in one zip archive, which is written while the client
/// reads it.
async fn archive(
    service: &Arc<Service>,
    sequence: &Arc<Job>,
    format: AnswerFormat,
) -> Result<Response, ApiError> {
    if sequence.state != JobState::Succeeded {
        Service::report(sequence)?;
    }
    let pairs = service.pairs(sequence).await?;
    let turn = service.archives.take(&sequence.tenant)?;
    let (pieces, stream) = tokio::sync::mpsc::channel::<Result<Bytes, std::io::Error>>(1);
    let service = Arc::clone(service);
    let runtime = tokio::runtime::Handle::current();
    tokio::task::spawn_blocking(move || {
        let _turn = turn;
        let taking = Arc::new(Mutex::new(None));
        let pipe = Pipe {
            pieces: pieces.clone(),
            runtime: runtime.clone(),
            taking: Arc::clone(&taking),
        };
        let mut zip = zip::ZipWriter::new_stream(pipe);
        let plain = zip::write::SimpleFileOptions::default()
            .compression_method(zip::CompressionMethod::Stored);
        let mut write = || -> Result<(), Box<dyn std::error::Error>> {
            for pair in &pairs {
                let encoded = runtime.block_on(service.encoded(pair, format))?;
                encoded.taking().begin();
                *locked(&taking) = Some(Arc::clone(encoded.taking()));
                zip.start_file(format!("{:06}.{}", pair.index, format.ending()), plain)?;
                std::io::Write::write_all(&mut zip, encoded.bytes())?;
                *locked(&taking) = None;
            }
            Ok(())
        };
        let done = write().and_then(|()| Ok(zip.finish().map(drop)?));
        if let Err(error) = done {
            tracing::debug!(%error, "an archive was not finished");
            // Without it the response would end as if it were whole. The client may read it late.
            runtime.spawn(async move {
                let _gone_is_fine = pieces
                    .send(Err(std::io::Error::other("not finished")))
                    .await;
            });
        }
    });
    let mut response = Body::from_stream(ReceiverStream::new(stream)).into_response();
    let name = format!("attachment; filename=\"{}.zip\"", sequence.id);
    for (header, value) in [
        ("content-type", ARCHIVE.to_owned()),
        ("content-disposition", name),
        ("fnsf-job-id", sequence.id.to_string()),
    ] {
        set_header(&mut response, header, value);
    }
    Ok(response)
}

/// A writer into a response body. It blocks while the client reads slowly. It fails if the client disconnects or
/// does not read for an hour, and if another result needs the memory of the flow that is sent.
struct Pipe {
    pieces: tokio::sync::mpsc::Sender<Result<Bytes, std::io::Error>>,
    runtime: tokio::runtime::Handle,
    /// The read progress of the flow that is sent.
    taking: Arc<Mutex<Option<Arc<ReadProgress>>>>,
}

impl std::io::Write for Pipe {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        // An upper bound: the listener closes a connection that does not read much earlier.
        const PATIENCE: Duration = Duration::from_secs(3600);
        const PIECE: usize = 64 << 10;
        let length = bytes.len().min(PIECE);
        let piece = Bytes::copy_from_slice(&bytes[..length]);
        let taking = locked(&self.taking).clone();
        let evicted = async {
            match &taking {
                Some(taking) => taking.evicted().await,
                None => std::future::pending().await,
            }
        };
        let sending = async {
            tokio::select! {
                sent = self.pieces.send(Ok(piece)) => {
                    sent.map_err(|_| std::io::Error::from(std::io::ErrorKind::BrokenPipe))
                }
                () = evicted => Err(std::io::ErrorKind::TimedOut.into()),
                () = tokio::time::sleep(PATIENCE) => Err(std::io::ErrorKind::TimedOut.into()),
            }
        };
        self.runtime.block_on(sending)?;
        if let Some(taking) = &taking {
            taking.took(length);
        }
        Ok(length)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn single_ranges_are_cut_to_the_result_and_nonsense_is_ignored() {
        for (range, expected) in [
            ("bytes=0-9", Some(Some((0, 9)))),
            ("bytes=90-", Some(Some((90, 99)))),
            ("bytes=-5", Some(Some((95, 99)))),
            ("bytes=-500", Some(Some((0, 99)))),
            ("bytes=50-1000", Some(Some((50, 99)))),
            ("bytes=100-", Some(None)),
            ("bytes=9-0", Some(None)),
            ("bytes=0-1,3-4", None),
            ("lines=0-1", None),
            ("bytes=a-b", None),
        ] {
            assert_eq!(parse_range(range, 100), expected, "{range}");
        }
        assert_eq!(parse_range("bytes=0-0", 0), None);
    }
}
