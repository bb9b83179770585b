//! Tests of the predicted cost of an estimate against its actual memory and work.

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::distance::{DistanceError, Metric, Sites};
use fnsf::flow::field::BackendError;
use fnsf::flow::simulate::StreetOptions;
use fnsf::flow::{
    ChamferOptions, DistanceLossOptions, Ground, LossOptions, NearestSearch, Options, Preset,
    Problem, estimate, predict_cost,
};
use fnsf::flow::{FlowError, Uncontrolled};

use super::scenes::{estimated, real_pair, street};

/// Bound on the memory beside the distance transform: sites, points and the network's working sets.
const BESIDE_BYTES: usize = 48 << 20;
const BESIDE_SHARE: f64 = 1.5;

fn distance_loss(options: &mut Options) -> &mut DistanceLossOptions {
    let field = options.field_mut().expect("a field");
    field.loss.distance_mut().expect("a distance transform")
}

#[test]
fn bytes_and_bricks_are_never_below_the_truth_and_not_far_above() {
    let simulated = Some(street(&StreetOptions::default()));
    let real = ["av2_7fab", "kitti_0000", "small_gicp"].map(real_pair);
    for pair in [simulated].into_iter().chain(real).flatten() {
        let ground = pair.ground.as_ref().expect("the pair has ground masks");
        let problem = Problem {
            source: &pair.source,
            target: &pair.target,
            ground: Some([&ground.source, &ground.target]),
            times: None,
            before: None,
            neighbors: &[],
        };
        for sites in [Sites::Cells, Sites::Points] {
            for max_points in [None, Some(5000)] {
                let mut options = Preset::Neural.options(max_points);
                options.ground = Ground::Mask;
                distance_loss(&mut options).transform.sites = sites;
                options.field_mut().expect("a field").max_iterations = 0;
                let cost = predict_cost(&problem, &options).expect("it is taken");
                let estimate = estimated(&pair, &options);
                assert_eq!(cost.source_points, estimate.points);
                assert_eq!(
                    cost.transform_bytes,
                    estimate.fit().expect("a fit").distance_bytes
                );
                assert!(cost.bytes >= estimate.fit().expect("a fit").distance_bytes);
                let most = estimate.fit().expect("a fit").distance_bytes as f64 * BESIDE_SHARE;
                // The points that a sample is drawn from, with their rows and order.
                let all = pair.source.len() + pair.target.len();
                let drawn_from = max_points.map_or(0, |_| 28 * all);
                let most = most as usize + BESIDE_BYTES + drawn_from;
                assert!(cost.bytes <= most, "{cost:?}");
            }
        }
    }
}

#[test]
fn work_grows_with_iterations_points_and_detail() {
    let pair = street(&StreetOptions {
        azimuth_steps: 400,
        ..StreetOptions::default()
    });
    let problem = Problem::pair(&pair.source, &pair.target);
    let work = |options: &Options| {
        predict_cost(&problem, options)
            .expect("taken")
            .multiply_adds
    };
    let base = Preset::Neural.options(None);
    let change = |change: fn(&mut Options)| {
        let mut options = base.clone();
        change(&mut options);
        work(&options)
    };
    assert!(change(|o| o.field_mut().expect("a field").max_iterations = 300) > work(&base));
    assert!(change(|o| o.field_mut().expect("a field").batch = None) > work(&base));
    assert!(change(|o| distance_loss(o).transform.sites = Sites::Points) > work(&base));
    assert!(change(|o| o.max_points = Some(1000)) < work(&base));
    assert!(work(&Preset::Paper.options(None)) > work(&base));
    let paper = predict_cost(&problem, &Preset::Paper.options(None)).expect("taken");
    assert!((paper.seconds(2.0) - paper.multiply_adds / 2.0).abs() < f64::EPSILON);
}

#[test]
fn what_the_estimate_refuses_has_no_price() {
    let cloud = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5], [2.0; 3]];
    let wide = [[0.0; 3], [1e6, 0.0, 0.0], [0.0, 1.0, 0.5]];
    let flags = [false; 2];
    let backend = CpuBackend::new(Some(1)).expect("threads");
    let mut options = Preset::Neural.options(None);
    options.field_mut().expect("a field").max_iterations = 0;
    let mut masked = options.clone();
    masked.ground = Ground::Mask;
    let mut tight = options.clone();
    distance_loss(&mut tight).transform.max_bytes = 1000;
    let mut dense = tight.clone();
    distance_loss(&mut dense).transform.metric = Metric::Chamfer;
    let cases = [
        (&cloud[..2], None, &options),
        (&wide[..], None, &options),
        (&cloud[..], None, &masked),
        (&cloud[..], Some([&flags[..], &flags[..]]), &masked),
        (&cloud[..], None, &tight),
        (&cloud[..], None, &dense),
    ];
    for (source, ground, options) in cases {
        let problem = Problem {
            source,
            target: &cloud,
            ground,
            times: None,
            before: None,
            neighbors: &[],
        };
        let refused = predict_cost(&problem, options).expect_err("refused");
        let truth = estimate(&backend, &problem, options, &Uncontrolled).expect_err("refused");
        assert_eq!(refused.to_string(), truth.to_string());
        assert!(refused.is_input());
    }
    let mut untruncated = Preset::NsfpBaseline.options(None);
    untruncated.field_mut().expect("a field").loss = LossOptions::Chamfer(ChamferOptions {
        truncation_m: f32::NAN,
        ..ChamferOptions::published(NearestSearch::KdTree)
    });
    let problem = Problem::pair(&cloud, &cloud);
    let refused = predict_cost(&problem, &untruncated).expect_err("refused");
    let truth = estimate(&backend, &problem, &untruncated, &Uncontrolled).expect_err("refused");
    assert_eq!(refused.to_string(), truth.to_string());
    assert!(refused.to_string().contains("truncation of NaN m"));
    assert!(matches!(
        predict_cost(&problem, &tight),
        Err(FlowError::Backend(BackendError::Distance(
            DistanceError::Memory { .. }
        )))
    ));
}

#[test]
fn a_search_for_objects_is_priced_by_all_points_whatever_is_drawn() {
    let pair = street(&StreetOptions {
        azimuth_steps: 400,
        ..StreetOptions::default()
    });
    let problem = Problem::pair(&pair.source, &pair.target);
    for preset in [Preset::Default, Preset::Label] {
        let of = |max_points| predict_cost(&problem, &preset.options(max_points)).expect("taken");
        assert_eq!(of(Some(100)), of(None));
        assert_eq!(of(None).transform_bytes, 0);
    }
    let fitted = predict_cost(&problem, &Preset::Neural.options(Some(100))).expect("taken");
    assert_eq!(fitted.source_points, 100);
}
