//! The common interface of the two methods: input and result.

use nalgebra::Matrix6;

use super::result::Solution;
use crate::flow::data::StopReason;
use crate::flow::data::{Control, Interrupt, Point, RigidTransform, transform_points};
use crate::flow::error::FlowError;
use crate::flow::host::Host;
use crate::flow::motion::Residual;
use crate::flow::options::{LEAST_OVERLAP, Options};
use crate::flow::problem::Problem;
use crate::flow::registration::{Registration, overlap};
use crate::flow::select::Selection;

/// The input of a method.
pub(super) struct Input<'a> {
    pub(super) problem: &'a Problem<'a>,
    /// The source and the target before they were deskewed, N and M points.
    pub(super) given: [&'a [Point]; 2],
    /// Whether the pair of `problem` is deskewed. If not, it is `given`.
    pub(super) is_deskewed: bool,
    pub(super) options: &'a Options,
    pub(super) selection: &'a Selection<'a>,
    pub(super) control: &'a dyn Control,
}

impl Input<'_> {
    /// The source in the target's frame by the ego motion `ego`, or as it is where there is none,
    /// with its overlap. After a deadline the overlap is not measured.
    ///
    /// # Errors
    /// [`FlowError::NoOverlap`] where an ego motion aligns sweeps of two scenes, and
    /// [`FlowError::Cancelled`] where the control has cancelled.
    pub(super) fn align(
        &self,
        host: &Host,
        ego: Option<Registration>,
    ) -> Result<Alignment, FlowError> {
        let Selection {
            source,
            target,
            unsampled,
            has_ground,
            ..
        } = self.selection;
        let (ego, ego_covariance) =
            ego.map_or((None, None), |found| (Some(found.motion), found.covariance));
        let moved = |points: &[Point]| match &ego {
            None => points.to_vec(),
            Some(motion) => transform_points(motion, points),
        };
        let aligned = moved(source);
        let clouds = unsampled
            .as_ref()
            .map_or([source, target], |[source, target]| [source, target]);
        let measure = || match (has_ground, unsampled) {
            (false, None) => overlap(&aligned, target),
            (false, Some([source, target])) => overlap(&moved(source), target),
            (true, _) => {
                let [source, target] = off_ground(host, clouds);
                overlap(&moved(&source), &target)
            }
        };
        let overlap = match self.control.interrupt() {
            Some(Interrupt::Cancelled) => return Err(FlowError::Cancelled),
            Some(Interrupt::Deadline) => None,
            None => host.threads().install(measure),
        };
        match overlap {
            Some(overlap) if overlap < LEAST_OVERLAP && ego.is_some() && !self.options.force => {
                Err(FlowError::NoOverlap { overlap })
            }
            overlap => Ok(Alignment {
                ego,
                ego_covariance,
                aligned,
                overlap,
            }),
        }
    }
}

/// The points of the source and of the target that are off the ground. All are finite.
fn off_ground(host: &Host, clouds: [&Vec<Point>; 2]) -> [Vec<Point>; 2] {
    let masks = host.ground(&clouds.map(Vec::as_slice));
    let mut masks = masks.into_iter();
    clouds.map(|points| {
        let rows = points.iter().zip(masks.next().unwrap_or_default());
        rows.filter(|(_, is_ground)| !is_ground)
            .map(|(&point, _)| point)
            .collect()
    })
}

/// The source in the target's frame.
pub(super) struct Alignment {
    pub(super) ego: Option<RigidTransform>,
    /// Covariance of the ego motion, see [`Registration::covariance`].
    pub(super) ego_covariance: Option<Matrix6<f64>>,
    /// The selected source points, transformed by the ego motion into the target's frame.
    pub(super) aligned: Vec<Point>,
    /// The overlap of the two sweeps, see [`overlap()`].
    pub(super) overlap: Option<f32>,
}

/// The result of a method, one row per selected source point.
pub(super) struct Solved {
    pub(super) alignment: Alignment,
    /// Residual displacement of each aligned point, metres, in the target's frame.
    pub(super) residual: Vec<Point>,
    /// The residual motion at any point.
    pub(super) motion: Residual,
    pub(super) solution: Solution,
    /// Source rows of the vehicle itself, which get no flow.
    pub(super) own_rows: Vec<usize>,
    pub(super) stop_reason: StopReason,
    pub(super) device: String,
    /// End of the preparation (selection, distance transform, ego motion), in seconds of the
    /// control's clock.
    pub(super) precomputed_at: f64,
}
