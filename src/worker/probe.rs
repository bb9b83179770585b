//! Whether the store can be used: asked by upkeep again and again, and by a worker whose job it has
//! just failed.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Mutex;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use crate::health::StoreHealth;
use crate::queue::Queue;
use crate::storage::Blobs;

/// A store that takes longer than this does not answer.
const PATIENCE: Duration = Duration::from_secs(10);

/// Asks the queue and the payloads' store.
pub struct StoreProbe {
    queue: Arc<dyn Queue>,
    blobs: Blobs,
    health: Arc<StoreHealth>,
    /// One that has not come back yet: a disk that hangs is not asked twice.
    asking: Mutex<Option<JoinHandle<Result<(), String>>>>,
}

impl StoreProbe {
    /// A probe of both; what it finds goes into `health`.
    pub fn new(queue: Arc<dyn Queue>, blobs: Blobs, health: Arc<StoreHealth>) -> Self {
        Self {
            queue,
            blobs,
            health,
            asking: Mutex::default(),
        }
    }

    /// What it is told to.
    pub fn health(&self) -> &Arc<StoreHealth> {
        &self.health
    }

    /// Asks both, and says whether they work.
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
