//! Serialization of a motion field.
//!
//! ```text
//! ego: present u8, rotation i j k w, translation x y z: f64 each
//!   | residual u8: 0 static | 1 network: center x y z, scale, parameters: f32 each
//!   | 2 objects: as in `objects/codec.rs` | 3 linear: as in `field/linear.rs`
//!   | 4 sampled: as in `samples.rs`
//! ```
//!
//! The envelope (magic, version, checksum) is that of `data/codec.rs`. A missing ego motion is
//! written as the identity with `present` 0.

use std::sync::Arc;

use nalgebra::{Quaternion, Translation3, UnitQuaternion};

use super::motion_field::{MotionField, Residual};
use super::samples::SampledMotion;
use crate::flow::data::{Body, Envelope, EnvelopeError, RigidTransform};
use crate::flow::field::{
    Conditioning, LAID_OUT, LinearField, Network, put_parameters, take_parameters,
};
use crate::flow::objects::ObjectMotions;

const ENVELOPE: Envelope = Envelope {
    magic: *b"FNSFFILD",
    version: 1,
};
const STILL: u8 = 0;
const NETWORK: u8 = 1;
const OBJECTS: u8 = 2;
const LINEAR: u8 = 3;
const SAMPLED: u8 = 4;
/// Tolerance of a rotation quaternion's norm around 1: rounding of doubles.
const UNIT: f64 = 1e-9;

impl MotionField {
    /// The motion field as bytes, which [`Self::from_bytes`] reads. A network takes about 0.5 MB.
    /// Object motions grow with their number of points.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = ENVELOPE.begin();
        bytes.push(self.ego.is_some().into());
        let motion = self.ego.unwrap_or_default();
        let rotation = motion.rotation.coords;
        for value in rotation.iter().chain(motion.translation.vector.iter()) {
            bytes.extend(value.to_le_bytes());
        }
        match &self.residual {
            Residual::Still => bytes.push(STILL),
            Residual::Network(network) => {
                bytes.push(NETWORK);
                let Conditioning { center, scale } = network.conditioning;
                for value in center.into_iter().chain([scale]) {
                    bytes.extend(value.to_le_bytes());
                }
                put_parameters(&mut bytes, &network.parameters);
            }
            Residual::Linear(field) => {
                bytes.push(LINEAR);
                field.put(&mut bytes);
            }
            Residual::Objects(motions) => {
                bytes.push(OBJECTS);
                motions.put(&mut bytes);
            }
            Residual::Sampled(motion) => {
                bytes.push(SAMPLED);
                motion.put(&mut bytes);
            }
        }
        ENVELOPE.close(bytes)
    }

    /// Reads the bytes that [`Self::to_bytes`] wrote. No more memory is allocated than the values
    /// in `bytes` need.
    ///
    /// # Errors
    /// [`EnvelopeError::Magic`] if the bytes do not begin as a motion field,
    /// [`EnvelopeError::Version`] if they are of another version, and [`EnvelopeError::Damaged`] if
    /// they are truncated or altered or hold an ego motion or object motion that is not finite or
    /// otherwise invalid. The parameters of a network are not checked.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, EnvelopeError> {
        let mut body = ENVELOPE.open(bytes)?;
        let ego = motion(&mut body)?;
        let [kind] = body.take()?;
        let residual = match kind {
            STILL => Residual::Still,
            NETWORK => Residual::Network(Network {
                conditioning: Conditioning {
                    center: [body.single()?, body.single()?, body.single()?],
                    scale: body.single()?,
                },
                parameters: take_parameters(&mut body, LAID_OUT)?,
            }),
            LINEAR => Residual::Linear(LinearField::take(&mut body)?),
            OBJECTS => Residual::Objects(Arc::new(ObjectMotions::take(&mut body)?)),
            SAMPLED => Residual::Sampled(Arc::new(SampledMotion::take(&mut body)?)),
            _ => return Err(EnvelopeError::Damaged),
        };
        body.end()?;
        Ok(Self { ego, residual })
    }
}

/// Reads the ego motion, none if it is absent.
fn motion(body: &mut Body<'_>) -> Result<Option<RigidTransform>, EnvelopeError> {
    let [known] = body.take()?;
    let mut float = || body.float();
    let rotation = Quaternion::from([float()?, float()?, float()?, float()?]);
    let translation = Translation3::new(float()?, float()?, float()?);
    let is_turn = (rotation.norm() - 1.0).abs() < UNIT;
    let is_place = translation.vector.iter().all(|value| value.is_finite());
    if known > 1 || !is_turn || !is_place {
        return Err(EnvelopeError::Damaged);
    }
    let rotation = UnitQuaternion::new_unchecked(rotation);
    Ok((known == 1).then(|| RigidTransform::from_parts(translation, rotation)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;
    use crate::flow::field::{LinearGrid, mlp};
    use crate::flow::options::LinearOptions;

    #[test]
    fn a_field_comes_back_from_its_bytes_and_altered_bytes_are_refused() {
        let motion = RigidTransform::new([1.5, -0.4, 0.1].into(), [0.01, -0.02, 0.3].into());
        let network = Residual::Network(Network {
            parameters: mlp::xavier(&mut Random::new(2)),
            conditioning: Conditioning {
                center: [1.0, 2.0, 3.0],
                scale: 0.1,
            },
        });
        let cloud = [[0.0; 3], [9.0, 7.0, 1.0]];
        let grid = LinearGrid::plan(&cloud, &LinearOptions::published()).expect("a small grid");
        let linear = Residual::Linear(LinearField {
            values: vec![0.25; 3 * grid.channel()],
            grid,
        });
        let cloud = cloud.to_vec();
        let sampled = Residual::Sampled(Arc::new(SampledMotion::new(cloud.clone(), cloud)));
        for (ego, residual) in [
            (None, linear),
            (Some(motion), sampled),
            (Some(motion), network.clone()),
            (None, network),
            (Some(motion), Residual::Still),
            (None, Residual::Still),
        ] {
            let bytes = MotionField { ego, residual }.to_bytes();
            let back = MotionField::from_bytes(&bytes).expect("sound");
            assert_eq!(back.ego, ego);
            assert_eq!(back.to_bytes(), bytes);
            for at in [0, 9, 12, 13, 60, bytes.len() / 2, bytes.len() - 1] {
                let mut altered = bytes.clone();
                altered[at] ^= 1;
                assert!(MotionField::from_bytes(&altered).is_err(), "byte {at}");
                assert!(MotionField::from_bytes(&bytes[..at]).is_err(), "{at} bytes");
            }
            let longer = [bytes.as_slice(), &[0; 9]].concat();
            assert!(MotionField::from_bytes(&longer).is_err());
        }
    }
}
