//! The CPU backend: vectorized network kernels on all cores. Independent of the GPU backend.

mod backend;
mod kernels;
mod linear;
mod mlp;
mod mlp_cycle;
mod mlp_kernels;
mod model;
mod multiply;
mod nearest;
mod nearest_kernels;
mod product_kernels;
mod profile;
mod tile;
mod trainer;
mod variation;

pub use crate::flow::simd::Isa;
pub use backend::CpuBackend;
pub use profile::{NetworkWorkload, multiply_add_peak};
