//! Tests of sweeps that are named by URI: files, https servers and buckets that the configuration
//! allows, and nothing else.

use axum::Router;
use axum::http::{StatusCode as Status, header};
use axum::response::IntoResponse;
use axum::routing::get;
use fnsf::formats::CloudFormat;
use reqwest::multipart::Form;
use reqwest::{Client, StatusCode};
use serde_json::Value;

use crate::clouds::{file, small_pair};
use crate::object_server::ObjectServer;
use crate::server::{Folder, Server, ended};

/// A folder with `a.npy` and `b.npy`, and its prefix as a `file` URI.
fn folder() -> (Folder, String) {
    let folder = Folder::new();
    for (name, points) in ["a.npy", "b.npy"].iter().zip(small_pair()) {
        std::fs::write(folder.path().join(name), file(CloudFormat::Npy, points)).expect("a file");
    }
    let prefix = format!("file://{}/", folder.path().display());
    (folder, prefix)
}

fn config(prefix: &str, private: bool) -> String {
    format!("[remote]\nsweeps = [\"{prefix}\"]\nallow_private_addresses = {private}\n")
}

/// Sends the URIs of a pair.
async fn send(server: &Server, path: &str, source: &str, target: &str) -> (StatusCode, Vec<u8>) {
    let form = Form::new()
        .text("source_uri", source.to_owned())
        .text("target_uri", target.to_owned());
    let sent = Client::new().post(server.url(path)).multipart(form).send();
    let answer = sent.await.expect("an answer");
    (
        answer.status(),
        answer.bytes().await.expect("a body").to_vec(),
    )
}

/// Fails unless the pair is refused with this code.
async fn refuse(server: &Server, source: &str, code: &str) {
    let (status, body) = send(server, "/v1/jobs", source, source).await;
    let problem: Value = serde_json::from_slice(&body).expect("JSON");
    assert_eq!(problem["code"], code, "{source}: {status} {problem}");
}

#[tokio::test]
async fn sweeps_by_uri_give_the_flow_of_the_same_files_that_are_sent() {
    let (folder, prefix) = folder();
    let server = Server::with_config(&config(&prefix, false));
    let [a, b] = ["a.npy", "b.npy"].map(|name| format!("{prefix}{name}"));
    let hash = blake3::hash(&file(CloudFormat::Npy, &small_pair()[0]));
    let (status, named) = send(&server, "/v1/flow", &format!("{a}#blake3={hash}"), &b).await;
    assert_eq!(status, StatusCode::OK);
    let form = crate::clouds::form(small_pair(), "{}");
    let sent = Client::new()
        .post(server.url("/v1/flow"))
        .multipart(form)
        .send();
    let sent = sent
        .await
        .expect("an answer")
        .bytes()
        .await
        .expect("a flow");
    assert_eq!(named, sent);
    // A URI has %20 for the space, whose digits would join those of the timestamp.
    let names = ["LIDAR 1532402927647951", "LIDAR 1532402927697731"];
    for (name, points) in names.iter().zip(small_pair()) {
        let path = folder.path().join(format!("{name}.npy"));
        std::fs::write(path, file(CloudFormat::Npy, points)).expect("a file");
    }
    let [first, second] = names.map(|name| format!("{prefix}{name}.npy").replace(' ', "%20"));
    let (status, body) = send(&server, "/v1/jobs", &first, &second).await;
    assert_eq!(status, StatusCode::ACCEPTED);
    let job: Value = serde_json::from_slice(&body).expect("JSON");
    let job = ended(&server, job["id"].as_str().expect("an id")).await;
    assert_eq!(job["report"]["dt_s"], 0.04978, "{job}");
    // A sequence of both kinds.
    let form = Form::new()
        .text("sweep_uri", a.clone())
        .text("sweep_uri", b)
        .text("sweep_uri", a);
    let sent = Client::new()
        .post(server.url("/v1/sequences"))
        .multipart(form)
        .send();
    let job: Value = sent.await.expect("an answer").json().await.expect("a job");
    let job = ended(&server, job["id"].as_str().expect("an id")).await;
    assert_eq!(job["state"], "succeeded", "{job}");
}

