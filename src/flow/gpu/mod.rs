//! The GPU backend: the solver's kernels in WGSL, on any card that wgpu reaches.
//!
//! Knows nothing of the CPU backend; no type of wgpu leaves this folder. One [`Gpu`] is one opened
//! card: it is cheap to clone, every clone may fit a pair of its own from a thread of its own, and
//! pairs that are fitted at the same time share the card's submissions.

mod adapter;
mod allocator;
mod backend;
mod batcher;
mod distance;
mod half;
mod inference;
mod iteration;
mod layout;
mod memory;
mod pipelines;
mod profile;
mod self_test;
#[cfg(test)]
mod tests;
mod tiling;
mod trainer;

pub use adapter::{Adapter, AdapterKind, Selector, adapters, select};
pub use backend::{Gpu, GpuOptions};
pub use memory::LANE_NETWORK_BYTES;
pub use profile::{KernelTime, arithmetic_peak, kernel_times};
