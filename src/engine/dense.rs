//! A sequence's sweeps carried into one frame on a device, in pieces: a sign of life comes between
//! them, however many points there are.

use std::collections::HashMap;
use std::sync::Arc;

use super::EngineError;
use super::busy::Busy;
use super::lane::Heard;
use crate::flow::backend::{Backend, BackendError, Transform};
use crate::flow::densify::{self, DensifyError, Leg, Plan};
use crate::flow::distance::DistanceOptions;
use crate::flow::field::Network;
use crate::flow::{
    DenseCloud, Field, FlowError, LabelOptions, Labelled, Point, RigidTransform, Sweep, Watch,
};

/// Points between two signs of life: a tenth of a second of two cores.
const PIECE: usize = 1 << 17;

/// Sweeps to be carried into one frame.
pub struct Densification {
    /// Which frame, and how.
    pub plan: Plan,
    /// All sweeps, in order.
    pub sweeps: Vec<Sweep>,
    /// A field for each leg of the plan.
    pub fields: HashMap<Leg, Field>,
    /// Looks in on it.
    pub watch: Arc<dyn Watch + Send + Sync>,
}

/// Carries the sweeps. Half of a dense cloud is none: an interrupt of any kind ends it without.
pub(super) fn densify(
    backend: &dyn Backend,
    work: &Densification,
    busy: &Busy,
) -> Result<DenseCloud, EngineError> {
    let watch = Heard {
        watch: work.watch.as_ref(),
        busy,
    };
    let pieces = InPieces {
        backend,
        watch: &watch,
        piece: PIECE,
    };
    let field = |leg| work.fields.get(&leg);
    densify::densify(&pieces, &work.plan, &work.sweeps, field, &watch).map_err(
        |error| match error {
            DensifyError::Interrupted(_) | DensifyError::Backend(BackendError::Interrupted(_)) => {
                FlowError::Cancelled.into()
            }
            DensifyError::Backend(error) => FlowError::Backend(error).into(),
            error => EngineError::Densify(error),
        },
    )
}

/// A backend that evaluates a field piece by piece. What it says at a point does not depend on the
/// points beside it.
struct InPieces<'a> {
    backend: &'a dyn Backend,
    watch: &'a dyn Watch,
    piece: usize,
}

impl Backend for InPieces<'_> {
    fn name(&self) -> String {
        self.backend.name()
    }

    fn transform(
        &self,
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        watch: &dyn Watch,
    ) -> Result<Box<dyn Transform>, BackendError> {
        self.backend.transform(source, target, options, watch)
    }

    fn align(
        &self,
        source: &[Point],
        target: &[Point],
        prior: &RigidTransform,
        watch: &dyn Watch,
    ) -> RigidTransform {
        self.backend.align(source, target, prior, watch)
    }

    fn movers(
        &self,
        source: &[Point],
        target: &[Point],
        options: &LabelOptions,
        watch: &dyn Watch,
    ) -> Labelled {
        self.backend.movers(source, target, options, watch)
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        let mut found = Vec::with_capacity(points.len());
        for piece in points.chunks(self.piece) {
            if let Some(interrupt) = self.watch.interrupt() {
                return Err(BackendError::Interrupted(interrupt));
            }
            found.extend(self.backend.evaluate(network, piece)?);
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::cpu::CpuBackend;
    use crate::flow::{Options, Preset, Problem, Unwatched, estimate};

    #[test]
    fn a_field_says_the_same_in_pieces_as_at_once() {
        let source: Vec<Point> = (0..700u16)
            .map(|i| [8.0, f32::from(i % 30) * 0.2, f32::from(i / 30) * 0.2])
            .collect();
        let target: Vec<Point> = source.iter().map(|[x, y, z]| [x + 0.1, *y, *z]).collect();
        let problem = Problem {
            source: &source,
            target: &target,
            ground: None,
            before: None,
        };
        let options = Options {
            max_iterations: 3,
            ..Preset::Default.options(None)
        };
        let backend = CpuBackend::new(Some(2)).expect("threads");
        let fitted = estimate(&backend, &problem, &options, &Unwatched).expect("a flow");
        let whole = fitted.field.residual(&backend, &source).expect("a flow");
        for piece in [1, 97, 256, 1000] {
            let pieces = InPieces {
                backend: &backend,
                watch: &Unwatched,
                piece,
            };
            let found = fitted.field.residual(&pieces, &source).expect("a flow");
            assert_eq!(found, whole, "{piece}");
        }
    }
}
