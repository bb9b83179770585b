//! Options of the model of a field: the function from a point to its displacement.

/// The model of a field.
#[derive(Clone, Debug, PartialEq)]
pub enum ModelOptions {
    /// The coordinate network of FNSF Section 3: a ReLU MLP with 8 hidden layers of 128 features.
    Network(NetworkOptions),
    /// The linear model of FNSF's comparison: a complex positional encoding of the points.
    Linear(LinearOptions),
}

/// Options of the coordinate network.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NetworkOptions {
    /// Normalization of the network's inputs.
    pub inputs: InputNormalization,
    /// Initial weights of the network.
    pub start: Start,
    /// Floating-point precision of the network's matrix products during the fit.
    pub precision: Precision,
    /// The cycle consistency of NSFP: a second network of the same shape leads each deformed source
    /// point back, and the loss to the source is added to that to the target. It doubles the cost
    /// of an iteration. The CPU alone has it.
    pub cycle: bool,
}

impl NetworkOptions {
    /// The settings of FNSF's published code.
    pub fn published() -> Self {
        Self {
            inputs: InputNormalization::Raw,
            start: Start::Xavier,
            precision: Precision::F32,
            cycle: false,
        }
    }
}

/// Options of the linear model: a grid of voxels over the source, with one weight for each voxel and
/// axis of the displacement.
///
/// The weights are smoothed by Gaussians along the three axes, the Kronecker product of three
/// encodings. A point's displacement is blended from the 8 vertices around it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearOptions {
    /// Distance between neighboring vertices of the grid, metres, at least 0.01.
    pub voxel_m: f32,
    /// Standard deviation of the Gaussians, metres. It must be 0.5 to 100 voxels; above 2 voxels the
    /// field is smooth.
    pub sigma_m: f32,
    /// Weight of the total variation of the displacements on the grid in the loss. Not negative.
    pub variation_weight: f32,
    /// Limit on the memory of the grid, of its encodings and of the optimizer's state, bytes.
    pub max_bytes: usize,
}

impl LinearOptions {
    /// The settings of FNSF's published code for Argoverse: voxels of 2 m and Gaussians of 5 m.
    pub fn published() -> Self {
        Self {
            voxel_m: 2.0,
            sigma_m: 5.0,
            variation_weight: 0.5,
            max_bytes: 1 << 30,
        }
    }
}

/// Normalization of the coordinates that the network takes as input.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum InputNormalization {
    /// Coordinates in metres, without normalization. If the mean of the cloud is far from the
    /// origin (more than 200 m along an axis, as in a map frame), the mean is subtracted.
    Raw,
    /// The mean of the cloud is subtracted, and the coordinates are divided by `scale_m`.
    Centered {
        /// Length that becomes one, metres. It must be above zero.
        scale_m: f32,
    },
}

/// Initial parameters of the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// Xavier-uniform weights in every layer (Glorot and Bengio 2010, equation 16). The biases are
    /// zero. Weights are drawn from `U(-a, a)` with `a = sqrt(6 / (inputs + outputs))` of the
    /// layer. The length of the initial flow grows with the length of the network's input. With
    /// raw coordinates it is about 0.2 m to 2 m, 50 m from the origin.
    Xavier,
    /// As [`Self::Xavier`], but the last layer is zero. The initial flow is zero.
    ZeroFlow,
}

/// Floating-point precision of the network's matrix products during the fit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// Single precision throughout.
    #[default]
    F32,
    /// Half-precision factors in the layers from 128 to 128 features: features, weights and
    /// derivatives are rounded before they are multiplied. Sums, parameters, the optimizer, the
    /// other layers, the loss and the evaluation of the result remain in single precision. Requires
    /// a GPU whose matrix units pass their self-test; every other device rejects it.
    F16,
}

impl Precision {
    /// All precisions.
    pub const ALL: [Self; 2] = [Self::F32, Self::F16];

    /// The name used by the command line and the service: `f32` or `f16`.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
        }
    }
}
