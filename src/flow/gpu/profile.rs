//! Measured amounts of work: every kernel of an iteration by the card's own clock, and the card's
//! arithmetic peak. For benchmarks and `fnsf doctor`.

use super::backend::{Gpu, spread};
use super::batcher::{Request, write};
use super::distance;
use super::iteration::{Clock, Phase, Phases};
use super::layout::{Lane, Status, Step};
use super::tiling::{Cut, Plan};
use crate::flow::data::{Point, Uncontrolled};
use crate::flow::distance::DistanceOptions;
use crate::flow::field::{BackendError, MIDDLE_LAYERS, Schedule, WIDTH};
use crate::flow::options::{Options, Precision, Preset};

/// Floating-point operations of a point's forward pass.
const FORWARD: f64 = 2.0 * (3 * WIDTH + MIDDLE_LAYERS * WIDTH * WIDTH + 3 * WIDTH) as f64;
/// Of the way back through all layers but the first.
const BACKWARD: f64 = FORWARD - 2.0 * (3 * WIDTH) as f64;

/// What one kernel takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KernelTime {
    /// The kernel.
    pub name: &'static str,
    /// Seconds by the card's clock, the least of all rounds.
    pub seconds: f64,
    /// Floating-point operations; zero of a kernel that is bound by memory.
    pub operations: f64,
}

/// Times each kernel of an iteration over all of `source` in one precision, `rounds` times.
///
/// # Errors
/// [`BackendError`] where the pair does not fit at once, or the card shows no clock.
pub fn kernel_times(
    gpu: &Gpu,
    source: &[Point],
    target: &[Point],
    precision: Precision,
    rounds: usize,
) -> Result<Vec<KernelTime>, BackendError> {
    let card = gpu.card();
    let cut = Cut::new(source.len());
    let plan = Plan::new(&[cut], card.budget.rows as usize);
    let [wave] = plan.waves.as_slice() else {
        let text = "the kernels are timed on what fits into the card's memory at once";
        return Err(BackendError::Unsupported(text));
    };
    let built = distance::build(
        card,
        source,
        target,
        &DistanceOptions::default(),
        &Uncontrolled,
    )?;
    let options = Options {
        precision,
        // The same iteration again and again is no progress, and no reason to stop.
        early_stop: None,
        ..Preset::Paper.options(None)
    };
    let (course, _) = Schedule::new(source, &options);
    // The trainer's network is at its start, and stays there: its rate is zero.
    let trainer = super::trainer::GpuTrainer::new(&built, source, &options)?;
    let adam = course.adam(0);
    let request = Request {
        lane: Lane {
            tiles: cut.tiles as u32,
            chunks: cut.chunks.count as u32,
            ..trainer.lane()
        },
        status: Status::default(),
        steps: vec![Step {
            first: 0,
            count: source.len() as u32,
            weight: 1.0 / source.len() as f32,
            step_size: 0.0,
            square_correction: adam.square_correction,
            fresh: 1.0,
        }],
        cut,
        precision,
    };
    write(card, &card.buffers, &[&request]);
    let units = match precision {
        Precision::F32 => None,
        Precision::F16 => Some(card.units()?),
    };
    let phases = Phases::bind(card, &card.buffers, &plan, 1, units)?;
    let points = source.len() as f64;
    let kernels = [
        ("forward", Phase::Forward, points * FORWARD),
        ("query", Phase::Query, 0.0),
        ("backward", Phase::Backward, points * BACKWARD),
        ("gradients", Phase::Gradients, points * FORWARD),
        ("judge", Phase::Judge, 0.0),
        ("step", Phase::Step, 0.0),
        match precision {
            Precision::F32 => ("transpose", Phase::Transpose, 0.0),
            Precision::F16 => ("halve", Phase::Halve, 0.0),
        },
    ];
    let mut times = kernels.map(|(name, _, operations)| KernelTime {
        name,
        seconds: f64::INFINITY,
        operations,
    });
    for _ in 0..rounds.max(1) {
        let clock = clock(gpu, 2 * kernels.len() as u32)?;
        let mut encoder = card.encoder();
        for (place, (_, phase, _)) in (0..).zip(kernels) {
            let mut pass = clock.pass(&mut encoder, Some(2 * place), Some(2 * place + 1));
            phases.dispatch(&mut pass, phase, 0, wave);
        }
        let moments = read(gpu, encoder, &clock, 2 * kernels.len() as u64)?;
        for (place, time) in times.iter_mut().enumerate() {
            let seconds = clock.seconds(&moments, 2 * place, 2 * place + 1);
            time.seconds = time.seconds.min(seconds);
        }
    }
    Ok(times.to_vec())
}

/// Floating-point operations a second that the card does at most, by independent multiply-adds.
///
/// # Errors
/// [`BackendError`] where the card fails or shows no clock.
pub fn arithmetic_peak(gpu: &Gpu) -> Result<f64, BackendError> {
    /// Invocations, of eight chains of 512 multiply-adds of vec4s each: see `multiply_adds.wgsl`.
    const GROUPS: u32 = 4096;
    const GROUP: f64 = 128.0;
    const OPERATIONS: f64 = 8.0 * 512.0 * 4.0 * 2.0;
    let card = gpu.card();
    let factors = card.filled(bytemuck::cast_slice(&[[0.999f32; 4], [0.001; 4], [1.0; 4]]))?;
    let sums = card.empty(1 << 20, wgpu::BufferUsages::STORAGE)?;
    let pipeline = &card.kernels.multiply_adds;
    let group = card.bound(pipeline, &[&factors, &sums]);
    let mut best = 0.0f64;
    // A quarter of the groups first: a slow card must not be busy for seconds.
    for groups in [GROUPS / 64, GROUPS / 8, GROUPS, GROUPS] {
        let clock = clock(gpu, 2)?;
        let mut encoder = card.encoder();
        {
            let mut pass = clock.pass(&mut encoder, Some(0), Some(1));
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, &group, &[]);
            let [x, y] = spread(groups);
            pass.dispatch_workgroups(x, y, 1);
        }
        let moments = read(gpu, encoder, &clock, 2)?;
        let seconds = clock.seconds(&moments, 0, 1);
        best = best.max(f64::from(groups) * GROUP * OPERATIONS / seconds);
        if seconds > 0.2 {
            break;
        }
    }
    Ok(best)
}

fn clock(gpu: &Gpu, moments: u32) -> Result<Clock, BackendError> {
    let text = "the card shows no clock";
    Clock::new(gpu.card(), moments).ok_or(BackendError::Unsupported(text))
}

/// Submits, and reads the clock's moments.
fn read(
    gpu: &Gpu,
    mut encoder: wgpu::CommandEncoder,
    clock: &Clock,
    moments: u64,
) -> Result<Vec<u8>, BackendError> {
    let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
    let to = gpu.card().empty(moments * 8, usage)?;
    clock.resolve(&mut encoder, &to, 0);
    gpu.card().finish(encoder, &to, moments * 8)
}
