//! A request: the next iterations of one pair, and their records for the kernels.

use std::sync::Arc;

use super::buffers::Buffers;
use super::context::Context;
use super::layout::{Lane, STEPS, Status, Step};
use super::linear::LinearFit;
use super::tiling::Cut;
use crate::flow::field::BackendError;
use crate::flow::options::Precision;

/// The model of a request.
#[derive(Clone, Debug)]
pub(super) enum Model {
    Network(Precision),
    Linear(Arc<LinearFit>),
}

/// The loss of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LossKind {
    Distance,
    Chamfer,
}

/// The next iterations of one pair.
#[derive(Clone, Debug)]
pub(super) struct Request {
    pub(super) lane: Lane,
    pub(super) status: Status,
    /// One per requested iteration, at most [`STEPS`].
    pub(super) steps: Vec<Step>,
    pub(super) cut: Cut,
    pub(super) model: Model,
    pub(super) loss: LossKind,
}

/// The kernels that a request needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Kind {
    /// The precision of the network; none for a linear model.
    precision: Option<Precision>,
    loss: LossKind,
}

impl Kind {
    /// The kind of a fit of `model` to `loss`.
    pub(super) fn new(model: &Model, loss: LossKind) -> Self {
        let precision = match model {
            Model::Network(precision) => Some(*precision),
            Model::Linear(_) => None,
        };
        Self { precision, loss }
    }

    /// Whether several fits of this kind can be in one submission. The buffers of a linear model are
    /// those of one fit.
    pub(super) fn shares_submissions(self) -> bool {
        self.precision.is_some()
    }

    /// Whether a tile takes as long in every fit of this kind. That of a Chamfer distance or of a
    /// linear model depends on the target or on the grid.
    pub(super) fn shares_pace(self) -> bool {
        self.precision.is_some() && self.loss == LossKind::Distance
    }
}

impl Request {
    /// The kernels that it needs.
    pub(super) fn kind(&self) -> Kind {
        Kind::new(&self.model, self.loss)
    }

    /// Points of the largest batch and of the target of a Chamfer distance.
    pub(super) fn cloud_sizes(&self) -> [usize; 2] {
        let batch = self.steps.iter().map(|step| step.count).max();
        [batch.unwrap_or_default(), self.lane.cloud.targets].map(|points| points as usize)
    }
}

/// Writes the records of all requests to the buffers that the kernels read.
///
/// # Errors
/// As [`Context::write`].
pub(super) fn write(
    context: &Context,
    buffers: &Buffers,
    requests: &[&Request],
) -> Result<(), BackendError> {
    let (mut first_tile, mut first_chunk) = (0, 0);
    let mut lanes = Vec::new();
    let mut steps = vec![Step::default(); requests.len() * STEPS];
    for (index, request) in requests.iter().enumerate() {
        lanes.push(Lane {
            first_tile: first_tile as u32,
            tiles: request.cut.tiles as u32,
            first_chunk: first_chunk as u32,
            chunks: request.cut.chunks.count as u32,
            steps: request.steps.len() as u32,
            ..request.lane
        });
        first_tile += request.cut.tiles;
        first_chunk += request.cut.chunks.count;
        steps[index * STEPS..][..request.steps.len()].copy_from_slice(&request.steps);
    }
    let statuses: Vec<_> = requests.iter().map(|request| request.status).collect();
    context.write(&[
        (&buffers.lanes, 0, bytemuck::cast_slice(&lanes)),
        (&buffers.steps, 0, bytemuck::cast_slice(&steps)),
        (&buffers.statuses, 0, bytemuck::cast_slice(&statuses)),
    ])
}
