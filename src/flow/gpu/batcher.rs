//! Submissions: the next iterations of all pairs that are being fitted, as one batch of GPU work.
//!
//! A small pair leaves a large GPU idle, so requests that arrive at about the same time
//! [share](super::sharing) a submission. Pairs stay independent: each has its own model and stopping
//! rule, and its result is bit-identical to that of a fit alone.

use core::ops::ControlFlow;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::context::Context;
use super::half::Units;
use super::iteration::{Phases, SubmittedModel};
use super::layout::{STEPS, Status};
use super::phase::Clock;
use super::program::{Item, Program, SubmittedLoss};
use super::request::{Request, write};
use super::sharing::{Shared, Submit, Ticketed};
use super::tiling::Plan;
use crate::flow::data::{Control, locked};
use crate::flow::field::BackendError;

/// The result of a request.
#[derive(Clone, Debug)]
pub(super) struct Done {
    pub(super) status: Status,
    /// Mean loss of each completed iteration, metres.
    pub(super) losses: Vec<f32>,
    /// Speed of the submission; none if the GPU has no timestamps.
    pub(super) pace: Option<TileThroughput>,
}

/// Speed of a submission's first iteration, by GPU timestamps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TileThroughput {
    /// Seconds of one iteration of all pairs in the submission.
    pub(super) iteration: f64,
    /// Seconds per tile: of the whole iteration, and of its distance query.
    pub(super) tile: f64,
    pub(super) tile_query: f64,
}

/// The queue of requests for iterations.
#[derive(Default)]
pub(super) struct Batch {
    shared: Shared<Request, Done>,
    /// Number of networks that are being fitted.
    members: AtomicUsize,
    /// Speed of the latest submission of a kind that shares it.
    pace: Mutex<Option<TileThroughput>>,
}

impl Batch {
    /// Registers a network that is being fitted.
    pub(super) fn joined(&self) {
        self.members.fetch_add(1, Ordering::Relaxed);
    }

    /// Unregisters a network whose fit has ended.
    pub(super) fn left(&self) {
        self.members.fetch_sub(1, Ordering::Relaxed);
        self.shared.expect_fewer();
    }

    /// Speed of the latest submission of a kind that shares it.
    pub(super) fn pace(&self) -> Option<TileThroughput> {
        *locked(&self.pace)
    }

    /// Runs the request's iterations, together with those that other threads request meanwhile. Asks
    /// `control` while it waits, which also shows that the pair is alive.
    ///
    /// # Errors
    /// [`BackendError::Interrupted`] if the control interrupts before the iterations are submitted.
    /// [`BackendError`] if the GPU fails.
    pub(super) fn run<'u>(
        &self,
        context: &Context,
        units: &dyn Fn() -> Result<&'u Units, BackendError>,
        request: Request,
        control: &dyn Control,
    ) -> Result<Done, BackendError> {
        let iterations = Iterations {
            batch: self,
            context,
            units,
            control,
        };
        let is_over = || control.interrupt();
        let watchdog = &context.watchdog;
        match self.shared.run(watchdog, request, &iterations, &is_over)? {
            ControlFlow::Continue(done) => Ok(done),
            ControlFlow::Break(interrupt) => Err(BackendError::Interrupted(interrupt)),
        }
    }
}

/// The iterations of networks or linear models, submitted by a thread with its control.
struct Iterations<'a, 'u> {
    batch: &'a Batch,
    context: &'a Context,
    units: &'a dyn Fn() -> Result<&'u Units, BackendError>,
    control: &'a dyn Control,
}

impl Submit<Request, Done> for Iterations<'_, '_> {
    fn expects_more(&self, waiting: &[Ticketed<Request>]) -> bool {
        let shares = |(_, request): &&Ticketed<Request>| request.kind().shares_submissions();
        waiting.iter().filter(shares).count() < self.batch.members.load(Ordering::Relaxed)
    }

    /// Takes the first request and the others of its kind in order of arrival, up to the capacity of
    /// the GPU. The rest remains in the queue.
    fn take(&self, waiting: &mut Vec<Ticketed<Request>>) -> Vec<Ticketed<Request>> {
        let budget = &self.context.budget;
        let kind = waiting.first().map(|(_, request)| request.kind());
        let mut chunks = 0;
        let mut fitting = 0;
        let mut full = false;
        let taken = waiting.extract_if(.., |(_, request)| {
            let alone = !request.kind().shares_submissions() && fitting > 0;
            if full || alone || Some(request.kind()) != kind {
                return false;
            }
            chunks += request.cut.chunks.count as u64;
            full = fitting > 0 && (chunks > budget.chunks || fitting as u64 >= budget.lanes);
            fitting += usize::from(!full);
            !full
        });
        taken.collect()
    }

    fn submit(&self, requests: &[&Request]) -> Result<Vec<Done>, BackendError> {
        let done = submit(self.context, self.units, requests, self.control)?;
        if requests[0].kind().shares_pace()
            && let Some(pace) = done.first().and_then(|done| done.pace)
        {
            *locked(&self.batch.pace) = Some(pace);
        }
        Ok(done)
    }
}

/// Timestamps of a submission: begin of the first iteration, begin and end of its first query, and
/// end of the first iteration.
const MOMENTS: u32 = 4;

