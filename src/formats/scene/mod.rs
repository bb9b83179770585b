//! Scenes of OpenSceneFlow: one HDF5 file with many sweeps, and their truth where it is known.

mod arrays;
mod filters;
mod sweeps;
mod truth;

pub use crate::formats::scene::sweeps::{Scene, SceneSweep};
