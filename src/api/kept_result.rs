//! A result that is kept until its reader has come to it.

use std::sync::Arc;
use std::time::Duration;

use tokio::task::AbortHandle;

use super::service::{Service, Waited};
use crate::job::JobId;
use crate::queue::QueueError;

/// Time after its end in which most results are read. They need not be kept.
const SOON_READ: Duration = Duration::from_millis(300);

/// Pause after an error of the store.
const PAUSE: Duration = Duration::from_secs(1);

/// Keeps the result of an ephemeral job past its retention. Dropping it begins the retention.
#[derive(Debug)]
pub(super) struct KeptResult(AbortHandle);

impl KeptResult {
    /// Keeps the result of the job `id` from its end on.
    pub(super) fn of(service: &Arc<Service>, id: JobId) -> Self {
        let service = Arc::clone(service);
        Self(tokio::spawn(async move { keep(&service, id).await }).abort_handle())
    }
}

impl Drop for KeptResult {
    fn drop(&mut self) {
        self.0.abort();
    }
}

async fn keep(service: &Service, id: JobId) {
    if !matches!(service.wait(id, None).await, Ok(Waited::Ended(_))) {
        return;
    }
    tokio::time::sleep(SOON_READ).await;
    loop {
        match service.queue.keep(id).await {
            Ok(retention) => tokio::time::sleep(retention / 2).await,
            Err(QueueError::NotFound | QueueError::Closed) => return,
            Err(_) => tokio::time::sleep(PAUSE).await,
        }
    }
}
