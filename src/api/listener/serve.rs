//! The accept loop of a port, and the HTTP server of each connection.
//!
//! Each connection passes a TLS handshake (optional), a timeout for protocol detection, and hyper's
//! HTTP/1.1 and HTTP/2 server. A timer closes connections that are idle, unauthenticated or do not
//! read. At the connection limit a less important connection is evicted. On shutdown the listener
//! stops accepting and lets open requests finish.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use hyper::Request;
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};

use super::bodies::RequestBody;

#[cfg(target_os = "linux")]
use socket2::SockRef;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt;

use super::bodies::AnswerBody;
use super::connections::{Connections, Entry, Patience, Verdict};
use super::handshake::Opening;
use super::stall::Stall;
use crate::health::{HEARTBEAT, Heartbeat};
use crate::metrics::Metrics;
use crate::sync::Exchange;

/// The limits of a port and its connections.
#[derive(Clone, Debug)]
pub struct ListenOptions {
    /// Maximum number of open connections. Beyond it a less important connection is evicted, or
    /// else the new one is closed.
    pub max_connections: usize,
    /// Timeout for the headers of a request, for a TLS handshake, and between two requests of a
    /// connection.
    pub header_timeout: Duration,
    /// Time after which a client that does not read its response is disconnected.
    pub write_timeout: Duration,
    /// Maximum number of concurrent requests on one HTTP/2 connection.
    pub max_streams: u32,
    /// Budget for the unread parts of all responses, bytes. Beyond it a response ends with an
    /// error. Responses with results have their own budget.
    pub max_answer_bytes: usize,
    /// Whether requests need a key. Then a connection without a valid key is closed after two
    /// header timeouts if it has no open request, and terminated after four.
    pub needs_key: bool,
}

impl ListenOptions {
    /// The options of the admin port: small requests without keys.
    pub fn of_admin() -> Self {
        Self {
            max_connections: 64,
            header_timeout: Duration::from_secs(5),
            write_timeout: Duration::from_secs(10),
            max_streams: 8,
            max_answer_bytes: 16 << 20,
            needs_key: false,
        }
    }

    fn patience(&self) -> Patience {
        Patience {
            idle: self.header_timeout,
            unknown: self.needs_key.then_some(self.header_timeout * 2),
            unread: self.write_timeout,
        }
    }

    /// The interval at which a connection is checked.
    fn look(&self) -> Duration {
        let shortest = self.header_timeout.min(self.write_timeout) / 4;
        shortest.clamp(Duration::from_millis(50), Duration::from_secs(1))
    }
}

impl Default for ListenOptions {
    fn default() -> Self {
        Self {
            max_connections: 1024,
            header_timeout: Duration::from_secs(15),
            write_timeout: Duration::from_secs(60),
            max_streams: 128,
            max_answer_bytes: 256 << 20,
            needs_key: false,
        }
    }
}

/// Maximum size of the headers of an HTTP/2 request, bytes.
const MAX_HEADER_BYTES: u32 = 16 << 10;
/// Maximum number of headers of an HTTP/1.1 request.
const MAX_HEADERS: usize = 64;
/// Size of the read buffer of an HTTP/1.1 connection, bytes. It bounds the headers of a request.
const MAX_BUFFER: usize = 64 << 10;
/// Maximum number of streams that a client may reset before the server has accepted them
/// (CVE-2023-44487). Beyond it the connection is closed.
const MAX_PENDING_RESETS: usize = 64;
/// Maximum number of streams that the server resets because of errors of the client
/// (CVE-2025-8671). Beyond it the connection is closed.
const MAX_ERROR_RESETS: usize = 1024;
/// Unsent bytes in the socket buffer up to which the socket is writable (TCP_NOTSENT_LOWAT). With
/// megabytes, a slow client could not be distinguished from one that does not read.
#[cfg(target_os = "linux")]
const UNSENT: u32 = 128 << 10;

/// HTTP/2 flow-control window of a stream, bytes. Large enough that the round-trip time does not
/// limit an upload, and small enough for the memory of all connections while their readers wait.
const STREAM_WINDOW: u32 = 1 << 20;
/// HTTP/2 flow-control window of a connection, bytes.
const CONNECTION_WINDOW: u32 = 2 << 20;
/// Interval of HTTP/2 keep-alive pings, which detect half-open connections.
const PING_INTERVAL: Duration = Duration::from_secs(30);
/// Time after which a missing reply to a ping closes the connection.
const PING_TIMEOUT: Duration = Duration::from_secs(10);

