//! What goes on beside the jobs: counting, cleaning, and looking at the devices.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::interval;

use crate::blobs::Blobs;
use crate::engine::Device;
use crate::metrics::Metrics;
use crate::queue::{Event, Queue};

/// How often the devices are looked at; their busy ratio is of so long.
const LOOK: Duration = Duration::from_secs(2);

/// How often payloads without a job are looked for, and how old they must be: a payload is
/// written before its job.
const ORPHANS: Duration = Duration::from_secs(3600);

/// Starts it all.
pub(super) fn start(
    queue: &Arc<dyn Queue>,
    blobs: &Blobs,
    metrics: &Arc<Metrics>,
    devices: &[Device],
    heard: mpsc::UnboundedReceiver<Event>,
) -> JoinSet<()> {
    let mut tasks = JoinSet::new();
    tasks.spawn(listen(blobs.clone(), Arc::clone(metrics), heard));
    tasks.spawn(look(devices.to_vec(), Arc::clone(metrics)));
    tasks.spawn(clean(Arc::clone(queue), blobs.clone()));
    tasks
}

/// Counts what happens in the queue, and removes what a forgotten job leaves behind.
async fn listen(blobs: Blobs, metrics: Arc<Metrics>, mut heard: mpsc::UnboundedReceiver<Event>) {
    while let Some(event) = heard.recv().await {
        metrics.observe(&event);
        if let Event::Forgotten(id) = event
            && let Err(error) = blobs.remove_job(id).await
        {
            tracing::warn!(%error, job = %id, "a forgotten job left something behind");
        }
    }
}

async fn look(devices: Vec<Device>, metrics: Arc<Metrics>) {
    let mut ticks = interval(LOOK);
    let mut before: Vec<Duration> = devices.iter().map(Device::busy).collect();
    let mut then = Instant::now();
    loop {
        ticks.tick().await;
        let passed = then.elapsed().as_secs_f64().max(1e-3);
        then = Instant::now();
        for (device, before) in devices.iter().zip(&mut before) {
            device.look();
            let busy = device.busy();
            let lanes = device.lanes().len() as f64;
            let ratio = busy.saturating_sub(*before).as_secs_f64() / passed / lanes;
            *before = busy;
            metrics.device(device.name(), device.obstacle().is_none(), ratio.min(1.0));
        }
    }
}

/// Removes payloads whose job was never accepted: their upload was cut off by a crash.
async fn clean(queue: Arc<dyn Queue>, blobs: Blobs) {
    let mut ticks = interval(ORPHANS);
    loop {
        ticks.tick().await;
        let found = match blobs.jobs_older_than(ORPHANS).await {
            Ok(found) => found,
            Err(error) => {
                tracing::warn!(%error, "payloads cannot be listed");
                continue;
            }
        };
        for ids in found.chunks(256) {
            let Ok(known) = queue.known(ids.to_vec()).await else {
                continue;
            };
            for id in ids.iter().filter(|id| !known.contains(id)) {
                if let Err(error) = blobs.remove_job(*id).await {
                    tracing::warn!(%error, job = %id, "an orphan was not removed");
                }
            }
        }
    }
}
