//! Background tasks of the server: metrics, heartbeat, device and store probes, and cleanup of
//! orphaned payloads.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::{Notify, mpsc};
use tokio::task::JoinSet;
use tokio::time::{interval, interval_at};

use crate::api::{Readiness, Service, capacities, others};
use crate::cost::CostModel;
use crate::engine::Device;
use crate::health::{HEARTBEAT, Heartbeat};
use crate::metrics::Metrics;
use crate::queue::{Event, Queue};
use crate::storage::Blobs;
use crate::worker::StoreProbe;

/// Polling interval of the readiness, which gRPC health follows.
const READINESS_INTERVAL: Duration = Duration::from_millis(200);

/// Polling interval of the devices, and the period of their busy ratio.
const PROBE_INTERVAL: Duration = Duration::from_secs(2);

/// Interval between scans for orphaned payloads, and their minimum age. A payload is written before
/// its job is accepted, so a young payload without a job is normal.
const ORPHANS: Duration = Duration::from_secs(3600);

/// Time from the start to the first scan: a server that is often started again scans, too.
const FIRST_SCAN: Duration = Duration::from_secs(300);

/// Orphans removed in one scan, oldest first. A crash leaves a few. Far more than this point to a
/// fault, and the limit leaves an operator time to find it.
const MOST_ORPHANS: usize = 1000;

/// Probe interval while the store works.
const PROBE: Duration = Duration::from_secs(10);

/// Pause after a failed probe. It doubles up to `LAST_PROBE`. It is reset when the start or the
/// last recovery of the store is longer ago than `LAST_PROBE`.
const FIRST_PROBE: Duration = Duration::from_secs(1);
const LAST_PROBE: Duration = Duration::from_secs(30);

/// Interval between two exchanges of the nodes.
const EXCHANGE_INTERVAL: Duration = Duration::from_secs(2);

/// Starts all background tasks.
pub(super) fn start(
    queue: &Arc<dyn Queue>,
    blobs: &Blobs,
    metrics: &Arc<Metrics>,
    devices: &[Device],
    events: (mpsc::UnboundedReceiver<Event>, Arc<Notify>),
    health: (&Arc<StoreProbe>, &Arc<Heartbeat>),
) -> JoinSet<()> {
    let (store, heartbeat) = (Arc::clone(health.0), Arc::clone(health.1));
    let mut tasks = JoinSet::new();
    tasks.spawn(beat(heartbeat));
    tasks.spawn(watch_space(
        blobs.clone(),
        Arc::clone(&store),
        Arc::clone(metrics),
    ));
    tasks.spawn(probe(store, Arc::clone(metrics)));
    tasks.spawn(listen(Arc::clone(metrics), events.0, events.1));
    tasks.spawn(look(devices.to_vec(), Arc::clone(metrics)));
    tasks.spawn(clean(Arc::clone(queue), blobs.clone()));
    tasks
}

/// Counts queue events in the metrics, and rings for the outbox where one may have filled it.
async fn listen(
    metrics: Arc<Metrics>,
    mut heard: mpsc::UnboundedReceiver<Event>,
    bell: Arc<Notify>,
) {
    while let Some(event) = heard.recv().await {
        metrics.observe(&event);
        let rings = match &event {
            Event::Deleted(_) => true,
            Event::Ended(job) => job.webhook.is_some() || job.delivery.is_some(),
            _ => false,
        };
        if rings {
            bell.notify_one();
        }
    }
}

/// Heartbeat of the async runtime, for the liveness check.
async fn beat(heartbeat: Arc<Heartbeat>) {
    let mut ticks = interval(HEARTBEAT);
    loop {
        ticks.tick().await;
        heartbeat.beat();
    }
}

/// Tells the service whether the server is ready.
pub(super) async fn follow_readiness(readiness: Readiness, service: Arc<Service>) {
    let mut ticks = interval(READINESS_INTERVAL);
    loop {
        ticks.tick().await;
        service.set_ready(readiness.not_ready_reason().is_none());
    }
}

