//! Values of one source, as a provider for figment: a configuration file, or the command line.

use std::path::Path;

use figment::error::Kind;
use figment::value::{Dict, Map, Value};
use figment::{Metadata, Profile, Provider};
use serde::Serialize;

use super::keys::ConfigError;
use super::secret::wrong_values;

/// The values of a source, with its name for errors.
pub(super) struct Layer {
    metadata: Metadata,
    values: Dict,
}

impl Layer {
    /// The values of the file at `path`.
    ///
    /// # Errors
    /// [`ConfigError::Value`].
    pub(super) fn file(path: &Path, table: &toml::Table) -> Result<Self, ConfigError> {
        let metadata = Metadata::from("TOML file", path);
        let values = dict_of(table)?;
        Ok(Self { metadata, values })
    }

    /// The keys that the command line gives. `flags` serializes to a map.
    ///
    /// # Errors
    /// [`ConfigError::Value`], also for what is no map.
    pub(super) fn command_line(flags: &impl Serialize) -> Result<Self, ConfigError> {
        let metadata = Metadata::named("the command line");
        let values = dict_of(flags)?;
        Ok(Self { metadata, values })
    }
}

fn dict_of(values: &impl Serialize) -> Result<Dict, ConfigError> {
    let wrong = |error| ConfigError::Value(wrong_values(error));
    let value = Value::serialize(values).map_err(wrong)?;
    let actual = value.to_actual();
    let dict = value.into_dict();
    dict.ok_or_else(|| wrong(Kind::InvalidType(actual, "a map".to_owned()).into()))
}

impl Provider for Layer {
    fn metadata(&self) -> Metadata {
        self.metadata.clone()
    }

    fn data(&self) -> Result<Map<Profile, Dict>, figment::Error> {
        Ok(Profile::Default.collect(self.values.clone()))
    }
}
