//! The two clouds of an object search: voxel-downsampled and indexed, each by itself.
//!
//! Heights are scaled down for matching, since the rings of a lidar are far apart and the samples
//! along a ring are not.

use rayon::prelude::*;

use crate::flow::data::Point;
use crate::flow::options::ObjectOptions;
use crate::flow::spatial::{ColumnIndex, SlotLabels, dbscan, voxel_first};

/// The source with the ego motion taken out, voxel-downsampled.
pub(super) struct SourceCloud {
    /// One point a voxel, metres in the target's frame.
    pub(super) points: Vec<Point>,
    /// The cluster of each point, or [`NOISE`](crate::flow::spatial::NOISE).
    pub(super) labels: Vec<u32>,
    /// For each cluster, the indices of its points in `points`.
    pub(super) members: Vec<Vec<u32>>,
    /// The points with scaled heights.
    pub(super) low: Vec<Point>,
    /// Index of `low`, and the cluster of each of its points.
    pub(super) near: ColumnIndex,
    pub(super) clusters: SlotLabels,
}

impl SourceCloud {
    /// Downsamples `source`. `labels` are the clusters of its points.
    pub(super) fn new(source: &[Point], labels: &[u32], options: &ObjectOptions) -> Self {
        let kept = voxel_first(source, options.voxel_m);
        let cloud = Self::of(&kept, source, labels, options);
        match cloud.near.uncrowded_rows() {
            None => cloud,
            Some(rows) => {
                let kept: Vec<u32> = rows.iter().map(|&row| kept[row as usize]).collect();
                Self::of(&kept, source, labels, options)
            }
        }
    }

    /// From the rows `kept` of `source`.
    fn of(kept: &[u32], source: &[Point], labels: &[u32], options: &ObjectOptions) -> Self {
        let labels: Vec<u32> = kept.iter().map(|&row| labels[row as usize]).collect();
        let points: Vec<Point> = kept.iter().map(|&row| source[row as usize]).collect();
        let low: Vec<Point> = points.iter().map(|&p| lowered(p, options)).collect();
        let near = ColumnIndex::new(&low, column_m(options));
        Self {
            clusters: near.labels(&labels),
            near,
            points,
            members: dbscan::members(&labels),
            labels,
            low,
        }
    }
}

impl SourceCloud {
    /// The mean position of the points `rows` along x and y, metres.
    pub(super) fn center(&self, rows: &[u32]) -> [f32; 2] {
        let count = rows.len() as f32;
        let mut center = [0.0; 2];
        for &row in rows {
            for (center, c) in center.iter_mut().zip(self.points[row as usize]) {
                *center += c / count;
            }
        }
        center
    }
}

/// The target or a neighbor sweep, voxel-downsampled.
pub(super) struct TargetCloud {
    /// One point a voxel, metres in the target's frame.
    pub(super) points: Vec<Point>,
    /// The points with scaled heights.
    pub(super) low: Vec<Point>,
    /// Index of `points`, until their normals are known.
    upright: Option<ColumnIndex>,
    /// Unit normals of the points, if they are known; zero where the surface is not flat.
    pub(super) normals: Option<Vec<Point>>,
    /// Index of `low` for static matches.
    pub(super) near: ColumnIndex,
}

impl TargetCloud {
    /// Downsamples `target`, metres in the target's frame. Its normals are not known yet.
    pub(super) fn new(target: &[Point], options: &ObjectOptions) -> Self {
        let mut points: Vec<Point> = voxel_first(target, options.voxel_m)
            .into_iter()
            .map(|row| target[row as usize])
            .collect();
        let upright = ColumnIndex::sorted_uncrowded(&mut points, column_m(options));
        let low: Vec<Point> = points.iter().map(|&p| lowered(p, options)).collect();
        Self {
            upright: Some(upright),
            normals: None,
            near: ColumnIndex::new(&low, 2.0 * options.static_match_m),
            points,
            low,
        }
    }

    /// Fits a plane to the points around each point, once.
    pub(super) fn find_normals(&mut self, options: &ObjectOptions) {
        if let Some(upright) = self.upright.take() {
            let points = self.points.par_iter();
            let normals = points.map(|&point| normal(&upright, point, options));
            self.normals = Some(normals.collect());
        }
    }
}

/// The unit normal of the surface around a point; zero where it is not flat.
fn normal(near: &ColumnIndex, point: Point, options: &ObjectOptions) -> Point {
    let range = point[0].hypot(point[1]);
    let [base, slope] = options.normal_m;
    let radius = (base + slope * range).min(options.match_m);
    let flat = near.plane_at(point, radius);
    flat.map_or([0.0; 3], |flat| flat.normal)
}

/// Side of the columns of the indices, metres: most matches lie within a quarter of `match_m`.
pub(super) fn column_m(options: &ObjectOptions) -> f32 {
    0.5 * options.match_m
}

/// The point with its height scaled.
#[inline]
pub(super) fn lowered([x, y, z]: Point, options: &ObjectOptions) -> Point {
    [x, y, z * options.height_weight]
}
