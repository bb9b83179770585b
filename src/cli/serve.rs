//! `fnsf serve`: the service, until it is told to stop.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, anyhow};
use clap::Args;
use serde::Serialize;
use tokio::signal::unix::{SignalKind, signal};

use super::failure::Failure;
use super::output::say;
use crate::app::App;
use crate::config::{Config, LogFormat};
use crate::telemetry::Telemetry;

/// Time that threads have to end when everything else has.
const TO_LET_GO: Duration = Duration::from_secs(1);

/// Serve scene flow over HTTP and gRPC.
///
/// Both on one port, health and metrics on another, jobs and results in a folder. Everything can
/// stand in a file (--config), in the environment (FNSF_SERVE_LISTEN, FNSF_SERVE_LIMITS__MAX_POINTS)
/// or, the most common, in flags; later ones win. --print-config shows every key and its value.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf serve\n  \
    fnsf serve --listen 0.0.0.0:8080 --config fnsf.toml\n  \
    curl -F source=@a.pcd -F target=@b.pcd localhost:8080/v1/flow -o flow.npz")]
pub(super) struct Serve {
    /// A TOML file; --print-config shows what it may say
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    flags: Flags,
    /// Show the whole configuration as TOML, secrets left out, and exit
    #[arg(long)]
    print_config: bool,
    /// Check the configuration and exit
    #[arg(long)]
    check_config: bool,
}

/// The keys that have flags; those not given are left to the file, the environment, the defaults.
#[derive(Debug, Args, Serialize)]
struct Flags {
    /// HTTP and gRPC [default: 127.0.0.1:8080]
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    listen: Option<SocketAddr>,
    /// Health and metrics [default: 127.0.0.1:9090]
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    admin_listen: Option<SocketAddr>,
    /// The queue, payloads and results [default: fnsf-data]
    #[arg(long, value_name = "DIR")]
    #[serde(skip_serializing_if = "Option::is_none")]
    data_dir: Option<PathBuf>,
    /// A device: auto (every GPU, else the CPU), cpu, cpu:THREADS, gpu or gpu:CARD; give it again
    /// for more than one [default: auto]
    #[arg(long = "device", value_name = "DEVICE")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    devices: Vec<String>,
    #[command(flatten)]
    #[serde(skip_serializing_if = "LogFlags::is_empty")]
    log: LogFlags,
}

#[derive(Debug, Args, Serialize)]
struct LogFlags {
    /// Logs for people or for programs [default: human]
    #[arg(long = "log-format", value_enum)]
    #[serde(skip_serializing_if = "Option::is_none")]
    format: Option<LogFormat>,
    /// Which logs: a level, or fnsf::worker=debug,info [default: info]
    #[arg(long = "log", value_name = "FILTER")]
    #[serde(skip_serializing_if = "Option::is_none")]
    filter: Option<String>,
}

impl LogFlags {
    fn is_empty(&self) -> bool {
        self.format.is_none() && self.filter.is_none()
    }
}

impl Serve {
    pub(super) fn run(self) -> Result<(), Failure> {
        let config = Config::load(self.config.as_deref(), &self.flags).map_err(Failure::usage)?;
        if self.print_config {
            let text = config.to_toml().map_err(Failure::internal)?;
            return say(format_args!("{}", text.trim_end()));
        }
        App::check(&config).map_err(Failure::usage)?;
        if self.check_config {
            return say(format_args!("the configuration is good"));
        }
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .map_err(Failure::internal)?;
        let served = runtime.block_on(serve(config));
        // A thread that hangs in a disk's hands must not keep the process.
        runtime.shutdown_timeout(TO_LET_GO);
        served
    }
}

async fn serve(config: Config) -> Result<(), Failure> {
    let telemetry = Telemetry::start(&config.log, config.otlp_endpoint.as_deref());
    let _flushed_at_the_end = telemetry.map_err(Failure::usage)?;
    // Before anything is promised, so that no signal is missed.
    let mut terminate = signal(SignalKind::terminate()).map_err(Failure::internal)?;
    let mut interrupt = signal(SignalKind::interrupt()).map_err(Failure::internal)?;
    let mut app = App::start(config).await.map_err(Failure::internal)?;
    say(format_args!(
        "fnsf serves HTTP and gRPC on {}, health and metrics on {}",
        app.public_address(),
        app.admin_address()
    ))?;
    app.ready()
        .await
        .context("no device is ready")
        .map_err(Failure::internal)?;
    let done = tokio::select! {
        _ = terminate.recv() => {
            tracing::info!("SIGTERM");
            Ok(())
        }
        _ = interrupt.recv() => {
            tracing::info!("SIGINT");
            Ok(())
        }
        reason = app.given_up() => {
            tracing::error!(reason, "this process cannot go on: stopping, for a fresh one");
            Err(Failure::internal(anyhow!("this process cannot go on: {reason}")))
        }
    };
    tokio::select! {
        () = app.drain() => done,
        _ = terminate.recv() => done,
        _ = interrupt.recv() => done,
    }
}
