//! Tests on real sweeps, if `FNSF_REAL_DATA` names a folder that has them.

use fnsf::flow::Point;
use fnsf::formats::{
    GroundRaster, Pair, is_pair, read_av2_labels, read_cloud, read_flow, read_pair, read_poses,
};

#[path = "../common/real_data.rs"]
mod folder;

/// Sweeps are float16 on disk and float32 in `pair.npz`. The conversion is exact.
const SAME: f32 = 0.0;

/// The flow in `pair.npz` is the float32 flow of the labels.
const SAME_FLOW_M: f32 = 1e-6;

pub(crate) fn real(path: &str) -> Option<Vec<u8>> {
    let path = folder::real_data()?.join(path);
    Some(std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
}

fn real_pair(folder: &str) -> Option<Pair> {
    let bytes = real(&format!("{folder}/pair.npz"))?;
    assert!(is_pair(&bytes));
    Some(read_pair(&bytes).unwrap())
}

fn largest_difference(left: &[Point], right: &[Point]) -> f32 {
    assert_eq!(left.len(), right.len());
    let differences = left.as_flattened().iter().zip(right.as_flattened());
    differences
        .map(|(left, right)| (left - right).abs())
        .fold(0.0, f32::max)
}

fn count(mask: &[bool]) -> usize {
    mask.iter().filter(|&&flag| flag).count()
}

#[test]
fn av2_sweeps_are_the_pairs_clouds() {
    let Some(pair) = real_pair("av2_7fab") else {
        return;
    };
    let sweep = |name: &str| {
        let bytes = real(&format!("av2_7fab/{name}")).unwrap();
        read_cloud(&bytes, Some(name)).unwrap()
    };
    let source = sweep("315966265259836000.feather");
    let target = sweep("315966265360032000.feather");
    assert_eq!(source.points.len(), 99_229);
    assert_eq!(target.points.len(), 99_466);
    assert_eq!(source.no_return, 0);
    assert!(largest_difference(&source.points, &pair.source) <= SAME);
    assert!(largest_difference(&target.points, &pair.target) <= SAME);
}

#[test]
fn av2_labels_are_the_pairs_truth() {
    let Some(pair) = real_pair("av2_7fab") else {
        return;
    };
    let labels = read_av2_labels(&real("av2_7fab/flow_labels.feather").unwrap()).unwrap();
    let truth = pair.truth.unwrap();
    assert!(largest_difference(&labels.truth.flow, &truth.flow) <= SAME_FLOW_M);
    assert!(labels.truth.valid == truth.valid);
    assert!(labels.truth.dynamic == truth.dynamic);
    // One point of 17,374 lies on the edge of the ground raster.
    let ground = pair.ground.unwrap().source;
    assert!(
        labels
            .ground
            .iter()
            .zip(&ground)
            .filter(|(left, right)| left != right)
            .count()
            <= 1
    );
    // Two points lie in a box and have class 0.
    assert_eq!(count(&labels.truth.foreground.unwrap()), 9_397);
    assert_eq!(count(&truth.foreground.unwrap()), 9_399);
    let dynamic = labels.truth.dynamic.unwrap();
    let off_ground = dynamic
        .iter()
        .zip(&ground)
        .filter(|&(&moves, &ground)| moves && !ground);
    assert_eq!(off_ground.count(), 1_910);
}

#[test]
fn the_kitti_pcd_is_the_pairs_cloud() {
    let Some(pair) = real_pair("kitti_0000") else {
        return;
    };
    for (name, cloud) in [
        ("0000000000.pcd", &pair.source),
        ("0000000001.pcd", &pair.target),
    ] {
        let read = read_cloud(&real(&format!("kitti_0000/{name}")).unwrap(), Some(name)).unwrap();
        assert_eq!(read.no_return, 0);
        assert!(largest_difference(&read.points, cloud) <= SAME, "{name}");
    }
    let truth = pair.truth.unwrap();
    assert_eq!(count(&truth.valid), 20_478);
    assert_eq!(count(truth.foreground.as_deref().unwrap()), 2_417);
}

#[test]
fn the_small_gicp_ply_is_the_pairs_cloud() {
    let Some(pair) = real_pair("small_gicp") else {
        return;
    };
    for (name, cloud) in [("source.ply", &pair.source), ("target.ply", &pair.target)] {
        let read = read_cloud(&real(&format!("small_gicp/{name}")).unwrap(), Some(name)).unwrap();
        assert!(largest_difference(&read.points, cloud) <= SAME, "{name}");
    }
}

/// In a static world the flow equals the motion of the points by the ego motion.
#[test]
fn the_static_pairs_flow_is_its_ego_motion() {
    // The transform was printed with six digits: 1e-6 off orthonormal, 0.1 mm at 75 m.
    const PRINTED_M: f32 = 1e-4;
    let Some(pair) = real_pair("small_gicp") else {
        return;
    };
    let ego = pair.ego.unwrap();
    let moved = |point: &Point| {
        let [x, y, z] = point.map(f64::from);
        let there = ego * nalgebra::Point3::new(x, y, z);
        [
            (there.x - x) as f32,
            (there.y - y) as f32,
            (there.z - z) as f32,
        ]
    };
    let flow: Vec<Point> = pair.source.iter().map(moved).collect();
    assert!(largest_difference(&flow, &pair.truth.unwrap().flow) <= PRINTED_M);
}

#[test]
fn a_pair_reads_as_a_flow_file() {
    let Some(pair) = real_pair("av2_7fab") else {
        return;
    };
    let flow = read_flow(&real("av2_7fab/pair.npz").unwrap(), None).unwrap();
    let truth = pair.truth.unwrap();
    assert!(flow.flow == truth.flow);
    assert!(flow.valid == Some(truth.valid));
    let labels = real("av2_7fab/flow_labels.feather").unwrap();
    assert_eq!(read_flow(&labels, None).unwrap().flow.len(), 99_229);
}

const AV2_SWEEPS: [&str; 2] = ["315966265259836000.feather", "315966265360032000.feather"];

fn av2_poses() -> Option<Vec<fnsf::flow::RigidTransform>> {
    let bytes = real("av2_7fab/city_SE3_egovehicle.feather")?;
    Some(read_poses(&bytes, &AV2_SWEEPS).unwrap())
}

#[test]
fn av2_poses_are_the_pairs_ego_motion() {
    /// City coordinates of kilometres in float64, and a matrix printed from a quaternion.
    const SAME_EGO: f64 = 1e-6;
    let (Some(pair), Some(poses)) = (real_pair("av2_7fab"), av2_poses()) else {
        return;
    };
    let motion = poses[1].inv_mul(&poses[0]);
    let difference = motion.to_homogeneous() - pair.ego.unwrap().to_homogeneous();
    assert!(difference.abs().max() < SAME_EGO, "{difference}");
}

#[test]
fn the_av2_raster_calls_ground_what_the_pair_does() {
    let (Some(pair), Some(poses)) = (real_pair("av2_7fab"), av2_poses()) else {
        return;
    };
    let scene = "av2_7fab/7fab2350-7eaf-3b7e-a39d-6937a4c1bede";
    let heights = real(&format!("{scene}_ground_height_surface____PIT.npy")).unwrap();
    let similarity = real(&format!("{scene}___img_Sim2_city.json")).unwrap();
    let raster = GroundRaster::read(&heights, &similarity).unwrap();
    let ground = pair.ground.unwrap();
    let clouds = [
        (&pair.source, &ground.source),
        (&pair.target, &ground.target),
    ];
    for ((points, truth), pose) in clouds.into_iter().zip(&poses) {
        let found = raster.ground(points, pose);
        assert!(count(truth) > 17_000);
        assert!(found == *truth);
    }
}
