//! Submissions: the next iterations of every pair that is being fitted, together.
//!
//! Small pairs leave a large card idle, so whoever wants iterations joins those who do at the same
//! moment; one of them submits for all. Pairs stay independent: each has its own network, stopping
//! rule and bits. Knows records and kernels, neither points nor options.

use core::time::Duration;
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::device::{Card, spread};
use super::memory::LEAST_CHUNKS;
use super::plan::{Cut, Plan, Wave};
use super::records::{Lane, Part, STEPS, Status, Step};
use crate::flow::backend::BackendError;
use crate::flow::field::mlp::{LAID_OUT, MIDDLE_LAYERS};

/// How long the one who submits waits for others that are about to join.
const MOMENT: Duration = Duration::from_micros(300);

/// The next iterations of one pair.
#[derive(Clone, Debug)]
pub(super) struct Request {
    pub(super) lane: Lane,
    pub(super) status: Status,
    /// One for each iteration that is wanted, at most [`STEPS`]; fewer may be done.
    pub(super) steps: Vec<Step>,
    pub(super) cut: Cut,
}

/// What became of a request.
#[derive(Clone, Debug)]
pub(super) struct Done {
    pub(super) status: Status,
    /// The mean loss of each iteration that was done, metres.
    pub(super) losses: Vec<f32>,
    /// Seconds of the card that one iteration of the submission took, and the share of them that
    /// went into distance queries; none where the card shows no clock.
    pub(super) pace: Option<Pace>,
}

/// How fast a submission's iterations were.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pace {
    pub(super) iteration_seconds: f64,
    pub(super) query_share: f64,
    /// Pairs that shared the submission.
    pub(super) pairs: usize,
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
}

impl Batch {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// One more pair is being fitted.
    pub(super) fn joined(&self) {
        self.state().members += 1;
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
                    let tickets = taken.iter().map(|(ticket, _)| *ticket);
                    state.done.extend(tickets.zip(all.into_iter().map(Ok)));
                }
                Err(error) => {
                    let text = error.to_string();
                    for (other, _) in &taken {
                        let lost = card.watchdog.check().err();
                        let own = lost.unwrap_or_else(|| BackendError::Device(text.clone()));
                        state.done.insert(*other, Err(own));
                    }
                }
            }
            self.changed.notify_all();
        }
    }
}

impl State {
    /// Takes requests in the order of their arrival, as many as the card has room for.
    fn take(&mut self, card: &Card) -> Vec<(u64, Request)> {
        let mut chunks = 0;
        let mut fitting = 0;
        for (_, request) in &self.waiting {
            chunks += request.cut.chunks as u64;
            if fitting > 0 && (chunks > card.budget.chunks || fitting as u64 >= card.budget.lanes) {
                break;
            }
            fitting += 1;
        }
        self.waiting.drain(..fitting).collect()
    }
}

/// The most points that a batch may have: their gradients must fit into the least memory.
pub(super) fn most_batch_points() -> usize {
    LEAST_CHUNKS as usize * super::memory::LEAST_ROWS as usize
}

/// Buffers of the phases' bindings.
struct Bound {
    forward: wgpu::BindGroup,
    query: wgpu::BindGroup,
    backward: wgpu::BindGroup,
    gradients: wgpu::BindGroup,
    judge: wgpu::BindGroup,
    step: wgpu::BindGroup,
    transpose: wgpu::BindGroup,
}

