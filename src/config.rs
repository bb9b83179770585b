//! The server's configuration: one tree, from defaults, a file, the environment and flags, in that
//! order. Unknown keys are refused, secrets are never shown.
//!
//! It must not know what its values do; each part of the server has options of its own.

mod ranges;
mod secret;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use figment::Figment;
use figment::providers::{Env, Format, Serialized, Toml};
use serde::{Deserialize, Serialize};

pub use self::secret::Secret;
use self::secret::wrong_values;

use crate::api::Role;
use crate::job::Priority;

/// What environment variables begin with; `__` goes one level down:
/// `FNSF_SERVE_LIMITS__MAX_POINTS=200000`.
const PREFIX: &str = "FNSF_SERVE_";

/// The variable of the one key, after the prefix.
const API_KEY: &str = "API_KEY";

/// What a drain needs at least: to put down what runs, and to close connections.
const MIN_DRAIN_SECONDS: u64 = 4;

/// Each lane is a thread, and has its share of the card's memory.
const MAX_LANES: usize = 64;

/// All of it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Where HTTP and gRPC are served, on one port.
    pub listen: SocketAddr,
    /// Where health and metrics are served.
    pub admin_listen: SocketAddr,
    /// Where the queue, payloads and results lie.
    pub data_dir: PathBuf,
    /// Listen beyond loopback although no key is needed.
    pub open_to_everybody: bool,
    /// Names besides localhost under which a server on loopback without keys may be called, such as
    /// that of a proxy before it. Others are pages of other sites that a browser was made to call.
    pub allowed_hosts: Vec<String>,
    /// One key, of the default tenant, that may do everything.
    pub api_key: Option<Secret>,
    /// Keys with tenants and roles.
    pub keys: Vec<KeyConfig>,
    /// TLS on the public port.
    pub tls: Option<TlsConfig>,
    /// What works. `auto`: every GPU that works, else the CPU; `cpu`: all cores; `cpu:4`: four
    /// threads; `gpu`: every GPU; `gpu:CARD`: the one of that number, PCI id or part of a name.
    pub devices: Vec<String>,
    /// Pairs that one GPU works on at the same time; by default what suits the card.
    pub gpu_lanes: Option<usize>,
    /// Memory of a GPU to take, MiB; by default what suits the card.
    pub gpu_memory_mib: Option<u64>,
    /// Take drivers that only compute on the CPU for GPUs: for tests.
    pub software_gpu: bool,
    /// What is accepted.
    pub limits: LimitsConfig,
    /// How jobs are treated.
    pub queue: QueueConfig,
    /// How the server stops.
    pub drain: DrainConfig,
    /// What is logged.
    pub log: LogConfig,
    /// Where traces go: an OTLP endpoint over gRPC, such as http://localhost:4317.
    pub otlp_endpoint: Option<String>,
}

/// A key.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeyConfig {
    /// Whose jobs it opens.
    pub tenant: String,
    /// What it may do.
    pub role: Role,
    /// The key itself, 16 characters or more.
    pub key: Secret,
    /// How urgent its jobs may be: low, normal or high. High goes before all others of any tenant.
    #[serde(default = "high")]
    pub max_priority: Priority,
}

fn high() -> Priority {
    Priority::High
}

/// TLS.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsConfig {
    /// The certificate chain, PEM.
    pub certificate: PathBuf,
    /// Its private key, PEM.
    pub key: PathBuf,
}

