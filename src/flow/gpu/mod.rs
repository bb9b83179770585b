//! The GPU backend: the kernels of the field fit in WGSL, on any GPU that wgpu supports.
//!
//! Independent of the CPU backend; no type of wgpu is public. A [`Gpu`] is one opened GPU. It is
//! cheap to clone, and each clone can fit its own pair from its own thread. Pairs that are fitted, or
//! searched for objects, at the same time share the GPU's submissions.

mod adapter;
mod allocation;
mod allocator;
mod backend;
mod batcher;
mod buffers;
mod chamfer;
mod chamfer_phases;
mod cluster_search;
mod context;
mod device;
mod distance;
mod half;
mod health;
mod inference;
mod iteration;
mod layout;
mod linear;
mod loss;
mod matrix_units;
mod memory;
mod network;
mod network_phases;
mod phase;
mod pipelines;
mod profile;
mod program;
mod request;
mod self_test;
mod sharing;
#[cfg(test)]
mod tests;
mod tiling;
mod trainer;
mod upload;

pub use adapter::{Adapter, AdapterKind, Selector, adapters, select};
pub use backend::Gpu;
pub use memory::{GpuOptions, LANE_NETWORK_BYTES};
pub use profile::{KernelTime, arithmetic_peak, kernel_times};
