//! The gRPC calls, except for the stream of `EstimateSequence`.

use std::sync::Arc;
use std::time::Duration;

use prost::Message;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::call::{Call, ResultBudget, no_begin};
use super::chunks::CloudBuilder;
use super::proto::{self, scene_flow_server::SceneFlow};
use super::{chunks, convert, requests, sequence};
use crate::api::admission::Durability;
use crate::api::dense;
use crate::api::error::ApiError;
use crate::api::job_watch::JobWatch;
use crate::api::listener::Asking;
use crate::api::pending_job::{Accepted, PendingJob};
use crate::api::result_budget::ReadProgress;
use crate::api::service::{Service, Waited};
use crate::api::sweep_order::SweepOrder;
use crate::api::tracks::SequenceTracks;
use crate::api::upload_budget::{MessageMemory, UploadReservation};
use crate::job::{InvalidId, Job, JobId, Kind, State};
use crate::payload::StoredCloud;

/// Number of response messages that are buffered for a slow client.
const AHEAD: usize = 4;

/// Minimum period of progress messages.
const LEAST_PAUSE: Duration = Duration::from_millis(20);

/// The implementation of the gRPC service.
pub(super) struct Calls {
    service: Arc<Service>,
}

impl Calls {
    pub(super) fn new(service: &Arc<Service>) -> Self {
        Self {
            service: Arc::clone(service),
        }
    }

    async fn named(&self, call: &Call, id: &str) -> Result<Arc<Job>, ApiError> {
        self.service.job(&call.caller, named(id)?).await
    }

    /// Receives the two clouds of a pair and submits the job. Also returns the interval of progress
    /// messages, if the client requests them.
    async fn read_pair(
        &self,
        call: &Call,
        inbound: &mut Streaming<proto::EstimateFlowRequest>,
    ) -> Result<(Accepted, Option<Duration>), ApiError> {
        use proto::estimate_flow_request::Part;
        let awaited = Durability::Ephemeral;
        self.service.check_room(&call.caller, None, awaited)?;
        let mut room = self.service.uploads.room(&call.caller.tenant);
        let begin = match chunks::next(&mut room, inbound).await?.and_then(|m| m.part) {
            Some(Part::Begin(begin)) => begin,
            _ => return Err(no_begin()),
        };
        let pause = match u64::from(begin.progress_ms) {
            0 => None,
            pause => Some(Duration::from_millis(pause).max(LEAST_PAUSE)),
        };
        let options = requests::options(begin.options)?;
        options.check_for_pairs().map_err(ApiError::from)?;
        self.service
            .check_room(&call.caller, Some(&options), awaited)?;
        let request = call.job_request(options, awaited);
        let mut pending = PendingJob::begin(&self.service, call.caller.clone(), request)?;
        let mut clouds = [CloudBuilder::default(), CloudBuilder::default()];
        while let Some(message) = chunks::next(&mut room, inbound).await? {
            let Some(Part::Cloud(piece)) = message.part else {
                return Err(no_begin());
            };
            let (cloud, part) = match piece.cloud() {
                proto::Cloud::Source => (&mut clouds[0], "source"),
                proto::Cloud::Target => (&mut clouds[1], "target"),
                proto::Cloud::Unspecified => {
                    let text = "a chunk is of the source or of the target";
                    return Err(ApiError::BadRequest(text.to_owned()));
                }
            };
            let chunk = piece.chunk.unwrap_or_default();
            cloud.take(&self.service, &mut room, part, &chunk)?;
        }
        for (cloud, part) in clouds.into_iter().zip(["source", "target"]) {
            pending.push(cloud.finish(part)?, None).await?;
        }
        let accepted = pending.submit(Kind::Pair).await?;
        Ok((accepted, pause))
    }
}

/// Parses a job id. A malformed id is reported as a job that does not exist.
fn named(id: &str) -> Result<JobId, ApiError> {
    Ok(id.parse()?)
}

/// Adds a complete cloud, if there is one, to the job. `part` is its name for errors.
async fn push(
    pending: &mut PendingJob,
    cloud: Option<CloudBuilder>,
    part: &str,
    room: &mut UploadReservation,
) -> Result<(), ApiError> {
    if let Some(cloud) = cloud {
        pending.push(cloud.finish(part)?, Some(room.next())).await?;
    }
    Ok(())
}

/// The error for a malformed page token.
fn bad_page(error: InvalidId) -> ApiError {
    ApiError::BadRequest(format!("page_token: {error}"))
}

