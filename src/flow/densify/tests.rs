//! Densification with constant fields, whose flow is the same at every point.

use super::accumulate::part_of;
use super::*;
use crate::flow::cpu::CpuBackend;
use crate::flow::data::DenseCloud;
use crate::flow::data::RigidTransform;
use crate::flow::data::{Point, Uncontrolled, transform_point};
use crate::flow::field::{Conditioning, Network, last_layer, mlp};
use crate::flow::motion::MotionField;
use crate::flow::motion::{Residual, SampledMotion};
use crate::flow::sequence::Sweep;

/// Rounding of single-precision coordinates of a few metres, metres.
const ROUNDING_M: f32 = 1e-5;

/// A field with the same flow everywhere.
fn constant(ego: Option<RigidTransform>, flow: Point) -> MotionField {
    let mut parameters = mlp::zeros();
    let bias = last_layer().bias;
    parameters.as_mut_slice()[bias..bias + 3].copy_from_slice(&flow);
    let conditioning = Conditioning {
        center: [0.0; 3],
        scale: 0.1,
    };
    MotionField {
        ego,
        residual: Residual::Network(Network {
            parameters,
            conditioning,
        }),
    }
}

fn sweeps(count: usize) -> Vec<Sweep> {
    (0..count)
        .map(|index| Sweep {
            points: vec![[index as f32, 0.0, 0.0], [f32::NAN; 3], [0.0, 1.0, 2.0]],
            ground: Some(vec![false, false, true]),
            ..Sweep::default()
        })
        .collect()
}

/// A vehicle that drives 1 m forward and turns 0.1 rad per step.
fn drive() -> RigidTransform {
    RigidTransform::new([-1.0, 0.0, 0.0].into(), [0.0, 0.0, 0.1].into())
}

fn dense(
    plan: &Plan,
    sweeps: &[Sweep],
    ahead: &MotionField,
    back: &MotionField,
) -> Result<DenseCloud, DensifyError> {
    let backend = CpuBackend::new(Some(1)).expect("a thread");
    let of = |edge: FlowEdge| {
        Some(if edge.target > edge.source {
            ahead
        } else {
            back
        })
    };
    densify(&backend, plan, sweeps, of, &Uncontrolled)
}

/// Position of a static point of sweep `frame` in the frame of the reference time `reference_time`.
fn expected(point: Point, frame: usize, reference_time: f64) -> Point {
    let anchor = reference_time.floor();
    let mut motion = part_of(&drive(), reference_time - anchor);
    let steps = anchor - frame as f64;
    for _ in 0..steps.abs() as usize {
        motion *= if steps < 0.0 {
            drive().inverse()
        } else {
            drive()
        };
    }
    transform_point(&motion, point)
}

fn assert_near(found: Point, expected: Point, of: &str) {
    for axis in 0..3 {
        let off = (found[axis] - expected[axis]).abs();
        assert!(off < ROUNDING_M, "{of}: {found:?}, not {expected:?}");
    }
}

#[test]
fn the_static_world_lands_where_the_vehicle_sees_it_whatever_the_instant() {
    let still = [drive(), drive().inverse()].map(|ego| MotionField {
        ego: Some(ego),
        residual: Residual::Still,
    });
    let [ahead, back] = &still;
    let sweeps = sweeps(5);
    for later in [LaterSweeps::Reverse, LaterSweeps::Inverse] {
        for reference_time in [0.0, 2.0, 2.25, 3.5, 4.0] {
            let plan = Plan::new(5, reference_time, later, 2).expect("a plan");
            let cloud = dense(&plan, &sweeps, ahead, back).expect("a cloud");
            assert_eq!(
                cloud.points.len(),
                10,
                "points that are no numbers stay out"
            );
            for (row, &frame) in cloud.sweep.iter().enumerate() {
                let index = frame as usize;
                let point = sweeps[index].points[if row % 2 == 0 { 0 } else { 2 }];
                let expected = expected(point, index, reference_time);
                assert_near(
                    cloud.points[row],
                    expected,
                    &format!("{later:?} {reference_time}"),
                );
                assert_eq!(cloud.age[row], (reference_time - f64::from(frame)) as f32);
                assert!(!cloud.dynamic[row] && cloud.converged[row]);
            }
        }
    }
}

#[test]
fn a_point_with_the_largest_coordinate_keeps_its_row() {
    // Readers let it pass, and what they give beside the points is ordered by these rows.
    let mut sweeps = sweeps(2);
    sweeps[0].points[0] = [1e6, 0.0, 0.0];
    let still = MotionField {
        ego: None,
        residual: Residual::Still,
    };
    let plan = Plan::new(2, 0.0, LaterSweeps::Reverse, 1).expect("a plan");
    let cloud = dense(&plan, &sweeps, &still, &still).expect("a cloud");
    assert_eq!(cloud.points.len(), 4);
    assert_eq!(cloud.points[0], [1e6, 0.0, 0.0]);
}

