//! Each kernel against the double-precision reference, including sizes that are not multiples of a
//! tile.

use super::{clouds, distance_loss, scattered, shared, with_network_and_transform};
use crate::flow::data::{Point, Random, Uncontrolled};
use crate::flow::distance::{Bricks, DistanceOptions, DistanceTransform};
use crate::flow::field::{
    Backend, Conditioning, PreparedTarget, ReferenceNetwork, TrainerState, first_losses,
    mean_distance, mlp,
};
use crate::flow::gpu::distance::{GpuTransform, build};
use crate::flow::options::{FieldOptions, Preset, ResultChoice};
use crate::flow::simulate::{Street, StreetOptions};

/// Rounding of single-precision sums of 128 terms, eight layers deep.
const NETWORK_TOLERANCE: f64 = 2e-5;
/// As above, and over the points. The signs of the single-precision losses may differ at kinks.
const GRADIENT_TOLERANCE: f64 = 1e-4;

pub(super) fn transform(source: &[Point], target: &[Point]) -> Option<GpuTransform> {
    let adapter = shared()?.device();
    let options = DistanceOptions::default();
    let built = build(adapter, source, target, &options, &Uncontrolled);
    Some(built.expect("small clouds fit"))
}

fn street() -> [Vec<Point>; 2] {
    let options = StreetOptions {
        beams: 16,
        azimuth_steps: 500,
        ..StreetOptions::default()
    };
    let pair = Street::new(&options).and_then(|street| street.pair(0));
    let pair = pair.expect("a small street");
    [pair.source, pair.target]
}

#[test]
fn bricks_have_the_bits_of_the_cpus() {
    let [source, target] = street();
    // The second pair has more bricks than a dispatch can have workgroups along one dimension.
    let sparse = scattered(520, [300.0, 300.0, 20.0], 3);
    for (source, target) in [(source, target), (sparse.clone(), sparse)] {
        let Some(gpu) = transform(&source, &target) else {
            return;
        };
        let cpu = Bricks::build(&source, &target, &DistanceOptions::default(), &Uncontrolled);
        let cpu = cpu.expect("small clouds fit");
        assert_eq!(gpu.bytes(), cpu.bytes());
        let mut encoder = gpu.device.context.encoder();
        let bytes = cpu.codes().len() as u64 * 2;
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let copy = gpu.device.context.empty(bytes, usage).expect("memory");
        let from = u64::from(gpu.record.codes) * 4;
        encoder.copy_buffer_to_buffer(&gpu.device.context.buffers.store, from, &copy, 0, bytes);
        let read = gpu
            .device
            .context
            .finish(encoder, &copy, bytes)
            .expect("an answer");
        let wrong = read
            .as_chunks::<2>()
            .0
            .iter()
            .zip(cpu.codes())
            .filter(|&(&bytes, &code)| u16::from_le_bytes(bytes) != code);
        assert_eq!(wrong.count(), 0, "of {} codes", cpu.codes().len());
    }
}

#[test]
fn samples_have_the_bits_of_the_cpus_near_far_and_outside() {
    let [source, target] = street();
    let Some(gpu) = transform(&source, &target) else {
        return;
    };
    let cpu =
        DistanceTransform::build(&source, &target, &DistanceOptions::default(), &Uncontrolled);
    let cpu = cpu.expect("small clouds fit");
    let mut points = scattered(20_000, [120.0, 120.0, 12.0], 4);
    points.extend(&source);
    points.extend([[1e6, 0.0, 0.0], [0.0, -1e6, 1e6]]);
    for count in [0, 1, 63, 64, 65, points.len()] {
        let samples = gpu.samples(&points[..count]).expect("an answer");
        assert_eq!(samples.len(), count);
        for (&point, seen) in points.iter().zip(&samples) {
            assert_eq!(*seen, cpu.sample(point), "{point:?}");
        }
    }
}

/// The published options without early stopping. The network does not start at zero, and the
/// learning rate is constant.
pub(super) fn plain() -> FieldOptions {
    let mut options = Preset::Paper.field();
    options.early_stop = None;
    options
}

pub(super) fn network() -> ReferenceNetwork {
    let mut random = Random::stream(0, 0);
    ReferenceNetwork::read(mlp::xavier(&mut random).as_slice())
}

#[test]
fn the_network_is_the_references_at_awkward_row_counts() {
    let [source, target] = clouds(300);
    let Some(gpu) = transform(&source, &target) else {
        return;
    };
    let options = plain();
    let mut trainer = gpu.start(&source, &options, 0).expect("a trainer");
    let reference = network();
    for rows in [0, 1, 7, 8, 63, 64, 65, 1000] {
        let points = scattered(rows, [9.0, 6.0, 2.0], 11);
        let flow = trainer.evaluate(&points).expect("an answer");
        assert_eq!(flow.len(), rows);
        for (point, flow) in points.iter().zip(&flow) {
            let expected = reference.forward(point.map(f64::from));
            for (&value, expected) in flow.iter().zip(expected) {
                let error = (f64::from(value) - expected).abs();
                let scale = expected.abs().max(1.0);
                assert!(
                    error < NETWORK_TOLERANCE * scale,
                    "{rows}: {flow:?} {expected}"
                );
            }
        }
    }
}

