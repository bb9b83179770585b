//! Self-test of the matrix units: compares the half-precision kernels with those of single
//! precision on a random network and random points. Runs once per opened GPU, before half precision
//! is used.
//!
//! Cooperative matrices are experimental in wgpu, whose barriers do not cover all requirements of
//! the Vulkan memory model (gfx-rs/wgpu#8805). A driver may therefore compute wrong results. Each
//! kernel runs on the same inputs in both precisions, so that only rounding differs.

use super::buffers::Buffers;
use super::context::Context;
use super::half::Units;
use super::iteration::{Phases, SubmittedModel};
use super::layout::{Lane, Status, Step, TILE};
use super::matrix_units::Tile;
use super::memory::Budget;
use super::phase::Phase;
use super::program::SubmittedLoss;
use super::request::{LossKind, Model, Request, write as write_request};
use super::tiling::{Cut, Plan};
use crate::flow::data::{Random, largest as largest_of};
use crate::flow::field::{
    BackendError, HIDDEN_LAYERS, LAID_OUT, MIDDLE_LAYERS, WIDTH, last_layer, middle_layer, mlp,
    transpose_middle_layers,
};
use crate::flow::options::Precision;

/// Number of points: enough for many concurrent workgroups, and not a multiple of the tile size.
const POINTS: usize = 2000;
/// Maximum difference, relative to the largest value of the layer. Rounding a factor to half
/// precision has a relative error of 2^-12 on average. Sums over 128 of them, seven layers deep,
/// are off by a few times that, relative to the largest. A wrong tile is off by about one.
const TOLERANCE: f32 = 0.01;

/// Why half precision is not available on a GPU.
#[derive(Debug, thiserror::Error)]
pub(super) enum SelfTestError {
    /// The test could not be done.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// It has no matrix units that the kernels support.
    #[error("{0}")]
    NoUnits(String),
    /// A result differs from that of single precision.
    #[error("its matrix units failed their self-test: {what} is off by {off:.3} of the largest")]
    Differs { what: String, off: f32 },
}

/// Builds the half-precision kernels and compares them with those of single precision.
///
/// # Errors
/// The reason why half precision is not available on this GPU.
pub(super) fn tested_units(
    context: &Context,
    tile: Tile,
    sources: &[(&str, &str)],
) -> Result<Units, SelfTestError> {
    run(context, &Units::new(context, tile, sources, 1)?)?;
    Ok(Units::new(context, tile, sources, context.budget.lanes)?)
}

/// Compares the kernels.
///
/// # Errors
/// The result that differs, or the failure that prevented the comparison.
fn run(context: &Context, units: &Units) -> Result<(), SelfTestError> {
    let [single, half] = computed(context, units)?;
    let layer = TILE * POINTS.div_ceil(TILE) * WIDTH;
    for (name, single, half) in [
        ("activations", &single.activations, &half.activations),
        ("derivatives", &single.deltas, &half.deltas),
    ] {
        for number in 0..HIDDEN_LAYERS {
            let span = number * layer..(number + 1) * layer;
            let what = format!("the {name} of hidden layer {number}");
            compare(what, &single[span.clone()], &half[span])?;
        }
    }
    compare("the flow".to_owned(), &single.flows, &half.flows)?;
    let chunks = single.gradients.chunks_exact(LAID_OUT);
    for (single, half) in chunks.zip(half.gradients.chunks_exact(LAID_OUT)) {
        let starts = (0..MIDDLE_LAYERS).map(|number| middle_layer(number).weights);
        let ends: Vec<_> = starts.chain([last_layer().weights, LAID_OUT]).collect();
        let mut start = 0;
        for (number, end) in ends.into_iter().enumerate() {
            let what = format!("the gradient of layer {number}");
            compare(what, &single[start..end], &half[start..end])?;
            start = end;
        }
    }
    Ok(())
}

/// # Errors
/// The relative difference, if it exceeds the tolerance.
fn compare(what: String, single: &[f32], half: &[f32]) -> Result<(), SelfTestError> {
    let largest = single.iter().fold(0.0f32, |most, x| most.max(x.abs()));
    let pairs = single.iter().zip(half);
    let off = largest_of(pairs.map(|(a, b)| (a - b).abs() / largest));
    if off <= TOLERANCE {
        return Ok(());
    }
    Err(SelfTestError::Differs { what, off })
}

/// The results of the kernels of one precision.
struct Computed {
    /// `[layer][row][128]`.
    activations: Vec<f32>,
    /// One vec4 per row.
    flows: Vec<f32>,
    /// `[layer][row][128]`.
    deltas: Vec<f32>,
    /// One network's worth per chunk.
    gradients: Vec<f32>,
}

