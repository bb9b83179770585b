//! The options of the parts of a server, from its configuration.

use std::time::Duration;

use anyhow::Context;

use crate::api::{AdmissionLimits, Caller, Keys, ListenOptions, Role, ServiceLimits};
use crate::config::{Config, LimitsConfig, QueueConfig, RemoteConfig};
use crate::job::{Priority, Tenant};
use crate::queue::{PostgresOptions, QueueOptions};
use crate::remote::{Allowed, DELIVERY_SCHEMES, SOURCE_SCHEMES, SigningSecret};

/// The API keys: that of the default tenant, and those of tenants.
///
/// # Errors
/// If a key or a tenant name is invalid, or a key is given twice.
pub(super) fn keys(config: &Config) -> anyhow::Result<Keys> {
    let mut keys = Keys::default();
    if let Some(key) = &config.api_key {
        let caller = Caller {
            tenant: Tenant::default(),
            role: Role::Operate,
            max_priority: Priority::High,
            shared_job: None,
        };
        keys.add(key.reveal(), caller).context("api_key")?;
    }
    for key in &config.keys {
        let tenant = key.tenant.parse().context("keys")?;
        let caller = Caller {
            tenant,
            role: key.role,
            max_priority: key.max_priority,
            shared_job: None,
        };
        keys.add(key.key.reveal(), caller).context("keys")?;
    }
    Ok(keys)
}

/// The places that sweeps may be fetched from.
///
/// # Errors
/// If a prefix is invalid.
pub(super) fn sources(config: &RemoteConfig) -> anyhow::Result<Allowed> {
    Allowed::new(&config.sweeps, &SOURCE_SCHEMES).context("remote.sweeps")
}

/// The places that results may be delivered to.
///
/// # Errors
/// If a prefix is invalid.
pub(super) fn deliveries(config: &RemoteConfig) -> anyhow::Result<Allowed> {
    Allowed::new(&config.results, &DELIVERY_SCHEMES).context("remote.results")
}

/// The webhooks that jobs may name, and the key of their signatures; `None` if there are none.
///
/// # Errors
/// If a prefix or the secret is invalid, or prefixes are without a secret.
pub(super) fn webhooks(config: &RemoteConfig) -> anyhow::Result<Option<(Allowed, SigningSecret)>> {
    let allowed = Allowed::new(&config.webhooks, &["https", "http"]).context("remote.webhooks")?;
    let secret = config.webhook_secret.as_ref();
    let secret = secret.map(|secret| SigningSecret::parse(secret.reveal()));
    let secret = secret.transpose().context("remote.webhook_secret")?;
    match secret {
        _ if allowed.is_empty() => Ok(None),
        Some(secret) => Ok(Some((allowed, secret))),
        None => anyhow::bail!(
            "remote.webhooks needs remote.webhook_secret, by which receivers know that a notice is \
             genuine: make one with echo whsec_$(openssl rand -base64 32)"
        ),
    }
}

pub(super) fn queue_options(config: &QueueConfig) -> QueueOptions {
    let seconds = Duration::from_secs;
    QueueOptions {
        max_attempts: config.max_attempts,
        max_crashes: config.max_crashes,
        lease: seconds(config.lease_seconds),
        retry_delay: seconds(config.retry_delay_seconds),
        time_to_live: seconds(config.time_to_live_seconds),
        retention: seconds(config.retention_seconds),
        answered_retention: seconds(config.sync_result_retention_seconds),
    }
}

/// The database of the queue; `None` if the queue is a file.
pub(super) fn postgres_options(config: &Config) -> Option<PostgresOptions> {
    let url = config.queue.postgres.as_ref()?;
    let direct_url = config.queue.postgres_direct.as_ref();
    let host = || std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    Some(PostgresOptions {
        url: url.reveal().to_owned(),
        direct_url: direct_url.map(|url| url.reveal().to_owned()),
        connections: config.queue.postgres_connections,
        name: config
            .node
            .clone()
            .unwrap_or_else(|| host().trim().to_owned()),
    })
}

pub(super) fn admission_limits(config: &LimitsConfig) -> AdmissionLimits {
    AdmissionLimits {
        max_points: config.max_points,
        max_pair_bytes: config.max_job_memory_mib << 20,
        max_wait: Duration::from_secs(config.max_wait_seconds),
        max_queue: Duration::from_secs(config.max_queue_seconds),
        max_tenant_queue: Duration::from_secs(config.max_tenant_queue_seconds),
    }
}

pub(super) fn service_limits(config: &LimitsConfig) -> ServiceLimits {
    ServiceLimits {
        max_upload_bytes: config.max_upload_mib << 20,
        max_uploads_bytes: config.max_total_upload_mib << 20,
        max_answers_bytes: config.max_answers_mib << 20,
        min_free_bytes: config.min_free_disk_mib << 20,
        min_free_inodes: config.min_free_inodes,
        max_sweeps: config.max_sweeps,
        body_idle: Duration::from_secs(config.body_timeout_seconds),
        stream_prefetch_pairs: config.stream_prefetch_pairs,
    }
}

pub(super) fn listen_options(config: &LimitsConfig) -> ListenOptions {
    ListenOptions {
        max_connections: config.max_connections,
        header_timeout: Duration::from_secs(config.header_timeout_seconds),
        write_timeout: Duration::from_secs(config.write_timeout_seconds),
        ..ListenOptions::default()
    }
}