/// Sends progress until the job ends, then its flow. Returns false if the client disconnects while
/// progress is sent.
async fn send_flow(
    service: &Arc<Service>,
    id: JobId,
    pause: Option<Duration>,
    answers: &mpsc::Sender<Result<proto::EstimateFlowResponse, Status>>,
) -> Result<bool, ApiError> {
    use proto::estimate_flow_response::Part;
    let message = |part: Part| proto::EstimateFlowResponse { part: Some(part) };
    let mut sent = None;
    let mut news = service.queue.watch(id).await?;
    let job = loop {
        match service.wait_for_end(&mut news, pause).await? {
            Waited::Ended(job) => break job,
            Waited::StillOpen(_) if service.closing.is_cancelled() => {
                return Err(ApiError::Draining);
            }
            Waited::StillOpen(job) => {
                if job.progress.is_some() && job.progress != sent {
                    sent = job.progress;
                    let progress = job.progress.map(convert::progress).unwrap_or_default();
                    let progress = message(Part::Progress(progress));
                    if answers.send(Ok(progress)).await.is_err() {
                        return Ok(false);
                    }
                }
            }
        }
    };
    let answer = service.answer(&job).await?;
    let header = Part::Header(convert::header(&answer));
    let pieces = chunks::pieces(&answer, 0).map(Part::Chunk);
    let messages = std::iter::once(header).chain(pieces).map(message);
    chunks::send(messages, answers, answer.room.taking()).await?;
    Ok(true)
}

/// Sends the messages of a result until it is evicted for a slow client. `held` is released before
/// the client reads the error.
async fn send_result<M: Message>(
    messages: impl Iterator<Item = M>,
    answers: mpsc::Sender<Result<M, Status>>,
    taking: Arc<ReadProgress>,
    held: impl Send,
) {
    let sent = chunks::send(messages, &answers, &taking).await;
    drop(held);
    if let Err(error) = sent {
        let _gone_is_fine = answers.send(Err(error.into())).await;
    }
}

#[tonic::async_trait]
impl SceneFlow for Calls {
    type EstimateFlowStream = ResultBudget<proto::EstimateFlowResponse>;
    type EstimateSequenceStream = ResultBudget<proto::EstimateSequenceResponse>;
    type WatchJobStream = ResultBudget<proto::Job>;
    type GetTracksStream = ResultBudget<proto::Track>;
    type DownloadResultStream = ResultBudget<proto::DownloadResultResponse>;

