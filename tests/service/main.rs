//! The service through its public doors: the real program, over real sockets, with real files.

mod clouds;
mod grpc;
mod http;
mod kills;
mod load;
mod server;
