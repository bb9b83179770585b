//! The lock helper of `flow`, for the modules of the service.

pub(crate) use crate::flow::locked;
