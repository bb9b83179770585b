//! Deskewing of a pair, where the times of its points are known.

use std::sync::Arc;

use super::ego_motion::prior;
use crate::flow::data::{Control, Point, RigidTransform};
use crate::flow::deskew::{Fit, deskewed};
use crate::flow::error::FlowError;
use crate::flow::host::Host;
use crate::flow::options::{Ego, Ground, Options};
use crate::flow::problem::{NeighborSweep, Problem};
use crate::flow::registration::Registration;
use crate::flow::select::{cropped, ground_masks};

/// Remaining time above which a pair is deskewed, seconds per point. It takes two registrations.
const SECONDS_PER_POINT: f64 = 2e-6;

/// The distance of the deskewed sweeps is at most this share of that of the sweeps as they were given
/// where they are used. At 10 m/s the two hardly differ, and nor do the flows.
const BETTER: f32 = 0.98;

/// Ego motion below which a pair is not deskewed: translation in metres, rotation in radians. Flows
/// then change by less than a millimetre beyond 1.6 m.
const STANDS: [f64; 2] = [0.1, 0.003];

/// The outcome of deskewing a pair.
#[derive(Clone, Debug)]
pub struct Deskew {
    /// Mean distance, metres, of the source's points near the sensor from the target after the ego
    /// motion: of the sweeps as they were given, and deskewed.
    pub distance_m: [f32; 2],
    /// N and M points of the source and the target, deskewed: each in the sensor's frame of its
    /// sweep's time. The flow starts from them. None where they do not fit clearly better than the
    /// sweeps as they were given: these were deskewed before, or the vehicle is slow.
    pub points: Option<[Arc<[Point]>; 2]>,
}

/// What deskewing determines of a pair.
pub(super) struct DeskewedPair {
    /// None where the vehicle stands.
    pub(super) deskew: Option<Deskew>,
    /// The ground masks of the source and the target.
    pub(super) ground: [Vec<bool>; 2],
    /// The deskewed points of the neighbor sweeps; empty where the pair is used as it was given.
    pub(super) neighbors: Vec<Vec<Point>>,
    /// The ego motion of the points that are used, target_from_source.
    pub(super) ego: Registration,
}

/// Whether a pair is to be deskewed where it moves: its points have times.
pub(super) fn has_deskew(problem: &Problem, options: &Options) -> bool {
    problem.times.is_some() && options.ego != Ego::Off
}

/// Deskews the pair of `problem` and its neighbor sweeps, and decides by the fit of near points
/// whether the result is used. A pair of a standing vehicle is used as it was given. None where
/// [`has_deskew`] is false, and where too little time is left.
///
/// # Errors
/// [`FlowError::TimesLength`].
pub(super) fn deskew(
    host: &Host,
    problem: &Problem,
    options: &Options,
    control: &dyn Control,
) -> Result<Option<DeskewedPair>, FlowError> {
    problem.check_times()?;
    let points = problem.source.len() + problem.target.len();
    let needed = SECONDS_PER_POINT * points as f64;
    let is_late =
        control.interrupt().is_some() || control.seconds_left().is_some_and(|left| left < needed);
    let Some(times) = problem
        .times
        .filter(|_| has_deskew(problem, options) && !is_late)
    else {
        return Ok(None);
    };
    let align = |sweeps: [&[Point]; 2], prior: &RigidTransform| match options.ego {
        Ego::Given(ego) => Registration::given(ego),
        Ego::Auto | Ego::Off => {
            let [source, target] = sweeps.map(|points| cropped(points, options));
            host.align(&source, &target, prior, control)
        }
    };
    let ground = ground_of(host, problem, options)?;
    let given = [problem.source, problem.target];
    let rough = align(given, &prior(problem, options));
    let motion = &rough.motion;
    let stands =
        motion.translation.vector.norm() < STANDS[0] && motion.rotation.angle() < STANDS[1];
    if stands && !options.always_deskew {
        return Ok(Some(DeskewedPair {
            deskew: None,
            ground,
            neighbors: Vec::new(),
            ego: rough,
        }));
    }
    let move_back = |points: &[Point], times: &[f32]| {
        host.threads()
            .install(|| deskewed(points, times, motion, options.elapsed_s()))
    };
    let moved = [0, 1].map(|sweep| move_back(given[sweep], times[sweep]));
    let fine = align([&moved[0], &moved[1]], motion);
    let distance = || {
        let fit = Fit::new(problem.source, ground.each_ref().map(Vec::as_slice));
        [
            fit.distance_m(problem.source, problem.target, motion),
            fit.distance_m(&moved[0], &moved[1], &fine.motion),
        ]
    };
    let distance_m = host.threads().install(distance);
    let is_used = options.always_deskew || distance_m[1] < BETTER * distance_m[0];
    let neighbor = |sweep: &NeighborSweep<'_>| match sweep.times {
        Some(times) => move_back(sweep.points, times),
        None => sweep.points.to_vec(),
    };
    Ok(Some(DeskewedPair {
        neighbors: problem
            .neighbors
            .iter()
            .filter(|_| is_used)
            .map(neighbor)
            .collect(),
        ground,
        ego: if is_used { fine } else { rough },
        deskew: Some(Deskew {
            distance_m,
            points: is_used.then(|| moved.map(Arc::from)),
        }),
    }))
}

/// The ground masks of a pair: those that are given, or segmented.
///
/// # Errors
/// None that an estimate of the pair has not.
fn ground_of(
    host: &Host,
    problem: &Problem,
    options: &Options,
) -> Result<[Vec<bool>; 2], FlowError> {
    let given = problem.ground.map_or([None; 2], |masks| masks.map(Some));
    let sweeps = [(problem.source, given[0]), (problem.target, given[1])];
    let options = Options {
        ground: Ground::Auto,
        ..options.clone()
    };
    let masks = ground_masks(sweeps, &options, &|sweeps| host.ground(sweeps))?;
    Ok(masks.map(|mask| mask.unwrap_or_default().into_owned()))
}

impl DeskewedPair {
    /// The ground masks for `problem`: where the options segment the ground, those found here.
    pub(super) fn ground<'a>(
        &'a self,
        problem: &Problem<'a>,
        options: &Options,
    ) -> Option<[&'a [bool]; 2]> {
        let found = || self.ground.each_ref().map(Vec::as_slice);
        let is_missing = options.ground == Ground::Auto;
        problem.ground.or_else(|| is_missing.then(found))
    }

    /// `problem` with the deskewed neighbor sweeps, if the pair is deskewed.
    pub(super) fn neighbors<'a>(&'a self, problem: &Problem<'a>) -> Vec<NeighborSweep<'a>> {
        let mut neighbors = problem.neighbors.to_vec();
        for (sweep, points) in neighbors.iter_mut().zip(&self.neighbors) {
            sweep.points = points;
        }
        neighbors
    }
}