/// Runs the iterations of all requests in one submission. A lane with fewer iterations than others
/// idles for the rest. `control` is that of the submitting thread.
fn submit<'u>(
    context: &Context,
    units: &dyn Fn() -> Result<&'u Units, BackendError>,
    requests: &[&Request],
    control: &dyn Control,
) -> Result<Vec<Done>, BackendError> {
    let iterations = requests.iter().map(|request| request.steps.len());
    let iterations = iterations.max().unwrap_or(0);
    let cuts: Vec<_> = requests.iter().map(|request| request.cut).collect();
    let Some(first) = requests.first() else {
        return Ok(Vec::new());
    };
    let model = SubmittedModel::of(&first.model, units)?;
    let rows = match model {
        // Its buffers hold all rows.
        SubmittedModel::Linear(_) => usize::MAX,
        _ => context.budget.rows as usize,
    };
    let loss = SubmittedLoss::of(requests);
    let plan = Plan::new(&cuts, rows);
    let program = Program::new(&plan, loss, context.most_distances);
    write(context, &context.buffers, requests)?;
    let lanes = requests.len();
    let phases = Phases::bind(context, &context.buffers, &plan, lanes, model, loss)?;
    let clock = Clock::new(context, MOMENTS)?;

    let mut encoder = context.encoder();
    for step in 0..iterations {
        let clock = clock.as_ref().filter(|_| step == 0);
        iterate(&mut encoder, &phases, &program, step, clock, control)?;
    }
    let status_bytes = (requests.len() * size_of::<Status>()) as u64;
    let loss_bytes = (requests.len() * STEPS * size_of::<f32>()) as u64;
    let bytes = status_bytes + loss_bytes + u64::from(MOMENTS) * 8;
    let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
    let results = context.empty(bytes, usage)?;
    let (statuses, losses) = (&context.buffers.statuses, &context.buffers.losses);
    encoder.copy_buffer_to_buffer(statuses, 0, &results, 0, status_bytes);
    encoder.copy_buffer_to_buffer(losses, 0, &results, status_bytes, loss_bytes);
    if let Some(clock) = &clock {
        clock.resolve(&mut encoder, &results, status_bytes + loss_bytes);
    }
    let read = context.finish(encoder, &results, bytes)?;

    let (statuses, rest) = read.split_at(status_bytes as usize);
    let (losses, moments) = rest.split_at(loss_bytes as usize);
    let pace = clock.and_then(|clock| {
        let iteration = clock.seconds(moments, 0, 3)?;
        let query = clock.seconds(moments, 1, 2).unwrap_or(0.0) / program.query_share;
        let tiles = plan.tiles.len() as f64;
        Some(TileThroughput {
            iteration,
            tile: iteration / tiles,
            tile_query: query.min(iteration) / tiles,
        })
    });
    let statuses = statuses.chunks_exact(size_of::<Status>());
    let losses = losses.chunks_exact(STEPS * size_of::<f32>());
    let each = requests.iter().zip(statuses).zip(losses);
    Ok(each
        .map(|((request, status), losses)| {
            let status: Status = bytemuck::pod_read_unaligned(status);
            let done = (status.iterations - request.status.iterations) as usize;
            let losses = losses.as_chunks::<4>().0.iter().take(done);
            Done {
                status,
                losses: losses.map(|&bytes| f32::from_ne_bytes(bytes)).collect(),
                pace,
            }
        })
        .collect())
}

/// One iteration of all lanes. A timed iteration is split into several passes, because timestamps
/// are taken at the boundaries of passes. A long one is split into several submissions to the driver.
/// The control is asked after each of them only to show that the pair is alive: others share the
/// iteration, which is always done as a whole.
fn iterate(
    encoder: &mut wgpu::CommandEncoder,
    phases: &Phases<'_>,
    program: &Program,
    step: usize,
    clock: Option<&Clock>,
    control: &dyn Control,
) -> Result<(), BackendError> {
    let run = |pass: &mut wgpu::ComputePass<'_>, items: &[Item]| {
        for (phase, wave) in items {
            phases.dispatch(pass, *phase, step, wave);
        }
    };
    let untimed = wgpu::ComputePassDescriptor::default();
    if clock.is_none() && program.is_whole {
        let mut pass = encoder.begin_compute_pass(&untimed);
        let groups = program.parts().into_iter().flatten();
        groups.for_each(|items| run(&mut pass, items));
        return Ok(());
    }
    let moments = [(Some(0), None), (Some(1), Some(2)), (None, Some(3))];
    for (groups, (begin, end)) in program.parts().into_iter().zip(moments) {
        for (number, items) in groups.iter().enumerate() {
            let is_last = number + 1 == groups.len();
            let (begin, end) = (begin.filter(|_| number == 0), end.filter(|_| is_last));
            {
                let timed = clock.filter(|_| begin.is_some() || end.is_some());
                let mut pass = match timed {
                    Some(clock) => clock.pass(encoder, begin, end),
                    None => encoder.begin_compute_pass(&untimed),
                };
                run(&mut pass, items);
            }
            if !program.is_whole {
                phases.context.flush(encoder)?;
                let _looked_at_between_iterations = control.interrupt();
            }
        }
    }
    Ok(())
}
