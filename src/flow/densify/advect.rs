//! Advection of points through motion fields: Euler steps, and their inverse by fixed-point
//! iteration.

use super::error::DensifyError;
use crate::flow::data::{
    Control, DYNAMIC_M, DenseCloud, Point, RigidTransform, control, transform_points,
};
use crate::flow::field::{Backend, length};
use crate::flow::motion::MotionField;
use crate::flow::sequence::Sweep;

/// The inverse has converged when its last correction is shorter than this, metres.
const SETTLED_M: f32 = 0.01;
/// Maximum number of corrections of an inverse.
const CORRECTIONS: usize = 20;

/// Larger coordinates are invalid, metres.
const FARTHEST_M: f32 = 1e6;
/// Points between two checks of the control: about a tenth of a second on two cores.
const PIECE: usize = 1 << 17;

/// Points of several sweeps, all in the frame and at the time of one sweep.
#[derive(Default)]
pub(super) struct PropagatedCloud {
    points: Vec<Point>,
    sweep: Vec<u32>,
    /// Marks ground points. They have no residual motion where there is an ego motion.
    ground: Vec<bool>,
    dynamic: Vec<bool>,
    converged: Vec<bool>,
}

impl PropagatedCloud {
    /// Appends the valid points of `sweep`, whose index in the sequence is `index`. The cloud must
    /// be in that sweep's frame.
    pub(super) fn take(&mut self, index: usize, sweep: &Sweep) {
        for (row, point) in sweep.points.iter().enumerate() {
            if is_place(*point) {
                self.points.push(*point);
                self.ground
                    .push(sweep.ground.as_ref().is_some_and(|ground| ground[row]));
            }
        }
        self.sweep.resize(self.points.len(), index as u32);
        self.dynamic.resize(self.points.len(), false);
        self.converged.resize(self.points.len(), true);
    }

    /// Euler integration from the time of the field's source sweep to that of its target, in
    /// `substeps` equal steps. Afterwards the cloud is in the target's frame.
    ///
    /// A field that is known at the source's points alone takes one step: after a part of the way
    /// a point would have left them, and stop.
    pub(super) fn step(
        &mut self,
        by: Context<'_>,
        field: &MotionField,
        substeps: usize,
    ) -> Result<(), DensifyError> {
        self.points = field.static_positions(&self.points);
        let substeps = match field.residual.is_known_at_points() {
            true => 1,
            false => substeps,
        };
        for _ in 0..substeps {
            self.advect(by, field, 1.0 / substeps as f32)?;
        }
        Ok(())
    }

    /// One Euler step that ends after `share` (0 to 1) of the interval. The points are still given
    /// in the target's frame.
    pub(super) fn part_step(
        &mut self,
        by: Context<'_>,
        field: &MotionField,
        share: f64,
    ) -> Result<(), DensifyError> {
        self.points = field.static_positions(&self.points);
        self.advect(by, field, share as f32)
    }

    /// Adds `share` of the residual motion at the current positions to all points that may move.
    fn advect(
        &mut self,
        by: Context<'_>,
        field: &MotionField,
        share: f32,
    ) -> Result<(), DensifyError> {
        let rows = self.movable(field);
        let indices: Vec<Point> = rows.iter().map(|&row| self.points[row]).collect();
        let residual = by.motion(field, &indices)?;
        for (row, residual) in rows.into_iter().zip(residual) {
            if field.ego.is_some() && residual != [0.0; 3] {
                self.dynamic[row] = true;
            }
            let index = self.points[row];
            let moved = core::array::from_fn(|a| index[a] + share * residual[a]);
            if is_place(moved) {
                self.points[row] = moved;
            } else {
                self.converged[row] = false;
            }
        }
        Ok(())
    }

