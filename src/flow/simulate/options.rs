//! Options of a simulated street and their validation.
//!
//! Sizes are checked before any memory is allocated.

/// Time between consecutive sweeps of a simulated street, seconds.
pub const SWEEP_SECONDS: f64 = 0.1;

/// Maximum number of rays per sweep.
const MAX_RAYS: usize = 1 << 20;
/// Minimum curve radius of the street at the ego vehicle, metres. A tighter curve would run into
/// the houses.
const MIN_RADIUS_M: f64 = 40.0;

/// Options of a simulated street. `beams` times `azimuth_steps`, the rays of a sweep, must not
/// exceed 1,048,576.
#[derive(Debug, Clone, PartialEq)]
pub struct StreetOptions {
    /// Seed of all random choices. The same seed gives the same street.
    pub seed: u64,
    /// Number of sweeps, 1 to 1,000.
    pub sweeps: usize,
    /// Number of lasers, 1 to 256, between 2 degrees up and 24.8 degrees down, denser in the upper
    /// half. A single laser points 2 degrees up.
    pub beams: usize,
    /// Number of azimuth steps per turn, 16 to 8,192.
    pub azimuth_steps: usize,
    /// Number of moving cars, cyclists and pedestrians, 0 to 256.
    pub movers: usize,
    /// Forward speed of the ego vehicle, 0 to 40 m/s. If none, it is drawn from the seed, 5 to 11
    /// m/s.
    pub speed_mps: Option<f64>,
    /// Yaw rate of the ego vehicle at the first sweep, -1 to 1 rad/s, positive to the left. The
    /// curve radius, speed over yaw rate, must be at least 40 m, so a standing vehicle has a yaw
    /// rate of zero. If none, it is drawn from the seed, with a radius of at least 250 m. The
    /// street winds, so the rate changes after the first sweep.
    pub yaw_rate_rps: Option<f64>,
    /// Standard deviation of the range noise of each return, 0 to 1 m.
    pub range_noise_m: f64,
    /// Standard deviation of the constant range error of each laser, 0 to 1 m.
    pub beam_bias_m: f64,
    /// Factor on the probability that a return is lost, 0 (no loss) to 1. Far and grazing returns
    /// are lost more often.
    pub dropout: f64,
    /// Whether the columns of a sweep are measured one after the other over the sweep interval, as
    /// a spinning lidar does. Otherwise a sweep is taken at one instant.
    pub rolling: bool,
    /// Whether the body of the ego vehicle pitches, rolls and heaves on its springs. Otherwise it
    /// follows its four wheels on the road.
    pub suspension: bool,
}

impl Default for StreetOptions {
    fn default() -> Self {
        Self {
            seed: 0,
            sweeps: 2,
            beams: 64,
            azimuth_steps: 2000,
            movers: 24,
            speed_mps: None,
            yaw_rate_rps: None,
            range_noise_m: 0.02,
            beam_bias_m: 0.01,
            dropout: 1.0,
            rolling: false,
            suspension: false,
        }
    }
}

/// Why the options of a street, or the index of a sweep, were rejected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum StreetError {
    /// An option is out of range or not a number. The range of the yaw rate depends on the speed.
    #[error("{name} must lie between {low} and {high}, not {value}")]
    OutOfRange {
        /// Name of the option.
        name: &'static str,
        /// Its value.
        value: f64,
        /// Minimum value.
        low: f64,
        /// Maximum value.
        high: f64,
    },
    /// Lasers times azimuth steps exceed the limit of a sweep.
    #[error("a sweep of {rays} rays is over the limit of {limit}")]
    TooManyRays {
        /// Requested rays per sweep.
        rays: usize,
        /// Maximum rays per sweep.
        limit: usize,
    },
    /// The street has no sweep with this index.
    #[error("sweep {index} of a street of {sweeps} sweeps")]
    NoSuchSweep {
        /// The requested index, from 0.
        index: usize,
        /// Number of sweeps of the street.
        sweeps: usize,
    },
}

