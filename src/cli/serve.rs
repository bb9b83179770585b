//! `fnsf serve`: runs the service until SIGTERM or SIGINT.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, anyhow};
use clap::Args;
use serde::Serialize;
use tokio::signal::unix::{SignalKind, signal};

use super::failure::Failure;
use super::output::{say, show};
use crate::app::App;
use crate::config::{Config, ConfigError, LogFormat, NodeRole};
use crate::telemetry::Telemetry;

/// Time given to the remaining threads to end at shutdown.
const TO_LET_GO: Duration = Duration::from_secs(1);

/// Serve scene flow over HTTP and gRPC.
///
/// HTTP and gRPC share one port; health and metrics have another. Jobs and results are kept in a
/// folder. Every setting can be given in a TOML file (--config) or in the environment
/// (FNSF_SERVE_LISTEN, FNSF_SERVE_LIMITS__MAX_POINTS); the most common ones have flags. Flags
/// override the environment, which overrides the file. --print-config lists every key with its
/// value.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf serve\n  \
    fnsf serve --listen 0.0.0.0:8080 --config fnsf.toml\n  \
    kill -HUP $(pidof fnsf)    # read API keys and TLS files again\n  \
    curl -F source=@a.pcd -F target=@b.pcd localhost:8080/v1/flow -o flow.npz")]
pub(super) struct Serve {
    /// Configuration file, TOML; --print-config lists its keys
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    flags: Flags,
    /// Print the whole configuration as TOML, without secrets, and exit
    #[arg(long)]
    print_config: bool,
    /// Check the configuration and exit
    #[arg(long)]
    check_config: bool,
}

/// Configuration keys that have flags. Those not given come from the environment, the file or the
/// defaults.
#[derive(Debug, Args, Serialize)]
struct Flags {
    /// What this process does: all, or only api (answers requests) or worker (computes jobs), with
    /// queue.postgres in the configuration [default: all]
    #[arg(long, value_enum, hide_possible_values = true)]
    #[serde(skip_serializing_if = "Option::is_none")]
    role: Option<NodeRole>,
    /// Address of HTTP and gRPC [default: 127.0.0.1:8080]
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    listen: Option<SocketAddr>,
    /// Address of health and metrics [default: 127.0.0.1:9090]
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    admin_listen: Option<SocketAddr>,
    /// Folder for the queue, payloads and results [default: fnsf-data]
    #[arg(long, value_name = "DIR")]
    #[serde(skip_serializing_if = "Option::is_none")]
    data_dir: Option<PathBuf>,
    /// Compute device: auto (every GPU, else the CPU), cpu, cpu:THREADS, gpu (every GPU) or
    /// gpu:CARD (a GPU's number, PCI id or part of its name); repeat it for several devices
    /// [default: auto]
    #[arg(long = "device", value_name = "DEVICE")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    devices: Vec<String>,
    /// Serve no pages for browsers at /
    #[arg(long = "no-console", action = clap::ArgAction::SetFalse)]
    #[serde(skip_serializing_if = "Clone::clone")]
    console: bool,
    #[command(flatten)]
    #[serde(skip_serializing_if = "LogFlags::is_empty")]
    log: LogFlags,
}

#[derive(Debug, Args, Serialize)]
struct LogFlags {
    /// Log format: human-readable lines, or one JSON object a line [default: human]
    #[arg(long = "log-format", value_enum)]
    #[serde(skip_serializing_if = "Option::is_none")]
    format: Option<LogFormat>,
    /// Log filter: a level such as info, or levels by module such as fnsf::worker=debug,info
    /// [default: info]
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
            return show(format_args!("{}", text.trim_end()));
        }
        App::check(&config).map_err(Failure::usage)?;
        if self.check_config {
            return show(format_args!("the configuration is good"));
        }
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .map_err(Failure::internal)?;
        let read_again = || Config::load(self.config.as_deref(), &self.flags);
        let served = runtime.block_on(serve(config, read_again));
        // A thread that is blocked in disk I/O must not keep the process alive.
        runtime.shutdown_timeout(TO_LET_GO);
        served
    }
}

async fn serve(
    config: Config,
    read_again: impl Fn() -> Result<Config, ConfigError>,
) -> Result<(), Failure> {
    let telemetry = Telemetry::start(&config.log, config.otlp_endpoint.as_deref());
    let _flushed_at_the_end = telemetry.map_err(Failure::usage)?;
    // The handlers are installed before the server starts, so that no signal is missed.
    let mut terminate = signal(SignalKind::terminate()).map_err(Failure::internal)?;
    let mut interrupt = signal(SignalKind::interrupt()).map_err(Failure::internal)?;
    let mut hang_up = signal(SignalKind::hangup()).map_err(Failure::internal)?;
    let mut app = App::start(config).await.map_err(Failure::internal)?;
    let admin = app.admin_address();
    match app.public_address() {
        Some(public) => say(format_args!(
            "fnsf serves HTTP and gRPC on {public}, health and metrics on {admin}"
        ))?,
        None => say(format_args!(
            "fnsf computes jobs; health and metrics are on {admin}"
        ))?,
    }
    app.ready()
        .await
        .context("no device is ready")
        .map_err(Failure::internal)?;
    let done = loop {
        tokio::select! {
            _ = terminate.recv() => {
                tracing::info!("SIGTERM");
                break Ok(());
            }
            _ = interrupt.recv() => {
                tracing::info!("SIGINT");
                break Ok(());
            }
            _ = hang_up.recv() => reload(&app, read_again()),
            reason = app.given_up() => {
                tracing::error!(reason, "this process cannot go on: stopping, for a fresh one");
                break Err(Failure::internal(anyhow!("this process cannot go on: {reason}")));
            }
        }
    };
    tokio::select! {
        () = app.drain() => done,
        _ = terminate.recv() => done,
        _ = interrupt.recv() => done,
    }
}

/// Takes the keys and the TLS files of the configuration as it is now, or goes on with those before.
fn reload(app: &App, config: Result<Config, ConfigError>) {
    let done = config.map_err(anyhow::Error::from);
    match done.and_then(|config| app.reload(&config)) {
        Ok(()) => tracing::info!("SIGHUP: keys and TLS files are read again"),
        Err(error) => {
            tracing::error!(
                error = format!("{error:#}"),
                "SIGHUP: keys and TLS files stay as they were"
            );
        }
    }
}
