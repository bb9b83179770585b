//! Every hyper-parameter and its default: the presets are here and nowhere else.

use super::distance::DistanceOptions;

/// Options of one estimate. Start from a [`Preset`] and change what you must.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Drives every random choice: the same seed gives the same bits.
    pub seed: u64,
    /// The distance transform.
    pub distance: DistanceOptions,
    /// What the network is fed.
    pub inputs: Inputs,
    /// Where the network starts.
    pub start: Start,
    /// Adam's step size at the first iteration.
    pub learning_rate: f32,
    /// Points drawn for each iteration; all of them where none.
    pub batch: Option<usize>,
    /// How the step size falls.
    pub decay: Decay,
    /// Momentum decay.
    pub beta2: f32,
    /// Average.
    pub average: Option<f32>,
    /// Dead.
    pub dead: f32,
    /// Norm.
    pub norm: f32,
    /// Distances count no further than this, metres.
    pub truncation_m: Option<f32>,
    /// When to stop before `max_iterations`.
    pub early_stop: Option<EarlyStopOptions>,
    /// Iterations at most.
    pub max_iterations: usize,
}

/// What the network is fed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Inputs {
    /// Coordinates as they come, metres.
    Raw,
    /// Coordinates about the cloud's mean, divided by this many metres.
    Centered {
        /// Metres that become one.
        scale_m: f32,
    },
}

/// Where the network starts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Start {
    /// Xavier-uniform weights in every layer: flows of metres at first.
    Xavier,
    /// Xavier but for the last layer, which is zero: no flow at first.
    ZeroFlow,
}

/// How the step size falls.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Decay {
    /// It does not.
    Constant,
    /// Linearly to zero at `max_iterations`.
    Linear,
    /// As a half cosine to zero.
    Cosine,
}

/// The stopping rule of the published code.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EarlyStopOptions {
    /// Iterations without progress before the end.
    pub patience: usize,
    /// Fall of the mean loss that counts as progress, metres.
    pub min_delta_m: f64,
}
