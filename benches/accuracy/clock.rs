//! A wall clock for the numerics, which keep no time of their own.

use std::time::Instant;

use fnsf::flow::Control;

/// Measures seconds since its start.
pub(crate) struct Clock(Instant);

impl Clock {
    pub(crate) fn start() -> Self {
        Self(Instant::now())
    }
}

impl Control for Clock {
    fn seconds(&self) -> f64 {
        self.0.elapsed().as_secs_f64()
    }
}
