//! The store probe, run periodically by housekeeping and by a worker whose job hit a storage
//! failure.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Mutex;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use crate::health::StoreHealth;
use crate::queue::Queue;
use crate::storage::Blobs;

/// Timeout of a probe.
const PATIENCE: Duration = Duration::from_secs(10);

/// Probes the queue and the blob store, and records the result in their [`StoreHealth`].
pub struct StoreProbe {
    queue: Arc<dyn Queue>,
    blobs: Blobs,
    health: Arc<StoreHealth>,
    /// A probe that has not returned yet: a hanging disk is not probed twice.
    asking: Mutex<Option<JoinHandle<Result<(), String>>>>,
}

impl StoreProbe {
    /// Creates a probe of `queue` and `blobs`; its results go into `health`.
    pub fn new(queue: Arc<dyn Queue>, blobs: Blobs, health: Arc<StoreHealth>) -> Self {
        Self {
            queue,
            blobs,
            health,
            asking: Mutex::default(),
        }
    }

    /// The health record that the probe updates.
    pub fn health(&self) -> &Arc<StoreHealth> {
        &self.health
    }

    /// Writes and reads the blob store and the queue, and returns whether both work.
    ///
    /// Calls run one after the other, each for at most 10 s. A probe that takes longer counts as a
    /// failure. It goes on in the background, and the next call waits for it instead of a new one.
    pub async fn ask(&self) -> bool {
        let mut asking = self.asking.lock().await;
        let handle = asking.get_or_insert_with(|| {
            let (queue, blobs) = (Arc::clone(&self.queue), self.blobs.clone());
            let needed = self.health.needed();
            tokio::spawn(async move {
                let asked = blobs.probe(queue.identity(), needed).await;
                asked.map_err(|error| error.to_string())?;
                queue.probe().await.map_err(|error| error.to_string())
            })
        });
        let found = match timeout(PATIENCE, handle).await {
            Err(_) => Err("it does not answer".to_owned()),
            Ok(answered) => {
                *asking = None;
                answered.unwrap_or_else(|error| Err(error.to_string()))
            }
        };
        match &found {
            Ok(()) => self.health.works(),
            Err(error) => self.health.failed(error),
        }
        found.is_ok()
    }
}
