//! The queue, the devices and the nodes, as far as a caller may see them.

use serde::Serialize;
use utoipa::ToSchema;

use super::auth::{Caller, Role};
use super::error::ApiError;
use super::fleet::{DeviceView, NodeView, capacities};
use super::service::Service;
use crate::job::{DeviceKind, Priority};
use crate::queue::Load;

/// The queue, the devices and the nodes. A caller of role `operate` sees all of it. Others see the
/// queued jobs of their own tenant, and the sums.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct QueueView {
    /// Whether the caller sees the jobs of all tenants, the devices and the nodes.
    operates: bool,
    /// Queued jobs by tenant, priority and required kind of device, highest priority first.
    queued: Vec<QueuedView>,
    /// All queued jobs, those of other tenants included.
    total: LoadView,
    /// All running jobs.
    running: LoadView,
    /// Number of pairs that all nodes compute at the same time.
    lanes: usize,
    /// Pairs that have ended on this node since its start, by state.
    ended: Option<Vec<EndedView>>,
    /// The devices of this node.
    devices: Option<Vec<DeviceView>>,
    /// The nodes that have the queue open.
    nodes: Option<Vec<NodeView>>,
}

/// A number of jobs and their predicted compute time.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct LoadView {
    /// Number of pairs and dense clouds.
    jobs: u64,
    /// Predicted compute time in one lane, seconds.
    seconds: f64,
}

/// The queued jobs of one tenant, priority and required kind of device.
#[derive(Debug, Serialize, ToSchema)]
struct QueuedView {
    /// The tenant.
    tenant: String,
    /// The priority.
    priority: Priority,
    /// The required kind of device. Null if any will do.
    device: Option<&'static str>,
    #[serde(flatten)]
    load: LoadView,
    /// Predicted seconds until one more such job would start.
    wait_seconds: f64,
}

/// The number of pairs that have ended in one state.
#[derive(Debug, Serialize, ToSchema)]
struct EndedView {
    /// The state.
    state: &'static str,
    /// The number of pairs.
    pairs: u64,
}

impl Service {
    /// The queue, the devices and the nodes, as far as the caller may see them.
    ///
    /// # Errors
    /// - [`ApiError::Forbidden`] for a caller with a share link.
    /// - [`ApiError::StoreUnavailable`], [`ApiError::DiskFull`] or [`ApiError::Draining`] if the
    ///   queue fails or is closed.
    pub(super) async fn queue_view(&self, caller: &Caller) -> Result<QueueView, ApiError> {
        caller.has_key()?;
        let operates = caller.role >= Role::Operate;
        let (backlog, cost) = (self.queue.backlog(), self.admission.cost());
        let load = |load: Load| LoadView {
            jobs: load.jobs,
            seconds: cost.seconds(load.seconds),
        };
        let mut rows = backlog.rows();
        rows.retain(|(tenant, ..)| operates || *tenant == caller.tenant);
        rows.sort_by(|a, b| {
            let key = |tenant: &crate::job::Tenant| tenant.as_str().to_owned();
            b.1.cmp(&a.1).then_with(|| key(&a.0).cmp(&key(&b.0)))
        });
        let queued = rows
            .into_iter()
            .map(|(tenant, priority, device, queued)| QueuedView {
                wait_seconds: self
                    .admission
                    .predicted_wait(&backlog, &tenant, priority, device),
                tenant: tenant.as_str().to_owned(),
                priority,
                device: device.map(DeviceKind::name),
                load: load(queued),
            });
        let nodes = match operates {
            true => Some(self.queue.nodes(capacities(cost)).await?),
            false => None,
        };
        Ok(QueueView {
            operates,
            queued: queued.collect(),
            total: load(backlog.queued()),
            running: load(backlog.running()),
            lanes: cost.lanes().total(),
            ended: operates.then(|| self.ended()),
            devices: operates.then(|| (self.devices)()),
            nodes: nodes.map(|nodes| nodes.into_iter().map(NodeView::from).collect()),
        })
    }

    fn ended(&self) -> Vec<EndedView> {
        let ended = self.metrics.finished_pairs().into_iter();
        ended
            .map(|(state, pairs)| EndedView { state, pairs })
            .collect()
    }
}
