//! The estimate of a pair: selection, ego motion, residual motion by the method, assembly.

use std::borrow::Cow;

use bytemuck::cast_slice;
use rayon::prelude::*;

use super::by_cluster;
use super::by_field;
use super::by_objects;
use super::deskewing::{deskew, has_deskew};
use super::ego_motion::has_time_for;
use super::method::{Alignment, Input, Solved};
use super::result::{Estimate, Solution};
use crate::flow::data::{Control, DYNAMIC_M, Point, StopReason, transform_point};
use crate::flow::error::FlowError;
use crate::flow::field::{Backend, Snapshot, SnapshotError};
use crate::flow::host::Host;
use crate::flow::motion::MotionField;
use crate::flow::objects::Probabilities;
use crate::flow::options::{CERTAIN_OVERLAP, Ego, LEAST_OVERLAP, Method, Options};
use crate::flow::problem::Problem;
use crate::flow::select::select;

/// Estimates the motion of the source points that `options` select; the other points get no flow. A
/// field and its distance transform are computed on `backend`, and so is the search of clusters if it
/// has kernels for it. All other stages run on its [`Backend::host`].
///
/// A deadline is not an error: the result is the best flow that the time allows.
///
/// # Errors
/// - [`FlowError::TooFewPoints`], [`FlowError::NoGroundMask`] or [`FlowError::GroundMaskLength`] if
///   the problem does not suit the options.
/// - [`FlowError::NotMetres`] or [`FlowError::NoOverlap`] if the coordinates are not metres, or the
///   sweeps do not show one scene after the ego motion. Not with [`Options::force`].
/// - [`FlowError::TimesLength`] if a sweep does not have one time per point.
/// - [`FlowError::Cancelled`] if the control cancels.
/// - [`FlowError::Diverged`] if the loss of a field is not finite.
/// - [`FlowError::Backend`] if the distance transform is rejected, or the device fails, is busy,
///   has too little memory or does not support the options.
pub fn estimate(
    backend: &dyn Backend,
    problem: &Problem,
    options: &Options,
    control: &dyn Control,
) -> Result<Estimate, FlowError> {
    estimate_from(backend, problem, options, None, control)
}

/// Resumes the fit of a field from `snapshot`. Without a deadline, the result is bit-identical to
/// that of an uninterrupted [`estimate`] on a device that rounds multiply-adds alike.
///
/// # Errors
/// As [`estimate`], and [`FlowError::Snapshot`] where the snapshot belongs to another problem,
/// other options or another method. A different
/// [`crate::flow::distance::DistanceOptions::max_bytes`] is allowed.
pub fn resume(
    backend: &dyn Backend,
    problem: &Problem,
    options: &Options,
    snapshot: Snapshot,
    control: &dyn Control,
) -> Result<Estimate, FlowError> {
    estimate_from(backend, problem, options, Some(snapshot), control)
}

fn estimate_from(
    backend: &dyn Backend,
    problem: &Problem,
    options: &Options,
    snapshot: Option<Snapshot>,
    control: &dyn Control,
) -> Result<Estimate, FlowError> {
    let began = control.seconds();
    let deskewed = deskew(backend.host(), problem, options, control)?;
    let lacks_deskew = deskewed.is_none() && has_deskew(problem, options);
    let given = [problem.source, problem.target];
    let estimates_ego = options.ego == Ego::Auto;
    let (mut problem, mut options) = (*problem, Cow::Borrowed(options));
    let mut is_deskewed = false;
    let neighbors;
    if let Some(deskewed) = &deskewed {
        options.to_mut().ego = Ego::Given(deskewed.ego.motion);
        neighbors = deskewed.neighbors(&problem);
        problem.neighbors = &neighbors;
        problem.ground = deskewed.ground(&problem, &options);
        let deskew = deskewed.deskew.as_ref();
        if let Some([source, target]) = deskew.and_then(|deskew| deskew.points.as_ref()) {
            (problem.source, problem.target) = (source, target);
            is_deskewed = true;
        }
    }
    let (problem, options) = (&problem, options.as_ref());
    let host = backend.host();
    let find_ground = |sweeps: &[&[Point]]| {
        // Twice the time, since the ground takes some of it.
        let points: usize = sweeps.iter().map(|sweep| sweep.len()).sum();
        if options.ego == Ego::Auto && has_time_for(2 * points, control) {
            host.ground_and_surfels(sweeps)
        } else {
            host.ground(sweeps)
        }
    };
    let selection = host.install(|| select(problem, given, options, &find_ground))?;
    let selected_at = control.seconds();
    let input = Input {
        problem,
        given,
        is_deskewed,
        options,
        selection: &selection,
        control,
    };
    let solved = match &options.method {
        // Only the fit of one field has snapshots.
        Method::Objects(_) if snapshot.is_some() => return Err(SnapshotError::Foreign.into()),
        Method::Objects(objects) => by_objects::residual_motion(backend, &input, objects)?,
        Method::Field(field) => match &field.partition {
            Some(_) if snapshot.is_some() => return Err(SnapshotError::Foreign.into()),
            Some(partition) => by_cluster::residual_motion(backend, &input, field, partition)?,
            None => by_field::residual_motion(backend, &input, field, snapshot)?,
        },
    };
    let mut estimate = assemble(host, &input, solved, [began, selected_at]);
    if lacks_deskew {
        estimate.stop_reason = StopReason::Deadline;
    }
    if let Some(pair) = deskewed {
        estimate.ego_covariance = pair.ego.covariance;
        estimate.deskew = pair.deskew;
    }
    estimate.ego_is_rough = estimates_ego && estimate.ego_covariance.is_none();
    if estimate.ego_is_rough
        && let Solution::Objects(solution) = &mut estimate.solution
    {
        solution.objects.scale_probabilities(0.0);
    }
    Ok(estimate)
}

