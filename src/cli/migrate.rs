//! `fnsf migrate`: the schema of a server's queue, brought to this program's version.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::client::block_on;
use super::failure::Failure;
use super::output::say;
use crate::app;
use crate::config::Config;

/// Bring the schema of a server's queue to this program's version, and exit.
///
/// fnsf serve does the same at its start. As a step of its own it suits a deployment whose nodes may not
/// change the tables of their database. An upgrade cannot be undone without a backup.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf migrate --data-dir /var/lib/fnsf     # the server is stopped\n  \
    fnsf migrate --config fnsf.toml           # the database that queue.postgres names")]
pub(super) struct Migrate {
    /// Configuration file of the server, TOML
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    flags: Flags,
}

#[derive(Debug, Args, Serialize)]
struct Flags {
    /// Folder of the queue, where it is not in a database [default: fnsf-data]
    #[arg(long, value_name = "DIR")]
    #[serde(skip_serializing_if = "Option::is_none")]
    data_dir: Option<PathBuf>,
}

impl Migrate {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let config = Config::load(self.config.as_deref(), &self.flags).map_err(Failure::usage)?;
        let done = block_on(async { app::migrate(&config).await.map_err(Failure::internal) })?;
        let to = done.to;
        match done.from {
            0 => say(format_args!("the queue is made, with schema version {to}")),
            from if from == to => say(format_args!("the queue has schema version {to} already")),
            from => say(format_args!(
                "the queue is upgraded from schema version {from} to {to}"
            )),
        }
    }
}
