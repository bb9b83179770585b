//! Cost model: the memory and the work of an estimate, predicted from its input.
//!
//! Rejects the inputs that [`super::estimate()`] rejects, in about a hundredth of its time and
//! without its memory. Work is counted in multiply-adds of the network. Other work is converted to
//! the number of multiply-adds that take equally long on a CPU. Independent of the device: a
//! throughput in multiply-adds per second turns work into seconds.

use super::data::Point;
use super::distance::DistanceTransform;
use super::error::FlowError;
use super::field::{LAID_OUT, LinearGrid, PARAMETERS, chamfer_work, check_chamfer};
use super::options::{FieldOptions, LossOptions, Method, ModelOptions, Options};
use super::problem::Problem;
use super::select::{find_ground, select};
use super::spatial::dbscan;

/// Network passes per point and iteration: one forward pass, and a backward pass that costs two.
const PASSES: f64 = 3.0;
/// Fixed cost of an iteration (gradient sum, Adam, transposes), expressed in points.
const STEP_POINTS: f64 = 150.0;
/// Fixed cost of a registration, multiply-adds: nine coarse fits, as nearly all pairs need, and a fine
/// fit of 8,192 points.
const ALIGNING: f64 = 4e9;
/// Cost per point of the registration's voxel downsampling and surfels, multiply-adds.
const THINNING: f64 = 2e4;
/// Peak bytes per point of the same step: the point, a cached copy, its voxel and its surfels.
const THINNING_BYTES: usize = 96;
/// Peak bytes per point of either cloud where nothing is registered: the ground, the clouds without
/// it, and the indices by which their overlap is measured.
const OVERLAP_BYTES: usize = 96;
/// Bytes per point of either cloud from which a sample is drawn: the point, its row and its place in
/// the order.
const DRAWN_FROM_BYTES: usize = 28;
/// Cost per point of the object search, multiply-adds. Its bytes per point cover the cell, the
/// voxel-downsampled copies, three spatial indices and the normal.
const LABELLING: f64 = 4e5;
const LABELLING_BYTES: usize = 448;
/// Cost per point of selection, of the rigid transform and of the result, multiply-adds.
const POINT: f64 = 3e4;
/// Peak bytes per point of either cloud for the correspondences of a Chamfer distance: copies of the
/// cloud and the deformed cloud, a k-d tree, the indices and the flow.
const CORRESPONDENCE_BYTES: usize = 128;
/// Bytes per point of its place in the grid of the linear model, and of its derivatives.
const PLACED_BYTES: usize = 72;
/// Work of the linear model per point and iteration, with the distance query, multiply-adds.
const BLENDED: f64 = 1e4;
/// Work of the local consistency per pair of points, multiply-adds.
const CONSISTENCY: f64 = 20.0;
/// Parameter sets held at once: the network, its transposes, its optimizer and the result (6), and
/// the largest number of gradient chunks (32).
const PARAMETER_SETS: usize = 6 + 32;
/// Copies of the source held at once: selected, aligned, the trainer's, and the flow twice.
const POINT_COPIES: usize = 5;
/// Bytes of the working sets of all threads together, for 28 threads.
const WORKING_SETS: usize = 16 << 20;

/// The predicted memory and work of an estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cost {
    /// Number of source points that take part: finite, within the crop, not excluded as ground and,
    /// for a field, sampled.
    pub source_points: usize,
    /// Number of target points that take part, by the same conditions.
    pub target_points: usize,
    /// Number of bricks of the distance transform; zero for a dense transform and for the object
    /// search.
    pub bricks: usize,
    /// Bytes of the prepared target, its distance transform or the cloud itself; zero for the object
    /// search. Equal to
    /// [`super::FieldSolution::distance_bytes`] of a fit on the CPU without a deadline.
    pub transform_bytes: usize,
    /// Upper bound of the bytes held at once on a CPU with up to 28 threads, without the problem
    /// itself.
    pub bytes: usize,
    /// Work, in multiply-adds of the network. Other work is included as the number of multiply-adds
    /// that take equally long.
    pub multiply_adds: f64,
}

