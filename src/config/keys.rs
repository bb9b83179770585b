//! The configuration of the server: its keys, their defaults and their checks.

use std::net::SocketAddr;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::remote::RemoteConfig;
use super::secret::Secret;
use crate::api::Role;
use crate::job::Priority;

/// Minimum time to interrupt running jobs and to close connections, seconds.
const MIN_DRAIN_SECONDS: u64 = 4;

/// Maximum number of lanes of a device. Each lane is a thread, and takes a share of a GPU's memory.
pub(crate) const MAX_LANES: usize = 64;

/// The complete configuration of the server. [`Config::check`] checks the ranges of its values,
/// [`App::check`](crate::app::App::check) also the devices, API keys and tenants.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// What this process does of the service.
    pub role: NodeRole,
    /// The name of this node, for operators. `None`: the name of the host.
    pub node: Option<String>,
    /// Address of the public port, which serves both HTTP and gRPC. Port 0 takes a free port. A
    /// worker has no public port.
    pub listen: SocketAddr,
    /// Address of the admin port, which serves health checks and metrics. Port 0 takes a free port.
    pub admin_listen: SocketAddr,
    /// Directory of the queue, the payloads and the results, as far as `queue.postgres` and
    /// `storage` name no other place.
    pub data_dir: PathBuf,
    /// Bucket of the payloads and the results: `s3://bucket/prefix`, `gs://bucket/prefix` or
    /// `az://container/prefix`. Keys, region and endpoint come from the variables that the vendors'
    /// own programs read, such as `AWS_ACCESS_KEY_ID`. `None`: the folder `blobs` in `data_dir`.
    pub storage: Option<String>,
    /// Whether `data_dir` is one folder of all nodes, such as a network file system. Several nodes
    /// need that or `storage`.
    pub data_dir_is_shared: bool,
    /// Allow a listen address beyond loopback without any API key.
    pub allow_unauthenticated: bool,
    /// Host names besides localhost that requests may use on a loopback server without keys, such
    /// as that of a reverse proxy. Other host names are refused, because a browser could be made to
    /// send requests from another site's page.
    pub allowed_hosts: Vec<String>,
    /// Serve the console, pages for browsers, at `/` of the public port.
    pub console: bool,
    /// One API key for the tenant `default`, with full access: 16 or more printable ASCII
    /// characters without white space at the ends.
    pub api_key: Option<Secret>,
    /// API keys with tenants and roles.
    pub keys: Vec<KeyConfig>,
    /// TLS on the public port.
    pub tls: Option<TlsConfig>,
    /// Compute devices, at least one. `auto`: every usable GPU, or the CPU if there is none. `cpu`:
    /// all cores, at most 256. `cpu:4`: four threads, 1 to 256. `gpu`: every GPU. `gpu:CARD`: one
    /// GPU by index, PCI id or part of its name.
    pub devices: Vec<String>,
    /// Number of pairs that the threads of a CPU compute at the same time, 1 to 64. `None`: half of the
    /// threads. No more than there are threads.
    pub cpu_lanes: Option<usize>,
    /// Number of pairs that one GPU computes at the same time, 1 to 64. `None`: 8, or 2 for a
    /// software driver. Fewer are used if the GPU cannot hold as many networks.
    pub gpu_lanes: Option<usize>,
    /// Memory to allocate on each GPU, MiB, at least 1. `None`: chosen by
    /// [`crate::flow::gpu::GpuOptions`].
    pub gpu_memory_mib: Option<u64>,
    /// Accept GPU drivers that compute on the CPU. For tests.
    pub allow_software_gpu: bool,
    /// Limits on requests, uploads and connections.
    pub limits: LimitsConfig,
    /// Retries, leases and retention of jobs.
    pub queue: QueueConfig,
    /// Other servers that callers may name.
    pub remote: RemoteConfig,
    /// Times of the shutdown.
    pub shutdown: ShutdownConfig,
    /// Log format and filter.
    pub log: LogConfig,
    /// Destination of traces: an OTLP endpoint over gRPC, such as http://localhost:4317. No traces
    /// are sent without it.
    pub otlp_endpoint: Option<String>,
}

