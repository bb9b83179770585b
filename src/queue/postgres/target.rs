//! Where the database is, and connections to it.

use std::str::FromStr;
use std::time::Duration;

use postgres::config::SslMode;
use postgres::{Client, Config, NoTls};
use tokio_postgres_rustls::MakeRustlsConnect;

use super::statements::said;
use crate::queue::types::QueueError;

/// Where a queue on PostgreSQL is.
#[derive(Clone, Debug)]
pub struct PostgresOptions {
    /// The URL, `postgres://user:password@host:port/database`, or `host=... dbname=...`. A pooler
    /// in transaction mode may stand between.
    pub url: String,
    /// The URL of the connection that shows that the node is alive and that listens. It must lead to
    /// the database itself or to a pooler in session mode. `None`: `url`.
    pub direct_url: Option<String>,
    /// Number of connections for changes and queries, at least 1. Two more are always open.
    pub connections: usize,
    /// The name of this node, for operators.
    pub name: String,
}

/// A database that can be connected to.
#[derive(Clone)]
pub(super) struct Target {
    config: Config,
    tls: Option<MakeRustlsConnect>,
}

impl Target {
    /// Reads a URL. The certificate of the server is checked against those of the system, or those
    /// in the file that SSL_CERT_FILE names, unless the URL says `sslmode=disable` or the host is a
    /// folder of Unix sockets.
    pub(super) fn of(url: &str) -> Result<Self, QueueError> {
        const PATIENCE: Duration = Duration::from_secs(5);
        // The error of the parser may contain the password.
        let refused = |_| QueueError::Store("the URL of the queue cannot be read".to_owned());
        let mut config = Config::from_str(url).map_err(refused)?;
        config.connect_timeout(*config.get_connect_timeout().unwrap_or(&PATIENCE));
        config.keepalives_idle(PATIENCE);
        config.keepalives_interval(Duration::from_secs(1));
        config.keepalives_retries(5);
        config.tcp_user_timeout(2 * PATIENCE);
        config.application_name("fnsf");
        let plain = config.get_ssl_mode() == SslMode::Disable;
        let tls = match MakeRustlsConnect::with_native_certs() {
            _ if plain => None,
            Ok((tls, _)) => Some(tls),
            Err(_) if config.get_ssl_mode() == SslMode::Prefer => None,
            Err(_) => {
                let none = "the system has no certificates to check the database's against: install \
                            them, or name a file in SSL_CERT_FILE";
                return Err(QueueError::Store(none.to_owned()));
            }
        };
        Ok(Self { config, tls })
    }

    /// Opens a connection. It must not be used on a thread of an async runtime.
    pub(super) fn connect(&self) -> Result<Client, QueueError> {
        let client = match &self.tls {
            Some(tls) => self.config.connect(tls.clone()),
            None => self.config.connect(NoTls),
        };
        client.map_err(|error| QueueError::Store(said(&error)))
    }
}