impl Cost {
    /// The predicted duration of the estimate, seconds, on a device that does `rate` multiply-adds
    /// of the network per second. `rate` must be above zero.
    pub fn seconds(&self, rate: f64) -> f64 {
        self.multiply_adds / rate
    }
}

/// The predicted cost that one neighbor sweep adds to the estimate of a pair by an object search.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NeighborCost {
    /// Upper bound of the bytes held for the sweep.
    pub bytes: usize,
    /// Work, in the unit of [`Cost::multiply_adds`].
    pub multiply_adds: f64,
}

/// Predicts the cost that a neighbor sweep of `points` points adds to an object search: its ground
/// segmentation, its registration to the target and its part in the search. The work is a constant
/// plus a term proportional to `points`.
pub fn neighbor_cost(points: usize) -> NeighborCost {
    NeighborCost {
        bytes: points * (2 * size_of::<Point>() + THINNING_BYTES + LABELLING_BYTES),
        multiply_adds: ALIGNING + points as f64 * (THINNING + LABELLING + POINT),
    }
}

/// Predicts the cost of the estimate of `problem` with `options`, without a deadline. Assumes
/// [`FieldOptions::expected_iterations`] iterations for a field.
///
/// Selects the points, with a segmentation of the ground where one is needed, and plans the
/// distance transform. Computes no distances.
///
/// # Errors
/// [`FlowError::NotMetres`], [`FlowError::TooFewPoints`], [`FlowError::NoGroundMask`] or
/// [`FlowError::GroundMaskLength`] for the pair, and [`FlowError::Backend`] if the distance transform is rejected: as
/// [`super::estimate()`]. The ground masks of neighbor sweeps and the limits of a device are not
/// checked.
pub fn predict_cost(problem: &Problem, options: &Options) -> Result<Cost, FlowError> {
    on_one_thread(|| predicted(problem, options))
}

/// Does `work` on one thread. A prediction takes one core from the pairs that are being computed, and
/// no more.
fn on_one_thread<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    match rayon::ThreadPoolBuilder::new().num_threads(1).build() {
        Ok(thread) => thread.install(work),
        Err(_) => work(),
    }
}

/// [`predict_cost`], on the calling thread's pool.
fn predicted(problem: &Problem, options: &Options) -> Result<Cost, FlowError> {
    let selection = select(
        problem,
        [problem.source, problem.target],
        options,
        &find_ground,
    )?;
    let (source_points, target_points) = (selection.source.len(), selection.target.len());
    let method = match &options.method {
        Method::Objects(_) => object_cost(source_points + target_points),
        Method::Field(field) => {
            let [source, target] =
                [&selection.source, &selection.target].map(|cloud| field.seen(cloud));
            let cluster = cluster_points(&selection.source, field);
            field_cost([&source, &target], field, cluster)?
        }
    };
    let registered = selection.registration_clouds.iter().flatten();
    let registered: usize = registered.map(|cloud| cloud.len()).sum();
    let registration = match selection.registration_clouds {
        Some(_) => ALIGNING + registered as f64 * THINNING,
        None => 0.0,
    };
    let unregistered = match registered {
        0 => problem.source.len() + problem.target.len(),
        _ => 0,
    };
    let unsampled = selection.unsampled.iter().flatten();
    let unsampled: usize = unsampled.map(Vec::len).sum();
    let neighbors = problem.nearest_neighbors(options.sweeps());
    let neighbors = neighbors
        .iter()
        .map(|sweep| neighbor_cost(sweep.points.len()));
    let (neighbor_bytes, neighbor_work) = neighbors.fold((0, 0.0), |(bytes, work), neighbor| {
        (bytes + neighbor.bytes, work + neighbor.multiply_adds)
    });
    Ok(Cost {
        source_points,
        target_points,
        bricks: method.bricks,
        transform_bytes: method.transform_bytes,
        bytes: method.bytes
            + (POINT_COPIES * source_points + target_points) * size_of::<Point>()
            + registered * THINNING_BYTES
            + unregistered * OVERLAP_BYTES
            + unsampled * DRAWN_FROM_BYTES
            + neighbor_bytes
            + WORKING_SETS,
        multiply_adds: method.multiply_adds
            + neighbor_work
            + registration
            + (source_points + target_points) as f64 * POINT,
    })
}

