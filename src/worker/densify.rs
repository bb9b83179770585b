//! The closing job of a sequence: reads its sweeps and fields from the store, and computes one
//! dense cloud.
//!
//! Independent of how fields are fitted and how points are advected.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use super::control::DenseControl;
use super::load::StoreError;
use super::run::{Attempt, Done, Output, Worker, alive};
use crate::engine::{Densification, Densified, EngineError};
use crate::flow::densify::Plan;
use crate::flow::{Control, FlowError, Sweep};
use crate::job::{DenseReport, Densify, Job, JobOptions};
use crate::payload::{CorruptPayload, StoredCloud, StoredDense};
use crate::queue::Lease;
use crate::storage::Blob;

/// Why the input of a densification could not be prepared.
enum Unprepared {
    /// The job was cancelled or released.
    Interrupted,
    Store(StoreError),
}

impl<E: Into<StoreError>> From<E> for Unprepared {
    fn from(error: E) -> Self {
        Self::Store(error.into())
    }
}

impl Worker {
    /// Densifies a sequence and returns how the attempt ended.
    pub(super) async fn densify(&self, lease: &Lease) -> Attempt {
        let control = Arc::new(DenseControl::new(
            lease.heartbeat.clone(),
            self.drain.release.clone(),
        ));
        let preparing = self.prepare_sweeps(&lease.job, control);
        let (work, asked) = match alive(lease, preparing).await {
            Ok(prepared) => prepared,
            Err(Unprepared::Interrupted) => return self.interrupted(lease),
            Err(Unprepared::Store(error)) => {
                return Attempt::Ended(alive(lease, self.unreadable(&error)).await);
            }
        };
        let (began, sweeps) = (Instant::now(), work.sweeps.len());
        match self.lane.densify(work).await {
            Ok(Densified { cloud, device }) => {
                let report = DenseReport {
                    points: cloud.points.len(),
                    sweeps,
                    reference_time: asked.reference_time,
                    substeps: asked.substeps,
                    device,
                    seconds: began.elapsed().as_secs_f64(),
                };
                tracing::info!(
                    seconds = report.seconds,
                    points = report.points,
                    "densified"
                );
                Attempt::Done(Box::new(Done {
                    stop_reason: None,
                    progress: None,
                    report: serde_json::to_string(&report),
                    field: None,
                    result: Output::Cloud(StoredDense(cloud)),
                }))
            }
            Err(EngineError::Flow(FlowError::Cancelled)) => self.interrupted(lease),
            Err(error) => self.failed(&lease.job, &error),
        }
    }

    /// Reads all sweeps and the fields of the plan, with a heartbeat for each.
    async fn prepare_sweeps(
        &self,
        job: &Job,
        control: Arc<DenseControl>,
    ) -> Result<(Densification, Densify), Unprepared> {
        let options = JobOptions::from_json(job.options.as_bytes())?;
        let asked = options.densify.ok_or(StoreError::NoPlan)?;
        let pairs = self.queue.pairs(job.id).await?;
        let count = 1 + pairs.iter().filter(|pair| !pair.backward).count();
        let plan: Plan = asked.plan(count).map_err(|_| StoreError::NoPlan)?;
        let go_on = || match control.interrupt() {
            None => Ok(()),
            Some(_) => Err(Unprepared::Interrupted),
        };
        let solver_options = Arc::new(options.solver_options(usize::MAX));
        let mut sweeps = Vec::with_capacity(count);
        for index in (0u32..).take(count) {
            go_on()?;
            let bytes = self.blobs.get(job.id, Blob::Sweep(index)).await?;
            let solver_options = Arc::clone(&solver_options);
            let read = move || {
                let StoredCloud { points, ground, .. } = StoredCloud::from_bytes(&bytes)?;
                let sweep = Sweep {
                    points,
                    ground,
                    ..Sweep::default()
                }
                .prepared(&solver_options);
                Ok::<_, CorruptPayload>(sweep.cropped(&solver_options))
            };
            let read = tokio::task::spawn_blocking(read).await;
            sweeps.push(read??);
        }
        let mut fields = HashMap::new();
        for edge in plan.edges() {
            go_on()?;
            let of_edge = |pair: &&Arc<Job>| {
                let (_, [source, target]) = pair.sweeps();
                (source as usize, target as usize) == (edge.source, edge.target)
            };
            let pair = pairs.iter().find(of_edge).ok_or(StoreError::NoPlan)?;
            fields.insert(edge, self.field(pair).await?);
        }
        let work = Densification {
            plan,
            sweeps,
            fields,
            control,
        };
        Ok((work, asked))
    }
}
