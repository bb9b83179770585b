//! Half precision on the GPU's matrix units, against the double-precision reference and against
//! single precision. Without matrix units these tests print a note and pass. Only the test of the
//! refusal checks something in that case, too.

use super::kernels::{after_one, network, plain, transform};
use super::whole::{Losses, end_point_error, solved, street};
use super::{clouds, distance_loss, shared, with_network_and_transform};
use crate::flow::cpu::CpuBackend;
use crate::flow::data::Uncontrolled;
use crate::flow::distance::DistanceTransform;
use crate::flow::field::{Backend, BackendError, ReferenceNetwork, mlp};
use crate::flow::gpu::backend::Gpu;
use crate::flow::gpu::half::Units;
use crate::flow::gpu::self_test::tested_units;
use crate::flow::options::{FieldOptions, Method, Options, Precision, Preset};

/// The shared GPU, if its matrix units can be used.
fn with_units() -> Option<&'static Gpu> {
    let gpu = shared()?;
    match gpu.matrix_units() {
        Ok(_) => Some(gpu),
        Err(reason) => {
            eprintln!("not tested: {}: {reason}", gpu.name());
            None
        }
    }
}

fn half(mut options: FieldOptions) -> FieldOptions {
    options.network_mut().expect("a network").precision = Precision::F16;
    options
}

#[test]
fn half_precision_is_refused_where_nothing_can_compute_it() {
    let [source, target] = clouds(100);
    let options = half(Preset::Paper.field());
    let refused = |device: &dyn Backend| {
        let transform = device
            .prepare_target(&source, &target, &options.loss, &Uncontrolled)
            .expect("small clouds fit");
        let refused = transform.start(&source, &options, 0).err();
        matches!(refused, Some(BackendError::Unsupported(text)) if text.contains("precision"))
    };
    assert!(refused(&CpuBackend::new(Some(1)).expect("threads")));
    if let Some(gpu) = shared() {
        assert_eq!(refused(gpu), gpu.matrix_units().is_err());
    }
}

/// The kernels' sources with one replacement, whose text must occur.
fn changed(
    sources: &[(&'static str, &'static str)],
    kernel: &str,
    from: &str,
    to: &str,
) -> Vec<(&'static str, String)> {
    let text = |&(name, source): &(&'static str, &str)| {
        assert!(name != kernel || source.contains(from), "{kernel}");
        let new = source.replace(from, to);
        (
            name,
            if name == kernel {
                new
            } else {
                source.to_owned()
            },
        )
    };
    sources.iter().map(text).collect()
}

fn tested(gpu: &Gpu, kernel: &str, from: &str, to: &str) -> Result<Units, String> {
    let tile = gpu
        .device()
        .context
        .tile
        .clone()
        .expect("it was there before");
    let sources = changed(tile.sources(), kernel, from, to);
    let sources: Vec<_> = sources
        .iter()
        .map(|(name, text)| (*name, text.as_str()))
        .collect();
    tested_units(&gpu.device().context, tile, &sources).map_err(|error| error.to_string())
}

#[test]
fn fewer_subgroups_than_pieces_of_a_product_go_round_again() {
    let Some(gpu) = with_units() else {
        return;
    };
    for (kernel, from, to) in [
        (
            "forward_half",
            "square += subgroups",
            "square += SQUARE_COUNT / 2u",
        ),
        (
            "backward_half",
            "square += subgroups",
            "square += SQUARE_COUNT / 2u",
        ),
        (
            "gradients_half",
            "first += subgroups",
            "first += PIECE_COUNT / 2u",
        ),
    ] {
        tested(gpu, kernel, from, to).unwrap_or_else(|reason| panic!("{kernel}: {reason}"));
    }
}

