//! Drives of data sets, found by how their files lie.

mod dataset;
mod find;
mod folders;
mod nuscenes;

pub use dataset::{Dataset, DatasetError};
pub(super) use find::drives_of;
