//! Tests of depth images of simulated streets: the lidar's points and the camera's depth must
//! agree.

use fnsf::flow::depth::{Camera, DepthImage, Intrinsics, Occlusion, project};
use fnsf::flow::simulate::{Street, StreetError, StreetOptions};
use fnsf::flow::{Point, RigidTransform};
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion};

/// A pixel covers 1/360 rad, so its center is up to half of that off the measured point.
const MEDIAN_M: f64 = 0.02;

/// Share of points next to an edge of an object, whose pixel shows the background.
const PAST_EDGES: f64 = 0.05;

/// A camera with half of KITTI's resolution: 6 cm beside, 8 cm below and 27 cm in front of the
/// lidar.
fn camera() -> Camera {
    let intrinsics = Intrinsics {
        fx: 360.0,
        fy: 360.0,
        cx: 305.0,
        cy: 86.0,
    };
    let turn = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(turn));
    let mount = RigidTransform::from_parts([0.06, -0.08, -0.27].into(), turn);
    Camera::new(intrinsics, mount, [621, 187]).expect("a camera")
}

fn street(sweeps: usize) -> Street {
    let options = StreetOptions {
        seed: 8,
        sweeps,
        range_noise_m: 0.0,
        beam_bias_m: 0.0,
        dropout: 0.0,
        ..StreetOptions::default()
    };
    Street::new(&options).expect("a street")
}

/// The static points of every sweep, in the frame of one of them, and all points of that one.
fn static_world(street: &Street, into: usize) -> Vec<Point> {
    let target = street.sweep(into).expect("a frame");
    let carried = |index: usize| {
        let frame = street.sweep(index).expect("a frame");
        let motion = target.world_from_sensor.inv_mul(&frame.world_from_sensor);
        let keep = move |object: i32| index == into || object < 0;
        let rows = frame.points.into_iter().zip(frame.object);
        rows.filter(move |(_, object)| keep(*object))
            .map(move |(point, _)| {
                let there = motion * Point3::from(point.map(f64::from));
                [there.x as f32, there.y as f32, there.z as f32]
            })
    };
    (0..street.sweeps()).flat_map(carried).collect()
}

fn errors(image: &DepthImage, truth: &DepthImage) -> fnsf::flow::depth::DepthErrors {
    image.errors(truth).expect("of the same size")
}

#[test]
fn the_lidars_points_lie_on_what_the_camera_sees() {
    let street = street(2);
    for index in 0..2 {
        let truth = street.depth(index, &camera()).unwrap();
        assert!(truth.density() > 0.85, "{}", truth.density());
        let measured = project(&street.sweep(index).unwrap().points, &camera());
        let errors = errors(&measured, &truth);
        assert!(errors.pixels > 8_000, "{errors:?}");
        assert!(errors.median_m < MEDIAN_M, "{errors:?}");
        assert!(errors.within_5_percent > 1.0 - PAST_EDGES, "{errors:?}");
        assert!(errors.coverage < 0.2, "{errors:?}");
    }
}

#[test]
fn a_camera_in_the_lidars_place_finds_the_lidars_ranges() {
    let mount = RigidTransform::from_parts(
        nalgebra::Translation3::identity(),
        camera().camera_from_lidar().rotation,
    );
    let camera = Camera::new(camera().intrinsics(), mount, [621, 187]).unwrap();
    let street = street(1);
    let truth = street.depth(0, &camera).unwrap();
    let measured = project(&street.sweep(0).unwrap().points, &camera);
    let errors = errors(&measured, &truth);
    assert!(errors.median_m < MEDIAN_M, "{errors:?}");
    // Without parallax only the pixel size lets a pixel show the background of an edge.
    assert!(errors.within_5_percent > 0.97, "{errors:?}");
}

#[test]
fn ten_sweeps_see_three_times_as_much_as_one_and_nothing_through_walls() {
    let street = street(10);
    let into = 5;
    let truth = street.depth(into, &camera()).unwrap();
    let sparse = project(&street.sweep(into).unwrap().points, &camera());
    let dense = project(&static_world(&street, into), &camera());
    assert!(dense.density() > 3.0 * sparse.density());
    // Other sweeps contain points behind the houses, which this camera cannot observe.
    let before = errors(&dense, &truth);
    assert!(before.within_5_percent < 0.8, "{before:?}");
    let clean = dense.without_occluded(&Occlusion::of(&camera()));
    let after = errors(&clean, &truth);
    assert!(clean.density() > 2.0 * sparse.density());
    assert!(after.within_5_percent > 0.96, "{after:?}");
    assert!(after.mean_m < 0.25 * before.mean_m, "{after:?}");
    // The filter removes few points of a single sweep.
    let alone = sparse.without_occluded(&Occlusion::of(&camera()));
    assert!(alone.density() > 0.95 * sparse.density());
}

#[test]
fn a_frame_that_the_street_does_not_have_has_no_depth() {
    let refused = street(2).depth(2, &camera());
    assert_eq!(
        refused,
        Err(StreetError::NoSuchSweep {
            index: 2,
            sweeps: 2
        })
    );
}
