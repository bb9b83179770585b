//! Binary encoding of the motions, little-endian.
//!
//! ```text
//! motions u64 | each: shift x y, turn, center x y: f32
//!   | moving points u64 | each: x y z f32, its motion u32 | static points u64 | each: x y z f32
//! ```

use super::motion_field::ObjectMotions;
use super::planar_motion::PlanarMotion;
use crate::flow::data::{Body, EnvelopeError, Point};

const MOTION_BYTES: usize = 5 * size_of::<f32>();
const POINT_BYTES: usize = 3 * size_of::<f32>();

impl ObjectMotions {
    /// Appends the encoded motions to `bytes`.
    pub(crate) fn put(&self, bytes: &mut Vec<u8>) {
        let (motions, moving, standing) = self.parts();
        let count = |bytes: &mut Vec<u8>, count: usize| bytes.extend((count as u64).to_le_bytes());
        let floats = |bytes: &mut Vec<u8>, values: &[f32]| {
            bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        };
        count(bytes, motions.len());
        for motion in motions {
            let ([x, y], [a, b]) = (motion.shift_m, motion.center);
            floats(bytes, &[x, y, motion.turn, a, b]);
        }
        count(bytes, moving.len());
        for (point, owner) in moving {
            floats(bytes, &point);
            bytes.extend(owner.to_le_bytes());
        }
        count(bytes, standing.len());
        for point in standing {
            floats(bytes, &point);
        }
    }

    /// Decodes the bytes written by [`Self::put`].
    ///
    /// # Errors
    /// [`EnvelopeError::Damaged`] where bytes are missing, a number is not finite or a motion's
    /// index is out of range.
    pub(crate) fn take(body: &mut Body<'_>) -> Result<Self, EnvelopeError> {
        let count = body.count_of(MOTION_BYTES)?;
        let mut motions = Vec::with_capacity(count);
        for _ in 0..count {
            motions.push(PlanarMotion {
                shift_m: [finite(body)?, finite(body)?],
                turn: finite(body)?,
                center: [finite(body)?, finite(body)?],
            });
        }
        let count = body.count_of(POINT_BYTES + size_of::<u32>())?;
        let mut moving: Vec<(Point, u32)> = Vec::with_capacity(count);
        for _ in 0..count {
            let point = [finite(body)?, finite(body)?, finite(body)?];
            let owner = u32::from_le_bytes(body.take()?);
            if owner as usize >= motions.len() {
                return Err(EnvelopeError::Damaged);
            }
            moving.push((point, owner));
        }
        let count = body.count_of(POINT_BYTES)?;
        let mut standing: Vec<Point> = Vec::with_capacity(count);
        for _ in 0..count {
            standing.push([finite(body)?, finite(body)?, finite(body)?]);
        }
        Ok(Self::of(motions, &moving, &standing))
    }
}

fn finite(body: &mut Body<'_>) -> Result<f32, EnvelopeError> {
    let value = body.single()?;
    value
        .is_finite()
        .then_some(value)
        .ok_or(EnvelopeError::Damaged)
}
