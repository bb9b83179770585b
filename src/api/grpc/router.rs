//! The gRPC routes: the calls, health checks and reflection.

use std::sync::Arc;

use axum::Router;
use tonic::codec::CompressionEncoding;
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic_health::ServingStatus;

use super::{calls, proto};
use crate::api::service::Service;

/// Maximum size of an incoming message, bytes: a chunk of 1 MiB and its envelope.
const MAX_MESSAGE: usize = (1 << 20) + (64 << 10);

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
    routes.routes().into_axum_router()
}
