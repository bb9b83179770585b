//! The gRPC routes: the calls, health checks and reflection.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::{Request, State};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::Response;
use axum::{BoxError, Router};
use http_body_util::{BodyExt, LengthLimitError, Limited};
use tonic::Status;
use tonic::codec::CompressionEncoding;
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic_health::ServingStatus;

use super::message_body::MessageBody;
use super::{calls, proto};
use crate::api::auth::Caller;
use crate::api::error::ApiError;
use crate::api::listener::bodies::{NotInTime, RequestBody, TimedBody};
use crate::api::service::Service;
use crate::api::upload_budget::MessageMemory;

/// Maximum size of an incoming message, bytes: a chunk of 1 MiB and its envelope.
const MAX_MESSAGE: usize = (1 << 20) + (64 << 10);

/// Maximum size of the body of a call that takes no clouds, bytes.
const MAX_SMALL_BODY: usize = 128 << 10;

/// Maximum size of a message to the health service, bytes.
const MAX_HEALTH_MESSAGE: usize = 4 << 10;

/// Bounds the memory of messages. With clouds, it is in the budget of the caller's uploads; a body
/// without clouds is small, and comes in time as a whole.
async fn with_bounds(
    State(service): State<Arc<Service>>,
    request: Request,
    next: Next,
) -> Response {
    let path = request.uri().path();
    let takes_clouds = ["/EstimateFlow", "/EstimateSequence", "/SubmitJob"];
    let takes_clouds = takes_clouds.iter().any(|call| path.ends_with(call));
    let caller = request.extensions().get::<Caller>();
    let room = caller.map(|caller| service.uploads.room(&caller.tenant));
    let request = match room.filter(|_| takes_clouds) {
        Some(room) => {
            let memory = MessageMemory::default();
            let mut request = request.map(|body| {
                let body = MessageBody::new(body, MAX_MESSAGE, room, memory.clone());
                Body::new(RequestBody::new(body))
            });
            request.extensions_mut().insert(memory);
            request
        }
        None => request.map(|body| {
            let body = TimedBody::new(Limited::new(body, MAX_SMALL_BODY), service.limits.body_idle);
            Body::new(RequestBody::new(body).map_err(status))
        }),
    };
    next.run(request).await
}

/// The status of a call whose body ends with an error.
fn status(error: BoxError) -> BoxError {
    let refused = if error.is::<LengthLimitError>() {
        ApiError::TooLarge("the request is larger than 128 KiB".to_owned())
    } else if error.is::<NotInTime>() {
        ApiError::TooSlow
    } else {
        return error;
    };
    Status::from(refused).into()
}

/// The gRPC routes. The health status follows [`Service::set_ready`].
pub(crate) fn router(service: &Arc<Service>) -> Router {
    let calls = proto::scene_flow_server::SceneFlowServer::new(calls::Calls::new(service))
        // The limit applies to the decompressed message too.
        .accept_compressed(CompressionEncoding::Gzip)
        .max_decoding_message_size(MAX_MESSAGE)
        .max_encoding_message_size(4 << 20);
    let (reporter, health) = tonic_health::server::health_reporter();
    let mut ready = service.ready.subscribe();
    tokio::spawn(async move {
        let own = <proto::scene_flow_server::SceneFlowServer<calls::Calls> as NamedService>::NAME;
        loop {
            let status = match *ready.borrow_and_update() {
                true => ServingStatus::Serving,
                false => ServingStatus::NotServing,
            };
            for name in ["", own] {
                reporter.set_service_status(name, status).await;
            }
            if ready.changed().await.is_err() {
                break;
            }
        }
    });
    let mut routes = Routes::builder();
    let health = health.max_decoding_message_size(MAX_HEALTH_MESSAGE);
    routes.add_service(calls).add_service(health);
    for version in [1, 0] {
        let reflection = tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(proto::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET);
        if version == 1 {
            routes.add_service(reflection.build_v1().expect("the descriptors are our own"));
        } else {
            let older = reflection.build_v1alpha();
            routes.add_service(older.expect("the descriptors are our own"));
        }
    }
    let bounds = from_fn_with_state(Arc::clone(service), with_bounds);
    routes.routes().into_axum_router().layer(bounds)
}
