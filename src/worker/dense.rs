//! The dense cloud of a sequence whose pairs have all succeeded: sweeps and fields from the store,
//! one cloud back into it.
//!
//! It must not know how fields are fitted, nor how points are carried.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use super::inputs::StoreError;
use super::job_watch::DenseWatch;
use super::{Attempt, Densification, Done, EngineError, Found, Solved, Worker, unreadable};
use crate::blobs::Blob;
use crate::flow::densify::Plan;
use crate::flow::ground::{GroundOptions, segment};
use crate::flow::{FlowError, Ground, Sweep, Watch};
use crate::job::{DenseReport, Densify, Job, JobOptions};
use crate::payload::{StoredCloud, StoredDense};
use crate::queue::Lease;

/// Why there is nothing to carry.
enum Unprepared {
    /// Its end was asked for.
    Interrupted,
    Store(StoreError),
}

impl<E: Into<StoreError>> From<E> for Unprepared {
    fn from(error: E) -> Self {
        Self::Store(error.into())
    }
}

impl Worker {
    /// Carries a sequence's sweeps into one frame; says how that ended.
    #[tracing::instrument(
        name = "densify",
        skip_all,
        fields(job = %lease.job.id, attempt = lease.job.attempt, device = self.lane.device().name())
    )]
    pub(super) async fn densify(&self, lease: &Lease) -> Attempt {
        let watch = Arc::new(DenseWatch::new(
            lease.pulse.clone(),
            self.drain.release.clone(),
        ));
        let (work, asked) = match self.prepare_sweeps(&lease.job, watch).await {
            Ok(prepared) => prepared,
            Err(Unprepared::Interrupted) => return self.interrupted(lease),
            Err(Unprepared::Store(error)) => return unreadable(&error),
        };
        let (began, frames) = (Instant::now(), work.sweeps.len());
        match self.lane.densify(work).await {
            Ok(Solved {
                found: cloud,
                device,
            }) => {
                let report = DenseReport {
                    points: cloud.points.len(),
                    frames,
                    into: asked.into,
                    substeps: asked.substeps,
                    device,
                    seconds: began.elapsed().as_secs_f64(),
                };
                tracing::info!(
                    seconds = report.seconds,
                    points = report.points,
                    "carried into one frame"
                );
                Attempt::Done(Box::new(Done {
                    stop_reason: None,
                    progress: None,
                    report: serde_json::to_string(&report),
                    field: None,
                    result: Found::Cloud(StoredDense(cloud)),
                }))
            }
            Err(EngineError::Flow(FlowError::Cancelled)) => self.interrupted(lease),
            Err(error) => self.failed(&lease.job, &error),
        }
    }

    /// Reads all sweeps and the fields of the plan, with a sign of life for each.
    async fn prepare_sweeps(
        &self,
        job: &Job,
        watch: Arc<DenseWatch>,
    ) -> Result<(Densification, Densify), Unprepared> {
        let options = JobOptions::from_json(job.options.as_bytes())?;
        let asked = options.densify.ok_or(StoreError::NoPlan)?;
        let pairs = self.queue.pairs(job.id).await?;
        let frames = 1 + pairs.iter().filter(|pair| !pair.backward).count();
        let plan: Plan = asked.plan(frames).map_err(|_| StoreError::NoPlan)?;
        let go_on = || match watch.interrupt() {
            None => Ok(()),
            Some(_) => Err(Unprepared::Interrupted),
        };
        let ground = options.solver_options(usize::MAX).ground;
        let mut sweeps = Vec::with_capacity(frames);
        for place in (0u32..).take(frames) {
            go_on()?;
            let bytes = self.blobs.get(job.id, Blob::Frame(place)).await?;
            let read = move || StoredCloud::from_bytes(&bytes).map(|cloud| sweep(cloud, ground));
            let read = tokio::task::spawn_blocking(read).await;
            sweeps.push(read??);
        }
        let mut fields = HashMap::new();
        for leg in plan.legs() {
            go_on()?;
            let of_leg = |pair: &&Arc<Job>| {
                let (_, [source, target]) = pair.sweeps();
                (source as usize, target as usize) == (leg.source, leg.target)
            };
            let pair = pairs.iter().find(of_leg).ok_or(StoreError::NoPlan)?;
            fields.insert(leg, self.field(pair).await?);
        }
        let work = Densification {
            plan,
            sweeps,
            fields,
            watch,
        };
        Ok((work, asked))
    }
}

/// A sweep with what of it never moves of itself, where that is known or to be found.
fn sweep(cloud: StoredCloud, ground: Ground) -> Sweep {
    let ground = match ground {
        Ground::Keep => None,
        Ground::Mask => cloud.ground,
        Ground::Auto => Some(cloud.ground.clone().unwrap_or_else(|| ground_of(&cloud))),
    };
    Sweep {
        points: cloud.points,
        ground,
    }
}

/// Ground is found among the points that are finite; the others are left out anyway.
fn ground_of(cloud: &StoredCloud) -> Vec<bool> {
    let is_finite = |row: &usize| cloud.points[*row].iter().all(|value| value.is_finite());
    let rows: Vec<usize> = (0..cloud.points.len()).filter(is_finite).collect();
    let points: Vec<_> = rows.iter().map(|&row| cloud.points[row]).collect();
    let mut ground = vec![false; cloud.points.len()];
    let found = segment(&points, &GroundOptions::default()).ground;
    for (row, found) in rows.into_iter().zip(found) {
        ground[row] = found;
    }
    ground
}
