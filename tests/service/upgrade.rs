//! Tests of the upgrade of stored data: a data directory of an older schema version, with jobs in
//! every state, lies in `frozen/`.

use std::path::Path;

use reqwest::Client;
use reqwest::multipart::{Form, Part};
use serde_json::Value;

use crate::clouds::accepted;
use crate::server::{FREE_PORTS, Folder, Server, ended};

/// The options of the frozen job with an idempotency key.
const OPTIONS: &str = r#"{"ground": "keep", "labels": {"state": "succeeded"}}"#;

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a folder");
    for entry in std::fs::read_dir(from).expect("a folder") {
        let path = entry.expect("an entry").path();
        let goal = to.join(path.file_name().expect("a name"));
        match path.is_dir() {
            true => copy(&path, &goal),
            false => drop(std::fs::copy(&path, &goal).expect("a copy")),
        }
    }
}

/// The data of a process that was killed, as it lay on disk, with schema version 8.
fn thaw() -> Folder {
    let frozen = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/service/frozen/version_8");
    let folder = Folder::new();
    let data = folder.path().join("data");
    copy(&frozen.join("blobs"), &data.join("blobs"));
    let queue = rusqlite::Connection::open(data.join("queue.sqlite3")).expect("a database");
    let rows = std::fs::read_to_string(frozen.join("queue.sql")).expect("its rows");
    queue.execute_batch(&rows).expect("a queue");
    std::fs::write(data.join("queue.running"), "").expect("a file");
    folder
}

async fn json(url: String) -> Value {
    let answer = reqwest::get(url).await.expect("an answer");
    answer.json().await.expect("JSON")
}

async fn labelled(server: &Server, state: &str) -> Value {
    let url = server.url(&format!("/v1/jobs?label=state={state}"));
    let found = json(url).await["jobs"][0].take();
    assert!(found["id"].is_string(), "no job is labelled {state}");
    found
}

#[tokio::test]
async fn data_of_an_older_version_keeps_every_job_in_its_state_and_unfinished_ones_are_done() {
    let server = Server::start_in(&thaw(), "", &[]);
    for state in ["succeeded", "failed", "expired", "cancelled"] {
        assert_eq!(labelled(&server, state).await["state"], state);
    }
    let failed = labelled(&server, "failed").await;
    assert_eq!(failed["error"]["code"], "no_overlap");
    let sequence = labelled(&server, "sequence").await;
    assert_eq!(sequence["pairs"]["ended"], 2);
    for job in [labelled(&server, "succeeded").await, sequence] {
        let id = job["id"].as_str().expect("an id");
        let url = server.url(&format!("/v1/jobs/{id}/result"));
        let flow = reqwest::get(url).await.expect("an answer");
        assert_eq!(flow.status(), 200, "{id}");
        assert!(flow.bytes().await.expect("a flow").len() > 240 * 12);
    }
    for state in ["running", "queued"] {
        let id = labelled(&server, state).await["id"].clone();
        let ended = ended(&server, id.as_str().expect("an id")).await;
        assert_eq!(ended["state"], "succeeded", "{state}: {ended}");
    }
}

#[tokio::test]
async fn an_idempotency_key_of_an_older_version_finds_its_job() {
    let server = Server::start_in(&thaw(), "", &[]);
    let known = labelled(&server, "succeeded").await;
    let frozen = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/service/frozen/version_8");
    let part = |name: &str| {
        let bytes = std::fs::read(frozen.join(name)).expect("a cloud");
        Part::bytes(bytes).file_name("cloud.npy")
    };
    let form = Form::new()
        .part("source", part("source.npy"))
        .part("target", part("target.npy"))
        .text("options", OPTIONS);
    let sent = Client::new()
        .post(server.url("/v1/jobs"))
        .header("idempotency-key", "frozen-key")
        .multipart(form);
    let job = accepted(sent).await;
    assert_eq!(job["id"], known["id"], "{job}");
}

#[tokio::test]
async fn data_of_a_newer_version_is_refused_by_name() {
    let folder = thaw();
    let path = folder.path().join("data/queue.sqlite3");
    let queue = rusqlite::Connection::open(&path).expect("a database");
    queue
        .pragma_update(None, "user_version", 1000)
        .expect("set");
    drop(queue);
    let refused = std::process::Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(FREE_PORTS)
        .args(["--device", "cpu:1", "--data-dir"])
        .arg(folder.path().join("data"))
        .output()
        .expect("it runs");
    assert_eq!(refused.status.code(), Some(70));
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.contains("version 1000"), "{said}");
}

#[test]
fn a_queue_is_upgraded_without_a_server_unless_one_runs() {
    let migrate = |data: &Path| {
        let run = std::process::Command::new(env!("CARGO_BIN_EXE_fnsf"))
            .args(["migrate", "--data-dir"])
            .arg(data)
            .output()
            .expect("it runs");
        let said = String::from_utf8_lossy(&[run.stdout, run.stderr].concat()).into_owned();
        (run.status.code(), said)
    };
    let folder = thaw();
    let data = folder.path().join("data");
    let (code, said) = migrate(&data);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("upgraded from schema version 8"), "{said}");
    let (code, said) = migrate(&data);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("already"), "{said}");
    let _server = Server::start_in(&folder, "", &[]);
    let (code, said) = migrate(&data);
    assert_eq!(code, Some(70), "{said}");
    assert!(said.contains("another process"), "{said}");
    let (code, said) = migrate(&folder.path().join("other"));
    assert_eq!(code, Some(70), "{said}");
    assert!(said.contains("has no queue"), "{said}");
}
