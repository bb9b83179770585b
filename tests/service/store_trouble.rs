//! Tests of failures of the machine: they cost no job an attempt, and jobs wait until it works
//! again.

use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

use fnsf::flow::Point;
use reqwest::StatusCode;
use serde_json::Value;
use tonic::transport::Endpoint;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::clouds::{form, medium_pair, small_pair};
use crate::raw_http::SMALL;
use crate::server::{Folder, PATIENCE, Server, ended, plain_get};

/// Immediate retries: with counted failures, a job would fail after three of them, within seconds.
const CONFIG: &str = "[queue]\nretry_delay_seconds = 0\n";

async fn submit(server: &Server) -> Result<String, (StatusCode, Value)> {
    let sent = reqwest::Client::new()
        .post(server.url("/v1/jobs"))
        .multipart(form(small_pair(), SMALL))
        .send()
        .await
        .expect("an answer");
    let status = sent.status();
    let said: Value = sent.json().await.expect("JSON");
    match said["id"].as_str() {
        Some(id) if status.is_success() => Ok(id.to_owned()),
        _ => Err((status, said)),
    }
}

async fn submit_some(server: &Server) -> Vec<String> {
    let mut ids = Vec::new();
    for _ in 0..12 {
        ids.push(submit(server).await.expect("accepted"));
    }
    ids
}

async fn all_succeed(server: &Server, ids: Vec<String>) {
    for id in ids {
        assert_eq!(ended(server, &id).await["state"], "succeeded");
    }
    assert_eq!(server.metric("fnsf_dead_letters_total"), 0.0);
}

