//! The engine on PostgreSQL.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::{mpsc, oneshot, watch};

use super::bell::Changes;
use super::heartbeat::PostgresHeartbeat;
use super::nodes;
use super::pool::{Pool, spawn};
use super::presence::Presence;
use super::schema;
use super::session::{Call, Flush, Session};
use super::shared::Shared;
use super::target::{PostgresOptions, Target};
use super::this_node::ThisNode;
use super::upkeep::Upkeep;
use crate::job::{Job, JobId};
use crate::queue::database::{DatabaseQueue, Engine, Kept};
use crate::queue::effects::Effects;
use crate::queue::interface::Queue;
use crate::queue::lease::HeartbeatStore;
use crate::queue::local::Local;
use crate::queue::migration::Migration;
use crate::queue::node::{Capacities, Node};
use crate::queue::sql::{Sql, values};
use crate::queue::transitions;
use crate::queue::types::{Event, QueueError, QueueOptions};

/// Interval at which idle workers look for a job, if no notification wakes them.
const POLL_INTERVAL: Duration = Duration::from_secs(1);

/// Opens the queue in a PostgreSQL database, as one of its nodes. The tables are created in an empty
/// database. `events` receives the events of the changes that this node makes. The async methods of
/// the queue need a tokio runtime.
///
/// Every change, leases included, is on the database's disk before it is acknowledged; heartbeats
/// are not. A change waits up to 10 s for a database that is away, so that a restart of it is not
/// seen. Jobs of nodes that have ended are recovered within 2 s, as [`open_sqlite`] recovers those
/// of the process before. In the first 8 s of the database or of its connection to it a node recovers
/// none, unless it is the only one. A node that is stopped but not ended loses its jobs when their
/// leases expire.
///
/// [`open_sqlite`]: crate::queue::open_sqlite
///
/// # Errors
/// [`QueueError::Store`] if a URL cannot be read, the database cannot be reached or used, it has
/// other tables or another schema version, or a thread cannot be started.
pub async fn open_postgres(
    target: &PostgresOptions,
    options: QueueOptions,
    events: mpsc::UnboundedSender<Event>,
) -> Result<Arc<dyn Queue>, QueueError> {
    let (target, own) = (target.clone(), options.clone());
    let engine = apart(move || PostgresEngine::open(&target, own, events)).await?;
    Ok(Arc::new(DatabaseQueue::new(engine, options)))
}

/// Creates the tables of the queue in an empty database, or upgrades those of an older version. Nodes may
/// run meanwhile.
///
/// # Errors
/// As [`open_postgres`].
pub async fn migrate_postgres(target: &PostgresOptions) -> Result<Migration, QueueError> {
    let url = target
        .direct_url
        .as_deref()
        .unwrap_or(&target.url)
        .to_owned();
    let migrating = move || {
        let mut session = Session::new(Target::of(&url)?, Arc::new(ThisNode::new()), 0);
        Ok(schema::prepare(&mut session)?.migration)
    };
    apart(migrating).await
}

/// Runs work on a thread of its own: a connection blocks, which the threads of the runtime must not.
async fn apart<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, QueueError> + Send + 'static,
) -> Result<T, QueueError> {
    let (answer, done) = oneshot::channel();
    let working = move || {
        let _gone_is_fine = answer.send(work());
    };
    thread::Builder::new()
        .name("queue-open".to_owned())
        .spawn(working)
        .map_err(|error| QueueError::Store(error.to_string()))?;
    done.await.map_err(|_| QueueError::Closed)?
}

/// A node of a queue in a PostgreSQL database.
struct PostgresEngine {
    shared: Arc<Shared>,
    pool: Pool,
    identity: i32,
}

