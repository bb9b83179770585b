//! Tests of estimates with neighbor sweeps: identical results over every protocol, in the library
//! and on the command line.

use std::process::Command;
use std::sync::OnceLock;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{Point, Preset, Sequence, Sweep, Uncontrolled};
use fnsf::formats::{CloudFormat, read_flow};
use fnsf::payload::points_from_le_bytes;
use reqwest::multipart::{Form, Part};
use tokio_stream::StreamExt;

use crate::clouds::file;
use crate::grpc::{chunk, client, proto};
use crate::sequences::{body, get, pair_flows, post};
use crate::server::{Server, ended};

/// More sweeps than a window has, so that the window moves.
const SWEEPS: usize = 7;

fn sweeps() -> &'static [Vec<Point>] {
    static SWEEPS_OF_A_DRIVE: OnceLock<Vec<Vec<Point>>> = OnceLock::new();
    SWEEPS_OF_A_DRIVE.get_or_init(|| {
        let options = StreetOptions {
            beams: 16,
            azimuth_steps: 400,
            sweeps: SWEEPS,
            ..StreetOptions::default()
        };
        let street = Street::new(&options).expect("a street");
        let frame = |index| street.sweep(index).expect("a frame").points;
        (0..SWEEPS).map(frame).collect()
    })
}

/// The flows of the sequence, computed by the library.
fn flows(preset: Preset, sweeps: &[Vec<Point>]) -> Vec<Vec<Point>> {
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let (options, mut sequence) = (preset.options(None), Sequence::default());
    let mut found = Vec::new();
    for points in sweeps {
        let sweep = Sweep {
            points: points.clone(),
            ..Sweep::default()
        };
        let pushed = sequence.push(&backend, sweep, &options, &Uncontrolled);
        found.extend(pushed.expect("a flow"));
    }
    found.extend(sequence.finish(&backend, &Uncontrolled).expect("the rest"));
    found.into_iter().map(|estimate| estimate.flow).collect()
}