/// The results of both precisions, single precision first. Both backward passes read the
/// activations of single precision, and both gradient kernels read its activations and deltas.
fn computed(context: &Context, units: &Units) -> Result<[Computed; 2], BackendError> {
    let cut = Cut::new(POINTS);
    let budget = Budget {
        lanes: 1,
        rows: (cut.tiles * TILE) as u64,
        chunks: cut.chunks.count as u64,
        store_words: 3 * POINTS as u64,
    };
    let more = wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST;
    let buffers = Buffers::allocate(&context.device, &budget, more);
    let buffers = buffers.map_err(|error| context.busy_if_it_fits(error, more))?;
    let plan = Plan::new(&[cut], cut.tiles * TILE);
    fill(context, &buffers, cut)?;
    let bind = |model| Phases::bind(context, &buffers, &plan, 1, model, SubmittedLoss::Distance);
    let single = bind(SubmittedModel::Network)?;
    let half = bind(SubmittedModel::Half(units))?;

    let row_bytes = budget.row_bytes();
    let sizes = [
        (&buffers.activations, row_bytes),
        (&buffers.flows, budget.rows * 16),
        (&buffers.deltas, row_bytes),
        (&buffers.partials, budget.chunk_bytes()),
    ];
    let all: u64 = sizes.iter().map(|(_, bytes)| 2 * bytes).sum();
    let results = context.empty(all, more)?;
    let mut encoder = context.encoder();
    let mut at = 0;
    let mut spans = Vec::new();
    let mut done = |phases: &Phases<'_>, todo: &[Phase], kept: &[usize]| {
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            for &phase in todo {
                phases.dispatch(&mut pass, phase, 0, &plan.waves[0]);
            }
        }
        for &number in kept {
            let (buffer, bytes) = sizes[number];
            encoder.copy_buffer_to_buffer(buffer, 0, &results, at, bytes);
            spans.push(at as usize..(at + bytes) as usize);
            at += bytes;
        }
    };
    done(&half, &[Phase::Halve, Phase::Forward], &[0, 1]);
    done(&single, &[Phase::Forward], &[0, 1]);
    done(&half, &[Phase::Backward], &[2]);
    done(&single, &[Phase::Backward], &[2]);
    done(&half, &[Phase::Gradients], &[3]);
    done(&single, &[Phase::Gradients], &[3]);
    let read = context.finish(encoder, &results, all)?;
    let values = |number: usize| {
        let quads = read[spans[number].clone()].as_chunks::<4>().0;
        quads
            .iter()
            .map(|&bytes| f32::from_ne_bytes(bytes))
            .collect()
    };
    let of = |[activations, flows, deltas, gradients]: [usize; 4]| Computed {
        activations: values(activations),
        flows: values(flows),
        deltas: values(deltas),
        gradients: values(gradients),
    };
    Ok([of([2, 3, 5, 7]), of([0, 1, 4, 6])])
}

/// Writes random points, random loss gradients and a random network, with random biases in the
/// middle layers.
fn fill(context: &Context, buffers: &Buffers, cut: Cut) -> Result<(), BackendError> {
    let mut random = Random::new(1);
    let mut parameters = mlp::xavier(&mut random);
    for number in 0..MIDDLE_LAYERS {
        let at = middle_layer(number).bias;
        for bias in &mut parameters.as_mut_slice()[at..at + WIDTH] {
            *bias = random.uniform(-0.1, 0.1) as f32;
        }
    }
    let mut transposed = mlp::zeros();
    transpose_middle_layers(parameters.as_slice(), transposed.as_mut_slice());
    let mut across = |width: f64| random.uniform(-width, width) as f32;
    let points: Vec<f32> = (0..3 * POINTS).map(|_| across(4.0)).collect();
    let loss_gradients: Vec<[f32; 4]> = (0..cut.tiles * TILE)
        .map(|row| match row < POINTS {
            true => [0; 4].map(|_| across(1.0 / POINTS as f64)),
            false => [0.0; 4],
        })
        .collect();
    let network = [&parameters, &transposed].map(|own| &own.as_slice()[..LAID_OUT]);
    let [parameters, transposed] = network.map(bytemuck::cast_slice);
    context.write(&[
        (&buffers.store, 0, bytemuck::cast_slice(&points)),
        (&buffers.networks, 0, parameters),
        (&buffers.networks, LAID_OUT as u64 * 4, transposed),
        (
            &buffers.loss_gradients,
            0,
            bytemuck::cast_slice(&loss_gradients),
        ),
    ])?;
    let request = Request {
        lane: Lane {
            scale: 1.0,
            ..Lane::default()
        },
        status: Status::default(),
        steps: vec![Step {
            count: POINTS as u32,
            ..Step::default()
        }],
        cut,
        model: Model::Network(Precision::F16),
        loss: LossKind::Distance,
    };
    write_request(context, buffers, &[&request])
}
