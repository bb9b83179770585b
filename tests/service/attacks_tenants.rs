//! Attacks of one tenant on the others: requests that hang up, large lists, receivers that do not
//! answer, and what readers and links may see.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use reqwest::Client;
use serde_json::{Value, json};

use crate::clouds::{file, form, small_pair};
use crate::grpc::{client, proto};
use crate::server::{Folder, PATIENCE, Server, ended};

const WRITER: &str = "key-of-the-writer-of-a";
const READER: &str = "key-of-the-reader-of-a";
const OTHER: &str = "key-of-the-writer-of-b";

fn config(more: &str) -> String {
    let mut config = format!("{more}\n");
    for (tenant, role, key) in [
        ("a", "write", WRITER),
        ("a", "read", READER),
        ("b", "write", OTHER),
    ] {
        config += &format!("[[keys]]\ntenant = \"{tenant}\"\nrole = \"{role}\"\nkey = \"{key}\"\n");
    }
    config
}

const HOOKS: &str = "whsec_MDEyMzQ1Njc4OWFiY2RlZjAxMjM0NTY3ODlhYmNkZWY=";

/// A configuration that allows webhooks below these URLs.
fn with_hooks(prefixes: &[&str]) -> String {
    config(&format!(
        "[remote]\nwebhooks = {prefixes:?}\nwebhook_secret = \"{HOOKS}\"\n\
         allow_private_addresses = true\n"
    ))
}

async fn submit(server: &Server, key: &str, options: &Value) -> String {
    // A few points: what is attacked is not the solver.
    let few = small_pair().each_ref().map(|points| points[..300].to_vec());
    let sent = Client::new()
        .post(server.url("/v1/jobs"))
        .bearer_auth(key)
        .multipart(form(&few, &options.to_string()))
        .send();
    let job: Value = sent.await.expect("an answer").json().await.expect("JSON");
    job["id"].as_str().expect("an id").to_owned()
}

async fn get(server: &Server, key: &str, path: &str) -> Value {
    let sent = Client::new().get(server.url(path)).bearer_auth(key).send();
    sent.await.expect("an answer").json().await.expect("JSON")
}

fn threads(server: &Server) -> usize {
    let tasks = std::fs::read_dir(format!("/proc/{}/task", server.id()));
    tasks.map_or(0, Iterator::count)
}

#[tokio::test]
async fn callers_that_hang_up_leave_no_work_beside_their_turn() {
    let server = Server::with_config(&config(""));
    let address = server.url("");
    let address = address.trim_start_matches("http://").trim_end_matches('/');
    let mut most = 0;
    for seed in 0..150 {
        let mut connection = TcpStream::connect(address).expect("a connection");
        let request = format!(
            "GET /v1/street/{}?seed={seed} HTTP/1.1\r\nhost: a\r\nauthorization: Bearer {READER}\r\n\r\n",
            seed % 5
        );
        connection.write_all(request.as_bytes()).expect("sent");
        std::thread::sleep(Duration::from_millis(12));
        drop(connection);
        most = most.max(threads(&server));
    }
    assert!(most < 80, "{most} threads");
    let began = Instant::now();
    let listed = get(&server, OTHER, "/v1/jobs").await;
    assert!(listed["jobs"].is_array());
    assert!(began.elapsed() < PATIENCE / 4, "{:?}", began.elapsed());
    assert!(server.is_ready(), "{}", server.log());
}

#[tokio::test]
async fn a_page_of_large_jobs_ends_early_and_the_next_one_goes_on() {
    let server = Server::with_config(&config(""));
    let long = "x".repeat(255);
    let labels: serde_json::Map<String, Value> = (0..16)
        .map(|index| (format!("{index:x>63}"), json!(long)))
        .collect();
    const JOBS: usize = 230;
    for _ in 0..JOBS {
        submit(&server, WRITER, &json!({ "labels": labels })).await;
    }
    let mut path = "/v1/jobs?limit=1000".to_owned();
    let mut counts = Vec::new();
    loop {
        let page = get(&server, WRITER, &path).await;
        counts.push(page["jobs"].as_array().expect("jobs").len());
        assert!(page.to_string().len() < 3 << 20);
        match page["next"].as_str() {
            None => break,
            Some(next) => path = format!("/v1/jobs?limit=1000&before={next}"),
        }
    }
    assert_eq!(counts.iter().sum::<usize>(), JOBS);
    assert!(counts.len() >= 2, "{counts:?}");
    let long = format!("https://hooks.example/{}", "x".repeat(4000));
    let hooked = Server::with_config(&with_hooks(&["https://hooks.example/"]));
    let sent = Client::new()
        .post(hooked.url("/v1/jobs"))
        .bearer_auth(WRITER)
        .multipart(form(small_pair(), &json!({ "webhook": long }).to_string()))
        .send();
    assert_eq!(sent.await.expect("an answer").status(), 400);
}

