//! The public port: who may connect, how long they may take, and how it all ends.
//!
//! HTTP/1.1 and HTTP/2 (and so gRPC) on one socket, with every limit of both written down: the
//! libraries' own defaults leave some of them open. It must not know routes.

mod opening;
mod stall;

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use hyper_util::service::TowerToHyperService;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio::time::timeout;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

use self::opening::Opening;
use self::stall::Stall;
use crate::metrics::Metrics;

/// What a connection may cost.
#[derive(Clone, Debug)]
pub struct ListenOptions {
    /// Open connections; more are closed at once.
    pub max_connections: usize,
    /// Time for a request's headers, and for a TLS handshake.
    pub header_timeout: Duration,
    /// Time that a client may leave an answer unread.
    pub write_timeout: Duration,
    /// Requests at a time on one HTTP/2 connection.
    pub max_streams: u32,
}

impl Default for ListenOptions {
    fn default() -> Self {
        Self {
            max_connections: 1024,
            header_timeout: Duration::from_secs(15),
            write_timeout: Duration::from_secs(60),
            max_streams: 128,
        }
    }
}

/// Headers of one request, bytes and number.
const MAX_HEADER_BYTES: u32 = 16 << 10;
const MAX_HEADERS: usize = 64;
/// Bytes that an HTTP/1.1 connection keeps before it looks at them: its headers and then some.
const MAX_BUFFER: usize = 64 << 10;
/// Streams that a client may reset before the server has answered them, and errors of its own that
/// make the server reset streams, before the connection is closed (CVE-2023-44487, CVE-2025-8671).
const MAX_PENDING_RESETS: usize = 64;
const MAX_ERROR_RESETS: usize = 1024;
/// Bytes under way, so that a distant client's upload is not held back by the round trip.
const STREAM_WINDOW: u32 = 4 << 20;
const CONNECTION_WINDOW: u32 = 16 << 20;
const PING_INTERVAL: Duration = Duration::from_secs(30);
const PING_TIMEOUT: Duration = Duration::from_secs(10);

/// A bound port.
pub struct Listener {
    listener: TcpListener,
    tls: Option<TlsAcceptor>,
    options: ListenOptions,
    metrics: Arc<Metrics>,
}

/// Why TLS cannot be offered.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read, or holds something else.
    #[error("cannot use {path}: {reason}")]
    File {
        /// The file.
        path: String,
        /// What is wrong with it.
        reason: String,
    },
    /// Certificate and key do not belong together.
    #[error(transparent)]
    Rustls(#[from] rustls::Error),
}

/// TLS with a certificate chain and its key, both PEM.
///
/// # Errors
/// [`TlsError`], which names the file.
pub fn tls_acceptor(certificate: &Path, key: &Path) -> Result<TlsAcceptor, TlsError> {
    let bad = |path: &Path, error: &dyn std::fmt::Display| TlsError::File {
        path: path.display().to_string(),
        reason: error.to_string(),
    };
    let chain: Vec<_> = CertificateDer::pem_file_iter(certificate)
        .and_then(Iterator::collect)
        .map_err(|error| bad(certificate, &error))?;
    let private = PrivateKeyDer::from_pem_file(key).map_err(|error| bad(key, &error))?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()?
        .with_no_client_auth()
        .with_single_cert(chain, private)?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    Ok(TlsAcceptor::from(Arc::new(config)))
}

impl Listener {
    /// Binds `address`.
    ///
    /// # Errors
    /// Where the address is taken or not ours.
    pub async fn bind(
        address: SocketAddr,
        tls: Option<TlsAcceptor>,
        options: ListenOptions,
        metrics: Arc<Metrics>,
    ) -> std::io::Result<Self> {
        Ok(Self {
            listener: TcpListener::bind(address).await?,
            tls,
            options,
            metrics,
        })
    }

    /// Where it listens.
    ///
    /// # Errors
    /// Where the system does not say.
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// Serves until `stop`, then lets every connection finish what it is answering.
    pub async fn serve(self, router: Router, stop: CancellationToken) {
        const PAUSE: Duration = Duration::from_millis(50);
        let room = Arc::new(Semaphore::new(self.options.max_connections));
        let mut connections = JoinSet::new();
        loop {
            let accepted = tokio::select! {
                biased;
                () = stop.cancelled() => break,
                Some(_) = connections.join_next() => continue,
                accepted = self.listener.accept() => accepted,
            };
            let stream = match accepted {
                Ok((stream, _)) => stream,
                Err(error) => {
                    // Out of file descriptors, mostly: those that are open will be closed.
                    tracing::warn!(%error, "a connection was not accepted");
                    tokio::time::sleep(PAUSE).await;
                    continue;
                }
            };
            let Ok(permit) = Arc::clone(&room).try_acquire_owned() else {
                tracing::debug!("too many connections");
                continue;
            };
            let (router, stop) = (router.clone(), stop.clone());
            let (tls, options) = (self.tls.clone(), self.options.clone());
            let open = self.metrics.connection();
            connections.spawn(async move {
                converse(stream, tls, &options, router, stop).await;
                drop((permit, open));
            });
        }
        drop(self.listener);
        while connections.join_next().await.is_some() {}
    }
}

async fn converse(
    stream: TcpStream,
    tls: Option<TlsAcceptor>,
    options: &ListenOptions,
    router: Router,
    stop: CancellationToken,
) {
    if let Err(error) = stream.set_nodelay(true) {
        tracing::debug!(%error, "a connection was lost");
        return;
    }
    let stream = Stall::new(stream, options.write_timeout);
    match tls {
        None => answer(stream, options, router, stop).await,
        Some(tls) => match timeout(options.header_timeout, tls.accept(stream)).await {
            Ok(Ok(stream)) => answer(stream, options, router, stop).await,
            Ok(Err(error)) => tracing::debug!(%error, "a handshake failed"),
            Err(_) => tracing::debug!("a handshake took too long"),
        },
    }
}

async fn answer<S>(stream: S, options: &ListenOptions, router: Router, stop: CancellationToken)
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let mut builder = Builder::new(TokioExecutor::new());
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(options.header_timeout)
        .max_headers(MAX_HEADERS)
        .max_buf_size(MAX_BUFFER);
    builder
        .http2()
        .timer(TokioTimer::new())
        .max_concurrent_streams(options.max_streams)
        .max_local_error_reset_streams(MAX_ERROR_RESETS)
        .max_pending_accept_reset_streams(MAX_PENDING_RESETS)
        .max_header_list_size(MAX_HEADER_BYTES)
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
        .keep_alive_interval(PING_INTERVAL)
        .keep_alive_timeout(PING_TIMEOUT);
    let service = TowerToHyperService::new(router);
    let stream = Opening::new(stream, options.header_timeout);
    let connection = builder.serve_connection(TokioIo::new(stream), service);
    let mut connection = std::pin::pin!(connection);
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        () = stop.cancelled() => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = ended {
        tracing::debug!(%error, "a connection ended early");
    }
}
