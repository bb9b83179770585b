//! The densification plan: which sweep pairs need a motion field so that all sweeps of a sequence
//! can be transformed into one frame.

/// How the sweeps after the reference time are transformed into its frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LaterSweeps {
    /// By motion fields that are estimated backward in time, from each sweep to the previous one.
    #[default]
    Reverse,
    /// By inverses of the forward motion fields, so that no backward fields are estimated. Where a
    /// field maps two points to one it has no inverse. Points that do not converge there count as
    /// static and are marked in [`crate::flow::DenseCloud::converged`].
    Inverse,
}

/// A pair of consecutive sweeps that needs a motion field, as indices in the sequence, from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct FlowEdge {
    /// Index of the sweep whose points the field moves.
    pub source: usize,
    /// Index of the sweep to whose time and frame the points are moved: the next or the previous
    /// sweep.
    pub target: usize,
}

/// Why a plan is impossible.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// The reference time lies outside the sequence, or is not a number.
    #[error("the reference time {reference_time} lies outside the sequence's sweeps, 0 to {last}")]
    ReferenceTimeOutOfRange {
        /// The requested reference time, in sweeps.
        reference_time: f64,
        /// Index of the last sweep.
        last: usize,
    },
    /// There are fewer than two sweeps.
    #[error("{0} sweeps are no sequence: two are needed at least")]
    TooFewSweeps(usize),
    /// The number of substeps is not between 1 and 64.
    #[error("{0} substeps: 1 to 64 are possible")]
    Substeps(usize),
}

/// Maximum number of substeps.
const MOST_SUBSTEPS: usize = 64;

/// The plan of a densification: the number of sweeps, the reference time, the treatment of later
/// sweeps and the number of Euler steps. It determines which motion fields are needed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    pub(super) sweeps: usize,
    /// Index of the last sweep at or before the reference time.
    pub(super) anchor: usize,
    /// Reference time minus the anchor, in sweeps: at least 0 and below 1.
    pub(super) fraction: f64,
    pub(super) later: LaterSweeps,
    pub(super) substeps: usize,
}

impl Plan {
    /// Plans to transform all of `sweeps` sweeps into the frame of `reference_time`. The reference
    /// time is counted in sweeps from 0, and may lie between two sweeps: 4.5 is half way from sweep
    /// 4 to sweep 5. `later` selects how the sweeps after it are transformed.
    ///
    /// Each step from one sweep to the next or the previous one takes `substeps` Euler steps of
    /// equal length, or one where the motion is known at the source's points alone. The last,
    /// partial step to a reference time between two sweeps is a single Euler step. Inverses of fields ([`LaterSweeps::Inverse`]) do not use `substeps`.
    ///
    /// # Errors
    /// - [`PlanError::TooFewSweeps`] if there are fewer than two sweeps.
    /// - [`PlanError::ReferenceTimeOutOfRange`] if `reference_time` is not from 0 to `sweeps - 1`.
    /// - [`PlanError::Substeps`] if `substeps` is not 1 to 64.
    pub fn new(
        sweeps: usize,
        reference_time: f64,
        later: LaterSweeps,
        substeps: usize,
    ) -> Result<Self, PlanError> {
        if sweeps < 2 {
            return Err(PlanError::TooFewSweeps(sweeps));
        }
        let last = sweeps - 1;
        if !(0.0..=last as f64).contains(&reference_time) {
            return Err(PlanError::ReferenceTimeOutOfRange {
                reference_time,
                last,
            });
        }
        if !(1..=MOST_SUBSTEPS).contains(&substeps) {
            return Err(PlanError::Substeps(substeps));
        }
        let anchor = reference_time as usize;
        Ok(Self {
            sweeps,
            anchor,
            fraction: reference_time - anchor as f64,
            later,
            substeps,
        })
    }

    /// The reference time, in sweeps from 0.
    pub fn reference_time(&self) -> f64 {
        self.anchor as f64 + self.fraction
    }

    /// The pairs whose motion fields [`super::densify`] needs: both chains of [`Self::chains`], one
    /// after the other.
    pub fn edges(&self) -> Vec<FlowEdge> {
        self.chains().concat()
    }

    /// The pairs whose motion fields [`super::densify`] needs, as two chains: forward in time from
    /// sweep 0, and backward in time from the last sweep. In a chain, the target of each pair is
    /// the source of the next one. A chain may be empty.
    pub fn chains(&self) -> [Vec<FlowEdge>; 2] {
        let last = self.sweeps - 1;
        // Index of the last sweep that earlier sweeps are advected to.
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

    fn edges(sweeps: usize, reference_time: f64, later: LaterSweeps) -> Vec<(usize, usize)> {
        let plan = Plan::new(sweeps, reference_time, later, 1).expect("a plan");
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
        for reference_time in [-0.5, 4.1, f64::NAN, f64::INFINITY] {
            let refused = Plan::new(5, reference_time, LaterSweeps::Reverse, 1);
            assert!(matches!(
                refused,
                Err(PlanError::ReferenceTimeOutOfRange { last: 4, .. })
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
