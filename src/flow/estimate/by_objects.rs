//! Method objects: registration, then a rigid motion for each moving cluster.

use super::ego_motion::{ego_motion, has_time_for_all};
use super::method::{Input, Solved};
use super::neighbors::aligned_neighbors;
use super::result::{ObjectSolution, Solution};
use crate::flow::data::StopReason;
use crate::flow::data::{Interrupt, RigidTransform};
use crate::flow::error::FlowError;
use crate::flow::field::{Backend, BackendError};
use crate::flow::motion::Residual;
use crate::flow::objects::{ClusterDevice, Objects, PackedScene, SearchClouds, TimedPoints};
use crate::flow::options::ObjectOptions;

/// Estimates the residual motion by an object search. The device finds the normals and searches the
/// clusters if it has kernels for it and memory, and the host's threads do the rest.
///
/// # Errors
/// [`FlowError`] where the ground mask of a neighbor sweep is rejected, the control cancels, or the
/// device fails.
pub(super) fn residual_motion(
    backend: &dyn Backend,
    input: &Input<'_>,
    options: &ObjectOptions,
) -> Result<Solved, FlowError> {
    let Input {
        problem,
        selection,
        control,
        ..
    } = *input;
    let host = backend.host();
    let whole = has_time_for_all(selection, control);
    let prior = RigidTransform::identity();
    let ego = ego_motion(host, selection, input.options.ego, &prior, whole, control);
    let alignment = input.align(host, ego)?;
    let ego = alignment.ego;
    let motion = ego.unwrap_or_default();
    let aligned = &alignment.aligned;
    let (neighbors, has_all) = match &ego {
        None => (Vec::new(), true),
        Some(ego) => aligned_neighbors(host, input, ego)?,
    };
    let precomputed_at = control.seconds();
    let elapsed_s = input.options.elapsed_s();
    let share = |times: &[f32]| -> Vec<f32> { times.iter().map(|time| time / elapsed_s).collect() };
    let shares = problem
        .times
        .filter(|_| input.is_deskewed)
        .map(|times| times.map(share));
    let clouds = SearchClouds {
        source: aligned,
        target: &selection.target,
        neighbors: &neighbors,
        sweeps: input.given,
        times: shares
            .as_ref()
            .map(|[source, target]| [source.as_slice(), target]),
        target_from_source: motion,
    };
    let on_device =
        |scene: &PackedScene, is_over: &dyn Fn() -> bool| backend.search_clusters(scene, is_over);
    let device: Option<&ClusterDevice<'_, BackendError>> =
        backend.searches_clusters().then_some(&on_device);
    let mut search = match host.find_objects_with(&clouds, options, device, control) {
        Err(error) if error.is_out_of_memory() => host.find_objects(&clouds, options, control),
        found => found?,
    };
    if search.interrupted == Some(Interrupt::Cancelled) {
        return Err(FlowError::Cancelled);
    }
    if let Some([source_times, target_times]) = problem.times {
        let at = |rows: &[usize], times: &[f32]| -> Vec<f32> {
            rows.iter().map(|&row| times[row]).collect()
        };
        let source = TimedPoints {
            points: aligned,
            times: &at(&selection.rows, source_times),
        };
        let target = TimedPoints {
            points: &selection.target,
            times: &at(&selection.target_rows, target_times),
        };
        search.scale_to_interval(source, target, elapsed_s);
    }
    let mut objects = host.threads().install(|| {
        let (rows, source) = (&selection.rows, &selection.source);
        Objects::new(
            problem.source.len(),
            rows,
            source,
            &search,
            &motion,
            input.options.dt_s,
        )
    });
    let own_rows = ego.map_or_else(Vec::new, |ego| {
        let rows = [problem.source, input.given[0]];
        objects.take_own(rows, &ego, input.options.dt_s)
    });
    Ok(Solved {
        residual: search.residual_of(aligned),
        alignment,
        solution: Solution::Objects(ObjectSolution {
            objects,
            searched: search.clusters,
            candidates: search.all_clusters,
            cost_m: search.cost_m,
            own_points: own_rows.len(),
            seconds: search.seconds,
        }),
        own_rows,
        stop_reason: match search.interrupted {
            None if whole && has_all => StopReason::Completed,
            _ => StopReason::Deadline,
        },
        device: if search.on_device {
            backend.name()
        } else {
            host.name().to_owned()
        },
        motion: Residual::Objects(search.motions.into()),
        precomputed_at,
    })
}