/// Does as many iterations of all requests as each of them wants.
fn submit(card: &Card, requests: &[&Request]) -> Result<Vec<Done>, BackendError> {
    card.watchdog.check()?;
    let iterations = requests.iter().map(|request| request.steps.len());
    let iterations = iterations.min().unwrap_or(0);
    let cuts: Vec<_> = requests.iter().map(|request| request.cut).collect();
    let plan = Plan::new(&cuts, card.budget.rows as usize);
    let bound = write(card, requests, &plan)?;
    let clock = card.tick.map(|_| Clock::new(card));

    let mut encoder = card.encoder();
    for step in 0..iterations {
        let timed = clock.as_ref().filter(|_| step == 0);
        encode(card, &mut encoder, &bound, &plan, step, requests.len(), timed);
    }
    let (statuses, losses) = (&card.buffers.statuses, &card.buffers.losses);
    let status_bytes = (requests.len() * size_of::<Status>()) as u64;
    let loss_bytes = (requests.len() * STEPS * size_of::<f32>()) as u64;
    let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
    let results = card.empty(status_bytes + loss_bytes + Clock::BYTES, usage)?;
    encoder.copy_buffer_to_buffer(statuses, 0, &results, 0, status_bytes);
    encoder.copy_buffer_to_buffer(losses, 0, &results, status_bytes, loss_bytes);
    if let Some(clock) = &clock {
        clock.resolve(&mut encoder, &results, status_bytes + loss_bytes);
    }
    let read = card.finish(encoder, &results, status_bytes + loss_bytes + Clock::BYTES)?;

    let (statuses, rest) = read.split_at(status_bytes as usize);
    let (losses, ticks) = rest.split_at(loss_bytes as usize);
    let first_wave = plan.waves[0].tiles as f64 / plan.tiles.len() as f64;
    let pace = card.tick.map(|tick| Clock::pace(ticks, tick, first_wave, requests.len()));
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

/// Writes what the kernels read, and binds it.
fn write(card: &Card, requests: &[&Request], plan: &Plan) -> Result<Bound, BackendError> {
    let buffers = &card.buffers;
    let (mut first_tile, mut first_chunk) = (0, 0);
    let mut lanes = Vec::new();
    let mut steps = vec![Step::default(); requests.len() * STEPS];
    for (index, request) in requests.iter().enumerate() {
        lanes.push(Lane {
            first_tile: first_tile as u32,
            tiles: request.cut.tiles as u32,
            first_chunk: first_chunk as u32,
            chunks: request.cut.chunks as u32,
            ..request.lane
        });
        first_tile += request.cut.tiles;
        first_chunk += request.cut.chunks;
        steps[index * STEPS..][..request.steps.len()].copy_from_slice(&request.steps);
    }
    let statuses: Vec<_> = requests.iter().map(|request| request.status).collect();
    let write = |buffer: &wgpu::Buffer, bytes: &[u8]| card.queue.write_buffer(buffer, 0, bytes);
    write(&buffers.lanes, bytemuck::cast_slice(&lanes));
    write(&buffers.steps, bytemuck::cast_slice(&steps));
    write(&buffers.statuses, bytemuck::cast_slice(&statuses));
    let tiles = card.filled(bytemuck::cast_slice(&plan.tiles))?;
    let chunks = card.filled(bytemuck::cast_slice(&plan.chunks))?;
    let storage = wgpu::BufferUsages::STORAGE;
    let tile_losses = card.empty(plan.tiles.len() as u64 * 4, storage)?;

    let (points, networks, lanes) = (&buffers.store, &buffers.networks, &buffers.lanes);
    let (steps, statuses) = (&buffers.steps, &buffers.statuses);
    let (flows, pulls, partials) = (&buffers.flows, &buffers.pulls, &buffers.partials);
    let (activations, deltas) = (&buffers.activations, &buffers.deltas);
    let kernels = &card.kernels;
    let bind = |pipeline, buffers: &[&wgpu::Buffer]| card.bound(pipeline, buffers);
    Ok(Bound {
        forward: bind(
            &kernels.forward,
            &[points, networks, lanes, steps, &tiles, statuses, flows, activations],
        ),
        query: bind(
            &kernels.query,
            &[points, lanes, steps, &tiles, statuses, flows, pulls, &tile_losses],
        ),
        backward: bind(
            &kernels.backward,
            &[networks, &tiles, statuses, pulls, activations, lanes, deltas],
        ),
        gradients: bind(
            &kernels.gradients,
            &[points, lanes, steps, &chunks, statuses, activations, deltas, pulls, partials],
        ),
        judge: bind(
            &kernels.judge,
            &[lanes, steps, &tile_losses, statuses, &buffers.losses],
        ),
        step: bind(
            &kernels.step,
            &[lanes, steps, statuses, partials, networks],
        ),
        transpose: bind(&kernels.transpose, &[statuses, lanes, networks]),
    })
}

/// One iteration of all lanes. A timed one is done in passes, so that the card can tell them apart.
fn encode(
    card: &Card,
    encoder: &mut wgpu::CommandEncoder,
    bound: &Bound,
    plan: &Plan,
    step: usize,
    lanes: usize,
    clock: Option<&Clock>,
) {
    let kernels = &card.kernels;
    let rows = card.budget.rows as u32;
    let part = |wave: &Wave| Part {
        step: step as u32,
        first_tile: wave.first_tile as u32,
        first_chunk: wave.first_chunk as u32,
        tiles: wave.tiles as u32,
        rows,
    };
    let dispatch = |pass: &mut wgpu::ComputePass<'_>,
                    pipeline: &wgpu::ComputePipeline,
                    group: &wgpu::BindGroup,
                    part: Option<Part>,
                    [x, y]: [u32; 2]| {
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, group, &[]);
        if let Some(part) = part {
            pass.set_immediates(0, bytemuck::bytes_of(&part));
        }
        pass.dispatch_workgroups(x, y, 1);
    };
    let forward = |pass: &mut wgpu::ComputePass<'_>, wave: &Wave| {
        let groups = spread(wave.tiles as u32);
        dispatch(pass, &kernels.forward, &bound.forward, Some(part(wave)), groups);
    };
    let query = |pass: &mut wgpu::ComputePass<'_>, wave: &Wave| {
        let groups = spread(wave.tiles as u32);
        dispatch(pass, &kernels.query, &bound.query, Some(part(wave)), groups);
    };
    let backward = |pass: &mut wgpu::ComputePass<'_>, wave: &Wave| {
        let groups = spread(wave.tiles as u32);
        dispatch(pass, &kernels.backward, &bound.backward, Some(part(wave)), groups);
        let layers = MIDDLE_LAYERS as u32 + 2;
        let groups = [wave.chunks as u32, layers];
        dispatch(pass, &kernels.gradients, &bound.gradients, Some(part(wave)), groups);
    };
    let end = |pass: &mut wgpu::ComputePass<'_>| {
        let all = Some(part(&Wave::default()));
        let lanes = lanes as u32;
        dispatch(pass, &kernels.judge, &bound.judge, all, [lanes, 1]);
        let groups = (LAID_OUT as u32 / 4).div_ceil(128);
        dispatch(pass, &kernels.step, &bound.step, all, [groups, lanes]);
        let squares = MIDDLE_LAYERS as u32 * 16;
        dispatch(pass, &kernels.transpose, &bound.transpose, None, [squares, lanes]);
    };
    let (first, rest) = (&plan.waves[0], &plan.waves[1..]);
    if let Some(clock) = clock {
        forward(&mut clock.pass(encoder, Some(0), None), first);
        query(&mut clock.pass(encoder, Some(1), Some(2)), first);
        let mut pass = clock.pass(encoder, None, Some(3));
        backward(&mut pass, first);
        for wave in rest {
            forward(&mut pass, wave);
            query(&mut pass, wave);
            backward(&mut pass, wave);
        }
        end(&mut pass);
        return;
    }
    let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
    for wave in &plan.waves {
        forward(&mut pass, wave);
        query(&mut pass, wave);
        backward(&mut pass, wave);
    }
    end(&mut pass);
}