/// The trainer's state after one iteration over `source`.
pub(super) fn after_one(
    gpu: &GpuTransform,
    source: &[Point],
    options: &FieldOptions,
) -> TrainerState {
    let mut trainer = gpu.start(source, options, 0).expect("a trainer");
    trainer.advance(1, &Uncontrolled).expect("an iteration");
    trainer.state().expect("an answer").expect("whole")
}

#[test]
fn every_gradient_is_the_references_at_awkward_row_counts() {
    let [cloud, target] = clouds(9000);
    for preset in with_network_and_transform() {
        let mut options = FieldOptions {
            loss: preset.field().loss,
            ..plain()
        };
        let inputs = preset.field().network().expect("a network").inputs;
        options.network_mut().expect("a network").inputs = inputs;
        options.result = ResultChoice::Best;
        for rows in [3, 63, 64, 65, 600] {
            let source = &cloud[..rows];
            let Some(gpu) = transform(source, &target) else {
                return;
            };
            let distance = DistanceTransform::build(
                source,
                &target,
                &distance_loss(&options).transform,
                &Uncontrolled,
            );
            let distance = distance.expect("small clouds fit");
            let reference = network();
            let conditioning =
                Conditioning::new(source, options.network().expect("a network").inputs);
            let mut expected = ReferenceNetwork::read(mlp::zeros().as_slice());
            for &point in source {
                let input = conditioning.apply(point).map(f64::from);
                let flow = reference.forward(input).map(|f| f as f32);
                let deformed = core::array::from_fn(|a| point[a] + flow[a]);
                let loss = distance_loss(&options).at(point, distance.sample(deformed), flow);
                let pull = loss.gradient.map(|g| f64::from(g) / rows as f64);
                reference.backward(input, pull, &mut expected);
            }
            // After the first step the mean of the gradients is a tenth of the gradient.
            let mut state = after_one(&gpu, source, &options);
            let means = &mut state.moments[0];
            means
                .as_mut_slice()
                .iter_mut()
                .for_each(|mean| *mean *= 10.0);
            let gradients = ReferenceNetwork::read(means.as_slice()).flat();
            let expected = expected.flat();
            let scale = expected.iter().fold(0.0f64, |most, g| most.max(g.abs()));
            for (index, (gradient, expected)) in gradients.iter().zip(&expected).enumerate() {
                let error = (gradient - expected).abs() / scale;
                assert!(
                    error < GRADIENT_TOLERANCE,
                    "{preset:?}, {rows} rows, parameter {index}: {gradient} {expected}"
                );
            }
        }
    }
}

#[test]
fn more_points_than_the_memory_holds_at_once_give_the_gradient_of_all() {
    // The software adapter holds fewer rows than this at once. The mean over the points taken twice
    // equals the mean over the points.
    let [cloud, target] = clouds(12_288);
    let twice: Vec<_> = cloud.iter().chain(&cloud).copied().collect();
    let Some(gpu) = transform(&twice, &target) else {
        return;
    };
    let once = after_one(&gpu, &cloud, &plain());
    let twice = after_one(&gpu, &twice, &plain());
    let [once, twice] =
        [once, twice].map(|state| ReferenceNetwork::read(state.moments[0].as_slice()).flat());
    let scale = once.iter().fold(0.0f64, |most, g| most.max(g.abs()));
    for (a, b) in once.iter().zip(&twice) {
        assert!((a - b).abs() < GRADIENT_TOLERANCE * scale, "{a} {b}");
    }
}

#[test]
fn the_first_losses_are_those_of_the_method_in_double_precision() {
    // Ten steps that move every weight by a thousandth each. With longer steps rounding errors
    // grow.
    const TOLERANCE: f64 = 2e-3;
    const STEPS: i32 = 10;
    const RATE: f32 = 1e-3;
    let [source, target] = clouds(200);
    let mut options = Preset::Paper.field();
    options.learning_rate = RATE;
    let Some(gpu) = shared() else {
        return;
    };
    let distance = DistanceTransform::build(
        &source,
        &target,
        &distance_loss(&options).transform,
        &Uncontrolled,
    );
    let distance = distance.expect("small clouds fit");
    let expected = first_losses(&source, &mean_distance(&distance), 0, RATE.into(), STEPS);
    let transform = gpu
        .prepare_target(&source, &target, &options.loss, &Uncontrolled)
        .expect("small clouds fit");
    let losses = super::whole::Losses::default();
    let mut trainer = transform.start(&source, &options, 0).expect("a trainer");
    trainer
        .advance(STEPS as usize, &losses)
        .expect("iterations");
    let losses = losses.taken();
    assert_eq!(losses.len(), expected.len());
    for (loss, expected) in losses.iter().zip(&expected) {
        let error = (loss - expected).abs() / expected;
        assert!(error < TOLERANCE, "{losses:?} {expected:?}");
    }
}
