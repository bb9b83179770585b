//! Tests of sequences: identical results over every protocol and in the library, also for the dense
//! cloud, after kills and after failed pairs.

use std::collections::HashMap;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::densify::{FlowEdge, densify};
use fnsf::flow::ground::{GroundOptions, segment};
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{DenseCloud, Ground, MotionField, Point, Sequence, Sweep, Uncontrolled};
use fnsf::formats::{CloudFormat, DENSE_FORMATS, DenseFormat, read_flow, write_dense};
use fnsf::job::JobOptions;
use fnsf::payload::points_from_le_bytes;
use reqwest::StatusCode;
use reqwest::multipart::{Form, Part};
use serde_json::Value;
use tokio_stream::StreamExt;
use tonic::Code;

use crate::clouds::file;
use crate::grpc::{chunk, client, pair, proto};
use crate::server::{Folder, PATIENCE, Server, ended};

/// Few points, so that a pair is quick. The dense cloud contains all points.
const FLOWS: &str = r#"{"preset": "neural", "max_points": 512, "ground": "auto"}"#;
const DENSE: &str = r#"{"preset": "neural", "max_points": 512, "ground": "auto", "densify": {"reference_time": 1.5}}"#;

/// The sweeps of a short simulated drive.
fn sweeps() -> &'static [Vec<Point>] {
    static FRAMES: OnceLock<Vec<Vec<Point>>> = OnceLock::new();
    FRAMES.get_or_init(|| {
        let options = StreetOptions {
            beams: 16,
            azimuth_steps: 400,
            sweeps: 4,
            ..StreetOptions::default()
        };
        let street = Street::new(&options).expect("a street");
        let frame = |index| street.sweep(index).expect("a frame").points;
        (0..4).map(frame).collect()
    })
}

fn backend() -> CpuBackend {
    CpuBackend::new(Some(2)).expect("threads")
}

/// The motion fields and flows of consecutive edges, each warm-started from the previous one.
fn chained(
    backend: &CpuBackend,
    options: &str,
    indices: &[usize],
) -> Vec<(MotionField, Vec<Point>)> {
    let options = JobOptions::from_json(options.as_bytes()).expect("good options");
    let mut sequence = Sequence::default();
    let mut found = Vec::new();
    for &index in indices {
        let sweep = Sweep {
            points: sweeps()[index].clone(),
            ..Sweep::default()
        };
        let solver = options.solver_options(sweep.points.len());
        let estimates = sequence.push(backend, sweep, &solver, &Uncontrolled);
        found.extend(estimates.expect("a flow"));
    }
    found.extend(sequence.finish(backend, &Uncontrolled).expect("the rest"));
    found.into_iter().map(|e| (e.motion, e.flow)).collect()
}

/// The flows of the sequence, computed by the library.
fn flows(options: &str) -> Vec<Vec<Point>> {
    let found = chained(&backend(), options, &[0, 1, 2, 3]);
    found.into_iter().map(|(_, flow)| flow).collect()
}

/// The dense cloud of the sequence, computed by the library.
fn dense(options: &str) -> DenseCloud {
    let backend = backend();
    let mut fields = HashMap::new();
    for indices in [[0, 1, 2, 3], [3, 2, 1, 0]] {
        let found = chained(&backend, options, &indices);
        for (step, (field, _)) in indices.windows(2).zip(found) {
            let leg = FlowEdge {
                source: step[0],
                target: step[1],
            };
            fields.insert(leg, field);
        }
    }
    let options = JobOptions::from_json(options.as_bytes()).expect("good options");
    let asked = options.densify.expect("a frame");
    let finds_ground = options.solver_options(usize::MAX).ground == Ground::Auto;
    let sweeps: Vec<Sweep> = sweeps()
        .iter()
        .map(|points| Sweep {
            points: points.clone(),
            ground: finds_ground.then(|| segment(points, &GroundOptions::default()).ground),
            ..Sweep::default()
        })
        .collect();
    let plan = asked.plan(sweeps.len()).expect("a plan");
    let field = |leg: FlowEdge| fields.get(&leg);
    densify(&backend, &plan, &sweeps, field, &Uncontrolled).expect("a cloud")
}