    async fn estimate_flow(
        &self,
        request: Request<Streaming<proto::EstimateFlowRequest>>,
    ) -> Result<Response<Self::EstimateFlowStream>, Status> {
        let call = Call::of(&request)?;
        let (accepted, pause) = self.read_pair(&call, &mut request.into_inner()).await?;
        let Accepted { job, awaited, .. } = accepted;
        let (answers, stream) = mpsc::channel(AHEAD);
        let service = Arc::clone(&self.service);
        tokio::spawn(async move {
            let sent = tokio::select! {
                // The client has disconnected. Dropping `awaited` cancels the job.
                () = answers.closed() => return,
                sent = send_flow(&service, job.id, pause, &answers) => sent,
            };
            match sent {
                Ok(false) => {}
                Ok(true) => {
                    if let Some(awaited) = awaited {
                        awaited.disarm();
                    }
                }
                Err(error) => {
                    service.count_late_error("grpc", &error);
                    let _gone_is_fine = answers.send(Err(error.into())).await;
                }
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }

    async fn estimate_sequence(
        &self,
        request: Request<Streaming<proto::EstimateSequenceRequest>>,
    ) -> Result<Response<Self::EstimateSequenceStream>, Status> {
        let call = Call::of(&request)?;
        let awaited = Durability::Ephemeral;
        self.service.check_room(&call.caller, None, awaited)?;
        if let Some(asking) = request.extensions().get::<Asking>() {
            asking.may_wait();
        }
        let messages = request.extensions().get::<MessageMemory>().cloned();
        let (service, messages) = (Arc::clone(&self.service), messages.unwrap_or_default());
        let answers = sequence::run(service, call, messages, request.into_inner());
        Ok(Response::new(Box::pin(answers)))
    }

    async fn submit_job(
        &self,
        request: Request<Streaming<proto::SubmitJobRequest>>,
    ) -> Result<Response<proto::Job>, Status> {
        use proto::submit_job_request::Part;
        let call = Call::of(&request)?;
        self.service
            .check_room(&call.caller, None, Durability::Durable)?;
        let mut inbound = request.into_inner();
        let service = &self.service;
        let mut room = service.uploads.room(&call.caller.tenant);
        let begin = match chunks::next(&mut room, &mut inbound)
            .await?
            .and_then(|m| m.part)
        {
            Some(Part::Begin(begin)) => begin,
            _ => return Err(no_begin().into()),
        };
        let options = requests::options(begin.options)?;
        let (dense, force) = (options.densify.is_some(), options.force);
        let mut order = SweepOrder::default();
        let mut job_request = call.job_request(options, Durability::Durable);
        let key = begin.idempotency_key;
        job_request.idempotency_key = (!key.is_empty()).then_some(key);
        let mut pending = PendingJob::begin(service, call.caller.clone(), job_request)?;
        let mut cloud: Option<CloudBuilder> = None;
        loop {
            let part = chunks::next(&mut room, &mut inbound).await?.map(|m| m.part);
            let index = format!("cloud {}", pending.sweeps());
            match part {
                Some(Some(Part::Chunk(chunk))) => match &mut cloud {
                    Some(cloud) => cloud.take(service, &mut room, &index, &chunk)?,
                    None => {
                        let text = "a chunk belongs to a cloud: send next first";
                        return Err(ApiError::BadRequest(text.to_owned()).into());
                    }
                },
                Some(Some(Part::Next(next))) => {
                    let pose = requests::pose("the next cloud", &next.pose)?;
                    push(&mut pending, cloud.take(), &index, &mut room).await?;
                    if next.uri.is_empty() {
                        cloud = Some(CloudBuilder::named(&next.name)?.with_pose(pose));
                        order.push(&next.name, force)?;
                    } else {
                        let index = format!("cloud {}", pending.sweeps());
                        let (name, bytes) = service.fetch(&mut room, &index, &next.uri).await?;
                        order.push(&name, force)?;
                        let decoded = service.decode(room.another(), index, Some(name), bytes);
                        let (cloud, room) = decoded.await?;
                        pending
                            .push(StoredCloud { pose, ..cloud }, Some(room))
                            .await?;
                    }
                }
                None => {
                    push(&mut pending, cloud, &index, &mut room).await?;
                    break;
                }
                Some(_) => return Err(no_begin().into()),
            }
        }
        let kind = if pending.sweeps() > 2 || dense {
            Kind::Sequence
        } else {
            Kind::Pair
        };
        let Accepted { job, .. } = pending.submit(kind).await?;
        // The job is accepted, even where the queue cannot be asked now.
        let wait = service.waiting(&job).await.unwrap_or_default();
        Ok(Response::new(proto::Job {
            wait: wait.map(convert::wait),
            ..convert::job(&job)
        }))
    }

    async fn get_job(
        &self,
        request: Request<proto::GetJobRequest>,
    ) -> Result<Response<proto::Job>, Status> {
        let call = Call::of(&request)?;
        let job = self.named(&call, &request.get_ref().id).await?;
        let mut message = convert::job_for(&call.caller, &job);
        let pairs = self.service.pairs(&job).await?;
        message.pair_ids = pairs.iter().map(|pair| pair.id.to_string()).collect();
        message.wait = self.service.waiting(&job).await?.map(convert::wait);
        Ok(Response::new(message))
    }

    async fn list_jobs(
        &self,
        request: Request<proto::ListJobsRequest>,
    ) -> Result<Response<proto::ListJobsResponse>, Status> {
        const PAGE: u32 = 100;
        let call = Call::of(&request)?;
        let asked = request.into_inner();
        let state = requests::wanted_state(asked.state)?;
        let label = Some(asked.label).filter(|label| !label.is_empty());
        let limit = match asked.page_size {
            0 => PAGE,
            size => size.min(1000),
        };
        let before = match asked.page_token.as_str() {
            "" => None,
            token => Some(token.parse::<JobId>().map_err(bad_page)?),
        };
        let listed = self.service.jobs(&call.caller, state, label, before, limit);
        let (jobs, next) = listed.await?;
        Ok(Response::new(proto::ListJobsResponse {
            jobs: jobs.iter().map(|job| convert::job(job)).collect(),
            next_page_token: next.map(|id| id.to_string()).unwrap_or_default(),
        }))
    }

    async fn cancel_job(
        &self,
        request: Request<proto::CancelJobRequest>,
    ) -> Result<Response<proto::Job>, Status> {
        let call = Call::of(&request)?;
        let id = named(&request.get_ref().id)?;
        let job = self.service.cancel(&call.caller, id).await?;
        Ok(Response::new(convert::job(&job)))
    }

    async fn delete_job(
        &self,
        request: Request<proto::DeleteJobRequest>,
    ) -> Result<Response<proto::DeleteJobResponse>, Status> {
        let call = Call::of(&request)?;
        let id = named(&request.get_ref().id)?;
        self.service.remove(&call.caller, id).await?;
        Ok(Response::new(proto::DeleteJobResponse {}))
    }

    async fn requeue_job(
        &self,
        request: Request<proto::RequeueJobRequest>,
    ) -> Result<Response<proto::Job>, Status> {
        let call = Call::of(&request)?;
        let id = named(&request.get_ref().id)?;
        let job = self.service.requeue(&call.caller, id).await?;
        Ok(Response::new(convert::job(&job)))
    }

    async fn watch_job(
        &self,
        request: Request<proto::WatchJobRequest>,
    ) -> Result<Response<Self::WatchJobStream>, Status> {
        let call = Call::of(&request)?;
        let id = named(&request.get_ref().id)?;
        let shown = request.metadata().get("authorization");
        let shown = shown.and_then(|value| value.to_str().ok());
        let mut watch = JobWatch::begin(&self.service, &call.caller, shown, id).await?;
        let (answers, stream) = mpsc::channel(AHEAD);
        tokio::spawn(async move {
            loop {
                let job = watch.latest();
                let shown = convert::job_for(&call.caller, &job);
                let sent = answers.send(Ok(shown)).await;
                if sent.is_err() || job.state.is_end() {
                    return;
                }
                tokio::select! {
                    () = answers.closed() => return,
                    changed = watch.changed() => if let Err(error) = changed {
                        let _gone_is_fine = answers.send(Err(error.into())).await;
                        return;
                    }
                }
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }

    async fn get_tracks(
        &self,
        request: Request<proto::GetTracksRequest>,
    ) -> Result<Response<Self::GetTracksStream>, Status> {
        let call = Call::of(&request)?;
        let job = self.named(&call, &request.get_ref().id).await?;
        let SequenceTracks { tracks, .. } = self.service.tracks(&job).await?;
        let room = self.service.room_for_tracks(&job, &tracks).await?;
        let messages: Vec<proto::Track> = tracks.iter().map(convert::track).collect();
        let (answers, stream) = mpsc::channel(AHEAD);
        let taking = Arc::clone(room.taking());
        tokio::spawn(send_result(messages.into_iter(), answers, taking, room));
        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }

    async fn download_result(
        &self,
        request: Request<proto::DownloadResultRequest>,
    ) -> Result<Response<Self::DownloadResultStream>, Status> {
        use proto::download_result_response::Part;
        let call = Call::of(&request)?;
        let asked = request.into_inner();
        let job = self.named(&call, &asked.id).await?;
        if job.state == State::Expired {
            return Err(ApiError::HasExpired(job.id).into());
        }
        let first = usize::try_from(asked.first_row).unwrap_or(usize::MAX);
        let message = |part| proto::DownloadResultResponse { part: Some(part) };
        let (answers, stream) = mpsc::channel(AHEAD);
        if dense::is_dense(&job) {
            let header = convert::dense_header(job.id, &self.service.dense_report(&job)?);
            // Held as long as the client reads.
            let turn = self.service.archives.take(&job.tenant)?;
            let (cloud, room) = self.service.dense_cloud(&job).await?;
            let pieces = chunks::dense_pieces(cloud, first).map(Part::DenseChunk);
            let parts = std::iter::once(Part::DenseHeader(header)).chain(pieces);
            let taking = Arc::clone(room.taking());
            let messages = parts.map(message);
            tokio::spawn(send_result(messages, answers, taking, (turn, room)));
        } else {
            let answer = self.service.answer(&job).await?;
            let header = Part::Header(convert::header(&answer));
            let pieces = chunks::pieces(&answer, first).map(Part::Chunk);
            let parts = std::iter::once(header).chain(pieces);
            let taking = Arc::clone(answer.room.taking());
            drop(answer);
            tokio::spawn(send_result(parts.map(message), answers, taking, ()));
        }
        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }
}
