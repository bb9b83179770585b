//! Tests of SIGHUP: keys are exchanged without a restart.

use std::path::PathBuf;

use reqwest::{Client, StatusCode};
use tokio_stream::StreamExt;
use tonic::Code;

use crate::clouds::{ENDLESS, accepted, form, small_pair};
use crate::grpc::{self, proto};
use crate::server::{Folder, Server};

const OLD: &str = "an-old-key-of-a-tenant";
const NEW: &str = "a-new-key-of-a-tenant";

fn config(keys: &[&str]) -> String {
    let key = |key: &&str| format!("[[keys]]\ntenant = \"a\"\nrole = \"write\"\nkey = \"{key}\"\n");
    keys.iter().map(key).collect()
}

async fn status(server: &Server, key: &str) -> StatusCode {
    let sent = Client::new().get(server.url("/v1/jobs")).bearer_auth(key);
    sent.send().await.expect("an answer").status()
}

/// Writes another configuration, sends SIGHUP, and waits for this line in the log.
fn reload(server: &Server, file: &PathBuf, config: &str, line: &str) {
    let before = server.log().matches(line).count();
    std::fs::write(file, config).expect("written");
    server.signal("HUP");
    server.until("it has read the file", || {
        server.log().matches(line).count() > before
    });
}

#[tokio::test]
async fn keys_are_exchanged_without_a_restart_and_two_are_valid_while_they_rotate() {
    let folder = Folder::new();
    let server = Server::start_in(&folder, &config(&[OLD]), &[]);
    let file = folder.path().join("fnsf.toml");
    let (ok, no) = (StatusCode::OK, StatusCode::UNAUTHORIZED);
    let both = async |of: &Server| (status(of, OLD).await, status(of, NEW).await);
    assert_eq!(both(&server).await, (ok, no));
    reload(&server, &file, &config(&[OLD, NEW]), "are read again");
    assert_eq!(both(&server).await, (ok, ok));
    reload(&server, &file, &config(&[NEW]), "are read again");
    assert_eq!(both(&server).await, (no, ok));
    // A file that cannot be used changes nothing.
    for wrong in ["keys = 7", &config(&["short"]), ""] {
        reload(&server, &file, wrong, "stay as they were");
        assert_eq!(both(&server).await, (no, ok));
    }
}

#[tokio::test]
async fn streams_of_events_end_with_the_key_of_their_reader() {
    let folder = Folder::new();
    let server = Server::start_in(&folder, &config(&[OLD, NEW]), &[]);
    let job = Client::new()
        .post(server.url("/v1/jobs"))
        .multipart(form(small_pair(), ENDLESS))
        .bearer_auth(NEW);
    let job = accepted(job).await;
    let id = job["id"].as_str().expect("an id").to_owned();
    let http = async |key: &str| {
        let path = format!("/v1/jobs/{id}/events");
        let events = Client::new().get(server.url(&path)).bearer_auth(key).send();
        events.await.expect("an answer").bytes_stream()
    };
    let (mut old, mut new) = (http(OLD).await, http(NEW).await);
    let mut asked = tonic::Request::new(proto::WatchJobRequest { id: id.clone() });
    let bearer = format!("Bearer {OLD}").parse().expect("a header");
    asked.metadata_mut().insert("authorization", bearer);
    let watch = grpc::client(&server).await.watch_job(asked).await;
    let mut watch = watch.expect("news").into_inner();

    let file = folder.path().join("fnsf.toml");
    // The other key gets other rights, which ends no stream.
    let changed = config(&[NEW]) + "max_priority = \"low\"\n";
    reload(&server, &file, &changed, "are read again");
    while let Some(event) = old.next().await {
        event.expect("the stream ends as a whole");
    }
    let refused = loop {
        match watch.next().await.expect("an end that says why") {
            Ok(_job) => {}
            Err(status) => break status,
        }
    };
    assert_eq!(refused.code(), Code::Unauthenticated);
    // The other reader still gets news of the same job.
    let delete = server.url(&format!("/v1/jobs/{id}"));
    let ended = Client::new().delete(delete).bearer_auth(NEW).send().await;
    assert!(ended.expect("an answer").status().is_success());
    let mut text = String::new();
    while let Some(event) = new.next().await {
        text += &String::from_utf8_lossy(&event.expect("an event"));
    }
    assert!(text.contains("\"cancelled\""), "{text}");
}
