//! Spatial indices and point-set geometry: column index, DBSCAN, plane fit and voxel downsampling.

mod column_index;
pub(crate) mod dbscan;
mod plane;
mod voxel;

pub(crate) use column_index::ColumnIndex;
pub(crate) use dbscan::NOISE;
pub(crate) use plane::{Neighborhood, PlaneFit};
pub(crate) use voxel::{REACH, voxel_first, voxel_mean};
