//! Tests of the file formats from outside: round trips, hostile files and real data.

// cfg(test) is always set in this crate. It makes clippy treat the modules' helper functions as
// tests.
#[cfg(test)]
mod cameras;
#[cfg(test)]
mod decompression_bombs;
#[cfg(test)]
mod dense;
#[cfg(test)]
#[path = "../common/dense_file.rs"]
mod dense_file;
#[cfg(test)]
mod hostile;
#[cfg(test)]
mod las;
#[cfg(test)]
mod poses;
#[cfg(test)]
#[path = "../common/process_memory.rs"]
mod process_memory;
#[cfg(test)]
mod real_data;
#[cfg(test)]
mod recordings;
#[cfg(test)]
mod round_trips;
#[cfg(test)]
mod samples;
#[cfg(test)]
mod scenes;
