//! Flow in any format: one row per source point, in the source's order.
//!
//! It must not know how the flow was found.

mod json;
mod objects;
mod read;
mod table;
mod write;

pub use read::read_flow;
pub use table::{FlowFile, FlowTable};
pub use write::{FlowFormat, write_flow};
