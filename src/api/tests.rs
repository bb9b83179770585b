//! Tests that no reader of a body or stream blocks its thread, with sources that never end.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::mpsc::channel;
use std::task::{Context, Poll};
use std::thread;
use std::time::Duration;

use axum::body::Body as AnyBody;
use axum::extract::Request;
use bytes::Bytes;
use http_body_util::BodyExt;
use hyper::body::{Body, Frame};
use tokio::sync::mpsc;
use tower::ServiceExt;

use super::admission::{AdmissionRequest, Durability};
use super::error::ApiError;
use super::listener::bodies::RequestBody;
use super::routes::public_router;
use super::service::Service;
use super::service_parts::ServiceParts;
use crate::job::{Priority, Tenant};
use crate::queue::{QueueOptions, open_sqlite};

/// Time after which a request that has not returned counts as a busy loop.
const PATIENCE: Duration = Duration::from_secs(60);

/// The idle timeout of bodies and streams. The sources in these tests are never idle.
const A_MOMENT: Duration = Duration::from_millis(300);

/// A body that repeats one frame or one error forever and is always ready.
pub(super) struct ForEver<E>(pub(super) Result<Bytes, E>);

impl<E: Clone + Unpin> Body for ForEver<E> {
    type Data = Bytes;
    type Error = E;

    fn poll_frame(
        self: Pin<&mut Self>,
        _: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, E>>> {
        Poll::Ready(Some(self.0.clone().map(Frame::data)))
    }
}

fn service(folder: &std::path::Path) -> Arc<Service> {
    let (events, _) = mpsc::unbounded_channel();
    let queue = open_sqlite(folder, QueueOptions::default(), events).expect("a queue");
    Arc::new(Service::new(ServiceParts::alone(queue, folder, A_MOMENT)))
}

/// The sources: as they are, or wrapped in [`RequestBody`] as the listener does.
fn sources(port: bool) -> Vec<(&'static str, AnyBody)> {
    let piece = |bytes: &'static [u8]| ForEver(Ok::<_, &'static str>(Bytes::from_static(bytes)));
    let broken = || ForEver(Err::<Bytes, _>("reset"));
    if !port {
        // All other sources are always ready. Only the listener's wrapper limits them.
        return vec![("errors", AnyBody::new(broken()))];
    }
    vec![
        ("errors", AnyBody::new(RequestBody::new(broken()))),
        ("nothing", AnyBody::new(RequestBody::new(piece(b"")))),
        ("zeros", AnyBody::new(RequestBody::new(piece(&[0; 5])))),
        (
            "a boundary",
            AnyBody::new(RequestBody::new(piece(b"--x\r\n"))),
        ),
        ("text", AnyBody::new(RequestBody::new(piece(&[b'y'; 4096])))),
    ]
}

/// Sends one request. Returns whether the response was complete in time.
async fn asked(service: &Arc<Service>, path: &str, media: &str, body: AnyBody) -> bool {
    let request = Request::post(path)
        .version(axum::http::Version::HTTP_2)
        .header("content-type", media)
        .header("te", "trailers")
        .body(body)
        .expect("a request");
    let answered = async {
        let answer = public_router(service, true).oneshot(request).await;
        let Ok(answer) = answer;
        answer.into_body().collect().await.is_ok()
    };
    // On one thread: a busy loop also stops this timer, and is detected by the thread outside.
    tokio::time::timeout(A_MOMENT * 10, answered).await.is_ok()
}

#[test]
fn no_reader_of_a_body_or_stream_keeps_its_thread_for_itself() {
    const FORM: &str = "multipart/form-data; boundary=x";
    let routes = [
        ("/v1/flow", FORM),
        ("/v1/jobs", FORM),
        ("/v1/sequences", FORM),
        ("/v1/flow", "a/b"),
        ("/v1/jobs", "a/b"),
        ("/v1/sequences", "a/b"),
        ("/nowhere", "a/b"),
        ("/fnsf.v1.SceneFlow/EstimateFlow", "application/grpc"),
        ("/fnsf.v1.SceneFlow/EstimateSequence", "application/grpc"),
        ("/fnsf.v1.SceneFlow/SubmitJob", "application/grpc"),
        ("/fnsf.v1.SceneFlow/GetJob", "application/grpc"),
        ("/grpc.health.v1.Health/Check", "application/grpc"),
    ];
    for (path, media) in routes {
        let mut asked_at_once = Vec::new();
        for port in [false, true] {
            for (source, body) in sources(port) {
                let (done, heard) = channel();
                thread::spawn(move || {
                    let folder = tempfile::tempdir().expect("a folder");
                    let runtime = tokio::runtime::Builder::new_current_thread()
                        .enable_all()
                        .build()
                        .expect("a runtime");
                    let answered = runtime.block_on(async {
                        let service = service(folder.path());
                        asked(&service, path, media, body).await
                    });
                    runtime.shutdown_background();
                    let _who_waits_may_have_gone = done.send(answered);
                });
                asked_at_once.push((source, heard));
            }
        }
        for (source, heard) in asked_at_once {
            let answered = heard.recv_timeout(PATIENCE);
            let answered = answered.unwrap_or_else(|_| panic!("{path} spins on {source}"));
            // A stream of messages may continue forever, but an error has to end the request.
            assert!(answered || source != "errors", "{path} does not end");
        }
    }
}

#[tokio::test]
async fn submissions_at_the_same_time_count_against_the_limit_of_their_tenant() {
    let folder = tempfile::tempdir().expect("a folder");
    let service = service(folder.path());
    let [one, other] = ["one", "other"].map(|name| name.parse::<Tenant>().expect("a name"));
    let admit = |tenant: &Tenant, nominal_seconds: f64| {
        service.admission.admit(&AdmissionRequest {
            tenant,
            priority: Priority::Normal,
            device: None,
            nominal_seconds,
            durability: Durability::Durable,
        })
    };
    // More than half of the limit, by whatever factor nominal seconds become seconds.
    let mut seconds = 1e6;
    while admit(&one, seconds).is_err() {
        seconds *= 0.75;
    }
    let first = admit(&one, seconds).expect("admitted");
    let refused = admit(&one, seconds).expect_err("over the limit");
    assert!(matches!(refused, ApiError::TenantLimit(_)), "{refused:?}");
    let refused = admit(&other, seconds).expect_err("over the limit of all");
    assert!(matches!(refused, ApiError::ServerFull(_)), "{refused:?}");
    drop(first);
    drop(admit(&one, seconds).expect("released"));
}
