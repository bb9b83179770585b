//! Streamed sequences: the client sends sweeps and receives the flow of each consecutive pair, in
//! order.
//!
//! A reader task and a writer task are connected by a bounded channel. When the channel is full,
//! the reader stops reading. This bounds the memory and applies back-pressure to the client.

use std::collections::VecDeque;
use std::sync::Arc;

use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use super::call::{Call, no_begin};
use super::chunks::CloudBuilder;
use super::{chunks, convert, proto, requests};
use crate::api::admission::Durability;
use crate::api::error::ApiError;
use crate::api::job_request::ChainLink;
use crate::api::kept_result::KeptResult;
use crate::api::pending_job::{Accepted, PendingJob};
use crate::api::service::{Service, Waited};
use crate::api::sweep_order::SweepOrder;
use crate::api::upload_budget::{MessageMemory, UploadReservation};
use crate::flow::{is_window_final, window};
use crate::job::{JobId, JobOptions, Kind};
use crate::payload::StoredCloud;
use crate::queue::PairOf;

type ResultBudget = mpsc::Sender<Result<proto::EstimateSequenceResponse, Status>>;

/// A pair that has been submitted.
struct Pending {
    index: u32,
    source: String,
    target: String,
    /// The job, or the error of its submission.
    job: Result<Accepted, ApiError>,
    /// The client may read the pairs before it slowly.
    _kept: Option<KeptResult>,
}

/// A message from the reader task to the writer task, in order.
enum Item {
    Pair(Pending),
    /// The stream ends with this error.
    Broken(ApiError),
}

/// A sweep that has arrived completely. Its memory reservation is held until no further pair has it
/// in its window.
struct Sweep {
    name: String,
    cloud: Arc<StoredCloud>,
    room: UploadReservation,
}

/// A sweep that is being received in chunks.
struct Coming {
    name: String,
    /// The number of points that the client has announced, if any.
    points: Option<u64>,
    cloud: CloudBuilder,
}

impl Coming {
    fn finish(self, room: UploadReservation) -> Result<Sweep, ApiError> {
        let cloud = self.cloud.finish(&self.name)?;
        if let Some(points) = self.points
            && points != cloud.points.len() as u64
        {
            return Err(ApiError::BadInput(format!(
                "{}: {points} points were announced and {} came",
                self.name,
                cloud.points.len()
            )));
        }
        Ok(Sweep {
            name: self.name,
            cloud: Arc::new(cloud),
            room,
        })
    }
}

/// Starts the reader task and the writer task.
pub(super) fn run(
    service: Arc<Service>,
    call: Call,
    messages: MessageMemory,
    inbound: Streaming<proto::EstimateSequenceRequest>,
) -> ReceiverStream<Result<proto::EstimateSequenceResponse, Status>> {
    let (answers, stream) = mpsc::channel(2);
    let (pending, pairs) = mpsc::channel(service.limits.stream_prefetch_pairs.max(1));
    let writing = (Arc::clone(&service), answers.clone());
    tokio::spawn(async move { write(&writing.0, pairs, &writing.1).await });
    tokio::spawn(async move {
        let mut reader = Reader {
            service,
            call,
            inbound,
            pending: pending.clone(),
            index: 0,
            count: 0,
            held: VecDeque::new(),
            order: SweepOrder::default(),
            before: None,
            options: JobOptions::default(),
            messages,
        };
        if let Err(error) = reader.run().await {
            // The error follows the pairs of the complete sweeps, so that their flows are still
            // sent.
            let _its_first_error_counts = reader.submit_rest().await;
            drop(reader);
            let _gone_is_fine = pending.send(Item::Broken(error)).await;
        }
    });
    ReceiverStream::new(stream)
}

struct Reader {
    service: Arc<Service>,
    call: Call,
    inbound: Streaming<proto::EstimateSequenceRequest>,
    pending: mpsc::Sender<Item>,
    /// The index of the next pair to submit.
    index: usize,
    /// The number of sweeps so far, and the latest of them, which windows of further pairs may
    /// contain.
    count: usize,
    held: VecDeque<Sweep>,
    order: SweepOrder,
    /// The job of the pair before. With a warm start the next pair starts from its field.
    before: Option<JobId>,
    options: JobOptions,
    /// What its messages take.
    messages: MessageMemory,
}

