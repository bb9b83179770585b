//! Reads the configuration: from defaults, a TOML file, the environment and the command line, in that
//! order.

use std::path::Path;

use figment::Figment;
use figment::providers::{Env, Serialized};
use serde::Serialize;

use super::keys::{Config, ConfigError};
use super::layer::Layer;
use super::secret::wrong_values;

/// Prefix of environment variables. `__` descends one level, as in
/// `FNSF_SERVE_LIMITS__MAX_POINTS=200000`.
const PREFIX: &str = "FNSF_SERVE_";

/// Name, after the prefix, of the variable that holds `api_key`.
const API_KEY: &str = "API_KEY";

/// Whether Kubernetes sets the variable `name`, here without its prefix, in every container beside
/// a Service named `fnsf-serve`. `PORT` is one of these if it holds an address instead of a number.
/// No key of the configuration has such a name.
fn is_of_a_kubernetes_service(name: &str, value: &str) -> bool {
    let name = name.to_ascii_lowercase();
    let one_of = |prefix: &str| name == prefix || name.starts_with(&format!("{prefix}_"));
    (name == "port" && value.contains("://"))
        || name.starts_with("port_")
        || name == "service_host"
        || one_of("service_port")
}

/// Reads a TOML file. It is read once: a pipe cannot be read twice.
fn table_of(path: &Path) -> Result<toml::Table, ConfigError> {
    let refused = |reason| {
        let path = path.display().to_string();
        ConfigError::File { path, reason }
    };
    let text = std::fs::read_to_string(path).map_err(|error| refused(error.to_string()))?;
    toml::from_str(&text).map_err(|error| {
        // figment's own message would quote the line, which may contain a key.
        let before = error.span().map_or(0, |span| span.start).min(text.len());
        let line = 1 + text.as_bytes()[..before]
            .iter()
            .filter(|&&b| b == b'\n')
            .count();
        refused(format!("line {line}: {}", error.message()))
    })
}

impl Config {
    /// Reads the defaults, the TOML `file`, the environment and `flags`. Each overrides the
    /// previous ones. Environment variables have the prefix `FNSF_SERVE_`. In their names `__`
    /// goes one level down, as in `FNSF_SERVE_LIMITS__MAX_POINTS`. Variables that Kubernetes sets
    /// for a Service named `fnsf-serve` are ignored. `flags` serializes to a map of the keys that
    /// are given.
    ///
    /// # Errors
    /// - [`ConfigError::File`] if `file` cannot be read or is not TOML.
    /// - [`ConfigError::Value`] if a key is unknown, or a value has the wrong type or form. It
    ///   names the key and its source.
    /// - [`ConfigError::Together`] as [`Config::check`].
    pub fn load(file: Option<&Path>, flags: &impl Serialize) -> Result<Self, ConfigError> {
        Self::load_beneath(file, Layer::command_line(flags)?)
    }

    /// As [`Self::load`]. It is not generic, so that it is compiled once.
    fn load_beneath(file: Option<&Path>, flags: Layer) -> Result<Self, ConfigError> {
        let mut figment = Figment::from(Serialized::defaults(Self::default()));
        if let Some(path) = file {
            figment = figment.merge(Layer::file(path, &table_of(path)?)?);
        }
        let mut variables = Env::prefixed(PREFIX)
            .filter(|name| {
                let value = std::env::var(format!("{PREFIX}{name}"));
                !is_of_a_kubernetes_service(name.as_str(), value.as_deref().unwrap_or_default())
            })
            .split("__");
        if let Ok(key) = std::env::var(format!("{PREFIX}{API_KEY}")) {
            // Taken as a string: figment would parse a key of digits as a number.
            figment = figment.merge(Serialized::default("api_key", key));
            variables = variables.ignore(&["api_key"]);
        }
        let config: Self = figment
            .merge(variables)
            .merge(flags)
            .extract()
            .map_err(|error| ConfigError::Value(wrong_values(error)))?;
        config.check()?;
        Ok(config)
    }
}
