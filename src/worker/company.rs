//! Who is at work in a process, so that a job that may have killed it, or a device, can be alone.
//!
//! Workers come in before they lease and leave when their job is done. Who wants to be alone closes
//! the door: nobody comes in any more, and who holds no job yet leaves, so that whatever dies then
//! takes one job along. It must not know jobs or devices.

use std::sync::Arc;

use tokio::sync::watch;

/// The workers of one process.
#[derive(Debug, Default)]
pub struct Company(watch::Sender<State>);

#[derive(Clone, Copy, Debug, Default)]
struct State {
    inside: usize,
    closed: bool,
}

/// A worker's place among those at work, as long as it is held.
#[derive(Debug)]
pub(super) struct Inside {
    company: Arc<Company>,
    /// Whether it is this one who has closed the door.
    closes: bool,
}

impl Company {
    /// Waits for an open door, and comes in.
    pub(super) async fn enter(self: &Arc<Self>) -> Inside {
        let mut state = self.0.subscribe();
        loop {
            let is_in = self.0.send_if_modified(|state| {
                state.inside += usize::from(!state.closed);
                !state.closed
            });
            if is_in {
                return Inside {
                    company: Arc::clone(self),
                    closes: false,
                };
            }
            // The sender is here: it cannot be gone.
            let _open = state.wait_for(|state| !state.closed).await;
        }
    }
}

impl Inside {
    /// Comes back when somebody has closed the door: who holds no job should leave.
    pub(super) async fn is_to_leave(&self) {
        let mut state = self.company.0.subscribe();
        let _closed = state.wait_for(|state| state.closed).await;
    }

    /// Closes the door; false where somebody else has.
    pub(super) fn close(&mut self) -> bool {
        self.closes = self.company.0.send_if_modified(|state| {
            let is_open = !state.closed;
            state.closed = true;
            is_open
        });
        self.closes
    }

    /// Opens the door again that this one has closed.
    pub(super) fn open(&mut self) {
        if std::mem::take(&mut self.closes) {
            self.company.0.send_modify(|state| state.closed = false);
        }
    }

    /// Comes back when nobody else is inside.
    pub(super) async fn is_alone(&self) {
        let mut state = self.company.0.subscribe();
        let _alone = state.wait_for(|state| state.inside == 1).await;
    }
}

impl Drop for Inside {
    fn drop(&mut self) {
        self.open();
        self.company.0.send_modify(|state| state.inside -= 1);
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
        let company = Arc::new(Company::default());
        let (mut first, second) = (company.enter().await, company.enter().await);
        assert!(timeout(A_WHILE, second.is_to_leave()).await.is_err());
        assert!(first.close());
        second.is_to_leave().await;
        assert!(timeout(A_WHILE, first.is_alone()).await.is_err());
        assert!(timeout(A_WHILE, company.enter()).await.is_err());
        drop(second);
        first.is_alone().await;
        assert!(timeout(A_WHILE, company.enter()).await.is_err());
        drop(first);
        company.enter().await.is_alone().await;
    }

    #[tokio::test]
    async fn only_one_closes_the_door_and_only_that_one_opens_it() {
        let company = Arc::new(Company::default());
        let (mut first, mut second) = (company.enter().await, company.enter().await);
        assert!(first.close() && !second.close());
        second.open();
        drop(second);
        assert!(timeout(A_WHILE, company.enter()).await.is_err());
        first.open();
        drop(company.enter().await);
        first.is_alone().await;
    }
}
