//! The options of a sequence: whether its pairs depend on each other, and the number of sweeps that
//! a pair uses.

use super::choices::EgoChoice;
use super::error::InvalidOptions;
use super::options::JobOptions;

impl JobOptions {
    /// Rejects `densify`, which only a sequence that is submitted as a job can have.
    ///
    /// # Errors
    /// [`InvalidOptions::NoSequence`] if `densify` is given.
    pub fn check_for_pairs(&self) -> Result<(), InvalidOptions> {
        match self.densify {
            None => Ok(()),
            Some(_) => Err(InvalidOptions::NoSequence),
        }
    }

    /// Rejects a given ego motion for a sequence of `sweeps` sweeps with more than one pair.
    ///
    /// # Errors
    /// [`InvalidOptions::OneMotion`] if the ego motion is a given matrix and there are more than
    /// two sweeps.
    pub fn check_for_sequence(&self, sweeps: usize) -> Result<(), InvalidOptions> {
        match self.ego {
            Some(EgoChoice::Given(_)) if sweeps > 2 => Err(InvalidOptions::OneMotion),
            _ => Ok(()),
        }
    }

    /// Rejects another ego motion beside the poses of the sweeps, which give it.
    ///
    /// # Errors
    /// [`InvalidOptions::PosesAndEgo`] if the ego motion is off or a given matrix.
    pub fn check_for_poses(&self) -> Result<(), InvalidOptions> {
        match self.ego {
            Some(EgoChoice::Off | EgoChoice::Given(_)) => Err(InvalidOptions::PosesAndEgo),
            Some(EgoChoice::Auto) | None => Ok(()),
        }
    }

    /// Number of sweeps in the window of a pair, its own two included. A sequence with fewer sweeps
    /// has smaller windows. Near the ends of a sequence the window is shifted, not shortened; see
    /// [`crate::flow::window`].
    pub fn sweeps(&self) -> usize {
        self.solver_options(usize::MAX).sweeps()
    }

    /// Whether each pair of a sequence warm-starts from the previous one, and so has to wait for
    /// it.
    pub fn chained(&self) -> bool {
        self.solver_options(usize::MAX)
            .field()
            .is_some_and(|field| field.warm_start.is_some())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_of_a_sequence_go_on_from_each_other_where_their_result_depends_on_it() {
        for (text, chained) in [
            ("{}", false),
            (r#"{"preset":"neural"}"#, true),
            (r#"{"preset":"paper"}"#, false),
            (r#"{"preset":"paper","ego":"auto"}"#, false),
            (r#"{"preset":"label"}"#, false),
            (r#"{"preset":"nsfp-kdtree"}"#, false),
        ] {
            let options = JobOptions::from_json(text.as_bytes()).expect("good options");
            assert_eq!(options.chained(), chained, "{text}");
        }
    }
}
