//! Locks for the rooms around the numerics.

pub(crate) use crate::flow::locked;