#[test]
fn what_moves_is_integrated_step_by_step_and_ground_is_not() {
    // The vehicle stands still, so that the steps add up.
    let standing = Some(RigidTransform::identity());
    let (ahead, back) = (
        constant(standing, [0.5, 0.0, 0.0]),
        constant(standing, [-0.5, 0.0, 0.0]),
    );
    let sweeps = sweeps(4);
    for later in [LaterSweeps::Reverse, LaterSweeps::Inverse] {
        for (reference_time, substeps) in [(2.0, 1), (2.0, 4), (1.5, 1)] {
            let plan = Plan::new(4, reference_time, later, substeps).expect("a plan");
            let cloud = dense(&plan, &sweeps, &ahead, &back).expect("a cloud");
            for (row, &frame) in cloud.sweep.iter().enumerate() {
                let age = (reference_time - f64::from(frame)) as f32;
                let is_ground = row % 2 == 1;
                let point = sweeps[frame as usize].points[if is_ground { 2 } else { 0 }];
                let advect = if is_ground { 0.0 } else { 0.5 * age };
                let expected = [point[0] + advect, point[1], point[2]];
                assert_near(
                    cloud.points[row],
                    expected,
                    &format!("{later:?} {reference_time}"),
                );
                assert_eq!(cloud.dynamic[row], advect != 0.0);
            }
        }
    }
}

#[test]
fn what_a_field_says_below_the_threshold_of_motion_moves_nothing() {
    let standing = Some(RigidTransform::identity());
    let noise = constant(standing, [0.02, 0.02, 0.0]);
    let plan = Plan::new(3, 2.0, LaterSweeps::Reverse, 1).expect("a plan");
    let sweeps = sweeps(3);
    let cloud = dense(&plan, &sweeps, &noise, &noise).expect("a cloud");
    assert_eq!(cloud.points[0], sweeps[0].points[0]);
    // Without an ego motion the field moves static points, too, and the ground with them.
    let all = constant(None, [0.02, 0.02, 0.0]);
    let cloud = dense(&plan, &sweeps, &all, &all).expect("a cloud");
    assert_near(cloud.points[0], [0.04, 0.04, 0.0], "two steps");
    assert_near(cloud.points[1], [0.04, 1.04, 2.0], "the ground");
}

#[test]
fn an_object_does_not_take_the_ground_below_it_along() {
    let mut sweeps = sweeps(2);
    sweeps[0].points[2] = [0.0, 0.0, -0.3];
    let by = vec![[1.5, 0.0, 0.0]];
    let field = MotionField {
        ego: None,
        residual: Residual::Sampled(SampledMotion::new(vec![[0.0; 3]], by).into()),
    };
    let plan = Plan::new(2, 1.0, LaterSweeps::Reverse, 1).expect("a plan");
    let cloud = dense(&plan, &sweeps, &field, &field).expect("a cloud");
    assert_near(cloud.points[0], [1.5, 0.0, 0.0], "the object");
    assert_near(cloud.points[1], [0.0, 0.0, -0.3], "the ground");
}

#[test]
fn an_object_that_leaves_its_own_points_behind_goes_its_whole_way() {
    // 1.5 m a sweep, with nothing within reach of half the way.
    let standing = Some(RigidTransform::identity());
    let at = |x: f32, by: f32| MotionField {
        ego: standing,
        residual: Residual::Sampled(
            SampledMotion::new(vec![[x, 0.0, 0.0]], vec![[by, 0.0, 0.0]]).into(),
        ),
    };
    let (ahead, back) = (at(0.0, 1.5), at(1.5, -1.5));
    let mut sweeps = sweeps(2);
    sweeps[1].points[0] = [1.5, 0.0, 0.0];
    for later in [LaterSweeps::Reverse, LaterSweeps::Inverse] {
        for (reference_time, x) in [(1.0, 1.5), (0.0, 0.0)] {
            let plan = Plan::new(2, reference_time, later, 4).expect("a plan");
            let cloud = dense(&plan, &sweeps, &ahead, &back).expect("a cloud");
            for row in [0, 2] {
                assert_near(cloud.points[row], [x, 0.0, 0.0], "both sweeps at one place");
                assert!(cloud.converged[row]);
            }
            assert_ne!(cloud.dynamic[0], cloud.dynamic[2], "one of them has moved");
        }
    }
}

#[test]
fn what_a_field_sends_out_of_the_world_stays_and_says_so() {
    let standing = Some(RigidTransform::identity());
    for flow in [[f32::NAN, 0.0, 0.0], [2e6, 0.0, 0.0]] {
        let wild = constant(standing, flow);
        for later in [LaterSweeps::Reverse, LaterSweeps::Inverse] {
            let plan = Plan::new(3, 1.0, later, 1).expect("a plan");
            let sweeps = sweeps(3);
            let cloud = dense(&plan, &sweeps, &wild, &wild).expect("a cloud");
            for (row, &frame) in cloud.sweep.iter().enumerate() {
                let is_ground = row % 2 == 1;
                let point = sweeps[frame as usize].points[if is_ground { 2 } else { 0 }];
                assert_eq!(cloud.points[row], point, "{later:?}");
                assert_eq!(cloud.converged[row], is_ground || frame == 1, "{later:?}");
            }
        }
    }
}

#[test]
fn missing_fields_and_sweeps_are_refused_by_name() {
    let backend = CpuBackend::new(Some(1)).expect("a thread");
    let plan = Plan::new(3, 1.0, LaterSweeps::Reverse, 1).expect("a plan");
    let run = |sweeps: &[Sweep]| densify(&backend, &plan, sweeps, |_| None, &Uncontrolled);
    let edge = FlowEdge {
        source: 0,
        target: 1,
    };
    assert!(matches!(run(&sweeps(3)), Err(DensifyError::NoField(found)) if found == edge));
    let error = run(&sweeps(2)).expect_err("one is missing");
    assert!(matches!(
        error,
        DensifyError::Sweeps {
            sweeps: 2,
            planned: 3
        }
    ));
    let mut short = sweeps(3);
    short[1].ground = Some(vec![true]);
    assert!(matches!(run(&short), Err(DensifyError::Mask(1))));
}
