//! A job that is being put together: clouds come one by one and go straight into store.
//!
//! Nothing is promised before [`Draft::submit`]; a draft that is dropped leaves nothing behind.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::admission::{Asked, Promise, Reservation};
use super::auth::Caller;
use super::dense::Closing;
use super::error::ApiError;
use super::service::{MakeDurable, Service};
use super::uploads::Room;
use super::waiters::Awaited;
use crate::clock::Timestamp;
use crate::cost::CostModel;
use crate::flow::{self, Cost, Ground, Sweep, window};
use crate::job::{Job, JobId, JobOptions, Kind};
use crate::payload::StoredCloud;
use crate::queue::{Idempotency, PairOf, Submission, Submitted};
use crate::storage::{Blob, BlobError, Sync};
use bytes::Bytes;
use tokio::task::JoinHandle;

/// What is asked of a job before its clouds are there.
#[derive(Clone, Debug)]
pub(super) struct Request {
    /// How the flow is found.
    pub options: JobOptions,
    /// Who waits.
    pub promise: Promise,
    /// Makes a repeated submission find the first one.
    pub idempotency_key: Option<String>,
    /// When it arrived: deadlines count from here.
    pub arrived: Instant,
    /// The call's own deadline, from its arrival, if it has one.
    pub time_left: Option<Duration>,
    /// Its place in a chain of pairs that come one by one, where it is of one.
    pub link: Option<Link>,
    /// Which of the clouds that come a pair is of, where it is not the first two.
    pub pair: PairOf,
}

/// A pair's place in a chain.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link {
    /// The pair before, where there is one.
    pub after: Option<JobId>,
}

/// A job that was accepted.
pub(super) struct Accepted {
    /// The job.
    pub(super) job: Arc<Job>,
    /// Whether it is new: not one that an idempotency key has found.
    pub(super) new: bool,
    /// Cancels a new job that somebody waits for, unless it is let go.
    pub(super) awaited: Option<Awaited>,
}

/// When a request arrived.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrived(pub(super) Instant);

/// A job that is being put together.
pub(super) struct Draft {
    service: Arc<Service>,
    caller: Caller,
    request: Request,
    id: JobId,
    frames: u32,
    /// Points of each cloud.
    points: Vec<usize>,
    /// The last cloud, and the room that it takes until the next one is there.
    last: Option<(Arc<StoredCloud>, Option<Room>)>,
    /// What each two clouds that follow each other cost alone, where they are a pair.
    prices: Vec<Option<Cost>>,
    fingerprint: blake3::Hasher,
    /// A cloud that is on its way into store.
    writing: Option<JoinHandle<Result<(), BlobError>>>,
    submitted: bool,
}

/// The cloud, with the ground that its pairs would find.
fn with_ground(cloud: Arc<StoredCloud>, options: &JobOptions) -> Arc<StoredCloud> {
    let options = options.solver_options(cloud.points.len());
    if cloud.ground.is_some() || options.ground != Ground::Auto {
        return cloud;
    }
    let StoredCloud { points, ground } = Arc::unwrap_or_clone(cloud);
    let Sweep { points, ground } = Sweep { points, ground }.prepared(&options);
    Arc::new(StoredCloud { points, ground })
}

impl Draft {
    /// Begins a job whose clouds will follow.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`], [`ApiError::Draining`], [`ApiError::InvalidOptions`],
    /// [`ApiError::NoDevice`] or [`ApiError::BadRequest`].
    pub(super) fn begin(
        service: &Arc<Service>,
        caller: Caller,
        request: Request,
    ) -> Result<Self, ApiError> {
        const MAX_KEY: usize = 255;
        caller.may_write()?;
        service.check_draining()?;
        request.options.check()?;
        caller.may_ask_for(request.options.priority)?;
        service
            .admission
            .check_device(request.options.device_kind())?;
        if let Some(key) = &request.idempotency_key
            && (key.is_empty() || key.len() > MAX_KEY)
        {
            let text = format!("an idempotency key has 1 to {MAX_KEY} bytes");
            return Err(ApiError::BadRequest(text));
        }
        let mut fingerprint = blake3::Hasher::new();
        fingerprint.update(request.options.to_json().as_bytes());
        Ok(Self {
            service: Arc::clone(service),
            caller,
            request,
            id: JobId::fresh(),
            frames: 0,
            points: Vec::new(),
            last: None,
            prices: Vec::new(),
            fingerprint,
            writing: None,
            submitted: false,
        })
    }

