//! Clouds made even: one point a voxel, so that near rings weigh no more than far walls.
//!
//! It must not know what the points are for.

use crate::flow::points::{Point, floor};

/// Voxels along an axis on each side of the origin; what is farther is left out.
pub(super) const REACH: f32 = (1 << 20) as f32;

/// The mean of each voxel's points, in the order of the voxels: x, then y, then z.
pub(super) fn thinned(points: &[Point], voxel_m: f32) -> Vec<Point> {
    let keyed = points.iter().zip(0_u32..);
    let mut keyed: Vec<(u64, u32)> = keyed
        .filter_map(|(&point, row)| Some((key(point, voxel_m)?, row)))
        .collect();
    keyed.sort_unstable();
    let voxels = keyed.chunk_by(|(key, _), (next, _)| key == next);
    voxels.map(|voxel| mean(points, voxel)).collect()
}

/// The voxel's number; none out of reach.
fn key(point: Point, voxel_m: f32) -> Option<u64> {
    let at = point.map(|c| floor(c / voxel_m));
    let [x, y, z] = at.map(|c| (c + REACH) as u64);
    at.iter()
        .all(|c| c.abs() < REACH)
        .then_some(x << 42 | y << 21 | z)
}

fn mean(points: &[Point], voxel: &[(u64, u32)]) -> Point {
    let mut sum = [0.0; 3];
    for &(_, row) in voxel {
        for (sum, c) in sum.iter_mut().zip(points[row as usize]) {
            *sum += f64::from(c);
        }
    }
    sum.map(|sum| (sum / voxel.len() as f64) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_voxel_keeps_the_mean_of_its_points_whatever_their_order() {
        let mut points = vec![[0.1, 0.1, 0.1], [-0.1, 0.1, 0.1], [0.3, 0.1, 0.1]];
        let thin = thinned(&points, 0.5);
        assert_eq!(thin, [[-0.1, 0.1, 0.1], [0.2, 0.1, 0.1]]);
        points.swap(0, 1);
        assert_eq!(thinned(&points, 0.5), thin);
    }

    #[test]
    fn points_out_of_reach_and_what_is_no_number_are_left_out() {
        let points = [
            [f32::NAN, 0.0, 0.0],
            [0.0, f32::INFINITY, 0.0],
            [1e9, 0.0, 0.0],
        ];
        assert_eq!(thinned(&points, 0.5), [[0.0; 3]; 0]);
    }
}
