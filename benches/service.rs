//! Overhead of the service over the library, and response times under deadlines.
//!
//! `cargo bench --bench service -- PAIR.npz` first solves a pair of 8,192 points by the library,
//! over HTTP and over gRPC in turn, and prints the medians. Then it solves all points off the
//! ground under deadlines, over HTTP.
#![expect(
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "a benchmark prints and may fail"
)]

use std::env;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use fnsf::app::App;
use fnsf::config::Config;
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::{Point, Preset, Problem, Uncontrolled, estimate};
use fnsf::formats::{CloudFormat, read_flow, read_pair, write_cloud};
use reqwest::multipart::{Form, Part};
use tokio_stream::StreamExt;

/// The generated gRPC client.
#[expect(unreachable_pub, reason = "generated code is public to its module")]
#[expect(
    unused_qualifications,
    reason = "generated code names everything in full"
)]
#[expect(clippy::allow_attributes_without_reason, reason = "generated code")]
mod proto {
    tonic::include_proto!("client/fnsf.v1");
}

/// Points of each cloud in the overhead measurement.
const POINTS: usize = 8192;
/// Rounds of the overhead measurement. Library, HTTP and gRPC run in turn in each round.
const ROUNDS: usize = 25;
/// Deadlines, milliseconds.
const DEADLINES: [u64; 6] = [150, 200, 300, 500, 1000, 2000];
/// Requests per deadline.
const ANSWERS: usize = 9;

fn main() {
    let pair = env::args()
        .skip(1)
        .find(|argument| argument.ends_with(".npz"));
    let Some(pair) = pair.map(PathBuf::from) else {
        println!("give a pair: cargo bench --bench service -- PAIR.npz");
        return;
    };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(run(&pair));
}

