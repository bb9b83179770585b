//! A field as bytes, so that another process can go on with it. Knows no files.
//!
//! ```text
//! parts u8 (1 ego motion, 2 network) | rotation i j k w, translation x y z: f64 each
//!   | center x y z, scale: f32 each | parameters: f32 each
//! ```
//!
//! Sealed as `sealed.rs` says; parts that are not there are zero.

use nalgebra::{Quaternion, Translation3, UnitQuaternion};

use super::mlp::{Conditioning, Parameters};
use super::{Field, Network};
use crate::flow::points::RigidTransform;
use crate::flow::sealed::{PARAMETERS_BYTES, Seal, SealError, put_parameters};

const SEAL: Seal = Seal {
    magic: *b"FNSFFILD",
    version: 1,
    body: 1 + 7 * size_of::<f64>() + 4 * size_of::<f32>() + PARAMETERS_BYTES,
};
const EGO: u8 = 1;
const NETWORK: u8 = 2;
/// How far from one a rotation's length may be: what doubles leave of it.
const UNIT: f64 = 1e-9;

impl Field {
    /// The field as bytes, 0.5 MB.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = SEAL.begin();
        let ego = self.ego.map_or(0, |_| EGO);
        bytes.push(ego | self.network.as_ref().map_or(0, |_| NETWORK));
        let motion = self.ego.unwrap_or_default();
        let rotation = motion.rotation.coords;
        for value in rotation.iter().chain(motion.translation.vector.iter()) {
            bytes.extend(value.to_le_bytes());
        }
        let (mut center, mut scale) = ([0.0; 3], 0.0);
        if let Some(network) = &self.network {
            (center, scale) = (network.conditioning.center, network.conditioning.scale);
        }
        for value in center.into_iter().chain([scale]) {
            bytes.extend(f32::to_le_bytes(value));
        }
        match &self.network {
            Some(network) => put_parameters(&mut bytes, &network.parameters),
            None => put_parameters(&mut bytes, &Parameters::zeros()),
        }
        SEAL.close(bytes)
    }

    /// Reads what [`Self::to_bytes`] wrote; nothing is allocated before all is known to be there.
    ///
    /// # Errors
    /// [`SealError`] where the bytes are no field, of another version, torn or altered.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SealError> {
        let mut body = SEAL.open(bytes)?;
        let [parts] = body.take()?;
        let mut float = || body.float();
        let rotation = Quaternion::from([float()?, float()?, float()?, float()?]);
        let translation = Translation3::new(float()?, float()?, float()?);
        let mut single = || body.take().map(f32::from_le_bytes);
        let center = [single()?, single()?, single()?];
        let scale = single()?;
        let parameters = body.parameters()?;
        let is_turn = (rotation.norm() - 1.0).abs() < UNIT;
        let is_place = translation.vector.iter().all(|value| value.is_finite());
        if parts & !(EGO | NETWORK) != 0 || !is_turn || !is_place {
            return Err(SealError::Damaged);
        }
        let rotation = UnitQuaternion::new_unchecked(rotation);
        Ok(Self {
            ego: (parts & EGO != 0).then(|| RigidTransform::from_parts(translation, rotation)),
            network: (parts & NETWORK != 0).then_some(Network {
                parameters,
                conditioning: Conditioning { center, scale },
            }),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::random::Random;

    #[test]
    fn a_field_comes_back_from_its_bytes_and_altered_bytes_are_refused() {
        let motion = RigidTransform::new([1.5, -0.4, 0.1].into(), [0.01, -0.02, 0.3].into());
        let network = Network {
            parameters: Parameters::xavier(&mut Random::new(2)),
            conditioning: Conditioning {
                center: [1.0, 2.0, 3.0],
                scale: 0.1,
            },
        };
        for (ego, network) in [
            (Some(motion), Some(network.clone())),
            (None, Some(network)),
            (Some(motion), None),
            (None, None),
        ] {
            let bytes = Field { ego, network }.to_bytes();
            let back = Field::from_bytes(&bytes).expect("sound");
            assert_eq!(back.ego, ego);
            assert_eq!(back.to_bytes(), bytes);
            for place in [0, 9, 12, 13, 60, bytes.len() / 2, bytes.len() - 1] {
                let mut altered = bytes.clone();
                altered[place] ^= 1;
                assert!(Field::from_bytes(&altered).is_err(), "byte {place}");
            }
            assert!(matches!(
                Field::from_bytes(&bytes[1..bytes.len() - 1]),
                Err(SealError::Magic)
            ));
        }
    }
}