pub(crate) fn body(options: &str, sweeps: &[Vec<Point>]) -> Form {
    let form = Form::new().text("options", options.to_owned());
    sweeps.iter().fold(form, |form, points| {
        let part = Part::bytes(file(CloudFormat::Npy, points)).file_name("f.npy");
        form.part("sweep", part)
    })
}

pub(crate) async fn post(server: &Server, path: &str, form: Form) -> (StatusCode, Value) {
    let request = reqwest::Client::new()
        .post(server.url(path))
        .multipart(form);
    let answer = request.send().await.expect("an answer");
    (answer.status(), answer.json().await.expect("JSON"))
}

async fn submit(server: &Server, options: &str) -> String {
    let (status, job) = post(server, "/v1/sequences", body(options, sweeps())).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{job}");
    job["id"].as_str().expect("a name").to_owned()
}

pub(crate) async fn get(
    server: &Server,
    path: &str,
    headers: &[(&str, &str)],
) -> reqwest::Response {
    let mut request = reqwest::Client::new().get(server.url(path));
    for (name, value) in headers {
        request = request.header(*name, *value);
    }
    request.send().await.expect("an answer")
}

/// The flows of a sequence's pairs, downloaded one by one.
pub(crate) async fn pair_flows(server: &Server, job: &Value) -> Vec<Vec<Point>> {
    let mut flows = Vec::new();
    for pair in job["pairs"]["jobs"].as_array().expect("pairs") {
        let link = pair["result"].as_str().expect("a link");
        let answer = get(server, link, &[]).await;
        let bytes = answer.bytes().await.expect("a body");
        flows.push(read_flow(&bytes, None).expect("a flow").flow);
    }
    flows
}

/// A dense cloud encoded as the service sends it.
fn packed(format: DenseFormat, cloud: &DenseCloud) -> Vec<u8> {
    let mut bytes = Vec::new();
    write_dense(format, cloud, None, &mut bytes).expect("written");
    bytes
}

async fn streamed(server: &Server) -> Vec<Vec<Point>> {
    use proto::estimate_sequence_request::{Begin, Part, Sweep};
    use proto::estimate_sequence_response::Part as Answer;
    let mut parts = vec![Part::Begin(Begin {
        options: Some(Box::new(grpc_options(None))),
    })];
    for points in sweeps() {
        parts.push(Part::Sweep(Sweep::default()));
        parts.push(Part::Chunk(chunk(points)));
    }
    let message = |part| proto::EstimateSequenceRequest { part: Some(part) };
    let stream = tokio_stream::iter(parts.into_iter().map(message));
    let mut calls = client(server).await;
    let answer = calls.estimate_sequence(stream).await.expect("an answer");
    let mut answer = answer.into_inner();
    let mut flows: Vec<Vec<Point>> = Vec::new();
    while let Some(message) = answer.next().await {
        match message.expect("a message").part.expect("a part") {
            Answer::Pair(_) => flows.push(Vec::new()),
            Answer::Chunk(piece) => {
                let flow = flows.last_mut().expect("a pair before its rows");
                flow.extend(points_from_le_bytes(&piece.flow));
            }
        }
    }
    flows
}

fn grpc_options(densify: Option<proto::Densify>) -> proto::Options {
    proto::Options {
        preset: proto::Preset::Neural.into(),
        max_points: Some(512),
        ground: proto::Ground::Auto.into(),
        densify,
        ..proto::Options::default()
    }
}

