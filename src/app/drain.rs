//! How the server stops: not ready, no new work, what runs is finished or put down, streams end,
//! and all of it within a deadline.

use std::time::Duration;

use tokio::task::JoinSet;
use tokio::time::{Instant, timeout_at};

use super::App;

/// Time before the deadline at which what still runs is put down.
const TO_PUT_DOWN: Duration = Duration::from_secs(2);

/// Time that connections have to take what is being sent to them, once streams are closed.
const TO_CLOSE: Duration = Duration::from_secs(1);

impl App {
    /// Stops; returns when nothing is left or the deadline has passed.
    pub async fn drain(mut self) {
        let began = Instant::now();
        let deadline = began + Duration::from_secs(self.config.drain.deadline_seconds);
        self.draining.send_replace(true);
        self.service.leave();
        tracing::info!("not ready any more");
        tokio::time::sleep(Duration::from_secs(self.config.drain.delay_seconds)).await;

        self.service.stop_accepting();
        self.workers_drain.stop.cancel();
        let to_finish = deadline - TO_PUT_DOWN.min(deadline - Instant::now()) - TO_CLOSE;
        if timeout_at(to_finish, all(&mut self.workers)).await.is_err() {
            tracing::info!("what still runs is put down, to go on later");
            self.workers_drain.release.cancel();
            if timeout_at(deadline - TO_CLOSE, all(&mut self.workers))
                .await
                .is_err()
            {
                tracing::warn!("a job did not stop in time; its lease ends with the process");
            }
        }
        self.service.close_streams();
        self.stop_listening.cancel();
        let closing = deadline.min(Instant::now() + TO_CLOSE);
        // One that has ended by itself must not be asked again.
        if !self.listener.is_finished() && timeout_at(closing, &mut self.listener).await.is_err() {
            tracing::debug!("some connections were still open");
            self.listener.abort();
        }
        self.upkeep.shutdown().await;
        self.queue.stopped();
        tracing::info!(seconds = began.elapsed().as_secs_f64(), "stopped");
    }
}

async fn all(workers: &mut JoinSet<()>) {
    while workers.join_next().await.is_some() {}
}
