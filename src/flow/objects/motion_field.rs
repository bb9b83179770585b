//! The motions of a pair's moving objects as a field over space.
//!
//! A position moves with the source point nearest to it: with the object of that point, or not at
//! all.

use rayon::prelude::*;

use super::planar_motion::PlanarMotion;
use crate::flow::data::Point;
use crate::flow::spatial::{ColumnIndex, NOISE};

/// Range of moving points, metres: positions farther from all of them do not move. It is the
/// default cluster radius, within which the points of one object lie of each other.
const REACH_M: f32 = 0.5;

/// The rigid motions of a pair's moving objects, as a field over space.
///
/// A position has the motion of the nearest downsampled source point, if that point moves and is
/// less than 0.5 m away. All other positions are static. Each motion is a translation in x and y
/// and a rotation about the vertical.
#[derive(Debug)]
pub struct ObjectMotions {
    motions: Vec<PlanarMotion>,
    /// For each moving point, the index of its motion.
    point_motion: Vec<u32>,
    moving: ColumnIndex,
    standing: ColumnIndex,
}

impl ObjectMotions {
    /// No motion.
    pub(super) fn none() -> Self {
        Self::of(Vec::new(), &[], &[])
    }

    /// From N `points`, metres in the target's frame with the ego motion taken out, and the index
    /// into `motions` of each; [`NOISE`] is static. Computes in parallel.
    pub(super) fn new(motions: Vec<PlanarMotion>, points: &[Point], point_motion: &[u32]) -> Self {
        let owned = points.iter().copied().zip(point_motion.iter().copied());
        let moving: Vec<(Point, u32)> = owned.filter(|&(_, owner)| owner != NOISE).collect();
        let before = moving.iter().map(|&(point, _)| point);
        let after = moving
            .iter()
            .map(|&(point, owner)| motions[owner as usize].apply(point));
        let both: Vec<Point> = before.chain(after).collect();
        let both = ColumnIndex::new(&both, 2.0 * REACH_M);
        // A static point farther from all moving points, before and after their motion, is never the
        // nearest to a position that may move.
        let matters = |point: Point| both.nearest(point, 2.0 * REACH_M).is_some();
        let rows = points.par_iter().zip(point_motion);
        let standing = rows.filter(|&(&point, &owner)| owner == NOISE && matters(point));
        let standing: Vec<Point> = standing.map(|(&point, _)| point).collect();
        Self::of(motions, &moving, &standing)
    }

    /// From the motions, the moving points with the index of each one's motion, and the static points
    /// beside them.
    pub(super) fn of(
        motions: Vec<PlanarMotion>,
        moving: &[(Point, u32)],
        standing: &[Point],
    ) -> Self {
        let (moving, point_motion): (Vec<Point>, Vec<u32>) = moving.iter().copied().unzip();
        Self {
            motions,
            point_motion,
            moving: ColumnIndex::new(&moving, 2.0 * REACH_M),
            standing: ColumnIndex::new(standing, REACH_M),
        }
    }

    /// The motions back from where the moving points arrive.
    pub(crate) fn reversed(&self) -> Self {
        let (motions, moving, standing) = self.parts();
        let arrived = moving
            .iter()
            .map(|&(point, owner)| (motions[owner as usize].apply(point), owner));
        let arrived: Vec<(Point, u32)> = arrived.collect();
        let back = motions.iter().map(|motion| motion.repeated(-1));
        Self::of(back.collect(), &arrived, &standing)
    }

    /// The motions, the moving points with the index of each one's motion, and the static points
    /// beside them.
    pub(super) fn parts(&self) -> (&[PlanarMotion], Vec<(Point, u32)>, Vec<Point>) {
        let moving = self.moving.in_order().into_iter();
        let moving = moving.zip(self.point_motion.iter().copied());
        (&self.motions, moving.collect(), self.standing.in_order())
    }

    /// The residual flow at `positions` (N x 3, metres): N x 3 displacements, metres, in one sweep
    /// interval beyond the ego motion. Zero where a position is static.
    ///
    /// `positions` are positions at the source's time, transformed to the target's frame by the ego
    /// motion. They need not be source points. The displacements are along the axes of the target's
    /// frame.
    pub fn residual_at(&self, positions: &[Point]) -> Vec<Point> {
        positions
            .par_iter()
            .map(|&position| self.residual(position))
            .collect()
    }

