//! GPU benchmark: each kernel against the measured arithmetic peak of the GPU, whole pairs of four
//! sizes, many small pairs at once, and object searches with and without the GPU, alone and on lanes.
//!
//! ```text
//! cargo bench --bench gpu -- [CARD] [--points N,N,...] [--pairs N,N,...] [--tables NAME,NAME,...]
//! ```
//!
//! `CARD` is an index, a PCI id or a part of the name. The default is the first hardware GPU.
//! `benches/gpu.sh` runs this benchmark, the tests and the PyTorch peer from prebuilt programs.
#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]

mod common;

use std::time::Instant;

use common::{median, scenes};
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::field::Backend;
use fnsf::flow::gpu::{
    Adapter, Gpu, GpuOptions, KernelTime, Selector, arithmetic_peak, kernel_times, select,
};
use fnsf::flow::simulate::{SimulatedPair, Street, StreetOptions};
use fnsf::flow::{Control, Estimate, Options, Precision, Preset, Problem, estimate};

/// Timed runs of each pair, after one warm-up run.
const RUNS: u64 = 5;
/// Rounds of each kernel.
const ROUNDS: usize = 10;
/// The tables, in the order in which they are made by default.
const TABLES: [&str; 5] = ["kernels", "objects", "lanes", "pairs", "batches"];
/// Points of each pair in the batch measurement.
const SMALL: usize = 8192;

/// A clock for the numerics.
struct Clock(Instant);

impl Control for Clock {
    fn seconds(&self) -> f64 {
        self.0.elapsed().as_secs_f64()
    }
}

/// The command-line arguments.
struct Arguments {
    card: Selector,
    points: Vec<usize>,
    pairs: Vec<usize>,
    tables: Vec<String>,
}

impl Arguments {
    fn read() -> Result<Self, String> {
        let mut asked = Self {
            card: Selector::Any,
            points: vec![SMALL, 50_000, 90_000, 150_000],
            pairs: vec![1, 8, 64],
            tables: TABLES.map(str::to_owned).to_vec(),
        };
        let mut arguments = std::env::args().skip(1).filter(|word| word != "--bench");
        while let Some(word) = arguments.next() {
            let list = |words: Option<String>| -> Result<Vec<usize>, String> {
                let words = words.ok_or("a list of numbers is missing")?;
                let numbers: Result<_, core::num::ParseIntError> =
                    words.split(',').map(str::parse).collect();
                numbers.map_err(|e| format!("{words}: {e}"))
            };
            match word.as_str() {
                "--points" => asked.points = list(arguments.next())?,
                "--pairs" => asked.pairs = list(arguments.next())?,
                "--tables" => {
                    let names = arguments.next().ok_or("a list of tables is missing")?;
                    asked.tables = names.split(',').map(str::to_owned).collect();
                }
                card => asked.card = card.parse().map_err(|_| "no card")?,
            }
        }
        Ok(asked)
    }
}

/// A simulated pair with more points than any benchmark uses.
fn street(seed: u64) -> Result<SimulatedPair, String> {
    let options = StreetOptions {
        seed,
        beams: 128,
        azimuth_steps: 2400,
        ..StreetOptions::default()
    };
    let street = Street::new(&options).map_err(|e| e.to_string())?;
    street.pair(0).map_err(|e| e.to_string())
}

fn estimated(
    backend: &dyn Backend,
    pair: &SimulatedPair,
    options: &Options,
) -> Result<Estimate, String> {
    let problem = Problem::pair(&pair.source, &pair.target);
    backend.host().clear_cache();
    let clock = Clock(Instant::now());
    estimate(backend, &problem, options, &clock).map_err(|e| e.to_string())
}

/// Mean end-point error of the points that have a flow, metres.
fn end_point_error(estimate: &Estimate, pair: &SimulatedPair) -> f64 {
    let rows = estimate.flow.iter().zip(&pair.flow).zip(&estimate.valid);
    let errors = rows.filter(|&(_, &valid)| valid).map(|((flow, truth), _)| {
        let square: f32 = (0..3).map(|a| (flow[a] - truth[a]).powi(2)).sum();
        f64::from(square.sqrt())
    });
    errors.sum::<f64>() / estimate.points as f64
}

/// Prints one row of the kernel table.
fn kernel(precision: &str, points: usize, time: &KernelTime, peak: f64) {
    let speed = time.operations / time.seconds;
    let shares = if time.operations > 0.0 {
        format!("{:.2} | {:.0}%", speed / 1e12, 100.0 * speed / peak)
    } else {
        "| ".to_owned()
    };
    let (name, ms) = (time.name, time.seconds * 1e3);
    println!("| {name}, {precision} | {points} | {ms:.3} | {shares} |");
}

