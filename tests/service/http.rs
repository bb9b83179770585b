//! Tests of the HTTP protocol: flow of files, jobs, events and range requests.

use std::time::{Duration, Instant};

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::{Preset, Problem, Uncontrolled, estimate};
use fnsf::formats::{CloudFormat, FlowFormat, read_flow};
use futures_util::StreamExt;
use reqwest::StatusCode;
use reqwest::multipart::{Form, Part};
use serde_json::Value;

use crate::clouds::{file, form, medium_pair, small_pair};
use crate::real_data::real_data;
use crate::server::{PATIENCE, Server, ended};

/// Every media type of a flow, and the format of its bytes.
const ANSWERS: [(&str, Option<FlowFormat>); 7] = [
    ("application/x-npz", Some(FlowFormat::Npz)),
    ("application/x-npy", Some(FlowFormat::Npy)),
    (
        "application/vnd.apache.arrow.file",
        Some(FlowFormat::Feather),
    ),
    ("application/x-ply", Some(FlowFormat::Ply)),
    ("application/x-pcd", Some(FlowFormat::Pcd)),
    ("application/json", Some(FlowFormat::Json)),
    ("application/octet-stream", None),
];

fn client() -> reqwest::Client {
    reqwest::Client::new()
}

async fn job_of(response: reqwest::Response) -> String {
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    let location = response.headers()["location"]
        .to_str()
        .expect("text")
        .to_owned();
    let job: Value = response.json().await.expect("a job");
    let id = job["id"].as_str().expect("a name").to_owned();
    assert_eq!(location, format!("/v1/jobs/{id}"));
    id
}

#[tokio::test]
async fn a_pair_comes_back_as_the_librarys_flow_in_every_format() {
    let server = Server::start(&[]);
    let pair = small_pair();
    let problem = Problem::pair(&pair[0], &pair[1]);
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let options = Preset::Default.options(None);
    let expected = estimate(&backend, &problem, &options, &Uncontrolled).expect("a flow");
    for (media, format) in ANSWERS {
        let response = client()
            .post(server.url("/v1/flow"))
            .header("accept", media)
            .multipart(form(pair, "{}"))
            .send()
            .await
            .expect("an answer");
        assert_eq!(response.status(), StatusCode::OK, "{media}");
        let headers = response.headers().clone();
        assert_eq!(headers["content-type"], media);
        assert_eq!(headers["fnsf-stop-reason"], "completed");
        let clusters = expected.objects().expect("objects").clusters.len();
        assert_eq!(headers["fnsf-clusters"], clusters.to_string().as_str());
        assert!(headers.contains_key("fnsf-job-id") && headers.contains_key("fnsf-seconds"));
        let bytes = response.bytes().await.expect("a body");
        let flow = match format {
            Some(_) => read_flow(&bytes, None).expect(media).flow,
            None => fnsf::payload::points_from_le_bytes(&bytes),
        };
        assert_eq!(flow, expected.flow, "{media}");
        if format == Some(FlowFormat::Json) {
            let json: Value = serde_json::from_slice(&bytes).expect("JSON");
            assert_eq!(json["stop_reason"], "completed");
            assert_eq!(
                json["job_id"].as_str(),
                headers["fnsf-job-id"].to_str().ok()
            );
        }
    }
}

#[tokio::test]
async fn the_warnings_of_a_flow_are_in_a_header() {
    let server = Server::start(&[]);
    let [source, _] = small_pair();
    for sweeps in [small_pair().clone(), [source.clone(), source.clone()]] {
        let request = client().post(server.url("/v1/flow"));
        let response = request.multipart(form(&sweeps, "{}")).send().await;
        let headers = response.expect("an answer").headers().clone();
        let warnings = headers
            .get("fnsf-warnings")
            .map(|text| text.to_str().expect("text"));
        let is_warned = warnings.is_some_and(|text| text.contains("both sweeps are the same"));
        assert_eq!(is_warned, sweeps[0] == sweeps[1], "{warnings:?}");
    }
}

#[tokio::test]
async fn every_input_format_gives_the_same_flow() {
    let server = Server::start(&[]);
    let pair = small_pair();
    let mut flows: Vec<Vec<u8>> = Vec::new();
    for (format, name) in [
        (CloudFormat::Npy, "a.npy"),
        (CloudFormat::Ply, "a.ply"),
        (CloudFormat::Pcd, "a.pcd"),
        (CloudFormat::Feather, "a.feather"),
        (CloudFormat::KittiBin, "a.kitti.bin"),
    ] {
        let part = |cloud: usize| Part::bytes(file(format, &pair[cloud])).file_name(name);
        let body = Form::new().part("source", part(0)).part("target", part(1));
        let response = client()
            .post(server.url("/v1/flow"))
            .multipart(body)
            .send()
            .await;
        let response = response.expect("an answer");
        assert_eq!(response.status(), StatusCode::OK, "{name}");
        flows.push(response.bytes().await.expect("a body").to_vec());
    }
    assert!(flows.iter().all(|flow| *flow == flows[0]));
}

