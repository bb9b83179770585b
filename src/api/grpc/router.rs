//! The gRPC routes: the calls, health checks and reflection.

use std::sync::Arc;

use axum::Router;
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic_health::ServingStatus;

use super::{calls, proto};
use crate::api::service::Service;

/// Maximum size of an incoming message, bytes: a chunk of 1 MiB and its envelope.
const MAX_MESSAGE: usize = (1 << 20) + (64 << 10);

/// The gRPC routes. The health status changes to NOT_SERVING when the server is about to stop.
pub(crate) fn router(service: &Arc<Service>) -> Router {
    let calls = proto::scene_flow_server::SceneFlowServer::new(calls::Calls::new(service))
        .max_decoding_message_size(MAX_MESSAGE)
        .max_encoding_message_size(4 << 20);
    let (reporter, health) = tonic_health::server::health_reporter();
    let leaving = service.leaving.clone();
    tokio::spawn(async move {
        let own = <proto::scene_flow_server::SceneFlowServer<calls::Calls> as NamedService>::NAME;
        reporter
            .set_service_status(own, ServingStatus::Serving)
            .await;
        leaving.cancelled().await;
        for name in ["", own] {
            reporter
                .set_service_status(name, ServingStatus::NotServing)
                .await;
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
