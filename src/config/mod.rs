//! The server's configuration: one tree of values, read from defaults, a file, the environment and
//! command-line flags, in that order.
//!
//! Unknown keys are refused. Secrets are never printed. Independent of the parts of the server that
//! use the values.

mod keys;
mod layer;
mod load;
mod ranges;
mod remote;
mod secret;

pub(crate) use keys::MAX_LANES;
pub use keys::{Config, ConfigError, LimitsConfig, LogConfig, LogFormat, NodeRole, QueueConfig};
pub use remote::RemoteConfig;
pub use secret::Secret;