fn kernels(gpu: &Gpu, pair: &SimulatedPair, sizes: &[usize]) -> Result<(), String> {
    let peak = arithmetic_peak(gpu).map_err(|e| e.to_string())?;
    println!("Arithmetic peak, measured: {:.2} TFLOP/s\n", peak / 1e12);
    println!("| kernel | points | ms | TFLOP/s | of the peak |");
    println!("|---|---|---|---|---|");
    for &points in sizes {
        let points = points.min(pair.source.len());
        let source = &pair.source[..points];
        for precision in Precision::ALL {
            let times = kernel_times(gpu, source, &pair.target, precision, ROUNDS);
            let name = precision.name();
            match times {
                Ok(times) => times
                    .iter()
                    .for_each(|time| kernel(name, points, time, peak)),
                Err(error) => println!("| all, {name} | {points} | {error} | | |"),
            }
        }
    }
    println!();
    Ok(())
}

fn pairs(gpu: &Gpu, pair: &SimulatedPair, sizes: &[usize]) -> Result<(), String> {
    println!("| preset | points | iterations | precompute | query | network | total ms | EPE m |");
    println!("|---|---|---|---|---|---|---|---|");
    for &points in sizes {
        for preset in Preset::with_gpu_kernels() {
            let mut runs = Vec::new();
            for seed in 0..=RUNS {
                let options = Options {
                    seed,
                    ..preset.options(Some(points))
                };
                let run = estimated(gpu, pair, &options)?;
                if seed > 0 {
                    runs.push(run);
                }
            }
            let of = |value: &dyn Fn(&Estimate) -> f64| median(runs.iter().map(value).collect());
            println!(
                "| {} | {} | {:.0} | {:.1} | {:.1} | {:.1} | {:.1} | {:.3} |",
                preset.name(),
                runs[0].points,
                of(&|e| e.fit().map_or(0.0, |fit| fit.iterations as f64)),
                of(&|e| e.precompute_seconds * 1e3),
                of(&|e| queries(e) * 1e3),
                of(&|e| (e.method_seconds() - queries(e)) * 1e3),
                of(&|e| e.total_seconds * 1e3),
                of(&|e| end_point_error(e, pair)),
            );
        }
    }
    println!();
    Ok(())
}

/// Solves many pairs at once, one thread each, as the lanes of the service do.
fn batches(gpu: &Gpu, pair: &SimulatedPair, counts: &[usize]) -> Result<(), String> {
    println!("| pairs of {SMALL} at once | seconds | pairs a second | of one at a time |");
    println!("|---|---|---|---|");
    let mut alone = None;
    for &count in counts {
        let count = count.min(gpu.lanes());
        let rounds = 3;
        let gpus = vec![gpu.clone(); count];
        let seconds = at_once(&gpus, |gpu, lane| {
            (0..rounds).try_for_each(|round| {
                let options = Options {
                    seed: lane as u64 * rounds + round,
                    ..Preset::Paper.options(Some(SMALL))
                };
                estimated(gpu, pair, &options).map(|_| ())
            })
        })?;
        let rate = (count as u64 * rounds) as f64 / seconds;
        let one = *alone.get_or_insert(rate);
        println!("| {count} | {seconds:.2} | {rate:.1} | {:.1} |", rate / one);
    }
    println!();
    Ok(())
}

/// Seconds in which every lane has done its work, all at the same time.
fn at_once(
    lanes: &[Gpu],
    work: impl Fn(&Gpu, usize) -> Result<(), String> + Sync,
) -> Result<f64, String> {
    let began = Instant::now();
    std::thread::scope(|scope| {
        let work = &work;
        let lanes = lanes.iter().enumerate();
        let lanes: Vec<_> = lanes
            .map(|(lane, gpu)| scope.spawn(move || work(gpu, lane)))
            .collect();
        lanes.into_iter().try_for_each(|lane| {
            let panicked = |_| "a lane panicked".to_owned();
            lane.join().map_err(panicked)?
        })
    })?;
    Ok(began.elapsed().as_secs_f64())
}

/// Whole sweeps by `default` on lanes that share the threads of the host, as in the service. Normals are
/// found and clusters searched by the host and by the GPU, in turn.
fn on_lanes(adapter: &Adapter) -> Result<(), String> {
    const COUNTS: [usize; 3] = [1, 8, 16];
    const PAIRS: usize = 3;
    let opened = [0, usize::MAX].map(|cluster_threads| {
        let options = GpuOptions {
            lanes: COUNTS[2],
            cluster_threads: Some(cluster_threads),
            ..GpuOptions::default()
        };
        Gpu::open(adapter, &options).map_err(|e| e.to_string())
    });
    let [host, card] = opened;
    let gpus = [host?, card?];
    println!("| scene | lanes | threads each | host: pairs a second | GPU: pairs a second |");
    println!("|---|---|---|---|---|");
    let options = Preset::Default.options(None);
    for scene in scenes()? {
        for count in COUNTS {
            let threads = (gpus[0].host_threads() / count).max(1);
            let mut rates = [const { Vec::new() }; 2];
            for round in 0..=PAIRS {
                for (gpu, rates) in gpus.iter().zip(&mut rates) {
                    let lanes = (0..count).map(|_| gpu.beside(threads));
                    let lanes: Result<Vec<Gpu>, _> = lanes.collect();
                    let lanes = lanes.map_err(|e| e.to_string())?;
                    let seconds = at_once(&lanes, |gpu, lane| {
                        (0..PAIRS).try_for_each(|pair| {
                            // Sweeps that no other pair has: lanes share what is known of one.
                            let first = (round * count + lane) * PAIRS + pair;
                            let problem =
                                Problem::pair(&scene.source[first..], &scene.target[first..]);
                            let clock = Clock(Instant::now());
                            let found = estimate(gpu, &problem, &options, &clock);
                            found.map(|_| ()).map_err(|e| e.to_string())
                        })
                    })?;
                    // The first round is not counted.
                    if round > 0 {
                        rates.push((count * PAIRS) as f64 / seconds);
                    }
                }
            }
            let [host, card] = rates.map(median);
            println!(
                "| {} | {count} | {threads} | {host:.1} | {card:.1} |",
                scene.name
            );
        }
    }
    println!();
    Ok(())
}

