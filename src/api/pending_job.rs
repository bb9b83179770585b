//! Pending jobs: they are assembled from clouds that arrive one by one. Each cloud is written to the
//! store as soon as it arrives.
//!
//! A pending job becomes a job of the queue with [`PendingJob::submit`]. If it is dropped before
//! that, its blobs are removed.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::task::JoinHandle;

use super::admission::{AdmissionRequest, Durability, Reservation};
use super::auth::Caller;
use super::deliver;
use super::dense::Finalizer;
use super::error::ApiError;
use super::job_request::Request;
use super::service::{MakeDurable, Service};
use super::upload_budget::UploadReservation;
use super::waiters::Awaited;
use crate::clock::Timestamp;
use crate::cost::CostModel;
use crate::flow::{self, Cost, Ground, Sweep, window};
use crate::job::{Job, JobId, JobOptions, Kind};
use crate::payload::StoredCloud;
use crate::queue::{Idempotency, PairOf, QueueError, Submission, Submitted};
use crate::storage::{Blob, BlobError, Fsync};

/// A job that was accepted.
pub(super) struct Accepted {
    /// The job.
    pub(super) job: Arc<Job>,
    /// Whether the job is new. False if an idempotency key has found an existing job.
    pub(super) new: bool,
    /// The registration of the caller as a waiter, if the job depends on its callers. Dropping it
    /// as the last one cancels the job.
    pub(super) awaited: Option<Awaited>,
}

/// A job that is being assembled.
pub(super) struct PendingJob {
    service: Arc<Service>,
    caller: Caller,
    request: Request,
    id: JobId,
    sweeps: u32,
    /// The number of points of each cloud.
    points: Vec<usize>,
    /// The latest cloud, and its memory reservation, which is held until the next cloud has
    /// arrived.
    last: Option<(Arc<StoredCloud>, Option<UploadReservation>)>,
    /// The cost of each two consecutive clouds without neighbor sweeps. `None` where they are not a
    /// pair of the job.
    costs: Vec<Option<Cost>>,
    fingerprint: blake3::Hasher,
    /// The write of a cloud to the store that is in progress.
    writing: Option<JoinHandle<Result<(), BlobError>>>,
    /// Whether the queue has the job, or may have it: its blobs stay. Those without a job are found
    /// and removed later.
    submitted: bool,
}

/// Adds the ground mask to a cloud if the options require ground segmentation and the cloud has no
/// mask.
fn with_ground(cloud: Arc<StoredCloud>, options: &JobOptions) -> Arc<StoredCloud> {
    let options = options.solver_options(cloud.points.len());
    if cloud.ground.is_some() || options.ground != Ground::Auto {
        return cloud;
    }
    let cloud = Arc::unwrap_or_clone(cloud);
    let sweep = Sweep {
        points: cloud.points,
        ground: cloud.ground,
        ..Sweep::default()
    };
    let Sweep { points, ground, .. } = sweep.prepared(&options);
    Arc::new(StoredCloud {
        points,
        ground,
        ..cloud
    })
}