/// The part of the cost that depends on the method.
struct MethodCost {
    bricks: usize,
    transform_bytes: usize,
    bytes: usize,
    multiply_adds: f64,
}

/// The object search in `points` points, source and target together.
fn object_cost(points: usize) -> MethodCost {
    MethodCost {
        bricks: 0,
        transform_bytes: 0,
        bytes: PARAMETER_SETS * LAID_OUT * size_of::<f32>() + points * LABELLING_BYTES,
        multiply_adds: points as f64 * LABELLING,
    }
}

/// The preparation of the target, and the fit of a field. `cluster` is as [`cluster_points`] gives it.
fn field_cost(
    clouds: [&[Point]; 2],
    options: &FieldOptions,
    cluster: Option<usize>,
) -> Result<MethodCost, FlowError> {
    let [source, _] = clouds;
    let batch = options.batch.unwrap_or(source.len()).min(source.len());
    let iterations = options.expected_iterations() as f64;
    let mut cost = target_cost(clouds, batch, options, cluster)?;
    if options.consistency_weight > 0.0 {
        let others = cluster.map_or(batch, |points| batch.min(points)) as f64;
        cost.multiply_adds += iterations * batch as f64 * others * CONSISTENCY;
    }
    let mut networks = 1;
    if options.has_cycle() {
        let back = target_cost([source, source], batch, options, cluster)?;
        cost.bytes += back.bytes;
        cost.multiply_adds += back.multiply_adds;
        networks = 2;
    }
    match &options.model {
        ModelOptions::Network(_) => {
            // For the correspondences the flow is computed once more.
            let again = if options.loss.distance().is_some() {
                0.0
            } else {
                batch as f64
            };
            let passes = PASSES * (batch as f64 + STEP_POINTS) + again;
            let passes = iterations * networks as f64 * passes + source.len() as f64;
            cost.bytes += networks * PARAMETER_SETS * LAID_OUT * size_of::<f32>();
            cost.multiply_adds += passes * PARAMETERS as f64;
        }
        ModelOptions::Linear(linear) => {
            let grid = LinearGrid::plan(source, linear);
            let grid = grid.map_err(|error| FlowError::Backend(error.into()))?;
            cost.bytes += grid.bytes() + source.len() * PLACED_BYTES;
            let products = 2.0 * grid.product_work();
            cost.multiply_adds += iterations * (products + batch as f64 * BLENDED);
        }
    }
    Ok(cost)
}

/// Points of the cluster that a point of the source is in, on average: each point is compared with
/// those of its own cluster. None where the source is not partitioned.
fn cluster_points(source: &[Point], options: &FieldOptions) -> Option<usize> {
    let partition = options.partition.as_ref()?;
    let labels = dbscan::clusters(source, partition.radius_m, partition.min_points);
    let members = dbscan::members(&labels);
    let sizes = || members.iter().map(Vec::len);
    let squares: usize = sizes().map(|size| size * size).sum();
    Some(squares / sizes().sum::<usize>().max(1))
}

/// The preparation of a target, and the queries of its distances in all iterations.
fn target_cost(
    [source, target]: [&[Point]; 2],
    batch: usize,
    options: &FieldOptions,
    cluster: Option<usize>,
) -> Result<MethodCost, FlowError> {
    let iterations = options.expected_iterations() as f64;
    Ok(match &options.loss {
        LossOptions::Distance(loss) => {
            let transform = DistanceTransform::predict_cost(source, target, &loss.transform);
            let transform = transform.map_err(|error| FlowError::Backend(error.into()))?;
            MethodCost {
                bricks: transform.bricks,
                transform_bytes: transform.bytes,
                bytes: transform.peak_bytes,
                multiply_adds: transform.multiply_adds,
            }
        }
        LossOptions::Chamfer(loss) => {
            check_chamfer(loss, target).map_err(FlowError::Backend)?;
            let searched = cluster.map_or(target.len(), |points| target.len().min(points));
            MethodCost {
                bricks: 0,
                transform_bytes: size_of_val(target),
                bytes: (batch + target.len()) * CORRESPONDENCE_BYTES,
                multiply_adds: iterations * chamfer_work(loss.search, batch, searched),
            }
        }
    })
}
