//! Isolation of suspect jobs, which may have crashed the process or a device.
//!
//! Workers enter before they lease and leave when their job is done. A worker with a suspect job
//! closes the gate: no other worker enters, and workers without a job leave. A crash then affects
//! only that job. Independent of jobs and devices.

use std::sync::Arc;

use tokio::sync::watch;

/// A shared-exclusive lock of all workers of a process. A worker holds it shared while it leases
/// and runs a job. A worker whose job is suspect (more than one crash) takes it exclusively, so
/// that a further crash affects no other job. After 30 s of waiting the suspect job runs beside the
/// others. A second suspect job goes back to the queue while the first one waits or runs alone.
#[derive(Debug, Default)]
pub struct IsolationLock(watch::Sender<State>);

#[derive(Clone, Copy, Debug, Default)]
struct State {
    inside: usize,
    closed: bool,
}

/// A worker's admission through the gate; dropping it leaves.
#[derive(Debug)]
pub(super) struct IsolationGuard {
    isolation: Arc<IsolationLock>,
    /// Whether this worker has closed the gate.
    closes: bool,
}

impl IsolationLock {
    /// Waits until the gate is open, and enters.
    pub(super) async fn enter(self: &Arc<Self>) -> IsolationGuard {
        let mut state = self.0.subscribe();
        loop {
            let is_in = self.0.send_if_modified(|state| {
                state.inside += usize::from(!state.closed);
                !state.closed
            });
            if is_in {
                return IsolationGuard {
                    isolation: Arc::clone(self),
                    closes: false,
                };
            }
            // `self` holds the sender, so the channel cannot be closed.
            let _open = state.wait_for(|state| !state.closed).await;
        }
    }
}

impl IsolationGuard {
    /// Returns when the gate is closed. A worker without a job should leave then.
    pub(super) async fn is_to_leave(&self) {
        let mut state = self.isolation.0.subscribe();
        let _closed = state.wait_for(|state| state.closed).await;
    }

    /// Closes the gate; false if another worker has closed it.
    pub(super) fn close(&mut self) -> bool {
        self.closes = self.isolation.0.send_if_modified(|state| {
            let is_open = !state.closed;
            state.closed = true;
            is_open
        });
        self.closes
    }

    /// Reopens the gate, if this worker has closed it.
    pub(super) fn open(&mut self) {
        if std::mem::take(&mut self.closes) {
            self.isolation.0.send_modify(|state| state.closed = false);
        }
    }

    /// Returns when no other worker is inside.
    pub(super) async fn is_alone(&self) {
        let mut state = self.isolation.0.subscribe();
        let _alone = state.wait_for(|state| state.inside == 1).await;
    }
}

impl Drop for IsolationGuard {
    fn drop(&mut self) {
        self.open();
        self.isolation.0.send_modify(|state| state.inside -= 1);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::time::timeout;

    use super::*;

    const A_WHILE: Duration = Duration::from_millis(30);

    #[tokio::test]
    async fn one_who_wants_to_be_alone_waits_for_those_inside_and_lets_nobody_in() {
        let isolation = Arc::new(IsolationLock::default());
        let (mut first, second) = (isolation.enter().await, isolation.enter().await);
        assert!(timeout(A_WHILE, second.is_to_leave()).await.is_err());
        assert!(first.close());
        second.is_to_leave().await;
        assert!(timeout(A_WHILE, first.is_alone()).await.is_err());
        assert!(timeout(A_WHILE, isolation.enter()).await.is_err());
        drop(second);
        first.is_alone().await;
        assert!(timeout(A_WHILE, isolation.enter()).await.is_err());
        drop(first);
        isolation.enter().await.is_alone().await;
    }

    #[tokio::test]
    async fn only_one_closes_the_door_and_only_that_one_opens_it() {
        let isolation = Arc::new(IsolationLock::default());
        let (mut first, mut second) = (isolation.enter().await, isolation.enter().await);
        assert!(first.close() && !second.close());
        second.open();
        drop(second);
        assert!(timeout(A_WHILE, isolation.enter()).await.is_err());
        first.open();
        drop(isolation.enter().await);
        first.is_alone().await;
    }
}