#[tokio::test]
async fn nothing_is_fetched_that_the_configuration_does_not_allow() {
    let (folder, prefix) = folder();
    let secret = Folder::new();
    let outside = secret.path().join("secret.npy");
    std::fs::write(&outside, file(CloudFormat::Npy, &small_pair()[0])).expect("a file");
    std::os::unix::fs::symlink(&outside, folder.path().join("link.npy")).expect("a link");
    let server = Server::with_config(&config(&prefix, false));
    refuse(
        &server,
        &format!("file://{}", outside.display()),
        "bad_request",
    )
    .await;
    refuse(&server, &format!("{prefix}../etc/passwd"), "bad_request").await;
    refuse(&server, &format!("{prefix}link.npy"), "bad_request").await;
    refuse(&server, &format!("{prefix}."), "bad_request").await;
    refuse(
        &server,
        "http://169.254.169.254/latest/meta-data",
        "bad_request",
    )
    .await;
    refuse(&server, &format!("{prefix}a.npy#blake3=7"), "bad_request").await;
    refuse(&server, &format!("{prefix}missing.npy"), "bad_input").await;
    let wrong = blake3::hash(b"another file");
    refuse(
        &server,
        &format!("{prefix}a.npy#blake3={wrong}"),
        "bad_input",
    )
    .await;
    let long = format!("{prefix}{}", "a".repeat(5000));
    refuse(&server, &long, "too_large").await;
    let plain = Server::start(&[]);
    refuse(&plain, &format!("{prefix}a.npy"), "bad_request").await;
    // An address of this machine behind an allowed name and port.
    for host in ["localhost", "127.0.0.1", "[::1]"] {
        let prefix = format!(
            "http://{host}:{}/",
            server.public.rsplit(':').next().expect("a port")
        );
        let other = Server::with_config(&config(&prefix, false));
        let (status, body) = send(&other, "/v1/jobs", &format!("{prefix}a.npy"), "").await;
        let said = String::from_utf8_lossy(&body).into_owned();
        assert!(
            matches!(status.as_u16(), 400 | 502),
            "{host}: {status} {said}"
        );
        assert!(
            said.contains("no public address") || said.contains("not allowed"),
            "{said}"
        );
    }
}

#[tokio::test]
async fn a_server_of_files_may_fail_and_leads_nowhere_else() {
    let bytes = file(CloudFormat::Npy, &small_pair()[0]);
    let moved = || async { (Status::FOUND, [(header::LOCATION, "/in/a.npy")]).into_response() };
    let endless = || async {
        let pieces = futures_util::stream::repeat_with(|| {
            Ok::<_, std::io::Error>(axum::body::Bytes::from(vec![7; 1 << 20]))
        });
        axum::body::Body::from_stream(pieces)
    };
    let router = Router::new()
        .route("/in/a.npy", get(move || async move { bytes }))
        .route("/in/moved.npy", get(moved))
        .route("/in/endless.npy", get(endless))
        .route(
            "/in/broken.npy",
            get(|| async { Status::SERVICE_UNAVAILABLE }),
        );
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0")
        .await
        .expect("a port");
    let prefix = format!("http://{}/in/", listener.local_addr().expect("an address"));
    tokio::spawn(async move { axum::serve(listener, router).await });
    let limits = "[limits]\nmax_upload_mib = 8\nmax_total_upload_mib = 32\n";
    let server = Server::with_config(&format!("{}{limits}", config(&prefix, true)));
    let a = format!("{prefix}a.npy");
    let (status, _) = send(&server, "/v1/jobs", &a, &a).await;
    assert_eq!(status, StatusCode::ACCEPTED);
    refuse(&server, &format!("{prefix}moved.npy"), "bad_input").await;
    refuse(&server, &format!("{prefix}missing.npy"), "bad_input").await;
    refuse(
        &server,
        &format!("{prefix}broken.npy"),
        "source_unavailable",
    )
    .await;
    refuse(&server, &format!("{prefix}endless.npy"), "too_large").await;
}