/// What a process does of the service.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum NodeRole {
    /// It answers requests and computes jobs.
    All,
    /// It answers requests. Other nodes compute the jobs.
    Api,
    /// It computes jobs. Other nodes answer the requests.
    Worker,
}

/// An API key.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeyConfig {
    /// Tenant that owns the jobs created and read with the key: 1 to 64 letters, digits, `-`, `_`
    /// or `.`.
    pub tenant: String,
    /// Permissions of the key: read, write or operate.
    pub role: Role,
    /// The key: 16 or more printable ASCII characters without white space at the ends. Each key is
    /// given once.
    pub key: Secret,
    /// Highest priority that its jobs may have: low, normal or high. High-priority jobs start
    /// before all others, across tenants.
    #[serde(default = "high")]
    pub max_priority: Priority,
}

fn high() -> Priority {
    Priority::High
}

/// Certificate and key of the public port.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsConfig {
    /// Certificate chain, PEM.
    pub certificate: PathBuf,
    /// Private key of the certificate, PEM.
    pub key: PathBuf,
}

/// Limits on requests, uploads and connections. Sizes in MiB are at most 2^43. Times are at most
/// 100 years, if not said otherwise.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LimitsConfig {
    /// Maximum number of points of one cloud, 1 to 50,000,000.
    pub max_points: usize,
    /// Maximum predicted memory of one pair on a device, or of one dense cloud, MiB, at least 1.
    pub max_job_memory_mib: usize,
    /// Maximum size of one request body, MiB, at least 1.
    pub max_upload_mib: u64,
    /// Maximum total size of all bodies that are being received and of the clouds decoded from
    /// them, MiB, at least `max_upload_mib`.
    pub max_total_upload_mib: u64,
    /// Maximum total size of all responses that are being prepared and sent, MiB, at least 1.
    pub max_answers_mib: u64,
    /// Free disk space below which new work is refused, MiB.
    pub min_free_disk_mib: u64,
    /// Number of free inodes (files that can still be created) below which new work is refused, at
    /// most 2^40.
    pub min_free_inodes: u64,
    /// Maximum number of sweeps of one sequence, 2 to 2^20.
    pub max_sweeps: u32,
    /// Maximum predicted wait of a synchronous call until its job starts, seconds.
    pub max_wait_seconds: u64,
    /// Maximum predicted compute time of all queued jobs, summed over the lanes, seconds.
    pub max_queue_seconds: u64,
    /// Maximum predicted compute time of all queued jobs of one tenant, summed over the lanes,
    /// seconds.
    pub max_tenant_queue_seconds: u64,
    /// Maximum number of open connections of the public port, 1 to 2^20. Fewer are used if the
    /// limit of open files is lower.
    pub max_connections: usize,
    /// Timeout for the headers of a request, for a TLS handshake, and between two requests of a
    /// connection, seconds, 1 to 3600.
    pub header_timeout_seconds: u64,
    /// Maximum time between two bytes of a request body, seconds, 1 to 3600. It is also the maximum
    /// delay of a body behind a rate of 1 KiB/s.
    pub body_timeout_seconds: u64,
    /// Time that a response may stay unread by its client, seconds, 1 to 3600.
    pub write_timeout_seconds: u64,
    /// Number of pairs of a streamed sequence that are computed ahead of the client's reading, 1 to
    /// 1000.
    pub stream_prefetch_pairs: usize,
}