    /// Clouds so far.
    pub(super) fn frames(&self) -> u32 {
        self.frames
    }

    /// Takes the next cloud, finds its ground where that is wanted and not known, prices it with the
    /// one before, and puts it in store. Gives it back as it lies there: every attempt at every pair
    /// that sees it is spared the search.
    ///
    /// # Errors
    /// [`ApiError`] where the pair cannot be solved here, or the store fails.
    pub(super) async fn push(
        &mut self,
        cloud: impl Into<Arc<StoredCloud>>,
        room: Option<Room>,
    ) -> Result<Arc<StoredCloud>, ApiError> {
        let cloud = cloud.into();
        let service = Arc::clone(&self.service);
        service.admission.check_points(cloud.points.len())?;
        service.check_disk()?;
        let limit = service.limits.max_frames;
        if self.frames >= limit && self.request.pair == PairOf::ALONE {
            return Err(ApiError::TooLarge(format!(
                "a sequence has more than the {limit} frames that this server takes"
            )));
        }
        self.points.push(cloud.points.len());
        if self.request.options.densify.is_some() {
            service.admission.check_dense(&self.points)?;
        }
        let (before, _room_before) = self.last.take().unzip();
        let options = self.request.options.clone();
        let after = self.request.link.and_then(|link| link.after);
        let goes_on = options.goes_on() && (self.frames > 1 || after.is_some());
        let pair = self.request.pair;
        let is_pair = pair == PairOf::ALONE || self.frames == pair.place + 1;
        let work = {
            let service = Arc::clone(&service);
            move || {
                // As it came: what is found of it is no part of what was asked.
                let mut bytes = cloud.to_bytes();
                let asked = blake3::hash(&bytes);
                let known = cloud.ground.is_some();
                let cloud = with_ground(cloud, &options);
                if cloud.ground.is_some() != known {
                    bytes = cloud.to_bytes();
                }
                let price = before.filter(|_| is_pair).map(|before| {
                    let admission = &service.admission;
                    admission.price(&before, &cloud, &options, goes_on)
                });
                Ok((price.transpose()?, asked, bytes, cloud))
            }
        };
        let (price, asked, bytes, cloud) = service.compute(&self.caller.tenant, work).await?;
        self.last = Some((Arc::clone(&cloud), room));
        if self.frames > 0 {
            self.prices.push(price);
        }
        self.fingerprint.update(asked.as_bytes());
        let sync = match self.request.promise {
            Promise::Durable => Sync::Yes,
            Promise::WhileAwaited => Sync::No,
        };
        let blob = Blob::Frame(self.frames);
        // The write runs in its own task: when the client disconnects, the write completes first and
        // the draft's files are removed after it.
        let (blobs, id) = (service.blobs.clone(), self.id);
        let writing = async move { blobs.put(id, blob, Bytes::from(bytes), sync).await };
        let writing = self.writing.insert(tokio::spawn(writing));
        let written = writing.await.map_err(ApiError::internal);
        self.writing = None;
        written??;
        self.frames += 1;
        Ok(cloud)
    }

