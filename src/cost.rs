//! What work costs: nominal seconds from its price, real seconds from what was measured.
//!
//! Nominal seconds are kept with a job and never change; one learned factor turns them into this
//! machine's. It must not know jobs.

use std::sync::{Mutex, PoisonError};

use crate::flow::Price;

/// Multiply-adds of a nominal second: two cores with wide vector units.
const NOMINAL_RATE: f64 = 2e11;

/// Weight of a new measurement.
const FRESH: f64 = 0.1;

/// How many times slower or faster than nominal a machine is taken for.
const RANGE: (f64, f64) = (1e-3, 1e3);

/// The learned factor from nominal to real seconds.
#[derive(Debug)]
pub struct CostModel {
    log_factor: Mutex<Option<f64>>,
}

impl CostModel {
    /// A model that has measured nothing.
    pub fn new() -> Self {
        Self {
            log_factor: Mutex::new(None),
        }
    }

    /// Nominal seconds of some work.
    pub fn nominal(price: &Price) -> f64 {
        price.seconds(NOMINAL_RATE)
    }

    /// The seconds that work of `nominal` seconds takes here, by what was measured so far.
    pub fn seconds(&self, nominal: f64) -> f64 {
        let log_factor = self
            .log_factor
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        nominal * log_factor.map_or(1.0, f64::exp)
    }

    /// Learns that work of `nominal` seconds took `measured`.
    pub fn learn(&self, nominal: f64, measured: f64) {
        let ratio = (measured / nominal).clamp(RANGE.0, RANGE.1);
        if !ratio.is_finite() {
            return;
        }
        let mut log_factor = self
            .log_factor
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let fresh = ratio.ln();
        *log_factor = Some(log_factor.map_or(fresh, |old| old + FRESH * (fresh - old)));
    }
}

impl Default for CostModel {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factor_follows_what_is_measured_and_survives_nonsense() {
        let model = CostModel::new();
        assert_eq!(model.seconds(2.0), 2.0);
        model.learn(1.0, 3.0);
        assert!((model.seconds(2.0) - 6.0).abs() < 1e-9);
        for _ in 0..100 {
            model.learn(1.0, 0.5);
        }
        assert!((model.seconds(2.0) - 1.0).abs() < 1e-3);
        for (nominal, measured) in [(0.0, 0.0), (1.0, f64::NAN), (0.0, 1.0)] {
            model.learn(nominal, measured);
        }
        assert!(model.seconds(2.0).is_finite() && model.seconds(2.0) < 100.0);
    }
}