impl Reader {
    async fn run(&mut self) -> Result<(), ApiError> {
        use proto::estimate_sequence_request::Part;
        let mut room = self.service.uploads.room(&self.call.caller.tenant);
        let first = chunks::next(&mut room, &mut self.inbound).await?;
        let Some(Part::Begin(begin)) = first.and_then(|message| message.part) else {
            return Err(no_begin());
        };
        let options = requests::options(begin.options)?;
        options.check_for_pairs()?;
        options.check_for_sequence(usize::MAX)?;
        self.options = options;
        let mut current: Option<Coming> = None;
        loop {
            // The stream may pause until other requests need its memory, except within a sweep
            // whose number of points was announced.
            let coming = current
                .as_ref()
                .is_some_and(|coming| coming.points.is_some());
            let message = if coming {
                // A sweep that is known to be incomplete must continue to arrive.
                room.wait(self.inbound.message()).await?
            } else {
                let held = self.held_bytes();
                room.pause(held, &self.messages, self.inbound.message())
                    .await?
            };
            let message = message.map_err(|status| chunks::broken(&status))?;
            let ended = message.is_none();
            let whole = match message.and_then(|message| message.part) {
                Some(Part::Chunk(chunk)) => {
                    let Some(coming) = &mut current else {
                        let text = "a chunk belongs to a sweep: send sweep first";
                        return Err(ApiError::BadRequest(text.to_owned()));
                    };
                    let cloud = &mut coming.cloud;
                    cloud.take(&self.service, &mut room, &coming.name, &chunk)?;
                    let all = coming.points.is_some_and(|points| cloud.points() >= points);
                    if all { current.take() } else { None }
                }
                Some(Part::Sweep(sweep)) => current.replace(Coming {
                    cloud: CloudBuilder::named(&sweep.name)?
                        .with_pose(requests::pose(&sweep.name, &sweep.pose)?),
                    name: sweep.name,
                    points: sweep.points,
                }),
                Some(Part::Begin(_)) => return Err(no_begin()),
                None if ended => current.take(),
                None => return Err(ApiError::BadRequest("a message is empty".to_owned())),
            };
            if let Some(whole) = whole {
                self.take(whole, room.next()).await?;
            }
            if ended {
                return self.submit_rest().await;
            }
        }
    }

    /// Adds a complete sweep, and submits the pairs whose windows are final.
    async fn take(&mut self, coming: Coming, room: UploadReservation) -> Result<(), ApiError> {
        self.order.push(&coming.name, self.options.force)?;
        self.held.push_back(coming.finish(room)?);
        self.count += 1;
        let sweeps = self.options.sweeps();
        while self.index + 1 < self.count && is_window_final(self.index, self.count, sweeps) {
            self.submit_next().await?;
        }
        let first = window(self.index, self.count.max(self.index + 2), sweeps).start;
        while self.count - self.held.len() < first {
            self.held.pop_front();
        }
        Ok(())
    }

    /// At the end of the stream: submits the remaining pairs, with windows that end at the last
    /// sweep.
    async fn submit_rest(&mut self) -> Result<(), ApiError> {
        while self.index + 1 < self.count {
            self.submit_next().await?;
        }
        Ok(())
    }

    /// Submits the next pair with the sweeps of its window. It waits for a client that has to read the
    /// pairs before, until other requests need the memory of the sweeps.
    async fn submit_next(&mut self) -> Result<(), ApiError> {
        let place = self.pending.clone().reserve_owned();
        let place = match self.held.back() {
            Some(latest) => {
                let held = self.held_bytes();
                latest.room.pause(held, &self.messages, place).await
            }
            None => Ok(place.await),
        };
        let place = match place {
            Ok(place) => place,
            // The sweeps go, so that their memory is there for others. No later pair is submitted.
            Err(error) => {
                self.held.clear();
                self.count = self.index;
                return Err(error);
            }
        };
        let index = self.index;
        self.index += 1;
        let Ok(place_in_line) = place else {
            return Ok(());
        };
        let first_held = self.count - self.held.len();
        let name = |index: usize| self.held[index - first_held].name.clone();
        let names = (name(index), name(index + 1));
        let job = self.submit(index).await;
        self.before = job.as_ref().ok().map(|accepted| accepted.job.id);
        let kept = self
            .before
            .map(|id| KeptResult::of(&self.service.queue, id));
        let _sender = place_in_line.send(Item::Pair(Pending {
            index: u32::try_from(index).unwrap_or(u32::MAX),
            source: names.0,
            target: names.1,
            job,
            _kept: kept,
        }));
        Ok(())
    }

