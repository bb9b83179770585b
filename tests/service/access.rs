//! Tests of access control: every route and every method with every kind of key.

use std::process::Command;

use axum::http;
use fnsf::flow::Point;
use reqwest::{Client, Method};
use serde_json::Value;
use tonic::{Code, Request};

use crate::clouds::{form, small_pair};
use crate::grpc::{client, pair, proto};
use crate::raw_http::SMALL;
use crate::server::{Folder, Server, ended};

/// A key of tenant a with the write role.
const WRITER: &str = "key-of-the-writer-of-a";
/// A key of tenant a with the read role.
const READER: &str = "key-of-the-reader-of-a";
/// A key of tenant b with the write role.
const OTHER: &str = "key-of-the-writer-of-b";

/// A server with the three keys.
fn guarded() -> Server {
    let mut config = String::new();
    for (tenant, role, key) in [
        ("a", "write", WRITER),
        ("a", "read", READER),
        ("b", "write", OTHER),
    ] {
        config += &format!("[[keys]]\ntenant = \"{tenant}\"\nrole = \"{role}\"\nkey = \"{key}\"\n");
    }
    Server::with_config(&config)
}

/// Values of the authorization header that must be refused.
const SHUT: [Option<&str>; 9] = [
    None,
    Some(""),
    Some("Bearer"),
    Some("Bearer "),
    Some("Bearer key-of-nobody-at-all"),
    Some("Bearer key-of-the-writer-of-"),
    Some("Bearer key-of-the-writer-of-a, Bearer key-of-the-writer-of-b"),
    Some("Basic key-of-the-writer-of-a"),
    Some("key-of-the-writer-of-a"),
];

/// Submits a job as tenant a and waits until it has succeeded. Returns its id.
async fn finished(server: &Server) -> String {
    let sent = Client::new()
        .post(server.url("/v1/jobs"))
        .bearer_auth(WRITER)
        .multipart(form(small_pair(), SMALL))
        .send();
    let job: Value = sent.await.expect("an answer").json().await.expect("a job");
    let id = job["id"].as_str().expect("a name").to_owned();
    let url = server.url(&format!("/v1/jobs/{id}?wait=60"));
    let seen = Client::new().get(url).bearer_auth(WRITER).send().await;
    let seen: Value = seen.expect("an answer").json().await.expect("a job");
    assert_eq!(seen["state"], "succeeded");
    id
}

/// The status of a request. Submission routes are sent a pair.
async fn ask(server: &Server, method: &Method, path: &str, shown: Option<&str>) -> u16 {
    let mut request = Client::new().request(method.clone(), server.url(path));
    if let Some(shown) = shown {
        request = request.header("authorization", shown);
    }
    if *method == Method::POST && !path.ends_with("requeue") && !path.ends_with("share") {
        request = request.multipart(form(small_pair(), SMALL));
    }
    let answer = request.send().await.expect("an answer");
    answer.status().as_u16()
}

/// A path of the documentation with its parameters filled in.
fn fill(path: &str, id: &str) -> String {
    let path = path.replace("{id}", id);
    path.replace("{index}", "0").replace("{sweep}", "0")
}

