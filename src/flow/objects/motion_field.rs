//! The motions of the movers of a pair, at any place.
//!
//! A place moves with the source point nearest to it: with its mover, or not at all. It must not
//! know how movers were found.

use rayon::prelude::*;

use super::planar_motion::PlanarMotion;
use crate::flow::data::Point;
use crate::flow::spatial::{ColumnIndex, NOISE};

/// A place farther than this from every mover's points does not move, metres: what belongs to an
/// object lies as near to the rest of it as its own points lie to each other.
const REACH_M: f32 = 0.5;

/// Rigid motions, and the source points that have them or have none.
#[derive(Debug)]
pub struct ObjectMotions {
    motions: Vec<PlanarMotion>,
    /// Of each moving point, its motion.
    point_motion: Vec<u32>,
    moving: ColumnIndex,
    standing: ColumnIndex,
}

impl ObjectMotions {
    /// Nothing moves.
    pub(super) fn none() -> Self {
        Self::new(Vec::new(), &[], &[])
    }

    /// Of `points`, in metres with the ego motion taken out, and which of `motions` each has;
    /// [`NOISE`] stands still.
    pub(super) fn new(motions: Vec<PlanarMotion>, points: &[Point], point_motion: &[u32]) -> Self {
        let of = |moves: bool| {
            let chosen = points.iter().zip(point_motion);
            chosen.filter(move |&(_, &owner)| (owner != NOISE) == moves)
        };
        let moving: Vec<Point> = of(true).map(|(&point, _)| point).collect();
        let moving = ColumnIndex::new(&moving, 2.0 * REACH_M);
        // What stands farther from all that moves is the nearest to no place that may move.
        let matters = |point: Point| moving.nearest(point, 2.0 * REACH_M, |_| true).is_some();
        let standing = of(false).map(|(&point, _)| point);
        let standing: Vec<Point> = standing.filter(|&point| matters(point)).collect();
        Self {
            motions,
            point_motion: of(true).map(|(_, &owner)| owner).collect(),
            moving,
            standing: ColumnIndex::new(&standing, REACH_M),
        }
    }

    /// The motions, the points that have them and which, and the points beside them that stand.
    pub(super) fn parts(&self) -> (&[PlanarMotion], Vec<(Point, u32)>, Vec<Point>) {
        let moving = self.moving.in_order().into_iter();
        let moving = moving.zip(self.point_motion.iter().copied());
        (&self.motions, moving.collect(), self.standing.in_order())
    }

    /// How far each place moves within one gap between the sweeps, beyond what the ego motion
    /// explains: metres, in the target's frame, at places in the source's frame with the ego motion
    /// taken out. They need not be the source's own.
    pub fn residual_at(&self, places: &[Point]) -> Vec<Point> {
        places
            .par_iter()
            .map(|&place| self.residual(place))
            .collect()
    }

    fn residual(&self, place: Point) -> Point {
        match self.owner(place) {
            NOISE => [0.0; 3],
            owner => self.displacement(owner, place),
        }
    }

    /// Which of the motions a place has; [`NOISE`] where it stands still.
    fn owner(&self, place: Point) -> u32 {
        let Some((row, square)) = self.moving.nearest(place, REACH_M, |_| true) else {
            return NOISE;
        };
        let stands = self.standing.nearest(place, square.sqrt(), |_| true);
        match stands {
            Some(_) => NOISE,
            None => self.point_motion[row as usize],
        }
    }

    /// [`Self::owner`] of every place.
    pub(super) fn owners_at(&self, places: &[Point]) -> Vec<u32> {
        places.par_iter().map(|&place| self.owner(place)).collect()
    }

    /// How far the motion of this number moves a place, metres, as [`Self::residual_at`] says it.
    pub(crate) fn displacement(&self, motion: u32, place: Point) -> Point {
        self.motions[motion as usize].displacement(place)
    }

    /// Radians that the motion of this number turns about the vertical, counterclockwise.
    pub(crate) fn turn(&self, motion: u32) -> f32 {
        self.motions[motion as usize].turn
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_moves_with_the_nearest_point_and_far_from_movers_not_at_all() {
        let motion = PlanarMotion::still([0.0; 2]).shifted([0.5, 0.25]);
        let points = [[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]];
        let motions = ObjectMotions::new(vec![motion], &points, &[0, NOISE]);
        let places = [
            [0.0, 0.0, 0.0],
            [0.1, 0.0, 0.0],
            [0.3, 0.0, 0.0],
            [-0.3, 0.0, 0.0],
            [-0.6, 0.0, 0.0],
        ];
        let moved = motions.residual_at(&places).into_iter();
        let moved: Vec<bool> = moved.map(|residual| residual == [0.5, 0.25, 0.0]).collect();
        assert_eq!(moved, [true, true, false, true, false]);
        assert_eq!(ObjectMotions::none().residual_at(&places), [[0.0; 3]; 5]);

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
        let moved = back.residual_at(&places).into_iter();
        let moved: Vec<bool> = moved.map(|residual| residual == [0.5, 0.25, 0.0]).collect();
        assert_eq!(moved, [true, true, false, true, false]);
    }
}