/// A receiver that accepts connections and answers nothing, or answers at once. Counts the notices.
fn receiver(answers: bool) -> (String, std::sync::Arc<std::sync::atomic::AtomicUsize>) {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let url = format!("http://{}/", listener.local_addr().expect("an address"));
    let count = std::sync::Arc::<std::sync::atomic::AtomicUsize>::default();
    let counted = std::sync::Arc::clone(&count);
    std::thread::spawn(move || {
        let mut silent = Vec::new();
        for connection in listener.incoming() {
            let Ok(mut connection) = connection else {
                return;
            };
            counted.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            if answers {
                let mut head = [0; 4096];
                let _read = connection.read(&mut head);
                let _sent =
                    connection.write_all(b"HTTP/1.1 204 No Content\r\nconnection: close\r\n\r\n");
            } else {
                silent.push(connection);
            }
        }
    });
    (url, count)
}

#[tokio::test]
async fn a_receiver_that_does_not_answer_holds_up_no_notice_and_no_removal_of_others() {
    let (silent, silent_count) = receiver(false);
    let (good, good_count) = receiver(true);
    let server = Server::with_config(&with_hooks(&[&silent, &good]));
    let removed = submit(&server, OTHER, &json!({})).await;
    let mut last = String::new();
    for _ in 0..90 {
        last = submit(&server, WRITER, &json!({ "webhook": silent })).await;
    }
    let url = format!("/v1/jobs/{last}?wait=60");
    assert!(get(&server, WRITER, &url).await["finished_at"].is_string());
    server.until("the silent receiver is told", || {
        silent_count.load(std::sync::atomic::Ordering::Relaxed) > 0
    });
    let began = Instant::now();
    let deleted = Client::new()
        .delete(server.url(&format!("/v1/jobs/{removed}?remove=true")))
        .bearer_auth(OTHER)
        .send();
    assert!(deleted.await.expect("an answer").status().is_success());
    submit(&server, OTHER, &json!({ "webhook": good })).await;
    let files = server
        .data()
        .join("blobs/jobs")
        .join(&removed[..8])
        .join(&removed);
    server.until("the other tenant's notice and removal", || {
        good_count.load(std::sync::atomic::Ordering::Relaxed) > 0 && !files.exists()
    });
    // A round of a silent receiver takes 15 s.
    assert!(
        began.elapsed() < Duration::from_secs(12),
        "{:?}",
        began.elapsed()
    );
}

#[tokio::test]
async fn readers_and_links_see_no_webhook_and_a_link_dies_with_the_key_that_made_it() {
    let folder = Folder::new();
    let config = with_hooks(&["https://hooks.example/"]);
    let server = Server::start_in(&folder, &config, &[]);
    let options =
        json!({ "webhook": "https://hooks.example/?token=secret", "labels": { "of": "a" } });
    let id = submit(&server, WRITER, &options).await;
    let path = format!("/v1/jobs/{id}");
    let shared = Client::new()
        .post(server.url(&format!("{path}/share")))
        .bearer_auth(READER)
        .send();
    let shared: Value = shared.await.expect("an answer").json().await.expect("JSON");
    let token = shared["token"].as_str().expect("a token");
    let own = get(&server, WRITER, &path).await;
    assert_eq!(own["options"]["webhook"], options["webhook"]);
    for (key, labels) in [(READER, json!({ "of": "a" })), (token, Value::Null)] {
        let seen = get(&server, key, &path).await;
        assert_eq!(seen["options"]["webhook"], Value::Null, "{seen}");
        assert_eq!(seen["options"]["labels"], labels);
        let mut asked = tonic::Request::new(proto::GetJobRequest { id: id.clone() });
        let shown = format!("Bearer {key}").parse().expect("plain text");
        asked.metadata_mut().insert("authorization", shown);
        let seen = client(&server).await.get_job(asked).await.expect("a job");
        assert_eq!(seen.get_ref().labels.is_empty(), labels.is_null());
    }
    ended_for(&server, &path).await;
    let folder = server.kill();
    let without = config.replace(READER, "key-of-another-reader-of-a");
    let server = Server::start_in(&folder, &without, &[]);
    let answer = Client::new()
        .get(server.url(&path))
        .bearer_auth(token)
        .send();
    assert_eq!(answer.await.expect("an answer").status(), 401);
}

