//! The engine of the simulation: the writer of SQLite without its thread.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::watch::Receiver;

use crate::job::{Job, JobId};
use crate::queue::database::{Engine, Kept};
use crate::queue::effects::Effects;
use crate::queue::lease::HeartbeatStore;
use crate::queue::local::Local;
use crate::queue::node::{Capacities, Node};
use crate::queue::sql::Sql;
use crate::queue::sqlite::engine::watch;
use crate::queue::sqlite::heartbeat::SqliteHeartbeat;
use crate::queue::sqlite::statements::SqliteSql;
use crate::queue::sqlite::writer::{Turns, Writer};
use crate::queue::types::{QueueError, QueueOptions};
use crate::sync::locked;

/// Changes go to the inbox of the writer, whose turns the simulation takes.
pub(super) struct SimulatedEngine {
    pub(super) writer: Writer,
    pub(super) turns: Arc<Mutex<Turns>>,
    pub(super) local: Arc<Local>,
    pub(super) options: QueueOptions,
}

#[async_trait]
impl Engine for SimulatedEngine {
    const NAME: &'static str = "sqlite";

    fn local(&self) -> &Arc<Local> {
        &self.local
    }

    async fn write<T, C>(&self, kept: Kept, change: C) -> Result<T, QueueError>
    where
        T: Send + 'static,
        C: Fn(&dyn Sql, &mut Effects) -> Result<T, QueueError> + Send + 'static,
    {
        self.writer.write(kept == Kept::Durably, change).await
    }

    async fn read<T, C>(&self, query: C) -> Result<T, QueueError>
    where
        T: Send + 'static,
        C: Fn(&dyn Sql) -> Result<T, QueueError> + Send + 'static,
    {
        query(&SqliteSql(locked(&self.turns).connection()))
    }

    async fn watch(&self, id: JobId) -> Result<Receiver<Arc<Job>>, QueueError> {
        watch(&self.writer, &self.local, id).await
    }

    fn heartbeat(&self, job: &Job) -> Arc<dyn HeartbeatStore> {
        Arc::new(SqliteHeartbeat::new(
            job,
            &self.writer,
            &self.local,
            &self.options,
        ))
    }

    fn poll_interval(&self) -> Option<Duration> {
        None
    }

    fn check(&self) -> Result<(), QueueError> {
        Ok(())
    }

    async fn nodes(&self, _: Capacities) -> Result<Vec<Node>, QueueError> {
        Ok(Vec::new())
    }

    async fn stopped(&self) {}

    fn identity(&self) -> i32 {
        1
    }
}
