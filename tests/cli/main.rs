//! Tests of the program from outside: real files, real processes, exit codes.

#![expect(
    clippy::print_stderr,
    reason = "helpers of tests say what they leave out"
)]

mod commands;
#[path = "../common/dense_file.rs"]
mod dense_file;
mod deskew;
mod evaluation;
mod export;
mod follow;
#[path = "../common/gpu.rs"]
mod gpu_rule;
mod hostile;
mod label;
mod label_datasets;
mod label_hostile;
mod label_manifest;
mod label_repair;
mod laz;
#[path = "../common/object_server.rs"]
mod object_server;
#[path = "../common/process_memory.rs"]
mod process_memory;
mod program;
#[path = "../common/real_data.rs"]
mod real_data;
mod sequences;
mod tables;
mod unpack;
mod view;