impl StreetOptions {
    /// Rejects values that are not a number, out of range or too large.
    pub(super) fn validate(&self) -> Result<(), StreetError> {
        check("sweeps", self.sweeps as f64, [1.0, 1000.0])?;
        check("beams", self.beams as f64, [1.0, 256.0])?;
        check("azimuth_steps", self.azimuth_steps as f64, [16.0, 8192.0])?;
        check("movers", self.movers as f64, [0.0, 256.0])?;
        check("range_noise_m", self.range_noise_m, [0.0, 1.0])?;
        check("beam_bias_m", self.beam_bias_m, [0.0, 1.0])?;
        check("dropout", self.dropout, [0.0, 1.0])?;
        if let Some(speed) = self.speed_mps {
            check("speed_mps", speed, [0.0, 40.0])?;
        }
        if let Some(yaw_rate) = self.yaw_rate_rps {
            check("yaw_rate_rps", yaw_rate, [-1.0, 1.0])?;
        }
        let rays = self.beams * self.azimuth_steps;
        if rays > MAX_RAYS {
            return Err(StreetError::TooManyRays {
                rays,
                limit: MAX_RAYS,
            });
        }
        Ok(())
    }

    /// Curvature of the street at the first sweep, 1/m, for a yaw rate in rad/s and a speed in m/s.
    pub(super) fn curvature(yaw_rate: f64, speed: f64) -> Result<f64, StreetError> {
        let limit = speed / MIN_RADIUS_M;
        check("yaw_rate_rps", yaw_rate, [-limit, limit])?;
        Ok(if speed > 0.0 { yaw_rate / speed } else { 0.0 })
    }
}

fn check(name: &'static str, value: f64, [low, high]: [f64; 2]) -> Result<(), StreetError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(StreetError::OutOfRange {
        name,
        value,
        low,
        high,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(change: impl Fn(&mut StreetOptions)) -> String {
        let mut options = StreetOptions::default();
        change(&mut options);
        options.validate().unwrap_err().to_string()
    }

    #[test]
    fn values_that_are_zero_huge_or_not_a_number_are_refused() {
        assert_eq!(StreetOptions::default().validate(), Ok(()));
        assert!(refused(|o| o.sweeps = 0).starts_with("sweeps must"));
        assert!(refused(|o| o.sweeps = usize::MAX).starts_with("sweeps must"));
        assert!(refused(|o| o.beams = 0).starts_with("beams must"));
        assert!(refused(|o| o.beams = usize::MAX).starts_with("beams must"));
        assert!(refused(|o| o.azimuth_steps = 3).starts_with("azimuth_steps must"));
        assert!(refused(|o| o.movers = 1 << 40).starts_with("movers must"));
        assert!(refused(|o| o.range_noise_m = f64::NAN).contains("not NaN"));
        assert!(refused(|o| o.beam_bias_m = -0.1).starts_with("beam_bias_m must"));
        assert!(refused(|o| o.dropout = f64::INFINITY).starts_with("dropout must"));
        assert!(refused(|o| o.speed_mps = Some(f64::NAN)).starts_with("speed_mps must"));
        assert!(refused(|o| o.yaw_rate_rps = Some(9.0)).starts_with("yaw_rate_rps must"));
    }

    #[test]
    fn beams_and_steps_are_bounded_together() {
        let error = refused(|o| (o.beams, o.azimuth_steps) = (256, 8192));
        assert!(error.contains("2097152 rays"), "{error}");
    }

    #[test]
    fn a_turn_tighter_than_the_street_is_refused() {
        assert_eq!(StreetOptions::curvature(0.1, 10.0), Ok(0.01));
        assert_eq!(StreetOptions::curvature(0.0, 0.0), Ok(0.0));
        assert!(StreetOptions::curvature(0.5, 10.0).is_err());
        assert!(StreetOptions::curvature(0.1, 0.0).is_err());
    }
}
