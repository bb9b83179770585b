//! Devices and the threads that run on them, one for each lane.
//!
//! Each lane runs one pair at a time. A device is opened once for all its lanes and has one health.
//! A panic fails only the pair in which it happened. A lost device fails the pairs that ran on it;
//! then it is reopened and must pass its self-test. Independent of queues, stores and protocols.

mod densify;
mod device;
mod liveness;
mod panics;
mod self_test;
mod slot;
mod supervisor;
#[cfg(test)]
pub(crate) mod test_gpu;
#[cfg(test)]
mod tests;
mod types;

pub use densify::{Densification, Densified};
pub use device::{Device, Lane, self_test_backend, try_opening};
#[cfg(test)]
pub(crate) use test_gpu::Switches;
pub use types::{DeviceFactory, DeviceOptions, EngineError, Health, Opened, ReopenPolicy, Work};
