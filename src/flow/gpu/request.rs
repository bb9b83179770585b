//! A request: the next iterations of one pair, and their records for the kernels.

use std::sync::Arc;

use super::buffers::Buffers;
use super::context::Context;
use super::layout::{Lane, STEPS, Status, Step};
use super::linear::LinearFit;
use super::tiling::Cut;
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

impl Request {
    /// Whether both requests can be in one submission, which has one set of kernels.
    pub(super) fn goes_with(&self, other: &Self) -> bool {
        let same = match (&self.model, &other.model) {
            (Model::Network(own), Model::Network(other)) => own == other,
            // Its buffers are those of one fit.
            _ => false,
        };
        same && self.loss == other.loss
    }

    /// Queries of the largest search of nearest neighbors.
    pub(super) fn queries(&self) -> usize {
        let batches = self.steps.iter().map(|step| step.count);
        let largest = batches.chain([self.lane.cloud.targets]).max();
        largest.unwrap_or_default() as usize
    }
}

/// Writes the records of all requests to the buffers that the kernels read.
pub(super) fn write(context: &Context, buffers: &Buffers, requests: &[&Request]) {
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
    let write = |buffer: &wgpu::Buffer, bytes: &[u8]| context.queue.write_buffer(buffer, 0, bytes);
    write(&buffers.lanes, bytemuck::cast_slice(&lanes));
    write(&buffers.steps, bytemuck::cast_slice(&steps));
    write(&buffers.statuses, bytemuck::cast_slice(&statuses));
}
