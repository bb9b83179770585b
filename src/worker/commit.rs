//! The end of an attempt: stores its result, finishes it in the queue, and handles storage
//! failures.

use std::time::{Duration, Instant};

use bytes::Bytes;

use super::load::StoreError;
use super::run::{Attempt, Done, Worker, failure};
use crate::fault::Fault;
use crate::job::{Job, State};
use crate::queue::{Committed, Lease, Outcome, QueueError};
use crate::storage::{Blob, BlobError, Fsync};

impl Worker {
    /// Stores the result, then ends the attempt in the queue.
    pub(super) async fn commit(&self, lease: &Lease, attempt: Attempt) {
        let job = &lease.job;
        let began = Instant::now();
        let outcome = match attempt {
            Attempt::Lost => return,
            Attempt::Ended(outcome) => outcome,
            Attempt::Done(done) => self.store(lease, *done).await,
        };
        let succeeded = matches!(outcome, Outcome::Succeeded { .. });
        match self.finish(lease, outcome).await {
            Ok(Committed::Yes(state)) => {
                if succeeded {
                    self.metrics
                        .phase("store", began.elapsed().as_secs_f64(), Some(job));
                }
                if state.is_end()
                    && let Err(error) = self.blobs.remove(job.id, Blob::Snapshot).await
                {
                    tracing::warn!(%error, job = %job.id, "a snapshot was not removed");
                }
            }
            Ok(Committed::Fenced) if self.has_this_result(job).await => {
                tracing::info!(job = %job.id, "the outcome had been kept");
            }
            Ok(Committed::Fenced) => {
                tracing::warn!(job = %job.id, attempt = job.attempt, "a late result was thrown away");
                self.remove_attempt(job).await;
            }
            Err(error) => tracing::error!(%error, job = %job.id, "an outcome was not kept"),
        }
    }

    /// Whether the job has succeeded by this attempt. Then the queue had kept the outcome, and its
    /// answer was lost. If the queue cannot be read, the result is kept.
    async fn has_this_result(&self, job: &Job) -> bool {
        match self.queue.job(&job.tenant, job.id).await {
            Ok(now) => now.state == State::Succeeded && now.attempt == job.attempt,
            Err(error) => error.is_of_the_machine(),
        }
    }

    /// Ends the attempt in the queue. Retries with exponential back-off while the store fails: the
    /// result is already computed, and the fencing token makes a retry safe.
    pub(super) async fn finish(
        &self,
        lease: &Lease,
        outcome: Outcome,
    ) -> Result<Committed, QueueError> {
        const FIRST_PAUSE: Duration = Duration::from_millis(100);
        const LONGEST_PAUSE: Duration = Duration::from_secs(5);
        let job = &lease.job;
        let mut pause = FIRST_PAUSE;
        loop {
            let ended = self.queue.finish(job.id, job.attempt, outcome.clone());
            let error = match ended.await {
                Err(error) if error.is_of_the_machine() => error,
                ended => return ended,
            };
            tracing::warn!(%error, job = %job.id, "an outcome is not kept yet");
            self.store.health().failed(&error);
            tokio::select! {
                () = self.drain.release.cancelled() => return Err(error),
                () = tokio::time::sleep(pause) => {}
            }
            pause = (pause * 2).min(LONGEST_PAUSE);
        }
    }

    /// Stores the results of an attempt. The field is stored before the success that followers wait
    /// for.
    async fn store(&self, lease: &Lease, done: Done) -> Outcome {
        let job = &lease.job;
        let (result, field) = (done.result, done.field);
        let packing = tokio::task::spawn_blocking(move || {
            (result.to_bytes(), field.map(|field| field.to_bytes()))
        });
        let (result, field) = match packing.await {
            Ok(packed) => packed,
            Err(error) => return Outcome::Failed(failure("store", &error, true)),
        };
        let size = result.len() + field.as_ref().map_or(0, Vec::len);
        let mut blobs = vec![(Blob::Result(job.attempt), result)];
        blobs.extend(field.map(|field| (Blob::Field(job.attempt), field)));
        let writing = blobs
            .into_iter()
            .map(|(blob, bytes)| self.put(lease, blob, bytes));
        let stored = futures_util::future::try_join_all(writing).await;
        match (stored, done.report) {
            (Ok(_), Ok(report)) => Outcome::Succeeded {
                stop_reason: done.stop_reason,
                report,
                progress: done.progress,
            },
            (Err(error), _) => {
                tracing::error!(%error, job = %job.id, "a result was not kept");
                // The next attempt writes its own blobs.
                self.remove_attempt(job).await;
                self.store_failed(error.fault(), size as u64, &error).await
            }
            (_, Err(error)) => Outcome::Failed(failure("store", &error, true)),
        }
    }

    /// Removes the blobs that an attempt has written.
    async fn remove_attempt(&self, job: &Job) {
        for blob in [Blob::Result(job.attempt), Blob::Field(job.attempt)] {
            if let Err(error) = self.blobs.remove(job.id, blob).await {
                tracing::warn!(%error, job = %job.id, "a result that is not wanted was not removed");
            }
        }
    }

    /// Writes a blob of an attempt; if the job is durable, the blob is on disk when this returns.
    async fn put(&self, lease: &Lease, blob: Blob, bytes: Vec<u8>) -> Result<(), BlobError> {
        let id = lease.job.id;
        let promised = lease.heartbeat.is_durable();
        let sync = if promised { Fsync::Yes } else { Fsync::No };
        self.blobs.put(id, blob, Bytes::from(bytes), sync).await?;
        if !promised && lease.heartbeat.is_durable() {
            // The job became durable during the write.
            self.blobs.sync(id, blob).await?;
        }
        Ok(())
    }
}

impl Worker {
    /// The outcome of a job whose payload cannot be read.
    pub(super) async fn unreadable(&self, error: &StoreError) -> Outcome {
        tracing::error!(%error, "the payload cannot be read");
        let fault = match error {
            StoreError::Blob(error) => error.fault(),
            StoreError::Queue(error) if error.is_of_the_machine() => Fault::Machine,
            // A worker of a newer version may know them.
            StoreError::Options(_) => return Outcome::Failed(failure("store", error, true)),
            _ => return Outcome::Failed(failure("store", error, false)),
        };
        self.store_failed(fault, 0, error).await
    }

    /// The outcome of a job after a storage failure. If the store probe fails too, the job is
    /// released, and no attempt is counted. If the store works otherwise, the job is delayed behind the others;
    /// if a blob is missing, the attempt has failed.
    async fn store_failed(
        &self,
        fault: Fault,
        needed: u64,
        error: &(dyn std::error::Error + Sync),
    ) -> Outcome {
        if fault == Fault::Full {
            self.store.health().needs(needed);
        }
        if !self.store.ask().await {
            return Outcome::Released;
        }
        let error = failure("store", error, true);
        match fault {
            Fault::Missing => Outcome::Failed(error),
            Fault::Full | Fault::Machine => Outcome::Delayed(error),
        }
    }
}
