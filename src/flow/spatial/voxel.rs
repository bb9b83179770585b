//! Voxel downsampling: one point a voxel, so that near rings weigh no more than far walls.

use super::key_table::KeyTable;
use crate::flow::data::{Point, floors};

/// Bound on a voxel's index along an axis, on each side of the origin.
const REACH: f32 = (1 << 20) as f32;
/// Points of a lidar sweep in a voxel, or fewer.
const EXPECTED: usize = 2;

/// Points whose keys are computed at a time. A loop that also searched the table would take twice the
/// time of both.
const KEYS_AT_ONCE: usize = 4096;

/// Voxel downsampling to the mean of each voxel's points, metres, with voxels of `side_m` metres, in
/// the order of their first points. Points beyond [`REACH`] voxels and points that are not finite are
/// dropped.
pub(crate) fn voxel_mean(points: &[Point], side_m: f32) -> Vec<Point> {
    let reach_m = REACH * side_m;
    let is_in_reach = |point: &Point| point.iter().all(|c| c.abs() < reach_m);
    let mut numbers = KeyTable::<u32>::new(points.len() / EXPECTED);
    let mut sums: Vec<([f64; 3], f64)> = Vec::new();
    let mut last = (u64::MAX, 0);
    each_key(points, side_m, |row, key| {
        let point = &points[row as usize];
        if !is_in_reach(point) {
            return;
        }
        // Points that follow each other often share a voxel.
        if last.0 != key {
            // Zero is the number of a new voxel.
            let number = numbers.entry(key);
            if *number == 0 {
                sums.push(([0.0; 3], 0.0));
                *number = sums.len() as u32;
            }
            last = (key, *number as usize - 1);
        }
        let (sum, count) = &mut sums[last.1];
        for (sum, &c) in sum.iter_mut().zip(point) {
            *sum += f64::from(c);
        }
        *count += 1.0;
    });
    let means = sums.into_iter();
    means
        .map(|(sum, count)| sum.map(|sum| (sum / count) as f32))
        .collect()
}

/// Voxel downsampling to the first row of each voxel of `side_m` metres. The rows are in ascending
/// order. Points beyond [`REACH`] voxels share the outermost voxels. All coordinates must be
/// finite.
pub(crate) fn voxel_first(points: &[Point], side_m: f32) -> Vec<u32> {
    let mut seen = KeyTable::<()>::new(points.len() / EXPECTED);
    let mut rows = Vec::new();
    let mut last = u64::MAX;
    each_key(points, side_m, |row, key| {
        // Points that follow each other often share a voxel.
        if core::mem::replace(&mut last, key) != key && seen.insert(key) {
            rows.push(row);
        }
    });
    rows
}

/// Calls `see` with each row and the key of its point's voxel: 21 bits an axis, x in the highest.
fn each_key(points: &[Point], side_m: f32, mut see: impl FnMut(u32, u64)) {
    let index = |floor: i32| u64::from((floor + REACH as i32).cast_unsigned());
    let mut keys = Vec::with_capacity(KEYS_AT_ONCE.min(points.len()));
    let mut rows = 0..;
    for points in points.chunks(KEYS_AT_ONCE) {
        keys.clear();
        keys.extend(points.iter().map(|&[x, y, z]| {
            let voxel = [x / side_m, y / side_m, z / side_m];
            let [x, y, z] = floors(voxel, [-REACH, REACH - 1.0]);
            index(x) << 42 | index(y) << 21 | index(z)
        }));
        for (&key, row) in keys.iter().zip(&mut rows) {
            see(row, key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_voxel_keeps_the_mean_of_its_points_in_the_order_of_the_first_ones() {
        let mut points = vec![[0.1, 0.1, 0.1], [-0.1, 0.1, 0.1], [0.3, 0.1, 0.1]];
        assert_eq!(
            voxel_mean(&points, 0.5),
            [[0.2, 0.1, 0.1], [-0.1, 0.1, 0.1]]
        );
        points.swap(0, 1);
        assert_eq!(
            voxel_mean(&points, 0.5),
            [[-0.1, 0.1, 0.1], [0.2, 0.1, 0.1]]
        );
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