#[test]
fn kernels_that_take_a_wrong_tile_or_layer_fail_the_self_test() {
    let Some(gpu) = with_units() else {
        return;
    };
    for (kernel, right, wrong) in [
        ("halve", "input % BLOCK * BLOCK", "input % 8u * BLOCK"),
        (
            "forward_half",
            "+ layer) * LAYER_HALVES",
            ") * LAYER_HALVES",
        ),
        ("backward_half", "coopLoad<Right>", "coopLoadT<Right>"),
        ("gradients_half", "output + 3u * SIDE", "output + 2u * SIDE"),
    ] {
        let failed = tested(gpu, kernel, right, wrong).err();
        let failed = failed.unwrap_or_else(|| panic!("{kernel} passes"));
        assert!(failed.contains("self-test"), "{failed}");
    }
}

#[test]
fn gradients_in_half_precision_are_near_the_references_at_awkward_row_counts() {
    // Rounding moves features across zero and points into other cells, which switches whole
    // derivatives on and off. Each layer's gradient is therefore compared as a whole. With three
    // rows its relative error is 0.04; a single wrong tile of 16 x 16 would cause one eighth.
    const TOLERANCE: f64 = 0.08;
    let [cloud, target] = clouds(9000);
    let options = half(plain());
    for rows in [3, 31, 32, 33, 63, 64, 65, 600] {
        let source = &cloud[..rows];
        let (Some(_), Some(gpu)) = (with_units(), transform(source, &target)) else {
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
        let mut expected = ReferenceNetwork::read(mlp::zeros().as_slice());
        for &point in source {
            let input = point.map(f64::from);
            let flow = reference.forward(input).map(|f| f as f32);
            let deformed = core::array::from_fn(|a| point[a] + flow[a]);
            let loss = distance_loss(&options).at(point, distance.sample(deformed), flow);
            let pull = loss.gradient.map(|g| f64::from(g) / rows as f64);
            reference.backward(input, pull, &mut expected);
        }
        // After the first step the mean of the gradients is a tenth of the gradient.
        let state = after_one(&gpu, source, &options);
        let found = ReferenceNetwork::read(state.moments[0].as_slice());
        for (layer, (found, expected)) in found.weights.iter().zip(&expected.weights).enumerate() {
            let found = found.iter().flatten().map(|g| g * 10.0);
            let pairs: Vec<_> = found.zip(expected.iter().flatten()).collect();
            let off: f64 = pairs.iter().map(|(a, b)| (a - **b).powi(2)).sum();
            let all: f64 = pairs.iter().map(|(_, b)| b.powi(2)).sum();
            let off = (off / all).sqrt();
            assert!(off < TOLERANCE, "{rows} rows, layer {layer}: {off}");
        }
    }
}

#[test]
fn the_first_losses_in_half_precision_are_those_of_single_precision() {
    // Each step moves every weight by 0.008 in the direction of its gradient's sign. The signs of
    // the smallest gradients depend on rounding, so the losses diverge after some steps.
    const STEPS: usize = 3;
    const TOLERANCE: f64 = 0.01;
    let Some(gpu) = with_units() else {
        return;
    };
    let [source, target] = clouds(1000);
    let losses = [plain(), half(plain())].map(|options| {
        let transform = gpu
            .prepare_target(&source, &target, &options.loss, &Uncontrolled)
            .expect("small clouds fit");
        let losses = Losses::default();
        let mut trainer = transform.start(&source, &options, 0).expect("a trainer");
        trainer.advance(STEPS, &losses).expect("iterations");
        losses.taken()
    });
    for (single, half) in losses[0].iter().zip(&losses[1]) {
        assert!((half - single).abs() < TOLERANCE * single, "{losses:?}");
    }
}

#[test]
fn whole_runs_in_half_precision_find_the_flow_of_single_precision() {
    // As between the GPU and the CPU: with the same seed, rounding makes two runs diverge, as another seed
    // would. So the means of several runs are compared, and their errors against the spread of the seeds.
    const RUNS: u64 = 8;
    const LOSS: f64 = 0.05;
    const ERROR_M: f64 = 0.03;
    const SIGMAS: f64 = 3.0;
    let Some(gpu) = with_units() else {
        return;
    };
    let pair = street(1);
    for preset in with_network_and_transform() {
        let mut options = preset.options(Some(1500));
        let field = options.field_mut().expect("a field");
        field.max_iterations = 40;
        let precisions = [field.clone(), half(field.clone())];
        let run = |field: &FieldOptions, seed: u64| {
            let options = Options {
                method: Method::Field(field.clone()),
                seed,
                ..options.clone()
            };
            let estimate = solved(gpu, &pair, &options);
            let kept = |points: &[[f32; 3]]| -> Vec<[f32; 3]> {
                let rows = points.iter().zip(&estimate.valid);
                rows.filter(|&(_, &valid)| valid).map(|(&p, _)| p).collect()
            };
            let error = end_point_error(&kept(&estimate.flow), &kept(&pair.flow));
            [estimate.fit().expect("a fit").best_loss, error]
        };
        let count = RUNS as f64;
        let [single, half] = precisions.map(|field| {
            let runs: Vec<_> = (0..RUNS).map(|seed| run(&field, seed)).collect();
            [0, 1].map(|figure| {
                let mean = runs.iter().map(|run| run[figure]).sum::<f64>() / count;
                let squares = runs.iter().map(|run| (run[figure] - mean).powi(2));
                (mean, squares.sum::<f64>() / (count - 1.0))
            })
        });
        println!(
            "{preset:?}: mean and variance of loss and error, half {half:?}, single {single:?}"
        );
        let [(half_loss, _), (half_error, half_variance)] = half;
        let [(single_loss, _), (single_error, single_variance)] = single;
        let loss = (half_loss - single_loss).abs() / single_loss;
        assert!(loss < LOSS, "{preset:?}: {half:?} {single:?}");
        // The standard error of the difference of the two means.
        let of_seeds = ((half_variance + single_variance) / count).sqrt();
        let error = (half_error - single_error).abs();
        assert!(
            error < ERROR_M + SIGMAS * of_seeds,
            "{preset:?}: {half:?} {single:?}"
        );
    }
}

#[test]
fn pairs_of_both_precisions_at_once_have_the_bits_they_have_alone() {
    let Some(gpu) = with_units() else {
        return;
    };
    let fitted = |options: &FieldOptions| {
        let [source, target] = clouds(700);
        let transform = gpu
            .prepare_target(&source, &target, &options.loss, &Uncontrolled)
            .expect("small clouds fit");
        let mut trainer = transform.start(&source, options, 0).expect("a trainer");
        trainer.advance(8, &Uncontrolled).expect("iterations");
        trainer.evaluate(&source).expect("an answer")
    };
    let all = [plain(), half(plain())];
    let alone = all.each_ref().map(&fitted);
    assert!(alone[0] != alone[1], "rounding makes a difference");
    let together = std::thread::scope(|scope| {
        let fitted = &fitted;
        let pairs = all
            .each_ref()
            .map(|options| scope.spawn(move || fitted(options)));
        pairs.map(|pair| pair.join().expect("no panic"))
    });
    assert!(alone == together);
}

#[test]
fn a_sweep_larger_than_the_memory_holds_at_once_has_the_gradient_of_all() {
    const TOLERANCE: f64 = 1e-3;
    let [cloud, target] = clouds(12_288);
    let twice: Vec<_> = cloud.iter().chain(&cloud).copied().collect();
    let (Some(_), Some(gpu)) = (with_units(), transform(&twice, &target)) else {
        return;
    };
    let once = after_one(&gpu, &cloud, &half(plain()));
    let twice = after_one(&gpu, &twice, &half(plain()));
    let [once, twice] =
        [once, twice].map(|state| ReferenceNetwork::read(state.moments[0].as_slice()).flat());
    let scale = once.iter().fold(0.0f64, |most, g| most.max(g.abs()));
    for (a, b) in once.iter().zip(&twice) {
        assert!((a - b).abs() < TOLERANCE * scale, "{a} {b}");
    }
}
