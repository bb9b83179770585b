//! The CPU backend: vectorized network kernels on all cores. Independent of the GPU backend.

mod backend;
mod isa;
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
mod simd;
mod tile;
mod trainer;
mod variation;

pub use backend::CpuBackend;
pub use isa::Isa;
pub use profile::{NetworkWorkload, multiply_add_peak};
