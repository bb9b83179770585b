//! The listener of a port: accepting connections, timeouts, memory limits and graceful shutdown.
//!
//! HTTP/1.1 and HTTP/2 (and therefore gRPC) share one socket. All limits of both protocols are set
//! explicitly, since the defaults of the libraries leave some of them open. The public port and the
//! admin port both use this module. Independent of the routes.

pub(super) mod bodies;
mod connections;
mod handshake;
mod serve;
mod stall;

pub(super) use connections::Asking;
pub(crate) use serve::HasRoom;
pub use serve::{ListenOptions, Listener, TlsError, TlsSetup, tls_acceptor};
