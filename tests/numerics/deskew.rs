//! Sweeps whose points are measured one after the other.

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::{SimulatedPair, Street, StreetOptions};
use fnsf::flow::{Estimate, FlowError, Preset, Problem, Uncontrolled, estimate};

fn pair(seed: u64, rolling: bool) -> SimulatedPair {
    let street = StreetOptions {
        seed,
        speed_mps: Some(30.0),
        rolling,
        ..StreetOptions::default()
    };
    let street = Street::new(&street).and_then(|street| street.pair(0));
    street.expect("a street")
}

fn estimated(pair: &SimulatedPair, times: Option<[&[f32]; 2]>) -> Result<Estimate, FlowError> {
    let problem = Problem {
        times,
        ..Problem::pair(&pair.source, &pair.target)
    };
    let backend = CpuBackend::new(None).expect("threads");
    let options = Preset::Default.options(None);
    estimate(&backend, &problem, &options, &Uncontrolled)
}

/// Mean end-point error of static points off the ground, metres.
fn static_error(pair: &SimulatedPair, found: &Estimate) -> f64 {
    let rows = (0..pair.flow.len())
        .filter(|&row| !pair.dynamic[row] && !pair.ground_source[row] && found.valid[row]);
    let off = |row: usize| -> f64 {
        let [found, truth] = [found.flow[row], pair.flow[row]];
        let square = (0..3).map(|a| f64::from(found[a] - truth[a]).powi(2));
        square.sum::<f64>().sqrt()
    };
    let errors: Vec<f64> = rows.map(off).collect();
    errors.iter().sum::<f64>() / errors.len() as f64
}

#[test]
fn a_rolling_sweep_at_thirty_metres_a_second_is_deskewed_as_exactly_as_one_instant() {
    let [mut instant, mut rolling, mut deskewed] = [0.0; 3];
    for seed in 7000..7004 {
        let still = pair(seed, false);
        instant += static_error(&still, &estimated(&still, None).expect("flow"));
        let pair = pair(seed, true);
        rolling += static_error(&pair, &estimated(&pair, None).expect("flow"));
        let [source, target] = pair.times.as_ref().expect("a rolling sweep");
        let found = estimated(&pair, Some([source, target])).expect("flow");
        assert!(found.deskew.as_ref().is_some_and(|d| d.points.is_some()));
        deskewed += static_error(&pair, &found);
    }
    assert!(deskewed < 1.5 * instant, "{deskewed} {instant}");
    assert!(rolling > 5.0 * instant, "{rolling} {instant}");
}

#[test]
fn sweeps_that_were_deskewed_before_are_taken_as_they_are() {
    let pair = pair(7010, false);
    let spinning = |points: &[[f32; 3]]| -> Vec<f32> {
        let share = |&[x, y, _]: &[f32; 3]| y.atan2(x) / std::f32::consts::TAU + 0.5;
        points.iter().map(|point| 0.1 * share(point)).collect()
    };
    let times = [&pair.source, &pair.target].map(|points| spinning(points));
    let found = estimated(&pair, Some([&times[0], &times[1]])).expect("flow");
    let deskew = found.deskew.as_ref().expect("times are known");
    assert!(deskew.points.is_none());
    let [given, deskewed] = deskew.distance_m;
    assert!(given < deskewed, "{given} {deskewed}");
    assert!(static_error(&pair, &found) < 0.005);
}

#[test]
fn times_of_another_length_are_refused_by_name() {
    let pair = pair(7010, false);
    let times = vec![0.0; pair.source.len()];
    let refused = estimated(&pair, Some([&times, &times[1..]])).expect_err("a time is missing");
    assert!(refused.is_input());
    let message = refused.to_string();
    assert!(message.starts_with("the target cloud has"), "{message}");
}
