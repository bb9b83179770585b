//! The kernels' sources and compute pipelines.

use super::health::Watchdog;
use crate::flow::field::BackendError;

macro_rules! source {
    ($($file:literal),+) => {
        concat!($(include_str!(concat!("shaders/", $file, ".wgsl")), "\n"),+)
    };
}

/// Entry point and source of each single-precision kernel.
pub(super) const SOURCES: [(&str, &str); 18] = [
    ("bricks", source!("bricks")),
    (
        "sample_points",
        source!("common", "arithmetic", "distance", "sample"),
    ),
    ("forward", source!("common", "forward")),
    (
        "distance_loss",
        source!(
            "common",
            "arithmetic",
            "tree_sum",
            "distance",
            "distance_loss"
        ),
    ),
    ("deform", source!("common", "deform")),
    ("nearest", source!("common", "points", "nearest")),
    (
        "chamfer_loss",
        source!("common", "arithmetic", "tree_sum", "points", "chamfer_loss"),
    ),
    ("contract", source!("common", "contract")),
    (
        "variation",
        source!("common", "arithmetic", "tree_sum", "grid", "variation"),
    ),
    (
        "reduce_variation",
        source!(
            "common",
            "arithmetic",
            "tree_sum",
            "grid",
            "reduce_variation"
        ),
    ),
    ("blend", source!("common", "arithmetic", "grid", "blend")),
    (
        "vertex_gradients",
        source!("common", "arithmetic", "grid", "vertex_gradients"),
    ),
    ("backward", source!("common", "backward")),
    ("gradients", source!("common", "gradients")),
    (
        "reduce_loss",
        source!("common", "arithmetic", "tree_sum", "reduce_loss"),
    ),
    ("step", source!("common", "arithmetic", "step")),
    ("transpose", source!("common", "transpose")),
    ("multiply_adds", source!("multiply_adds")),
];

/// Entry point and source of the kernel that fits planes to the points of an object search.
pub(super) const NORMALS_SOURCE: (&str, &str) = (
    "find_normals",
    source!("objects/records", "objects/index", "objects/normals"),
);

/// Entry point and source of the kernel that searches clusters.
pub(super) const CLUSTER_SOURCE: (&str, &str) = (
    "search_clusters",
    source!(
        "objects/records",
        "objects/index",
        "objects/measure",
        "objects/votes",
        "objects/state",
        "objects/fit",
        "objects/evidence",
        "objects/stages",
        "objects/search"
    ),
);

macro_rules! half_sources {
    ($tile:literal) => {
        [
            ("halve", source!($tile, "common", "matrix", "halve")),
            (
                "forward_half",
                source!($tile, "common", "matrix", "product", "forward_half"),
            ),
            (
                "backward_half",
                source!($tile, "common", "matrix", "product", "backward_half"),
            ),
            (
                "gradients_half",
                source!($tile, "common", "matrix", "gradients_half"),
            ),
        ]
    };
}

/// The half-precision kernels, for matrix units with tiles of 8 x 8 and of 16 x 16.
pub(super) const HALF_SOURCES: [[(&str, &str); 4]; 2] =
    [half_sources!("tile8"), half_sources!("tile16")];

/// The pipelines of all kernels except those of half precision.
#[derive(Debug)]
pub(super) struct Kernels {
    pub(super) bricks: wgpu::ComputePipeline,
    pub(super) sample: wgpu::ComputePipeline,
    pub(super) forward: wgpu::ComputePipeline,
    /// [`Self::forward`] with the kept parameters and without storing activations.
    pub(super) evaluate: wgpu::ComputePipeline,
    pub(super) distance_loss: wgpu::ComputePipeline,
    pub(super) deform: wgpu::ComputePipeline,
    pub(super) nearest: wgpu::ComputePipeline,
    pub(super) chamfer_loss: wgpu::ComputePipeline,
    /// The linear model's kernels.
    pub(super) linear: LinearKernels,
    pub(super) backward: wgpu::ComputePipeline,
    pub(super) gradients: wgpu::ComputePipeline,
    pub(super) reduce_loss: wgpu::ComputePipeline,
    pub(super) step: wgpu::ComputePipeline,
    pub(super) transpose: wgpu::ComputePipeline,
    /// Measures the GPU's peak arithmetic throughput.
    pub(super) multiply_adds: wgpu::ComputePipeline,
}

