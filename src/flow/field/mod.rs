//! What produces the flow: continuous fields fitted to one pair.

pub mod mlp;