impl PendingJob {
    /// Begins a draft without clouds.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`], [`ApiError::Draining`], [`ApiError::InvalidOptions`],
    /// [`ApiError::Priority`], [`ApiError::NoDevice`] or [`ApiError::BadRequest`].
    pub(super) fn begin(
        service: &Arc<Service>,
        caller: Caller,
        request: Request,
    ) -> Result<Self, ApiError> {
        const MAX_KEY: usize = 255;
        service.check_new_work(&caller)?;
        request.options.check()?;
        caller.may_ask_for(request.options.priority)?;
        service
            .admission
            .check_device(request.options.device_kind())?;
        if let Some(url) = &request.options.webhook {
            if request.durability == Durability::Ephemeral {
                let text =
                    "options: webhook is for submitted jobs: this call has the flow in its answer";
                return Err(ApiError::InvalidOptions(text.to_owned()));
            }
            let webhooks = &service.remotes.webhooks;
            let checked = webhooks.check(url);
            checked.map_err(|error| ApiError::webhook(webhooks, &error))?;
        }
        if let Some(uri) = &request.options.result_uri {
            if request.durability == Durability::Ephemeral {
                let text = "options: result_uri is for submitted jobs: this call has the flow in \
                            its answer";
                return Err(ApiError::InvalidOptions(text.to_owned()));
            }
            deliver::check_place(&service.remotes.deliveries, uri)?;
        }
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
            sweeps: 0,
            points: Vec::new(),
            last: None,
            costs: Vec::new(),
            fingerprint,
            writing: None,
            submitted: false,
        })
    }

    /// The number of clouds so far.
    pub(super) fn sweeps(&self) -> u32 {
        self.sweeps
    }

    /// Adds the next cloud: segments the ground if needed, prices the pair with the cloud before,
    /// and writes the cloud to the store. Returns the cloud with its ground mask, so that further
    /// pairs that use the sweep do not repeat the segmentation. `room` is the memory reservation of
    /// the cloud.
    ///
    /// # Errors
    /// [`ApiError`] if a limit is exceeded, the pair cannot be solved, or the store fails.
    pub(super) async fn push(
        &mut self,
        cloud: impl Into<Arc<StoredCloud>>,
        room: Option<UploadReservation>,
    ) -> Result<Arc<StoredCloud>, ApiError> {
        let cloud = cloud.into();
        let service = Arc::clone(&self.service);
        service.admission.check_points(cloud.points.len())?;
        self.check_pose(&cloud)?;
        service.check_disk()?;
        let limit = service.limits.max_sweeps;
        if self.sweeps >= limit && self.request.pair == PairOf::ALONE {
            return Err(ApiError::TooLarge(format!(
                "a sequence has more than the {limit} sweeps that this server takes"
            )));
        }
        self.points.push(cloud.points.len());
        if self.request.options.densify.is_some() {
            service.admission.check_dense(&self.points)?;
        }
        let (before, _room_before) = self.last.take().unzip();
        let options = self.request.options.clone();
        let after = self.request.link.and_then(|link| link.after);
        let chained = options.chained() && (self.sweeps > 1 || after.is_some());
        let pair = self.request.pair;
        let is_pair = pair == PairOf::ALONE || self.sweeps == pair.index + 1;
        let work = {
            let service = Arc::clone(&service);
            move || {
                // The fingerprint covers the cloud as it was sent, without the computed ground
                // mask.
                let mut bytes = cloud.to_bytes();
                let asked = blake3::hash(&bytes);
                let known = cloud.ground.is_some();
                let cloud = with_ground(cloud, &options);
                if cloud.ground.is_some() != known {
                    bytes = cloud.to_bytes();
                }
                let cost = before.filter(|_| is_pair).map(|before| {
                    let admission = &service.admission;
                    admission.predict_cost(&before, &cloud, &options, chained)
                });
                Ok((cost.transpose()?, asked, bytes, cloud))
            }
        };
        let (cost, asked, bytes, cloud) = service.compute(&self.caller.tenant, work).await?;
        self.last = Some((Arc::clone(&cloud), room));
        if self.sweeps > 0 {
            self.costs.push(cost);
        }
        self.fingerprint.update(asked.as_bytes());
        let sync = match self.request.durability {
            Durability::Durable => Fsync::Yes,
            Durability::Ephemeral => Fsync::No,
        };
        let blob = Blob::Sweep(self.sweeps);
        // The write runs in its own task: when the client disconnects, the write completes first,
        // and the draft's files are removed after it.
        let (blobs, id) = (service.blobs.clone(), self.id);
        let writing = async move { blobs.put(id, blob, Bytes::from(bytes), sync).await };
        let writing = self.writing.insert(tokio::spawn(writing));
        let written = writing.await.map_err(ApiError::internal);
        self.writing = None;
        written??;
        self.sweeps += 1;
        Ok(cloud)
    }

    /// Checks that all clouds have a pose or none has, and that a pose is not beside another ego
    /// motion.
    fn check_pose(&self, cloud: &StoredCloud) -> Result<(), ApiError> {
        if cloud.pose.is_some() {
            self.request.options.check_for_poses()?;
        }
        match &self.last {
            Some((before, _)) if before.pose.is_some() != cloud.pose.is_some() => {
                let text = format!(
                    "sweeps {} and {}: one has a pose and the other has none",
                    self.sweeps - 1,
                    self.sweeps
                );
                Err(ApiError::BadRequest(text))
            }
            _ => Ok(()),
        }
    }

    /// Submits the job: a pair of two clouds if `kind` is a pair, otherwise a sequence.
    ///
    /// The commit runs in its own task, so a client that disconnects cannot leave a partial state.
    /// Either the job is accepted with its clouds, or neither is kept. A job that depends on its
    /// caller is cancelled afterwards.
    ///
    /// # Errors
    /// [`ApiError`] if clouds are missing, admission control refuses the job, or the store fails.
    pub(super) async fn submit(self, kind: Kind) -> Result<Accepted, ApiError> {
        if kind == Kind::Pair {
            self.request.options.check_for_pairs()?;
        } else {
            let options = &self.request.options;
            options.check_for_sequence(self.sweeps as usize)?;
        }
        match (kind, self.sweeps) {
            (Kind::Pair, clouds) if clouds == self.request.pair.window[1] => {}
            (Kind::Sequence, 2..) => {}
            (Kind::Pair, _) => {
                return Err(ApiError::BadRequest("a pair is two clouds".to_owned()));
            }
            (Kind::Sequence, _) => {
                let text = "a sequence is at least two sweeps";
                return Err(ApiError::BadRequest(text.to_owned()));
            }
        }
        deliver::check_form(&self.request.options, kind)?;
        let submission = self.submission(kind)?;
        let index = self.admit(&submission)?;
        let committed = tokio::spawn(self.commit(submission, index));
        committed.await.map_err(ApiError::internal)?
    }

    async fn commit(
        mut self,
        submission: Submission,
        _reservation: Reservation,
    ) -> Result<Accepted, ApiError> {
        // The job that an idempotency key finds may be cancelled at the same time. Then its key is
        // free again, and the submission is repeated.
        const TRIES: u32 = 5;
        let durable = self.request.durability == Durability::Durable;
        for _ in 0..TRIES {
            let submitted = self.service.queue.submit(submission.clone()).await;
            match &submitted {
                // A database that did not answer in time may accept the job later.
                Err(QueueError::Store(_) | QueueError::Closed) => self.submitted = true,
                Err(QueueError::Full(_)) => {
                    self.submitted = self.service.may_be_queued(self.id).await;
                }
                _ => {}
            }
            let (mut job, new) = match submitted? {
                Submitted::New(job) => {
                    self.submitted = true;
                    (job, true)
                }
                Submitted::Known(job) => {
                    // It may be this one: a repetition finds what the queue had accepted.
                    self.submitted |= job.id == self.id;
                    (job, false)
                }
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
        let closing = submission.finalizer_seconds.unwrap_or(0.0);
        self.service.admission.admit(&AdmissionRequest {
            tenant: &self.caller.tenant,
            priority: self.request.options.priority,
            device: self.request.options.device_kind(),
            nominal_seconds: submission.cost_seconds * pairs + closing,
            durability: self.request.durability,
        })
    }

    /// The forward pairs of the sequence, in the order of computation.
    fn pairs(&self) -> Vec<PairOf> {
        let options = &self.request.options;
        let (chained, sweeps) = (options.chained(), options.sweeps());
        let forward = (0..self.sweeps - 1).map(|index| PairOf {
            index,
            backward: false,
            window: PairOf::seen(window(index as usize, self.sweeps as usize, sweeps)),
            chained: chained && index > 0,
        });
        forward.collect()
    }

    /// Nominal seconds of forward pairs, including their neighbor sweeps.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`] if a pair exceeds the memory limit.
    fn nominal_seconds(&self, pairs: &[PairOf]) -> Result<f64, ApiError> {
        let mut seconds = 0.0;
        for pair in pairs {
            let Some(Some(cost)) = self.costs.get(pair.index as usize) else {
                continue;
            };
            let neighbors = (pair.window[0]..pair.window[1])
                .filter(|&index| index != pair.index && index != pair.index + 1)
                .map(|index| flow::neighbor_cost(self.points[index as usize]));
            let cost = neighbors.fold(*cost, |cost, neighbor| Cost {
                bytes: cost.bytes + neighbor.bytes,
                multiply_adds: cost.multiply_adds + neighbor.multiply_adds,
                ..cost
            });
            self.service.admission.check_bytes(&cost)?;
            seconds += CostModel::nominal(&cost);
        }
        Ok(seconds)
    }

    /// The fingerprint of the submission for its idempotency key: options, clouds, and pair or
    /// sequence.
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
        let mut finalizer_seconds = None;
        if let Some(densify) = &self.request.options.densify {
            let options = &self.request.options;
            let solver = options.solver_options(0);
            let closing = Finalizer::of(densify, &self.points, options.chained(), &solver)?;
            pairs.extend(closing.back);
            finalizer_seconds = Some(closing.nominal_seconds);
        }
        let link = self.request.link;
        let options = &self.request.options;
        let asked = options.deadline_ms.map(Duration::from_millis);
        let spent = self.request.received.at.elapsed();
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
            finalizer_seconds,
            after: link.and_then(|link| link.after),
            has_dependents: link.is_some(),
            priority: options.priority,
            device: options.device_kind(),
            options: options.to_json(),
            labels: options.labels.texts(),
            trace: self.request.received.trace.clone(),
            webhook: options.webhook.clone(),
            result_uri: options.result_uri.clone(),
            deadline: left.map(|left| Timestamp::now().after(left)),
            idempotency: key.map(|key| Idempotency {
                key,
                fingerprint: self.fingerprint(kind),
            }),
            durable: self.request.durability == Durability::Durable,
        })
    }
}

impl Drop for PendingJob {
    fn drop(&mut self) {
        let writing = self.writing.take();
        if self.submitted || (self.sweeps == 0 && writing.is_none()) {
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
        let sweep = Street::new(&street).and_then(|street| street.sweep(0));
        let points = sweep.expect("a sweep").points;
        let options = |json: &str| JobOptions::from_json(json.as_bytes()).expect("good options");
        let stored = |ground: Option<Vec<bool>>, json: &str| {
            let points = points.clone();
            let cloud = Arc::new(StoredCloud {
                points,
                ground,
                ..StoredCloud::default()
            });
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
        let near = stored(None, r#"{"crop_m": 15}"#).expect("found");
        let all = stored(None, "{}").expect("found");
        let ground = |mask: &[bool]| mask.iter().filter(|&&ground| ground).count();
        assert!(0 < ground(&near) && ground(&near) < ground(&all));
    }
}