/// Retries, leases and retention of jobs. Times in seconds are at most 100 years.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct QueueConfig {
    /// URL of a PostgreSQL database that holds the queue of many nodes:
    /// `postgres://user:password@host/database`. `None`: a file in `data_dir`, of this process
    /// alone.
    pub postgres: Option<Secret>,
    /// URL of the same database without the pooler that `postgres` leads through. One connection of
    /// each node needs it.
    pub postgres_direct: Option<Secret>,
    /// Number of connections to the database, 1 to 64. Two more are always open.
    pub postgres_connections: usize,
    /// Failures after which a job is not retried, 1 to 1000.
    pub max_attempts: u32,
    /// Crashes without a new snapshot in between after which a job is not retried, 1 to 1000.
    pub max_crashes: u32,
    /// Time without a heartbeat after which a running job is queued again, seconds, at least 1. It
    /// counts as a failure.
    pub lease_seconds: u64,
    /// Delay before the second attempt, seconds. It doubles with each further attempt, up to 1024
    /// times the first one.
    pub retry_delay_seconds: u64,
    /// Maximum time in the queue of a job without a deadline, seconds, at least 1.
    pub time_to_live_seconds: u64,
    /// Time that a finished durable job, its sweeps and its result are kept, seconds, at least 1.
    pub retention_seconds: u64,
    /// The same for an ephemeral job, whose caller waited for the result, seconds, at least 1.
    pub sync_result_retention_seconds: u64,
    /// Minimum time between two snapshots of a running fit, milliseconds. 0 saves one whenever the
    /// fit offers it.
    pub snapshot_interval_ms: u64,
}

/// Times of the shutdown.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShutdownConfig {
    /// Time between reporting not ready and refusing new work, seconds. Load balancers need it to
    /// react.
    pub readiness_delay_seconds: u64,
    /// Deadline of the shutdown, seconds after the signal: at least `readiness_delay_seconds` + 4,
    /// at most 100 years. Jobs that still run shortly before it are queued again, and continue
    /// after a restart. The exit may take a few seconds more, to send the last traces.
    pub timeout_seconds: u64,
}

/// Log format and filter.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogConfig {
    /// Output format.
    pub format: LogFormat,
    /// A level such as `info`, or levels by module such as `fnsf::worker=debug,info`.
    pub filter: String,
}

/// Output format of the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum LogFormat {
    /// Human-readable lines.
    Human,
    /// One JSON object per line.
    Json,
}

impl Default for Config {
    fn default() -> Self {
        const DAY: u64 = 24 * 60 * 60;
        Self {
            role: NodeRole::All,
            node: None,
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            admin_listen: SocketAddr::from(([127, 0, 0, 1], 9090)),
            data_dir: PathBuf::from("fnsf-data"),
            storage: None,
            data_dir_is_shared: false,
            console: true,
            allow_unauthenticated: false,
            allowed_hosts: Vec::new(),
            api_key: None,
            keys: Vec::new(),
            tls: None,
            devices: vec!["auto".to_owned()],
            cpu_lanes: None,
            gpu_lanes: None,
            gpu_memory_mib: None,
            allow_software_gpu: false,
            limits: LimitsConfig {
                max_points: 2_000_000,
                max_job_memory_mib: 8192,
                max_upload_mib: 1024,
                max_total_upload_mib: 2048,
                max_answers_mib: 1024,
                min_free_disk_mib: 1024,
                min_free_inodes: 10_000,
                max_sweeps: 1000,
                max_wait_seconds: 30,
                max_queue_seconds: 7 * DAY,
                max_tenant_queue_seconds: 7 * DAY / 2,
                max_connections: 1024,
                header_timeout_seconds: 15,
                body_timeout_seconds: 30,
                write_timeout_seconds: 60,
                stream_prefetch_pairs: 3,
            },
            queue: QueueConfig {
                postgres: None,
                postgres_direct: None,
                postgres_connections: 4,
                max_attempts: 3,
                max_crashes: 5,
                lease_seconds: 60,
                retry_delay_seconds: 1,
                time_to_live_seconds: 7 * DAY,
                retention_seconds: DAY,
                sync_result_retention_seconds: 60,
                snapshot_interval_ms: 1000,
            },
            remote: RemoteConfig::default(),
            shutdown: ShutdownConfig {
                readiness_delay_seconds: 0,
                timeout_seconds: 30,
            },
            log: LogConfig {
                format: LogFormat::Human,
                filter: "info".to_owned(),
            },
            otlp_endpoint: None,
        }
    }
}

/// Why a configuration is refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The configuration file cannot be read or is not TOML.
    #[error("cannot read {path}: {reason}")]
    File {
        /// Path of the file.
        path: String,
        /// The error, with the line number if the file is not TOML. It does not quote the line.
        reason: String,
    },
    /// A key is unknown, or a value has the wrong type or form.
    #[error("{0}")]
    Value(String),
    /// A value is out of range or has no TOML form, or two values contradict each other.
    #[error("{0}")]
    Together(String),
}

