//! Absolute early stopping, as the published code does it.
//!
//! The first loss is the best; a loss more than `min_delta` below the best is progress; as many
//! iterations as `patience` without progress, or a loss that is not a number, are the end.

use crate::flow::options::EarlyStopOptions;

/// The rule's state.
#[derive(Clone, Debug)]
pub(crate) struct EarlyStop {
    options: EarlyStopOptions,
    seen: Seen,
}

/// What the rule has seen.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Seen {
    /// The lowest loss that counted as progress, metres.
    pub(crate) best: Option<f32>,
    /// Iterations since.
    pub(crate) without_progress: usize,
}

impl EarlyStop {
    /// A rule that has seen nothing.
    pub(crate) fn new(options: EarlyStopOptions) -> Self {
        Self::resumed(options, Seen::default())
    }

    /// A rule that goes on from what it has seen.
    pub(crate) fn resumed(options: EarlyStopOptions, seen: Seen) -> Self {
        Self { options, seen }
    }

    /// What it has seen.
    pub(crate) fn seen(&self) -> Seen {
        self.seen
    }

    /// Takes the next loss, metres; true where the optimization should end.
    pub(crate) fn observe(&mut self, loss: f32) -> bool {
        if loss.is_nan() {
            return true;
        }
        match self.seen.best {
            Some(best) if loss >= best - self.options.min_delta_m as f32 => {
                self.seen.without_progress += 1;
            }
            _ => {
                self.seen = Seen {
                    best: Some(loss),
                    without_progress: 0,
                };
            }
        }
        self.seen.without_progress >= self.options.patience
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stops_at(patience: usize, losses: &[f32]) -> Option<usize> {
        let mut rule = EarlyStop::new(EarlyStopOptions {
            patience,
            min_delta_m: 1e-3,
        });
        losses.iter().position(|&loss| rule.observe(loss))
    }

    #[test]
    fn small_progress_is_no_progress() {
        assert_eq!(stops_at(2, &[1.0, 0.9995, 0.9991, 0.5]), Some(2));
    }

    #[test]
    fn progress_is_counted_from_the_best_loss_that_counted() {
        assert_eq!(stops_at(2, &[1.0, 0.9995, 0.9985, 0.9984, 0.9983]), Some(4));
    }

    #[test]
    fn a_loss_that_is_not_a_number_ends_it() {
        assert_eq!(stops_at(5, &[1.0, f32::NAN]), Some(1));
    }
}
