//! Where a fit starts that has a pair before it: from that pair's field, carried into the new frame,
//! if that explains the new pair. Fits nothing.

use super::backend::Backend;
use super::budget::Prepared;
use super::mlp::Conditioning;
use super::network::Network;
use super::snapshot::TrainerState;
use crate::flow::data::{Point, stride_sample};
use crate::flow::error::FlowError;
use crate::flow::motion::{MotionField, Residual};
use crate::flow::options::Options;

/// Points on which a field of the pair before is judged.
const JUDGED: usize = 4096;

/// The state of a fit to `aligned` that starts from the field before, and its options; none where the
/// options want none, or the field explains this pair no better than that nothing moves.
pub(crate) fn warm_start(
    backend: &dyn Backend,
    prepared: &Prepared,
    aligned: &[Point],
    before: Option<&MotionField>,
    options: &mut Options,
) -> Result<Option<TrainerState>, FlowError> {
    let (Some(warm_start), Some(before)) = (options.warm_start, before) else {
        return Ok(None);
    };
    let Residual::Network(network) = &before.residual else {
        return Ok(None);
    };
    if before.ego.is_some() != prepared.ego.is_some() {
        return Ok(None);
    }
    let conditioning = Conditioning::new(aligned, options.inputs);
    let motion = prepared.ego.unwrap_or_default();
    let carried = Network {
        parameters: network.carried(&motion, &conditioning),
        conditioning,
    };
    let points = stride_sample(aligned, JUDGED);
    let flows = backend.evaluate(&carried, &points)?;
    let still = vec![[0.0; 3]; points.len()];
    let [carried_loss, still_loss] = [
        mean_loss(prepared, options, &points, &flows)?,
        mean_loss(prepared, options, &points, &still)?,
    ];
    // Not the other way round: a loss that is no number starts afresh.
    if carried_loss < still_loss {
        *options = options.warmed(warm_start);
        return Ok(Some(TrainerState::at_start(carried.parameters)));
    }
    Ok(None)
}

/// The mean loss of `points` moved by `flows`.
fn mean_loss(
    prepared: &Prepared,
    options: &Options,
    points: &[Point],
    flows: &[Point],
) -> Result<f64, FlowError> {
    let pairs = || points.iter().zip(flows);
    let moved = pairs().map(|(point, flow)| core::array::from_fn(|a| point[a] + flow[a]));
    let distances = prepared.transform.distances(&moved.collect::<Vec<_>>())?;
    let losses = pairs()
        .zip(distances)
        .map(|((&point, &flow), distance)| f64::from(options.loss.value(point, distance, flow)));
    Ok(losses.sum::<f64>() / points.len() as f64)
}