/// Marks a response whose body has its own memory reservation.
#[derive(Clone, Copy)]
pub(crate) struct HasRoom;

/// Time that an evicted connection has to close.
const EVICTION: Duration = Duration::from_millis(200);

/// A bound TCP port, which [`Listener::serve`] serves over HTTP/1.1 and HTTP/2.
pub struct Listener {
    listener: TcpListener,
    tls: Option<Arc<TlsSetup>>,
    options: ListenOptions,
    metrics: Option<Arc<Metrics>>,
    heartbeat: Arc<Heartbeat>,
}

/// The certificate and the key of a port, which can be exchanged.
pub struct TlsSetup(Exchange<TlsAcceptor>);

impl TlsSetup {
    /// The setup of a port that begins with this acceptor.
    pub fn new(acceptor: TlsAcceptor) -> Self {
        Self(Exchange::new(acceptor))
    }

    /// Exchanges the acceptor of the connections from now on.
    pub fn set(&self, acceptor: TlsAcceptor) {
        self.0.set(acceptor);
    }
}

/// Why TLS cannot be configured.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read, or has invalid contents.
    #[error("cannot use {path}: {reason}")]
    File {
        /// The path of the file.
        path: String,
        /// The reason.
        reason: String,
    },
    /// The certificate and the key are invalid or do not match.
    #[error(transparent)]
    Rustls(#[from] rustls::Error),
}

/// A TLS acceptor with a certificate chain and its private key, both paths of PEM files. It offers
/// HTTP/2 and HTTP/1.1 (ALPN).
///
/// # Errors
/// [`TlsError::File`] if a file cannot be read or is not such a PEM file. [`TlsError::Rustls`] if
/// the certificate and the key are invalid or do not match.
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
    /// Binds `address`. Without `tls` the port is unencrypted. If `metrics` is given, it counts the
    /// open connections.
    ///
    /// # Errors
    /// The error of the operating system, for example if the address is in use.
    pub async fn bind(
        address: SocketAddr,
        tls: Option<Arc<TlsSetup>>,
        options: ListenOptions,
        metrics: Option<Arc<Metrics>>,
    ) -> std::io::Result<Self> {
        Ok(Self {
            listener: TcpListener::bind(address).await?,
            tls,
            options,
            metrics,
            heartbeat: Arc::default(),
        })
    }

    /// A listener without TLS and metrics on a socket that is already bound. Must be called in the
    /// runtime that will serve it.
    ///
    /// # Errors
    /// If the socket cannot be made non-blocking or registered with the runtime.
    ///
    /// # Panics
    /// Outside of a Tokio runtime.
    pub fn on(socket: std::net::TcpListener, options: ListenOptions) -> std::io::Result<Self> {
        socket.set_nonblocking(true)?;
        Ok(Self {
            listener: TcpListener::from_std(socket)?,
            tls: None,
            options,
            metrics: None,
            heartbeat: Arc::default(),
        })
    }

    /// The local address of the port, with the port number that the system chose if 0 was asked
    /// for.
    ///
    /// # Errors
    /// The error of the operating system.
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// The heartbeat of the accept loop.
    pub fn heartbeat(&self) -> Arc<Heartbeat> {
        Arc::clone(&self.heartbeat)
    }

    /// Serves connections until `stop` is cancelled, then shuts down gracefully: no connection is
    /// accepted any more, and open requests are finished. Returns when all connections have ended.
    ///
    /// # Panics
    /// If `max_connections` or `max_answer_bytes` is above [`Semaphore::MAX_PERMITS`].
    pub async fn serve(self, router: Router, stop: CancellationToken) {
        const PAUSE: Duration = Duration::from_millis(50);
        let room = Arc::new(Semaphore::new(self.options.max_connections));
        let table = Arc::new(Connections::new(self.options.max_connections));
        let answers = Arc::new(Semaphore::new(self.options.max_answer_bytes));
        let mut connections = JoinSet::new();
        let mut beats = interval(HEARTBEAT);
        loop {
            self.heartbeat.beat();
            let accepted = tokio::select! {
                biased;
                () = stop.cancelled() => break,
                Some(_) = connections.join_next() => continue,
                accepted = self.listener.accept() => accepted,
                _ = beats.tick() => continue,
            };
            let (stream, address) = match accepted {
                Ok((stream, address)) => (stream, address.ip()),
                Err(error) => {
                    // Usually the process is out of file descriptors. Some become free when
                    // connections close.
                    tracing::warn!(%error, "a connection was not accepted");
                    sleep(PAUSE).await;
                    continue;
                }
            };
            let Some(permit) = room_for(&room, &table).await else {
                tracing::debug!("too many connections");
                continue;
            };
            let entry = table.enter(address);
            let (router, stop) = (router.clone(), stop.clone());
            let tls = self.tls.as_ref().map(|tls| tls.0.get());
            let options = self.options.clone();
            let answers = Arc::clone(&answers);
            let open = self.metrics.as_ref().map(|metrics| metrics.connection());
            connections.spawn(async move {
                tokio::select! {
                    () = entry.connection.evicted() => tracing::debug!("a connection made room"),
                    () = converse(stream, tls, &options, (router, answers), stop, &entry) => {}
                }
                drop((entry, permit, open));
            });
        }
        drop(self.listener);
        while connections.join_next().await.is_some() {}
    }
}

