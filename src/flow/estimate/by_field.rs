//! Method field: the target prepared, registration, then the fit of a neural field (FNSF, NSFP).

use std::cell::LazyCell;

use super::ego_motion::{ego_motion, has_time_for_all, prior};
use super::method::{Input, Solved};
use super::result::{FieldSolution, Solution};
use crate::flow::data::{Hash, Point, StopReason};
use crate::flow::error::FlowError;
use crate::flow::field::{self, Backend, Fit, Fitted, FittedField, Prior, Snapshot};
use crate::flow::motion::{MotionField, Residual};
use crate::flow::options::{Ego, FieldOptions, Options};
use crate::flow::registration::Registration;
use crate::flow::select::Selection;

/// Estimates the residual motion by fitting a field on the backend, resumed from `snapshot` where
/// one is given.
///
/// # Errors
/// [`FlowError`] where the clouds or the snapshot are rejected, the control cancels, the fit
/// diverges or the device fails.
pub(super) fn residual_motion(
    backend: &dyn Backend,
    input: &Input<'_>,
    options: &FieldOptions,
    snapshot: Option<Snapshot>,
) -> Result<Solved, FlowError> {
    let Input {
        problem,
        selection,
        control,
        ..
    } = *input;
    // Without a warm start each pair is independent of the other pairs and of their order.
    let before = problem.before.filter(|_| options.warm_start.is_some());
    // Computed at most once, and only if there are snapshots.
    let identity = LazyCell::new(|| identity(selection, input.options, before));
    let state = snapshot
        .map(|snapshot| snapshot.state_for(*identity))
        .transpose()?;
    let host = backend.host();
    let prior = prior(problem, input.options);
    let registered = |whole| ego_motion(host, selection, input.options.ego, &prior, whole, control);
    // A cycle leads back to the source as it is aligned.
    let early_whole = !options.has_cycle() || has_time_for_all(selection, control);
    let early = options
        .has_cycle()
        .then(|| input.align(host, registered(early_whole)));
    let early = early.transpose()?;
    let source = early
        .as_ref()
        .map_or(&selection.source, |early| &early.aligned);
    let [source, target] = [source, &selection.target].map(|cloud| options.seen(cloud));
    let prepared = field::prepare_target(backend, [&source, &target], options, control)?;
    let alignment = match (early, &prepared, input.options.ego) {
        (Some(early), ..) => early,
        (None, Some(prepared), _) => input.align(host, registered(prepared.whole))?,
        (None, None, Ego::Given(motion)) => input.align(host, Some(Registration::given(motion)))?,
        (None, None, Ego::Auto | Ego::Off) => input.align(host, None)?,
    };
    let ego = alignment.ego;
    let aligned = &alignment.aligned;
    let fitted = match &prepared {
        None => Fitted::nothing(aligned.len(), control),
        Some(prepared) => Fit {
            backend,
            prior: before.and_then(|field| match &field.residual {
                Residual::Network(network) => Some(Prior {
                    network,
                    has_ego: field.ego.is_some(),
                }),
                Residual::Still
                | Residual::Linear(_)
                | Residual::Objects(_)
                | Residual::Sampled(_) => None,
            }),
            aligned: &options.seen(aligned),
            ego: ego.as_ref(),
            options,
            seed: input.options.seed,
            identity: &|| *identity,
            prepared,
            control,
        }
        .run(state)?,
    };
    Ok(Solved {
        alignment,
        own_rows: Vec::new(),
        residual: fitted.residual,
        motion: match fitted.field {
            None => Residual::Still,
            Some(FittedField::Network(network)) => Residual::Network(network),
            Some(FittedField::Linear(field)) => Residual::Linear(field),
        },
        solution: Solution::Field(FieldSolution {
            iterations: fitted.report.iterations,
            max_iterations: fitted.max_iterations,
            best_iteration: fitted.report.best_iteration,
            best_loss: fitted.report.best_loss,
            loss_unit: options.loss.unit(),
            query_seconds: fitted.report.query_seconds,
            distance_bytes: prepared.map_or(0, |prepared| prepared.target.bytes()),
        }),
        stop_reason: match early_whole {
            true => fitted.stop_reason,
            false => StopReason::Deadline,
        },
        device: backend.name(),
        precomputed_at: fitted.precomputed_at,
    })
}

/// Hash of all inputs of a fit: the selected clouds, the registration clouds, the previous motion
/// field, and every option except the memory limit.
fn identity(selection: &Selection, options: &Options, before: Option<&MotionField>) -> u64 {
    let mut options = options.clone();
    if let Some(loss) = options
        .field_mut()
        .and_then(|field| field.loss.distance_mut())
    {
        loss.transform.max_bytes = 0;
    }
    let mut hash = Hash(Hash::default().of(format!("{options:?}").as_bytes()));
    let mut cloud = |points: &[Point]| {
        hash.word(points.len() as u64);
        for [x, y, z] in points.iter().map(|point| point.map(f32::to_bits)) {
            hash.word(u64::from(x) << 32 | u64::from(y));
            hash.word(u64::from(z));
        }
    };
    cloud(&selection.source);
    cloud(&selection.target);
    selection
        .registration_clouds
        .iter()
        .flatten()
        .for_each(|points| cloud(points));
    if let Some(field) = before {
        field
            .to_bytes()
            .into_iter()
            .for_each(|byte| hash.word(byte.into()));
    }
    hash.0
}
