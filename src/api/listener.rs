//! A port: who may connect, how long they may take, and how it all ends.
//!
//! HTTP/1.1 and HTTP/2 (and so gRPC) on one socket, with every limit of both written down: the
//! libraries' own defaults leave some of them open. The public port and the admin port are such.
//! It must not know routes.

mod bodies;
mod connections;
mod opening;
mod stall;

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

use self::bodies::AnswerBody;
pub(super) use self::bodies::RequestBody;
pub(super) use self::connections::Asking;
use self::connections::{Connections, Entry, Patience, Verdict};
use self::opening::Opening;
use self::stall::Stall;
use crate::health::{HEARTBEAT, Heartbeat};
use crate::metrics::Metrics;

/// What a connection may cost.
#[derive(Clone, Debug)]
pub struct ListenOptions {
    /// Open connections. Past it, one that is needed less makes room, or the new one is closed.
    pub max_connections: usize,
    /// Time for a request's headers, for a TLS handshake, and between two requests.
    pub header_timeout: Duration,
    /// Time that a client may leave an answer unread.
    pub write_timeout: Duration,
    /// Requests at a time on one HTTP/2 connection.
    pub max_streams: u32,
    /// Bytes of all answers that are handed over and not taken, but for results, which have room of
    /// their own.
    pub max_answer_bytes: usize,
    /// Whether a connection has to show a good key: else it ends after two header timeouts.
    pub needs_key: bool,
}

impl ListenOptions {
    /// Those of the admin port: small questions, no keys.
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

    /// How often a connection is looked at.
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

/// Headers of one request, bytes and number.
const MAX_HEADER_BYTES: u32 = 16 << 10;
const MAX_HEADERS: usize = 64;
/// Bytes that an HTTP/1.1 connection keeps before it looks at them: its headers and then some.
const MAX_BUFFER: usize = 64 << 10;
/// Streams that a client may reset before the server has answered them, and errors of its own that
/// make the server reset streams, before the connection is closed (CVE-2023-44487, CVE-2025-8671).
const MAX_PENDING_RESETS: usize = 64;
const MAX_ERROR_RESETS: usize = 1024;
/// Bytes that the system may hold unsent before it says that it takes more: with megabytes, a slow
/// line would look like one that takes nothing.
#[cfg(target_os = "linux")]
const UNSENT: u32 = 128 << 10;

/// Bytes under way, so that a distant client's upload is not held back by the round trip; and no more
/// of them than all connections together may have while their readers wait.
const STREAM_WINDOW: u32 = 1 << 20;
const CONNECTION_WINDOW: u32 = 2 << 20;
const PING_INTERVAL: Duration = Duration::from_secs(30);
const PING_TIMEOUT: Duration = Duration::from_secs(10);

/// Marks an answer whose body has room of its own.
#[derive(Clone, Copy)]
pub(super) struct HasRoom;

/// Time that a connection which has to make room may take for that.
const EVICTION: Duration = Duration::from_millis(200);

/// A bound port.
pub struct Listener {
    listener: TcpListener,
    tls: Option<TlsAcceptor>,
    options: ListenOptions,
    metrics: Option<Arc<Metrics>>,
    heartbeat: Arc<Heartbeat>,
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
    /// Binds `address`. Connections are counted in `metrics`, where they are given.
    ///
    /// # Errors
    /// Where the address is taken or not ours.
    pub async fn bind(
        address: SocketAddr,
        tls: Option<TlsAcceptor>,
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

    /// Serves from a socket that is bound already; to be called where it will be served.
    ///
    /// # Errors
    /// Where the socket cannot be waited for.
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

    /// Where it listens.
    ///
    /// # Errors
    /// Where the system does not say.
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// The sign of life of the loop that accepts.
    pub fn heartbeat(&self) -> Arc<Heartbeat> {
        Arc::clone(&self.heartbeat)
    }

    /// Serves until `stop`, then lets every connection finish what it is answering.
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
                    // Out of file descriptors, mostly: those that are open will be closed.
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
            let (tls, options) = (self.tls.clone(), self.options.clone());
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

/// A place for one more connection; one that is needed less may have to make it.
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
    tls: Option<TlsAcceptor>,
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

/// What answers, and the room that answers have.
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
    // Once it is asked to close, it may still send what is on its way.
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
