//! Cache of the results that depend on a single sweep: its ground mask and its surfels.
//!
//! A sweep of a sequence is the target of one pair and the source of the next. Where estimates use
//! neighbor sweeps, it is also a neighbor of other pairs. Its ground and its surfels are computed
//! once. The key is the bits of all points, so that a cached result is bit-identical to a
//! recomputed one.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

use crate::flow::data::Point;
use crate::flow::data::get_or_compute;
use crate::flow::data::locked;
use crate::flow::registration::SurfelCloud;

/// Bound on the total points of the cached sweeps: about twenty full sweeps. They take about 60 MB
/// with their surfels, and 240 MB where no two points share a voxel.
pub(super) const POINTS: usize = 2 << 20;
/// Bound on the number of cached sweeps. A linear search over them is cheap compared with the
/// cached computations.
const SWEEPS: usize = 64;

/// The cached results of one sweep, each computed on first use.
pub(crate) struct CachedSweep {
    /// The points that take part: finite and in range.
    points: Vec<Point>,
    ground: OnceLock<Vec<bool>>,
    surface: OnceLock<SurfelCloud>,
}

impl CachedSweep {
    /// Ground mask, one flag a point; `find` computes it on first use.
    pub(crate) fn ground(&self, find: impl FnOnce(&[Point]) -> Vec<bool>) -> &Vec<bool> {
        get_or_compute(&self.ground, || find(&self.points))
    }

    /// Surfels for the registration. Their points and indices are computed on first use, and a plane
    /// where the registration asks for it.
    pub(crate) fn surface(&self) -> &SurfelCloud {
        get_or_compute(&self.surface, || SurfelCloud::new(&self.points))
    }
}

/// Whether two clouds are bit-identical.
fn same(a: &[Point], b: &[Point]) -> bool {
    bytemuck::cast_slice::<Point, u8>(a) == bytemuck::cast_slice::<Point, u8>(b)
}

/// The most recently used sweeps, the latest first.
#[derive(Default)]
pub(crate) struct SweepCache(Mutex<VecDeque<Arc<CachedSweep>>>);

impl SweepCache {
    /// Removes all sweeps.
    pub(crate) fn clear(&self) {
        self.sweeps().clear();
    }

    fn sweeps(&self) -> MutexGuard<'_, VecDeque<Arc<CachedSweep>>> {
        locked(&self.0)
    }

    /// The entry for exactly these points; a new one where there is none. Sweeps of more than
    /// `POINTS` points are not kept.
    pub(crate) fn of(&self, points: &[Point]) -> Arc<CachedSweep> {
        let mut sweeps = self.sweeps();
        let known = match sweeps.iter().position(|known| same(&known.points, points)) {
            Some(index) => sweeps.remove(index),
            None => None,
        };
        let known = known.unwrap_or_else(|| {
            Arc::new(CachedSweep {
                points: points.to_vec(),
                ground: OnceLock::new(),
                surface: OnceLock::new(),
            })
        });
        if points.len() > POINTS {
            return known;
        }
        sweeps.push_front(Arc::clone(&known));
        sweeps.truncate(SWEEPS);
        let mut held = 0;
        sweeps.retain(|known| {
            held += known.points.len();
            held <= POINTS
        });
        known
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sweep(points: usize, x: f32) -> Vec<Point> {
        (0..points).map(|i| [x, i as f32, 0.0]).collect()
    }

    #[test]
    fn a_sweep_is_known_again_by_its_points_and_by_nothing_else() {
        let sweep_cache = SweepCache::default();
        let first = sweep_cache.of(&sweep(100, 1.0));
        assert_eq!(
            first.ground(|points| vec![true; points.len()])[..],
            [true; 100]
        );
        let again = sweep_cache.of(&sweep(100, 1.0));
        assert_eq!(
            again.ground(|_| unreachable!("it is known"))[..],
            [true; 100]
        );
        let mut other = sweep(100, 1.0);
        other[99][2] = -0.0;
        for other in [other, sweep(99, 1.0), sweep(100, 2.0)] {
            let ground = sweep_cache.of(&other);
            let ground = ground.ground(|points| vec![false; points.len()]);
            assert_eq!(*ground, vec![false; other.len()]);
        }
    }

    #[test]
    fn what_was_not_seen_for_long_is_forgotten_and_what_is_too_large_is_not_kept() {
        let held = |sweep_cache: &SweepCache| -> usize {
            sweep_cache
                .sweeps()
                .iter()
                .map(|known| known.points.len())
                .sum()
        };
        let sweep_cache = SweepCache::default();
        let asked = |x: f32| {
            let known = sweep_cache.of(&sweep(POINTS / 4, x));
            let mut was_known = true;
            known.ground(|points| {
                was_known = false;
                vec![false; points.len()]
            });
            was_known
        };
        assert_eq!([1.0, 2.0, 3.0, 4.0].map(asked), [false; 4]);
        // The first sweep is used once more, so that the second is evicted.
        assert_eq!([1.0, 5.0, 1.0, 2.0].map(asked), [true, false, true, false]);
        assert!(held(&sweep_cache) <= POINTS);
        let before = held(&sweep_cache);
        sweep_cache.of(&sweep(POINTS + 1, 0.0));
        assert_eq!(held(&sweep_cache), before);
        sweep_cache.clear();
        assert_eq!(held(&sweep_cache), 0);
        for few in 0..=SWEEPS as u16 {
            sweep_cache.of(&sweep(3, few.into()));
        }
        assert_eq!(sweep_cache.sweeps().len(), SWEEPS);
    }
}
