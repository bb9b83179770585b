//! Tracks: the moving objects of a sequence, each with one identity over its sweeps.
//!
//! ```text
//! sweep, estimate of its pair - Tracker::push - Tracker::finish - tracks
//! ```
//!
//! The motion of a pair carries the points of an object into the next sweep. The cluster that they
//! fall on is the same object there (`association.rs`). Objects that are hidden are carried on at
//! constant velocity and turn rate (`carried.rs`). Works on arrays in memory, and is independent of
//! the method that found the clusters.

mod association;
mod carried;
mod correction;
mod fitted_box;
mod live_object;
mod same_vehicle;
mod track;
mod tracker;

pub use correction::{correct, push_and_correct};
pub use track::{Track, TrackState};
pub use tracker::{ClusteredSweep, TrackError, TrackedCluster, Tracker};
