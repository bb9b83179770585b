//! Adam (Kingma and Ba 2015), on slices of single-precision floats.

/// Decay of the running mean of the gradients.
const BETA1: f64 = 0.9;
/// Decay of the running mean of their squares.
const BETA2: f64 = 0.999;
/// Added to the denominator.
const EPSILON: f32 = 1e-8;

/// The factors of one Adam step, equal for all parameters.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AdamStep {
    pub(crate) step_size: f32,
    pub(crate) square_correction: f32,
}

impl AdamStep {
    /// The factors of step `iteration` (from 1) at `learning_rate`.
    pub(crate) fn new(iteration: usize, learning_rate: f64) -> Self {
        let power = i32::try_from(iteration).unwrap_or(i32::MAX);
        Self {
            step_size: (learning_rate / (1.0 - BETA1.powi(power))) as f32,
            square_correction: (1.0 / (1.0 - BETA2.powi(power)).sqrt()) as f32,
        }
    }

    /// Updates `parameters` and `moments` by their `gradients`. `moments` are the running means of
    /// the gradients and of their squares.
    pub(crate) fn apply(
        &self,
        gradients: &[f32],
        parameters: &mut [f32],
        moments: [&mut [f32]; 2],
    ) {
        let [means, squares] = moments;
        let moments = means.iter_mut().zip(squares);
        for ((gradient, parameter), (mean, square)) in gradients.iter().zip(parameters).zip(moments)
        {
            *mean += (gradient - *mean) * (1.0 - BETA1) as f32;
            *square += (gradient * gradient - *square) * (1.0 - BETA2) as f32;
            let scale = square.sqrt() * self.square_correction + EPSILON;
            *parameter -= self.step_size * *mean / scale;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Single-precision against double-precision steps, over a hundred iterations.
    const TOLERANCE: f64 = 1e-5;

    #[test]
    fn a_hundred_steps_follow_the_formula_in_double_precision() {
        let gradient = |x: f64, i: usize| (x - 0.3) * 2.0 + 0.1 * (i as f64).sin();
        let (mut x, mut mean, mut square) = ([1.0f32], [0.0f32], [0.0f32]);
        let (mut y, mut m, mut v) = (1.0f64, 0.0f64, 0.0f64);
        for i in 1..=100 {
            let g = gradient(f64::from(x[0]), i) as f32;
            AdamStep::new(i, 0.01).apply(&[g], &mut x, [&mut mean, &mut square]);
            let g = gradient(y, i);
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            let m_hat = m / (1.0 - 0.9f64.powi(i as i32));
            let v_hat = v / (1.0 - 0.999f64.powi(i as i32));
            y -= 0.01 * m_hat / (v_hat.sqrt() + 1e-8);
        }
        assert!((f64::from(x[0]) - y).abs() < TOLERANCE, "{} {y}", x[0]);
    }

    #[test]
    fn the_first_step_has_the_length_of_the_learning_rate() {
        let mut x = [0.0f32, 0.0];
        AdamStep::new(1, 0.008).apply(&[3.0, -1e-3], &mut x, [&mut [0.0; 2], &mut [0.0; 2]]);
        assert!(
            (x[0] + 0.008).abs() < 1e-6 && (x[1] - 0.008).abs() < 1e-6,
            "{x:?}"
        );
    }
}