/// Tells the other nodes what this one can do, and learns what they can.
pub(super) async fn exchange(queue: Arc<dyn Queue>, cost: Arc<CostModel>) {
    let mut ticks = interval(EXCHANGE_INTERVAL);
    loop {
        ticks.tick().await;
        match queue.nodes(capacities(&cost)).await {
            Ok(nodes) => cost.set_others(others(&nodes)),
            Err(error) => tracing::debug!(%error, "the other nodes are not heard"),
        }
    }
}

/// Polls the free disk space. A hanging disk delays only this task.
async fn watch_space(blobs: Blobs, store: Arc<StoreProbe>, metrics: Arc<Metrics>) {
    let mut ticks = interval(HEARTBEAT);
    loop {
        ticks.tick().await;
        let blobs = blobs.clone();
        if let Ok(Some(free)) = tokio::task::spawn_blocking(move || blobs.free_space()).await {
            store.health().has_free(free);
            metrics.free_space(free);
        }
    }
}

/// Probes the store for as long as the server runs.
async fn probe(store: Arc<StoreProbe>, metrics: Arc<Metrics>) {
    let mut pause = FIRST_PROBE;
    let mut worked_since = Instant::now();
    let mut worked = true;
    loop {
        let works = store.ask().await;
        metrics.store(works);
        if works && !worked {
            worked_since = Instant::now();
        }
        worked = works;
        if works {
            tokio::select! {
                () = tokio::time::sleep(PROBE) => continue,
                () = store.health().until_it_fails() => {
                    metrics.store(false);
                    worked = false;
                }
            }
        }
        if worked_since.elapsed() > LAST_PROBE {
            pause = FIRST_PROBE;
        }
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(LAST_PROBE);
    }
}

/// Polls the devices and updates their metrics.
async fn look(devices: Vec<Device>, metrics: Arc<Metrics>) {
    let mut ticks = interval(PROBE_INTERVAL);
    let mut before: Vec<Duration> = devices.iter().map(Device::busy_time).collect();
    let mut then = Instant::now();
    loop {
        ticks.tick().await;
        let passed = then.elapsed().as_secs_f64().max(1e-3);
        then = Instant::now();
        for (device, before) in devices.iter().zip(&mut before) {
            device.look();
            let busy = device.busy_time();
            let lanes = device.lanes().len() as f64;
            let ratio = busy.saturating_sub(*before).as_secs_f64() / passed / lanes;
            *before = busy;
            metrics.device(
                device.name(),
                device.not_ready_reason().is_none(),
                ratio.min(1.0),
            );
        }
    }
}

/// Removes orphaned payloads. A crash interrupted their upload, so their job was never accepted.
async fn clean(queue: Arc<dyn Queue>, blobs: Blobs) {
    let mut ticks = interval_at(tokio::time::Instant::now() + FIRST_SCAN, ORPHANS);
    loop {
        ticks.tick().await;
        match blobs.remove_cut_off(ORPHANS).await {
            Ok(0) => {}
            Ok(files) => tracing::info!(files, "what writes that were cut off had left is removed"),
            Err(error) => tracing::warn!(%error, "payloads cannot be listed"),
        }
        let found = match blobs.jobs_older_than(ORPHANS).await {
            Ok(found) => found,
            Err(error) => {
                tracing::warn!(%error, "payloads cannot be listed");
                continue;
            }
        };
        let mut orphans = Vec::new();
        for ids in found.chunks(256) {
            let Ok(known) = queue.known(ids.to_vec()).await else {
                continue;
            };
            orphans.extend(ids.iter().copied().filter(|id| !known.contains(id)));
        }
        if orphans.len() > MOST_ORPHANS {
            tracing::warn!(
                jobs = orphans.len(),
                "the queue knows nothing of many payloads: they are removed bit by bit"
            );
            orphans.sort_unstable();
            orphans.truncate(MOST_ORPHANS);
        }
        for id in &orphans {
            if let Err(error) = blobs.remove_job(*id).await {
                tracing::warn!(%error, job = %id, "an orphan was not removed");
            }
        }
        if !orphans.is_empty() {
            tracing::info!(
                jobs = orphans.len(),
                "payloads whose jobs were never accepted are removed"
            );
        }
    }
}
