//! Other servers that callers may name.

use serde::{Deserialize, Serialize};

use super::secret::Secret;

/// Other servers that callers may name. By default none.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RemoteConfig {
    /// Prefixes of the URIs by which requests may name sweeps instead of sending them, such as
    /// `s3://drives/2026/`, `https://data.example.com/` or `file:///mnt/drives/`. Each ends with a
    /// slash.
    pub sweeps: Vec<String>,
    /// Prefixes of the URIs to which jobs may have their results delivered, such as
    /// `s3://labels/2026/`. Each ends with a slash.
    pub results: Vec<String>,
    /// Prefixes of the URLs that jobs may name as their webhook, such as
    /// `https://hooks.example.com/fnsf/`. Each ends with a slash.
    pub webhooks: Vec<String>,
    /// Secret of the signatures of webhooks: `whsec_` and at least 24 random bytes in base64. Needed
    /// with `webhooks`.
    pub webhook_secret: Option<Secret>,
    /// Allow private addresses, such as 10.0.0.1 and this machine, behind these prefixes.
    pub allow_private_addresses: bool,
}
