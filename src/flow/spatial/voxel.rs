//! Voxel downsampling: one point a voxel, so that near rings weigh no more than far walls.

use crate::flow::data::{Point, floor};

/// Bound on a voxel's index along an axis, on each side of the origin.
pub(crate) const REACH: f32 = (1 << 20) as f32;

/// Voxel downsampling to the mean of each voxel's points, metres, with voxels of `side_m` metres.
/// The means are ordered by voxel: x, then y, then z. Points beyond [`REACH`] voxels and points
/// that are not finite are dropped.
pub(crate) fn voxel_mean(points: &[Point], side_m: f32) -> Vec<Point> {
    let is_in_reach = |point: &Point| point.iter().all(|c| (c / side_m).abs() < REACH);
    let rows = (0..points.len() as u32).filter(|&row| is_in_reach(&points[row as usize]));
    let keyed = sorted_by_voxel(points, rows, side_m);
    let voxels = keyed.chunk_by(|(key, _), (next, _)| key == next);
    voxels.map(|voxel| mean(points, voxel)).collect()
}

/// Voxel downsampling to the first row of each voxel of `side_m` metres. The rows are in ascending
/// order. Points beyond [`REACH`] voxels share the outermost voxels. All coordinates must be
/// finite.
pub(crate) fn voxel_first(points: &[Point], side_m: f32) -> Vec<u32> {
    let mut keyed = sorted_by_voxel(points, 0..points.len() as u32, side_m);
    keyed.dedup_by_key(|&mut (voxel, _)| voxel);
    let mut rows: Vec<u32> = keyed.into_iter().map(|(_, row)| row).collect();
    rows.sort_unstable();
    rows
}

/// The voxel's key of each row and the row itself, ordered by key and then by row.
fn sorted_by_voxel(
    points: &[Point],
    rows: impl Iterator<Item = u32>,
    side_m: f32,
) -> Vec<(u64, u32)> {
    let mut keyed: Vec<(u64, u32)> = rows
        .map(|row| (key(points[row as usize], side_m), row))
        .collect();
    keyed.sort_unstable();
    keyed
}

/// The key of a point's voxel: 21 bits an axis, x in the highest.
fn key(point: Point, side_m: f32) -> u64 {
    let index = |c: f32| (floor(c / side_m).clamp(-REACH, REACH - 1.0) + REACH) as u64;
    let [x, y, z] = point.map(index);
    x << 42 | y << 21 | z
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
        let thin = voxel_mean(&points, 0.5);
        assert_eq!(thin, [[-0.1, 0.1, 0.1], [0.2, 0.1, 0.1]]);
        points.swap(0, 1);
        assert_eq!(voxel_mean(&points, 0.5), thin);
    }

    #[test]
    fn points_out_of_reach_and_what_is_no_number_are_left_out() {
        let points = [
            [f32::NAN, 0.0, 0.0],
            [0.0, f32::INFINITY, 0.0],
            [1e9, 0.0, 0.0],
        ];
        assert_eq!(voxel_mean(&points, 0.5), [[0.0; 3]; 0]);
    }

    #[test]
    fn the_first_row_of_each_voxel_is_kept_in_the_order_of_the_rows() {
        let points = [
            [5.1, 0.0, 0.0],
            [0.1, 0.1, 0.1],
            [5.2, 0.0, 0.0],
            [-0.1, 0.1, 0.1],
            [1e9, 0.0, 0.0],
            [2e9, 0.0, 0.0],
        ];
        assert_eq!(voxel_first(&points, 0.5), [0, 1, 3, 4]);
    }
}
