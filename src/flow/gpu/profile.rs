//! Profiling: the time of every kernel of an iteration by GPU timestamps, and the GPU's peak
//! arithmetic throughput. For benchmarks and `fnsf doctor`.

use super::backend::Gpu;
use super::buffers::spread;
use super::chamfer::GpuCloud;
use super::distance;
use super::iteration::{Phases, SubmittedModel};
use super::layout::TILE;
use super::loss::GpuTarget;
use super::phase::{Clock, Phase};
use super::program::SubmittedLoss;
use super::request::write;
use super::tiling::{Cut, Plan, Wave};
use super::trainer::GpuTrainer;
use crate::flow::data::{Point, Uncontrolled};
use crate::flow::distance::DistanceOptions;
use crate::flow::field::{BackendError, MIDDLE_LAYERS, WIDTH};
use crate::flow::options::{
    ChamferOptions, FieldOptions, LossOptions, ModelOptions, NearestSearch, NetworkOptions,
    Precision,
};

/// Floating-point operations of the forward pass, per point.
const FORWARD: f64 = 2.0 * (3 * WIDTH + MIDDLE_LAYERS * WIDTH * WIDTH + 3 * WIDTH) as f64;
/// Floating-point operations of the backward pass, which stops at the first hidden layer, per
/// point.
const BACKWARD: f64 = FORWARD - 2.0 * (3 * WIDTH) as f64;

/// Floating-point operations of a squared distance.
const DISTANCE: f64 = 8.0;

/// Seconds that a GPU computes before its clocks are high: an idle one lowers them.
const WARM_SECONDS: f64 = 0.5;

/// Time and work of one kernel in one iteration of a fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KernelTime {
    /// Name of the kernel: `forward`, `distance_loss`, `backward`, `gradients`, `reduce_loss`,
    /// `step`, `transpose` in single or `halve` in half precision, and in single precision
    /// `deform`, `nearest` and `chamfer_loss`.
    pub name: &'static str,
    /// Time by GPU timestamps, seconds: the minimum over all rounds.
    pub seconds: f64,
    /// Number of floating-point operations of the kernel's matrix products, two per multiply-add, or
    /// of its squared distances. Zero for another kernel.
    pub operations: f64,
}

