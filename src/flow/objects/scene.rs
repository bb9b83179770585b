//! The clouds of the object search: voxel-downsampled, with normals and static matches.
//!
//! A target point on a source point of a clearly static cluster is a static match: that cluster
//! explains it, and no other cluster can be matched to it. Heights are scaled down for matching,
//! since the rings of a lidar are far apart and the samples along a ring are not.

use rayon::prelude::*;

use super::planar_motion::PlanarMotion;
use crate::flow::data::Point;
use crate::flow::options::ObjectOptions;
use crate::flow::spatial::{ColumnIndex, NOISE, Neighborhood, voxel_first};

/// Share of a cluster's points that must lie on the target for the cluster to be clearly static.
const PLAIN: f32 = 0.9;

/// The source with the ego motion taken out, voxel-downsampled.
pub(super) struct SourceCloud {
    /// One point a voxel, metres in the target's frame.
    pub(super) points: Vec<Point>,
    /// The cluster of each point, or [`NOISE`].
    pub(super) labels: Vec<u32>,
    /// For each cluster, the indices of its points in `points`.
    pub(super) members: Vec<Vec<u32>>,
    /// The points with scaled heights.
    low: Vec<Point>,
    /// Index of `low`.
    near: ColumnIndex,
}

impl SourceCloud {
    /// Downsamples `source`. `labels` are the clusters of its points.
    pub(super) fn new(source: &[Point], labels: &[u32], options: &ObjectOptions) -> Self {
        let kept = voxel_first(source, options.voxel_m);
        let labels: Vec<u32> = kept.iter().map(|&row| labels[row as usize]).collect();
        let points: Vec<Point> = kept.iter().map(|&row| source[row as usize]).collect();
        let low: Vec<Point> = points.iter().map(|&p| lowered(p, options)).collect();
        let clusters = labels.iter().filter(|&&label| label != NOISE).max();
        let mut members = vec![Vec::new(); clusters.map_or(0, |&last| last as usize + 1)];
        for (&label, row) in labels.iter().zip(0..) {
            if label != NOISE {
                members[label as usize].push(row);
            }
        }
        Self {
            near: ColumnIndex::new(&low, options.match_m),
            points,
            labels,
            members,
            low,
        }
    }
}

/// The source and one other sweep, prepared for matching.
pub(super) struct Scene<'a> {
    pub(super) options: &'a ObjectOptions,
    pub(super) source: &'a SourceCloud,
    /// Target points, one a voxel, metres.
    pub(super) target: Vec<Point>,
    /// Unit normals of the target points; zero where the surface is not flat.
    normals: Vec<Point>,
    /// Index of the target points with scaled heights.
    near_target: ColumnIndex,
    /// For each target point, the static cluster that explains it, or [`NOISE`].
    taken: Vec<u32>,
}

impl<'a> Scene<'a> {
    /// Prepares `source` and `target` for matching. Both are in the target's frame, metres.
    pub(super) fn new(
        source: &'a SourceCloud,
        target: &[Point],
        options: &'a ObjectOptions,
    ) -> Self {
        let target: Vec<Point> = voxel_first(target, options.voxel_m)
            .into_iter()
            .map(|row| target[row as usize])
            .collect();
        let low_target: Vec<Point> = target.iter().map(|&p| lowered(p, options)).collect();
        let near_target = ColumnIndex::new(&low_target, options.match_m);
        let upright = ColumnIndex::new(&target, options.match_m);
        let normals = target
            .par_iter()
            .map(|&point| normal(&upright, point, options));
        let normals = normals.collect();
        let within = options.static_match_m;
        let on_target: Vec<bool> = source
            .low
            .par_iter()
            .map(|&point| near_target.nearest(point, within, |_| true).is_some())
            .collect();
        let still: Vec<bool> = source
            .members
            .iter()
            .map(|rows: &Vec<u32>| {
                let on = rows.iter().filter(|&&row| on_target[row as usize]).count();
                on as f32 >= PLAIN * rows.len() as f32
            })
            .collect();
        let taken = low_target.par_iter().map(|&point| {
            let owner = source.near.nearest(point, within, |_| true);
            let cluster = owner.map_or(NOISE, |(row, _)| source.labels[row as usize]);
            if cluster != NOISE && still[cluster as usize] {
                cluster
            } else {
                NOISE
            }
        });
        let taken = taken.collect();
        Self {
            options,
            source,
            target,
            normals,
            near_target,
            taken,
        }
    }

    /// The target point nearest to `position`, within `match_m`. Static matches of clusters other than
    /// `cluster` are excluded.
    #[inline]
    pub(super) fn match_of(&self, position: Point, cluster: u32) -> Option<u32> {
        let allowed = |row: u32| {
            let owner = self.taken[row as usize];
            owner == NOISE || owner == cluster
        };
        let position = lowered(position, self.options);
        let found = self
            .near_target
            .nearest(position, self.options.match_m, allowed);
        found.map(|(row, _)| row)
    }

    /// The source point of `cluster` nearest to `position`, within `match_m`.
    #[inline]
    pub(super) fn origin_of(&self, position: Point, cluster: u32) -> Option<u32> {
        let position = lowered(position, self.options);
        let of_it = |row: u32| self.source.labels[row as usize] == cluster;
        let found = self
            .source
            .near
            .nearest(position, self.options.match_m, of_it);
        found.map(|(row, _)| row)
    }

