//! Tests of webhooks: told once their job has ended, signed, again after failures and kills.

use std::sync::{Arc, Mutex};
use std::time::Instant;

use axum::Router;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::routing::post;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit, Mac};
use reqwest::Client;
use serde_json::{Value, json};
use sha2::Sha256;

use crate::clouds::{form, small_pair};
use crate::server::{Folder, PATIENCE, Server, ended};

const KEY: &[u8] = b"0123456789abcdef0123456789abcdef";

/// A notice as a receiver gets it.
#[derive(Clone)]
struct Heard {
    headers: HeaderMap,
    body: String,
}

#[derive(Clone, Default)]
struct Receiver {
    heard: Arc<Mutex<Vec<Heard>>>,
    /// The number of notices that are answered with 503.
    fails: usize,
}

async fn receive(State(of): State<Receiver>, headers: HeaderMap, body: String) -> StatusCode {
    let mut heard = of.heard.lock().expect("no panic holds it");
    heard.push(Heard { headers, body });
    match heard.len() <= of.fails {
        true => StatusCode::SERVICE_UNAVAILABLE,
        false => StatusCode::NO_CONTENT,
    }
}

impl Receiver {
    /// Listens on a free port. Returns the URL of its address, which ends with a slash.
    async fn listen(&self) -> String {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0")
            .await
            .expect("a port");
        let address = listener.local_addr().expect("an address");
        let router = Router::new()
            .route("/hooks/{*any}", post(receive))
            .with_state(self.clone());
        tokio::spawn(async move { axum::serve(listener, router).await });
        format!("http://{address}/hooks/")
    }

    fn heard(&self) -> Vec<Heard> {
        self.heard.lock().expect("no panic holds it").clone()
    }

    async fn until_heard(&self, count: usize) -> Vec<Heard> {
        let began = Instant::now();
        while self.heard().len() < count {
            assert!(began.elapsed() < PATIENCE, "nothing was told");
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
        self.heard()
    }
}

fn config(prefix: &str) -> String {
    let secret = STANDARD.encode(KEY);
    format!(
        "[remote]\nwebhooks = [\"{prefix}\"]\nwebhook_secret = \"whsec_{secret}\"\n\
         allow_private_addresses = true\n"
    )
}

async fn submit(server: &Server, options: &Value) -> (StatusCode, Value) {
    let sent = Client::new()
        .post(server.url("/v1/jobs"))
        .multipart(form(small_pair(), &options.to_string()))
        .send();
    let answer = sent.await.expect("an answer");
    (answer.status(), answer.json().await.expect("JSON"))
}

fn header<'a>(heard: &'a Heard, name: &str) -> &'a str {
    heard.headers[name].to_str().expect("text")
}

/// Fails unless the signature is that of the secret.
fn check_signature(heard: &Heard) {
    let signed = [
        header(heard, "webhook-id"),
        header(heard, "webhook-timestamp"),
        &heard.body,
    ];
    let mut mac = Hmac::<Sha256>::new_from_slice(KEY).expect("a key");
    mac.update(signed.join(".").as_bytes());
    let expected = format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()));
    assert_eq!(header(heard, "webhook-signature"), expected);
}

#[tokio::test]
async fn the_end_of_a_job_is_told_signed_and_again_until_the_receiver_takes_it() {
    let receiver = Receiver {
        fails: 1,
        ..Receiver::default()
    };
    let prefix = receiver.listen().await;
    let server = Server::with_config(&config(&prefix));
    let options = json!({ "webhook": format!("{prefix}a"), "labels": { "drive": "7" } });
    let (status, job) = submit(&server, &options).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{job}");
    let heard = receiver.until_heard(2).await;
    for one in &heard {
        check_signature(one);
        let body: Value = serde_json::from_str(&one.body).expect("JSON");
        assert_eq!(body["type"], "job.succeeded");
        assert_eq!(body["data"]["id"], job["id"]);
        assert_eq!(body["data"]["labels"]["drive"], "7");
        assert_eq!(header(one, "webhook-id"), header(&heard[0], "webhook-id"));
    }
    assert_eq!(
        server.metric("fnsf_webhooks_total{outcome=\"retried\"}"),
        1.0
    );
    server.until("it is counted", || {
        server.metric("fnsf_webhooks_total{outcome=\"delivered\"}") >= 1.0
    });
}

#[tokio::test]
async fn a_notice_that_a_kill_prevented_is_told_by_the_next_process() {
    let receiver = Receiver::default();
    // The receiver starts on this port after the server is killed. Until then the port is closed.
    let free = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = free.local_addr().expect("an address");
    drop(free);
    let prefix = format!("http://{address}/hooks/");
    let folder = Folder::new();
    let server = Server::start_in(&folder, &config(&prefix), &[]);
    let (_, job) = submit(&server, &json!({ "webhook": format!("{prefix}b") })).await;
    let id = job["id"].as_str().expect("an id");
    ended(&server, id).await;
    server.until("it was tried", || {
        server.metric("fnsf_webhooks_total{outcome=\"retried\"}") >= 1.0
    });
    server.kill();
    let listener = tokio::net::TcpListener::bind(address)
        .await
        .expect("the port");
    let router = Router::new()
        .route("/hooks/b", post(receive))
        .with_state(receiver.clone());
    tokio::spawn(async move { axum::serve(listener, router).await });
    let _server = Server::start_in(&folder, &config(&prefix), &[]);
    let heard = receiver.until_heard(1).await;
    check_signature(&heard[0]);
    assert!(heard[0].body.contains(id));
}

#[tokio::test]
async fn a_webhook_is_refused_that_the_configuration_does_not_allow() {
    let server = Server::with_config(&config("http://127.0.0.1:9/hooks/"));
    for wrong in [
        "http://127.0.0.1:9/other",
        "http://127.0.0.1:9/hooks/../other",
        "http://user@127.0.0.1:9/hooks/a",
        "https://127.0.0.1:9/hooks/a",
        "file:///etc/passwd",
        "",
    ] {
        let (status, problem) = submit(&server, &json!({ "webhook": wrong })).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{wrong}: {problem}");
        assert_eq!(problem["code"], "invalid_options");
    }
    // A call that waits for its flow has no end to be told of.
    let waits = Client::new()
        .post(server.url("/v1/flow"))
        .multipart(form(
            small_pair(),
            r#"{"webhook": "http://127.0.0.1:9/hooks/a"}"#,
        ))
        .send();
    assert_eq!(
        waits.await.expect("an answer").status(),
        StatusCode::BAD_REQUEST
    );
    let plain = Server::start(&[]);
    let (status, problem) = submit(&plain, &json!({ "webhook": "https://a.example/" })).await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    let said = problem["detail"].as_str().expect("text");
    assert!(said.contains("remote.webhooks"), "{said}");
}