/// Object searches with the normals found and the clusters searched by a few threads of the host and
/// by the GPU, in turn.
fn objects(adapter: &Adapter) -> Result<(), String> {
    const ALIKE_M: f32 = 0.02;
    const HOST_THREADS: usize = 4;
    let cpu = CpuBackend::new(Some(HOST_THREADS)).map_err(|e| e.to_string())?;
    let options = GpuOptions {
        host_threads: Some(HOST_THREADS),
        ..GpuOptions::default()
    };
    let gpu = &Gpu::open(adapter, &options).map_err(|e| e.to_string())?;
    println!("`default`, {HOST_THREADS} threads of the host\n");
    println!(
        "| scene | points | clusters | host: clouds and clusters ms | all ms | GPU: clouds and clusters ms | all ms | alike |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    let options = Preset::Default.options(None);
    for scene in scenes()? {
        let problem = Problem::pair(&scene.source, &scene.target);
        let backends = [&cpu as &dyn Backend, gpu];
        let mut runs = [const { Vec::new() }; 2];
        for run in 0..=RUNS {
            for (backend, runs) in backends.iter().zip(&mut runs) {
                backend.host().clear_cache();
                let clock = Clock(Instant::now());
                let found = estimate(*backend, &problem, &options, &clock);
                let found = found.map_err(|e| e.to_string())?;
                if run > 0 {
                    runs.push(found);
                }
            }
        }
        let [host, card] = &runs;
        let ms = |runs: &[Estimate]| {
            let of = |value: &dyn Fn(&Estimate) -> f64| median(runs.iter().map(value).collect());
            [of(&search_seconds), of(&|e| e.total_seconds)].map(|seconds| seconds * 1e3)
        };
        let ([host_ms, host_all_ms], [card_ms, card_all_ms]) = (ms(host), ms(card));
        let pairs = host[0].flow.iter().zip(&card[0].flow);
        let alike = pairs.filter(|(a, b)| (0..3).all(|axis| (a[axis] - b[axis]).abs() < ALIKE_M));
        println!(
            "| {} | {} | {} | {host_ms:.1} | {host_all_ms:.1} | {card_ms:.1} | {card_all_ms:.1} | {:.4} |",
            scene.name,
            scene.source.len(),
            clusters(&host[0]),
            alike.count() as f64 / host[0].flow.len() as f64,
        );
    }
    println!();
    Ok(())
}

/// Seconds of the clouds, with the normals, and of the search of all clusters.
fn search_seconds(estimate: &Estimate) -> f64 {
    let seconds = estimate.object_search().expect("an object search").seconds;
    seconds.preparation + seconds.clusters
}

/// Number of clusters that were searched.
fn clusters(estimate: &Estimate) -> usize {
    let search = estimate.object_search().expect("an object search");
    search.searched
}

/// Seconds of the distance queries of a field; zero of an object search.
fn queries(estimate: &Estimate) -> f64 {
    estimate.fit().map_or(0.0, |fit| fit.query_seconds)
}

fn main() -> Result<(), String> {
    let asked = Arguments::read()?;
    let adapter = select(&asked.card, false).map_err(|e| e.to_string())?;
    let lanes = asked.pairs.iter().copied().max().unwrap_or(1);
    let options = GpuOptions {
        lanes,
        memory_bytes: None,
        ..GpuOptions::default()
    };
    let gpu = Gpu::open(&adapter, &options).map_err(|e| e.to_string())?;
    println!(
        "{}; {} lanes, {} MiB taken",
        gpu.name(),
        gpu.lanes(),
        gpu.memory_bytes() >> 20
    );
    let tiles = adapter.matrix_tiles.join(", ");
    println!(
        "matrix tiles: {}\n",
        if tiles.is_empty() { "none" } else { &tiles }
    );
    let pair = street(1)?;
    for table in &asked.tables {
        match table.as_str() {
            "kernels" => kernels(&gpu, &pair, &asked.points)?,
            "objects" => objects(&adapter)?,
            "lanes" => on_lanes(&adapter)?,
            "pairs" => pairs(&gpu, &pair, &asked.points)?,
            "batches" => batches(&gpu, &pair, &asked.pairs)?,
            other => return Err(format!("{other}: the tables are {}", TABLES.join(", "))),
        }
    }
    Ok(())
}
