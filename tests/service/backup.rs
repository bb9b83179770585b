//! Tests of `fnsf backup` beside a busy server, and of `fnsf restore`.

use std::path::Path;
use std::process::{Command, Output};

use reqwest::Client;

use crate::clouds::{accepted, form, small_pair};
use crate::server::{Folder, Server, ended};

/// Number of jobs; `FNSF_BACKUP_JOBS` overrides it.
fn jobs() -> usize {
    let asked = std::env::var("FNSF_BACKUP_JOBS").ok();
    asked.and_then(|jobs| jobs.parse().ok()).unwrap_or(60)
}

fn fnsf(arguments: &[&str], place: &Path, other: &Path) -> Output {
    let (place, other) = (place.to_string_lossy(), other.to_string_lossy());
    let fill = |text: &&str| match *text {
        "PLACE" => place.clone().into_owned(),
        "OTHER" => other.clone().into_owned(),
        text => text.to_owned(),
    };
    let run = Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(arguments.iter().map(fill))
        .output();
    run.expect("it runs")
}

fn backup(server: &Server, to: &Path) -> Output {
    fnsf(
        &["backup", "--data-dir", "PLACE", "-o", "OTHER"],
        &server.data(),
        to,
    )
}

fn restore(from: &Path, to: &Path) -> Output {
    fnsf(&["restore", "PLACE", "--data-dir", "OTHER"], from, to)
}

async fn submit(server: &Server) -> String {
    let sent = Client::new()
        .post(server.url("/v1/jobs"))
        .multipart(form(small_pair(), "{}"));
    let job = accepted(sent).await;
    job["id"].as_str().expect("an id").to_owned()
}

async fn flow(server: &Server, id: &str) -> Vec<u8> {
    let url = server.url(&format!("/v1/jobs/{id}/result"));
    let flow = reqwest::get(url).await.expect("an answer");
    assert_eq!(flow.status(), 200, "{id}");
    flow.bytes().await.expect("a flow").to_vec()
}

#[tokio::test]
async fn a_backup_is_for_its_user_alone_and_lies_outside_of_the_data() {
    use std::os::unix::fs::PermissionsExt;
    let server = Server::start(&[]);
    let id = submit(&server).await;
    ended(&server, &id).await;
    let folder = Folder::new();
    let (copy, restored) = (folder.path().join("copy"), folder.path().join("restored"));
    assert!(backup(&server, &copy).status.success());
    assert!(restore(&copy, &restored).status.success());
    for place in [&copy, &restored] {
        for name in ["", "queue.sqlite3", "blobs"] {
            let about = std::fs::metadata(place.join(name)).expect("it is there");
            assert_eq!(about.permissions().mode() & 0o077, 0, "{name}");
        }
    }
    let inside = backup(&server, &server.data().join("blobs/jobs/copy"));
    let said = String::from_utf8_lossy(&inside.stderr).into_owned();
    assert!(said.contains("lies in the data directory"), "{said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_beside_a_busy_server_has_every_job_that_was_acknowledged_before() {
    let server = Server::start(&[]);
    let mut acknowledged = Vec::new();
    for _ in 0..jobs() {
        acknowledged.push(submit(&server).await);
    }
    // It goes on accepting, computing and removing meanwhile.
    let removed = acknowledged.remove(0);
    ended(&server, &removed).await;
    let url = server.url(&format!("/v1/jobs/{removed}?remove=true"));
    let copies = Folder::new();
    let copy = copies.path().join("copy");
    let (copied, _removal, later) = tokio::join!(
        async { tokio::task::block_in_place(|| backup(&server, &copy)) },
        async { Client::new().delete(&url).send().await },
        async {
            let mut later = Vec::new();
            for _ in 0..5 {
                later.push(submit(&server).await);
            }
            later
        },
    );
    let said = String::from_utf8_lossy(&copied.stderr);
    assert!(copied.status.success(), "{said}");
    let last = acknowledged.last().expect("a job");
    ended(&server, last).await;
    let expected = flow(&server, last).await;
    for id in &later {
        ended(&server, id).await;
    }
    drop(server.kill());

    let folder = Folder::new();
    let restored = restore(&copy, &folder.path().join("data"));
    let said = String::from_utf8_lossy(&restored.stderr);
    assert!(restored.status.success(), "{said}");
    let server = Server::start_in(&folder, "", &[]);
    for id in &acknowledged {
        assert_eq!(ended(&server, id).await["state"], "succeeded", "{id}");
        assert_eq!(flow(&server, id).await, expected, "{id}");
    }
}

#[tokio::test]
async fn a_backup_is_refused_where_it_would_overwrite_or_mix() {
    let server = Server::start(&[]);
    let copies = Folder::new();
    let copy = copies.path().join("copy");
    assert!(backup(&server, &copy).status.success());
    for (refused, what) in [
        (backup(&server, &copy), "is not empty"),
        (restore(&copy, &server.data()), "is not empty"),
        (
            restore(copies.path(), &copies.path().join("new")),
            "cannot be used",
        ),
        (
            fnsf(
                &["backup", "--data-dir", "PLACE", "-o", "OTHER"],
                copies.path(),
                &copies.path().join("other"),
            ),
            "no payloads",
        ),
    ] {
        assert_eq!(refused.status.code(), Some(70));
        let said = String::from_utf8_lossy(&refused.stderr);
        assert!(said.contains(what), "{said}");
    }
    std::fs::write(copy.join("blobs/identity"), "7").expect("written");
    let mixed = restore(&copy, &copies.path().join("new"));
    let said = String::from_utf8_lossy(&mixed.stderr);
    assert!(said.contains("not of one server"), "{said}");
}