    fn residual(&self, position: Point) -> Point {
        match self.owner(position) {
            NOISE => [0.0; 3],
            owner => self.displacement(owner, position),
        }
    }

    /// The index of the motion at a position; [`NOISE`] where it is static.
    fn owner(&self, position: Point) -> u32 {
        let Some((row, square)) = self.moving.nearest(position, REACH_M) else {
            return NOISE;
        };
        let stands = self.standing.nearest(position, square.sqrt());
        match stands {
            Some(_) => NOISE,
            None => self.point_motion[row as usize],
        }
    }

    /// [`Self::owner`] of every position.
    pub(super) fn owners_at(&self, positions: &[Point]) -> Vec<u32> {
        positions
            .par_iter()
            .map(|&position| self.owner(position))
            .collect()
    }

    /// Displacement of a position by the motion of this index, metres, in the frame of
    /// [`Self::residual_at`].
    pub(crate) fn displacement(&self, motion: u32, position: Point) -> Point {
        self.motions[motion as usize].displacement(position)
    }

    /// Number of motions.
    pub(super) fn count(&self) -> usize {
        self.motions.len()
    }

    /// Multiplies the motion of this index by `factor`.
    pub(super) fn scale(&mut self, motion: u32, factor: f32) {
        let motion = &mut self.motions[motion as usize];
        motion.shift_m = motion.shift_m.map(|c| c * factor);
        motion.turn *= factor;
    }

    /// Rotation of the motion of this index about the vertical, radians, counterclockwise.
    pub(crate) fn turn(&self, motion: u32) -> f32 {
        self.motions[motion as usize].turn
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_goes_back_with_the_point_that_arrives_nearest_to_it() {
        // 3 m forward, to a place beside a pole.
        let motion = PlanarMotion::still([0.0; 2]).shifted([3.0, 0.0]);
        let points = [[0.0; 3], [3.4, 0.0, 0.0]];
        let back = ObjectMotions::new(vec![motion], &points, &[0, NOISE]).reversed();
        let positions = [[3.0, 0.0, 0.0], [3.1, 0.1, 0.0], [3.3, 0.0, 0.0], [0.0; 3]];
        let moved = back.residual_at(&positions).into_iter();
        let moved: Vec<bool> = moved.map(|residual| residual == [-3.0, 0.0, 0.0]).collect();
        assert_eq!(moved, [true, true, false, false]);
    }

    #[test]
    fn a_place_moves_with_the_nearest_point_and_far_from_movers_not_at_all() {
        let motion = PlanarMotion::still([0.0; 2]).shifted([0.5, 0.25]);
        let points = [[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]];
        let motions = ObjectMotions::new(vec![motion], &points, &[0, NOISE]);
        let positions = [
            [0.0, 0.0, 0.0],
            [0.1, 0.0, 0.0],
            [0.3, 0.0, 0.0],
            [-0.3, 0.0, 0.0],
            [-0.6, 0.0, 0.0],
        ];
        let moved = motions.residual_at(&positions).into_iter();
        let moved: Vec<bool> = moved.map(|residual| residual == [0.5, 0.25, 0.0]).collect();
        assert_eq!(moved, [true, true, false, true, false]);
        assert_eq!(ObjectMotions::none().residual_at(&positions), [[0.0; 3]; 5]);

        let field = crate::flow::MotionField {
            ego: None,
            residual: crate::flow::Residual::Objects(motions.into()),
        };
        let bytes = field.to_bytes();
        let back = crate::flow::MotionField::from_bytes(&bytes).expect("sound");
        assert_eq!(back.to_bytes(), bytes);
        let crate::flow::Residual::Objects(back) = back.residual else {
            panic!("another kind of field came back");
        };
        let moved = back.residual_at(&positions).into_iter();
        let moved: Vec<bool> = moved.map(|residual| residual == [0.5, 0.25, 0.0]).collect();
        assert_eq!(moved, [true, true, false, true, false]);
    }
}
