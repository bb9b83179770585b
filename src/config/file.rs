//! The values of a configuration file, as a provider for figment.

use std::path::Path;

use figment::providers::Serialized;
use figment::value::{Dict, Map};
use figment::{Metadata, Profile, Provider};

/// The values of a file, with the name of the file for errors.
pub(super) struct ConfigFile<'a> {
    pub(super) path: &'a Path,
    pub(super) table: toml::Table,
}

impl Provider for ConfigFile<'_> {
    fn metadata(&self) -> Metadata {
        Metadata::from("TOML file", self.path)
    }

    fn data(&self) -> Result<Map<Profile, Dict>, figment::Error> {
        Serialized::defaults(&self.table).data()
    }
}
