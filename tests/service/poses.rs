//! Tests of sequences whose sweeps have poses, over HTTP and gRPC.

use std::sync::OnceLock;

use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{Point, RigidTransform};
use fnsf::formats::{CloudFormat, matrix_rows};
use reqwest::StatusCode;
use reqwest::multipart::{Form, Part};
use serde_json::Value;
use tokio_stream::StreamExt;
use tonic::Code;

use crate::clouds::{file, form, small_pair};
use crate::grpc::{chunk, client, proto};
use crate::sequences::{get, post};
use crate::server::{Server, ended};

/// Difference between two motions that rounding explains, in metres and in entries of the rotation.
const SAME: f64 = 1e-9;

/// Sweeps of a street at 40 m/s, 0.3 s and 12 m apart, and their poses. A registration finds the ego
/// motion to centimetres, so one within [`SAME`] comes from the poses.
fn drive() -> &'static [(Vec<Point>, RigidTransform)] {
    static DRIVE: OnceLock<Vec<(Vec<Point>, RigidTransform)>> = OnceLock::new();
    DRIVE.get_or_init(|| {
        let options = StreetOptions {
            beams: 16,
            azimuth_steps: 400,
            sweeps: 7,
            speed_mps: Some(40.0),
            ..StreetOptions::default()
        };
        let street = Street::new(&options).expect("a street");
        let sweep = |index: usize| {
            let points = street.sweep(index).expect("a sweep").points;
            (points, street.pose(index as f64))
        };
        [0, 3, 6].map(sweep).to_vec()
    })
}

fn poses() -> Vec<[[f64; 4]; 4]> {
    drive().iter().map(|(_, pose)| matrix_rows(pose)).collect()
}

/// The known ego motion of a pair.
fn known(pair: usize) -> [[f64; 4]; 4] {
    let [source, target] = [pair, pair + 1].map(|sweep| drive()[sweep].1);
    matrix_rows(&target.inv_mul(&source))
}

fn assert_same(found: &[f64], expected: &[[f64; 4]; 4]) {
    assert_eq!(found.len(), 16);
    for (found, expected) in found.iter().zip(expected.as_flattened()) {
        assert!((found - expected).abs() < SAME, "{found} {expected}");
    }
}

/// A request with options, then a file of poses, then the sweeps.
fn body(options: &'static str, poses: impl Into<Vec<u8>>) -> Form {
    let poses = Part::bytes(poses.into()).file_name("poses");
    let form = Form::new().text("options", options).part("poses", poses);
    drive()
        .iter()
        .fold(form, |form, (points, _)| with(form, points))
}

fn with(form: Form, points: &[Point]) -> Form {
    let part = Part::bytes(file(CloudFormat::Npy, points)).file_name("f.npy");
    form.part("sweep", part)
}