/// The points shifted along x by `times` millimetres, so that no round finds its sweeps in the
/// sweep cache.
fn elsewhere(points: &[Point], times: usize) -> Vec<Point> {
    let moved = points
        .iter()
        .map(|[x, y, z]| [x + 1e-3 * times as f32, *y, *z]);
    moved.collect()
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn file(points: &[Point]) -> Part {
    let mut bytes = Vec::new();
    write_cloud(CloudFormat::Npy, points, &mut bytes).unwrap();
    Part::bytes(bytes).file_name("cloud.npy")
}

async fn http(
    client: &reqwest::Client,
    url: &str,
    clouds: &[Vec<Point>; 2],
    options: String,
) -> (f64, String, Vec<u8>) {
    let body = Form::new()
        .text("options", options)
        .part("source", file(&clouds[0]))
        .part("target", file(&clouds[1]));
    let began = Instant::now();
    let answer = client.post(url).multipart(body).send().await.unwrap();
    let reason = answer.headers().get("fnsf-stop-reason");
    let reason = reason.map_or(answer.status().to_string(), |reason| {
        reason.to_str().unwrap().to_owned()
    });
    let bytes = answer.bytes().await.unwrap();
    (began.elapsed().as_secs_f64(), reason, bytes.to_vec())
}

fn messages(clouds: &[Vec<Point>; 2]) -> Vec<proto::EstimateFlowRequest> {
    use proto::estimate_flow_request::{Begin, CloudChunk, Part};
    let options = proto::Options {
        preset: proto::Preset::Neural.into(),
        ..proto::Options::default()
    };
    let mut parts = vec![Part::Begin(Begin {
        options: Some(Box::new(options)),
        ..Begin::default()
    })];
    for (points, cloud) in clouds
        .iter()
        .zip([proto::Cloud::Source, proto::Cloud::Target])
    {
        let values = points.as_flattened().iter();
        let bytes: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
        parts.push(Part::Cloud(CloudChunk {
            cloud: cloud.into(),
            chunk: Some(proto::Chunk {
                points: bytes.into(),
                ground: Vec::new().into(),
            }),
        }));
    }
    let message = |part| proto::EstimateFlowRequest { part: Some(part) };
    parts.into_iter().map(message).collect()
}

async fn run(path: &PathBuf) {
    let pair = read_pair(&std::fs::read(path).unwrap()).unwrap();
    let ground = pair.ground.clone().unwrap_or_default();
    let kept = |points: &[Point], ground: &[bool]| -> Vec<usize> {
        (0..points.len())
            .filter(|&row| !ground.get(row).copied().unwrap_or(false))
            .collect()
    };
    let rows = kept(&pair.source, &ground.source);
    let source: Vec<Point> = rows.iter().map(|&row| pair.source[row]).collect();
    let target: Vec<Point> = kept(&pair.target, &ground.target)
        .iter()
        .map(|&row| pair.target[row])
        .collect();
    let every = |points: &[Point]| -> Vec<Point> {
        (0..POINTS)
            .map(|i| points[i * points.len() / POINTS])
            .collect()
    };
    let small = [every(&source), every(&target)];

    let folder = tempfile::tempdir().unwrap();
    let any_port = SocketAddr::from(([127, 0, 0, 1], 0));
    let app = App::start(Config {
        listen: any_port,
        admin_listen: any_port,
        data_dir: folder.path().to_owned(),
        ..Config::default()
    });
    let app = app.await.unwrap();
    app.ready().await.unwrap();
    let address = app.public_address().expect("a public port");
    let url = format!("http://{address}/v1/flow");
    let _is_named = rustls::crypto::ring::default_provider().install_default();
    let client = reqwest::Client::new();
    let endpoint = tonic::transport::Endpoint::from_shared(format!("http://{address}"));
    let channel = endpoint.unwrap().connect().await.unwrap();
    let mut calls = proto::scene_flow_client::SceneFlowClient::new(channel);
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let backend = CpuBackend::new(Some(threads)).unwrap();
    let options = Preset::Neural.options(None);

    let (mut library, mut over_http, mut over_grpc) = (Vec::new(), Vec::new(), Vec::new());
    for round in 0..ROUNDS {
        let small = small.each_ref().map(|points| elsewhere(points, round));
        let began = Instant::now();
        let problem = Problem::pair(&small[0], &small[1]);
        let flow = estimate(&backend, &problem, &options, &Uncontrolled).unwrap();
        library.push(began.elapsed().as_secs_f64());
        assert_eq!(flow.flow.len(), POINTS);
        over_http.push(
            http(&client, &url, &small, r#"{"preset": "neural"}"#.to_owned())
                .await
                .0,
        );
        let messages = messages(&small);
        let began = Instant::now();
        let answer = calls
            .estimate_flow(tokio_stream::iter(messages))
            .await
            .unwrap();
        let parts: Vec<_> = answer.into_inner().collect().await;
        over_grpc.push(began.elapsed().as_secs_f64());
        assert!(parts.len() >= 2 && parts.iter().all(Result::is_ok));
    }
    println!("{POINTS} points, preset neural, {ROUNDS} rounds, {threads} threads; medians");
    println!("| | ms | over the library's of the same round, ms |\n|---|---|---|");
    println!("| library | {:.1} | |", median(&mut library.clone()) * 1e3);
    for (name, mut values) in [("HTTP", over_http), ("gRPC", over_grpc)] {
        let over = values
            .iter()
            .zip(&library)
            .map(|(value, base)| value - base);
        let over = median(&mut over.collect::<Vec<f64>>()) * 1e3;
        println!("| {name} | {:.1} | {over:.1} |", median(&mut values) * 1e3);
    }

    let truth = pair.truth.unwrap_or_default().flow;
    println!(
        "\n{} points, over HTTP, {ANSWERS} answers each",
        source.len()
    );
    println!(
        "| deadline ms | answered after ms, median (first, last) | ends | EPE |\n|---|---|---|---|"
    );
    for deadline in DEADLINES {
        let (mut took, mut errors, mut ends) = (Vec::new(), Vec::new(), Vec::new());
        for answer in 0..ANSWERS {
            let options = format!(r#"{{"preset": "neural", "deadline_ms": {deadline}}}"#);
            let clouds = [&source, &target].map(|points| elsewhere(points, answer));
            let (seconds, reason, bytes) = http(&client, &url, &clouds, options).await;
            took.push(seconds * 1e3);
            if !ends.contains(&reason) {
                ends.push(reason);
            }
            let Ok(flow) = read_flow(&bytes, None).map(|file| file.flow) else {
                println!("refused: {}", String::from_utf8_lossy(&bytes));
                continue;
            };
            let mut sum = 0.0;
            for (flow, &row) in flow.iter().zip(&rows) {
                let square: f32 = (0..3).map(|a| (flow[a] - truth[row][a]).powi(2)).sum();
                sum += f64::from(square.sqrt());
            }
            errors.push(sum / rows.len() as f64);
        }
        let middle = median(&mut took);
        println!(
            "| {deadline} | {middle:.0} ({:.0}, {:.0}) | {} | {:.4} |",
            took[0],
            took[ANSWERS - 1],
            ends.join(", "),
            median(&mut errors)
        );
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    app.drain().await;
}