#[tokio::test]
async fn every_route_of_http_takes_a_key_and_gives_only_what_it_opens() {
    let server = guarded();
    let id = finished(&server).await;
    let document = reqwest::get(server.url("/openapi.json")).await;
    let document: Value = document.expect("an answer").json().await.expect("JSON");
    let mut routes = Vec::new();
    for (path, methods) in document["paths"].as_object().expect("paths") {
        for method in methods.as_object().expect("methods").keys() {
            let method = method.to_uppercase().parse::<Method>();
            routes.push((method.expect("a method"), fill(path, &id)));
        }
    }
    assert_eq!(routes.len(), 16);
    for (method, path) in [
        ("GET", "/v1"),
        ("GET", "/v1/flow"),
        ("PUT", "/v1/jobs"),
        ("OPTIONS", "/v1/jobs"),
        ("TRACE", "/v1/jobs"),
        ("HEAD", "/v1/jobs"),
        ("GET", "/metrics"),
        ("GET", "/livez"),
        ("GET", "/readyz"),
        ("GET", "/v1/jobs/"),
        ("GET", "/V1/jobs"),
        ("GET", "//v1/jobs"),
        ("GET", "/docs/../v1/jobs"),
        ("GET", "/docs%2f../v1/jobs"),
        ("GET", "/openapi.json/../v1/jobs"),
        ("GET", "/openapi.jsonx"),
        ("GET", "/docsx"),
        ("GET", "/consolex"),
        ("GET", "/console/../v1/jobs"),
        ("GET", "/grpc.health.v1.Healthx/Check"),
        ("POST", "/fnsf.v1.SceneFlow/ListJobs"),
    ] {
        routes.push((method.parse().expect("a method"), path.to_owned()));
    }
    for (method, path) in &routes {
        for shown in SHUT {
            let status = ask(&server, method, path, shown).await;
            assert_eq!(status, 401, "{method} {path} with {shown:?}");
        }
    }
    let own = format!("/v1/jobs/{id}");
    let [events, result, requeue, tracks] =
        ["events", "result", "requeue", "tracks"].map(|of| format!("{own}/{of}"));
    let [scene, sweep, share] = ["scene", "sweeps/0", "share"].map(|of| format!("{own}/{of}"));
    let removal = format!("{own}?remove=true");
    // Expected status for the reader, the other tenant and the writer.
    let expected = [
        (Method::GET, "/v1/info", [200, 200, 200]),
        (Method::POST, "/v1/flow", [403, 200, 200]),
        (Method::POST, "/v1/jobs", [403, 202, 202]),
        (Method::POST, "/v1/sequences", [403, 202, 202]),
        (Method::GET, "/v1/jobs", [200, 200, 200]),
        (Method::GET, &own, [200, 404, 200]),
        (Method::GET, &events, [200, 404, 200]),
        (Method::GET, &result, [200, 404, 200]),
        // The job is a pair.
        (Method::GET, &tracks, [400, 404, 400]),
        (Method::GET, &scene, [200, 404, 200]),
        (Method::GET, &sweep, [200, 404, 200]),
        (Method::POST, &share, [200, 404, 200]),
        (Method::GET, "/v1/queue", [200, 200, 200]),
        (Method::GET, "/v1/street/0", [200, 200, 200]),
        (Method::POST, &requeue, [403, 404, 400]),
        (Method::DELETE, &own, [403, 404, 200]),
        (Method::DELETE, &removal, [403, 404, 204]),
        (Method::GET, "/v1/nothing", [404, 404, 404]),
        (Method::PUT, "/v1/jobs", [405, 405, 405]),
        (Method::GET, "/metrics", [404, 404, 404]),
    ];
    for (method, path) in &routes[..16] {
        let told = expected
            .iter()
            .any(|(known, at, _)| known == method && at == path);
        assert!(told, "{method} {path} is in no row");
    }
    for (method, path, statuses) in expected {
        for (key, expected) in [READER, OTHER, WRITER].into_iter().zip(statuses) {
            let shown = format!("Bearer {key}");
            let status = ask(&server, &method, path, Some(&shown)).await;
            assert_eq!(status, expected, "{method} {path} with {key}");
        }
    }
    for open in ["/", "/console/main.js", "/openapi.json", "/docs", "/docs/"] {
        assert_eq!(ask(&server, &Method::GET, open, None).await, 200, "{open}");
    }
    // The admin port needs no key: it exposes no jobs and listens on loopback.
    for open in ["/livez", "/readyz", "/metrics"] {
        let answer = reqwest::get(format!("http://{}{open}", server.admin))
            .await
            .expect("an answer");
        assert_eq!(answer.status(), 200, "{open}");
        assert!(!answer.text().await.expect("text").contains(&id));
    }
    // A page of another site, also one whose name leads to this machine, does not read it.
    let own = server.admin.to_string();
    for (host, origin) in [
        ("evil.example:9090", None),
        (own.as_str(), Some("https://evil.example")),
    ] {
        let mut request = Client::new().get(format!("http://{own}/nodes"));
        request = request.header("host", host);
        if let Some(origin) = origin {
            request = request.header("origin", origin);
        }
        let answer = request.send().await.expect("an answer");
        assert_eq!(answer.status(), 403, "{host} {origin:?}");
    }
    let closed = reqwest::get(format!("http://{}/v1/jobs", server.admin)).await;
    assert_eq!(closed.expect("an answer").status(), 404);
}

