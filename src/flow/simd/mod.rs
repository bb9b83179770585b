//! Vector registers and instruction sets: what the kernels of the CPU backend and of the spatial
//! index are written in.

mod isa;
mod lanes;

pub use isa::Isa;
pub(in crate::flow) use lanes::{F32x4, Lanes};
#[cfg(target_arch = "x86_64")]
pub(in crate::flow) use lanes::{F32x8, F32x16};
