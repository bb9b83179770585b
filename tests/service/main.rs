//! The service through its public doors: the real program, over real sockets, with real files.

#![expect(
    clippy::panic,
    clippy::print_stderr,
    reason = "helpers of tests fail loudly and say what they leave out"
)]

mod clouds;
mod grpc;
mod http;
mod kills;
mod load;
mod readme;
mod server;