    /// Calls `see` with every source point within `within_m` metres of `position`, with scaled
    /// heights. `within_m` is at most `match_m`.
    pub(super) fn source_within(&self, position: Point, within_m: f32, mut see: impl FnMut(u32)) {
        let position = lowered(position, self.options);
        self.source
            .near
            .within(position, within_m, |row, _| see(row));
    }

    /// Distance from `position` to the target for a point of `cluster`, metres, truncated. With
    /// [`NOISE`] all static matches are excluded.
    pub(super) fn distance_of(&self, position: Point, cluster: u32) -> f32 {
        let target = self.match_of(position, cluster);
        target.map_or(self.options.truncation_m, |target| {
            self.distance(position, target)
        })
    }

    /// The target points within `match_m` of the moved `rows` that are no static match of another
    /// cluster than `cluster`, in ascending order.
    pub(super) fn touched(&self, rows: &[u32], cluster: u32, motion: &PlanarMotion) -> Vec<u32> {
        let within_m = self.options.match_m;
        let mut seen = self.near_target.unseen();
        let mut touched = vec![0_u64; self.target.len().div_ceil(64)];
        for &row in rows {
            let position = lowered(motion.apply(self.source.points[row as usize]), self.options);
            self.near_target
                .within_unseen(position, within_m, &mut seen, |row| {
                    let owner = self.taken[row as usize];
                    if owner == NOISE || owner == cluster {
                        touched[row as usize / 64] |= 1 << (row % 64);
                    }
                });
        }
        let words = touched.iter().zip((0..).step_by(64));
        words
            .flat_map(|(&word, first)| ones(word).map(move |bit| first + bit))
            .collect()
    }

    /// The unit normal of a target point; zero where the surface is not flat.
    #[inline]
    pub(super) fn normal(&self, row: u32) -> Point {
        self.normals[row as usize]
    }

    /// Distance from `position` to a target point, metres, truncated: along its normal with a small
    /// share of the full distance, or the full distance where it has no normal.
    #[inline]
    pub(super) fn distance(&self, position: Point, row: u32) -> f32 {
        let (target, normal) = (self.target[row as usize], self.normals[row as usize]);
        let [x, y, z]: Point = core::array::from_fn(|a| target[a] - position[a]);
        let height = z * self.options.height_weight;
        let plain = x * x + y * y + height * height;
        let square = if normal == [0.0; 3] {
            plain
        } else {
            let along = normal[0] * x + normal[1] * y + normal[2] * z;
            along * along + self.options.tangential_weight * self.options.tangential_weight * plain
        };
        square.sqrt().min(self.options.truncation_m)
    }
}

/// The indices of the set bits of a word, in ascending order.
fn ones(word: u64) -> impl Iterator<Item = u32> {
    let without_lowest = |&left: &u64| Some(left & left.wrapping_sub(1));
    std::iter::successors(Some(word), without_lowest)
        .take_while(|&left| left != 0)
        .map(u64::trailing_zeros)
}

/// The point with its height scaled.
#[inline]
fn lowered([x, y, z]: Point, options: &ObjectOptions) -> Point {
    [x, y, z * options.height_weight]
}

/// The unit normal of the surface around a point; zero where it is not flat.
fn normal(near: &ColumnIndex, point: Point, options: &ObjectOptions) -> Point {
    let range = point[0].hypot(point[1]);
    let [base, slope] = options.normal_m;
    let radius = (base + slope * range).min(options.match_m);
    let mut neighborhood = Neighborhood::of(point);
    near.within(point, radius, |_, other| neighborhood.add(other));
    let flat = neighborhood.flat();
    flat.map_or([0.0; 3], |flat| flat.normal)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::square_distance;

    #[test]
    fn every_bit_of_a_word_is_named_once_in_order() {
        assert_eq!(ones(0).count(), 0);
        assert_eq!(ones(1 | 1 << 5 | 1 << 63).collect::<Vec<_>>(), [0, 5, 63]);
        assert!(ones(u64::MAX).eq(0..64));
    }

    #[test]
    fn what_a_cluster_touches_is_what_a_search_of_all_finds() {
        let options = ObjectOptions::default();
        // 150 target points fill two words of the bit set and a part of a third.
        let target: Vec<Point> = (0..150_u8)
            .map(|i| [f32::from(i) * 0.2, 1.0, 0.0])
            .collect();
        let source = [[7.0, 1.2, 0.0], [19.0, 1.0, 0.1], [29.7, 0.8, 0.0]];
        let downsampled = SourceCloud::new(&source, &[0; 3], &options);
        let scene = Scene::new(&downsampled, &target, &options);
        let motion = PlanarMotion::still([0.0; 2]).shifted([0.5, 0.0]);
        let near = |point: &Point| {
            source.iter().any(|&position| {
                let away = square_distance(
                    lowered(motion.apply(position), &options),
                    lowered(*point, &options),
                );
                away < options.match_m * options.match_m
            })
        };
        let expected: Vec<Point> = target.iter().copied().filter(near).collect();
        let touched = scene.touched(&[0, 1, 2], 0, &motion);
        let touched: Vec<Point> = touched
            .iter()
            .map(|&row| scene.target[row as usize])
            .collect();
        assert!(touched.len() > 9);
        assert_eq!(touched, expected);
    }
}
