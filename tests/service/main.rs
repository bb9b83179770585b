//! Tests of the service from outside: the real program, real sockets and real files.

#![expect(
    clippy::panic,
    clippy::print_stderr,
    reason = "helpers of tests fail loudly and say what they leave out"
)]

mod access;
mod access_tls;
mod attacks_connections;
mod attacks_files;
mod attacks_grpc;
mod attacks_http2;
mod attacks_memory;
mod attacks_requests;
mod attacks_tenants;
mod backup;
mod browser;
mod clouds;
mod command_line;
mod console;
mod console_browser;
mod console_pages;
mod crash_recovery;
mod deliveries;
mod devices;
mod fleet;
#[path = "../common/gpu.rs"]
mod gpu_rule;
mod grpc;
mod http;
mod info;
mod load;
mod network_cut;
mod nonsense;
#[path = "../common/object_server.rs"]
mod object_server;
mod objects;
mod poses;
#[path = "../common/postgres_server.rs"]
mod postgres_server;
#[path = "../common/process_memory.rs"]
mod process_memory;
mod raw_http;
mod readme;
#[path = "../common/real_data.rs"]
mod real_data;
mod reload;
mod removal;
mod retries;
mod sequences;
mod server;
mod slow_readers;
mod sources;
mod store_trouble;
mod tracks;
mod upgrade;
mod webdriver;
mod webhooks;
mod windows;
