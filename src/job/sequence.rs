//! What options mean to a sequence: whether its pairs go on from each other, and the dense cloud that
//! may be asked for. It must not know how one is made.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::options::{EgoChoice, InvalidOptions, JobOptions};
use crate::flow::densify::{LaterSweeps, Plan, PlanError};

/// All sweeps of a sequence, carried into one frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Densify {
    /// The frame, counted in sweeps from 0; or an instant between two of them.
    pub into: f64,
    /// Parts that each step from sweep to sweep is cut into, 1 to 64.
    #[serde(default = "one")]
    pub substeps: u32,
    /// How sweeps after the frame are carried back.
    #[serde(default)]
    pub later: LaterChoice,
}

/// How sweeps after the frame are carried into it.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum LaterChoice {
    /// Through fields that are fitted backward in time.
    #[default]
    Reverse,
    /// Through the inverses of the fields that are fitted forward: half of the work.
    Inverse,
}

fn one() -> u32 {
    1
}

impl Densify {
    /// How `frames` frames become one cloud.
    ///
    /// # Errors
    /// [`PlanError`] where they cannot.
    pub fn plan(&self, frames: usize) -> Result<Plan, PlanError> {
        let later = match self.later {
            LaterChoice::Reverse => LaterSweeps::Reverse,
            LaterChoice::Inverse => LaterSweeps::Inverse,
        };
        Plan::new(frames, self.into, later, self.substeps as usize)
    }

    /// Refuses what no sequence could be carried into.
    pub(super) fn check(&self) -> Result<(), InvalidOptions> {
        if !(self.into.is_finite() && self.into >= 0.0) {
            return Err(InvalidOptions::Into(self.into));
        }
        // Long enough for the frame, so that only the rest can be wrong.
        let frames = (self.into.ceil() as usize).saturating_add(2);
        self.plan(frames).map(drop).map_err(InvalidOptions::Densify)
    }
}

impl JobOptions {
    /// Refuses what only a sequence can have.
    ///
    /// # Errors
    /// [`InvalidOptions::NoSequence`].
    pub fn check_for_pairs(&self) -> Result<(), InvalidOptions> {
        match self.densify {
            None => Ok(()),
            Some(_) => Err(InvalidOptions::NoSequence),
        }
    }

    /// Refuses what a sequence of `frames` frames cannot have: one motion for several pairs.
    ///
    /// # Errors
    /// [`InvalidOptions::OneMotion`].
    pub fn check_for_sequence(&self, frames: usize) -> Result<(), InvalidOptions> {
        match self.ego {
            Some(EgoChoice::Given(_)) if frames > 2 => Err(InvalidOptions::OneMotion),
            _ => Ok(()),
        }
    }

    /// Sweeps of a sequence that a pair is found from, where there are as many.
    pub fn frames(&self) -> usize {
        self.solver_options(usize::MAX).frames()
    }

    /// Whether the pairs of a sequence go on from each other: each needs the one before then.
    pub fn goes_on(&self) -> bool {
        self.solver_options(usize::MAX).warm_start.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_of_a_sequence_go_on_from_each_other_where_their_result_depends_on_it() {
        for (text, goes_on) in [
            ("{}", false),
            (r#"{"preset":"neural"}"#, true),
            (r#"{"preset":"paper"}"#, false),
            (r#"{"preset":"paper","ego":"auto"}"#, false),
            (r#"{"preset":"label"}"#, false),
        ] {
            let options = JobOptions::from_json(text.as_bytes()).expect("good options");
            assert_eq!(options.goes_on(), goes_on, "{text}");
        }
    }
}
