//! Scene flow as a service: estimates the motion of every point between two lidar sweeps.
//!
//! ```text
//! file - formats -> Problem -> flow::estimate -> Estimate -> formats, picture - file
//!     objects: select -> registration -> clusters, search -> assignment
//!     field:   select -> distance transform -> registration -> fit
//!              fit: loop { forward, query, backward, Adam } -> early stopping -> evaluation
//! ```
//!
//! [`flow`] holds the numerics and is independent of files, clocks and the service. All other
//! modules may depend on [`flow`].

pub mod flow;

#[cfg(feature = "service")]
pub mod api;
#[cfg(feature = "service")]
pub mod app;
#[cfg(feature = "service")]
pub mod cli;
#[cfg(feature = "formats")]
pub mod clock;
#[cfg(feature = "service")]
pub mod config;
#[cfg(feature = "service")]
pub mod cost;
#[cfg(feature = "service")]
pub mod engine;
#[cfg(feature = "service")]
pub mod fault;
#[cfg(feature = "formats")]
pub mod formats;
#[cfg(feature = "service")]
pub mod health;
#[cfg(feature = "formats")]
pub mod job;
#[cfg(feature = "service")]
pub mod label;
#[cfg(feature = "service")]
pub mod metrics;
#[cfg(feature = "service")]
pub mod payload;
#[cfg(feature = "formats")]
pub mod picture;
#[cfg(feature = "service")]
pub mod queue;
#[cfg(feature = "service")]
pub mod remote;
#[cfg(feature = "formats")]
pub mod scores;
#[cfg(feature = "service")]
pub mod storage;
#[cfg(feature = "service")]
mod sync;
#[cfg(feature = "service")]
pub mod telemetry;
#[cfg(feature = "formats")]
mod text;
#[cfg(feature = "service")]
mod trace;
#[cfg(feature = "service")]
pub mod worker;

#[cfg(all(test, feature = "gpu"))]
#[path = "../tests/common/gpu.rs"]
mod gpu_in_tests;
