//! `fnsf doctor`: what this machine offers, what is missing, and how to mend it.

mod cards;
mod missing;

use std::time::Instant;

use clap::Args;

use super::failure::Failure;
use super::machine::available_bytes;
use super::output::say;
use crate::flow::cpu::{Isa, NetworkWorkload};

/// Points of the measured cloud: tens of milliseconds at most.
const POINTS: usize = 2048;

/// Show devices and what they can do, what is missing, and how to mend it.
#[derive(Debug, Args)]
pub(super) struct Doctor {}

impl Doctor {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        say(format_args!("fnsf {}", env!("CARGO_PKG_VERSION")))?;
        say(format_args!("cpu: {threads} threads"))?;
        for (place, isa) in Isa::available().into_iter().enumerate() {
            let used = if place == 0 { ", used" } else { "" };
            say(format_args!(
                "  {}: network at {:.0} GFLOP/s a thread{used}",
                isa.name(),
                network_speed(isa) / 1e9
            ))?;
        }
        if !Isa::available().contains(&Isa::Avx2) {
            say(format_args!(
                "  no AVX2: the portable kernels are several times slower"
            ))?;
            say(format_args!(
                "  in a virtual machine, pass the host's CPU features through"
            ))?;
        }
        match available_bytes() {
            Some(bytes) => say(format_args!(
                "memory: {:.1} GB available",
                bytes as f64 / 1e9
            ))?,
            None => say(format_args!("memory: this system does not say"))?,
        }
        cards::report()
    }
}

/// Floating-point operations a second, forward and backward, the best of a few short runs.
fn network_speed(isa: Isa) -> f64 {
    let mut work = NetworkWorkload::new(isa, POINTS);
    let speed = |_| {
        let began = Instant::now();
        let operations = work.forward_and_backward();
        operations / began.elapsed().as_secs_f64()
    };
    (0..5).map(speed).fold(0.0, f64::max)
}
