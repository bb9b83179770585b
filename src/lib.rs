//! Scene flow as a service: two lidar clouds in, the motion of every point out.
//!
//! ```text
//! file - formats -> Problem -> flow::estimate -> Estimate -> formats, picture - file
//!     preprocess -> backend.transform -> align -> start
//!     loop { forward, query, backward, Adam } -> early stop -> evaluate
//! ```
//!
//! [`flow`] is the numerics and knows nothing of files, clocks or services; everything else may
//! know [`flow`].

pub mod flow;

#[cfg(feature = "service")]
pub mod api;
#[cfg(feature = "service")]
pub mod app;
#[cfg(feature = "service")]
pub mod cli;
#[cfg(feature = "service")]
pub mod clock;
#[cfg(feature = "service")]
pub mod config;
#[cfg(feature = "service")]
pub mod cost;
#[cfg(feature = "service")]
pub mod engine;
#[cfg(feature = "service")]
pub mod fault;
#[cfg(feature = "service")]
pub mod formats;
#[cfg(feature = "service")]
pub mod health;
#[cfg(feature = "service")]
pub mod job;
#[cfg(feature = "service")]
pub mod metrics;
#[cfg(feature = "service")]
pub mod payload;
#[cfg(feature = "service")]
pub mod picture;
#[cfg(feature = "service")]
pub mod queue;
#[cfg(feature = "service")]
pub mod storage;
#[cfg(feature = "service")]
pub mod telemetry;
#[cfg(feature = "service")]
mod text;
#[cfg(feature = "service")]
pub mod worker;

#[cfg(all(test, feature = "gpu"))]
#[path = "../tests/common/gpu.rs"]
mod gpu_in_tests;
