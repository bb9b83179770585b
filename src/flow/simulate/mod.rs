//! Simulated street scanned by a spinning lidar, with the exact motion of every point.
//!
//! The options and their seed determine all data. A sweep is taken at one instant or, with
//! [`StreetOptions::rolling`], column by column over the sweep interval. Independent of the
//! estimation and of the metrics.

mod lidar;
mod objects;
mod options;
mod scene;
mod shapes;
mod street;
mod suspension;
mod terrain;
mod view;
mod world;

pub use objects::Kind;
pub use options::{SWEEP_SECONDS, StreetError, StreetOptions};
pub use street::{SimulatedPair, Street, StreetSweep};
