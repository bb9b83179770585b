//! A flow with what is known about its rows, out and back in.

use crate::flow::{Cluster, Estimate, Objects, Point, RigidTransform};

/// Property names of a displacement in PLY and PCD.
pub(super) const FLOW_AXES: [&str; 3] = ["flow_x", "flow_y", "flow_z"];

/// A flow to be written: N rows, in the source's order.
#[derive(Clone, Copy, Debug)]
pub struct FlowTable<'a> {
    /// N source points, metres. Rows without return may be NaN. PLY and PCD contain the source
    /// points, such rows included; the other formats do not.
    pub source: &'a [Point],
    /// N displacements from the source sweep's time to the target's, metres, ego motion included.
    /// Finite in every row.
    pub flow: &'a [Point],
    /// N flags: whether the row has a flow. The displacement of a row without one is zero.
    pub valid: &'a [bool],
    /// N flags: whether the point moves relative to the static world, where known.
    pub dynamic: Option<&'a [bool]>,
    /// The clusters of the N points, the confidence of their flow and the probability that they move,
    /// where known.
    pub objects: Option<&'a Objects>,
    /// The ego motion `target_from_source`, where known.
    pub ego: Option<&'a RigidTransform>,
}

impl<'a> FlowTable<'a> {
    /// The flow of an estimate. `source` are the N points that it starts from, see
    /// [`Estimate::sweeps`].
    pub fn new(source: &'a [Point], estimate: &'a Estimate) -> Self {
        Self {
            source,
            flow: &estimate.flow,
            valid: &estimate.valid,
            dynamic: estimate.dynamic.as_deref(),
            objects: estimate.objects(),
            ego: estimate.ego.as_ref(),
        }
    }
}

/// A flow of N rows as read from a file, with the optional columns that the file has.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FlowFile {
    /// N displacements from the source sweep's time to the target's, metres.
    pub flow: Vec<Point>,
    /// N flags: whether the row has a flow.
    pub valid: Option<Vec<bool>>,
    /// N flags: whether the point moves relative to the static world.
    pub dynamic: Option<Vec<bool>>,
    /// N indices into `clusters`; negative where a point is in none.
    pub cluster: Option<Vec<i32>>,
    /// N probabilities, 0 to 1, that the row's flow is less than 0.05 m off.
    pub confidence: Option<Vec<f32>>,
    /// N probabilities, 0 to 1, that the row's point moves by 0.05 m or more, ego motion taken out.
    pub moving: Option<Vec<f32>>,
    /// The K clusters; only npz and JSON contain them.
    pub clusters: Option<Vec<Cluster>>,
    /// The ego motion `target_from_source`, metres; only npz and JSON contain it.
    pub ego: Option<RigidTransform>,
}
