//! The gRPC door: the protocol's calls on the service that both doors share.
//!
//! The only room that sees the protocol's types. Health and reflection are served beside it.

mod call;
mod calls;
mod chunks;
mod convert;
mod sequence;
mod status;

use std::sync::Arc;

use axum::Router;
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic_health::ServingStatus;

use super::service::Service;

pub(super) use status::{row_of, status};

/// The messages and the service, generated from `proto/fnsf/v1/scene_flow.proto`.
#[expect(unreachable_pub, reason = "generated code is public to its module")]
#[expect(
    clippy::allow_attributes,
    reason = "generated code silences what it must"
)]
#[expect(
    clippy::allow_attributes_without_reason,
    reason = "and does not say why"
)]
#[expect(
    unused_qualifications,
    reason = "generated code names everything in full"
)]
mod proto {
    tonic::include_proto!("fnsf.v1");

    /// The protocol itself, for reflection.
    pub(super) const DESCRIPTORS: &[u8] =
        include_bytes!(concat!(env!("OUT_DIR"), "/scene_flow.bin"));
}

/// The largest message that is taken: a chunk and its envelope.
const MAX_MESSAGE: usize = (1 << 20) + (64 << 10);

/// The calls of the gRPC door, as routes.
pub(super) fn router(service: &Arc<Service>) -> Router {
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
