//! Tests of the program from outside: real files, real processes, exit codes.

mod commands;
mod evaluation;
#[path = "../common/gpu.rs"]
mod gpu_rule;
mod hostile;
mod label;
#[path = "../common/object_server.rs"]
mod object_server;
mod program;
mod sequences;
mod tables;
mod view;