    /// Bytes of the sweeps that further pairs need.
    fn held_bytes(&self) -> u64 {
        self.held.iter().map(|sweep| sweep.room.bytes()).sum()
    }

    async fn submit(&mut self, index: usize) -> Result<Accepted, ApiError> {
        let options = &self.options;
        let mut request = self
            .call
            .job_request(options.clone(), Durability::Ephemeral);
        let after = self.before;
        request.link = options.chained().then_some(ChainLink { after });
        let window = window(index, self.count, options.sweeps());
        request.pair = PairOf {
            index: u32::try_from(index - window.start).unwrap_or(u32::MAX),
            window: PairOf::seen(0..window.len()),
            ..PairOf::ALONE
        };
        let mut pending = PendingJob::begin(&self.service, self.call.caller.clone(), request)?;
        let first_held = self.count - self.held.len();
        for index in window {
            let cloud = &mut self.held[index - first_held].cloud;
            *cloud = pending.push(Arc::clone(cloud), None).await?;
        }
        pending.submit(Kind::Pair).await
    }
}

/// Sends the flow of every pair in order, as soon as it is available. When the client disconnects,
/// the pending pairs are dropped, which cancels their jobs.
async fn write(service: &Arc<Service>, mut items: mpsc::Receiver<Item>, answers: &ResultBudget) {
    while let Some(item) = items.recv().await {
        let pair = match item {
            Item::Pair(pair) => pair,
            Item::Broken(error) => {
                service.count_late_error("grpc", &error);
                let _gone_is_fine = answers.send(Err(error.into())).await;
                return;
            }
        };
        let sent = tokio::select! {
            () = answers.closed() => return,
            sent = send(service, pair, answers) => sent,
        };
        match sent {
            Ok(true) => {}
            Ok(false) => return,
            Err(error) => {
                // Its memory and the pairs after it are gone before the client reads the error.
                drop(items);
                service.count_late_error("grpc", &error);
                let _gone_is_fine = answers.send(Err(error.into())).await;
                return;
            }
        }
    }
}

/// Sends one pair. Returns false if the client has disconnected.
///
/// # Errors
/// [`ApiError::TakenTooSlowly`] if the result was evicted.
async fn send(
    service: &Arc<Service>,
    pair: Pending,
    answers: &ResultBudget,
) -> Result<bool, ApiError> {
    use proto::estimate_sequence_response::pair::Outcome;
    use proto::estimate_sequence_response::{Pair, Part};
    let message = |part: Part| proto::EstimateSequenceResponse { part: Some(part) };
    let header = |outcome: Outcome| Pair {
        index: pair.index,
        source: pair.source.clone(),
        target: pair.target.clone(),
        outcome: Some(outcome),
    };
    // A server that stops waits for the calls that wait for a job, until they have their answer.
    let mut awaited = None;
    let answer = match pair.job {
        Err(error) => Err(error),
        Ok(accepted) => match service.wait(accepted.job.id, None).await {
            Ok(Waited::Ended(job)) => {
                awaited = accepted.awaited;
                service.answer(&job).await
            }
            Ok(Waited::StillOpen(_)) => Err(ApiError::Draining),
            Err(error) => Err(error),
        },
    };
    let sent = match answer {
        Err(error) => {
            service.count_late_error("grpc", &error);
            let failed = header(Outcome::Error(convert::pair_error(&error)));
            Ok(answers.send(Ok(message(Part::Pair(failed)))).await.is_ok())
        }
        Ok(answer) => {
            let head = header(Outcome::Header(Box::new(convert::header(&answer))));
            let pieces = chunks::pieces(&answer, 0).map(Part::Chunk);
            let messages = std::iter::once(Part::Pair(head)).chain(pieces).map(message);
            chunks::send(messages, answers, answer.room.taking()).await
        }
    };
    if let Some(awaited) = awaited {
        awaited.disarm();
    }
    sent
}