    /// The inverse step, from the time of the field's target sweep to that of its source.
    pub(super) fn invert(
        &mut self,
        by: Context<'_>,
        field: &MotionField,
    ) -> Result<(), DensifyError> {
        match field.residual.reversed() {
            Some(residual) => {
                let ego = field.ego;
                self.advect(by, &MotionField { ego, residual }, 1.0)?;
            }
            None => self.find_fixed_points(by, field)?,
        }
        if let Some(motion) = &field.ego {
            self.transform(&motion.inverse());
        }
        Ok(())
    }

    /// For each position y solves `z = y - g(z)` by fixed-point iteration, where z is the static
    /// position.
    fn find_fixed_points(
        &mut self,
        by: Context<'_>,
        field: &MotionField,
    ) -> Result<(), DensifyError> {
        let mut rows = self.movable(field);
        let ends = self.points.clone();
        for _ in 0..CORRECTIONS {
            let indices: Vec<Point> = rows.iter().map(|&row| self.points[row]).collect();
            let residual = by.motion(field, &indices)?;
            let mut unsettled = Vec::new();
            for (&row, residual) in rows.iter().zip(residual) {
                let index: Point = core::array::from_fn(|a| ends[row][a] - residual[a]);
                let correction = core::array::from_fn(|a| index[a] - self.points[row][a]);
                self.points[row] = index;
                // Negated, so that NaN counts as not converged.
                if !(length(correction) < SETTLED_M && is_place(index)) {
                    unsettled.push(row);
                }
            }
            rows = unsettled;
        }
        // Points that did not converge are treated as static.
        for row in rows {
            self.converged[row] = false;
            self.points[row] = ends[row];
        }
        if field.ego.is_some() {
            for (row, end) in ends.iter().enumerate() {
                self.dynamic[row] |= self.points[row] != *end;
            }
        }
        Ok(())
    }

    /// Applies a rigid motion to all points.
    pub(super) fn transform(&mut self, motion: &RigidTransform) {
        self.points = transform_points(motion, &self.points);
    }

    /// Joins both clouds into the dense cloud of the reference time `reference_time`, in sweeps.
    pub(super) fn joined(mut self, other: Self, reference_time: f64) -> DenseCloud {
        self.points.extend(other.points);
        self.sweep.extend(other.sweep);
        self.dynamic.extend(other.dynamic);
        self.converged.extend(other.converged);
        DenseCloud {
            age: self
                .sweep
                .iter()
                .map(|&sweep| (reference_time - f64::from(sweep)) as f32)
                .collect(),
            points: self.points,
            sweep: self.sweep,
            dynamic: self.dynamic,
            converged: self.converged,
        }
    }

    /// Rows of the points that a field may move: all but the ground. A function of space has the motion
    /// of the ground, too, where there is no ego motion.
    fn movable(&self, field: &MotionField) -> Vec<usize> {
        let has_ground = field.ego.is_none() && !field.residual.is_known_at_points();
        (0..self.points.len())
            .filter(|&row| !self.ground[row] || has_ground)
            .collect()
    }
}

/// The device that evaluates fields, and the control that is checked meanwhile.
#[derive(Clone, Copy)]
pub(super) struct Context<'a> {
    pub(super) backend: &'a dyn Backend,
    pub(super) control: &'a dyn Control,
}

impl Context<'_> {
    /// The field's residual motion at the static positions (N x 3), metres. Checks the control
    /// between pieces.
    ///
    /// With an ego motion, residuals below [`DYNAMIC_M`] are set to zero, so that the static world
    /// does not move. Without one the field describes the motion of the static world, too, and
    /// nothing is set to zero.
    fn motion(self, field: &MotionField, indices: &[Point]) -> Result<Vec<Point>, DensifyError> {
        let mut residual = Vec::with_capacity(indices.len());
        for piece in indices.chunks(PIECE) {
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

/// Whether all coordinates are finite and at most [`FARTHEST_M`].
fn is_place(point: Point) -> bool {
    point.iter().all(|value| value.abs() <= FARTHEST_M)
}
