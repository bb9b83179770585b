//! Formats, seen from outside: what goes out comes back, what is hostile is refused, what is
//! real is read.

// cfg(test) is always set here; it tells clippy that the modules' plain functions are tests too.
#[cfg(test)]
mod bombs;
#[cfg(test)]
mod cameras;
#[cfg(test)]
mod dense;
#[cfg(test)]
mod hostile;
#[cfg(test)]
mod poses;
#[cfg(test)]
mod real_data;
#[cfg(test)]
mod round_trips;
#[cfg(test)]
mod samples;
