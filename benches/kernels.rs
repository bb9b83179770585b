//! Throughput of the network's CPU kernels, as a share of the measured multiply-add peak.
//!
//! ```text
//! cargo bench --bench kernels
//! ```
//!
//! Every round measures the peak and the kernels, so that other load on the machine slows both. The
//! share is computed in each round, and the median over the rounds is printed. The portable kernels
//! have no fused multiply-add peak of their own. They are compared with the peak of the fastest
//! instruction set.
#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]

use std::sync::Barrier;
use std::time::Instant;

use fnsf::flow::cpu::{Isa, NetworkWorkload, multiply_add_peak};

/// Points of the cloud, as in the published setting with sampling.
const POINTS: usize = 8192;
const ROUNDS: usize = 15;
/// Rounds of the peak loop. It takes about as long as one pass over the points.
const PEAK_ROUNDS: usize = 8_000_000;

/// The results of one round on one thread, in floating-point operations per second.
#[derive(Clone, Copy)]
struct Round {
    peak: f64,
    forward: f64,
    both: f64,
}

fn speed(work: impl FnOnce() -> f64) -> f64 {
    let began = Instant::now();
    let operations = work();
    operations / began.elapsed().as_secs_f64()
}

/// Measures on `threads` threads at the same time. Returns the rounds of all threads.
fn measure(isa: Isa, threads: usize) -> Vec<Round> {
    let start = Barrier::new(threads);
    let peak_of = match isa {
        Isa::Portable => Isa::available()[0],
        fused => fused,
    };
    let one_thread = || {
        let mut work = NetworkWorkload::new(isa, POINTS);
        work.forward_and_backward();
        let round = |_| {
            start.wait();
            let before = speed(|| multiply_add_peak(peak_of, PEAK_ROUNDS));
            let forward = speed(|| work.forward());
            let both = speed(|| work.forward_and_backward());
            let after = speed(|| multiply_add_peak(peak_of, PEAK_ROUNDS));
            Round {
                peak: before.max(after),
                forward,
                both,
            }
        };
        (0..ROUNDS).map(round).collect::<Vec<_>>()
    };
    std::thread::scope(|scope| {
        let running: Vec<_> = (0..threads).map(|_| scope.spawn(one_thread)).collect();
        let rounds = running
            .into_iter()
            .map(|thread| thread.join().unwrap_or_default());
        rounds.flatten().collect()
    })
}

fn median(rounds: &[Round], value: impl Fn(&Round) -> f64) -> f64 {
    let mut values: Vec<f64> = rounds.iter().map(value).collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    println!(
        "{POINTS} points, {ROUNDS} rounds; GFLOP/s a thread and share of the peak (medians)\n"
    );
    println!("| instructions | threads | peak | forward | share | forward + backward | share |");
    println!("|---|---|---|---|---|---|---|");
    for isa in Isa::available() {
        for threads in [1, cores] {
            let rounds = measure(isa, threads);
            println!(
                "| {} | {threads} | {:.1} | {:.1} | {:.1}% | {:.1} | {:.1}% |",
                isa.name(),
                median(&rounds, |r| r.peak) / 1e9,
                median(&rounds, |r| r.forward) / 1e9,
                median(&rounds, |r| r.forward / r.peak) * 100.0,
                median(&rounds, |r| r.both) / 1e9,
                median(&rounds, |r| r.both / r.peak) * 100.0,
            );
        }
    }
}
