//! A result that is kept until its reader has come to it.

use std::sync::Arc;
use std::time::Duration;

use tokio::task::AbortHandle;

use crate::job::JobId;
use crate::queue::{Queue, QueueError};

/// Time until the job is looked at first. Most results have been read by then.
const FIRST_PAUSE: Duration = Duration::from_millis(300);

/// Pause after an error of the store.
const ERROR_PAUSE: Duration = Duration::from_secs(1);

/// Keeps the result of an ephemeral job past its retention. Dropping it begins the retention.
#[derive(Debug)]
pub(super) struct KeptResult(AbortHandle);

impl KeptResult {
    /// Keeps the result of the job `id`, which may not have ended yet.
    pub(super) fn of(queue: &Arc<dyn Queue>, id: JobId) -> Self {
        let queue = Arc::clone(queue);
        let keeping = async move {
            let mut pause = FIRST_PAUSE;
            loop {
                tokio::time::sleep(pause).await;
                pause = match queue.keep(id).await {
                    Ok(retention) => retention / 2,
                    Err(QueueError::NotFound | QueueError::Closed) => return,
                    Err(_) => ERROR_PAUSE,
                };
            }
        };
        Self(tokio::spawn(keeping).abort_handle())
    }
}

impl Drop for KeptResult {
    fn drop(&mut self) {
        self.0.abort();
    }
}
