//! The kernels: their sources and their pipelines. Knows neither what they compute nor on what.

use super::backend::Watchdog;
use crate::flow::field::BackendError;

macro_rules! source {
    ($($file:literal),+) => {
        concat!($(include_str!(concat!("shaders/", $file, ".wgsl")), "\n"),+)
    };
}

/// Each kernel's entry point and source.
pub(super) const SOURCES: [(&str, &str); 10] = [
    ("bricks", source!("bricks")),
    (
        "sample_points",
        source!("common", "arithmetic", "distance", "sample"),
    ),
    ("forward", source!("common", "forward")),
    (
        "query",
        source!("common", "arithmetic", "distance", "query"),
    ),
    ("backward", source!("common", "backward")),
    ("gradients", source!("common", "gradients")),
    ("judge", source!("common", "arithmetic", "judge")),
    ("step", source!("common", "arithmetic", "step")),
    ("transpose", source!("common", "transpose")),
    ("multiply_adds", source!("multiply_adds")),
];

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

/// The kernels of half precision, for matrix units whose tiles are 8 and 16 to a side.
pub(super) const HALF_SOURCES: [[(&str, &str); 4]; 2] =
    [half_sources!("tile8"), half_sources!("tile16")];

/// The pipelines of all kernels but those of half precision.
#[derive(Debug)]
pub(super) struct Kernels {
    pub(super) bricks: wgpu::ComputePipeline,
    pub(super) sample: wgpu::ComputePipeline,
    pub(super) forward: wgpu::ComputePipeline,
    /// [`Self::forward`] with the kept network, remembering nothing.
    pub(super) evaluate: wgpu::ComputePipeline,
    pub(super) query: wgpu::ComputePipeline,
    pub(super) backward: wgpu::ComputePipeline,
    pub(super) gradients: wgpu::ComputePipeline,
    pub(super) judge: wgpu::ComputePipeline,
    pub(super) step: wgpu::ComputePipeline,
    pub(super) transpose: wgpu::ComputePipeline,
    /// The device's arithmetic peak, for measurements.
    pub(super) multiply_adds: wgpu::ComputePipeline,
}

impl Kernels {
    /// Builds all pipelines.
    ///
    /// # Errors
    /// [`BackendError::Device`] where the driver refuses one.
    pub(super) fn new(device: &wgpu::Device, watchdog: &Watchdog) -> Result<Self, BackendError> {
        let pipeline =
            |name: &str, constants: &[(&str, f64)]| pipeline(device, &SOURCES, name, constants);
        let kernels = Self {
            bricks: pipeline("bricks", &[]),
            sample: pipeline("sample_points", &[]),
            forward: pipeline("forward", &[]),
            evaluate: pipeline("forward", &[("EVALUATES", 1.0)]),
            query: pipeline("query", &[]),
            backward: pipeline("backward", &[]),
            gradients: pipeline("gradients", &[]),
            judge: pipeline("judge", &[]),
            step: pipeline("step", &[]),
            transpose: pipeline("transpose", &[]),
            multiply_adds: pipeline("multiply_adds", &[]),
        };
        watchdog.check()?;
        Ok(kernels)
    }
}

/// The pipelines of half precision.
#[derive(Debug)]
pub(super) struct HalfKernels {
    pub(super) halve: wgpu::ComputePipeline,
    pub(super) forward: wgpu::ComputePipeline,
    pub(super) backward: wgpu::ComputePipeline,
    /// The middle layers'.
    pub(super) gradients: wgpu::ComputePipeline,
    /// Those of the first layer and the last, in single precision.
    pub(super) outer_gradients: wgpu::ComputePipeline,
}

impl HalfKernels {
    /// Builds the pipelines from one of [`HALF_SOURCES`].
    ///
    /// # Errors
    /// [`BackendError::Device`] where the driver refuses one.
    pub(super) fn new(
        device: &wgpu::Device,
        sources: &[(&str, &str)],
    ) -> Result<Self, BackendError> {
        // A driver's refusal costs half precision, not the card.
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

/// The pipeline of the kernel of this name.
fn pipeline(
    device: &wgpu::Device,
    sources: &[(&str, &str)],
    name: &str,
    constants: &[(&str, f64)],
) -> wgpu::ComputePipeline {
    let text = sources.iter().find(|(entry, _)| *entry == name);
    let (entry, text) = text.unwrap_or(&sources[0]);
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some(entry),
        source: wgpu::ShaderSource::Wgsl((*text).into()),
    });
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
