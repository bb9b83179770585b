//! The GPU backend: the solver's kernels in WGSL, on any card that wgpu reaches.
//!
//! Knows nothing of the CPU backend; no type of wgpu leaves this folder. One [`Gpu`] is one opened
//! card: it is cheap to clone, every clone may fit a pair of its own from a thread of its own, and
//! pairs that are fitted at the same time share the card's submissions.

// The card.
mod adapter;
mod device;
mod memory;
mod words;

// The kernels, and what they share with the host.
mod kernels;
mod matrix;
mod phases;
mod plan;
mod records;
mod self_test;

// A pair on the card.
mod batch;
mod evaluate;
mod trainer;
mod transform;
mod workload;

#[cfg(test)]
mod tests;

pub use adapter::{Adapter, AdapterKind, Selector, adapters, select};
pub use device::{Gpu, GpuOptions};
pub use memory::LANE_NETWORK_BYTES;
pub use workload::{KernelTime, arithmetic_peak, kernel_times};