#[tokio::test]
async fn a_reader_may_not_write_and_is_told_so_whatever_it_sends() {
    let server = guarded();
    for path in ["/v1/flow", "/v1/jobs", "/v1/sequences"] {
        for (media, body) in [("application/json", "{}"), ("multipart/form-data", "")] {
            let sent = Client::new()
                .post(server.url(path))
                .bearer_auth(READER)
                .header("content-type", media)
                .body(body)
                .send();
            assert_eq!(sent.await.expect("an answer").status(), 403, "{path}");
        }
    }
}

#[tokio::test]
async fn lists_and_keys_of_submissions_are_each_tenants_own() {
    let server = guarded();
    let mut ids = Vec::new();
    for key in [WRITER, OTHER] {
        let sent = Client::new()
            .post(server.url("/v1/jobs"))
            .bearer_auth(key)
            .header("idempotency-key", "the-same")
            .multipart(form(small_pair(), SMALL))
            .send();
        let answer = sent.await.expect("an answer");
        assert_eq!(answer.status(), 202, "it was found as another tenant's");
        let job: Value = answer.json().await.expect("a job");
        ids.push(job["id"].as_str().expect("a name").to_owned());
    }
    for (key, own) in [(WRITER, 0), (READER, 0), (OTHER, 1)] {
        let urls = [
            "/v1/jobs".to_owned(),
            "/v1/jobs?limit=1000".to_owned(),
            format!("/v1/jobs?before={}", "ffffffff-ffff-7fff-bfff-ffffffffffff"),
        ];
        for url in urls {
            let sent = Client::new().get(server.url(&url)).bearer_auth(key).send();
            let page: Value = sent.await.expect("an answer").json().await.expect("a page");
            let jobs = page["jobs"].as_array().expect("jobs");
            let listed: Vec<_> = jobs.iter().map(|job| job["id"].as_str()).collect();
            assert_eq!(listed, [Some(ids[own].as_str())], "{url}");
        }
        let mut asked = Request::new(proto::ListJobsRequest::default());
        let shown = format!("Bearer {key}").parse().expect("plain text");
        asked.metadata_mut().insert("authorization", shown);
        let listed = client(&server)
            .await
            .list_jobs(asked)
            .await
            .expect("a list");
        let jobs = listed.into_inner().jobs;
        assert_eq!(jobs.len(), 1);
        assert_eq!(jobs[0].id, ids[own]);
    }
}

/// A request with the given authorization metadata.
fn showing<T>(message: T, shown: Option<&str>) -> Request<T> {
    let mut request = Request::new(message);
    if let Some(shown) = shown {
        let value = shown.parse().expect("plain text");
        request.metadata_mut().insert("authorization", value);
    }
    request
}

