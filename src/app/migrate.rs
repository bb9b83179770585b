//! The upgrade of the queue's schema without a server.

use anyhow::{Context, bail};

use super::process::{keep_files_private, name_tls_provider};
use super::settings::postgres_options;
use crate::config::Config;
use crate::queue::{Migration, migrate_postgres, migrate_sqlite};

/// Brings the schema of the queue that a configuration names to this program's version.
///
/// # Errors
/// If the configuration is refused, the queue is in a folder that has none or that another process uses,
/// the database cannot be reached or used, or the schema is too old or newer than the program.
pub async fn migrate(config: &Config) -> anyhow::Result<Migration> {
    config.check()?;
    keep_files_private();
    name_tls_provider();
    if let Some(target) = postgres_options(config) {
        let migrated = migrate_postgres(&target).await;
        return migrated.context("the database of queue.postgres is not upgraded");
    }
    let folder = &config.data_dir;
    if !folder.join("queue.sqlite3").exists() {
        bail!("{} has no queue: name its data_dir", folder.display());
    }
    let migrated = migrate_sqlite(folder);
    migrated.with_context(|| format!("the queue in {} is not upgraded", folder.display()))
}
