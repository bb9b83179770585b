//! The input of a pair, read from the store: sweeps, neighbor sweeps, the preceding field and the
//! snapshot.
//!
//! Independent of how the result is used.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::control::JobControl;
use super::run::Worker;
use crate::clock::Timestamp;
use crate::engine::Work;
use crate::flow::{EnvelopeError, MotionField, Snapshot, Sweep, neighbor_at};
use crate::formats::SweepTime;
use crate::job::{Job, JobOptions, State};
use crate::payload::{CorruptPayload, StoredCloud};
use crate::queue::{Lease, QueueError};
use crate::storage::{Blob, BlobError, Fsync};

/// Why a job's input could not be read from the store.
#[derive(Debug, thiserror::Error)]
pub(super) enum StoreError {
    #[error(transparent)]
    Blob(#[from] BlobError),
    #[error(transparent)]
    CorruptPayload(#[from] CorruptPayload),
    #[error("a field cannot be read: {0}")]
    MotionField(#[from] EnvelopeError),
    #[error("reading it failed: {0}")]
    Task(#[from] tokio::task::JoinError),
    #[error("its pairs are not those of its plan")]
    NoPlan,
    #[error("its options cannot be read: {0}")]
    Options(#[from] crate::job::InvalidOptions),
    #[error(transparent)]
    Queue(#[from] QueueError),
}

impl Worker {
    /// Reads the input of the job, and starts the task that writes its snapshots.
    pub(super) async fn prepare(
        &self,
        lease: &Lease,
    ) -> Result<(Work, JoinHandle<()>, JobOptions), StoreError> {
        let job = &lease.job;
        let mut options = JobOptions::from_json(job.options.as_bytes())?;
        let (owner, [source, target]) = job.sweeps();
        let (source, target, before) = tokio::try_join!(
            async { Ok(self.blobs.get(owner, Blob::Sweep(source)).await?) },
            async { Ok(self.blobs.get(owner, Blob::Sweep(target)).await?) },
            self.field_before(job),
        )?;
        let snapshot = self.earlier_snapshot(job).await;
        let source = StoredCloud::from_bytes(&source)?;
        let target = StoredCloud::from_bytes(&target)?;
        let neighbors = self.around(job, [source.time, target.time]).await?;
        options.dt_s = options
            .dt_s
            .or_else(|| Some(source.time?.interval_s(target.time?)?.abs()));
        let points = source.points.len().max(target.points.len());
        let (snapshots, kept) = mpsc::channel(1);
        let deadline = job.deadline.map(|deadline| {
            // Storing and delivering the result also takes time.
            let left = Timestamp::now().until(deadline);
            Instant::now() + left.saturating_sub(self.after_solving(job, points))
        });
        let control = JobControl::new(
            lease.heartbeat.clone(),
            deadline,
            self.options.snapshot_interval,
            self.drain.release.clone(),
            snapshots,
        );
        let mut solver = options.solver_options(points);
        let poses = source.pose.zip(target.pose).map(<[_; 2]>::from);
        solver.ego = solver.ego.of_pair(poses, job.backward);
        let work = Work {
            options: solver,
            before,
            neighbors,
            ground: source.ground.zip(target.ground).map(<[_; 2]>::from),
            source: source.points,
            target: target.points,
            snapshot,
            control: Arc::new(control),
        };
        Ok((work, self.keep_snapshots(lease, kept), options))
    }

    /// The neighbor sweeps of a pair, each with its time after the source in units of the interval
    /// from source to target. For a backward pair, earlier sweeps have positive times. `times` are those
    /// of the source and the target.
    async fn around(
        &self,
        job: &Job,
        times: [Option<SweepTime>; 2],
    ) -> Result<Vec<(Sweep, i8)>, StoreError> {
        let (owner, pair) = job.sweeps();
        let [first, end] = job.window;
        let mut around = Vec::new();
        for index in (first..end).filter(|index| !pair.contains(index)) {
            let gaps = i64::from(index) - i64::from(pair[0]);
            let at = if job.backward { -gaps } else { gaps };
            let bytes = self.blobs.get(owner, Blob::Sweep(index)).await?;
            let StoredCloud {
                points,
                ground,
                time,
                ..
            } = StoredCloud::from_bytes(&bytes)?;
            let [source, target] = times;
            let times = [source, target, time].map(|time| time?.seconds());
            let Some(at) = neighbor_at(times, at) else {
                continue;
            };
            let sweep = Sweep {
                points,
                ground,
                ..Sweep::default()
            };
            around.push((sweep, at));
        }
        Ok(around)
    }

    /// Time reserved for storing the result and delivering it to the caller.
    fn after_solving(&self, job: &Job, points: usize) -> Duration {
        const FOR_THE_DISK: Duration = Duration::from_millis(30);
        const FOR_THE_CALLER: Duration = Duration::from_millis(8);
        let disk = if job.durable {
            FOR_THE_DISK
        } else {
            Duration::ZERO
        };
        FOR_THE_CALLER + disk + Duration::from_nanos(150 * points as u64)
    }

    /// The motion field of the job that this one follows, if that has succeeded. A succeeded job
    /// runs another attempt only if its result is lost, so repeated reads give the same field.
    /// Without a field the pair starts cold.
    async fn field_before(&self, job: &Job) -> Result<Option<MotionField>, StoreError> {
        let Some(after) = job.after else {
            return Ok(None);
        };
        let before = match self.queue.job(&job.tenant, after).await {
            Ok(before) => before,
            Err(QueueError::NotFound) => return Ok(None),
            Err(error) => return Err(error.into()),
        };
        if before.state != State::Succeeded {
            return Ok(None);
        }
        match self.field(&before).await {
            Ok(field) => Ok(Some(field)),
            Err(StoreError::Blob(error)) if !error.is_missing() => Err(error.into()),
            Err(error) => {
                tracing::warn!(%error, %after, "no field to go on from: the pair starts afresh");
                Ok(None)
            }
        }
    }

    /// The motion field of a pair that has succeeded.
    pub(super) async fn field(&self, job: &Job) -> Result<MotionField, StoreError> {
        let bytes = self.blobs.get(job.id, Blob::Field(job.attempt)).await?;
        Ok(MotionField::from_bytes(&bytes)?)
    }

    /// The snapshot of an earlier attempt, if there is one.
    async fn earlier_snapshot(&self, job: &Job) -> Option<Snapshot> {
        if job.attempt == 1 {
            return None;
        }
        let bytes = match self.blobs.get(job.id, Blob::Snapshot).await {
            Ok(bytes) => bytes,
            Err(error) if error.is_missing() => return None,
            Err(error) => {
                tracing::warn!(%error, "a snapshot cannot be read: the job starts afresh");
                return None;
            }
        };
        match Snapshot::from_bytes(&bytes) {
            Ok(snapshot) => {
                tracing::info!(iteration = snapshot.iterations(), "resumed");
                self.metrics.resumed();
                Some(snapshot)
            }
            Err(error) => {
                tracing::warn!(%error, "a snapshot is damaged: the job starts afresh");
                None
            }
        }
    }

    /// Writes every snapshot that arrives, until the optimization ends.
    fn keep_snapshots(&self, lease: &Lease, mut kept: mpsc::Receiver<Vec<u8>>) -> JoinHandle<()> {
        let (blobs, metrics) = (self.blobs.clone(), Arc::clone(&self.metrics));
        let store_health = Arc::clone(self.store.health());
        let (id, heartbeat) = (lease.job.id, lease.heartbeat.clone());
        tokio::spawn(async move {
            while let Some(snapshot) = kept.recv().await {
                let bytes = Bytes::from(snapshot);
                match blobs.put(id, Blob::Snapshot, bytes, Fsync::No).await {
                    Ok(()) => {
                        metrics.snapshot_kept();
                        heartbeat.snapshot_kept();
                    }
                    Err(error) => {
                        tracing::warn!(%error, "a snapshot was not kept");
                        store_health.failed(&error);
                    }
                }
            }
        })
    }
}
