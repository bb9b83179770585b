//! The options of a dense cloud.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::error::InvalidOptions;
use crate::flow::densify::{LaterSweeps, Plan, PlanError};

/// Options of the dense cloud of a sequence: the points of all sweeps, moved to one reference time
/// by the estimated motion. The points are in the sensor frame of that time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Densify {
    /// The reference time, in sweeps from 0 to the index of the last sweep. It may lie between two
    /// sweeps: 4.5 is half way from sweep 4 to sweep 5.
    pub reference_time: f64,
    /// Euler integration steps per sweep interval, 1 to 64. 1 if not given.
    #[serde(default = "one")]
    pub substeps: u32,
    /// How sweeps after the reference time are moved back to it.
    #[serde(default)]
    pub later_sweeps: LaterSweepsChoice,
}

/// How sweeps after the reference time are moved back to it.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum LaterSweepsChoice {
    /// With motion estimated backward in time, from each sweep to the previous one.
    #[default]
    Reverse,
    /// With the inverse of the forward motion, which needs no additional estimates. Points for
    /// which the inversion does not converge are flagged.
    Inverse,
}

fn one() -> u32 {
    1
}

impl Densify {
    /// The densification plan for a sequence of `sweeps` sweeps.
    ///
    /// # Errors
    /// [`PlanError`] if there are fewer than two sweeps, the reference time is not from 0 to
    /// `sweeps - 1`, or the substeps are not 1 to 64.
    pub fn plan(&self, sweeps: usize) -> Result<Plan, PlanError> {
        let later = match self.later_sweeps {
            LaterSweepsChoice::Reverse => LaterSweeps::Reverse,
            LaterSweepsChoice::Inverse => LaterSweeps::Inverse,
        };
        Plan::new(sweeps, self.reference_time, later, self.substeps as usize)
    }

    /// Rejects options that are invalid for every sequence.
    pub(super) fn check(&self) -> Result<(), InvalidOptions> {
        if !(self.reference_time.is_finite() && self.reference_time >= 0.0) {
            return Err(InvalidOptions::ReferenceTime(self.reference_time));
        }
        // A sequence that contains the reference time, so that only the other options can fail.
        let sweeps = (self.reference_time.ceil() as usize).saturating_add(2);
        self.plan(sweeps).map(drop).map_err(InvalidOptions::Densify)
    }
}
