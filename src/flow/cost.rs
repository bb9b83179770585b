//! What an estimate will take, known before anything is accepted: memory and work.
//!
//! Refuses what [`super::estimate()`] would refuse, for a hundredth of its time and without its
//! memory. Work is counted in multiply-adds of the network; what is not one is counted as the
//! multiply-adds that take as long on a CPU. Knows no device and no time: a rate turns work into
//! seconds.

use super::data::Point;
use super::distance::{DistanceTransform, TransformPrice};
use super::error::FlowError;
use super::field::{LAID_OUT, PARAMETERS};
use super::options::Options;
use super::registration::neighbors;
use super::select;
use super::select::Problem;

/// Passes over the network that an iteration takes a point: forward, and twice that backward.
const PASSES: f64 = 3.0;
/// An iteration's steps beside its points (gradients added, Adam, transposes), in points.
const STEP_POINTS: f64 = 150.0;
/// Multiply-adds that take as long as aligning whatever the number of points: nine coarse fits, and
/// a fine one of 8,192 points.
const ALIGNING: f64 = 4e9;
/// Multiply-adds that take as long as thinning a point for that, and its share of the surfels.
const THINNING: f64 = 2e4;
/// Bytes that are held for a point while it is: itself and a copy that is remembered, its voxel and
/// its surfels, at most.
const THINNING_BYTES: usize = 96;
/// Multiply-adds that take as long as a point's share of the search for movers, and the bytes that
/// are held for it: its cell, its thinned copies, three indices by place, its normal.
const LABELLING: f64 = 4e5;
const LABELLING_BYTES: usize = 448;
/// Multiply-adds that take as long as selecting and moving a point and its results.
const POINT: f64 = 3e4;
/// Sets of parameters that are held at once: of the network, its transposes, its optimizer, the
/// result, and the most chunks of gradients.
const PARAMETER_SETS: usize = 6 + 32;
/// Copies of the source that are held at once: selected, aligned, the trainer's, flow twice.
const POINT_COPIES: usize = 5;
/// Working sets, one a thread, bytes in all: 28 threads.
const WORKING_SETS: usize = 16 << 20;

/// What an estimate will take.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cost {
    /// Source points that take part.
    pub source_points: usize,
    /// Target points that take part.
    pub target_points: usize,
    /// Bricks of the distance transform; none of a dense one.
    pub bricks: usize,
    /// Bytes of the distance transform: what [`super::Estimate::distance_bytes`] will be.
    pub transform_bytes: usize,
    /// At most the bytes that are held at once on the device, but for the problem itself.
    pub bytes: usize,
    /// Work: multiply-adds of the network, and what takes as long as so many.
    pub multiply_adds: f64,
}

impl Cost {
    /// Seconds on a device that does `rate` multiply-adds a second.
    pub fn seconds(&self, rate: f64) -> f64 {
        self.multiply_adds / rate
    }
}

/// What one more sweep around a pair adds to its price.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NeighborCost {
    /// At most the bytes that are held for it.
    pub bytes: usize,
    /// Work, as [`Cost::multiply_adds`].
    pub multiply_adds: f64,
}

/// Prices a sweep of so many points around a pair.
pub fn neighbor_cost(points: usize) -> NeighborCost {
    NeighborCost {
        bytes: points * (2 * size_of::<Point>() + THINNING_BYTES + LABELLING_BYTES),
        multiply_adds: ALIGNING + points as f64 * (THINNING + LABELLING + POINT),
    }
}

/// Prices the estimate of `problem` by `options`, with as many iterations as
/// [`Options::expected_iterations`].
///
/// # Errors
/// [`FlowError`] where [`super::estimate()`] would refuse the input.
pub fn price(problem: &Problem, options: &Options) -> Result<Cost, FlowError> {
    let selection = select::select(problem, options, &select::find_ground)?;
    let (source_points, target_points) = (selection.source.len(), selection.target.len());
    let clouds = [&selection.source, &selection.target];
    let transform = match options.label {
        None => DistanceTransform::price(clouds[0], clouds[1], &options.distance)
            .map_err(|error| FlowError::Backend(error.into()))?,
        Some(_) => TransformPrice::default(),
    };
    let batch = options.batch.unwrap_or(source_points).min(source_points) as f64;
    let iterations = options.expected_iterations() as f64;
    let passes = match options.label {
        None => iterations * PASSES * (batch + STEP_POINTS) + source_points as f64,
        Some(_) => 0.0,
    };
    let labelled = options
        .label
        .as_ref()
        .map_or(0, |_| source_points + target_points);
    let aligned = selection
        .registration_clouds
        .map(|clouds| clouds.map(|points| points.len()));
    let aligned = aligned.map(|[source, target]| source + target);
    let aligning = aligned.map_or(0.0, |points| ALIGNING + points as f64 * THINNING);
    let points = (source_points + target_points) as f64 * POINT;
    let around = neighbors::nearest(problem, options.frames()).into_iter();
    let around = around.map(|sweep| neighbor_cost(sweep.points.len()));
    let (around_bytes, around_work) = around.fold((0, 0.0), |(bytes, work), around| {
        (bytes + around.bytes, work + around.multiply_adds)
    });
    Ok(Cost {
        source_points,
        target_points,
        bricks: transform.bricks,
        transform_bytes: transform.bytes,
        bytes: transform.peak_bytes
            + PARAMETER_SETS * LAID_OUT * size_of::<f32>()
            + (POINT_COPIES * source_points + target_points) * size_of::<Point>()
            + aligned.unwrap_or(0) * THINNING_BYTES
            + labelled * LABELLING_BYTES
            + around_bytes
            + WORKING_SETS,
        multiply_adds: transform.multiply_adds
            + passes * PARAMETERS as f64
            + labelled as f64 * LABELLING
            + around_work
            + aligning
            + points,
    })
}