    /// Submits the job: a pair for two clouds and `kind` pair, else a sequence.
    ///
    /// A caller that goes away in the middle leaves nothing half done: the job is accepted with its
    /// clouds, or neither is there; and what was only for that caller is cancelled.
    ///
    /// # Errors
    /// [`ApiError`] where clouds are missing, nothing more is accepted, or the store fails.
    pub(super) async fn submit(self, kind: Kind) -> Result<Accepted, ApiError> {
        if kind == Kind::Pair {
            self.request.options.check_for_pairs()?;
        } else {
            let options = &self.request.options;
            options.check_for_sequence(self.frames as usize)?;
        }
        match (kind, self.frames) {
            (Kind::Pair, clouds) if clouds == self.request.pair.sees[1] => {}
            (Kind::Sequence, 2..) => {}
            (Kind::Pair, _) => {
                return Err(ApiError::BadRequest("a pair is two clouds".to_owned()));
            }
            (Kind::Sequence, _) => {
                let text = "a sequence is at least two frames";
                return Err(ApiError::BadRequest(text.to_owned()));
            }
        }
        let submission = self.submission(kind)?;
        let place = self.admit(&submission)?;
        let committed = tokio::spawn(self.commit(submission, place));
        committed.await.map_err(ApiError::internal)?
    }

    async fn commit(
        mut self,
        submission: Submission,
        _place: Reservation,
    ) -> Result<Accepted, ApiError> {
        // A job that is found may be given up at the same moment: then its key is free again.
        const TRIES: u32 = 5;
        let durable = self.request.promise == Promise::Durable;
        for _ in 0..TRIES {
            let (mut job, new) = match self.service.queue.submit(submission.clone()).await? {
                Submitted::New(job) => {
                    self.submitted = true;
                    (job, true)
                }
                Submitted::Known(job) => (job, false),
            };
            let mut awaited = None;
            if durable && !job.durable {
                job = match self.service.make_durable(&job).await {
                    Err(MakeDurable::GivenUp) => continue,
                    Err(MakeDurable::Failed(error)) => return Err(error),
                    Ok(job) => job,
                };
            } else if !durable && !job.durable && !job.state.is_end() {
                match self.service.wait_for(job.id) {
                    Ok(waits) => awaited = Some(waits),
                    Err(ending) => {
                        ending.is_over().await;
                        continue;
                    }
                }
            }
            return Ok(Accepted { job, new, awaited });
        }
        Err(ApiError::ServerFull(Duration::from_secs(1)))
    }

    fn admit(&self, submission: &Submission) -> Result<Reservation, ApiError> {
        self.service.check_draining()?;
        let pairs = submission.pairs.len().max(1) as f64;
        let closing = submission.closing_seconds.unwrap_or(0.0);
        self.service.admission.admit(&Asked {
            tenant: &self.caller.tenant,
            priority: self.request.options.priority,
            device: self.request.options.device_kind(),
            nominal_seconds: submission.cost_seconds * pairs + closing,
            promise: self.request.promise,
        })
    }

    /// The pairs of a sequence that go forward, in the order of their turns.
    fn pairs(&self) -> Vec<PairOf> {
        let options = &self.request.options;
        let (goes_on, frames) = (options.goes_on(), options.frames());
        let forward = (0..self.frames - 1).map(|place| PairOf {
            place,
            backward: false,
            sees: PairOf::seen(window(place as usize, self.frames as usize, frames)),
            follows: goes_on && place > 0,
        });
        forward.collect()
    }

    /// Nominal seconds of some pairs that go forward, with all that they see.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`] where one needs more memory than a pair may take.
    fn nominal_seconds(&self, pairs: &[PairOf]) -> Result<f64, ApiError> {
        let mut seconds = 0.0;
        for pair in pairs {
            let Some(Some(price)) = self.prices.get(pair.place as usize) else {
                continue;
            };
            let around = (pair.sees[0]..pair.sees[1])
                .filter(|&place| place != pair.place && place != pair.place + 1)
                .map(|place| flow::neighbor_cost(self.points[place as usize]));
            let price = around.fold(*price, |price, around| Cost {
                bytes: price.bytes + around.bytes,
                multiply_adds: price.multiply_adds + around.multiply_adds,
                ..price
            });
            self.service.admission.check_bytes(&price)?;
            seconds += CostModel::nominal(&price);
        }
        Ok(seconds)
    }

