//! A street seen by a spinning lidar, with the exact motion of every point.
//!
//! Everything follows from the options and their seed. Each sweep is taken at one instant: there
//! is no rolling shutter. It must not know how flow is estimated or scored.

mod lidar;
mod objects;
mod options;
mod scene;
mod shapes;
mod street;
mod terrain;
mod view;
mod world;

pub use objects::Kind;
pub use options::{FRAME_SECONDS, StreetError, StreetOptions};
pub use street::{Frame, SimulatedPair, Street};
