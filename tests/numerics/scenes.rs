//! Pairs for the tests, and the errors of their flow.

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::evaluate::{Metrics, Truth, evaluate};
use fnsf::flow::field::Backend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{self, Estimate, Ground, Options, Problem, Uncontrolled};
use fnsf::formats::{Pair, PairTruth, read_pair};

use super::real_data::real_data;

/// The real pair of that name. None, with a message, without real data.
pub(crate) fn real_pair(name: &str) -> Option<Pair> {
    let path = real_data()?.join(name).join("pair.npz");
    let bytes = std::fs::read(&path).expect("FNSF_REAL_DATA holds the pair");
    Some(read_pair(&bytes).expect("the pair is sound"))
}

/// A simulated pair with its ground truth.
pub(crate) fn street(options: &StreetOptions) -> Pair {
    let simulated = Street::new(options)
        .and_then(|street| street.pair(0))
        .expect("a street");
    Pair {
        truth: Some(PairTruth {
            valid: vec![true; simulated.source.len()],
            flow: simulated.flow,
            dynamic: Some(simulated.dynamic),
            foreground: Some(simulated.foreground),
            category: None,
        }),
        ground: Some(fnsf::formats::Ground {
            source: simulated.ground_source,
            target: simulated.ground_target,
        }),
        ego: Some(simulated.target_from_source),
        source: simulated.source,
        target: simulated.target,
    }
}

/// Estimates the pair without its ground points, on two CPU threads.
pub(crate) fn estimated(pair: &Pair, options: &Options) -> Estimate {
    let backend = CpuBackend::new(Some(2)).expect("threads");
    estimated_on(&backend, pair, options)
}

/// Estimates the pair without its ground points, on the given backend.
pub(crate) fn estimated_on(backend: &dyn Backend, pair: &Pair, options: &Options) -> Estimate {
    let ground = pair.ground.as_ref().expect("the pair has ground masks");
    let problem = Problem {
        source: &pair.source,
        target: &pair.target,
        ground: Some([&ground.source, &ground.target]),
        times: None,
        before: None,
        neighbors: &[],
    };
    let options = Options {
        ground: Ground::Mask,
        ..options.clone()
    };
    flow::estimate(backend, &problem, &options, &Uncontrolled).expect("a flow")
}

/// The error metrics of the pair's flow, estimated with `options`.
pub(crate) fn score(pair: &Pair, options: &Options) -> Metrics {
    scored(pair, &estimated(pair, options))
}

/// The error metrics of an estimate of the pair.
pub(crate) fn scored(pair: &Pair, estimate: &Estimate) -> Metrics {
    let known = pair.truth.as_ref().expect("the pair has truth");
    let ground = pair.ground.as_ref().expect("the pair has ground masks");
    let truth = Truth {
        dynamic: known.dynamic.as_deref(),
        ground: Some(&ground.source),
        ..Truth::new(&known.flow, &known.valid)
    };
    evaluate(&estimate.flow, &estimate.valid, &truth).expect("points to score")
}

/// The median EPE over several seeds, and the largest, metres.
pub(crate) fn median_and_worst(pair: &Pair, options: &Options, seeds: u64) -> [f64; 2] {
    let epe = |seed| {
        score(
            pair,
            &Options {
                seed,
                ..options.clone()
            },
        )
        .epe
    };
    let mut errors: Vec<f64> = (0..seeds).map(epe).collect();
    errors.sort_by(f64::total_cmp);
    [errors[errors.len() / 2], errors[errors.len() - 1]]
}

/// Allows 30 iterations if the loss is a Chamfer distance. They are slow.
pub(crate) fn shorten_chamfer(options: &mut Options) {
    if let Some(field) = options.field_mut()
        && field.loss.distance().is_none()
    {
        field.max_iterations = 30;
    }
}
