//! Tests of the tracks of sequences, over HTTP and gRPC.

use std::sync::OnceLock;

use fnsf::flow::Point;
use fnsf::flow::evaluate::{TrackingPool, tracked_sweeps};
use fnsf::flow::simulate::{Street, StreetOptions, StreetSweep};
use fnsf::flow::tracks::Track;
use fnsf::formats::{CloudFormat, read_tracks};
use reqwest::StatusCode;
use reqwest::multipart::{Form, Part};
use serde_json::Value;
use tokio_stream::StreamExt;
use tonic::Code;

use crate::clouds::file;
use crate::grpc::{client, proto};
use crate::sequences::{get, post};
use crate::server::{Server, ended};

/// Sweeps of a street, and the true tracks.
fn drive() -> &'static (Vec<Vec<Point>>, Vec<Track>) {
    static DRIVE: OnceLock<(Vec<Vec<Point>>, Vec<Track>)> = OnceLock::new();
    DRIVE.get_or_init(|| {
        let options = StreetOptions {
            beams: 32,
            sweeps: 6,
            ..StreetOptions::default()
        };
        let street = Street::new(&options).expect("a street");
        let sweep = |index| street.sweep(index).expect("a sweep");
        let sweeps: Vec<StreetSweep> = (0..6).map(sweep).collect();
        let truth = street.tracks(&sweeps);
        (
            sweeps.into_iter().map(|sweep| sweep.points).collect(),
            truth,
        )
    })
}

/// A request with options and the first sweeps of the drive.
fn body(options: &'static str, sweeps: usize) -> Form {
    let form = Form::new().text("options", options);
    drive().0[..sweeps].iter().fold(form, |form, points| {
        let part = Part::bytes(file(CloudFormat::Npy, points)).file_name("f.npy");
        form.part("sweep", part)
    })
}

/// The name of a sequence with these options and sweeps after it has succeeded.
async fn succeeded(server: &Server, options: &'static str, sweeps: usize) -> String {
    let (status, job) = post(server, "/v1/sequences", body(options, sweeps)).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{job}");
    let id = job["id"].as_str().expect("a name").to_owned();
    let job = ended(server, &id).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    id
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_tracks_of_a_sequence_come_over_http_and_grpc_alike() {
    let server = Server::start(&[]);
    let id = succeeded(&server, "{}", 6).await;
    let answer = get(&server, &format!("/v1/jobs/{id}/tracks"), &[]).await;
    assert_eq!(answer.status(), StatusCode::OK);
    assert_eq!(answer.headers()["content-type"], "application/json");
    assert_eq!(answer.headers()["fnsf-pairs"], "5");
    let tracks = read_tracks(&answer.bytes().await.expect("a body")).expect("tracks");
    let mut pool = TrackingPool::default();
    pool.add(&tracked_sweeps(&drive().1, &tracks));
    let metrics = pool.metrics();
    assert!(metrics.matches * 2 > metrics.truth, "{metrics:?}");

    let mut client = client(&server).await;
    let asked = proto::GetTracksRequest { id };
    let stream = client.get_tracks(asked).await.expect("tracks").into_inner();
    let streamed: Vec<proto::Track> = stream.map(|track| track.expect("a track")).collect().await;
    assert_eq!(streamed.len(), tracks.len());
    for (message, track) in streamed.iter().zip(&tracks) {
        assert_eq!(message.id, track.id);
        assert_eq!(message.states.len(), track.states.len());
        for (message, state) in message.states.iter().zip(&track.states) {
            assert_eq!(message.sweep, state.sweep);
            assert_eq!(message.center, state.bounds.center);
            assert_eq!(message.size, state.bounds.size);
            assert_eq!(message.velocity, state.velocity);
            assert_eq!(message.points, state.points);
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tracks_of_what_has_none_are_refused_in_words() {
    let server = Server::start(&[]);
    let options = r#"{"preset": "paper", "max_points": 256}"#;
    let id = succeeded(&server, options, 3).await;
    let refused = async |id: &str| {
        let answer = get(&server, &format!("/v1/jobs/{id}/tracks"), &[]).await;
        let status = answer.status();
        let problem: Value = answer.json().await.expect("JSON");
        (status, problem["detail"].as_str().expect("text").to_owned())
    };
    let (status, detail) = refused(&id).await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    assert!(
        detail.contains("use the preset default or label"),
        "{detail}"
    );

    let job: Value = get(&server, &format!("/v1/jobs/{id}"), &[])
        .await
        .json()
        .await
        .expect("JSON");
    let pair = job["pairs"]["jobs"][0]["id"].as_str().expect("a name");
    let (status, detail) = refused(pair).await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    assert!(detail.contains("tracks are of a sequence"), "{detail}");

    let nobody = "0192f000-0000-7000-8000-000000000000";
    assert_eq!(refused(nobody).await.0, StatusCode::NOT_FOUND);
    let mut client = client(&server).await;
    let asked = proto::GetTracksRequest { id };
    let refused = client.get_tracks(asked).await.expect_err("refused");
    assert_eq!(refused.code(), Code::InvalidArgument);
}
