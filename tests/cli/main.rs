//! The program through its public door: real files, real processes, exit codes.

mod commands;
mod evaluation;
mod hostile;
mod program;
mod sequences;