impl Config {
    /// Checks ranges, and values that must agree with each other. The texts in `devices`, the API
    /// keys and the tenants are not checked.
    ///
    /// # Errors
    /// [`ConfigError::Together`] in these cases:
    /// - `listen` is beyond loopback, no API key is given, and `allow_unauthenticated` is false.
    /// - `role` is not `all`, and `queue.postgres` is not given.
    /// - `queue.postgres` is given without `storage` or `data_dir_is_shared`.
    /// - `devices` is empty.
    /// - A number is outside the range that its field states.
    /// - `shutdown.timeout_seconds` is less than `shutdown.readiness_delay_seconds` + 4.
    /// - `limits.max_total_upload_mib` is less than `limits.max_upload_mib`.
    pub fn check(&self) -> Result<(), ConfigError> {
        let refuse = |text: &str| Err(ConfigError::Together(text.to_owned()));
        let open = self.api_key.is_none() && self.keys.is_empty();
        let answers = self.role != NodeRole::Worker;
        if answers && open && !self.listen.ip().is_loopback() && !self.allow_unauthenticated {
            return refuse(
                "listen goes beyond loopback and no key is needed: set api_key or keys, or \
                 allow_unauthenticated = true if the network keeps strangers out",
            );
        }
        if self.role != NodeRole::All && self.queue.postgres.is_none() {
            return refuse(
                "role is not all, and a queue in data_dir is of this process alone: name a database \
                 of all nodes in queue.postgres",
            );
        }
        if self.queue.postgres.is_some() && self.storage.is_none() && !self.data_dir_is_shared {
            return refuse(
                "queue.postgres is for many nodes, and the payloads are in a folder of this one: name \
                 a bucket in storage, or set data_dir_is_shared = true if every node sees the same \
                 folder",
            );
        }
        if self.devices.is_empty() {
            return refuse("devices is empty: name at least one, such as \"cpu\"");
        }
        let mut lanes = [self.cpu_lanes, self.gpu_lanes].into_iter().flatten();
        if lanes.any(|lanes| !(1..=MAX_LANES).contains(&lanes)) {
            return refuse("cpu_lanes and gpu_lanes must be 1 to 64");
        }
        if self.gpu_memory_mib == Some(0) {
            return refuse("gpu_memory_mib must be at least 1");
        }
        if self.shutdown.timeout_seconds
            < self
                .shutdown
                .readiness_delay_seconds
                .saturating_add(MIN_DRAIN_SECONDS)
        {
            return refuse(
                "shutdown.timeout_seconds must be at least 4 s longer than shutdown.readiness_delay_seconds: \
                 what runs has to be put down",
            );
        }
        for (key, value, least, most) in self.ranges() {
            if !(least..=most).contains(&value) {
                return refuse(&format!("{key} is {value}, {least} to {most} are possible"));
            }
        }
        if self.limits.max_total_upload_mib < self.limits.max_upload_mib {
            return refuse(
                "limits.max_total_upload_mib must be no less than limits.max_upload_mib",
            );
        }
        Ok(())
    }

    /// The configuration as TOML, with `***` for API keys and for the user and password of
    /// `otlp_endpoint`. These are found only in an endpoint with a scheme, such as `http://`. Keys
    /// without a value are left out.
    ///
    /// # Errors
    /// [`ConfigError::Together`] if a path is not UTF-8, or a number is 2^63 or more.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        let mut shown = self.clone();
        // The URL may contain a password.
        if let Some(endpoint) = &mut shown.otlp_endpoint
            && let Some((scheme, rest)) = endpoint.split_once("://")
            && let Some((_, host)) = rest.rsplit_once('@')
        {
            *endpoint = format!("{scheme}://***@{host}");
        }
        toml::to_string_pretty(&shown).map_err(|error| ConfigError::Together(error.to_string()))
    }
}

#[cfg(test)]
mod tests;
