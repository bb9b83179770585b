//! Tests of results that are delivered to a bucket: the bytes that a download gives, after failures and
//! kills, and nowhere that the configuration does not allow.

use fnsf::formats::CloudFormat;
use reqwest::header::ACCEPT;
use reqwest::multipart::{Form, Part};
use reqwest::{Client, StatusCode};
use serde_json::{Value, json};

use crate::clouds::{accepted, file, form, small_pair};
use crate::object_server::ObjectServer;
use crate::server::{Folder, Server, ended};

const CONFIG: &str = "[remote]\nresults = [\"s3://farm/labels/\", \"s3://late/\"]\n";

async fn submit(server: &Server, options: &Value) -> Value {
    let form = form(small_pair(), &options.to_string());
    accepted(Client::new().post(server.url("/v1/jobs")).multipart(form)).await
}

/// A sequence of three sweeps.
async fn submit_sequence(server: &Server, options: &Value) -> Value {
    let [a, b] = small_pair();
    let mut form = Form::new().text("options", options.to_string());
    for (name, points) in [("0.npy", a), ("1.npy", b), ("2.npy", a)] {
        let part = Part::bytes(file(CloudFormat::Npy, points)).file_name(name);
        form = form.part("sweep", part);
    }
    let request = Client::new().post(server.url("/v1/sequences"));
    accepted(request.multipart(form)).await
}

/// The job once its result was delivered or given up.
async fn delivered(server: &Server, id: &str) -> Value {
    ended(server, id).await;
    loop {
        let job: Value = get(server, &format!("/v1/jobs/{id}"), "application/json").await;
        match job["delivery"]["state"].as_str() {
            Some("pending") => tokio::time::sleep(std::time::Duration::from_millis(50)).await,
            _ => return job,
        }
    }
}

async fn bytes(server: &Server, path: &str, accept: &str) -> Vec<u8> {
    let request = Client::new().get(server.url(path)).header(ACCEPT, accept);
    let answer = request.send().await.expect("an answer");
    assert_eq!(answer.status(), StatusCode::OK, "{path}");
    answer.bytes().await.expect("a body").to_vec()
}

async fn get(server: &Server, path: &str, accept: &str) -> Value {
    serde_json::from_slice(&bytes(server, path, accept).await).expect("JSON")
}

fn id(job: &Value) -> &str {
    job["id"].as_str().expect("an id")
}

#[tokio::test]
async fn a_result_is_written_to_its_uri_as_a_download_gives_it() {
    let Some(objects) = ObjectServer::start() else {
        return;
    };
    let server = Server::start_with(&Folder::new(), CONFIG, &objects.variables());
    for (ending, media) in [
        ("feather", "application/vnd.apache.arrow.file"),
        ("ply", "application/x-ply"),
    ] {
        let uri = format!("s3://farm/labels/drive 7/one.{ending}");
        let job = submit(&server, &json!({ "result_uri": uri })).await;
        assert_eq!(job["delivery"], json!({ "uri": uri, "state": "pending" }));
        let job = delivered(&server, id(&job)).await;
        assert_eq!(job["delivery"]["state"], "delivered", "{job}");
        let path = format!("/v1/jobs/{}/result", id(&job));
        let found = objects.get(&format!("labels/drive%207/one.{ending}"));
        assert!(found == bytes(&server, &path, media).await, "{ending}");
    }
    assert_eq!(
        server.metric("fnsf_deliveries_total{outcome=\"delivered\"}"),
        2.0
    );
}

