//! Self-test of a device: a small synthetic pair with known flow, solved before any job runs on it.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use super::panics::message;
use super::types::{DeviceFactory, Opened};
use crate::flow::cpu::CpuBackend;
use crate::flow::field::Backend;
use crate::flow::{self, Ego, FlowError, Point, Preset, Problem, Uncontrolled, largest};

/// Translation of the scene (a wall and a post in front of it) between source and target, metres.
const MOTION: [f32; 3] = [0.2, 0.1, 0.0];

/// Tolerance of the mean end-point error, metres. It is half the error of zero flow, and wide
/// enough for the few iterations of the self-test.
const TOLERANCE: f32 = 0.11;

/// Iterations of the self-test.
const ITERATIONS: usize = 12;

/// Iterations of the methods that are compared with the CPU, enough to run every kernel more than
/// once. Rounding sets them apart by less than a millimetre.
const COMPARED_ITERATIONS: usize = 3;
/// Tolerance of the largest difference, metres.
const COMPARED_TOLERANCE: f32 = 0.01;

/// Why a self-test failed.
#[derive(Debug, thiserror::Error)]
pub(super) enum SelfTestError {
    #[error("it failed its self-test: {0}")]
    Failed(#[from] FlowError),
    #[error("it failed its self-test: its flow is off by {0} m")]
    Off(f32),
    #[error("it failed its self-test: its flow with preset {0} is off by {1} m")]
    Differs(&'static str, f32),
    #[error("{0}")]
    Panicked(String),
}

impl SelfTestError {
    /// Whether the self-test only lacked memory beside other pairs. This is no evidence against the
    /// device.
    pub(super) fn is_out_of_memory(&self) -> bool {
        matches!(self, Self::Failed(FlowError::Backend(error)) if error.is_out_of_memory())
    }
}

/// Opens a device and runs the self-test. A panic counts as a failure.
pub(super) fn opened(open: &DeviceFactory) -> Result<Arc<dyn Opened>, String> {
    let opening = catch_unwind(AssertUnwindSafe(|| {
        let opened = open().map_err(|error| error.to_string())?;
        run(opened.lane().as_ref()).map_err(|error| error.to_string())?;
        Ok(Arc::from(opened))
    }));
    opening.unwrap_or_else(|panic| Err(message(panic.as_ref())))
}

/// Solves the test pair and compares the result with the known flow.
pub(super) fn run(backend: &dyn Backend) -> Result<(), SelfTestError> {
    catch_unwind(AssertUnwindSafe(|| compared(backend)))
        .unwrap_or_else(|panic| Err(SelfTestError::Panicked(message(panic.as_ref()))))
}

fn compared(backend: &dyn Backend) -> Result<(), SelfTestError> {
    let mut source = Vec::new();
    for row in 0..40u8 {
        for column in 0..40u8 {
            let (y, z) = (f32::from(row) * 0.25 - 5.0, f32::from(column) * 0.1 - 2.0);
            source.push([8.0 + 0.3 * (y * 1.3).sin(), y, z]);
            source.push([4.0 + z * 0.2, 0.02 * f32::from(column), y * 0.4]);
            source.push([y, 6.0 + 0.2 * (z * 2.0).cos(), z]);
        }
    }
    let target: Vec<_> = source
        .iter()
        .map(|point| core::array::from_fn(|axis| point[axis] + MOTION[axis]))
        .collect();
    let problem = Problem::pair(&source, &target);
    let mut options = Preset::Neural.options(None);
    if let Some(field) = options.field_mut() {
        field.max_iterations = ITERATIONS;
    }
    let estimate = flow::estimate(backend, &problem, &options, &Uncontrolled)?;
    let mut error = 0.0;
    for flow in &estimate.flow {
        let square: f32 = (0..3).map(|axis| (flow[axis] - MOTION[axis]).powi(2)).sum();
        error += square.sqrt() / source.len() as f32;
    }
    if !(error.is_finite() && error < TOLERANCE) {
        return Err(SelfTestError::Off(error));
    }
    if backend.is_cpu() {
        return Ok(());
    }
    let searched = backend.searches_clusters().then_some(Preset::Default);
    [Preset::NsfpBaseline, Preset::NsfpLinear]
        .into_iter()
        .chain(searched)
        .try_for_each(|preset| compared_with_the_cpu(backend, preset, [&source, &target]))
}

/// Compares a preset with the CPU: a few iterations of a field, which are too few to find a motion, or
/// the search of clusters.
fn compared_with_the_cpu(
    backend: &dyn Backend,
    preset: Preset,
    clouds: [&[Point]; 2],
) -> Result<(), SelfTestError> {
    let [source, target] = clouds;
    let problem = Problem::pair(source, target);
    let mut options = preset.options(None);
    if let Some(field) = options.field_mut() {
        field.max_iterations = COMPARED_ITERATIONS;
    } else {
        // All clusters move.
        options.ego = Ego::Off;
    }
    let flow_on = |device: &dyn Backend| {
        let estimate = flow::estimate(device, &problem, &options, &Uncontrolled)?;
        Ok::<_, FlowError>(estimate.flow)
    };
    let cpu = CpuBackend::new(Some(1)).map_err(FlowError::from)?;
    let (found, expected) = (flow_on(backend)?, flow_on(&cpu)?);
    let axes = found.iter().flatten().zip(expected.iter().flatten());
    let largest = largest(axes.map(|(found, expected)| (found - expected).abs()));
    if largest <= COMPARED_TOLERANCE {
        Ok(())
    } else {
        Err(SelfTestError::Differs(preset.name(), largest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cpu_passes_its_trial() {
        let backend = CpuBackend::new(Some(1)).expect("threads");
        run(&backend).expect("it passes");
    }
}
