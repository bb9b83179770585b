//! Tests of the removal of ended jobs by their owners.

use reqwest::{Client, StatusCode};
use tonic::Code;

use crate::clouds::{accepted, form, small_pair};
use crate::grpc::{client, proto};
use crate::raw_http::SMALL;
use crate::server::{PATIENCE, Server, ended};

/// Submits a pair under an idempotency key and waits for its end. Returns its id.
async fn finished(server: &Server) -> String {
    let sent = Client::new()
        .post(server.url("/v1/jobs"))
        .header("idempotency-key", "the-same")
        .multipart(form(small_pair(), SMALL));
    let job = accepted(sent).await;
    let id = job["id"].as_str().expect("an id").to_owned();
    assert_eq!(ended(server, &id).await["state"], "succeeded");
    id
}

/// Whether a file of this job is stored.
fn is_stored(server: &Server, id: &str) -> bool {
    let folder = server.data().join("blobs/jobs").join(&id[..8]).join(id);
    folder.exists()
}

async fn delete(url: &str) -> StatusCode {
    let sent = Client::new().delete(url).send().await;
    sent.expect("an answer").status()
}

async fn until_not_stored(server: &Server, id: &str) {
    let began = std::time::Instant::now();
    while is_stored(server, id) {
        assert!(began.elapsed() < PATIENCE, "its files are still there");
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
}

#[tokio::test]
async fn an_ended_job_that_is_deleted_leaves_no_file_and_frees_its_key() {
    let server = Server::start(&[]);
    let id = finished(&server).await;
    assert!(is_stored(&server, &id));
    let url = server.url(&format!("/v1/jobs/{id}"));
    assert_eq!(delete(&url).await, StatusCode::OK, "it is cancelled");
    assert!(is_stored(&server, &id), "a cancellation removes nothing");
    let removal = format!("{url}?remove=true");
    assert_eq!(delete(&removal).await, StatusCode::NO_CONTENT);
    until_not_stored(&server, &id).await;
    for path in [url.clone(), format!("{url}/result")] {
        let gone = reqwest::get(path).await.expect("an answer");
        assert_eq!(gone.status(), StatusCode::NOT_FOUND);
    }
    assert_eq!(delete(&removal).await, StatusCode::NOT_FOUND);
    let unknown = format!("{url}?purge=true");
    assert_eq!(delete(&unknown).await, StatusCode::BAD_REQUEST);
    assert_ne!(
        finished(&server).await,
        id,
        "the key finds a job that is gone"
    );
}

#[tokio::test]
async fn a_job_that_has_not_ended_is_not_removed() {
    let server = Server::start(&[]);
    let mut calls = client(&server).await;
    let paper = r#"{"preset": "paper"}"#;
    let sent = Client::new()
        .post(server.url("/v1/jobs"))
        .multipart(form(crate::clouds::medium_pair(), paper));
    let job = accepted(sent).await;
    let id = job["id"].as_str().expect("an id").to_owned();
    let removal = server.url(&format!("/v1/jobs/{id}?remove=true"));
    assert_eq!(delete(&removal).await, StatusCode::CONFLICT);
    let refused = calls
        .delete_job(proto::DeleteJobRequest { id: id.clone() })
        .await;
    assert_eq!(
        refused.expect_err("it has not ended").code(),
        Code::FailedPrecondition
    );
    let cancelled = proto::CancelJobRequest { id: id.clone() };
    calls.cancel_job(cancelled).await.expect("known");
    assert_eq!(ended(&server, &id).await["state"], "cancelled");
    let asked = proto::DeleteJobRequest { id: id.clone() };
    calls.delete_job(asked.clone()).await.expect("it has ended");
    until_not_stored(&server, &id).await;
    let gone = calls.delete_job(asked).await.expect_err("it is gone");
    assert_eq!(gone.code(), Code::NotFound);
}