/// A permit for one more connection. At the limit, a less important connection is evicted. `None`
/// if there is none, or it does not close in time.
async fn room_for(room: &Arc<Semaphore>, table: &Connections) -> Option<OwnedSemaphorePermit> {
    if let Ok(permit) = Arc::clone(room).try_acquire_owned() {
        return Some(permit);
    }
    if !table.make_room() {
        return None;
    }
    let made = timeout(EVICTION, Arc::clone(room).acquire_owned()).await;
    made.ok()?.ok()
}

async fn converse(
    stream: TcpStream,
    tls: Option<Arc<TlsAcceptor>>,
    options: &ListenOptions,
    served: Served,
    stop: CancellationToken,
    entry: &Entry,
) {
    if let Err(error) = stream.set_nodelay(true) {
        tracing::debug!(%error, "a connection was lost");
        return;
    }
    #[cfg(target_os = "linux")]
    if let Err(error) = SockRef::from(&stream).set_tcp_notsent_lowat(UNSENT) {
        tracing::debug!(%error, "the system tells late of what is read");
    }
    let stream = Stall::new(stream, options.write_timeout);
    match tls {
        None => answer(stream, options, served, stop, entry).await,
        Some(tls) => match timeout(options.header_timeout, tls.accept(stream)).await {
            Ok(Ok(stream)) => answer(stream, options, served, stop, entry).await,
            Ok(Err(error)) => tracing::debug!(%error, "a handshake failed"),
            Err(_) => tracing::debug!("a handshake took too long"),
        },
    }
}

/// The router, and the budget for unread responses in bytes.
type Served = (Router, Arc<Semaphore>);

async fn answer<S>(
    stream: S,
    options: &ListenOptions,
    (router, answers): Served,
    stop: CancellationToken,
    entry: &Entry,
) where
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
    let peer = Arc::clone(&entry.connection);
    let service = service_fn(move |request: Request<Incoming>| {
        let open = peer.begin();
        let mut request = request.map(|body| Body::new(RequestBody::new(body)));
        request.extensions_mut().insert(open.asking());
        let answering = router.clone().oneshot(request);
        let answers = Arc::clone(&answers);
        async move {
            let response = answering.await;
            response.map(|response| {
                let has_room = response.extensions().get::<HasRoom>().is_some();
                let room = (!has_room).then_some(answers);
                response.map(|body| AnswerBody::new(body, open, room))
            })
        }
    });
    let stream = Opening::new(stream, options.header_timeout);
    let connection = builder.serve_connection(TokioIo::new(stream), service);
    let mut connection = std::pin::pin!(connection);
    let patience = options.patience();
    let mut looks = interval(options.look());
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    // The start of the graceful shutdown of this connection. Responses in progress may still be
    // sent.
    let mut closing: Option<Instant> = None;
    loop {
        tokio::select! {
            ended = connection.as_mut() => {
                if let Err(error) = ended {
                    tracing::debug!(%error, "a connection ended early");
                }
                return;
            }
            () = stop.cancelled(), if closing.is_none() => {
                connection.as_mut().graceful_shutdown();
                closing = Some(Instant::now());
            }
            _ = looks.tick() => match (entry.connection.verdict(&patience), closing) {
                (Verdict::Close, None) => {
                    connection.as_mut().graceful_shutdown();
                    closing = Some(Instant::now());
                }
                (Verdict::Close, Some(since)) if since.elapsed() > patience.unread => return,
                (Verdict::End, _) => {
                    tracing::debug!("a connection was ended: it does not read, or shows no key");
                    return;
                }
                _ => {}
            },
        }
    }
}
