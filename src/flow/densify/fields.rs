//! The motion fields that a plan needs, estimated as sequences.

use std::collections::{BTreeMap, VecDeque};

use super::plan::{FlowEdge, Plan};
use crate::flow::estimate::Estimate;
use crate::flow::motion::MotionField;
use crate::flow::sequence::Sequence;

/// What [`estimate_fields`] asks for next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FieldStep {
    /// Push sweep `index`. It is the target of the pair whose source is sweep `before`. The first
    /// sweep of a chain is its own source.
    Push {
        /// Index of the sweep that was pushed last.
        before: usize,
        /// Index of the sweep to push.
        index: usize,
        /// Number of fields that are estimated.
        done: usize,
    },
    /// Finish the sequence.
    Finish,
}

/// Estimates the motion fields of all [`Plan::edges`], chain by chain. `step` does what it is asked
/// with the [`Sequence`] of the chain, and returns the complete estimates.
///
/// # Errors
/// Those of `step`.
pub fn estimate_fields<E>(
    plan: &Plan,
    mut step: impl FnMut(&mut Sequence, FieldStep) -> Result<Vec<Estimate>, E>,
) -> Result<BTreeMap<FlowEdge, MotionField>, E> {
    let mut fields: BTreeMap<FlowEdge, MotionField> = BTreeMap::new();
    for chain in plan.chains() {
        let (mut sequence, mut waiting) = (Sequence::default(), VecDeque::from(chain));
        let mut last = None;
        for index in way(&waiting, plan.sweeps) {
            let before = last.replace(index).unwrap_or(index);
            let done = fields.len();
            let push = FieldStep::Push {
                before,
                index,
                done,
            };
            fields.extend(fields_of_edges(step(&mut sequence, push)?, &mut waiting));
            if waiting.is_empty() {
                break;
            }
        }
        while !waiting.is_empty() {
            let rest = step(&mut sequence, FieldStep::Finish)?;
            fields.extend(fields_of_edges(rest, &mut waiting));
        }
    }
    Ok(fields)
}

/// The sweeps to push so that the edges of a chain are estimated, in order, out of a sequence of
/// `sweeps`. They go on past the chain's end to the end of the sequence, because the windows of the
/// chain's last pairs may contain them.
fn way(chain: &VecDeque<FlowEdge>, sweeps: usize) -> Vec<usize> {
    match chain.front() {
        None => Vec::new(),
        Some(edge) if edge.source < edge.target => (edge.source..sweeps).collect(),
        Some(edge) => (0..=edge.source).rev().collect(),
    }
}

/// Pairs the estimates with the edges at the front of the queue, and removes these edges.
fn fields_of_edges(
    estimates: Vec<Estimate>,
    waiting: &mut VecDeque<FlowEdge>,
) -> Vec<(FlowEdge, MotionField)> {
    let edges = waiting.drain(..estimates.len().min(waiting.len()));
    edges
        .zip(estimates)
        .map(|(edge, estimate)| (edge, estimate.motion))
        .collect()
}
