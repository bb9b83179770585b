//! Recordings of robots: MCAP files. Those with point clouds of ROS 1 and ROS 2 are read as a stream.
//!
//! The records are walked from the beginning, without the index, so that a recording that was cut off
//! gives what it has. Every length is checked against the bytes that are there.

mod chunk;
mod point_cloud;
mod recording;
mod records;
mod wire;
mod writer;

pub use point_cloud::RecordedSweep;
pub use recording::{CloudMessage, read_recording};
pub(super) use records::MAGIC;
pub(super) use writer::{RecordingWriter, Topic};
