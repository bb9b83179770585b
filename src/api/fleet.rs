//! The nodes of a queue: what this one can do, what the others can, and the views of devices and
//! nodes.

use serde::Serialize;
use utoipa::ToSchema;

use crate::clock::Timestamp;
use crate::cost::{CostModel, Others};
use crate::job::DeviceKind;
use crate::queue::{Capacities, Capacity, Node};

/// What this process can do.
pub fn capacities(cost: &CostModel) -> Capacities {
    DeviceKind::ALL.map(|kind| Capacity {
        lanes: u32::try_from(cost.own_lanes().of(kind)).unwrap_or(u32::MAX),
        rate: cost.own_rate(kind),
    })
}

/// What the other nodes can do together.
pub fn others(nodes: &[Node]) -> Others {
    let mut sum = Others::default();
    for node in nodes.iter().filter(|node| !node.is_this) {
        for (sum, capacity) in sum.iter_mut().zip(&node.capacities) {
            sum.0 += capacity.lanes as usize;
            sum.1 += capacity.rate;
        }
    }
    sum
}

/// A device of this node.
#[derive(Debug, Serialize, ToSchema)]
pub struct DeviceView {
    /// Its name in metrics and logs.
    pub name: String,
    /// Its kind.
    pub kind: &'static str,
    /// Number of pairs that it computes at the same time.
    pub lanes: usize,
    /// Why it is not ready. Null if it is ready.
    pub not_ready: Option<String>,
}

/// A node.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct NodeView {
    /// Its number, which no other node has had.
    number: i64,
    /// Its name: `node` of its configuration, or the name of its host.
    name: String,
    /// The version of its program.
    version: String,
    /// When it started.
    #[schema(value_type = String)]
    started: Timestamp,
    /// Whether it is the one that answers.
    is_this: bool,
    /// Its devices, by kind.
    devices: Vec<CapacityView>,
}

/// The devices of one kind of a node.
#[derive(Debug, Serialize, ToSchema)]
struct CapacityView {
    /// The kind.
    kind: &'static str,
    /// Number of pairs that they compute at the same time.
    lanes: u32,
    /// Nominal seconds of work that they complete per second.
    rate: f64,
}

impl From<Node> for NodeView {
    fn from(node: Node) -> Self {
        let devices = DeviceKind::ALL.iter().zip(node.capacities);
        let devices = devices.filter(|(_, capacity)| capacity.lanes > 0);
        Self {
            number: node.number,
            name: node.name,
            version: node.version,
            started: node.started,
            is_this: node.is_this,
            devices: devices
                .map(|(kind, capacity)| CapacityView {
                    kind: kind.name(),
                    lanes: capacity.lanes,
                    rate: capacity.rate,
                })
                .collect(),
        }
    }
}