/// What is accepted.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LimitsConfig {
    /// Points of one cloud.
    pub max_points: usize,
    /// Memory of one pair on a device, or of one dense cloud, MiB.
    pub max_pair_mib: usize,
    /// Body of one request, MiB.
    pub max_upload_mib: u64,
    /// All bodies that are being received, MiB.
    pub max_uploads_mib: u64,
    /// All answers that are being made and sent, MiB.
    pub max_answers_mib: u64,
    /// Room that stays free on the disk, MiB; with less, nothing more is accepted.
    pub min_free_mib: u64,
    /// Files that can still be made on the disk (free inodes); with fewer, nothing more is accepted.
    pub min_free_inodes: u64,
    /// Frames of one sequence.
    pub max_frames: u32,
    /// Predicted wait of a call that is answered with its flow, seconds.
    pub max_wait_seconds: u64,
    /// Predicted compute time of all that waits, seconds.
    pub max_queue_seconds: u64,
    /// Predicted compute time of all that one tenant has waiting, seconds.
    pub max_tenant_queue_seconds: u64,
    /// Open connections.
    pub max_connections: usize,
    /// Time for a request's headers, seconds.
    pub header_timeout_seconds: u64,
    /// Time without a byte of a body that is being received, seconds. By more than that no body may
    /// lag behind 1 KiB a second.
    pub body_timeout_seconds: u64,
    /// Time that a client may leave an answer unread, seconds.
    pub write_timeout_seconds: u64,
    /// Pairs of a streamed sequence that are worked on ahead of its client.
    pub sequence_ahead: usize,
}

/// How jobs are treated.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct QueueConfig {
    /// Failures after which a job is given up.
    pub max_attempts: u32,
    /// Deaths of the process at the same place after which a job is given up.
    pub max_crashes: u32,
    /// Silence after which a running job is given to another worker, seconds.
    pub lease_seconds: u64,
    /// Wait before the second attempt, seconds; doubled for each one after it.
    pub retry_delay_seconds: u64,
    /// Time that a job without a deadline may wait, seconds.
    pub time_to_live_seconds: u64,
    /// Time that an ended job and its flow are kept, seconds.
    pub retention_seconds: u64,
    /// The same for a job whose caller waited and has its answer, seconds.
    pub answered_retention_seconds: u64,
    /// Time between a running job's snapshots, milliseconds.
    pub snapshot_interval_ms: u64,
}

/// How the server stops.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DrainConfig {
    /// Time between not being ready and refusing work, for load balancers to notice, seconds.
    pub delay_seconds: u64,
    /// Time from the signal to the exit, seconds. What runs longer is put down and goes on later.
    pub deadline_seconds: u64,
}

/// What is logged.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogConfig {
    /// For people or for programs.
    pub format: LogFormat,
    /// Which: a level, or `fnsf::worker=debug,info`.
    pub filter: String,
}

/// The form of logs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum LogFormat {
    /// Lines for people.
    Human,
    /// One JSON object a line.
    Json,
}

