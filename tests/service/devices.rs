//! Tests of the choice of a device: refusals over HTTP and gRPC, and a server with a GPU.

use fnsf::flow::gpu;
use reqwest::StatusCode;
use serde_json::Value;
use tonic::Code;

use crate::clouds::{form, medium_pair, small_pair};
use crate::gpu_rule;
use crate::grpc::{self, proto};
use crate::server::{Server, ended};

#[tokio::test]
async fn a_job_for_a_kind_of_device_that_is_not_here_is_refused_at_both_doors() {
    let server = Server::start(&[]);
    for path in ["/v1/flow", "/v1/jobs"] {
        let sent = reqwest::Client::new()
            .post(server.url(path))
            .multipart(form(small_pair(), r#"{"device": "gpu"}"#))
            .send()
            .await
            .expect("an answer");
        assert_eq!(sent.status(), StatusCode::UNPROCESSABLE_ENTITY, "{path}");
        let problem: Value = sent.json().await.expect("a problem");
        assert_eq!(problem["code"], "no_device", "{problem}");
        assert_eq!(problem["retryable"], false);
    }
    let options = proto::Options {
        device: proto::Device::Gpu.into(),
        ..proto::Options::default()
    };
    let mut calls = grpc::client(&server).await;
    let refused = calls
        .estimate_flow(grpc::pair(small_pair(), options))
        .await
        .expect_err("a refusal");
    assert_eq!(refused.code(), Code::FailedPrecondition, "{refused}");
    assert!(refused.message().contains("no gpu"), "{refused}");
    assert!(
        (server.metric("fnsf_requests_rejected_total{reason=\"no_device\"}") - 3.0).abs() < 0.5
    );
}

#[tokio::test]
async fn half_precision_of_what_fits_no_field_is_refused_at_both_doors_and_names_neural() {
    let server = Server::start(&[]);
    let sent = reqwest::Client::new()
        .post(server.url("/v1/flow"))
        .multipart(form(small_pair(), r#"{"precision": "f16"}"#))
        .send()
        .await
        .expect("an answer");
    assert_eq!(sent.status(), StatusCode::BAD_REQUEST);
    let problem: Value = sent.json().await.expect("a problem");
    let detail = problem["detail"].as_str().unwrap_or_default();
    assert!(detail.contains("take preset neural"), "{problem}");
    let options = proto::Options {
        precision: proto::Precision::F16.into(),
        ..proto::Options::default()
    };
    let mut calls = grpc::client(&server).await;
    let refused = calls
        .estimate_flow(grpc::pair(small_pair(), options))
        .await
        .expect_err("a refusal");
    assert_eq!(refused.code(), Code::InvalidArgument, "{refused}");
    assert!(
        refused.message().contains("take preset neural"),
        "{refused}"
    );
}

#[tokio::test]
async fn pairs_side_by_side_on_one_cpu_have_the_flow_of_a_pair_alone() {
    let server = Server::start(&["--device", "cpu:4"]);
    let info = reqwest::get(server.url("/v1/info")).await;
    let info: Value = info.expect("an answer").json().await.expect("JSON");
    assert_eq!(info["devices"][0]["lanes"], 2, "{info}");
    let flow = || async {
        let sent = reqwest::Client::new()
            .post(server.url("/v1/flow"))
            .header("accept", "application/x-npy")
            .multipart(form(medium_pair(), "{}"))
            .send()
            .await
            .expect("an answer");
        assert_eq!(sent.status(), StatusCode::OK);
        sent.bytes().await.expect("a flow")
    };
    let alone = flow().await;
    let many = futures_util::future::join_all((0..6).map(|_| flow())).await;
    assert!(many.iter().all(|flow| *flow == alone));
}

#[tokio::test]
async fn auto_without_a_card_works_on_the_cpu_and_says_so() {
    let hardware = |card: &gpu::Adapter| card.kind != gpu::AdapterKind::Software;
    if gpu::adapters().iter().any(hardware) {
        return;
    }
    let server = Server::start(&["--device", "auto"]);
    assert!((server.metric("fnsf_device_fallback") - 1.0).abs() < 0.5);
    assert!(
        server.log().contains("no GPU was found"),
        "{}",
        server.log()
    );
}

#[tokio::test]
async fn a_server_on_a_card_gives_it_the_jobs_that_ask_for_one() {
    if !gpu_rule::is_there(gpu::adapters().len()) {
        return;
    }
    let server = Server::start(&["--device", "gpu:0", "--device", "cpu:1"]);
    assert!(server.metric("fnsf_device_lanes{device=\"gpu0\"}") >= 2.0);
    assert!((server.metric("fnsf_device_fallback")).abs() < 0.5);
    let mut devices = Vec::new();
    for (preset, device) in [
        ("neural", "gpu"),
        ("neural", "cpu"),
        ("default", "gpu"),
        ("nsfp-kdtree-linear", "auto"),
        ("fnsf-linear", "gpu"),
    ] {
        let field = match preset {
            "default" => "",
            _ => r#", "field": {"max_iterations": 60}"#,
        };
        let options =
            format!(r#"{{"preset": "{preset}", "device": "{device}", "max_points": 512{field}}}"#);
        let sent = reqwest::Client::new()
            .post(server.url("/v1/jobs"))
            .multipart(form(small_pair(), &options))
            .send()
            .await;
        let job: Value = sent.expect("an answer").json().await.expect("a job");
        let job = ended(&server, job["id"].as_str().expect("a name")).await;
        assert_eq!(job["state"], "succeeded", "{job}");
        devices.push(job["report"]["device"].as_str().expect("a name").to_owned());
    }
    assert_ne!(devices[0], devices[1]);
    assert_eq!(devices[1], devices[3]);
    assert_eq!(devices[0], devices[4]);
    // Objects are searched on the host, and the report names it. A hardware GPU may search clusters.
    let is_software = gpu::adapters()[0].kind == gpu::AdapterKind::Software;
    assert!(
        devices[2].starts_with("cpu (") || !is_software,
        "{devices:?}"
    );
}
