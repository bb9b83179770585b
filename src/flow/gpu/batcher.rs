//! Submissions: the next iterations of every pair that is being fitted, together.
//!
//! Small pairs leave a large card idle, so whoever wants iterations joins those who do at the same
//! moment; one of them submits for all. Pairs stay independent: each has its own network, stopping
//! rule and bits. Knows records and kernels, neither points nor options.

use core::time::Duration;
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::backend::{Buffers, Card};
use super::iteration::{Clock, Phase, Phases};
use super::layout::{Lane, STEPS, Status, Step};
use super::tiling::{Cut, Plan, Wave};
use crate::flow::field::BackendError;
use crate::flow::options::Precision;

/// How long the one who submits waits for others that are about to join.
const MOMENT: Duration = Duration::from_micros(300);

/// The next iterations of one pair.
#[derive(Clone, Debug)]
pub(super) struct Request {
    pub(super) lane: Lane,
    pub(super) status: Status,
    /// One for each iteration that is wanted, at most [`STEPS`].
    pub(super) steps: Vec<Step>,
    pub(super) cut: Cut,
    /// Of everything in one submission: the kernels of one precision know no others.
    pub(super) precision: Precision,
}

/// What became of a request.
#[derive(Clone, Debug)]
pub(super) struct Done {
    pub(super) status: Status,
    /// The mean loss of each iteration that was done, metres.
    pub(super) losses: Vec<f32>,
    /// How fast it went; none where the card shows no clock.
    pub(super) pace: Option<Pace>,
}

/// How fast a submission's first iteration was, by the card's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pace {
    /// Seconds of the iteration, of all pairs that shared it.
    pub(super) iteration: f64,
    /// Seconds of a tile, and those of them in the distance query.
    pub(super) tile: f64,
    pub(super) tile_query: f64,
}

/// Who wants iterations.
#[derive(Default)]
pub(super) struct Batch {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// Pairs that are being fitted.
    members: usize,
    next_ticket: u64,
    waiting: Vec<(u64, Request)>,
    done: HashMap<u64, Result<Done, BackendError>>,
    /// Whether somebody submits at the moment.
    submitting: bool,
    /// The latest submission's.
    pace: Option<Pace>,
}

impl Batch {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// One more pair is being fitted.
    pub(super) fn joined(&self) {
        self.state().members += 1;
    }

    /// How fast the card was last.
    pub(super) fn pace(&self) -> Option<Pace> {
        self.state().pace
    }

    /// A pair is fitted, or given up.
    pub(super) fn left(&self) {
        self.state().members -= 1;
        self.changed.notify_all();
    }

