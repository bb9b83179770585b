//! The stores of a server: the queue and the payloads, which must belong together.

use std::sync::Arc;

use anyhow::{Context, anyhow};
use tokio::sync::mpsc;

use super::settings::{postgres_options, queue_options};
use crate::config::Config;
use crate::cost::Lanes;
use crate::health::StoreHealth;
use crate::job::DeviceKind;
use crate::queue::{Event, Queue, open_postgres, open_sqlite};
use crate::storage::Blobs;
use crate::worker::StoreProbe;

/// The queue, the payloads, and their health.
pub(super) struct Stores {
    pub(super) queue: Arc<dyn Queue>,
    pub(super) blobs: Blobs,
    pub(super) health: Arc<StoreHealth>,
    pub(super) probe: Arc<StoreProbe>,
}

impl Stores {
    /// Opens them and checks that they belong together. Returns the queue's events, too.
    pub(super) async fn open(
        config: &Config,
    ) -> anyhow::Result<(Self, mpsc::UnboundedReceiver<Event>)> {
        let blobs = match &config.storage {
            Some(url) => Blobs::open_bucket(url).context("storage")?,
            None => Blobs::open(&config.data_dir.join("blobs"))
                .with_context(|| format!("cannot use {}", config.data_dir.display()))?,
        };
        let is_empty = blobs.is_empty().await;
        let is_empty = is_empty.with_context(|| format!("cannot use {}", blobs.location()))?;
        let (queue, heard) = open_queue(config, is_empty).await?;
        check_identity(queue.as_ref(), &blobs, is_empty).await?;
        let health = Arc::new(StoreHealth::default());
        if let Some(free) = blobs.free_space() {
            health.has_free(free);
        }
        let probe = StoreProbe::new(Arc::clone(&queue), blobs.clone(), Arc::clone(&health));
        let stores = Self {
            queue,
            blobs,
            health,
            probe: Arc::new(probe),
        };
        Ok((stores, heard))
    }
}

/// Opens the queue in the database of all nodes, or in the data folder.
async fn open_queue(
    config: &Config,
    has_no_payloads: bool,
) -> anyhow::Result<(Arc<dyn Queue>, mpsc::UnboundedReceiver<Event>)> {
    let (events, heard) = mpsc::unbounded_channel();
    let options = queue_options(&config.queue);
    let queue = match postgres_options(config) {
        Some(target) => open_postgres(&target, options, events)
            .await
            .context("cannot open the queue in the database of queue.postgres")?,
        None => {
            check_queue_is_there(config, has_no_payloads)?;
            open_sqlite(&config.data_dir, options, events).with_context(|| {
                format!("cannot open the queue in {}", config.data_dir.display())
            })?
        }
    };
    Ok((queue, heard))
}

/// Refuses to make a new queue where payloads of an older one lie: its file was lost or moved, and
/// all that it promised would be taken for rubbish.
fn check_queue_is_there(config: &Config, has_no_payloads: bool) -> anyhow::Result<()> {
    let file = config.data_dir.join("queue.sqlite3");
    if file.exists() || has_no_payloads {
        return Ok(());
    }
    Err(anyhow!(
        "{} is missing, but payloads of its jobs lie in {}: put it back, or name another data_dir",
        file.display(),
        config.data_dir.join("blobs").display()
    ))
}

/// Refuses payloads that are not the queue's: those of another one, or an empty folder where a
/// volume should be. A queue and a store that are both new are made for each other.
async fn check_identity(queue: &dyn Queue, blobs: &Blobs, may_be_new: bool) -> anyhow::Result<()> {
    let location = blobs.location();
    let found = blobs.identity().await;
    let found = found.with_context(|| format!("cannot use {location}"))?;
    match found {
        Some(identity) if identity == queue.identity() => Ok(()),
        None if may_be_new && queue.is_empty().await? => {
            Ok(blobs.set_identity(queue.identity()).await?)
        }
        _ => Err(anyhow!(
            "the payloads in {location} are not those of the queue's jobs: is their volume mounted? \
             put them back, or name another data_dir or storage"
        )),
    }
}

/// Jobs of an earlier start may wait for a kind of device that this one does not have: they would
/// do so in silence until their time is over.
pub(super) fn warn_of_stranded_jobs(queue: &dyn Queue, lanes: Lanes) {
    let backlog = queue.backlog();
    for kind in DeviceKind::ALL {
        let jobs = backlog.queued_only_for(kind).jobs;
        if lanes.of(kind) == 0 && jobs > 0 {
            tracing::warn!(
                jobs,
                needs = kind.name(),
                "jobs wait for a kind of device that this server does not have: start it with one, \
                 or cancel them"
            );
        }
    }
}
