//! The gRPC interface: the calls of the protocol, with health checks and reflection.

mod call;
mod calls;
mod chunks;
mod convert;
mod message_body;
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
mod proto;
mod requests;
mod router;
mod sequence;
mod status;

pub(super) use router::router;
pub(super) use status::{row_of, status};