/// A kernel to time: its name, its phase, and its floating-point operations.
type Timed = (&'static str, Phase, f64);

/// Times each of the kernels of an iteration over all points of `source`, in the precision
/// `precision`: for a network, with a distance transform and, in single precision, with the Chamfer
/// distance to all points of `target`. It repeats the iteration `rounds` times, zero counts as one, and
/// until the GPU has computed for half a second, since an idle GPU lowers its clocks.
/// `source` (N x 3, N at least 1) and `target` (M x 3) are in metres, in the same frame. The GPU
/// should do no other work meanwhile.
///
/// # Errors
/// - [`BackendError::Unsupported`] if the memory cannot hold all points at once, the GPU has no
///   timestamps, or it lacks the precision.
/// - [`BackendError::Distance`] if the distance transform refuses the clouds.
/// - [`BackendError::Memory`] if the pair does not fit in the GPU's memory.
/// - [`BackendError::Busy`] if other pairs occupy the GPU.
/// - [`BackendError::Lost`] or [`BackendError::Device`] if the GPU fails.
pub fn kernel_times(
    gpu: &Gpu,
    source: &[Point],
    target: &[Point],
    precision: Precision,
    rounds: usize,
) -> Result<Vec<KernelTime>, BackendError> {
    let device = gpu.device();
    let points = source.len() as f64;
    let network = FieldOptions {
        model: ModelOptions::Network(NetworkOptions {
            precision,
            ..NetworkOptions::published()
        }),
        // The repeated iteration makes no progress and must not stop the fit.
        early_stop: None,
        ..FieldOptions::published(false)
    };
    let kernels = [
        ("forward", Phase::Forward, points * FORWARD),
        ("distance_loss", Phase::Loss, 0.0),
        ("backward", Phase::Backward, points * BACKWARD),
        ("gradients", Phase::Gradients, points * FORWARD),
        ("reduce_loss", Phase::ReduceLoss, 0.0),
        ("step", Phase::Step, 0.0),
        match precision {
            Precision::F32 => ("transpose", Phase::Transpose, 0.0),
            Precision::F16 => ("halve", Phase::Halve, 0.0),
        },
    ];
    let transform = DistanceOptions::default();
    let built = distance::build(device, source, target, &transform, &Uncontrolled)?;
    let on = GpuTarget::Transform(&built);
    let mut times = timed(gpu, on, source, &network, &kernels, rounds)?;
    if precision == Precision::F32 {
        let distances = 2.0 * points * target.len() as f64;
        let kernels = [
            ("forward", Phase::Forward, points * FORWARD),
            ("deform", Phase::Deform, 0.0),
            ("nearest", Phase::Nearest, distances * DISTANCE),
            ("chamfer_loss", Phase::Loss, 0.0),
        ];
        drop(built);
        let chamfer = ChamferOptions::published(NearestSearch::BruteForce);
        let cloud = GpuCloud::new(device, source.len(), target, &chamfer, &Uncontrolled)?;
        let options = FieldOptions {
            loss: LossOptions::Chamfer(chamfer),
            ..network
        };
        let on = GpuTarget::Cloud(&cloud);
        let more = timed(gpu, on, source, &options, &kernels, rounds)?;
        // Without the forward pass, which is the same.
        times.extend(more.into_iter().skip(1));
    }
    Ok(times)
}

/// Times `kernels` of an iteration over `source` that can be repeated: its step size is zero.
fn timed(
    gpu: &Gpu,
    target: GpuTarget<'_>,
    source: &[Point],
    options: &FieldOptions,
    kernels: &[Timed],
    rounds: usize,
) -> Result<Vec<KernelTime>, BackendError> {
    let device = gpu.device();
    let context = &device.context;
    let cut = Cut::new(source.len());
    let plan = Plan::new(&[cut], context.budget.rows as usize);
    let [wave] = plan.waves.as_slice() else {
        let text = "the kernels are timed on what fits into the card's memory at once";
        return Err(BackendError::Unsupported(text));
    };
    // The network keeps its initial parameters, because the step size is zero.
    let request = GpuTrainer::new(target, source, options, 0)?.repeated_iteration();
    write(context, &context.buffers, &[&request])?;
    let model = SubmittedModel::of(&request.model, &|| device.units())?;
    let loss = SubmittedLoss::of(&[&request]);
    let phases = Phases::bind(context, &context.buffers, &plan, 1, model, loss)?;
    let largest = request.cloud_sizes().into_iter().max().unwrap_or_default();
    let queries = Wave {
        tiles: largest.div_ceil(TILE),
        ..Wave::default()
    };
    let start = |&(name, _, operations): &Timed| KernelTime {
        name,
        seconds: f64::INFINITY,
        operations,
    };
    let mut times: Vec<_> = kernels.iter().map(start).collect();
    let (mut done, mut busy) = (0, 0.0);
    while done < rounds.max(1) || busy < WARM_SECONDS {
        done += 1;
        let clock = clock(gpu, 2 * kernels.len() as u32)?;
        let mut encoder = context.encoder();
        for (index, &(_, phase, _)) in (0..).zip(kernels) {
            let mut pass = clock.pass(&mut encoder, Some(2 * index), Some(2 * index + 1));
            let wave = match phase {
                Phase::Nearest => &queries,
                _ => wave,
            };
            phases.dispatch(&mut pass, phase, 0, wave);
        }
        let moments = read(gpu, encoder, &clock, 2 * kernels.len() as u64)?;
        for (index, time) in times.iter_mut().enumerate() {
            // A short kernel may end within one tick.
            let seconds = clock.seconds(&moments, 2 * index, 2 * index + 1);
            time.seconds = time.seconds.min(seconds.unwrap_or(0.0));
        }
        let whole = clock.seconds(&moments, 0, 2 * kernels.len() - 1);
        busy += whole.ok_or(NO_CLOCK)?;
    }
    Ok(times)
}

/// Measures the peak arithmetic throughput of the GPU in single precision and returns it in
/// floating-point operations per second. The GPU computes independent multiply-adds, of two
/// operations each. It should do no other work meanwhile.
///
/// # Errors
/// - [`BackendError::Unsupported`] if the GPU has no timestamps.
/// - [`BackendError::Busy`] if the GPU has no free memory for the measurement.
/// - [`BackendError::Lost`] or [`BackendError::Device`] if the GPU fails.
pub fn arithmetic_peak(gpu: &Gpu) -> Result<f64, BackendError> {
    /// Fewest and most workgroups, invocations per workgroup, and operations per invocation: eight
    /// chains of 512 multiply-adds of vec4s, see `multiply_adds.wgsl`.
    const GROUPS: [u32; 2] = [64, 1 << 20];
    const GROUP: f64 = 128.0;
    const OPERATIONS: f64 = 8.0 * 512.0 * 4.0 * 2.0;
    let device = gpu.device();
    let context = &device.context;
    let factors = context.filled(bytemuck::cast_slice(&[[0.999f32; 4], [0.001; 4], [1.0; 4]]))?;
    let sums = context.empty(1 << 20, wgpu::BufferUsages::STORAGE)?;
    let pipeline = &context.kernels.multiply_adds;
    let group = context.bound(pipeline, &[&factors, &sums]);
    let mut best = 0.0f64;
    // Starts with few workgroups, so that a slow GPU is not busy for seconds.
    let [mut groups, most] = GROUPS;
    let mut busy = 0.0;
    while busy < WARM_SECONDS {
        let clock = clock(gpu, 2)?;
        let mut encoder = context.encoder();
        {
            let mut pass = clock.pass(&mut encoder, Some(0), Some(1));
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, &group, &[]);
            let [x, y] = spread(groups);
            pass.dispatch_workgroups(x, y, 1);
        }
        let moments = read(gpu, encoder, &clock, 2)?;
        let seconds = clock.seconds(&moments, 0, 1).ok_or(NO_CLOCK)?;
        best = best.max(f64::from(groups) * GROUP * OPERATIONS / seconds);
        busy += seconds;
        if seconds < WARM_SECONDS / 10.0 {
            groups = most.min(2 * groups);
        }
    }
    Ok(best)
}

/// A GPU without timestamps, or with timestamps that stand still.
const NO_CLOCK: BackendError = BackendError::Unsupported("the card shows no clock");

fn clock(gpu: &Gpu, moments: u32) -> Result<Clock, BackendError> {
    Clock::new(&gpu.device().context, moments)?.ok_or(NO_CLOCK)
}

/// Submits the commands and reads the timestamps.
fn read(
    gpu: &Gpu,
    mut encoder: wgpu::CommandEncoder,
    clock: &Clock,
    moments: u64,
) -> Result<Vec<u8>, BackendError> {
    let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
    let to = gpu.device().context.empty(moments * 8, usage)?;
    clock.resolve(&mut encoder, &to, 0);
    gpu.device().context.finish(encoder, &to, moments * 8)
}
