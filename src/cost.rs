//! Cost model of jobs: nominal seconds predicted from the amount of work, and learned factors to
//! real seconds.
//!
//! Nominal seconds are stored with a job and never change. One learned factor per kind of device
//! converts them to real seconds on this machine. Independent of jobs.

use std::sync::Mutex;

use crate::flow::Cost;
use crate::flow::field::PARAMETERS;
use crate::job::DeviceKind;
use crate::sync::locked;

/// Multiply-adds per nominal second: about two cores with wide vector units.
const NOMINAL_RATE: f64 = 2e11;

/// Nominal seconds of overhead per job: it is written, leased, read and committed.
const EACH: f64 = 0.005;

/// Weight of a measurement of a job of at least [`WHOLE`] nominal seconds. Smaller jobs weigh
/// proportionally less, because their overhead dominates.
const FRESH: f64 = 0.1;
/// Nominal seconds from which a measurement has its full weight.
const WHOLE: f64 = 0.1;

/// Measurements of jobs below this many nominal seconds are ignored.
const LEAST: f64 = 0.02;

/// Range of the measured ratio of real to nominal seconds. Ratios outside it are clamped.
const RANGE: (f64, f64) = (1e-3, 1e3);

/// Number of lanes, by kind of device. Each lane computes one pair at a time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lanes {
    /// Lanes on CPUs.
    pub cpu: usize,
    /// Lanes on GPUs.
    pub gpu: usize,
}

impl Lanes {
    /// Lanes on devices of one kind.
    pub fn of(self, kind: DeviceKind) -> usize {
        match kind {
            DeviceKind::Cpu => self.cpu,
            DeviceKind::Gpu => self.gpu,
        }
    }

    /// Lanes on all devices.
    pub fn total(self) -> usize {
        self.cpu + self.gpu
    }
}

/// Lanes and rate of the devices of one kind on other nodes. The rate is nominal seconds of work
/// per second.
pub type Others = [(usize, f64); DeviceKind::ALL.len()];

/// The learned factors from nominal to real seconds in a lane, one per kind of device, and the lanes
/// of this process and of the other nodes.
#[derive(Debug)]
pub struct CostModel {
    own: Lanes,
    log_factors: Mutex<[Option<f64>; DeviceKind::ALL.len()]>,
    others: Mutex<Others>,
}

impl CostModel {
    /// A model without measurements. Its factors are 1.
    pub fn new(lanes: Lanes) -> Self {
        Self {
            own: lanes,
            log_factors: Mutex::default(),
            others: Mutex::default(),
        }
    }

    /// The lanes of all nodes.
    pub fn lanes(&self) -> Lanes {
        let [(cpu, _), (gpu, _)] = *locked(&self.others);
        Lanes {
            cpu: self.own.cpu + cpu,
            gpu: self.own.gpu + gpu,
        }
    }

    /// The lanes of this process.
    pub fn own_lanes(&self) -> Lanes {
        self.own
    }

    /// Takes over what the other nodes can do.
    pub fn set_others(&self, others: Others) {
        *locked(&self.others) = others;
    }

    /// Nominal seconds of a job of this cost: its multiply-adds divided by 2e11, plus 0.005 of
    /// overhead.
    pub fn nominal(cost: &Cost) -> f64 {
        EACH + cost.seconds(NOMINAL_RATE)
    }

    /// Nominal seconds to evaluate a field at `points` points, without overhead: one multiply-add
    /// per point and network parameter.
    pub fn asking(points: f64) -> f64 {
        points * PARAMETERS as f64 / NOMINAL_RATE
    }

    /// Predicted real seconds of `nominal` seconds of work in a lane of this kind: of this process
    /// or, if it has none, of the mean of the other nodes.
    pub fn seconds_on(&self, kind: DeviceKind, nominal: f64) -> f64 {
        let (lanes, rate) = locked(&self.others)[kind as usize];
        if self.own.of(kind) == 0 && rate > 0.0 {
            return nominal * lanes as f64 / rate;
        }
        let log_factors = locked(&self.log_factors);
        nominal * log_factors[kind as usize].map_or(1.0, f64::exp)
    }

    /// Nominal seconds of work that the lanes of one kind of this process complete per second. Zero
    /// without such lanes.
    pub fn own_rate(&self, kind: DeviceKind) -> f64 {
        match self.own.of(kind) {
            0 => 0.0,
            lanes => lanes as f64 / self.seconds_on(kind, 1.0),
        }
    }

    /// Nominal seconds of work that the lanes of one kind of all nodes complete per second. Zero
    /// without such lanes.
    pub fn rate(&self, kind: DeviceKind) -> f64 {
        let (_, rate) = locked(&self.others)[kind as usize];
        self.own_rate(kind) + rate
    }

    /// Nominal seconds of work that all lanes complete per second. Zero without lanes.
    pub fn total_rate(&self) -> f64 {
        DeviceKind::ALL
            .into_iter()
            .map(|kind| self.rate(kind))
            .sum()
    }

    /// Predicted real seconds that `nominal` seconds of work occupy one lane, averaged over all
    /// lanes. Without lanes the factor is 1: nodes that have some may join.
    pub fn seconds(&self, nominal: f64) -> f64 {
        match self.lanes().total() {
            0 => nominal,
            lanes => nominal * lanes as f64 / self.total_rate().max(f64::MIN_POSITIVE),
        }
    }

    /// Updates the factor of this kind: `nominal` seconds of work took `measured` seconds in a
    /// lane.
    ///
    /// The ratio `r = measured / nominal` is clamped to 1e-3 to 1e3. The first ratio becomes the
    /// factor `f`. Each later one changes it by `ln f += w (ln r - ln f)`. The weight `w` is 0.1
    /// for 0.1 nominal seconds or more. Below that, it is proportional to `nominal`.
    ///
    /// A measurement of less than 0.02 nominal seconds is ignored. So is one whose ratio is not a
    /// number.
    pub fn learn(&self, kind: DeviceKind, nominal: f64, measured: f64) {
        let ratio = (measured / nominal).clamp(RANGE.0, RANGE.1);
        if !ratio.is_finite() || nominal < LEAST {
            return;
        }
        let mut log_factors = locked(&self.log_factors);
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
        // Jobs below the limit are ignored at any ratio.
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
        // The five lanes complete 40.5 nominal seconds per second.
        assert!((model.seconds(40.5) - 5.0).abs() < 1e-9);
        assert!((model.seconds_on(DeviceKind::Cpu, 1.0) - 2.0).abs() < 1e-9);
    }

    #[test]
    fn a_node_without_devices_predicts_by_those_of_the_others() {
        let model = CostModel::new(Lanes::default());
        assert_eq!((model.total_rate(), model.seconds(2.0)), (0.0, 2.0));
        model.set_others([(4, 8.0), (0, 0.0)]);
        assert_eq!(model.lanes(), Lanes { cpu: 4, gpu: 0 });
        assert!((model.seconds(6.0) - 3.0).abs() < 1e-9);
        assert!((model.seconds_on(DeviceKind::Cpu, 6.0) - 3.0).abs() < 1e-9);
        assert_eq!(model.own_rate(DeviceKind::Cpu), 0.0);
    }
}