impl PostgresEngine {
    fn open(
        options: &PostgresOptions,
        queue: QueueOptions,
        events: mpsc::UnboundedSender<Event>,
    ) -> Result<Self, QueueError> {
        let target = Target::of(&options.url)?;
        let direct = options.direct_url.as_deref().unwrap_or(&options.url);
        let me = Arc::new(ThisNode::new());
        let session = |target: &Target, place| Session::new(target.clone(), Arc::clone(&me), place);
        let mut own = session(&Target::of(direct)?, 0);
        let identity = schema::prepare(&mut own)?.identity;
        let local = Arc::new(Local::new(events));
        let shared = Arc::new(Shared::new(local, queue, &options.name, &me));
        let mut presence = Presence::new(Arc::clone(&shared), own);
        presence.open()?;
        let upkeep = Upkeep::new(Arc::clone(&shared), session(&target, 1));
        let connections = i64::try_from(options.connections.max(1)).unwrap_or(1);
        let sessions = (0..connections).map(|place| session(&target, 2 + place));
        let ended = &shared.local.ended;
        let pool = Pool::start(sessions.collect(), ended)?;
        spawn("queue-upkeep", ended, move || upkeep.run())?;
        spawn("queue-presence", ended, move || presence.run())?;
        Ok(Self {
            shared,
            pool,
            identity,
        })
    }
}

impl Drop for PostgresEngine {
    fn drop(&mut self) {
        self.shared.stop();
    }
}

#[async_trait]
impl Engine for PostgresEngine {
    const NAME: &'static str = "postgres";

    fn local(&self) -> &Arc<Local> {
        &self.shared.local
    }

    async fn write<T, C>(&self, kept: Kept, change: C) -> Result<T, QueueError>
    where
        T: Send + 'static,
        C: Fn(&dyn Sql, &mut Effects) -> Result<T, QueueError> + Send + 'static,
    {
        // A crash of the database does not end the workers. If it forgot a claim, the next one would
        // get the same attempt number, and two workers would hold the job.
        let flush = match kept {
            Kept::Durably => Flush::Always,
            Kept::Soon => Flush::IfWritten,
        };
        let shared = Arc::clone(&self.shared);
        let work = move |session: &mut Session, call: Call<'_>| {
            shared.change(session, flush, call, change)
        };
        self.pool.run(work).await
    }

    async fn read<T, C>(&self, query: C) -> Result<T, QueueError>
    where
        T: Send + 'static,
        C: Fn(&dyn Sql) -> Result<T, QueueError> + Send + 'static,
    {
        let work = move |session: &mut Session, call: Call<'_>| session.read(call.at, query);
        self.pool.run(work).await
    }

    async fn watch(&self, id: JobId) -> Result<watch::Receiver<Arc<Job>>, QueueError> {
        let job = self.read(move |sql| transitions::get(sql, id)).await?;
        let followed = self.shared.local.watchers.follow(&Arc::new(job));
        // A change may have fallen between the query and the subscription.
        let again = Changes {
            jobs: [id].into(),
            ..Changes::default()
        };
        self.shared.bell.elsewhere(again);
        Ok(followed)
    }

    fn heartbeat(&self, job: &Job) -> Arc<dyn HeartbeatStore> {
        Arc::new(PostgresHeartbeat {
            id: job.id,
            attempt: job.attempt,
            shared: Arc::clone(&self.shared),
        })
    }

    fn has_note_of_snapshot(&self, id: JobId, attempt: u32) -> bool {
        self.shared.beats.has_note_of_snapshot(id, attempt)
    }

    fn poll_interval(&self) -> Option<Duration> {
        Some(POLL_INTERVAL)
    }

    fn check(&self) -> Result<(), QueueError> {
        Ok(())
    }

    async fn nodes(&self, own: Capacities) -> Result<Vec<Node>, QueueError> {
        self.write(Kept::Soon, move |sql, _| nodes::exchange(sql, own))
            .await
    }

    async fn stopped(&self) {
        let node = self.shared.node();
        let change = move |sql: &dyn Sql, _: &mut Effects| {
            sql.query(
                "UPDATE nodes SET stopped = ?2 WHERE id = ?1",
                values![node, nodes::STOPPED],
            )
        };
        if let Err(error) = self.write(Kept::Durably, change).await {
            tracing::warn!(%error, "the other nodes will take this end for a crash");
        }
    }

    fn identity(&self) -> i32 {
        self.identity
    }
}
