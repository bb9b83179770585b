//! Warm start of a fit from the preceding pair's field, transformed into the new frame. It is used
//! only if it explains the new pair better than no motion.

use super::backend::Backend;
use super::budget::Prepared;
use super::error::FitError;
use super::mlp::Conditioning;
use super::network::Network;
use super::snapshot::TrainerState;
use crate::flow::data::{Point, RigidTransform, stride_sample};
use crate::flow::options::{FieldOptions, LossOptions};

/// Points on which the preceding pair's field is evaluated.
const JUDGED: usize = 4096;

/// The field of the preceding pair.
#[derive(Clone, Copy)]
pub(crate) struct Prior<'a> {
    pub(crate) network: &'a Network,
    /// Whether it is the residual motion after an ego motion.
    pub(crate) has_ego: bool,
}

/// The initial state of a fit to `aligned` that starts from the preceding pair's field. Sets
/// `options` to those of a warm start. None, with `options` unchanged, if the options have no warm
/// start or a model that is not one network, there is no preceding field, only one of the pairs has
/// an ego motion, or the field explains this pair no better than no motion.
pub(crate) fn warm_start(
    backend: &dyn Backend,
    prepared: &Prepared,
    aligned: &[Point],
    ego: Option<&RigidTransform>,
    prior: Option<Prior<'_>>,
    options: &mut FieldOptions,
) -> Result<Option<TrainerState>, FitError> {
    let (Some(warm_start), Some(prior)) = (options.warm_start, prior) else {
        return Ok(None);
    };
    if prior.has_ego != ego.is_some() {
        return Ok(None);
    }
    let Some(model) = options.network().filter(|network| !network.cycle) else {
        return Ok(None);
    };
    let conditioning = Conditioning::new(aligned, model.inputs);
    let motion = ego.copied().unwrap_or_default();
    let transformed = Network {
        parameters: prior.network.transformed(&motion, &conditioning),
        conditioning,
    };
    let points = stride_sample(aligned, JUDGED);
    let flows = backend.evaluate(&transformed, &points)?;
    let still = vec![[0.0; 3]; points.len()];
    let [prior_loss, still_loss] = [
        mean_loss(prepared, options, &points, &flows)?,
        mean_loss(prepared, options, &points, &still)?,
    ];
    // Written so that a loss that is not a number starts from new weights.
    if prior_loss < still_loss {
        *options = options.warmed(warm_start);
        return Ok(Some(TrainerState::at_start(transformed.parameters)));
    }
    Ok(None)
}

/// The mean loss of `points` displaced by `flows`.
fn mean_loss(
    prepared: &Prepared,
    options: &FieldOptions,
    points: &[Point],
    flows: &[Point],
) -> Result<f64, FitError> {
    let pairs = || points.iter().zip(flows);
    let moved = pairs().map(|(point, flow)| core::array::from_fn(|a| point[a] + flow[a]));
    let distances = prepared.target.distances(&moved.collect::<Vec<_>>())?;
    let losses = pairs()
        .zip(distances)
        .map(|((&point, &flow), distance)| f64::from(value(&options.loss, point, distance, flow)));
    Ok(losses.sum::<f64>() / points.len() as f64)
}

/// The loss of `point` with `flow`, where the deformed point lies at `distance` from the target,
/// metres. Of a Chamfer distance it is the source's part.
fn value(loss: &LossOptions, point: Point, distance: f32, flow: Point) -> f32 {
    match loss {
        LossOptions::Distance(options) => options.value(point, distance, flow),
        LossOptions::Chamfer(options) if distance < options.truncation_m => distance * distance,
        LossOptions::Chamfer(_) => 0.0,
    }
}
