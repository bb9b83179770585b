//! Graceful shutdown within `shutdown.timeout_seconds`: report not ready, accept no new work,
//! finish or interrupt running jobs, then close streams and connections.

use std::time::Duration;

use tokio::task::JoinSet;
use tokio::time::{Instant, timeout_at};

use super::start::App;

/// Time reserved for interrupting the jobs that still run, before the connections are closed.
const TO_PUT_DOWN: Duration = Duration::from_secs(2);

/// Time for connections to flush their responses after streams are closed.
const TO_CLOSE: Duration = Duration::from_secs(1);

impl App {
    /// Stops the server. The deadline is `shutdown.timeout_seconds` after the call. The steps are:
    ///
    /// 1. The server reports that it is not ready. It accepts work for
    ///    `shutdown.readiness_delay_seconds` more.
    /// 2. New work is refused, and no job is leased. Running jobs go on until 3 s before the
    ///    deadline.
    /// 3. Jobs that still run are interrupted and queued again, a fit with a snapshot. They have
    ///    until 1 s before the deadline. An object search is not interrupted, nor is a fit that its
    ///    deadline has shortened. A durable job that does not stop in time is queued again at the
    ///    next start.
    /// 4. Where the queue is PostgreSQL, calls may wait for jobs on other nodes until 3 s before the
    ///    deadline.
    /// 5. Event streams and long polls end, and the listener closes. Open connections have 1 s to
    ///    send their responses, but not beyond the deadline.
    /// 6. Background tasks end, and the queue records the graceful shutdown, within 1 s after the
    ///    deadline.
    ///
    /// Steps 2 to 5 end early when nothing is left to wait for. The admin port answers until the
    /// process ends.
    pub async fn drain(mut self) {
        let began = Instant::now();
        let deadline = began + Duration::from_secs(self.config.shutdown.timeout_seconds);
        self.draining.send_replace(true);
        self.service.set_ready(false);
        tracing::info!("not ready any more");
        tokio::time::sleep(Duration::from_secs(
            self.config.shutdown.readiness_delay_seconds,
        ))
        .await;

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
        if self.config.queue.postgres.is_some() {
            let answered = self.service.calls_are_answered();
            if timeout_at(to_finish, answered).await.is_err() {
                tracing::info!("calls whose jobs are not done in time end without them");
            }
        }
        self.service.close_streams();
        self.stop_listening.cancel();
        let closing = deadline.min(Instant::now() + TO_CLOSE);
        // A task that has finished must not be polled again.
        if !self.listener.is_finished() && timeout_at(closing, &mut self.listener).await.is_err() {
            tracing::debug!("some connections were still open");
            self.listener.abort();
        }
        self.upkeep.shutdown().await;
        let last = deadline.max(Instant::now()) + TO_CLOSE;
        if timeout_at(last, self.queue.stopped()).await.is_err() {
            tracing::warn!("the queue did not record the shutdown");
        }
        tracing::info!(seconds = began.elapsed().as_secs_f64(), "stopped");
    }
}

async fn all(workers: &mut JoinSet<()>) {
    while workers.join_next().await.is_some() {}
}
