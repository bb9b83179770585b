//! The numerics as a whole, on simulated streets and on real pairs with ground truth.
//!
//! Real pairs are read from the folder that `FNSF_REAL_DATA` names; without it those tests say so
//! and pass. They never are part of the project.

mod accuracy;
mod deadlines;
mod depth;
mod ego;
mod frames;
mod gpu;
#[path = "../common/gpu.rs"]
mod gpu_rule;
mod ground;
mod labels;
mod prices;
mod resumption;
mod scenes;
mod sequences;
