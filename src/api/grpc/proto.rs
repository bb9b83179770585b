//! The messages and the service, generated from `proto/fnsf/v1/scene_flow.proto`.

tonic::include_proto!("fnsf.v1");

/// The encoded file descriptors, for reflection.
pub(crate) const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/scene_flow.bin"));