/// Streams the sequence over gRPC. Returns each pair's sweep names and flow, and the status code of
/// an error. The bytes of `broken`, if any, replace the sweep after the first four.
async fn streamed(
    server: &Server,
    broken: Option<&'static [u8]>,
) -> (Vec<([String; 2], Vec<Point>)>, Option<tonic::Code>) {
    use proto::estimate_sequence_request::{Begin, Part, Sweep};
    use proto::estimate_sequence_response::Part as Answer;
    let mut parts = vec![Part::Begin(Begin {
        options: Some(Box::new(proto::Options {
            preset: proto::Preset::Label.into(),
            ..proto::Options::default()
        })),
    })];
    for (index, points) in sweeps().iter().enumerate() {
        parts.push(Part::Sweep(Sweep {
            name: index.to_string(),
            ..Sweep::default()
        }));
        match broken.filter(|_| index == 4) {
            None => parts.push(Part::Chunk(chunk(points))),
            Some(bytes) => parts.push(Part::Chunk(proto::Chunk {
                points: bytes.into(),
                ground: Vec::new().into(),
            })),
        }
    }
    let message = |part| proto::EstimateSequenceRequest { part: Some(part) };
    let stream = tokio_stream::iter(parts.into_iter().map(message));
    let answer = client(server).await.estimate_sequence(stream).await;
    let mut answer = answer.expect("an answer").into_inner();
    let mut flows: Vec<([String; 2], Vec<Point>)> = Vec::new();
    while let Some(message) = answer.next().await {
        let message = match message {
            Ok(message) => message,
            Err(status) => return (flows, Some(status.code())),
        };
        match message.part.expect("a part") {
            Answer::Pair(pair) => flows.push(([pair.source, pair.target], Vec::new())),
            Answer::Chunk(piece) => {
                let (_, flow) = flows.last_mut().expect("a pair before its rows");
                flow.extend(points_from_le_bytes(&piece.flow));
            }
        }
    }
    (flows, None)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_that_breaks_still_gives_the_pairs_of_the_sweeps_before() {
    let server = Server::start(&[]);
    let (found, broken) = streamed(&server, Some(b"not a multiple of 12")).await;
    assert_eq!(broken, Some(tonic::Code::InvalidArgument));
    let found: Vec<Vec<Point>> = found.into_iter().map(|(_, flow)| flow).collect();
    assert!(found == flows(Preset::Label, &sweeps()[..4]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pairs_that_see_the_sweeps_around_them_have_the_same_bits_through_every_door() {
    let server = Server::start(&[]);
    let expected = flows(Preset::Label, sweeps());
    assert_eq!(expected.len(), SWEEPS - 1);
    assert!(
        expected != flows(Preset::Default, sweeps()),
        "nothing is seen around"
    );

    let form = body(r#"{"preset": "label"}"#, sweeps());
    let (_, job) = post(&server, "/v1/sequences", form).await;
    let job = ended(&server, job["id"].as_str().expect("a name")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    assert!(pair_flows(&server, &job).await == expected, "over HTTP");

    let (streamed, broken) = streamed(&server, None).await;
    assert_eq!(broken, None);
    for (index, (names, _)) in streamed.iter().enumerate() {
        assert_eq!(*names, [index.to_string(), (index + 1).to_string()]);
    }
    let streamed: Vec<Vec<Point>> = streamed.into_iter().map(|(_, flow)| flow).collect();
    assert!(streamed == expected, "as a stream");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn windows_with_a_missing_sweep_have_the_same_bits_in_the_service_and_on_the_command_line() {
    let server = Server::start(&[]);
    let folder = tempfile::tempdir().expect("a folder");
    let mut form = Form::new().text("options", r#"{"preset": "label"}"#);
    let (mut names, mut kept) = (Vec::new(), Vec::new());
    for (index, points) in sweeps().iter().enumerate().filter(|(index, _)| *index != 2) {
        let name = format!("{}.npy", 1_700_000_000_000 + 100 * index);
        let bytes = file(CloudFormat::Npy, points);
        std::fs::write(folder.path().join(&name), &bytes).expect("written");
        form = form.part("sweep", Part::bytes(bytes).file_name(name.clone()));
        names.push(name);
        kept.push(points.clone());
    }
    let (_, job) = post(&server, "/v1/sequences", form).await;
    let job = ended(&server, job["id"].as_str().expect("a name")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let found = pair_flows(&server, &job).await;
    let done = Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .current_dir(folder.path())
        .arg("flow")
        .args(&names)
        .args(["--preset", "label", "--device", "cpu", "-o", "flow.npz"])
        .output();
    let done = done.expect("the program starts");
    assert!(done.status.success(), "{done:?}");
    for (pair, found) in found.iter().enumerate() {
        let path = folder.path().join(format!("flow_{pair:04}.npz"));
        let bytes = std::fs::read(path).expect("written");
        assert!(
            *found == read_flow(&bytes, None).expect("a flow").flow,
            "pair {pair}"
        );
    }
    // By their indices the neighbors would be elsewhere.
    assert!(found != flows(Preset::Label, &kept));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dense_cloud_whose_pairs_see_the_sweeps_around_them_is_the_command_lines() {
    let server = Server::start(&[]);
    for into in ["2", "4.5"] {
        let options = format!(r#"{{"preset": "label", "densify": {{"reference_time": {into}}}}}"#);
        let (_, job) = post(&server, "/v1/sequences", body(&options, sweeps())).await;
        let id = job["id"].as_str().expect("a name").to_owned();
        let job = ended(&server, &id).await;
        assert_eq!(job["state"], "succeeded", "{job}");
        let path = format!("/v1/jobs/{id}/result");
        let answer = get(&server, &path, &[("accept", "application/x-ply")]).await;
        let over_http = answer.bytes().await.expect("a body");

        let folder = tempfile::tempdir().expect("a folder");
        let names: Vec<String> = (0..SWEEPS).map(|index| format!("{index}.npy")).collect();
        for (name, points) in names.iter().zip(sweeps()) {
            let bytes = file(CloudFormat::Npy, points);
            std::fs::write(folder.path().join(name), bytes).expect("written");
        }
        let done = Command::new(env!("CARGO_BIN_EXE_fnsf"))
            .current_dir(folder.path())
            .arg("densify")
            .args(&names)
            .args([
                "--reference-time",
                into,
                "--preset",
                "label",
                "--device",
                "cpu",
            ])
            .args(["-o", "dense.ply"])
            .output();
        let done = done.expect("the program starts");
        assert!(done.status.success(), "{done:?}");
        let bytes = std::fs::read(folder.path().join("dense.ply")).expect("written");
        assert!(bytes == over_http, "into {into}");
    }
}