/// The status codes of the nine methods. Those that need a job id use `id`, a job of tenant a.
async fn codes(server: &Server, id: &str, shown: Option<&str>) -> [Code; 11] {
    use proto::estimate_sequence_request as sequence;
    use proto::submit_job_request as submit;
    let code =
        |result: Result<(), tonic::Status>| result.map_or_else(|error| error.code(), |()| Code::Ok);
    let mut calls = client(server).await;
    let id = || id.to_owned();
    let options = || proto::Options {
        preset: proto::Preset::Neural.into(),
        max_points: Some(512),
        ..proto::Options::default()
    };
    let chunk = |points: &[Point]| {
        let values = points.as_flattened().iter();
        let bytes: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
        proto::Chunk {
            points: bytes.into(),
            ground: Vec::new().into(),
        }
    };
    let flow = calls
        .estimate_flow(showing(pair(small_pair(), options()), shown))
        .await;
    let mut parts = vec![sequence::Part::Begin(sequence::Begin {
        options: Some(Box::new(options())),
    })];
    let mut jobs = vec![submit::Part::Begin(submit::Begin {
        options: Some(Box::new(options())),
        ..submit::Begin::default()
    })];
    for points in small_pair() {
        parts.push(sequence::Part::Sweep(sequence::Sweep::default()));
        parts.push(sequence::Part::Chunk(chunk(points)));
        jobs.push(submit::Part::Next(submit::NextCloud::default()));
        jobs.push(submit::Part::Chunk(chunk(points)));
    }
    let parts = parts
        .into_iter()
        .map(|part| proto::EstimateSequenceRequest { part: Some(part) });
    let jobs = jobs
        .into_iter()
        .map(|part| proto::SubmitJobRequest { part: Some(part) });
    let sequence = calls
        .estimate_sequence(showing(tokio_stream::iter(parts), shown))
        .await;
    let submitted = calls
        .submit_job(showing(tokio_stream::iter(jobs), shown))
        .await;
    let seen = calls
        .get_job(showing(proto::GetJobRequest { id: id() }, shown))
        .await;
    let listed = calls
        .list_jobs(showing(proto::ListJobsRequest::default(), shown))
        .await;
    let cancelled = calls
        .cancel_job(showing(proto::CancelJobRequest { id: id() }, shown))
        .await;
    let requeued = calls
        .requeue_job(showing(proto::RequeueJobRequest { id: id() }, shown))
        .await;
    let watched = calls
        .watch_job(showing(proto::WatchJobRequest { id: id() }, shown))
        .await;
    let asked = proto::DownloadResultRequest {
        id: id(),
        first_row: 0,
    };
    let fetched = calls.download_result(showing(asked, shown)).await;
    let tracked = calls
        .get_tracks(showing(proto::GetTracksRequest { id: id() }, shown))
        .await;
    // Last, as it removes the job.
    let deleted = calls
        .delete_job(showing(proto::DeleteJobRequest { id: id() }, shown))
        .await;
    [
        code(flow.map(drop)),
        code(sequence.map(drop)),
        code(submitted.map(drop)),
        code(seen.map(drop)),
        code(listed.map(drop)),
        code(cancelled.map(drop)),
        code(requeued.map(drop)),
        code(watched.map(drop)),
        code(fetched.map(drop)),
        code(tracked.map(drop)),
        code(deleted.map(drop)),
    ]
}

#[tokio::test]
async fn every_call_of_grpc_takes_a_key_and_gives_only_what_it_opens() {
    let server = guarded();
    let id = finished(&server).await;
    for shown in SHUT {
        let codes = codes(&server, &id, shown).await;
        assert_eq!(codes, [Code::Unauthenticated; 11], "{shown:?}");
    }
    // Estimate, sequence, submit; get, list, cancel, requeue, watch, download, tracks, delete.
    let (ok, no, none) = (Code::Ok, Code::PermissionDenied, Code::NotFound);
    // The job has succeeded, and it is a pair.
    let bad = Code::InvalidArgument;
    for (key, expected) in [
        (READER, [no, no, no, ok, ok, no, no, ok, ok, bad, no]),
        (
            OTHER,
            [ok, ok, ok, none, ok, none, none, none, none, none, none],
        ),
        (WRITER, [ok, ok, ok, ok, ok, ok, bad, ok, ok, bad, ok]),
    ] {
        let shown = format!("Bearer {key}");
        assert_eq!(codes(&server, &id, Some(&shown)).await, expected, "{key}");
    }
}