#[tokio::test]
async fn each_pair_of_a_sequence_has_an_object_and_a_dense_cloud_has_one() {
    let Some(objects) = ObjectServer::start() else {
        return;
    };
    let server = Server::start_with(&Folder::new(), CONFIG, &objects.variables());
    let options = json!({ "result_uri": "s3://farm/labels/a/{index}.npz" });
    let job = submit_sequence(&server, &options).await;
    let job = ended(&server, id(&job)).await;
    assert_eq!(job["delivery"], Value::Null);
    let pairs = job["pairs"]["jobs"].as_array().expect("pairs");
    assert_eq!(pairs.len(), 2);
    for (index, pair) in pairs.iter().enumerate() {
        let pair = delivered(&server, id(pair)).await;
        assert_eq!(pair["delivery"]["state"], "delivered", "{pair}");
        let path = format!("/v1/jobs/{}/result", id(&pair));
        let found = objects.get(&format!("labels/a/00000{index}.npz"));
        assert!(found == bytes(&server, &path, "application/x-npz").await);
    }
    let options = json!({
        "result_uri": "s3://farm/labels/dense.laz",
        "densify": { "reference_time": 1 }
    });
    let job = submit_sequence(&server, &options).await;
    let job = delivered(&server, id(&job)).await;
    assert_eq!(job["delivery"]["state"], "delivered", "{job}");
    let path = format!("/v1/jobs/{}/result", id(&job));
    let found = objects.get("labels/dense.laz");
    assert!(found == bytes(&server, &path, "application/vnd.laszip").await);
}

#[tokio::test]
async fn a_bucket_that_comes_later_gets_its_result_from_the_next_process() {
    let Some(objects) = ObjectServer::start() else {
        return;
    };
    let folder = Folder::new();
    let server = Server::start_with(&folder, CONFIG, &objects.variables());
    let job = submit(&server, &json!({ "result_uri": "s3://late/one.npy" })).await;
    ended(&server, id(&job)).await;
    server.until("it was tried", || {
        server.metric("fnsf_deliveries_total{outcome=\"retried\"}") >= 1.0
    });
    server.kill();
    assert!(objects.makes_a_bucket("late"));
    let server = Server::start_with(&folder, CONFIG, &objects.variables());
    let job = delivered(&server, id(&job)).await;
    assert_eq!(job["delivery"]["state"], "delivered", "{job}");
}

#[tokio::test]
async fn a_place_is_refused_that_is_not_allowed_or_does_not_fit_the_result() {
    let server = Server::with_config(CONFIG);
    for (uri, said) in [
        ("s3://farm/other/one.npz", "not below an address"),
        ("s3://another/one.npz", "not below an address"),
        ("file:///tmp/one.npz", "not below an address"),
        ("s3://farm/labels/../other/one.npz", "not below an address"),
        ("s3://farm/labels/a%2Fb.npz", "not a plain URL"),
        ("s3://farm/labels/one.npz?versionId=1", "not a plain URL"),
        ("s3://farm/labels/one.xyz", "one of npz"),
        (
            "s3://farm/labels/{index}.npz",
            "for the flows of a sequence",
        ),
    ] {
        let form = form(small_pair(), &json!({ "result_uri": uri }).to_string());
        let sent = Client::new()
            .post(server.url("/v1/jobs"))
            .multipart(form)
            .send();
        let answer = sent.await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::BAD_REQUEST, "{uri}");
        let problem: Value = answer.json().await.expect("JSON");
        assert_eq!(problem["code"], "invalid_options");
        let detail = problem["detail"].as_str().expect("text");
        assert!(detail.contains(said), "{uri}: {detail}");
    }
    let options = json!({ "result_uri": "s3://farm/labels/one.npz" }).to_string();
    // A call that waits for its flow, and a server that delivers nothing.
    let plain = Server::start(&[]);
    for (server, path, said) in [
        (&server, "/v1/flow", "is for submitted jobs"),
        (&plain, "/v1/jobs", "remote.results"),
    ] {
        let form = form(small_pair(), &options);
        let sent = Client::new().post(server.url(path)).multipart(form).send();
        let answer = sent.await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::BAD_REQUEST);
        let text = answer.text().await.expect("text");
        assert!(text.contains(said), "{text}");
    }
}
