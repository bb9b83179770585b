//! A residual motion that is known at points, as a field over space.
//!
//! ```text
//! points u64 | each: x y z, its displacement x y z: f32
//! ```

use rayon::prelude::*;

use crate::flow::data::{Body, EnvelopeError, Point};
use crate::flow::spatial::ColumnIndex;

/// Range of a point, metres: positions farther from all points do not move.
const REACH_M: f32 = 0.5;
const POINT_BYTES: usize = 6 * size_of::<f32>();

/// The displacements of points: a position moves as the nearest point within 0.5 m, else not at
/// all.
#[derive(Debug)]
pub struct SampledMotion {
    points: Vec<Point>,
    displacements: Vec<Point>,
    index: ColumnIndex,
}

impl SampledMotion {
    /// From N `points` and the displacement of each, metres.
    pub(crate) fn new(points: Vec<Point>, displacements: Vec<Point>) -> Self {
        Self {
            index: ColumnIndex::new(&points, REACH_M),
            points,
            displacements,
        }
    }

    /// The motion back from where the points arrive.
    pub(super) fn reversed(&self) -> Self {
        let rows = self.points.iter().zip(&self.displacements);
        let arrived = rows.map(|(point, by)| core::array::from_fn(|a| point[a] + by[a]));
        let back = self.displacements.iter().map(|by| by.map(|c| -c));
        Self::new(arrived.collect(), back.collect())
    }

    /// The displacements of N `positions` (N x 3, metres): N x 3, metres.
    pub fn displacements_at(&self, positions: &[Point]) -> Vec<Point> {
        let at = |&position: &Point| {
            let nearest = self.index.nearest(position, REACH_M);
            nearest.map_or([0.0; 3], |(row, _)| self.displacements[row as usize])
        };
        positions.par_iter().map(at).collect()
    }

    /// Appends the encoded points to `bytes`.
    pub(super) fn put(&self, bytes: &mut Vec<u8>) {
        bytes.extend((self.points.len() as u64).to_le_bytes());
        let rows = self.points.iter().zip(&self.displacements);
        let floats = rows.flat_map(|(point, displacement)| point.iter().chain(displacement));
        bytes.extend(floats.flat_map(|value| value.to_le_bytes()));
    }

    /// Reads the bytes written by [`Self::put`].
    ///
    /// # Errors
    /// [`EnvelopeError::Damaged`] where bytes are missing or a number is not finite.
    pub(super) fn take(body: &mut Body<'_>) -> Result<Self, EnvelopeError> {
        let count = body.count_of(POINT_BYTES)?;
        let (mut points, mut displacements) =
            (Vec::with_capacity(count), Vec::with_capacity(count));
        let mut vector = || -> Result<Point, EnvelopeError> {
            let vector = [body.single()?, body.single()?, body.single()?];
            let is_finite = vector.iter().all(|value| value.is_finite());
            is_finite.then_some(vector).ok_or(EnvelopeError::Damaged)
        };
        for _ in 0..count {
            points.push(vector()?);
            displacements.push(vector()?);
        }
        Ok(Self::new(points, displacements))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_position_moves_as_the_nearest_point_within_reach() {
        let points = vec![[0.0; 3], [1.0, 0.0, 0.0]];
        let displacements = vec![[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]];
        let motion = SampledMotion::new(points, displacements.clone());
        let positions = [[0.1, 0.1, 0.0], [0.8, 0.0, 0.1], [0.5, 0.6, 0.0]];
        let [first, second] = displacements[..] else {
            panic!("two displacements");
        };
        let expected = [first, second, [0.0; 3]];
        assert_eq!(motion.displacements_at(&positions), expected);
    }
}