impl Kernels {
    /// Builds all pipelines.
    ///
    /// # Errors
    /// [`BackendError::Lost`] if the driver rejects one.
    pub(super) fn new(device: &wgpu::Device, watchdog: &Watchdog) -> Result<Self, BackendError> {
        let pipeline =
            |name: &str, constants: &[(&str, f64)]| pipeline(device, &SOURCES, name, constants);
        let kernels = Self {
            bricks: pipeline("bricks", &[]),
            sample: pipeline("sample_points", &[]),
            forward: pipeline("forward", &[]),
            evaluate: pipeline("forward", &[("EVALUATES", 1.0)]),
            distance_loss: pipeline("distance_loss", &[]),
            deform: pipeline("deform", &[]),
            nearest: pipeline("nearest", &[]),
            chamfer_loss: pipeline("chamfer_loss", &[]),
            linear: LinearKernels {
                contract: pipeline("contract", &[]),
                variation: pipeline("variation", &[]),
                reduce_variation: pipeline("reduce_variation", &[]),
                blend: pipeline("blend", &[]),
                vertex_gradients: pipeline("vertex_gradients", &[]),
            },
            backward: pipeline("backward", &[]),
            gradients: pipeline("gradients", &[]),
            reduce_loss: pipeline("reduce_loss", &[]),
            step: pipeline("step", &[]),
            transpose: pipeline("transpose", &[]),
            multiply_adds: pipeline("multiply_adds", &[]),
        };
        watchdog.check()?;
        Ok(kernels)
    }
}

/// The pipelines of the linear model.
#[derive(Debug)]
pub(super) struct LinearKernels {
    pub(super) contract: wgpu::ComputePipeline,
    pub(super) variation: wgpu::ComputePipeline,
    pub(super) reduce_variation: wgpu::ComputePipeline,
    pub(super) blend: wgpu::ComputePipeline,
    pub(super) vertex_gradients: wgpu::ComputePipeline,
}

/// The half-precision pipelines.
#[derive(Debug)]
pub(super) struct HalfKernels {
    pub(super) halve: wgpu::ComputePipeline,
    pub(super) forward: wgpu::ComputePipeline,
    pub(super) backward: wgpu::ComputePipeline,
    /// Gradients of the middle layers.
    pub(super) gradients: wgpu::ComputePipeline,
    /// Gradients of the first and the last layer, in single precision.
    pub(super) outer_gradients: wgpu::ComputePipeline,
}

impl HalfKernels {
    /// Builds the pipelines from one of [`HALF_SOURCES`].
    ///
    /// # Errors
    /// [`BackendError::Device`] if the driver rejects one.
    pub(super) fn new(
        device: &wgpu::Device,
        sources: &[(&str, &str)],
    ) -> Result<Self, BackendError> {
        // If the driver rejects a pipeline, only half precision is unavailable; the GPU remains
        // usable.
        let internal = device.push_error_scope(wgpu::ErrorFilter::Internal);
        let invalid = device.push_error_scope(wgpu::ErrorFilter::Validation);
        let half = |name: &str| pipeline(device, sources, name, &[]);
        let kernels = Self {
            halve: half("halve"),
            forward: half("forward_half"),
            backward: half("backward_half"),
            gradients: half("gradients_half"),
            outer_gradients: pipeline(device, &SOURCES, "gradients", &[("OUTER", 1.0)]),
        };
        let invalid = pollster::block_on(invalid.pop());
        let internal = pollster::block_on(internal.pop());
        match invalid.or(internal) {
            None => Ok(kernels),
            Some(error) => Err(BackendError::Device(error.to_string())),
        }
    }
}

/// Compiles a kernel. Accesses to memory are checked, and loops are not counted: a counter of
/// iterations keeps drivers from unrolling a loop, and arrays that should be registers then lie in
/// memory.
#[expect(
    unsafe_code,
    reason = "wgpu requires it for loops that are not counted"
)]
fn module(device: &wgpu::Device, entry: &str, text: &str) -> wgpu::ShaderModule {
    let description = wgpu::ShaderModuleDescriptor {
        label: Some(entry),
        source: wgpu::ShaderSource::Wgsl(text.into()),
    };
    let checks = wgpu::ShaderRuntimeChecks {
        force_loop_bounding: false,
        ..wgpu::ShaderRuntimeChecks::checked()
    };
    // SAFETY: the caller must ensure that no loop is infinite. The sources are those of this folder.
    // Their loops count up to a number that is fixed or read once, or walk over a table that is half
    // full at most.
    unsafe { device.create_shader_module_trusted(description, checks) }
}

/// Builds the pipeline of the kernel `name`.
pub(super) fn pipeline(
    device: &wgpu::Device,
    sources: &[(&str, &str)],
    name: &str,
    constants: &[(&str, f64)],
) -> wgpu::ComputePipeline {
    let text = sources.iter().find(|(entry, _)| *entry == name);
    let (entry, text) = text.unwrap_or(&sources[0]);
    let module = module(device, entry, text);
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(entry),
        layout: None,
        module: &module,
        entry_point: Some(entry),
        compilation_options: wgpu::PipelineCompilationOptions {
            constants,
            zero_initialize_workgroup_memory: false,
        },
        cache: None,
    })
}