#[tokio::test]
async fn real_files_are_taken_as_they_are() {
    let Some(data) = real_data() else { return };
    let server = Server::start(&[]);
    let read = |path: &str| {
        let name = path.rsplit('/').next().unwrap_or_default().to_owned();
        Part::bytes(std::fs::read(data.join(path)).expect("real data")).file_name(name)
    };
    let pairs = [
        vec![
            "av2_7fab/315966265259836000.feather",
            "av2_7fab/315966265360032000.feather",
        ],
        vec!["kitti_0000/0000000005.pcd", "kitti_0000/0000000006.pcd"],
        vec!["small_gicp/source.ply", "small_gicp/target.ply"],
        vec!["av2_7fab/pair.npz"],
    ];
    for files in pairs {
        let mut body = Form::new().text("options", r#"{"max_points": 4096}"#);
        for (file, part) in files.iter().zip(["source", "target"]) {
            body = body.part(part, read(file));
        }
        let response = client()
            .post(server.url("/v1/flow"))
            .multipart(body)
            .send()
            .await;
        let response = response.expect("an answer");
        assert_eq!(response.status(), StatusCode::OK, "{files:?}");
        let bytes = response.bytes().await.expect("a body");
        let flow = read_flow(&bytes, None).expect("a flow");
        let valid = flow.valid.expect("a mask").iter().filter(|&&v| v).count();
        // Returns of the vehicle itself have no flow: a few of the drawn points of a KITTI drive.
        assert!((4064..=4096).contains(&valid), "{files:?}: {valid}");
    }
}

#[tokio::test]
async fn a_job_is_submitted_followed_and_fetched_in_parts() {
    let server = Server::start(&[]);
    let response = client()
        .post(server.url("/v1/jobs"))
        .header("idempotency-key", "once")
        .multipart(form(small_pair(), "{}"))
        .send()
        .await
        .expect("an answer");
    let id = job_of(response).await;
    let again = client()
        .post(server.url("/v1/jobs"))
        .header("idempotency-key", "once")
        .multipart(form(small_pair(), "{}"))
        .send()
        .await
        .expect("an answer");
    assert_eq!(again.status(), StatusCode::OK);
    let known: Value = again.json().await.expect("a job");
    assert_eq!(known["id"], id.as_str());
    let other = client()
        .post(server.url("/v1/jobs"))
        .header("idempotency-key", "once")
        .multipart(form(small_pair(), r#"{"seed": 1}"#))
        .send()
        .await
        .expect("an answer");
    assert_eq!(other.status(), StatusCode::UNPROCESSABLE_ENTITY);
    let problem: Value = other.json().await.expect("a problem");
    assert_eq!(problem["code"], "idempotency_key_reused");

    let job = ended(&server, &id).await;
    assert_eq!(job["state"], "succeeded");
    assert_eq!(job["attempt"], 1);
    let url = server.url(&format!("/v1/jobs/{id}/result"));
    let whole = client().get(&url).send().await.expect("an answer");
    let tag = whole.headers()["etag"].clone();
    let whole = whole.bytes().await.expect("a body");
    let mut parts = Vec::new();
    for range in ["bytes=0-999", "bytes=1000-"] {
        let part = client().get(&url).header("range", range).send().await;
        let part = part.expect("an answer");
        assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
        parts.extend(part.bytes().await.expect("a body"));
    }
    assert_eq!(parts, whole);
    let fresh = client().get(&url).header("if-none-match", tag).send().await;
    assert_eq!(fresh.expect("an answer").status(), StatusCode::NOT_MODIFIED);
    let past = client().get(&url).header("range", "bytes=99999999-");
    let past = past.send().await.expect("an answer");
    assert_eq!(past.status(), StatusCode::RANGE_NOT_SATISFIABLE);
    let html = client().get(&url).header("accept", "text/html");
    let html = html.send().await.expect("an answer");
    assert_eq!(html.status(), StatusCode::NOT_ACCEPTABLE);
}

#[tokio::test]
async fn events_tell_states_and_progress_and_end_with_the_job() {
    let server = Server::start(&[]);
    let options = r#"{"preset": "paper"}"#;
    let response = client()
        .post(server.url("/v1/jobs"))
        .multipart(form(medium_pair(), options))
        .send()
        .await
        .expect("an answer");
    let id = job_of(response).await;
    let events = client()
        .get(server.url(&format!("/v1/jobs/{id}/events")))
        .send()
        .await
        .expect("an answer");
    assert_eq!(events.headers()["content-type"], "text/event-stream");
    let mut stream = events.bytes_stream();
    let mut text = String::new();
    while let Some(piece) = stream.next().await {
        text.push_str(&String::from_utf8_lossy(&piece.expect("a piece")));
    }
    assert!(
        text.contains("event: state") && text.contains("event: progress"),
        "{text}"
    );
    assert!(
        text.contains(r#""done":"#) && text.contains(r#""loss":"#),
        "{text}"
    );
    assert!(text.trim_end().contains(r#""state":"succeeded""#), "{text}");
}

#[tokio::test]
async fn a_preference_to_be_asked_later_gives_a_job_at_once_or_after_the_wait() {
    let server = Server::start(&["--device", "cpu:1"]);
    let post = |prefer: &'static str, options: &'static str| {
        client()
            .post(server.url("/v1/flow"))
            .header("prefer", prefer)
            .multipart(form(small_pair(), options))
            .send()
    };
    let now = post("respond-async", "{}").await.expect("an answer");
    assert_eq!(now.headers()["preference-applied"], "respond-async");
    let first = job_of(now).await;
    let quick = post("respond-async, wait=50", "{}")
        .await
        .expect("an answer");
    assert_eq!(quick.status(), StatusCode::OK);
    let body = form(medium_pair(), r#"{"preset": "paper"}"#);
    let slow = client()
        .post(server.url("/v1/flow"))
        .header("prefer", "respond-async, wait=1")
        .multipart(body)
        .send();
    let second = job_of(slow.await.expect("an answer")).await;
    for id in [first, second] {
        assert_eq!(ended(&server, &id).await["state"], "succeeded");
    }
}

#[tokio::test]
async fn a_cancelled_job_stops_within_an_iteration_and_so_does_one_whose_caller_hangs_up() {
    let server = Server::start(&[]);
    let long = || form(medium_pair(), r#"{"preset": "paper"}"#);
    let response = client()
        .post(server.url("/v1/jobs"))
        .multipart(long())
        .send()
        .await;
    let id = job_of(response.expect("an answer")).await;
    until_running(&server, &id).await;
    let url = server.url(&format!("/v1/jobs/{id}"));
    let asked = Instant::now();
    client().delete(&url).send().await.expect("an answer");
    let job = ended(&server, &id).await;
    assert_eq!(job["state"], "cancelled");
    assert!(
        asked.elapsed() < Duration::from_secs(5),
        "{:?}",
        asked.elapsed()
    );

    let call = client()
        .post(server.url("/v1/flow"))
        .multipart(long())
        .send();
    let hung_up = tokio::time::timeout(Duration::from_secs(2), call).await;
    assert!(hung_up.is_err(), "it was answered too soon");
    let began = Instant::now();
    while server.metric("fnsf_jobs_finished_total{outcome=\"cancelled\"}") < 2.0 {
        assert!(
            began.elapsed() < PATIENCE,
            "it goes on for nobody: {}",
            server.log()
        );
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

async fn until_running(server: &Server, id: &str) {
    let began = Instant::now();
    loop {
        let job = reqwest::get(server.url(&format!("/v1/jobs/{id}"))).await;
        let job: Value = job.expect("an answer").json().await.expect("a job");
        if job["state"] == "running" {
            return;
        }
        assert!(began.elapsed() < PATIENCE, "{job}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

#[tokio::test]
async fn a_sequence_gives_one_archive_and_every_pair_by_itself() {
    let server = Server::start(&[]);
    let [first, second] = small_pair();
    let mut body = Form::new().text("options", r#"{"max_points": 2048}"#);
    for points in [first, second, first] {
        let part = Part::bytes(file(CloudFormat::Npy, points)).file_name("f.npy");
        body = body.part("sweep", part);
    }
    let response = client()
        .post(server.url("/v1/sequences"))
        .multipart(body)
        .send()
        .await;
    let id = job_of(response.expect("an answer")).await;
    let job = ended(&server, &id).await;
    assert_eq!(
        (&job["state"], &job["kind"]),
        (&"succeeded".into(), &"sequence".into())
    );
    assert_eq!(job["pairs"]["total"], 2);
    let archive = client()
        .get(server.url(&format!("/v1/jobs/{id}/result")))
        .header("accept", "application/x-npy")
        .send()
        .await
        .expect("an answer");
    assert_eq!(archive.headers()["content-type"], "application/zip");
    let bytes = archive.bytes().await.expect("a body").to_vec();
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(bytes)).expect("an archive");
    assert_eq!(zip.len(), 2);
    for (index, pair) in job["pairs"]["jobs"]
        .as_array()
        .expect("pairs")
        .iter()
        .enumerate()
    {
        let own = client()
            .get(server.url(pair["result"].as_str().expect("a link")))
            .header("accept", "application/x-npy")
            .send()
            .await
            .expect("an answer");
        let own = own.bytes().await.expect("a body").to_vec();
        let mut entry = zip.by_name(&format!("{index:06}.npy")).expect("an entry");
        let mut packed = Vec::new();
        std::io::Read::read_to_end(&mut entry, &mut packed).expect("bytes");
        assert_eq!(own, packed);
    }
}

#[tokio::test]
async fn refusals_say_what_is_wrong_as_problems() {
    let server = Server::with_config("[limits]\nmax_points = 20000\nmax_upload_mib = 4\n");
    let cloud = || Part::bytes(file(CloudFormat::Npy, &small_pair()[0])).file_name("a.npy");
    let noise = || Part::bytes(vec![7; 100]).file_name("a.xyz");
    let big = Part::bytes(vec![0; 6 << 20]).file_name("a.npy");
    let few = Part::bytes(file(CloudFormat::Npy, &[[0.0; 3]])).file_name("a.npy");
    let many = vec![[1.0; 3]; 30_000];
    let many = Part::bytes(file(CloudFormat::Npy, &many)).file_name("a.npy");
    let both =
        |source: Part, target: Part| Form::new().part("source", source).part("target", target);
    let cases = [
        (
            Form::new().part("source", cloud()),
            400,
            "target is missing",
        ),
        (both(cloud(), noise()), 422, "target: unrecognized file"),
        (both(cloud(), few), 422, "at least 3 are needed"),
        (both(cloud(), many), 413, "20000 are taken"),
        (both(big, cloud()), 413, "4 MiB"),
        (
            both(cloud(), cloud()).text("options", "{\"sead\":1}"),
            400,
            "unknown field `sead`",
        ),
        (
            both(cloud(), cloud()).text("colour", "red"),
            400,
            "no part named \"colour\"",
        ),
        (
            both(cloud(), cloud()).part("source", cloud()),
            400,
            "source is there twice",
        ),
        (Form::new().part("sweep", cloud()), 400, "/v1/sequences"),
    ];
    for (body, status, said) in cases {
        let response = client()
            .post(server.url("/v1/flow"))
            .multipart(body)
            .send()
            .await;
        let response = response.expect("an answer");
        assert_eq!(
            response.headers()["content-type"],
            "application/problem+json"
        );
        let problem: Value = response.json().await.expect("a problem");
        assert_eq!(problem["status"], status, "{problem}");
        let detail = problem["detail"].as_str().unwrap_or_default();
        assert!(detail.contains(said), "{said}: {problem}");
    }
    let json = client()
        .post(server.url("/v1/flow"))
        .body("{}")
        .send()
        .await;
    assert_eq!(
        json.expect("an answer").status(),
        StatusCode::UNSUPPORTED_MEDIA_TYPE
    );
    let put = client().put(server.url("/v1/flow")).send().await;
    assert_eq!(
        put.expect("an answer").status(),
        StatusCode::METHOD_NOT_ALLOWED
    );
    let gone = reqwest::get(server.url("/v1/jobs/0192f0c1-7b7a-7000-8000-000000000000")).await;
    assert_eq!(gone.expect("an answer").status(), StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn a_disk_that_is_nearly_full_takes_no_more_work() {
    let server = Server::with_config("[limits]\nmin_free_disk_mib = 1000000000000\n");
    let answer = client()
        .post(server.url("/v1/jobs"))
        .multipart(form(small_pair(), "{}"));
    let answer = answer.send().await.expect("an answer");
    assert_eq!(answer.status(), StatusCode::INSUFFICIENT_STORAGE);
    assert_eq!(answer.headers()["retry-after"], "60");
    let listed = reqwest::get(server.url("/v1/jobs"))
        .await
        .expect("an answer");
    assert_eq!(listed.status(), StatusCode::OK);
}
