//! Tests of the numerics as a whole, on simulated streets and on real pairs with ground truth.
//!
//! Real pairs are read from the folder `FNSF_REAL_DATA`. They are not part of the project. Without
//! the folder their tests print a message and pass, or fail where `FNSF_REQUIRE_REAL_DATA` is `1`.

mod accuracy;
mod costs;
mod deadlines;
mod depth;
mod deskew;
mod ego;
mod gpu;
#[path = "../common/gpu.rs"]
mod gpu_rule;
mod ground;
mod labels;
mod overlap;
// cfg(test) is always set in this crate. It makes clippy treat the module as a test.
#[cfg(test)]
#[path = "../common/real_data.rs"]
mod real_data;
mod resumption;
mod scenes;
mod sequences;
mod sweeps;
mod tracks;
