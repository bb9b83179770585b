//! Which pairs of a sequence have to be fitted so that all of its sweeps can be carried into one
//! frame. Fits nothing.

/// How sweeps after the frame are carried into it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LaterSweeps {
    /// Through fields that are fitted backward in time, from each sweep to the one before.
    #[default]
    Reverse,
    /// Through the inverses of the fields that are fitted forward: half of the fits, but where a
    /// field folds space it has no inverse, and points do not settle.
    Inverse,
}

/// A pair to be fitted: places of its sweeps in the sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct FlowEdge {
    /// The sweep whose points the field moves.
    pub source: usize,
    /// The sweep whose time they are moved to: the one after, or before.
    pub target: usize,
}

/// Why a sequence cannot be carried into a frame.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// The frame is not one of the sequence's, nor between two.
    #[error("into {into} lies outside the sequence's sweeps, 0 to {last}")]
    NoSuchFrame {
        /// What was asked for.
        into: f64,
        /// The last sweep.
        last: usize,
    },
    /// One sweep is no sequence.
    #[error("{0} sweeps are no sequence: two are needed at least")]
    TooFewSweeps(usize),
    /// A step that is cut into nothing, or into too many.
    #[error("{0} substeps: 1 to 64 are possible")]
    Substeps(usize),
}

/// Substeps at most.
const MOST_SUBSTEPS: usize = 64;

/// How a sequence's sweeps become one cloud.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    pub(super) sweeps: usize,
    /// The last sweep at or before the instant.
    pub(super) anchor: usize,
    /// How far the instant lies behind it, 0 to 1, in sweeps.
    pub(super) fraction: f64,
    pub(super) later: LaterSweeps,
    pub(super) substeps: usize,
}

impl Plan {
    /// All of `sweeps` sweeps into the instant `into`, counted in sweeps from 0: a sweep's own, or
    /// one between two. Each step from sweep to sweep is cut into `substeps`.
    ///
    /// # Errors
    /// [`PlanError`] where there is no such instant.
    pub fn new(
        sweeps: usize,
        into: f64,
        later: LaterSweeps,
        substeps: usize,
    ) -> Result<Self, PlanError> {
        if sweeps < 2 {
            return Err(PlanError::TooFewSweeps(sweeps));
        }
        let last = sweeps - 1;
        if !(0.0..=last as f64).contains(&into) {
            return Err(PlanError::NoSuchFrame { into, last });
        }
        if !(1..=MOST_SUBSTEPS).contains(&substeps) {
            return Err(PlanError::Substeps(substeps));
        }
        let anchor = into as usize;
        Ok(Self {
            sweeps,
            anchor,
            fraction: into - anchor as f64,
            later,
            substeps,
        })
    }

    /// The instant, in sweeps.
    pub fn into(&self) -> f64 {
        self.anchor as f64 + self.fraction
    }

    /// All fits that are needed.
    pub fn edges(&self) -> Vec<FlowEdge> {
        self.chains().concat()
    }

    /// The fits that are needed, as two sequences: forward in time, and backward from the end.
    pub fn chains(&self) -> [Vec<FlowEdge>; 2] {
        let last = self.sweeps - 1;
        // The sweep that those of before are carried to, and the one from which those of after are.
        let before = if self.fraction > 0.0 {
            self.anchor + 1
        } else {
            self.anchor
        };
        let forward = match self.later {
            LaterSweeps::Reverse => before,
            LaterSweeps::Inverse => last,
        };
        let ahead = (0..forward).map(|source| FlowEdge {
            source,
            target: source + 1,
        });
        let back = match self.later {
            LaterSweeps::Reverse => self.anchor..last,
            LaterSweeps::Inverse => 0..0,
        };
        let back = back.rev().map(|target| FlowEdge {
            source: target + 1,
            target,
        });
        [ahead.collect(), back.collect()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn edges(sweeps: usize, into: f64, later: LaterSweeps) -> Vec<(usize, usize)> {
        let plan = Plan::new(sweeps, into, later, 1).expect("a plan");
        let edges = plan.edges();
        edges
            .iter()
            .map(|edge| (edge.source, edge.target))
            .collect()
    }

    #[test]
    fn sweeps_before_go_forward_and_sweeps_after_go_back() {
        assert_eq!(
            edges(5, 2.0, LaterSweeps::Reverse),
            [(0, 1), (1, 2), (4, 3), (3, 2)]
        );
        assert_eq!(
            edges(4, 1.5, LaterSweeps::Reverse),
            [(0, 1), (1, 2), (3, 2), (2, 1)]
        );
        assert_eq!(
            edges(4, 1.0, LaterSweeps::Inverse),
            [(0, 1), (1, 2), (2, 3)]
        );
        assert_eq!(edges(3, 2.0, LaterSweeps::Reverse), [(0, 1), (1, 2)]);
        assert_eq!(edges(3, 0.0, LaterSweeps::Reverse), [(2, 1), (1, 0)]);
    }

    #[test]
    fn instants_outside_the_sequence_are_refused() {
        for into in [-0.5, 4.1, f64::NAN, f64::INFINITY] {
            let refused = Plan::new(5, into, LaterSweeps::Reverse, 1);
            assert!(matches!(
                refused,
                Err(PlanError::NoSuchFrame { last: 4, .. })
            ));
        }
        assert_eq!(
            Plan::new(1, 0.0, LaterSweeps::Reverse, 1),
            Err(PlanError::TooFewSweeps(1))
        );
        assert_eq!(
            Plan::new(2, 0.0, LaterSweeps::Reverse, 0),
            Err(PlanError::Substeps(0))
        );
    }
}
