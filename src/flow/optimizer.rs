//! Adam (Kingma and Ba 2015), on slices: every backend with plain floats steps through this.

/// Decay of the mean of the gradients.
const BETA1: f64 = 0.9;

/// The factors of one step, the same for every parameter.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AdamStep {
    beta2: f32,
    step_size: f32,
    second_correction: f32,
}

impl AdamStep {
    const EPSILON: f32 = 1e-8;

    /// The factors of step `iteration` (from 1) at `learning_rate`.
    pub(crate) fn new(iteration: usize, learning_rate: f64, beta2: f64) -> Self {
        let power = i32::try_from(iteration).unwrap_or(i32::MAX);
        Self {
            beta2: beta2 as f32,
            step_size: (learning_rate / (1.0 - BETA1.powi(power))) as f32,
            second_correction: (1.0 / (1.0 - beta2.powi(power)).sqrt()) as f32,
        }
    }

    /// Moves one parameter against its gradient.
    #[inline]
    pub(crate) fn apply(&self, gradient: f32, parameter: &mut f32, moments: [&mut f32; 2]) {
        let [mean, square] = moments;
        *mean += (gradient - *mean) * (1.0 - BETA1) as f32;
        *square += (gradient * gradient - *square) * (1.0 - self.beta2);
        *parameter -= self.step_size * *mean
            / (square.sqrt() * self.second_correction + Self::EPSILON);
    }
}
