//! The result of an estimate.

use std::sync::Arc;

use nalgebra::Matrix6;

use super::deskewing::Deskew;
use crate::flow::data::{Point, RigidTransform, StopReason};
use crate::flow::motion::MotionField;
use crate::flow::objects::{Objects, SearchSeconds};

/// The motion of every source point of a pair.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// N x 3 displacements from the source sweep's time to the target's, metres, ego motion
    /// included: the position in the target's frame minus the position in the source's frame. Zero
    /// for points without a flow. The flow of a deskewed sweep starts from the deskewed points.
    pub flow: Vec<Point>,
    /// N flags: true for points with a flow.
    pub valid: Vec<bool>,
    /// N flags: true for points whose residual motion is at least [`crate::flow::DYNAMIC_M`]. False
    /// for points without a flow. None if `ego` is none.
    pub dynamic: Option<Vec<bool>>,
    /// The ego motion as target_from_source. None with [`crate::flow::Ego::Off`], and where a
    /// deadline left no time to estimate it.
    pub ego: Option<RigidTransform>,
    /// 6 x 6 covariance of the ego motion: of the position of the source's origin in the target's
    /// frame (x, y, z, metres) and of the rotation about the target's axes (x, y, z, radians). None
    /// without an ego motion, where it is given, and where a deadline left no time for it.
    pub ego_covariance: Option<Matrix6<f64>>,
    /// Whether a deadline left no time to finish the registration. The ego motion is then none or
    /// rough, and all confidences and probabilities of motion are zero.
    pub ego_is_rough: bool,
    /// Overlap of the two sweeps after the ego motion, 0 to 1: the share of the volume off the ground
    /// of the source that the target shows as well, within 0.3 m. Below
    /// [`crate::flow::LEAST_OVERLAP`] it is the larger of the shares of the two sweeps. None for
    /// small clouds, and where a deadline left no time for it.
    pub overlap: Option<f32>,
    /// The deskewing of the two sweeps. None where the times of their points are unknown, without an
    /// ego motion, while the vehicle stands, and where a deadline left no time for it.
    pub deskew: Option<Deskew>,
    /// Whether the source lies far from the origin of its frame, where the sensor should be. Ground and
    /// moving objects are then missed.
    pub is_off_origin: bool,
    /// Whether both sweeps are the same points in the same order.
    pub same_sweep: bool,
    /// Number of points that took part and have a flow. Ground points with the ego-motion flow
    /// alone are not counted.
    pub points: usize,
    /// Results of the method besides the flow.
    pub solution: Solution,
    /// The reason why the method ended.
    pub stop_reason: StopReason,
    /// Name of the processor that ran the method, for reports: the device of a field, the GPU that
    /// searched the clusters of objects, or the host's threads.
    pub device: String,
    /// Seconds of the first stage, by the control's clock: deskewing, selection, ground segmentation,
    /// and beside it the downsampling for the registration. Zero if the control keeps no time.
    pub selection_seconds: f64,
    /// Seconds of all stages before the method, by the control's clock: selection, ground
    /// segmentation, distance transform, ego motion and the registration of neighbor sweeps. Zero
    /// if the control keeps no time.
    pub precompute_seconds: f64,
    /// Seconds of all phases, by the control's clock. Zero if the control keeps no time.
    pub total_seconds: f64,
    /// The motion at any point in space, not only at the source points.
    pub motion: MotionField,
}

impl Estimate {
    /// Seconds of the method, by the control's clock: the object search, or the fit of the field
    /// with its distance queries and its evaluation.
    pub fn method_seconds(&self) -> f64 {
        self.total_seconds - self.precompute_seconds
    }

    /// The source and the target of the pair, N and M points, as the flow takes them: deskewed, or
    /// as they were `given`.
    pub fn sweeps(&self, given: [&Arc<[Point]>; 2]) -> [Arc<[Point]>; 2] {
        let deskewed = self
            .deskew
            .as_ref()
            .and_then(|deskew| deskew.points.clone());
        deskewed.unwrap_or_else(|| given.map(Arc::clone))
    }

    /// The outcome of the object search; none for [`crate::flow::Method::Field`].
    pub fn object_search(&self) -> Option<&ObjectSolution> {
        match &self.solution {
            Solution::Objects(solution) => Some(solution),
            Solution::Field(_) => None,
        }
    }

    /// The objects; none for [`crate::flow::Method::Field`].
    pub fn objects(&self) -> Option<&Objects> {
        self.object_search().map(|search| &search.objects)
    }

    /// The outcome of the fit; none for [`crate::flow::Method::Objects`].
    pub fn fit(&self) -> Option<&FieldSolution> {
        match &self.solution {
            Solution::Field(solution) => Some(solution),
            Solution::Objects(_) => None,
        }
    }
}

/// Results of a method besides the flow.
#[derive(Clone, Debug)]
pub enum Solution {
    /// The outcome of [`crate::flow::Method::Objects`].
    Objects(ObjectSolution),
    /// The outcome of [`crate::flow::Method::Field`].
    Field(FieldSolution),
}

/// The outcome of an object search.
#[derive(Clone, Debug)]
pub struct ObjectSolution {
    /// The clusters of the source with their boxes and motions.
    pub objects: Objects,
    /// Number of candidates that were searched. It is `candidates`, unless a deadline ended the
    /// search.
    pub searched: usize,
    /// Number of candidates: clusters before fragments of one moving object were merged. Zero if a
    /// deadline ended the search before or right after the clustering.
    pub candidates: usize,
    /// Mean truncated distance of the points of a cluster from the target, metres, averaged over
    /// the searched clusters. It is measured after the cluster's accepted motion, or at rest.
    /// Infinite if no cluster was searched.
    pub cost_m: f64,
    /// Number of source points on the vehicle that carries the sensor. They have no flow.
    pub own_points: usize,
    /// Seconds of the phases of the search.
    pub seconds: SearchSeconds,
}

/// The outcome of the fit of a field. With a partition the numbers of iterations are sums over the
/// clusters, the loss is the mean over their points, and the bytes are those of the largest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldSolution {
    /// Number of completed iterations; zero where the deadline allowed none.
    pub iterations: usize,
    /// Iteration limit of this fit; zero if the deadline allowed no fit. A warm start or a deadline
    /// can make it differ from [`crate::flow::FieldOptions::max_iterations`].
    pub max_iterations: usize,
    /// The iteration, counted from 1, whose field is the result. For an average it is the last one.
    /// Zero if none was done.
    pub best_iteration: usize,
    /// Mean loss of that iteration; for an average, the moving average of the losses. Comparable
    /// within one preset and pair. Infinite if no iteration was done.
    pub best_loss: f64,
    /// The unit of the loss, see [`crate::flow::LossOptions::unit`].
    pub loss_unit: &'static str,
    /// Bytes of the distance transform, or of the target cloud with a Chamfer distance; zero where
    /// the deadline left no time for one.
    pub distance_bytes: usize,
    /// Seconds of the distance queries in this run, without those before a resumed snapshot.
    ///
    /// On the CPU, the mean over the threads; zero if the control keeps no time. On a GPU,
    /// extrapolated from the timestamps of each submission's first iteration; zero if the GPU has
    /// no timestamps.
    pub query_seconds: f64,
}
