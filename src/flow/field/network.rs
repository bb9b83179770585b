//! A fitted network: its parameters and its input normalization.

use core::fmt;

use nalgebra::Vector3;

use super::mlp::{Conditioning, WIDTH, first_layer, last_layer};
use super::parameters::Parameters;
use crate::flow::data::{Point, RigidTransform};

/// The fitted coordinate network of one pair (FNSF Section 3): parameters and input normalization.
///
/// It maps a position to the displacement in one sweep interval, `g(p; theta)` in the paper, both
/// in metres. With an ego motion, the position is a source point after the ego motion, in the
/// target's frame, and the displacement is the residual flow.
/// [`crate::flow::field::Backend::evaluate`] computes it.
#[derive(Clone)]
pub struct Network {
    pub(crate) parameters: Parameters,
    pub(crate) conditioning: Conditioning,
}

impl Network {
    /// The parameters of the same field in another frame, for inputs normalized by `conditioning`.
    /// With `motion` as the transform to the new frame: `g'(p) = R g(motion^-1 p)`. The result is
    /// exact up to rounding: both rotations and the translation are absorbed by the first and last
    /// layers.
    pub(crate) fn transformed(
        &self,
        motion: &RigidTransform,
        conditioning: &Conditioning,
    ) -> Parameters {
        let rotation = motion.rotation.to_rotation_matrix().into_inner();
        let vector = |point: Point| Vector3::from(point.map(f64::from));
        let (own, new) = (&self.conditioning, conditioning);
        // The old input is (R^T (p - t) - center) * scale. In it, p is the new input divided by the
        // new scale, plus the new center.
        let stretch = f64::from(own.scale) / f64::from(new.scale);
        let shift = rotation.transpose() * (vector(new.center) - motion.translation.vector);
        let shift = (shift - vector(own.center)) * f64::from(own.scale);
        let mut transformed = self.parameters.clone();
        let (from, to) = (self.parameters.as_slice(), transformed.as_mut_slice());
        let layer = first_layer();
        for feature in 0..WIDTH {
            let weight = |input: usize| layer.weights + input * WIDTH + feature;
            let weights = Vector3::from_fn(|input, _| f64::from(from[weight(input)]));
            let turned = rotation * weights * stretch;
            for input in 0..3 {
                to[weight(input)] = turned[input] as f32;
            }
            to[layer.bias + feature] += weights.dot(&shift) as f32;
        }
        let layer = last_layer();
        for feature in 0..=WIDTH {
            // The biases follow the weights of all features.
            let index = |output: usize| match feature {
                WIDTH => layer.bias + output,
                _ => layer.weights + output * WIDTH + feature,
            };
            let flow = Vector3::from_fn(|output, _| f64::from(from[index(output)]));
            let turned = rotation * flow;
            for output in 0..3 {
                to[index(output)] = turned[output] as f32;
            }
        }
        transformed
    }
}

impl fmt::Debug for Network {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Network")
            .field("conditioning", &self.conditioning)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::cpu::CpuBackend;
    use crate::flow::data::Random;
    use crate::flow::data::transform_point;
    use crate::flow::field::backend::Backend;
    use crate::flow::field::mlp;
    use crate::flow::options::InputNormalization;

    /// Metres: single-precision rounding of coordinates of 50 m and of features of that size.
    const ROUNDING_M: f32 = 2e-4;

    #[test]
    fn a_carried_network_is_the_same_field_seen_from_the_new_frame() {
        let mut random = Random::new(5);
        let mut points = || -> Vec<Point> {
            let mut axis = |half: f64| random.uniform(-half, half) as f32;
            (0..200)
                .map(|_| [axis(50.0), axis(50.0), axis(3.0)])
                .collect()
        };
        let (fitted, others) = (points(), points());
        let scales = [10.0, 8.0].map(|scale_m| InputNormalization::Centered { scale_m });
        let parameters = mlp::xavier(&mut Random::new(9));
        let network = Network {
            parameters,
            conditioning: Conditioning::new(&fitted, scales[0]),
        };
        let motion = RigidTransform::new([1.5, -0.4, 0.1].into(), [0.01, -0.02, 0.3].into());
        let seen: Vec<Point> = others
            .iter()
            .map(|&point| transform_point(&motion, point))
            .collect();
        let conditioning = Conditioning::new(&seen, scales[1]);
        let transformed = Network {
            parameters: network.transformed(&motion, &conditioning),
            conditioning,
        };
        let backend = CpuBackend::new(Some(1)).expect("a thread");
        let before = backend.evaluate(&network, &others).expect("flows");
        let after = backend.evaluate(&transformed, &seen).expect("flows");
        for (before, after) in before.into_iter().zip(after) {
            let turned = motion.rotation * Vector3::from(before.map(f64::from));
            for axis in 0..3 {
                assert!((turned[axis] as f32 - after[axis]).abs() < ROUNDING_M);
            }
        }
    }
}
