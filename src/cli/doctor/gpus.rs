//! The GPU part of `fnsf doctor`: the properties of each GPU, the one that `auto` selects, and
//! whether it estimates a test pair correctly.

use std::time::Instant;

use super::missing::Environment;
use crate::cli::device::{best_card, software_is_welcome};
use crate::cli::failure::Failure;
use crate::cli::output::show;
use crate::engine::self_test_backend;
use crate::flow::Preset;
use crate::flow::gpu;
use crate::flow::gpu::{Adapter, AdapterKind, Gpu, GpuOptions};

/// Prints the report on all GPUs.
pub(super) fn report() -> Result<(), Failure> {
    let adapters = gpu::adapters();
    if adapters.is_empty() {
        show(format_args!("gpu: none found"))?;
    }
    let taken = best_card().ok();
    for adapter in &adapters {
        let taken = taken.as_ref().filter(|taken| taken.index == adapter.index);
        describe(adapter, taken.is_some())?;
        if let Some(taken) = taken {
            show(format_args!("  {}", tried(taken)))?;
        }
    }
    if taken.is_none() {
        show(format_args!("  auto takes the CPU"))?;
    }
    let presets: Vec<_> = Preset::with_gpu_kernels().map(Preset::name).collect();
    show(format_args!(
        "  a GPU computes presets {}; all other presets run on the CPU",
        presets.join(", ")
    ))?;
    let hardware = |adapter: &&Adapter| adapter.kind != AdapterKind::Software;
    let found = Environment::here(adapters.iter().filter(hardware).count(), adapters.len());
    for advice in found.advice() {
        show(format_args!("  {advice}"))?;
    }
    if taken.is_none() && !adapters.is_empty() && !software_is_welcome() {
        show(format_args!(
            "  software is taken by its number alone, or for tests with FNSF_ALLOW_SOFTWARE_GPU=1"
        ))?;
    }
    Ok(())
}

fn describe(adapter: &Adapter, taken: bool) -> Result<(), Failure> {
    let taken = if taken { ", taken by auto" } else { "" };
    let pci_id = match adapter.pci_id.as_str() {
        "" => String::new(),
        pci_id => format!(", {pci_id}"),
    };
    show(format_args!(
        "gpu:{}: {} ({}{pci_id}){taken}",
        adapter.index,
        adapter.name,
        adapter.kind.name(),
    ))?;
    show(format_args!(
        "  {}, driver {}",
        adapter.interface, adapter.driver
    ))?;
    show(format_args!(
        "  largest buffer {:.1} GB, workgroup memory {} KiB",
        adapter.max_binding_bytes as f64 / 1e9,
        adapter.workgroup_bytes >> 10
    ))?;
    match adapter.matrix_tiles.as_slice() {
        [] => show(format_args!("  no matrix units that this program can use")),
        tiles => show(format_args!("  matrix units: {}", tiles.join(", "))),
    }
}

/// Opens the GPU and estimates the test pair on it. Returns the outcome as text.
fn tried(adapter: &Adapter) -> String {
    let opening = Instant::now();
    let opened = match Gpu::open(adapter, &GpuOptions::default()) {
        Ok(opened) => opened,
        Err(error) => return format!("cannot be opened: {error}"),
    };
    let opening = opening.elapsed().as_secs_f64();
    let trial = Instant::now();
    let passed = match self_test_backend(&opened) {
        Ok(()) => format!(
            "opened in {opening:.1} s, passed its self-test in {:.2} s",
            trial.elapsed().as_secs_f64()
        ),
        Err(reason) => return format!("opened in {opening:.1} s, but {reason}"),
    };
    match opened.matrix_units() {
        Ok(tile) => format!("{passed}; precision f16 by {tile}"),
        Err(reason) => format!("{passed}; no precision f16: {reason}"),
    }
}
