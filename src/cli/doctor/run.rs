//! The `doctor` command.

use std::time::Instant;

use clap::Args;

use super::gpus;
use crate::cli::failure::Failure;
use crate::cli::machine::available_bytes;
use crate::cli::output::show;
use crate::flow::cpu::{Isa, NetworkWorkload};

/// Points of the benchmark's cloud; a run takes tens of milliseconds at most.
const POINTS: usize = 2048;

/// Show this machine's compute devices and their capabilities, and how to install missing GPU
/// drivers
#[derive(Debug, Args)]
pub(crate) struct Doctor {}

impl Doctor {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        show(format_args!("fnsf {}", env!("CARGO_PKG_VERSION")))?;
        show(format_args!("cpu: {threads} threads"))?;
        for (index, isa) in Isa::available().into_iter().enumerate() {
            let used = if index == 0 { ", used" } else { "" };
            show(format_args!(
                "  {}: network at {:.0} GFLOP/s a thread{used}",
                isa.name(),
                network_speed(isa) / 1e9
            ))?;
        }
        if !Isa::available().contains(&Isa::Avx2) {
            show(format_args!(
                "  no AVX2: the portable kernels are several times slower"
            ))?;
            show(format_args!(
                "  in a virtual machine, pass the host's CPU features through"
            ))?;
        }
        match available_bytes() {
            Some(bytes) => show(format_args!(
                "memory: {:.1} GB available",
                bytes as f64 / 1e9
            ))?,
            None => show(format_args!("memory: this system does not say"))?,
        }
        gpus::report()
    }
}

/// The speed of the network on one thread, forward and backward pass, in floating-point operations
/// per second: the best of five runs.
fn network_speed(isa: Isa) -> f64 {
    let mut work = NetworkWorkload::new(isa, POINTS);
    let speed = |_| {
        let began = Instant::now();
        let operations = work.forward_and_backward();
        operations / began.elapsed().as_secs_f64()
    };
    (0..5).map(speed).fold(0.0, f64::max)
}
