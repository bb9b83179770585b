//! Early stopping with an absolute threshold, as in the published code.
//!
//! The first loss is the initial best. A loss more than `min_delta` below the best is progress
//! and becomes the best. After `patience` iterations without progress, or at a loss that is not a
//! number, the fit ends.

use crate::flow::options::EarlyStopOptions;

/// The early stopping rule and its state.
#[derive(Clone, Debug)]
pub(crate) struct EarlyStop {
    options: EarlyStopOptions,
    seen: EarlyStopState,
}

/// The state of the rule.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct EarlyStopState {
    /// The lowest loss that counted as progress; none before the first loss.
    pub(crate) best: Option<f32>,
    /// Iterations since then.
    pub(crate) without_progress: usize,
}

impl EarlyStop {
    /// A rule before the first loss.
    pub(crate) fn new(options: EarlyStopOptions) -> Self {
        Self::resumed(options, EarlyStopState::default())
    }

    /// A rule that resumes from the state `seen`.
    pub(crate) fn resumed(options: EarlyStopOptions, seen: EarlyStopState) -> Self {
        Self { options, seen }
    }

    /// The state of the rule.
    pub(crate) fn seen(&self) -> EarlyStopState {
        self.seen
    }

    /// Adds the next loss, metres. Returns true if the fit should end.
    pub(crate) fn observe(&mut self, loss: f32) -> bool {
        if loss.is_nan() {
            return true;
        }
        match self.seen.best {
            Some(best) if loss >= best - self.options.min_delta as f32 => {
                self.seen.without_progress += 1;
            }
            _ => {
                self.seen = EarlyStopState {
                    best: Some(loss),
                    without_progress: 0,
                };
            }
        }
        self.seen.without_progress >= self.options.patience.max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stops_at(patience: usize, losses: &[f32]) -> Option<usize> {
        let mut rule = EarlyStop::new(EarlyStopOptions {
            patience,
            min_delta: 1e-3,
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