/// Submits the sequence over gRPC and waits for its end.
async fn submitted(server: &Server, densify: Option<proto::Densify>) -> proto::Job {
    use proto::submit_job_request::{Begin, NextCloud, Part};
    let mut parts = vec![Part::Begin(Begin {
        options: Some(Box::new(grpc_options(densify))),
        idempotency_key: String::new(),
    })];
    for points in sweeps() {
        parts.push(Part::Next(NextCloud::default()));
        parts.push(Part::Chunk(chunk(points)));
    }
    let message = |part| proto::SubmitJobRequest { part: Some(part) };
    let stream = tokio_stream::iter(parts.into_iter().map(message));
    let mut calls = client(server).await;
    let job = calls.submit_job(stream).await.expect("accepted");
    let id = job.into_inner().id;
    assert_eq!(ended(server, &id).await["state"], "succeeded");
    let asked = proto::GetJobRequest { id };
    calls.get_job(asked).await.expect("known").into_inner()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_sequence_has_the_same_bits_through_every_door_and_in_the_library() {
    use proto::download_result_response::Part;
    let server = Server::start(&[]);
    let expected = flows(FLOWS);
    let alone = chained(&backend(), FLOWS, &[1, 2]);
    assert!(alone[0].1 != expected[1], "nothing goes on from anything");
    let id = submit(&server, FLOWS).await;
    let job = ended(&server, &id).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    assert!(pair_flows(&server, &job).await == expected, "over HTTP");
    assert!(streamed(&server).await == expected, "as a stream");
    let job = submitted(&server, None).await;
    assert_eq!(job.pair_ids.len(), expected.len());
    let mut calls = client(&server).await;
    for (id, expected) in job.pair_ids.into_iter().zip(&expected) {
        let asked = proto::DownloadResultRequest { id, first_row: 0 };
        let parts = calls.download_result(asked).await.expect("it is there");
        let mut parts = parts.into_inner();
        let mut flow = Vec::new();
        while let Some(part) = parts.next().await {
            if let Some(Part::Chunk(piece)) = part.expect("a part").part {
                flow.extend(points_from_le_bytes(&piece.flow));
            }
        }
        assert!(flow == *expected, "as a job over gRPC");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_dense_cloud_of_a_sequence_is_the_librarys_in_every_format_and_door() {
    use proto::download_result_response::Part;
    let server = Server::start(&[]);
    let expected = dense(DENSE);
    let id = submit(&server, DENSE).await;
    let early = get(&server, &format!("/v1/jobs/{id}/result"), &[]).await;
    assert_eq!(early.status(), StatusCode::CONFLICT);
    let job = ended(&server, &id).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    assert_eq!(job["report"]["points"], expected.points.len());
    assert_eq!(job["pairs"]["total"], 5);
    assert_eq!(job["pairs"]["ended"], 5);
    // Only the forward flows are listed as results.
    assert!(pair_flows(&server, &job).await == flows(FLOWS));
    let path = format!("/v1/jobs/{id}/result");
    for (format, media, _) in DENSE_FORMATS {
        let answer = get(&server, &path, &[("accept", media)]).await;
        assert_eq!(answer.status(), StatusCode::OK, "{media}");
        assert_eq!(answer.headers()["content-type"], media);
        let tag = answer.headers()["etag"].to_str().expect("text").to_owned();
        let bytes = answer.bytes().await.expect("a body");
        assert!(bytes == packed(format, &expected), "{media}");
        let part = [("accept", media), ("range", "bytes=10-19")];
        let part = get(&server, &path, &part).await;
        assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
        assert_eq!(part.bytes().await.expect("a body"), bytes[10..20]);
        let known = [("accept", media), ("if-none-match", tag.as_str())];
        let known = get(&server, &path, &known).await;
        assert_eq!(known.status(), StatusCode::NOT_MODIFIED);
    }
    let zip = get(&server, &path, &[("accept", "application/zip")]).await;
    assert_eq!(zip.headers()["content-type"], "application/zip");
    let other = get(&server, &path, &[("accept", "application/x-npy")]).await;
    assert_eq!(other.status(), StatusCode::NOT_ACCEPTABLE);

    let into = proto::Densify {
        reference_time: 1.5,
        ..proto::Densify::default()
    };
    let job = submitted(&server, Some(into)).await;
    assert_eq!((job.pair_ids.len(), job.pairs, job.pairs_left), (3, 5, 0));
    let asked = proto::DownloadResultRequest {
        id: job.id,
        first_row: 10,
    };
    let mut calls = client(&server).await;
    let parts = calls.download_result(asked).await.expect("it is there");
    let mut parts = parts.into_inner();
    let mut found = DenseCloud::default();
    while let Some(part) = parts.next().await {
        match part.expect("a part").part.expect("something") {
            Part::DenseHeader(header) => {
                assert_eq!(header.points as usize, expected.points.len());
                assert_eq!((header.sweeps, header.substeps), (4, 1));
            }
            Part::DenseChunk(piece) => {
                let word = |bytes: &[u8]| u32::from_le_bytes(bytes.try_into().expect("4 bytes"));
                found.points.extend(points_from_le_bytes(&piece.points));
                found.sweep.extend(piece.sweep.chunks(4).map(word));
                let ages = piece.age.chunks(4).map(word);
                found.age.extend(ages.map(f32::from_bits));
                let flags = |bit: u8| piece.flags.iter().map(move |flag| flag & bit != 0);
                found.dynamic.extend(flags(1));
                found.converged.extend(flags(2));
            }
            part => panic!("a flow's part: {part:?}"),
        }
    }
    let rest = DenseCloud {
        points: expected.points[10..].to_vec(),
        sweep: expected.sweep[10..].to_vec(),
        age: expected.age[10..].to_vec(),
        dynamic: expected.dynamic[10..].to_vec(),
        converged: expected.converged[10..].to_vec(),
    };
    assert!(found == rest, "over gRPC");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_sequence_that_is_killed_in_its_pairs_and_while_it_is_carried_ends_with_the_same_bits() {
    const CONFIG: &str =
        "[queue]\nretry_delay_seconds = 1\nsnapshot_interval_ms = 50\nmax_crashes = 40\n";
    // Enough integration steps that the densification takes seconds.
    const LONG: &str = r#"{"preset": "neural", "max_points": 1024, "ground": "auto",
        "densify": {"reference_time": 0, "substeps": 64}}"#;
    let folder = Folder::new();
    let mut server = Server::start_in(&folder, CONFIG, &[]);
    let id = submit(&server, LONG).await;
    for life in [200, 700, 450] {
        tokio::time::sleep(Duration::from_millis(life)).await;
        server.kill();
        server = Server::start_in(&folder, CONFIG, &[]);
    }
    let began = Instant::now();
    loop {
        let job = get(&server, &format!("/v1/jobs/{id}"), &[]).await;
        let job: Value = job.json().await.expect("a job");
        if job["attempt"] == 1 && job["state"] == "running" {
            break;
        }
        assert!(began.elapsed() < PATIENCE, "{job}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    tokio::time::sleep(Duration::from_millis(100)).await;
    server.kill();
    let server = Server::start_in(&folder, CONFIG, &[]);
    let job = ended(&server, &id).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    assert_eq!(job["attempt"], 2);
    assert!(pair_flows(&server, &job).await == flows(LONG), "the flows");
    let cloud = get(&server, &format!("/v1/jobs/{id}/result"), &[]).await;
    let cloud = cloud.bytes().await.expect("a body");
    assert!(cloud == packed(DenseFormat::Npz, &dense(LONG)), "the cloud");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dense_cloud_whose_pair_fails_fails_and_names_it_and_the_others_are_there() {
    let folder = Folder::new();
    let server = Server::start_in(&folder, "[queue]\nretry_delay_seconds = 1\n", &[]);
    let id = submit(&server, DENSE).await;
    let blobs = folder.path().join("data/blobs/jobs").join(&id[..8]);
    let last = blobs.join(&id).join("sweep-3");
    std::fs::remove_file(last).expect("it was stored");
    let job = ended(&server, &id).await;
    assert_eq!(job["state"], "failed", "{job}");
    let error = job["error"]["message"].as_str().expect("a reason");
    assert!(error.starts_with("pair 2: "), "{error}");
    assert_eq!(job["pairs"]["jobs"][0]["state"], "succeeded");
    let result = get(&server, &format!("/v1/jobs/{id}/result"), &[]).await;
    let problem: Value = result.json().await.expect("a problem");
    let detail = problem["detail"].as_str().unwrap_or_default();
    assert!(detail.contains("pair 2: "), "{problem}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dense_cloud_that_cannot_be_made_is_refused_with_clear_words_and_costs_nothing() {
    let server = Server::with_config("[limits]\nmax_job_memory_mib = 128\n");
    let small: Vec<Vec<Point>> = sweeps()
        .iter()
        .map(|points| points.iter().step_by(4).copied().collect())
        .collect();
    let many: Vec<Vec<Point>> = small.iter().cycle().take(150).cloned().collect();
    for (densify, sweeps, status, said) in [
        (
            r#"{"reference_time": 9}"#,
            &small,
            400,
            "the reference time 9 lies outside the sequence's sweeps, 0 to 3",
        ),
        (
            r#"{"reference_time": -1}"#,
            &small,
            400,
            "densify.reference_time is -1",
        ),
        (
            r#"{"reference_time": 1, "substeps": 0}"#,
            &small,
            400,
            "0 substeps: 1 to 64 are possible",
        ),
        (
            r#"{"reference_time": 1, "steps": 2}"#,
            &small,
            400,
            "unknown field `steps`",
        ),
        (r#"{"reference_time": 1}"#, &many, 413, "the dense cloud of"),
    ] {
        let options = format!(r#"{{"preset": "neural", "max_points": 512, "densify": {densify}}}"#);
        let (found, problem) = post(&server, "/v1/sequences", body(&options, sweeps)).await;
        let detail = problem["detail"].as_str().unwrap_or_default();
        assert_eq!(found.as_u16(), status, "{problem}");
        assert!(detail.contains(said), "{said}: {problem}");
    }
    let cloud = || Part::bytes(file(CloudFormat::Npy, &sweeps()[0])).file_name("f.npy");
    for path in ["/v1/flow", "/v1/jobs"] {
        let form = Form::new()
            .text("options", DENSE)
            .part("source", cloud())
            .part("target", cloud());
        let (status, problem) = post(&server, path, form).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{problem}");
        let detail = problem["detail"].as_str().unwrap_or_default();
        assert!(detail.contains("densify is for sequences"), "{problem}");
    }
    let into = || Some(proto::Densify::default());
    let mut calls = client(&server).await;
    let clouds = [sweeps()[0].clone(), sweeps()[1].clone()];
    let refused = calls
        .estimate_flow(pair(&clouds, grpc_options(into())))
        .await;
    let refused = refused.expect_err("a refusal");
    assert_eq!(refused.code(), Code::InvalidArgument);
    assert!(refused.message().contains("densify"), "{refused}");
    let begin = proto::EstimateSequenceRequest {
        part: Some(proto::estimate_sequence_request::Part::Begin(
            proto::estimate_sequence_request::Begin {
                options: Some(Box::new(grpc_options(into()))),
            },
        )),
    };
    let answer = calls.estimate_sequence(tokio_stream::iter([begin])).await;
    let first = answer.expect("a stream").into_inner().next().await;
    let refused = first.expect("an answer").expect_err("a refusal");
    assert_eq!(refused.code(), Code::InvalidArgument);
    assert!(refused.message().contains("densify"), "{refused}");
    let listed = get(&server, "/v1/jobs", &[]).await;
    let listed: Value = listed.json().await.expect("a page");
    assert_eq!(listed["jobs"].as_array().map(Vec::len), Some(0));
}

#[tokio::test]
async fn velocities_of_a_sequence_are_by_the_times_in_the_names_of_its_files() {
    let server = Server::start(&[]);
    let names = [
        "1700000000000.npy",
        "1700000000050.npy",
        "1700000000150.npy",
    ];
    let parts = names
        .iter()
        .zip(sweeps())
        .map(|(name, points)| Part::bytes(file(CloudFormat::Npy, points)).file_name(*name));
    let form = parts.fold(Form::new(), |form, part| form.part("sweep", part));
    let (status, job) = post(&server, "/v1/sequences", form).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{job}");
    let job = ended(&server, job["id"].as_str().expect("an id")).await;
    let mut intervals = Vec::new();
    for pair in job["pairs"]["jobs"].as_array().expect("pairs") {
        let pair = ended(&server, pair["id"].as_str().expect("an id")).await;
        assert_eq!(pair["report"]["dt_assumed"], false, "{pair}");
        intervals.push(pair["report"]["dt_s"].as_f64().expect("seconds"));
    }
    assert_eq!(intervals, [0.05, 0.1]);
}
