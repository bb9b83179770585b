//! The source and one other sweep, prepared for matching.
//!
//! A target point on a source point of a clearly static cluster is a static match: that cluster
//! explains it, and no other cluster can be matched to it.

use rayon::prelude::*;

use super::clouds::{SourceCloud, TargetCloud, column_m, lowered};
use super::planar_motion::PlanarMotion;
use crate::flow::data::Point;
use crate::flow::options::ObjectOptions;
use crate::flow::spatial::{ColumnIndex, NOISE, SlotLabels};

/// Share of a cluster's points that must lie on the target for the cluster to be clearly static.
const PLAIN: f32 = 0.9;

/// The source and one other sweep, prepared for matching.
pub(super) struct Scene<'a> {
    pub(super) options: &'a ObjectOptions,
    pub(super) source: &'a SourceCloud,
    /// Target points, one a voxel, metres: those of `free`, then those of `taken`.
    pub(super) target: Vec<Point>,
    /// Unit normals of the target points; zero where the surface is not flat or not known.
    normals: Vec<Point>,
    /// Index of the target points that are no static match, with scaled heights.
    free: ColumnIndex,
    /// Index of the static matches, with scaled heights, and the cluster that explains each.
    taken: ColumnIndex,
    owners: SlotLabels,
    /// For each cluster, whether it is clearly static. No other cluster has static matches.
    is_static: Vec<bool>,
}

impl<'a> Scene<'a> {
    /// Prepares `source` and `target` for matching. Both are in the target's frame, metres.
    pub(super) fn new(
        source: &'a SourceCloud,
        target: &TargetCloud,
        options: &'a ObjectOptions,
    ) -> Self {
        let (is_static, owners) = static_matches(source, target, options);
        let of = |is_taken: bool| -> (Vec<u32>, ColumnIndex) {
            let rows =
                (0..owners.len() as u32).filter(|&row| (owners[row as usize] != NOISE) == is_taken);
            let rows: Vec<u32> = rows.collect();
            let low: Vec<Point> = rows.iter().map(|&row| target.low[row as usize]).collect();
            let index = ColumnIndex::new(&low, column_m(options));
            let in_order = index.rows().iter().map(|&row| rows[row as usize]).collect();
            (in_order, index)
        };
        let ((free_rows, free), (taken_rows, taken)) = rayon::join(|| of(false), || of(true));
        let owners: Vec<u32> = taken_rows.iter().map(|&row| owners[row as usize]).collect();
        let in_order = |of: &[Point]| -> Vec<Point> {
            let rows = free_rows.iter().chain(&taken_rows);
            rows.map(|&row| of[row as usize]).collect()
        };
        Self {
            options,
            source,
            target: in_order(&target.points),
            normals: match &target.normals {
                Some(normals) => in_order(normals),
                None => vec![[0.0; 3]; target.points.len()],
            },
            free,
            owners: taken.slot_labels(&owners),
            taken,
            is_static,
        }
    }

    /// The target point nearest to `position`, within `match_m`. Static matches of clusters other than
    /// `cluster` are excluded.
    #[inline]
    pub(super) fn match_of(&self, position: Point, cluster: u32) -> Option<u32> {
        let position = lowered(position, self.options);
        let mut within_m = self.options.match_m;
        let mut own = None;
        if self.has_static_matches(cluster) {
            let found = self
                .taken
                .nearest_labelled(position, within_m, &self.owners, cluster);
            if let Some((slot, square)) = found {
                own = Some((self.free.len() + slot) as u32);
                within_m = square.sqrt();
            }
        }
        let free = self.free.nearest_slot(position, within_m);
        free.map(|(slot, _)| slot as u32).or(own)
    }

    /// The indices of the target points that are no static match, and of the static matches.
    pub(super) fn indices(&self) -> [&ColumnIndex; 2] {
        [&self.free, &self.taken]
    }

    /// The cluster that explains each static match, in the order of its index.
    pub(super) fn owners(&self) -> impl Iterator<Item = u32> {
        self.owners.all(self.taken.len())
    }

    /// For each cluster, whether it is clearly static.
    pub(super) fn statics(&self) -> &[bool] {
        &self.is_static
    }

    /// Takes the normals of its target points from those of several scenes.
    pub(super) fn take_normals(&mut self, of_all: &mut impl Iterator<Item = Point>) {
        for (normal, found) in self.normals.iter_mut().zip(of_all) {
            *normal = found;
        }
    }

    /// Whether some static matches may be those of `cluster`.
    fn has_static_matches(&self, cluster: u32) -> bool {
        self.is_static.get(cluster as usize) == Some(&true)
    }

    /// The source point of `cluster` nearest to `position`, within `match_m`.
    #[inline]
    pub(super) fn origin_of(&self, position: Point, cluster: u32) -> Option<u32> {
        let SourceCloud { near, clusters, .. } = self.source;
        let position = lowered(position, self.options);
        let found = near.nearest_labelled(position, self.options.match_m, clusters, cluster);
        found.map(|(slot, _)| near.rows()[slot])
    }

    /// Calls `see` with every source point within `within_m` metres of `position`, with scaled
    /// heights.
    pub(super) fn source_within(&self, position: Point, within_m: f32, see: impl FnMut(u32)) {
        let position = lowered(position, self.options);
        self.source.near.within(position, within_m, see);
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
        let map = motion.map();
        let moved = rows
            .iter()
            .map(|&row| map.apply(self.source.points[row as usize]));
        let moved: Vec<Point> = moved.map(|point| lowered(point, self.options)).collect();
        let mut touched = self.free.slots_near(&moved, within_m);
        if self.has_static_matches(cluster) {
            let first = self.free.len() as u32;
            let taken = self.taken.slots_near(&moved, within_m).into_iter();
            let own = taken.filter(|&slot| self.owners.is(slot, cluster));
            touched.extend(own.map(|slot| first + slot));
        }
        touched
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

/// For each cluster whether it is clearly static, and for each target point the clearly static
/// cluster that explains it, or [`NOISE`].
fn static_matches(
    source: &SourceCloud,
    target: &TargetCloud,
    options: &ObjectOptions,
) -> (Vec<bool>, Vec<u32>) {
    let within_m = options.static_match_m;
    let on_target: Vec<bool> = source
        .low
        .par_iter()
        .map(|&point| target.near.nearest_slot(point, within_m).is_some())
        .collect();
    let members = source.members.iter();
    let is_static = members.map(|rows| {
        let on = rows.iter().filter(|&&row| on_target[row as usize]).count();
        on as f32 >= PLAIN * rows.len() as f32
    });
    let is_static: Vec<bool> = is_static.collect();
    let owner = |&point: &Point| {
        let cluster = source.near.nearest(point, within_m);
        let cluster = cluster.map_or(NOISE, |(row, _)| source.labels[row as usize]);
        match is_static.get(cluster as usize) {
            Some(true) => cluster,
            _ => NOISE,
        }
    };
    let owners = target.low.par_iter().map(owner).collect();
    (is_static, owners)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::square_distance;

    #[test]
    fn what_a_cluster_touches_is_what_a_search_of_all_finds() {
        let options = ObjectOptions::default();
        // 150 target points fill two words of the bit set and a part of a third.
        let target: Vec<Point> = (0..150_u8)
            .map(|i| [f32::from(i) * 0.2, 1.0, 0.0])
            .collect();
        let source = [[7.0, 1.2, 0.0], [19.0, 1.0, 0.1], [29.7, 0.8, 0.0]];
        let downsampled = SourceCloud::new(&source, &[0; 3], &options);
        let scene = Scene::new(&downsampled, &TargetCloud::new(&target, &options), &options);
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