    /// Of what was asked: options, clouds, and whether they are a pair or a sequence.
    fn fingerprint(&self, kind: Kind) -> [u8; 32] {
        let mut fingerprint = self.fingerprint.clone();
        fingerprint.update(match kind {
            Kind::Pair => b"pair".as_slice(),
            Kind::Sequence => b"sequence".as_slice(),
        });
        *fingerprint.finalize().as_bytes()
    }

    fn submission(&self, kind: Kind) -> Result<Submission, ApiError> {
        let mut pairs: Vec<PairOf> = match kind {
            Kind::Pair => Vec::new(),
            Kind::Sequence => self.pairs(),
        };
        let nominal = match kind {
            Kind::Pair => self.nominal_seconds(&[self.request.pair])?,
            Kind::Sequence => self.nominal_seconds(&pairs)?,
        };
        let cost_seconds = nominal / pairs.len().max(1) as f64;
        let mut closing_seconds = None;
        if let Some(densify) = &self.request.options.densify {
            let options = &self.request.options;
            let (goes_on, frames) = (options.goes_on(), options.frames());
            let closing = Closing::of(densify, &self.points, goes_on, frames)?;
            pairs.extend(closing.back);
            closing_seconds = Some(closing.nominal_seconds);
        }
        let link = self.request.link;
        let options = &self.request.options;
        let asked = options.deadline_ms.map(Duration::from_millis);
        let spent = self.request.arrived.elapsed();
        let asked = asked.into_iter().chain(self.request.time_left).min();
        let left = asked.map(|asked| asked.saturating_sub(spent));
        let key = self.request.idempotency_key.clone();
        Ok(Submission {
            id: self.id,
            tenant: self.caller.tenant.clone(),
            kind,
            pair: self.request.pair,
            cost_seconds,
            pairs,
            closing_seconds,
            after: link.and_then(|link| link.after),
            followed: link.is_some(),
            priority: options.priority,
            device: options.device_kind(),
            options: options.to_json(),
            deadline: left.map(|left| Timestamp::now().after(left)),
            idempotency: key.map(|key| Idempotency {
                key,
                fingerprint: self.fingerprint(kind),
            }),
            durable: self.request.promise == Promise::Durable,
        })
    }
}

impl Drop for Draft {
    fn drop(&mut self) {
        let writing = self.writing.take();
        if self.submitted || (self.frames == 0 && writing.is_none()) {
            return;
        }
        let (service, id) = (Arc::clone(&self.service), self.id);
        tokio::spawn(async move {
            if let Some(writing) = writing {
                let _however_it_ends = writing.await;
            }
            service.forget_blobs(id).await;
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::simulate::{Street, StreetOptions};

    #[test]
    fn ground_is_found_where_it_is_wanted_and_not_known() {
        let street = StreetOptions {
            azimuth_steps: 300,
            ..StreetOptions::default()
        };
        let sweep = Street::new(&street).and_then(|street| street.frame(0));
        let points = sweep.expect("a sweep").points;
        let options = |json: &str| JobOptions::from_json(json.as_bytes()).expect("good options");
        let stored = |ground: Option<Vec<bool>>, json: &str| {
            let points = points.clone();
            let cloud = Arc::new(StoredCloud { points, ground });
            with_ground(cloud, &options(json)).ground.clone()
        };
        let mask = vec![true; points.len()];
        for json in ["{}", r#"{"ground": "keep"}"#, r#"{"ground": "mask"}"#] {
            assert_eq!(
                stored(Some(mask.clone()), json),
                Some(mask.clone()),
                "{json}"
            );
            let found = stored(None, json);
            assert_eq!(found.is_some(), json == "{}", "{json}");
        }
        let near = stored(None, r#"{"range_m": 15}"#).expect("found");
        let all = stored(None, "{}").expect("found");
        let ground = |mask: &[bool]| mask.iter().filter(|&&ground| ground).count();
        assert!(0 < ground(&near) && ground(&near) < ground(&all));
    }
}
