//! A deadline and progress: the best flow of a simulated pair within 200 milliseconds.
//!
//! ```text
//! cargo run --release --example deadline
//! ```
#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "the progress and the result are printed"
)]

use std::time::{Duration, Instant};

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{Control, Interrupt, Preset, Problem, Progress, estimate};

/// A deadline by the wall clock.
struct Deadline {
    began: Instant,
    limit: Duration,
}

impl Control for Deadline {
    fn seconds(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    /// The estimate plans its work by this.
    fn seconds_left(&self) -> Option<f64> {
        let left = self.limit.saturating_sub(self.began.elapsed());
        Some(left.as_secs_f64())
    }

    /// Ends the work where the plan was too optimistic.
    fn interrupt(&self) -> Option<Interrupt> {
        (self.began.elapsed() >= self.limit).then_some(Interrupt::Deadline)
    }

    fn progress(&self, progress: Progress) {
        eprint!("\r{} of {}", progress.done, progress.total);
    }
}

fn main() -> anyhow::Result<()> {
    let pair = Street::new(&StreetOptions::default())?.pair(0)?;
    let problem = Problem::pair(&pair.source, &pair.target);
    let options = Preset::Neural.options(None);
    let backend = CpuBackend::new(None)?;
    let control = Deadline {
        began: Instant::now(),
        limit: Duration::from_millis(200),
    };
    let estimate = estimate(&backend, &problem, &options, &control)?;
    // The reason says whether the deadline has shortened the work.
    println!(
        "\n{:?} after {:.3} s: {} points have a flow",
        estimate.stop_reason,
        control.seconds(),
        estimate.points
    );
    Ok(())
}
