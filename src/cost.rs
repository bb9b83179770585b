//! What work costs: nominal seconds from its price, real seconds from what was measured.
//!
//! Nominal seconds are kept with a job and never change; one learned factor for each kind of device
//! turns them into this machine's. It must not know jobs.

use std::sync::{Mutex, PoisonError};

use crate::flow::Cost;
use crate::flow::field::PARAMETERS;
use crate::job::DeviceKind;

/// Multiply-adds of a nominal second: two cores with wide vector units.
const NOMINAL_RATE: f64 = 2e11;

/// Nominal seconds of any job, however small: it is written, leased, read and committed.
const EACH: f64 = 0.005;

/// Weight of a new measurement of a job of [`WHOLE`] nominal seconds or more; a smaller one has less,
/// so that what is learned is learned of work and not of jobs.
const FRESH: f64 = 0.1;
const WHOLE: f64 = 0.1;

/// A job of fewer nominal seconds says nothing of what work takes.
const LEAST: f64 = 0.02;

/// How many times slower or faster than nominal a machine is taken for.
const RANGE: (f64, f64) = (1e-3, 1e3);

/// How many pairs are worked on at the same time, by kind of device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lanes {
    /// Those of processors.
    pub cpu: usize,
    /// Those of cards.
    pub gpu: usize,
}

impl Lanes {
    /// Those of one kind.
    pub fn of(self, kind: DeviceKind) -> usize {
        match kind {
            DeviceKind::Cpu => self.cpu,
            DeviceKind::Gpu => self.gpu,
        }
    }

    /// Those of any kind.
    pub fn total(self) -> usize {
        self.cpu + self.gpu
    }
}

/// The learned factors from nominal to real seconds in a lane, one for each kind of device.
#[derive(Debug)]
pub struct CostModel {
    lanes: Lanes,
    log_factors: Mutex<[Option<f64>; DeviceKind::ALL.len()]>,
}

impl CostModel {
    /// A model that has measured nothing yet on its lanes.
    pub fn new(lanes: Lanes) -> Self {
        Self {
            lanes,
            log_factors: Mutex::default(),
        }
    }

    /// The lanes that it is about.
    pub fn lanes(&self) -> Lanes {
        self.lanes
    }

    /// Nominal seconds of some work.
    pub fn nominal(price: &Cost) -> f64 {
        EACH + price.seconds(NOMINAL_RATE)
    }

    /// Nominal seconds of asking a field about a point, so many times.
    pub fn asking(points: f64) -> f64 {
        points * PARAMETERS as f64 / NOMINAL_RATE
    }

    /// The seconds that work of `nominal` seconds takes in a lane of that kind, by what was
    /// measured so far.
    pub fn seconds_on(&self, kind: DeviceKind, nominal: f64) -> f64 {
        let log_factors = self
            .log_factors
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        nominal * log_factors[kind as usize].map_or(1.0, f64::exp)
    }

    /// Nominal seconds that all lanes of one kind get through in a second.
    pub fn rate(&self, kind: DeviceKind) -> f64 {
        self.lanes.of(kind) as f64 / self.seconds_on(kind, 1.0)
    }

    /// Nominal seconds that all lanes get through in a second.
    pub fn total_rate(&self) -> f64 {
        DeviceKind::ALL
            .into_iter()
            .map(|kind| self.rate(kind))
            .sum()
    }

    /// The seconds that work of `nominal` seconds keeps one lane busy, whichever takes it.
    pub fn seconds(&self, nominal: f64) -> f64 {
        nominal * self.lanes.total().max(1) as f64 / self.total_rate().max(f64::MIN_POSITIVE)
    }

    /// Learns that work of `nominal` seconds took `measured` in a lane of that kind.
    pub fn learn(&self, kind: DeviceKind, nominal: f64, measured: f64) {
        let ratio = (measured / nominal).clamp(RANGE.0, RANGE.1);
        if !ratio.is_finite() || nominal < LEAST {
            return;
        }
        let mut log_factors = self
            .log_factors
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let fresh = ratio.ln();
        let log_factor = &mut log_factors[kind as usize];
        let weight = FRESH * (nominal / WHOLE).min(1.0);
        *log_factor = Some(log_factor.map_or(fresh, |old| old + weight * (fresh - old)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factor_follows_what_is_measured_and_survives_nonsense() {
        let model = CostModel::new(Lanes { cpu: 1, gpu: 0 });
        let learn = |nominal, measured| model.learn(DeviceKind::Cpu, nominal, measured);
        assert_eq!(model.seconds(2.0), 2.0);
        learn(1.0, 3.0);
        assert!((model.seconds(2.0) - 6.0).abs() < 1e-9);
        for _ in 0..100 {
            learn(1.0, 0.5);
        }
        assert!((model.seconds(2.0) - 1.0).abs() < 1e-3);
        // Tiny jobs take what jobs take, whatever their work is.
        for _ in 0..1000 {
            learn(0.01, 0.2);
        }
        for (nominal, measured) in [(0.0, 0.0), (1.0, f64::NAN), (0.0, 1.0)] {
            learn(nominal, measured);
        }
        assert!((model.seconds(2.0) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn each_kind_learns_for_itself_and_the_mean_is_of_the_work_done() {
        let model = CostModel::new(Lanes { cpu: 1, gpu: 4 });
        model.learn(DeviceKind::Cpu, 1.0, 2.0);
        model.learn(DeviceKind::Gpu, 1.0, 0.1);
        assert!((model.rate(DeviceKind::Cpu) - 0.5).abs() < 1e-9);
        assert!((model.rate(DeviceKind::Gpu) - 40.0).abs() < 1e-9);
        // Five lanes get through 40.5 nominal seconds in a second.
        assert!((model.seconds(40.5) - 5.0).abs() < 1e-9);
        assert!((model.seconds_on(DeviceKind::Cpu, 1.0) - 2.0).abs() < 1e-9);
    }
}
