//! Many cores: one pair at a time on all threads, against several pairs side by side on a share of
//! them each.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo bench --bench side_by_side -- [--lanes LxT,LxT,...] [--preset NAME]
//! ```
//!
//! `4x2` is four lanes of two threads each. By default the lanes times their threads are the cores.
#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]

mod common;

use std::thread::available_parallelism;
use std::time::Instant;

use common::{Scene, median, scenes};
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::field::Backend;
use fnsf::flow::{Control, Options, Preset, Problem, estimate};

/// Pairs of each lane in a round.
const PAIRS: usize = 8;
/// Rounds, in which all arrangements take turns.
const ROUNDS: usize = 3;

/// A clock for the numerics.
struct Clock(Instant);

impl Control for Clock {
    fn seconds(&self) -> f64 {
        self.0.elapsed().as_secs_f64()
    }
}

fn main() -> Result<(), String> {
    let cores = available_parallelism().map_err(|e| e.to_string())?.get();
    let powers = (0..usize::BITS)
        .map(|power| 1 << power)
        .take_while(|&threads| threads <= cores);
    let mut arrangements: Vec<[usize; 2]> =
        powers.map(|threads| [cores / threads, threads]).collect();
    let mut preset = Preset::Default;
    let mut words = std::env::args().skip(1).filter(|word| word != "--bench");
    while let Some(word) = words.next() {
        let value = words.next().ok_or(format!("{word}: a value is missing"))?;
        match word.as_str() {
            "--lanes" => {
                let arrangement = |text: &str| {
                    let (lanes, threads) = text.split_once('x')?;
                    Some([lanes.parse().ok()?, threads.parse().ok()?])
                };
                let read: Option<Vec<_>> = value.split(',').map(arrangement).collect();
                arrangements = read.ok_or(format!("{value}: not a list of LxT"))?;
            }
            "--preset" => {
                let named = Preset::ALL.into_iter().find(|p| p.name() == value);
                preset = named.ok_or(format!("{value}: no such preset"))?;
            }
            _ => return Err(format!("{word}: no such option")),
        }
    }
    println!(
        "`{}`, whole sweeps, {cores} cores, medians of {ROUNDS} rounds\n",
        preset.name()
    );
    println!(
        "| scene | points | lanes | threads each | ms a pair | pairs a second | times one lane |"
    );
    println!("|---|---|---|---|---|---|---|");
    for scene in scenes()? {
        table(&scene, &preset.options(None), &arrangements)?;
    }
    Ok(())
}

/// One row for each arrangement of lanes and their threads.
fn table(scene: &Scene, options: &Options, arrangements: &[[usize; 2]]) -> Result<(), String> {
    let mut rates = vec![Vec::new(); arrangements.len()];
    for _ in 0..ROUNDS {
        for (&[lanes, threads], rates) in arrangements.iter().zip(&mut rates) {
            rates.push(rate(scene, options, lanes, threads)?);
        }
    }
    let rates: Vec<f64> = rates.into_iter().map(median).collect();
    let one = arrangements.iter().position(|&[lanes, _]| lanes == 1);
    for (&[lanes, threads], &rate) in arrangements.iter().zip(&rates) {
        let ratio = one.map_or(f64::NAN, |one| rate / rates[one]);
        println!(
            "| {} | {} | {lanes} | {threads} | {:.1} | {rate:.1} | {ratio:.2} |",
            scene.name,
            scene.source.len(),
            lanes as f64 / rate * 1e3,
        );
    }
    Ok(())
}

/// Pairs a second of `lanes` lanes with `threads` threads each.
fn rate(scene: &Scene, options: &Options, lanes: usize, threads: usize) -> Result<f64, String> {
    let backends: Result<Vec<_>, _> = (0..lanes).map(|_| CpuBackend::new(Some(threads))).collect();
    let backends = backends.map_err(|e| e.to_string())?;
    let solve = |backend: &CpuBackend| -> Result<(), String> {
        let problem = Problem::pair(&scene.source, &scene.target);
        backend.host().clear_cache();
        let clock = Clock(Instant::now());
        let solved = estimate(backend, &problem, options, &clock);
        solved.map(|_| ()).map_err(|e| e.to_string())
    };
    // Every lane's first pair is not timed.
    let run = |pairs: usize| -> Result<f64, String> {
        let began = Instant::now();
        std::thread::scope(|scope| {
            let lanes: Vec<_> = backends
                .iter()
                .map(|backend| scope.spawn(move || (0..pairs).try_for_each(|_| solve(backend))))
                .collect();
            let panicked = |_| "a lane panicked".to_owned();
            lanes
                .into_iter()
                .try_for_each(|lane| lane.join().map_err(panicked)?)
        })?;
        Ok(began.elapsed().as_secs_f64())
    };
    run(1)?;
    Ok((lanes * PAIRS) as f64 / run(PAIRS)?)
}