/// The card's own clock over one iteration: when it began, when the first wave's query began and
/// ended, when it ended.
struct Clock(wgpu::QuerySet, wgpu::Buffer);

impl Clock {
    const TICKS: u32 = 4;
    const BYTES: u64 = Self::TICKS as u64 * 8;

    fn new(card: &Card) -> Self {
        let set = card.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: None,
            ty: wgpu::QueryType::Timestamp,
            count: Self::TICKS,
        });
        let resolved = card.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: Self::BYTES,
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        Self(set, resolved)
    }

    /// A pass whose begin and end are noted in these places.
    fn pass<'a>(
        &self,
        encoder: &'a mut wgpu::CommandEncoder,
        begin: Option<u32>,
        end: Option<u32>,
    ) -> wgpu::ComputePass<'a> {
        encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
            label: None,
            timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
                query_set: &self.0,
                beginning_of_pass_write_index: begin,
                end_of_pass_write_index: end,
            }),
        })
    }

    fn resolve(&self, encoder: &mut wgpu::CommandEncoder, to: &wgpu::Buffer, at: u64) {
        encoder.resolve_query_set(&self.0, 0..Self::TICKS, &self.1, 0);
        encoder.copy_buffer_to_buffer(&self.1, 0, to, at, Self::BYTES);
    }

    /// What the ticks say, where the first wave was this share of the iteration.
    fn pace(ticks: &[u8], tick: f64, first_wave: f64, pairs: usize) -> Pace {
        let ticks = ticks.as_chunks::<8>().0;
        let at = |place: usize| u64::from_ne_bytes(ticks[place]);
        let between = |from, to| at(to).saturating_sub(at(from)) as f64 * tick;
        let iteration = between(0, 3);
        Pace {
            iteration_seconds: iteration,
            query_share: (between(1, 2) / first_wave / iteration.max(1e-12)).min(1.0),
            pairs,
        }
    }
}
