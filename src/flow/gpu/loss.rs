//! The prepared targets and the losses of fits on the GPU, as records for the kernels.

use core::ops::Range;
use std::sync::Arc;

use super::chamfer::GpuCloud;
use super::device::Device;
use super::distance::GpuTransform;
use super::layout;
use super::request::LossKind;
use crate::flow::data::Point;
use crate::flow::field::{BackendError, OTHER_LOSS};
use crate::flow::options::{ChamferOptions, DistanceLossOptions, LossOptions};

/// A prepared target on the GPU.
#[derive(Clone, Copy)]
pub(super) enum GpuTarget<'a> {
    Transform(&'a GpuTransform),
    Cloud(&'a GpuCloud),
}

impl GpuTarget<'_> {
    pub(super) fn device(&self) -> &Arc<Device> {
        match self {
            Self::Transform(target) => &target.device,
            Self::Cloud(target) => &target.device,
        }
    }

    /// Writes the points that are fitted, and returns their offset in words.
    pub(super) fn write_points(&self, points: &[Point]) -> Result<u32, BackendError> {
        match self {
            Self::Transform(target) => target.allocation.write_points(points),
            Self::Cloud(target) => target.allocation.write_points(points),
        }
    }
}

/// The loss of a fit.
pub(super) enum GpuLoss<'a> {
    Distance {
        target: &'a GpuTransform,
        options: DistanceLossOptions,
    },
    Chamfer {
        target: &'a GpuCloud,
        options: ChamferOptions,
    },
}

impl<'a> GpuLoss<'a> {
    pub(super) fn new(target: GpuTarget<'a>, options: &LossOptions) -> Result<Self, BackendError> {
        Ok(match (target, options) {
            (GpuTarget::Transform(target), LossOptions::Distance(options)) => Self::Distance {
                target,
                options: options.clone(),
            },
            (GpuTarget::Cloud(target), LossOptions::Chamfer(options)) => Self::Chamfer {
                target,
                options: *options,
            },
            _ => return Err(OTHER_LOSS),
        })
    }

    pub(super) fn kind(&self) -> LossKind {
        match self {
            Self::Distance { .. } => LossKind::Distance,
            Self::Chamfer { .. } => LossKind::Chamfer,
        }
    }

    /// Writes its part of the lane's record.
    pub(super) fn describe(&self, lane: &mut layout::Lane) {
        match self {
            Self::Distance { target, options } => {
                lane.transform = target.record;
                lane.margin = options.margin_m;
                lane.margin_slope = options.margin_slope;
                lane.truncation = options.truncation_m.unwrap_or(f32::MAX);
                lane.flow_penalty = options.flow_penalty;
            }
            Self::Chamfer { target, options } => {
                lane.cloud = target.record;
                lane.truncation = options.truncation_m;
            }
        }
    }

    /// Whether the iteration after `done` others keeps nearest neighbors of an earlier one.
    pub(super) fn depends_on_earlier(&self, done: usize) -> bool {
        match self {
            Self::Distance { .. } => false,
            Self::Chamfer { options, .. } => {
                options.renewal.is_some_and(|renewal| !renewal.is_due(done))
            }
        }
    }

    /// `steps` iterations after `done` others, or fewer if a new search of nearest neighbors follows
    /// them: only there can the state of the fit be taken.
    pub(super) fn up_to_a_search(&self, done: usize, steps: usize) -> usize {
        let before_a_search = (1..=steps)
            .rev()
            .find(|&steps| !self.depends_on_earlier(done + steps));
        before_a_search.unwrap_or(steps)
    }

    /// Writes its part of the record of the iteration after `done` others, over `batch`. `searched` is
    /// the batch that nearest neighbors were searched for last.
    pub(super) fn describe_step(
        &self,
        step: &mut layout::Step,
        done: usize,
        batch: &Range<usize>,
        searched: &mut Option<Range<usize>>,
    ) {
        if let Self::Chamfer { target, .. } = self {
            step.share = batch.len() as f32 / target.record.targets as f32;
            if !self.depends_on_earlier(done) || searched.as_ref() != Some(batch) {
                step.searches = 1;
                *searched = Some(batch.clone());
            }
        }
    }

    /// The number of `steps` that have a distance query or a search of nearest neighbors.
    pub(super) fn queries(&self, steps: &[layout::Step]) -> usize {
        match self {
            Self::Distance { .. } => steps.len(),
            Self::Chamfer { .. } => steps.iter().filter(|step| step.searches == 1).count(),
        }
    }
}