#[tokio::test]
async fn a_key_that_may_not_ask_for_a_priority_may_not_queue_a_job_of_it_again() {
    const LOW: &str = "key-of-the-low-writer-of-a";
    let low = format!(
        "[[keys]]\ntenant = \"a\"\nrole = \"write\"\nmax_priority = \"low\"\nkey = \"{LOW}\"\n"
    );
    let server = Server::with_config(&(config("") + &low));
    let options = json!({
        "priority": "high", "preset": "paper",
        "field": { "max_iterations": 1_000_000, "patience": 1_000_000 },
    });
    let id = submit(&server, WRITER, &options).await;
    let path = format!("/v1/jobs/{id}");
    let cancelled = Client::new().delete(server.url(&path)).bearer_auth(LOW);
    assert_eq!(cancelled.send().await.expect("an answer").status(), 200);
    ended_for(&server, &path).await;
    for (key, status) in [(LOW, 403), (WRITER, 200)] {
        let again = Client::new().post(server.url(&format!("{path}/requeue")));
        let answer = again.bearer_auth(key).send().await.expect("an answer");
        assert_eq!(answer.status(), status, "{key}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn reading_long_sequences_holds_up_no_other_tenant() {
    const SWEEPS: usize = 400;
    const READS: usize = 200;
    let server = Server::with_config(&config(""));
    let sweep = file(fnsf::formats::CloudFormat::Pcd, &small_pair()[0][..300]);
    let options =
        r#"{"preset": "paper", "field": {"max_iterations": 1000000, "patience": 1000000}}"#;
    let mut form = reqwest::multipart::Form::new().text("options", options);
    for index in 0..SWEEPS {
        let part = reqwest::multipart::Part::bytes(sweep.clone()).file_name(format!("{index}.pcd"));
        form = form.part("sweep", part);
    }
    let sent = Client::new().post(server.url("/v1/sequences"));
    let sent = sent.bearer_auth(WRITER).multipart(form).send();
    let sequence: Value = sent.await.expect("an answer").json().await.expect("JSON");
    let path = format!("/v1/jobs/{}", sequence["id"].as_str().expect("an id"));
    let reads: Vec<_> = (0..READS)
        .map(|_| {
            Client::new()
                .get(server.url(&path))
                .bearer_auth(READER)
                .send()
        })
        .map(tokio::spawn)
        .collect();
    let began = Instant::now();
    get(&server, OTHER, "/v1/jobs").await;
    let took = began.elapsed();
    assert!(server.is_ready());
    for read in reads {
        let answer = read.await.expect("no panic").expect("an answer");
        assert_eq!(answer.status(), 200);
    }
    assert!(took < Duration::from_secs(5), "{took:?}");
}

async fn ended_for(server: &Server, path: &str) {
    let seen = get(server, WRITER, &format!("{path}?wait=60")).await;
    assert!(seen["finished_at"].is_string());
}

#[tokio::test]
async fn a_damaged_result_is_lost_and_found_again_when_it_is_asked_for() {
    let server = Server::start(&[]);
    let sent = Client::new()
        .post(server.url("/v1/jobs"))
        .multipart(form(small_pair(), "{}"))
        .send();
    let job: Value = sent.await.expect("an answer").json().await.expect("JSON");
    let id = job["id"].as_str().expect("an id").to_owned();
    assert_eq!(ended(&server, &id).await["state"], "succeeded");
    let stored = server.data().join("blobs/jobs").join(&id[..8]).join(&id);
    std::fs::write(stored.join("result-1"), b"fnsfflw4 damaged").expect("it was there");
    let client = Client::new();
    let url = server.url(&format!("/v1/jobs/{id}"));
    let result = || client.get(format!("{url}/result")).send();
    assert_eq!(result().await.expect("an answer").status(), 410);
    let again = client.post(format!("{url}/requeue")).send();
    assert!(again.await.expect("an answer").status().is_success());
    assert_eq!(ended(&server, &id).await["state"], "succeeded");
    assert_eq!(result().await.expect("an answer").status(), 200);
}

#[tokio::test]
async fn a_configuration_is_read_from_a_pipe_as_from_a_file() {
    // `serve --config <(decrypt keys.toml)`: a pipe is read once.
    let folder = Folder::new();
    let pipe = folder.path().join("pipe");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.expect("mkfifo").success());
    let writer = std::thread::spawn({
        let pipe = pipe.clone();
        move || std::fs::write(pipe, "listen = \"127.0.0.1:7\"\nlabel_of_no_use = 1\n")
    });
    let run = std::process::Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(["serve", "--check-config", "--config"])
        .arg(&pipe)
        .output()
        .expect("it runs");
    writer.join().expect("no panic").expect("written");
    let said = String::from_utf8_lossy(&run.stderr);
    assert!(said.contains("label_of_no_use"), "{said}");
    let secret = std::process::Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(["serve", "--check-config"])
        .env("FNSF_SERVE_QUEUE", "postgres://fnsf:hunter2@db/fnsf")
        .output()
        .expect("it runs");
    let said = String::from_utf8_lossy(&secret.stderr);
    assert!(
        said.contains("queue") && !said.contains("hunter2"),
        "{said}"
    );
}

#[test]
fn a_file_that_says_far_more_than_it_holds_takes_no_memory_of_the_server() {
    let server = Server::start(&[]);
    let before = server.resident_bytes();
    let mut header = b"ply\ncomment ".to_vec();
    header.resize(60 << 20, b' ');
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let status = runtime.block_on(async {
        let part = |bytes| reqwest::multipart::Part::bytes(bytes).file_name("a.ply");
        let target = file(fnsf::formats::CloudFormat::Ply, &small_pair()[1]);
        let form = reqwest::multipart::Form::new()
            .part("source", part(header))
            .part("target", part(target));
        let sent = Client::new()
            .post(server.url("/v1/jobs"))
            .multipart(form)
            .send();
        sent.await.expect("an answer").status()
    });
    assert_eq!(status, 422);
    let grown = server.resident_bytes().saturating_sub(before);
    assert!(grown < 200 << 20, "{} MiB", grown >> 20);
}