/// The status code of a call with an empty message. `method` is the path without its leading slash.
async fn plain_call(server: &Server, method: &str, shown: Option<&str>) -> Code {
    let stream = tokio::net::TcpStream::connect(&server.public).await;
    let (client, connection) = h2::client::handshake(stream.expect("a connection"))
        .await
        .expect("HTTP/2");
    let driving = tokio::spawn(connection);
    let mut request = http::Request::post(format!("http://localhost/{method}"))
        .header("content-type", "application/grpc")
        .header("te", "trailers");
    if let Some(shown) = shown {
        request = request.header("authorization", shown);
    }
    let request = request.body(()).expect("a request");
    let mut client = client.ready().await.expect("open");
    let (response, mut sending) = client.send_request(request, false).expect("sent");
    // The server may have refused the call already.
    let _refused_early = sending.send_data(bytes::Bytes::from_static(&[0; 5]), true);
    let mut response = response.await.expect("an answer");
    let mut headers = response.headers().clone();
    if !headers.contains_key("grpc-status") {
        let body = response.body_mut();
        while let Some(piece) = body.data().await {
            let piece = piece.expect("a piece");
            let _window = body.flow_control().release_capacity(piece.len());
        }
        headers = body.trailers().await.expect("an end").expect("trailers");
    }
    driving.abort();
    let code = headers["grpc-status"].to_str().expect("text").parse();
    Code::from_i32(code.expect("a number"))
}

#[tokio::test]
async fn health_is_open_and_reflection_and_unknown_calls_take_a_key() {
    let server = guarded();
    let good = format!("Bearer {READER}");
    for shown in SHUT {
        let health = plain_call(&server, "grpc.health.v1.Health/Check", shown).await;
        assert_eq!(health, Code::Ok, "{shown:?}");
    }
    for (method, expected) in [
        (
            "grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
            Code::InvalidArgument,
        ),
        (
            "grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
            Code::InvalidArgument,
        ),
        ("fnsf.v1.SceneFlow/Nothing", Code::Unimplemented),
        ("fnsf.v1.Nothing/Nothing", Code::Unimplemented),
        ("nothing", Code::Unimplemented),
    ] {
        for shown in SHUT {
            let code = plain_call(&server, method, shown).await;
            assert_eq!(code, Code::Unauthenticated, "{method} with {shown:?}");
        }
        let code = plain_call(&server, method, Some(&good)).await;
        assert_eq!(code, expected, "{method}");
    }
}

#[test]
fn keys_that_are_weak_or_shared_and_open_doors_refuse_to_start() {
    let key = |tenant: &str, key: &str| {
        format!("[[keys]]\ntenant = \"{tenant}\"\nrole = \"write\"\nkey = \"{key}\"\n")
    };
    let twice = key("a", WRITER) + &key("b", WRITER);
    let open = "listen = \"0.0.0.0:0\"\n";
    for (config, said) in [
        (key("a", ""), "shorter than 16"),
        (key("a", "fifteen-letters"), "shorter than 16"),
        ("api_key = \"\"\n".to_owned(), "shorter than 16"),
        (format!("{open}api_key = \"\"\n"), "shorter than 16"),
        (twice, "given twice"),
        (key("../a", WRITER), "a tenant's name"),
        (key("", WRITER), "a tenant's name"),
        (open.to_owned(), "listen goes beyond loopback"),
        (
            "listen = \"[::]:0\"\n".to_owned(),
            "listen goes beyond loopback",
        ),
    ] {
        let folder = Folder::new();
        let file = folder.path().join("fnsf.toml");
        std::fs::write(&file, &config).expect("a file");
        let ended = Command::new(env!("CARGO_BIN_EXE_fnsf"))
            .args(["serve", "--admin-listen", "127.0.0.1:0", "--data-dir"])
            .arg(folder.path().join("data"))
            .arg("--config")
            .arg(&file)
            .output()
            .expect("it runs");
        let log = String::from_utf8_lossy(&ended.stderr);
        assert_eq!(ended.status.code(), Some(2), "{config}: {log}");
        assert!(
            log.contains(said) && !log.contains(WRITER),
            "{config}: {log}"
        );
        assert!(ended.stdout.is_empty(), "{config}: it served");
    }
}

#[tokio::test]
async fn a_server_without_keys_serves_everybody_on_loopback() {
    let server = Server::start(&[]);
    assert_eq!(ask(&server, &Method::POST, "/v1/jobs", None).await, 202);
    let listed = reqwest::get(server.url("/v1/jobs"))
        .await
        .expect("an answer");
    let page: Value = listed.json().await.expect("a page");
    let id = page["jobs"][0]["id"].as_str().expect("a job");
    assert_eq!(ended(&server, id).await["state"], "succeeded");
}
