//! Spatial indices and point-set geometry: column index, DBSCAN, plane fit and voxel downsampling.

mod column_index;
mod column_kernels;
pub(crate) mod dbscan;
mod index_words;
mod key_table;
mod neighborhood;
mod plane;
mod slots;
mod tiles;
mod voxel;

pub(crate) use column_index::{ColumnIndex, SlotLabels};
pub(crate) use column_kernels::around;
pub(crate) use dbscan::NOISE;
pub(crate) use index_words::IndexRecord;
pub(crate) use plane::PlaneFit;
#[cfg(test)]
pub(crate) use plane::constants_of_planes;
pub(crate) use voxel::{voxel_first, voxel_mean};
