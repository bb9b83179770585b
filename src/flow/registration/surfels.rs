//! Surfels: small flat patches of a cloud's surfaces, and a nearest-neighbor search over them.
//!
//! A surfel is fitted to the neighbors of a point within a radius. It is fitted when it is first asked
//! for, because the source points that are registered match few of a target's points.

use std::sync::OnceLock;

use rayon::prelude::*;

use crate::flow::data::{Point, get_or_compute, stride_sample};
use crate::flow::spatial::{ColumnIndex, PlaneFit};

/// Points whose surfels one thread computes at a time.
const POINTS_AT_ONCE: usize = 256;

/// A flat patch of surface.
#[derive(Clone, Copy)]
pub(super) struct Surfel {
    /// The point of the cloud that it is centered on, metres.
    pub(super) point: Point,
    /// The plane fitted to the neighbors of `point`.
    pub(super) flat: PlaneFit,
}

/// The surfels of a voxel-downsampled cloud, each fitted on first use.
pub(super) struct Surfels {
    /// Radius of the neighborhoods, metres.
    within_m: f32,
    /// The points in the order of the index.
    points: Vec<Point>,
    index: ColumnIndex,
    /// The plane at each point, once it is fitted; none where the surface is not flat.
    flats: Vec<OnceLock<Option<PlaneFit>>>,
}

impl Surfels {
    /// Surfels of `points`, metres, fitted to their neighbors within `within_m` metres.
    pub(super) fn new(points: &[Point], within_m: f32) -> Self {
        let mut points = points.to_vec();
        let index = ColumnIndex::sorted_uncrowded(&mut points, within_m);
        Self {
            within_m,
            flats: points.iter().map(|_| OnceLock::new()).collect(),
            points,
            index,
        }
    }

    /// The surfels of at most `most` points, chosen evenly. Points on no flat surface have none.
    pub(super) fn some(&self, most: usize) -> Vec<Surfel> {
        let slots: Vec<usize> = (0..self.points.len()).collect();
        let slots = stride_sample(&slots, most);
        let chunks = slots.par_chunks(POINTS_AT_ONCE);
        let surfels = chunks.flat_map_iter(|slots| slots.iter().filter_map(|&slot| self.at(slot)));
        surfels.collect()
    }

    /// The surfel whose point is nearest to `point` and less than `within_m` metres from it. None
    /// where there is no such point, or where its surface is not flat.
    pub(super) fn nearest(&self, point: Point, within_m: f32) -> Option<Surfel> {
        let (slot, _) = self.index.nearest_slot(point, within_m)?;
        self.at(slot)
    }

    /// The surfel of the point in a slot of the index.
    fn at(&self, slot: usize) -> Option<Surfel> {
        let point = self.points[slot];
        let flat = get_or_compute(&self.flats[slot], || {
            self.index.plane_at(point, self.within_m)
        });
        flat.map(|flat| Surfel { point, flat })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::flow::data::{Random, square_distance};

    #[test]
    fn the_nearest_surfel_is_the_one_that_a_search_of_all_finds() {
        let mut random = Random::new(2);
        let mut point = || [0; 3].map(|_| random.uniform(-4.0, 4.0) as f32);
        let cloud: Vec<Point> = (0..800).map(|_| point()).collect();
        let surfels = Surfels::new(&cloud, 1.0);
        for _ in 0..500 {
            let asked = point();
            let square = |other: &Point| square_distance(asked, *other);
            let nearest = cloud.iter().map(square).fold(f32::INFINITY, f32::min);
            if let Some(found) = surfels.nearest(asked, 1.0) {
                assert_eq!(square(&found.point), nearest);
            }
        }
        assert!(surfels.nearest([f32::NAN; 3], 1.0).is_none());
        assert!(surfels.nearest([1e30, 0.0, 0.0], 1.0).is_none());
    }

    #[test]
    fn planes_have_their_normal_and_lines_have_none() {
        let slope = Vector3::new(0.3, -0.2, 1.0).normalize();
        let on_plane = |i: usize| {
            let [x, y] = [(i % 20) as f32 * 0.3 - 3.0, (i / 20) as f32 * 0.3 - 3.0];
            [x, y, -0.3 * x + 0.2 * y]
        };
        let plane: Vec<Point> = (0..400).map(on_plane).collect();
        let surfels = Surfels::new(&plane, 1.0);
        for &point in &plane {
            let found = surfels.nearest(point, 1.0).expect("flat").flat;
            let PlaneFit {
                normal, thickness, ..
            } = found;
            let along = Vector3::from(normal.map(f64::from)).dot(&slope).abs();
            assert!(along > 1.0 - 1e-6, "{normal:?}");
            assert!(thickness < 0.01, "{thickness}");
        }
        let line: Vec<Point> = (0..100).map(|i| [i as f32 * 0.3, 0.0, 0.0]).collect();
        let line = Surfels::new(&line, 1.0);
        assert!(line.some(100).is_empty());
        let nothing = Surfels::new(&[], 1.0);
        assert!(nothing.nearest([0.0; 3], 1.0).is_none());
    }

    #[test]
    fn some_surfels_are_the_same_whether_others_have_been_asked_for_or_not() {
        let mut random = Random::new(3);
        let mut point = || [4.0, 4.0, 0.1].map(|side| random.uniform(-side, side) as f32);
        let cloud: Vec<Point> = (0..900).map(|_| point()).collect();
        let surfels = Surfels::new(&cloud, 1.0);
        let bits = |some: Vec<Surfel>| -> Vec<_> {
            let some = some.into_iter();
            some.map(|Surfel { point, flat }| (point, flat.normal, flat.thickness))
                .collect()
        };
        let before = bits(surfels.some(200));
        let others = Surfels::new(&cloud, 1.0);
        assert!(others.some(600).len() > before.len());
        assert!(before.len() > 100);
        assert_eq!(bits(others.some(200)), before);
    }
}