/// Maps the result for the selected points back to all source points.
/// The times are those of its begin and of the end of the selection.
fn assemble(
    host: &Host,
    input: &Input<'_>,
    solved: Solved,
    [began, selected_at]: [f64; 2],
) -> Estimate {
    let (source, selection) = (input.problem.source, input.selection);
    let Solved {
        alignment,
        residual,
        motion,
        mut solution,
        own_rows,
        ..
    } = solved;
    let Alignment {
        ego,
        ego_covariance,
        aligned,
        overlap,
    } = alignment;
    let mut flow = vec![[0.0; 3]; source.len()];
    let mut valid = vec![false; source.len()];
    let mut dynamic = ego.map(|_| vec![false; source.len()]);
    for &i in &selection.output_indices {
        let row = selection.rows[i];
        let (from, to, residual) = (selection.source[i], aligned[i], residual[i]);
        flow[row] = core::array::from_fn(|a| (to[a] - from[a]) + residual[a]);
        valid[row] = true;
        if let Some(dynamic) = &mut dynamic {
            let square: f32 = residual.iter().map(|r| r * r).sum();
            dynamic[row] = square >= DYNAMIC_M * DYNAMIC_M;
        }
    }
    for row in own_rows {
        flow[row] = [0.0; 3];
        valid[row] = false;
        if let Some(dynamic) = &mut dynamic {
            dynamic[row] = false;
        }
    }
    let output = selection.output_indices.iter();
    let points = output.filter(|&&i| valid[selection.rows[i]]).count();
    let mut objects = match &mut solution {
        Solution::Objects(solution) => Some(&mut solution.objects),
        Solution::Field(_) => None,
    };
    // Where the deadline allowed no ego motion, the identity is used.
    if input.options.ego != Ego::Off {
        let ego = ego.unwrap_or_default();
        let rows = &selection.ego_only_rows;
        let moved = rows
            .par_iter()
            .map(|&row| transform_point(&ego, source[row]));
        let moved: Vec<Point> = host.install(|| moved.collect());
        for (&row, to) in rows.iter().zip(&moved) {
            flow[row] = core::array::from_fn(|a| to[a] - source[row][a]);
            valid[row] = true;
        }
        if let Some(objects) = &mut objects {
            let of_ground = |to: &Point| Probabilities::of_ground(to[0].hypot(to[1]));
            let probabilities = moved.par_iter().map(of_ground);
            let probabilities: Vec<Probabilities> = host.install(|| probabilities.collect());
            for (&row, probabilities) in rows.iter().zip(probabilities) {
                objects.confidence[row] = probabilities.confidence;
                objects.moving[row] = probabilities.moving;
            }
        }
    }
    if let Some(objects) = objects {
        objects.clear_invalid(&valid);
        objects.scale_probabilities(certainty(overlap));
    }
    Estimate {
        flow,
        valid,
        dynamic,
        ego,
        ego_covariance,
        ego_is_rough: false,
        overlap,
        deskew: None,
        is_off_origin: selection.is_off_origin,
        // By bits, because points may be no numbers.
        same_sweep: cast_slice::<Point, u8>(source)
            == cast_slice::<Point, u8>(input.problem.target),
        points,
        solution,
        stop_reason: solved.stop_reason,
        device: solved.device,
        selection_seconds: selected_at - began,
        precompute_seconds: solved.precomputed_at - began,
        total_seconds: input.control.seconds() - began,
        motion: MotionField {
            ego,
            residual: motion,
        },
    }
}

/// The factor of an overlap on all confidences: 1 from [`CERTAIN_OVERLAP`], 0 below
/// [`LEAST_OVERLAP`], and linear between the two. An unknown overlap is no doubt.
fn certainty(overlap: Option<f32>) -> f32 {
    let share = |overlap| (overlap - LEAST_OVERLAP) / (CERTAIN_OVERLAP - LEAST_OVERLAP);
    overlap.map_or(1.0, |overlap| share(overlap).clamp(0.0, 1.0))
}
