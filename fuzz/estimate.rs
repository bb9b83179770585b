//! Estimates, tracks and dense clouds from strange clouds: few points, far points, all in one place,
//! on a line, NaN. Every row has a finite flow or an honest mask, and nothing panics.

use std::sync::OnceLock;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::densify::{LaterSweeps, Plan, densify};
use fnsf::flow::tracks::{ClusteredSweep, Tracker};
use fnsf::flow::{
    Control, Estimate, FlowError, Interrupt, MotionField, Options, Point, Preset, Problem,
    Sequence, Sweep, Uncontrolled, estimate, predict_cost,
};
use libfuzzer_sys::Corpus;

use crate::pieces::Pieces;

/// The most points of a cloud.
const POINTS: usize = 300;

const PRESETS: [Preset; 8] = [
    Preset::Default,
    Preset::Label,
    Preset::Neural,
    Preset::Paper,
    Preset::NsfpBaseline,
    Preset::NsfpKdtree,
    Preset::FnsfLinear,
    Preset::NsfpPlusPlus,
];

fn backend() -> &'static CpuBackend {
    static BACKEND: OnceLock<CpuBackend> = OnceLock::new();
    BACKEND.get_or_init(|| CpuBackend::new(Some(1)).expect("a backend"))
}

/// Options of little work: a preset, and bits for the others.
fn options(pieces: &mut Pieces<'_>, presets: &[Preset]) -> Options {
    let preset = presets[usize::from(pieces.byte()) % presets.len()];
    let bits = pieces.byte();
    let mut options = preset.options(None);
    options.force = bits & 1 != 0;
    options.always_deskew = bits & 2 != 0;
    options.max_points = (bits & 4 != 0).then_some(40);
    options.crop_m = (bits & 8 != 0).then_some(30.0);
    options.min_range_m = (bits & 16 != 0).then_some(1.0);
    options.newest_first = bits & 32 != 0;
    options.dt_s = [0.1, 1e-3, 60.0, 0.5][usize::from(bits >> 6)];
    if let Some(field) = options.field_mut() {
        field.max_iterations = 3;
    }
    options
}

/// A cloud: a scale and 6 bytes for a point, so that strange places are a few changes apart.
fn cloud(pieces: &mut Pieces<'_>) -> Vec<Point> {
    let count = usize::from(pieces.byte()) % POINTS;
    let repeat = 1 + usize::from(pieces.byte() % 4);
    let step = [0.01, 0.1, 1.0, 30.0][usize::from(pieces.byte() % 4)];
    let offset = [0.0, 0.0, 500.0, 9e5][usize::from(pieces.byte() % 4)];
    let mut points = Vec::new();
    for _ in 0..count {
        let place: [i16; 3] = core::array::from_fn(|_| i16::from_le_bytes(pieces.array()));
        let point = place.map(|steps| match steps {
            i16::MAX => f32::NAN,
            i16::MIN => f32::INFINITY,
            steps => offset + f32::from(steps) * step,
        });
        // Blocks of points, as objects have them.
        for copy in 0..repeat {
            points.push([point[0] + copy as f32 * 0.1, point[1], point[2]]);
        }
        if pieces.is_empty() {
            break;
        }
    }
    points
}

fn check(points: &[Point], found: &Estimate) {
    assert_eq!(found.flow.len(), points.len());
    assert_eq!(found.valid.len(), points.len());
    assert!(
        found
            .flow
            .as_flattened()
            .iter()
            .all(|value| value.is_finite()),
        "a flow is not finite"
    );
    let bytes = found.motion.to_bytes();
    assert!(
        MotionField::from_bytes(&bytes).is_ok(),
        "the motion field is not read back"
    );
}

/// A pair.
pub(crate) fn pair(bytes: &[u8]) -> Corpus {
    let mut pieces = Pieces(bytes);
    let options = options(&mut pieces, &PRESETS);
    let [has_times, has_ground, late] =
        [1, 2, 4].map(|bit| pieces.0.first().is_some_and(|b| b & bit != 0));
    pieces.byte();
    let clouds = [(); 2].map(|()| cloud(&mut pieces));
    let times = clouds
        .each_ref()
        .map(|cloud| -> Vec<f32> { (0..cloud.len()).map(|row| row as f32 * 3e-4).collect() });
    let ground = clouds
        .each_ref()
        .map(|cloud| -> Vec<bool> { (0..cloud.len()).map(|row| row % 3 == 0).collect() });
    let problem = Problem {
        times: has_times.then_some(times.each_ref().map(Vec::as_slice)),
        ground: has_ground.then_some(ground.each_ref().map(Vec::as_slice)),
        ..Problem::pair(&clouds[0], &clouds[1])
    };
    let _predicted = predict_cost(&problem, &options);
    let found = match late {
        true => estimate(backend(), &problem, &options, &Late),
        false => estimate(backend(), &problem, &options, &Uncontrolled),
    };
    if let Ok(found) = found {
        check(&clouds[0], &found);
    }
    Corpus::Keep
}

/// A deadline that has passed at the start.
struct Late;

impl Control for Late {
    fn seconds_left(&self) -> Option<f64> {
        Some(-1.0)
    }

    fn interrupt(&self) -> Option<Interrupt> {
        Some(Interrupt::Deadline)
    }
}

/// A sequence with its tracks and a dense cloud.
pub(crate) fn sequence(bytes: &[u8]) -> Corpus {
    let mut pieces = Pieces(bytes);
    let options = options(&mut pieces, &[Preset::Default, Preset::Label]);
    let later = match pieces.byte() % 2 {
        0 => LaterSweeps::Reverse,
        _ => LaterSweeps::Inverse,
    };
    let reference = f64::from(pieces.byte()) / 32.0;
    let mut sweeps = Vec::new();
    while !pieces.is_empty() && sweeps.len() < 6 {
        let points = cloud(&mut pieces);
        sweeps.push(Sweep {
            points,
            ..Sweep::default()
        });
    }
    let mut sequence = Sequence::default();
    let mut found = Vec::new();
    for sweep in &sweeps {
        match sequence.push(backend(), sweep.clone(), &options, &Uncontrolled) {
            Ok(more) => found.extend(more),
            Err(error) => return refused(&error),
        }
    }
    loop {
        match sequence.finish(backend(), &Uncontrolled) {
            Ok(more) if more.is_empty() => break,
            Ok(more) => found.extend(more),
            Err(error) => return refused(&error),
        }
    }
    assert_eq!(found.len(), sweeps.len().saturating_sub(1));
    let mut tracker = Tracker::default();
    for (sweep, found) in sweeps.iter().zip(&found) {
        check(&sweep.points, found);
        if let Ok(clustered) = ClusteredSweep::new(&sweep.points, found, options.dt_s) {
            tracker.push(&clustered).expect("a row for each point");
        }
    }
    for track in tracker.finish() {
        assert!(
            track
                .states
                .is_sorted_by(|one, next| one.sweep < next.sweep)
        );
    }
    if let Ok(plan) = Plan::new(sweeps.len(), reference, later, 1) {
        let field = |edge: fnsf::flow::densify::FlowEdge| {
            Some(&found.get(edge.source.min(edge.target))?.motion)
        };
        if let Ok(dense) = densify(backend(), &plan, &sweeps, field, &Uncontrolled) {
            assert_eq!(dense.points.len(), dense.sweep.len());
        }
    }
    Corpus::Keep
}

fn refused(_: &FlowError) -> Corpus {
    Corpus::Keep
}
