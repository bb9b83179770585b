//! Tests of the GPU backend against the double-precision reference and the CPU backend.
//!
//! They need an adapter; a software adapter suffices.

mod chamfer;
mod failures;
mod half;
mod kernels;
mod objects;
mod shaders;
mod upload;
mod whole;

use std::sync::OnceLock;

use super::adapter::adapters;
use super::backend::Gpu;
use super::memory::GpuOptions;
use crate::flow::data::{Point, Random};
use crate::flow::options::{DistanceLossOptions, FieldOptions, Preset};
use crate::gpu_in_tests;

/// Number of lanes that a test fills.
const LANES: usize = 4;
/// Number of lanes of the shared GPU: those that all tests fill at the same time on many cores.
const SHARED_LANES: usize = 64;

/// Opens the first adapter for one test; none if the machine has none.
fn opened(options: &GpuOptions) -> Option<Gpu> {
    let adapters = adapters();
    gpu_in_tests::is_there(adapters.len())
        .then(|| Gpu::open(&adapters[0], options).expect("the card opens"))
}

/// The loss of `options`, which is one by distance transform.
fn distance_loss(options: &FieldOptions) -> &DistanceLossOptions {
    options.loss.distance().expect("a distance transform")
}

/// The presets that fit a network to a distance transform.
fn with_network_and_transform() -> impl Iterator<Item = Preset> {
    Preset::with_gpu_kernels().filter(|preset| {
        let options = preset.field();
        options.network().is_some() && options.loss.distance().is_some()
    })
}

/// The GPU shared by the tests that leave it intact. It searches clusters, also where it is a software
/// device.
pub(super) fn shared() -> Option<&'static Gpu> {
    static SHARED: OnceLock<Option<Gpu>> = OnceLock::new();
    let options = GpuOptions {
        lanes: SHARED_LANES,
        cluster_threads: Some(usize::MAX),
        ..GpuOptions::default()
    };
    SHARED.get_or_init(|| opened(&options)).as_ref()
}

/// A wall with a box in front of it, and the same moved by 0.22 m. The points avoid the faces of
/// the grid's cells, where rounding decides which side's gradient is sampled.
fn clouds(points: usize) -> [Vec<Point>; 2] {
    let mut random = Random::new(5);
    let mut across = |width: f64| random.uniform(-width, width) as f32;
    let source: Vec<Point> = (0..points)
        .map(|i| match i % 3 {
            0 => [4.03, across(1.0), across(1.0)],
            _ => [8.07, across(6.0), across(2.0)],
        })
        .collect();
    let moved = |p: &Point| [p[0] + 0.1, p[1] + 0.2, p[2]];
    let target = source.iter().map(moved).collect();
    [source, target]
}

/// `count` points, uniform in a box of half the sides `spread`, metres.
fn scattered(count: usize, spread: [f64; 3], seed: u64) -> Vec<Point> {
    let mut random = Random::new(seed);
    let mut point = || spread.map(|side| random.uniform(-side, side) as f32);
    (0..count).map(|_| point()).collect()
}