#[tokio::test]
async fn a_source_that_stalls_is_named_and_does_not_hold_up_others() {
    let bytes = file(CloudFormat::Npy, &small_pair()[0]);
    let stalls = || async { std::future::pending::<Status>().await };
    let serve = async |router: Router| {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await;
        let listener = listener.expect("a port");
        let prefix = format!("http://{}/", listener.local_addr().expect("an address"));
        tokio::spawn(async move { axum::serve(listener, router).await });
        prefix
    };
    let slow = serve(Router::new().route("/a.npy", get(stalls))).await;
    let good = serve(Router::new().route("/a.npy", get(move || async move { bytes }))).await;
    let server = Server::with_config(&format!(
        "[remote]\nsweeps = [\"{slow}\", \"{good}\"]\nallow_private_addresses = true\n\
         [limits]\nbody_timeout_seconds = 3\n"
    ));
    let [slow, good] = [slow, good].map(|prefix| format!("{prefix}a.npy"));
    // More than the turns of all sources.
    let stalling = (0..40).map(|_| send(&server, "/v1/jobs", &slow, &slow));
    let others = async {
        tokio::time::sleep(std::time::Duration::from_secs(1)).await;
        let began = std::time::Instant::now();
        let (status, _) = send(&server, "/v1/jobs", &good, &good).await;
        assert_eq!(status, StatusCode::ACCEPTED);
        assert!(began.elapsed().as_secs() < 2, "{:?}", began.elapsed());
    };
    let (refused, ()) =
        futures_util::future::join(futures_util::future::join_all(stalling), others).await;
    let codes: std::collections::BTreeSet<String> = refused
        .iter()
        .map(|(_, body)| serde_json::from_slice(body).expect("JSON"))
        .map(|problem: Value| problem["code"].as_str().unwrap_or_default().to_owned())
        .collect();
    assert!(
        codes.iter().eq(["server_full", "source_unavailable"]),
        "{codes:?}"
    );
}

#[tokio::test]
async fn sweeps_are_fetched_from_a_bucket() {
    let Some(objects) = ObjectServer::start() else {
        return;
    };
    let variables = objects.variables();
    for (name, points) in ["a.npy", "b.npy"].iter().zip(small_pair()) {
        let (path, bytes) = (format!("drives/7/{name}"), file(CloudFormat::Npy, points));
        objects.put(&path, &bytes);
        assert!(objects.get(&path) == bytes, "{path}");
    }
    let folder = Folder::new();
    let server = Server::start_with(&folder, &config("s3://farm/drives/", false), &variables);
    let [a, b] = ["a.npy", "b.npy"].map(|name| format!("s3://farm/drives/7/{name}"));
    let (status, flow) = send(&server, "/v1/flow", &a, &b).await;
    assert_eq!(status, StatusCode::OK, "{}", String::from_utf8_lossy(&flow));
    refuse(&server, "s3://farm/drives/7/missing.npy", "bad_input").await;
    refuse(&server, "s3://farm/other/a.npy", "bad_request").await;
    refuse(&server, "s3://another/drives/a.npy", "bad_request").await;
}

#[tokio::test]
async fn sweeps_may_be_named_by_uri_over_grpc_too() {
    use crate::grpc::proto::submit_job_request::{Begin, NextCloud, Part};
    use crate::grpc::{chunk, client, proto};
    let (_folder, prefix) = folder();
    let server = Server::with_config(&config(&prefix, false));
    let mut calls = client(&server).await;
    let named = |name: &str| {
        Part::Next(NextCloud {
            uri: format!("{prefix}{name}"),
            ..NextCloud::default()
        })
    };
    let request = |parts: Vec<Part>| {
        let begin = Part::Begin(Begin::default());
        let message = |part| proto::SubmitJobRequest { part: Some(part) };
        tokio_stream::iter(std::iter::once(begin).chain(parts).map(message))
    };
    let sent = || {
        let points = chunk(&small_pair()[1]);
        [Part::Next(NextCloud::default()), Part::Chunk(points)]
    };
    let mut flows = Vec::new();
    for parts in [
        vec![named("a.npy"), named("b.npy")],
        [vec![named("a.npy")], sent().to_vec()].concat(),
    ] {
        let job = calls.submit_job(request(parts)).await.expect("accepted");
        let job = ended(&server, &job.into_inner().id).await;
        let path = job["links"]["result"].as_str().expect("a path");
        let flow = Client::new().get(server.url(path)).send().await;
        flows.push(flow.expect("an answer").bytes().await.expect("a flow"));
    }
    assert!(flows[0] == flows[1]);
    for (parts, said) in [
        (vec![named("../secret.npy"), named("b.npy")], "not below"),
        (vec![named("missing.npy"), named("b.npy")], "not there"),
        (
            [vec![named("a.npy")], sent()[1..].to_vec()].concat(),
            "send next first",
        ),
    ] {
        let refused = calls.submit_job(request(parts)).await.expect_err(said);
        assert!(refused.message().contains(said), "{refused}");
    }
}
