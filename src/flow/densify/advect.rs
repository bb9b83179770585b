//! Points on their way from their own sweeps' frames to another. Knows fields, and no sequences.

use super::accumulate::DensifyError;
use crate::flow::data::{
    Control, DYNAMIC_M, DenseCloud, Point, RigidTransform, control, transform_points,
};
use crate::flow::field::{Backend, length};
use crate::flow::motion::MotionField;
use crate::flow::sequence::Sweep;

/// An inverse has settled where its last correction is shorter than this, metres.
const SETTLED_M: f32 = 0.01;
/// Corrections of an inverse at most.
const CORRECTIONS: usize = 20;

/// Places farther than this from the frame's origin are none, metres.
const FARTHEST_M: f32 = 1e6;
/// Points between two looks at the watch: a tenth of a second of two cores.
const PIECE: usize = 1 << 17;

/// Points of several sweeps, all in one frame.
#[derive(Default)]
pub(super) struct PropagatedCloud {
    points: Vec<Point>,
    frame: Vec<u32>,
    /// What never moves of itself.
    ground: Vec<bool>,
    dynamic: Vec<bool>,
    converged: Vec<bool>,
}

impl PropagatedCloud {
    /// Takes the finite points of the sweep whose frame this is.
    pub(super) fn take(&mut self, place: usize, sweep: &Sweep) {
        for (row, point) in sweep.points.iter().enumerate() {
            if is_place(*point) {
                self.points.push(*point);
                self.ground
                    .push(sweep.ground.as_ref().is_some_and(|ground| ground[row]));
            }
        }
        self.frame.resize(self.points.len(), place as u32);
        self.dynamic.resize(self.points.len(), false);
        self.converged.resize(self.points.len(), true);
    }

    /// Euler's step from the field's source frame to its target's, in parts.
    pub(super) fn step(
        &mut self,
        by: Context<'_>,
        field: &MotionField,
        substeps: usize,
    ) -> Result<(), DensifyError> {
        self.points = field.static_places(&self.points);
        for _ in 0..substeps {
            self.advect(by, field, 1.0 / substeps as f32)?;
        }
        Ok(())
    }

    /// A step that ends after `share` of the time, still in the target's frame.
    pub(super) fn part_step(
        &mut self,
        by: Context<'_>,
        field: &MotionField,
        share: f64,
    ) -> Result<(), DensifyError> {
        self.points = field.static_places(&self.points);
        self.advect(by, field, share as f32)
    }

    /// Moves what moves of itself by `share` of what the field says where it is now.
    fn advect(
        &mut self,
        by: Context<'_>,
        field: &MotionField,
        share: f32,
    ) -> Result<(), DensifyError> {
        let rows = self.movable();
        let places: Vec<Point> = rows.iter().map(|&row| self.points[row]).collect();
        let residual = by.motion(field, &places)?;
        for (row, residual) in rows.into_iter().zip(residual) {
            if field.ego.is_some() && residual != [0.0; 3] {
                self.dynamic[row] = true;
            }
            let place = self.points[row];
            let moved = core::array::from_fn(|a| place[a] + share * residual[a]);
            if is_place(moved) {
                self.points[row] = moved;
            } else {
                self.converged[row] = false;
            }
        }
        Ok(())
    }

    /// From the field's target frame back to its source's: the fixed point of `z = y - g(z)` for
    /// each place y, where z is its static place.
    pub(super) fn invert(
        &mut self,
        by: Context<'_>,
        field: &MotionField,
    ) -> Result<(), DensifyError> {
        let mut rows = self.movable();
        let ends = self.points.clone();
        for _ in 0..CORRECTIONS {
            let places: Vec<Point> = rows.iter().map(|&row| self.points[row]).collect();
            let residual = by.motion(field, &places)?;
            let mut unsettled = Vec::new();
            for (&row, residual) in rows.iter().zip(residual) {
                let place: Point = core::array::from_fn(|a| ends[row][a] - residual[a]);
                let correction = core::array::from_fn(|a| place[a] - self.points[row][a]);
                self.points[row] = place;
                // Not the other way round: what is no number has not settled.
                if !(length(correction) < SETTLED_M && is_place(place)) {
                    unsettled.push(row);
                }
            }
            rows = unsettled;
        }
        // What did not settle is left where it would be if it stood.
        for row in rows {
            self.converged[row] = false;
            self.points[row] = ends[row];
        }
        if field.ego.is_some() {
            for (row, end) in ends.iter().enumerate() {
                self.dynamic[row] |= self.points[row] != *end;
            }
        }
        if let Some(motion) = &field.ego {
            self.transform(&motion.inverse());
        }
        Ok(())
    }

    /// Moves all points rigidly.
    pub(super) fn transform(&mut self, motion: &RigidTransform) {
        self.points = transform_points(motion, &self.points);
    }

    /// These points and those, as the cloud of the instant `into`.
    pub(super) fn joined(mut self, other: Self, into: f64) -> DenseCloud {
        self.points.extend(other.points);
        self.frame.extend(other.frame);
        self.dynamic.extend(other.dynamic);
        self.converged.extend(other.converged);
        DenseCloud {
            age: self
                .frame
                .iter()
                .map(|&frame| (into - f64::from(frame)) as f32)
                .collect(),
            points: self.points,
            frame: self.frame,
            dynamic: self.dynamic,
            converged: self.converged,
        }
    }

    /// Rows of what may move of itself.
    fn movable(&self) -> Vec<usize> {
        (0..self.points.len())
            .filter(|&row| !self.ground[row])
            .collect()
    }
}

/// What computes, and who looks in on it.
#[derive(Clone, Copy)]
pub(super) struct Context<'a> {
    pub(super) backend: &'a dyn Backend,
    pub(super) control: &'a dyn Control,
}

impl Context<'_> {
    /// What the field moves at the static places, metres: nothing where that is less than counts as
    /// motion, so that the static world stands still. Without an ego motion the field moves that too,
    /// and all of it counts. Looks at the watch between pieces.
    fn motion(self, field: &MotionField, places: &[Point]) -> Result<Vec<Point>, DensifyError> {
        let mut residual = Vec::with_capacity(places.len());
        for piece in places.chunks(PIECE) {
            control::check(self.control).map_err(DensifyError::Interrupted)?;
            residual.extend(field.residual(self.backend, piece)?);
        }
        if field.ego.is_some() {
            for motion in &mut residual {
                if length(*motion) < DYNAMIC_M {
                    *motion = [0.0; 3];
                }
            }
        }
        Ok(residual)
    }
}

/// Whether a lidar could have measured something there.
fn is_place(point: Point) -> bool {
    point.iter().all(|value| value.abs() < FARTHEST_M)
}