/// The answers to a stream of the first sweeps of the drive, one for each of the poses.
async fn streamed(
    server: &Server,
    poses: &[Vec<f64>],
) -> tonic::Streaming<proto::EstimateSequenceResponse> {
    use proto::estimate_sequence_request::{Begin, Part, Sweep};
    let mut parts = vec![Part::Begin(Begin::default())];
    for ((points, _), pose) in drive().iter().zip(poses) {
        parts.push(Part::Sweep(Sweep {
            pose: pose.clone(),
            ..Sweep::default()
        }));
        parts.push(Part::Chunk(chunk(points)));
    }
    let message = |part| proto::EstimateSequenceRequest { part: Some(part) };
    let stream = tokio_stream::iter(parts.into_iter().map(message));
    let answer = client(server).await.estimate_sequence(stream).await;
    answer.expect("an answer").into_inner()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_ego_motions_of_a_sequence_with_poses_are_those_of_its_poses_in_text_and_in_json() {
    let server = Server::start(&[]);
    let json = serde_json::to_string(&poses()).expect("JSON");
    let line = |rows: &[[f64; 4]; 4]| {
        let numbers = rows.as_flattened()[..12].iter();
        numbers.map(f64::to_string).collect::<Vec<_>>().join(" ")
    };
    let text: Vec<String> = poses().iter().map(line).collect();
    for file in [json, text.join("\n")] {
        let (status, job) = post(&server, "/v1/sequences", body("{}", file)).await;
        assert_eq!(status, StatusCode::ACCEPTED, "{job}");
        let job = ended(&server, job["id"].as_str().expect("a name")).await;
        assert_eq!(job["state"], "succeeded", "{job}");
        let pairs = job["pairs"]["jobs"].as_array().expect("pairs");
        assert_eq!(pairs.len(), 2);
        for (index, pair) in pairs.iter().enumerate() {
            let path = format!("/v1/jobs/{}", pair["id"].as_str().expect("a name"));
            let pair: Value = get(&server, &path, &[]).await.json().await.expect("JSON");
            let motion = &pair["report"]["ego_motion"];
            let motion: Vec<Vec<f64>> = serde_json::from_value(motion.clone()).expect("rows");
            assert_same(&motion.concat(), &known(index));
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_ego_motions_of_a_stream_and_of_a_job_over_grpc_are_those_of_the_poses() {
    use proto::estimate_sequence_response::{Part as Answer, pair::Outcome};
    use proto::submit_job_request::{Begin, NextCloud, Part};
    let server = Server::start(&[]);
    let flat: Vec<Vec<f64>> = poses().iter().map(|pose| pose.concat()).collect();
    let mut answer = streamed(&server, &flat).await;
    let mut pairs = 0;
    while let Some(message) = answer.next().await {
        if let Answer::Pair(pair) = message.expect("a message").part.expect("a part") {
            match pair.outcome {
                Some(Outcome::Header(header)) => assert_same(&header.ego_motion, &known(pairs)),
                other => panic!("{other:?}"),
            }
            pairs += 1;
        }
    }
    assert_eq!(pairs, 2);

    let mut parts = vec![Part::Begin(Begin::default())];
    for ((points, _), pose) in drive()[..2].iter().zip(flat) {
        parts.push(Part::Next(NextCloud {
            pose,
            ..NextCloud::default()
        }));
        parts.push(Part::Chunk(chunk(points)));
    }
    let message = |part| proto::SubmitJobRequest { part: Some(part) };
    let stream = tokio_stream::iter(parts.into_iter().map(message));
    let mut calls = client(&server).await;
    let id = calls.submit_job(stream).await.expect("accepted");
    let id = id.into_inner().id;
    assert_eq!(ended(&server, &id).await["state"], "succeeded");
    let asked = proto::DownloadResultRequest { id, first_row: 0 };
    let answer = calls.download_result(asked).await.expect("an answer");
    let mut answer = answer.into_inner();
    let first = answer.message().await.expect("a message").expect("one");
    match first.part {
        Some(proto::download_result_response::Part::Header(header)) => {
            assert_same(&header.ego_motion, &known(0));
        }
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn poses_that_do_not_belong_to_the_sweeps_are_refused_in_words() {
    let server = Server::start(&[]);
    let json = |poses: &[[[f64; 4]; 4]]| serde_json::to_string(poses).expect("JSON");
    let poses = poses();
    let refused = async |path: &str, form: Form, words: &str| {
        let (status, problem) = post(&server, path, form).await;
        let status = status.as_u16();
        assert!([400, 422].contains(&status), "{problem}");
        let detail = problem["detail"].as_str().expect("words");
        assert!(detail.contains(words), "{detail}");
    };
    let sequences = "/v1/sequences";
    let more = [poses.clone(), poses.clone()].concat();
    let count = "has 6 rows where 3 are needed";
    refused(sequences, body("{}", json(&more)), count).await;
    let count = "has 2 rows where 3 are needed";
    refused(sequences, body("{}", json(&poses[..2])), count).await;
    refused(sequences, body("{}", "no poses"), "not 12 numbers").await;
    refused(sequences, body("{}", "[[[0]]]"), "4 x 4").await;
    let none = json(&[[[0.0; 4]; 4]; 3]);
    refused(sequences, body("{}", none), "no rigid transform").await;
    let beside = body(r#"{"ego": "off"}"#, json(&poses));
    refused(sequences, beside, "leave ego out").await;
    let late = with(Form::new(), &drive()[0].0).text("poses", json(&poses));
    refused(sequences, late, "before the sweeps").await;
    for path in ["/v1/flow", "/v1/jobs"] {
        let pair = form(small_pair(), "{}").text("poses", json(&poses));
        refused(path, pair, "the option ego").await;
    }

    use proto::estimate_sequence_response::{Part as Answer, pair::Outcome};
    let first = poses[0].concat();
    for (pose, words) in [
        (Vec::new(), "one has a pose and the other has none"),
        (first[..15].to_vec(), "15 numbers where 16 are needed"),
        (
            vec![f64::NAN; 16],
            "the pose of a sweep: the matrix is not a rigid",
        ),
    ] {
        let mut answer = streamed(&server, &[first.clone(), pose]).await;
        match answer.message().await {
            Err(status) => {
                assert_eq!(status.code(), Code::InvalidArgument);
                assert!(status.message().contains(words), "{status}");
            }
            Ok(message) => match message.and_then(|message| message.part) {
                Some(Answer::Pair(pair)) => match pair.outcome {
                    Some(Outcome::Error(error)) => {
                        assert!(error.message.contains(words), "{error:?}");
                    }
                    other => panic!("{other:?}"),
                },
                other => panic!("{other:?}"),
            },
        }
    }
}
