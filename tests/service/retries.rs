//! Tests of a client that loses its connection and retries with its idempotency key.

use std::io::Write;
use std::time::Duration;

use fnsf::formats::CloudFormat;
use reqwest::StatusCode;
use serde_json::Value;

use crate::clouds::{file, form, small_pair};
use crate::raw_http::{connect, multipart, post};
use crate::server::{PATIENCE, Server, ended};

/// Some seconds of work, so that the job runs when its client disconnects.
const OPTIONS: &str = r#"{"preset": "paper", "max_points": 2048}"#;

/// Requests a flow and disconnects while it is being computed.
fn hang_up(server: &Server, key: &str) {
    let [source, target] = small_pair()
        .each_ref()
        .map(|points| file(CloudFormat::Npy, points));
    let body = multipart(&[
        ("options", OPTIONS.as_bytes()),
        ("source", &source),
        ("target", &target),
    ]);
    let length = body.len();
    let head = format!("idempotency-key: {key}\r\ncontent-length: {length}\r\n\r\n");
    let mut stream = connect(server);
    let head = post("/v1/flow", &head);
    stream.write_all(head.as_bytes()).expect("sent");
    stream.write_all(&body).expect("sent");
    server.until("it runs", || server.metric("fnsf_jobs_running") > 0.0);
}

async fn ask(server: &Server, path: &str, key: &str) -> reqwest::Response {
    let sent = reqwest::Client::new()
        .post(server.url(path))
        .header("idempotency-key", key)
        .multipart(form(small_pair(), OPTIONS))
        .timeout(PATIENCE)
        .send();
    sent.await.expect("an answer")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_retry_after_a_lost_line_gets_its_flow() {
    let server = Server::start(&[]);
    // Immediately, and while the job is being cancelled.
    for millis in [0, 1, 3, 10, 30, 100] {
        let key = format!("after {millis} ms");
        hang_up(&server, &key);
        tokio::time::sleep(Duration::from_millis(millis)).await;
        let answer = ask(&server, "/v1/flow", &key).await;
        assert_eq!(answer.status(), StatusCode::OK, "{key}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_is_promised_after_a_lost_line_is_done() {
    let server = Server::start(&[]);
    for millis in [0, 1, 3, 10, 30, 100] {
        let key = format!("after {millis} ms");
        hang_up(&server, &key);
        tokio::time::sleep(Duration::from_millis(millis)).await;
        let answer = ask(&server, "/v1/jobs", &key).await;
        assert!(answer.status().is_success(), "{key}");
        let job: Value = answer.json().await.expect("a job");
        let id = job["id"].as_str().expect("a name");
        assert_eq!(ended(&server, id).await["state"], "succeeded", "{key}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_still_waits_gets_the_flow_that_another_has_given_up() {
    let server = Server::start(&[]);
    let first = tokio::spawn({
        let (url, key) = (server.url("/v1/flow"), "shared");
        async move {
            let sent = reqwest::Client::new()
                .post(url)
                .header("idempotency-key", key)
                .multipart(form(small_pair(), OPTIONS));
            sent.send().await.map(|answer| answer.status())
        }
    });
    server.until("it runs", || server.metric("fnsf_jobs_running") > 0.0);
    let second = ask(&server, "/v1/flow", "shared");
    let leave = async {
        tokio::time::sleep(Duration::from_millis(100)).await;
        first.abort();
    };
    let (second, ()) = tokio::join!(second, leave);
    assert_eq!(second.status(), StatusCode::OK);
    assert_eq!(server.metric("fnsf_jobs_submitted_total"), 1.0);
}

#[tokio::test]
async fn a_key_is_of_a_pair_or_of_a_sequence() {
    let server = Server::start(&[]);
    let client = reqwest::Client::new();
    let sweeps = || {
        let part = |points: &[fnsf::flow::Point]| {
            reqwest::multipart::Part::bytes(file(CloudFormat::Npy, points)).file_name("a.npy")
        };
        let [source, target] = small_pair();
        reqwest::multipart::Form::new()
            .text("options", "{}")
            .part("sweep", part(source))
            .part("sweep", part(target))
    };
    let of_pair = client
        .post(server.url("/v1/jobs"))
        .header("idempotency-key", "one")
        .multipart(form(small_pair(), "{}"))
        .send();
    assert_eq!(
        of_pair.await.expect("an answer").status(),
        StatusCode::ACCEPTED
    );
    let of_sequence = client
        .post(server.url("/v1/sequences"))
        .header("idempotency-key", "one")
        .multipart(sweeps())
        .send();
    let refused = of_sequence.await.expect("an answer");
    assert_eq!(refused.status(), StatusCode::UNPROCESSABLE_ENTITY);
}