    /// Does the request's iterations, together with what others ask for meanwhile.
    ///
    /// # Errors
    /// [`BackendError`] where the card fails.
    pub(super) fn run(&self, card: &Card, request: Request) -> Result<Done, BackendError> {
        let mut state = self.state();
        let ticket = state.next_ticket;
        state.next_ticket += 1;
        state.waiting.push((ticket, request));
        self.changed.notify_all();
        loop {
            if let Some(done) = state.done.remove(&ticket) {
                return done;
            }
            if state.submitting {
                state = self
                    .changed
                    .wait(state)
                    .unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            state.submitting = true;
            let incomplete = |state: &mut State| state.waiting.len() < state.members;
            state = self
                .changed
                .wait_timeout_while(state, MOMENT, incomplete)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
            let taken = state.take(card);
            drop(state);
            let requests: Vec<_> = taken.iter().map(|(_, request)| request).collect();
            let submitted = catch_unwind(AssertUnwindSafe(|| submit(card, &requests)));
            let submitted = submitted.unwrap_or_else(|_| {
                let reason = "the driver's bindings panicked".to_owned();
                card.watchdog.lost(reason.clone());
                Err(BackendError::Lost(reason))
            });
            state = self.state();
            state.submitting = false;
            match submitted {
                Ok(all) => {
                    state.pace = all.first().and_then(|done| done.pace).or(state.pace);
                    let tickets = taken.iter().map(|(ticket, _)| *ticket);
                    state.done.extend(tickets.zip(all.into_iter().map(Ok)));
                }
                Err(error) => {
                    for (other, _) in &taken {
                        let own = card.watchdog.check().err().unwrap_or(match &error {
                            BackendError::Busy => BackendError::Busy,
                            error => BackendError::Device(error.to_string()),
                        });
                        state.done.insert(*other, Err(own));
                    }
                }
            }
            self.changed.notify_all();
        }
    }
}

impl State {
    /// Takes requests in the order of their arrival, as many of the first one's precision as the
    /// card has room for. The others stay, one of them now the first.
    fn take(&mut self, card: &Card) -> Vec<(u64, Request)> {
        let precision = self.waiting.first().map(|(_, request)| request.precision);
        let mut chunks = 0;
        let mut fitting = 0;
        let mut full = false;
        let taken = self.waiting.extract_if(.., |(_, request)| {
            if full || Some(request.precision) != precision {
                return false;
            }
            chunks += request.cut.chunks.count as u64;
            full =
                fitting > 0 && (chunks > card.budget.chunks || fitting as u64 >= card.budget.lanes);
            fitting += usize::from(!full);
            !full
        });
        taken.collect()
    }
}

/// Moments of a submission's clock: when its first iteration began, when that one's first query
/// began and ended, and when it ended itself.
const MOMENTS: u32 = 4;

/// Does the iterations of all requests; who wants fewer than others rests meanwhile.
fn submit(card: &Card, requests: &[&Request]) -> Result<Vec<Done>, BackendError> {
    card.watchdog.check()?;
    let iterations = requests.iter().map(|request| request.steps.len());
    let iterations = iterations.max().unwrap_or(0);
    let cuts: Vec<_> = requests.iter().map(|request| request.cut).collect();
    let plan = Plan::new(&cuts, card.budget.rows as usize);
    write(card, &card.buffers, requests);
    let precision = requests.first().map(|request| request.precision);
    let units = match precision.unwrap_or_default() {
        Precision::F32 => None,
        Precision::F16 => Some(card.units()?),
    };
    let phases = Phases::bind(card, &card.buffers, &plan, requests.len(), units)?;
    let clock = Clock::new(card, MOMENTS);

    let mut encoder = card.encoder();
    for step in 0..iterations {
        let clock = clock.as_ref().filter(|_| step == 0);
        iterate(&mut encoder, &phases, &plan, step, clock);
    }
    let status_bytes = (requests.len() * size_of::<Status>()) as u64;
    let loss_bytes = (requests.len() * STEPS * size_of::<f32>()) as u64;
    let bytes = status_bytes + loss_bytes + u64::from(MOMENTS) * 8;
    let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
    let results = card.empty(bytes, usage)?;
    let (statuses, losses) = (&card.buffers.statuses, &card.buffers.losses);
    encoder.copy_buffer_to_buffer(statuses, 0, &results, 0, status_bytes);
    encoder.copy_buffer_to_buffer(losses, 0, &results, status_bytes, loss_bytes);
    if let Some(clock) = &clock {
        clock.resolve(&mut encoder, &results, status_bytes + loss_bytes);
    }
    let read = card.finish(encoder, &results, bytes)?;

    let (statuses, rest) = read.split_at(status_bytes as usize);
    let (losses, moments) = rest.split_at(loss_bytes as usize);
    let first_wave = plan.waves[0].tiles as f64 / plan.tiles.len() as f64;
    let pace = clock.map(|clock| {
        let iteration = clock.seconds(moments, 0, 3);
        let query = (clock.seconds(moments, 1, 2) / first_wave).min(iteration);
        let tiles = plan.tiles.len() as f64;
        Pace {
            iteration,
            tile: iteration / tiles,
            tile_query: query / tiles,
        }
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

/// Writes what the kernels read of each request.
pub(super) fn write(card: &Card, buffers: &Buffers, requests: &[&Request]) {
    let (mut first_tile, mut first_chunk) = (0, 0);
    let mut lanes = Vec::new();
    let mut steps = vec![Step::default(); requests.len() * STEPS];
    for (index, request) in requests.iter().enumerate() {
        lanes.push(Lane {
            first_tile: first_tile as u32,
            tiles: request.cut.tiles as u32,
            first_chunk: first_chunk as u32,
            chunks: request.cut.chunks.count as u32,
            steps: request.steps.len() as u32,
            ..request.lane
        });
        first_tile += request.cut.tiles;
        first_chunk += request.cut.chunks.count;
        steps[index * STEPS..][..request.steps.len()].copy_from_slice(&request.steps);
    }
    let statuses: Vec<_> = requests.iter().map(|request| request.status).collect();
    let write = |buffer: &wgpu::Buffer, bytes: &[u8]| card.queue.write_buffer(buffer, 0, bytes);
    write(&buffers.lanes, bytemuck::cast_slice(&lanes));
    write(&buffers.steps, bytemuck::cast_slice(&steps));
    write(&buffers.statuses, bytemuck::cast_slice(&statuses));
}

/// One iteration of all lanes. A timed one is done in passes, so that the card can tell them apart.
fn iterate(
    encoder: &mut wgpu::CommandEncoder,
    phases: &Phases<'_>,
    plan: &Plan,
    step: usize,
    clock: Option<&Clock>,
) {
    let (first, rest) = (&plan.waves[0], &plan.waves[1..]);
    let mut pass = match clock {
        None => {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            phases.dispatch(&mut pass, Phase::Halve, step, first);
            phases.dispatch(&mut pass, Phase::Forward, step, first);
            phases.dispatch(&mut pass, Phase::Query, step, first);
            pass
        }
        Some(clock) => {
            let mut pass = clock.pass(encoder, Some(0), None);
            phases.dispatch(&mut pass, Phase::Halve, step, first);
            phases.dispatch(&mut pass, Phase::Forward, step, first);
            drop(pass);
            let mut pass = clock.pass(encoder, Some(1), Some(2));
            phases.dispatch(&mut pass, Phase::Query, step, first);
            drop(pass);
            clock.pass(encoder, None, Some(3))
        }
    };
    phases.dispatch(&mut pass, Phase::Backward, step, first);
    phases.dispatch(&mut pass, Phase::Gradients, step, first);
    for wave in rest {
        for phase in Phase::OF_A_WAVE {
            phases.dispatch(&mut pass, phase, step, wave);
        }
    }
    for phase in Phase::OF_THE_END {
        phases.dispatch(&mut pass, phase, step, &Wave::default());
    }
}
