//! What a device needs that fills and samples bricks itself: their plan, and what they are filled
//! from. The layout of [`super::Bricks`] is the one to mirror.

pub(crate) use super::activate::{ABSENT, Index};
pub(crate) use super::build::codes_per_cell;
pub(crate) use super::cell_sites::CellSites;
pub(crate) use super::far::FarField;
pub(crate) use super::grid::Lattice;
pub(crate) use super::layout::Layout;
