//! The program through its public door: real files, real processes, exit codes.

mod commands;
mod hostile;
mod program;
mod sequences;