/// Replaces a folder by a file, so that writes below it fail for every user, root included. Returns
/// a function that restores the folder.
fn break_folder(folder: &Path) -> impl Fn() + use<> {
    let (folder, aside) = (folder.to_owned(), folder.with_extension("aside"));
    std::fs::rename(&folder, &aside).expect("renamed");
    std::fs::write(&folder, "no folder").expect("written");
    move || {
        std::fs::remove_file(&folder).expect("removed");
        std::fs::rename(&aside, &folder).expect("renamed");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_store_that_fails_costs_no_job_an_attempt_and_readiness_says_so() {
    let server = Server::with_config(CONFIG);
    let ids = submit_some(&server).await;
    let mend = break_folder(&server.data().join("blobs/jobs"));
    server.until("it is not ready", || !server.is_ready());
    let said = plain_get(&server.admin, "/readyz").expect("an answer");
    assert!(said.contains("the store does not work"), "{said}");
    let alive = plain_get(&server.admin, "/livez").expect("an answer");
    assert!(alive.starts_with("HTTP/1.1 200"), "{alive}");
    let (status, said) = submit(&server).await.expect_err("refused");
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{said}");
    assert_eq!(said["code"], "store_unavailable");
    assert_eq!(said["retryable"], true);
    // Long enough for three attempts of each job.
    tokio::time::sleep(Duration::from_secs(4)).await;
    mend();
    server.until_ready();
    all_succeed(&server, ids).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn descriptors_that_connections_take_are_none_that_jobs_need() {
    // More connections than the process may open files, as the configuration allows.
    let config = format!("{CONFIG}[limits]\nmax_connections = 1024\n");
    let server = Server::start_after("ulimit -n 300", &config);
    assert!(
        server.log().contains("fewer connections"),
        "{}",
        server.log()
    );
    let ids = submit_some(&server).await;
    let held: Vec<TcpStream> = (0..600)
        .filter_map(|_| TcpStream::connect(&server.public).ok())
        .collect();
    assert!(held.len() > 300);
    all_succeed(&server, ids).await;
}

#[tokio::test]
async fn grpc_health_follows_the_readiness() {
    let server = Server::with_config(CONFIG);
    let endpoint = Endpoint::from_shared(server.url("")).expect("a good address");
    let channel = endpoint.connect().await.expect("a connection");
    let until = async |expected: ServingStatus| {
        for service in ["", "fnsf.v1.SceneFlow"] {
            let asked = HealthCheckRequest {
                service: service.to_owned(),
            };
            let began = Instant::now();
            loop {
                let mut health = HealthClient::new(channel.clone());
                let answer = health.check(asked.clone()).await.expect("an answer");
                if answer.into_inner().status() == expected {
                    break;
                }
                assert!(began.elapsed() < PATIENCE, "{service} is not {expected:?}");
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        }
    };
    until(ServingStatus::Serving).await;
    let restore = break_folder(&server.data().join("blobs/jobs"));
    // A refused upload reports the failure at once.
    submit(&server).await.expect_err("refused");
    until(ServingStatus::NotServing).await;
    restore();
    until(ServingStatus::Serving).await;
}

#[tokio::test]
async fn a_server_raises_the_number_of_files_that_it_may_open() {
    let server = Server::start_after("ulimit -Sn 200", "");
    let limits = std::fs::read_to_string(format!("/proc/{}/limits", server.id()));
    let limits = limits.expect("it runs on Linux");
    let files = limits
        .lines()
        .find(|line| line.starts_with("Max open files"));
    let words: Vec<&str> = files.expect("a line").split_whitespace().collect();
    assert_eq!(words[3], words[4], "{words:?}");
}

#[tokio::test]
async fn files_that_can_still_be_made_are_watched_as_bytes_are() {
    let server = Server::with_config("[limits]\nmin_free_inodes = 1099511627776\n");
    let (status, said) = submit(&server).await.expect_err("refused");
    assert_eq!(status, StatusCode::INSUFFICIENT_STORAGE, "{said}");
    assert_eq!(said["code"], "disk_full");
}

#[tokio::test]
async fn a_file_that_may_not_grow_is_an_error_and_not_the_end() {
    // In blocks of 512 bytes or 1 KiB, depending on the shell: less than this cloud needs.
    let server = Server::start_after("ulimit -f 3000", "");
    let cloud: Vec<Point> = (0..400_000_u32)
        .map(|at| [(at % 1000) as f32 * 0.1, (at / 1000) as f32 * 0.1, 0.0])
        .collect();
    let sent = reqwest::Client::new()
        .post(server.url("/v1/jobs"))
        .multipart(form(&[cloud.clone(), cloud], SMALL))
        .send();
    let answer = sent.await.expect("an answer");
    assert_eq!(answer.status(), StatusCode::INSUFFICIENT_STORAGE);
    let alive = plain_get(&server.admin, "/livez").expect("an answer");
    assert!(alive.starts_with("HTTP/1.1 200"), "{alive}");
}

#[tokio::test]
async fn payloads_whose_queue_is_missing_are_kept_and_the_server_says_so() {
    let folder = Folder::new();
    let server = Server::start_in(&folder, "", &[]);
    let id = submit(&server).await.expect("accepted");
    assert_eq!(ended(&server, &id).await["state"], "succeeded");
    drop(server);
    let data = folder.path().join("data");
    let moved: Vec<_> = ["queue.sqlite3", "queue.sqlite3-wal", "queue.sqlite3-shm"]
        .into_iter()
        .map(|name| (data.join(name), folder.path().join(name)))
        .filter(|(from, _)| from.exists())
        .collect();
    for (from, to) in &moved {
        std::fs::rename(from, to).expect("moved");
    }
    let started = std::process::Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(["serve", "--device", "cpu", "--data-dir"])
        .arg(&data)
        .args(["--listen", "127.0.0.1:0", "--admin-listen", "127.0.0.1:0"])
        .output()
        .expect("it runs");
    assert_eq!(started.status.code(), Some(70));
    let said = String::from_utf8_lossy(&started.stderr);
    assert!(said.contains("put it back"), "{said}");
    for (from, to) in &moved {
        std::fs::rename(to, from).expect("moved");
    }
    let server = Server::start_in(&folder, "", &[]);
    let url = server.url(&format!("/v1/jobs/{id}/result"));
    let answer = reqwest::get(url).await.expect("an answer");
    assert_eq!(answer.status(), StatusCode::OK);
}

#[tokio::test]
async fn a_result_that_is_lost_is_found_again_when_it_is_asked_for() {
    let server = Server::start(&[]);
    let id = submit(&server).await.expect("accepted");
    assert_eq!(ended(&server, &id).await["state"], "succeeded");
    let client = reqwest::Client::new();
    let fetch = || {
        client
            .get(server.url(&format!("/v1/jobs/{id}/result")))
            .send()
    };
    let requeue = || {
        client
            .post(server.url(&format!("/v1/jobs/{id}/requeue")))
            .send()
    };
    let whole = fetch().await.expect("an answer").bytes().await;
    let whole = whole.expect("a body");
    let refused = requeue().await.expect("an answer");
    assert_eq!(refused.status(), StatusCode::BAD_REQUEST);
    let folder = server.data().join("blobs/jobs").join(&id[..8]).join(&id);
    std::fs::remove_file(folder.join("result-1")).expect("it was there");
    // Requested in another format, because the previous response may be cached.
    let url = server.url(&format!("/v1/jobs/{id}/result"));
    let lost = client.get(url).header("accept", "application/x-ply").send();
    let lost = lost.await.expect("an answer");
    assert_eq!(lost.status(), StatusCode::GONE);
    assert!(requeue().await.expect("an answer").status().is_success());
    assert_eq!(ended(&server, &id).await["state"], "succeeded");
    let again = fetch().await.expect("an answer").bytes().await;
    assert_eq!(again.expect("a body"), whole);
}

#[tokio::test]
async fn what_a_server_keeps_is_for_its_user_alone() {
    use std::os::unix::fs::PermissionsExt;
    let server = Server::start(&[]);
    let id = submit(&server).await.expect("accepted");
    ended(&server, &id).await;
    for name in ["", "queue.sqlite3", "blobs", "blobs/jobs"] {
        let about = std::fs::metadata(server.data().join(name)).expect("it is there");
        assert_eq!(about.permissions().mode() & 0o077, 0, "{name}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_payload_that_cannot_be_read_keeps_nobody_else_waiting() {
    let server = Server::start(&[]);
    // A long job first, so that the next ones are still queued.
    let sent = reqwest::Client::new()
        .post(server.url("/v1/jobs"))
        .multipart(form(medium_pair(), r#"{"preset": "paper"}"#))
        .send();
    assert!(sent.await.expect("an answer").status().is_success());
    let broken = submit(&server).await.expect("accepted");
    let others = submit_some(&server).await;
    // Replaces a file by a symbolic link to itself: reading it fails for every user, root included.
    let folder = server
        .data()
        .join("blobs/jobs")
        .join(&broken[..8])
        .join(&broken);
    let (file, aside) = (folder.join("sweep-0"), folder.join("aside"));
    std::fs::rename(&file, &aside).expect("renamed");
    std::os::unix::fs::symlink(&file, &file).expect("linked");
    all_succeed(&server, others).await;
    let url = server.url(&format!("/v1/jobs/{broken}"));
    let job: Value = reqwest::get(url)
        .await
        .expect("an answer")
        .json()
        .await
        .expect("a job");
    assert!(
        matches!(job["state"].as_str(), Some("queued" | "running")),
        "{job}"
    );
    assert!(server.is_ready(), "one file is not the store");
    std::fs::remove_file(&file).expect("removed");
    std::fs::rename(&aside, &file).expect("renamed");
    all_succeed(&server, vec![broken]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn payloads_whose_volume_is_not_there_are_waited_for() {
    let folder = Folder::new();
    let server = Server::start_in(&folder, CONFIG, &[]);
    let ids = submit_some(&server).await;
    let blobs = server.data().join("blobs");
    let aside = server.data().join("aside");
    std::fs::rename(&blobs, &aside).expect("renamed");
    std::fs::create_dir(&blobs).expect("made");
    server.until("it is not ready", || !server.is_ready());
    tokio::time::sleep(Duration::from_secs(3)).await;
    // A restart does not accept an empty folder as the payloads of these jobs either.
    let folder = server.kill();
    let started = std::process::Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(["serve", "--device", "cpu", "--data-dir"])
        .arg(folder.path().join("data"))
        .args(["--listen", "127.0.0.1:0", "--admin-listen", "127.0.0.1:0"])
        .output()
        .expect("it runs");
    assert_eq!(started.status.code(), Some(70));
    let said = String::from_utf8_lossy(&started.stderr);
    assert!(said.contains("is their volume mounted?"), "{said}");
    std::fs::remove_dir_all(&blobs).expect("removed");
    std::fs::rename(&aside, &blobs).expect("renamed");
    let server = Server::start_in(&folder, CONFIG, &[]);
    all_succeed(&server, ids).await;
}

#[tokio::test]
async fn a_queue_whose_file_is_removed_is_not_ready() {
    let server = Server::start(&[]);
    std::fs::remove_file(server.data().join("queue.lock")).expect("removed");
    server.until("it is not ready", || !server.is_ready());
    let said = plain_get(&server.admin, "/readyz").expect("an answer");
    assert!(said.contains("removed or replaced"), "{said}");
}