impl Default for Config {
    fn default() -> Self {
        const DAY: u64 = 24 * 60 * 60;
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            admin_listen: SocketAddr::from(([127, 0, 0, 1], 9090)),
            data_dir: PathBuf::from("fnsf-data"),
            open_to_everybody: false,
            allowed_hosts: Vec::new(),
            api_key: None,
            keys: Vec::new(),
            tls: None,
            devices: vec!["auto".to_owned()],
            gpu_lanes: None,
            gpu_memory_mib: None,
            software_gpu: false,
            limits: LimitsConfig {
                max_points: 2_000_000,
                max_pair_mib: 8192,
                max_upload_mib: 1024,
                max_uploads_mib: 2048,
                max_answers_mib: 1024,
                min_free_mib: 1024,
                min_free_inodes: 10_000,
                max_frames: 1000,
                max_wait_seconds: 30,
                max_queue_seconds: 7 * DAY,
                max_tenant_queue_seconds: 7 * DAY / 2,
                max_connections: 1024,
                header_timeout_seconds: 15,
                body_timeout_seconds: 30,
                write_timeout_seconds: 60,
                sequence_ahead: 3,
            },
            queue: QueueConfig {
                max_attempts: 3,
                max_crashes: 5,
                lease_seconds: 60,
                retry_delay_seconds: 1,
                time_to_live_seconds: 7 * DAY,
                retention_seconds: DAY,
                answered_retention_seconds: 60,
                snapshot_interval_ms: 1000,
            },
            drain: DrainConfig {
                delay_seconds: 0,
                deadline_seconds: 30,
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
    /// A file cannot be read.
    #[error("cannot read {path}: {reason}")]
    File {
        /// The file.
        path: String,
        /// Why not.
        reason: String,
    },
    /// A key is unknown, or a value is not what it should be.
    #[error("{0}")]
    Value(String),
    /// Values that do not go together.
    #[error("{0}")]
    Together(String),
}

impl Config {
    /// Reads defaults, `file`, the environment and `flags`, later ones over earlier ones.
    ///
    /// # Errors
    /// [`ConfigError`], which names the key and where it came from.
    pub fn load(file: Option<&Path>, flags: &impl Serialize) -> Result<Self, ConfigError> {
        let mut figment = Figment::from(Serialized::defaults(Self::default()));
        if let Some(path) = file {
            let text = std::fs::read_to_string(path).map_err(|error| ConfigError::File {
                path: path.display().to_string(),
                reason: error.to_string(),
            })?;
            // Its own message would show the line, and there may be a key in it.
            let _table: toml::Table = toml::from_str(&text).map_err(|error| {
                let before = error.span().map_or(0, |span| span.start).min(text.len());
                let line = 1 + text.as_bytes()[..before]
                    .iter()
                    .filter(|&&b| b == b'\n')
                    .count();
                ConfigError::File {
                    path: path.display().to_string(),
                    reason: format!("line {line}: {}", error.message()),
                }
            })?;
            figment = figment.merge(Toml::file_exact(path));
        }
        let mut variables = Env::prefixed(PREFIX).split("__");
        if let Ok(key) = std::env::var(format!("{PREFIX}{API_KEY}")) {
            // As it is: digits are no number here.
            figment = figment.merge(Serialized::default("api_key", key));
            variables = variables.ignore(&["api_key"]);
        }
        let config: Self = figment
            .merge(variables)
            .merge(Serialized::defaults(flags))
            .extract()
            .map_err(|error| ConfigError::Value(wrong_values(error)))?;
        config.check()?;
        Ok(config)
    }

    /// Refuses values that do not go together.
    ///
    /// # Errors
    /// [`ConfigError::Together`].
    pub fn check(&self) -> Result<(), ConfigError> {
        let refuse = |text: &str| Err(ConfigError::Together(text.to_owned()));
        let open = self.api_key.is_none() && self.keys.is_empty();
        if open && !self.listen.ip().is_loopback() && !self.open_to_everybody {
            return refuse(
                "listen goes beyond loopback and no key is needed: set api_key or keys, or \
                 open_to_everybody = true if the network keeps strangers out",
            );
        }
        if self.devices.is_empty() {
            return refuse("devices is empty: name at least one, such as \"cpu\"");
        }
        if self
            .gpu_lanes
            .is_some_and(|lanes| !(1..=MAX_LANES).contains(&lanes))
        {
            return refuse("gpu_lanes must be 1 to 64");
        }
        if self.gpu_memory_mib == Some(0) {
            return refuse("gpu_memory_mib must be at least 1");
        }
        if self.drain.deadline_seconds < self.drain.delay_seconds.saturating_add(MIN_DRAIN_SECONDS)
        {
            return refuse(
                "drain.deadline_seconds must be at least 4 s longer than drain.delay_seconds: \
                 what runs has to be put down",
            );
        }
        for (key, value, least, most) in self.ranges() {
            if !(least..=most).contains(&value) {
                return refuse(&format!("{key} is {value}, {least} to {most} are possible"));
            }
        }
        if self.limits.max_uploads_mib < self.limits.max_upload_mib {
            return refuse("limits.max_uploads_mib must be no less than limits.max_upload_mib");
        }
        Ok(())
    }

    /// The configuration as TOML, secrets left out.
    ///
    /// # Errors
    /// Where a value has no TOML form.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        let mut shown = self.clone();
        // It may hold a password.
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
mod tests {
    use super::*;
    use std::io::Write;

    #[derive(Serialize)]
    struct Nothing {}

    fn load(text: &str) -> Result<Config, ConfigError> {
        let mut file = tempfile::NamedTempFile::new().expect("a file");
        file.write_all(text.as_bytes()).expect("written");
        Config::load(Some(file.path()), &Nothing {})
    }

    #[test]
    fn what_is_printed_is_read_back() {
        let printed = Config::default().to_toml().expect("TOML");
        let read = load(&printed).expect("a configuration");
        assert_eq!(read.to_toml().expect("TOML"), printed);
    }

    #[test]
    fn unknown_keys_and_wrong_values_are_refused_by_name() {
        for (text, said) in [
            ("lisen = \"127.0.0.1:1\"", "lisen"),
            ("[limits]\nmax_pionts = 1", "max_pionts"),
            ("listen = \"here\"", "listen"),
            ("listen = \"0.0.0.0:8080\"", "listen goes beyond loopback"),
            ("devices = []", "devices is empty"),
            ("gpu_lanes = 0", "gpu_lanes"),
            ("gpu_memory_mib = 0", "gpu_memory_mib"),
            (
                "[limits]\nmax_upload_mib = 17592186044416",
                "1 to 8796093022208",
            ),
            ("[limits]\nmin_free_mib = 17592186044416", "min_free_mib"),
            (
                "[limits]\nmax_connections = 9223372036854775807",
                "max_connections",
            ),
            (
                "[limits]\nheader_timeout_seconds = 9223372036854775807",
                "header_timeout",
            ),
            (
                "[limits]\nsequence_ahead = 9223372036854775807",
                "sequence_ahead",
            ),
            ("[limits]\nmax_connections = 0", "max_connections"),
            (
                "[drain]\ndeadline_seconds = 9223372036854775807",
                "drain.deadline",
            ),
            (
                "[drain]\ndelay_seconds = 9223372036854775807",
                "delay_seconds",
            ),
            ("[queue]\nlease_seconds = 0", "lease_seconds"),
            (
                "[[keys]]\ntenant = \"a\"\nrole = \"root\"\nkey = \"x\"",
                "one of read, write",
            ),
        ] {
            let error = load(text).expect_err(text).to_string();
            assert!(error.contains(said), "{text}: {error}");
        }
        let missing = Config::load(Some(Path::new("/nonexistent")), &Nothing {});
        assert!(missing.is_err());
    }

    #[test]
    fn a_key_that_is_wrong_is_not_shown() {
        for text in [
            "api_key = 12345678901234567890",
            "api_key = 1234567890123456",
            "api_key = 1234567890123.456",
            "api_key = [\"1234567890123456\"]",
            "api_key = \"1234567890123456\" x",
            "api_key = 1234567890123456x",
            "[[keys]]\ntenant = \"a\"\nrole = \"read\"\nkey = 1234567890123456",
            "[[keys]]\ntenant = \"a\"\nrole = \"1234567890123456\"\nkey = \"read\"",
            "keys = \"1234567890123456\"",
            "keys = [\"1234567890123456\"]",
            "tls = \"1234567890123456\"",
        ] {
            let error = load(text).expect_err(text);
            let said = format!("{error} {error:?}");
            assert!(!said.contains("1234567890"), "{text}: {said}");
        }
    }

    #[test]
    fn secrets_are_read_and_never_shown() {
        let config = "api_key = \"a very long secret\"\notlp_endpoint = \"http://a:secret@b:1\"";
        let config = load(config).expect("a configuration");
        let key = config.api_key.clone().expect("a key");
        assert_eq!(key.reveal(), "a very long secret");
        let shown = config.to_toml().expect("TOML");
        let debug = format!("{:?} {:?}", config.api_key, config.keys);
        let shown = format!("{debug}{shown}");
        assert!(
            !shown.contains("secret") && shown.contains("***"),
            "{shown}"
        );
    }
}
