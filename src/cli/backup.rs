//! `fnsf backup` and `fnsf restore`: copies of a server's data directory.

use std::path::PathBuf;

use clap::Args;

use super::failure::Failure;
use super::output::say;
use crate::app;
use crate::text::grouped;

/// Copy the data directory of a server, which may run meanwhile.
///
/// For a server with the queue and the payloads in its data directory. Of nodes over PostgreSQL and a
/// bucket, back up the database first and then the bucket.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf backup --data-dir /var/lib/fnsf -o /backups/fnsf-$(date +%F)\n  \
    fnsf restore /backups/fnsf-2026-11-25 --data-dir /var/lib/fnsf-new")]
pub(super) struct Backup {
    /// The server's data directory
    #[arg(long, value_name = "DIR", default_value = "fnsf-data")]
    data_dir: PathBuf,
    /// New folder for the copy
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

impl Backup {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let copied = app::backup(&self.data_dir, &self.output).map_err(Failure::internal)?;
        tell(&copied, "copied to", &self.output)
    }
}

/// Make a data directory from a copy by fnsf backup.
#[derive(Debug, Args)]
pub(super) struct Restore {
    /// Folder that fnsf backup has written
    backup: PathBuf,
    /// New data directory; start fnsf serve on it
    #[arg(long, value_name = "DIR")]
    data_dir: PathBuf,
}

impl Restore {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let copied = app::restore(&self.backup, &self.data_dir).map_err(Failure::internal)?;
        tell(&copied, "restored to", &self.data_dir)
    }
}

fn tell(copied: &app::Backup, done: &str, place: &std::path::Path) -> Result<(), Failure> {
    say(format_args!(
        "{} jobs with {} files ({:.1} MB) {done} {}",
        grouped(copied.jobs),
        grouped(copied.files.files as usize),
        copied.files.bytes as f64 / 1e6,
        place.display()
    ))
}
