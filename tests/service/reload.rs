//! Tests of SIGHUP: keys are exchanged without a restart.

use std::path::PathBuf;

use reqwest::{Client, StatusCode};

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
