//! Contract tests of the queue on PostgreSQL, and tests of several nodes.

use std::process::Command;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use tokio::sync::mpsc;

mod dead_nodes;
mod nodes;
mod same_answers;
mod upkeep;

use super::engine::{migrate_postgres, open_postgres};
use super::target::PostgresOptions;
use crate::job::{DeviceKind, JobId};
use crate::queue::contract_tests::{Stand, queue_contract, submission};
use crate::queue::interface::Queue;
use crate::queue::migration::Migration;
use crate::queue::sql::for_postgres;
use crate::queue::transitions::{expiry, fair_queue, leases, standing};
use crate::queue::types::{Event, Idempotency, QueueError, QueueOptions, Submission, Submitted};

#[path = "../../../../tests/common/postgres_server.rs"]
mod postgres_server;
use postgres_server::{PostgresServer, start_postgres};

/// Timeout, long enough for a loaded machine. Only a failing test waits this long.
const PATIENCE: Duration = Duration::from_secs(30);

/// Waits until something holds. `otherwise` is what is wrong if it never does.
async fn until(otherwise: &str, holds: impl AsyncFn() -> bool) {
    let began = Instant::now();
    while !holds().await {
        assert!(began.elapsed() < PATIENCE, "{otherwise}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// The server of all tests of this process that crash none, started by the first of them.
fn shared_postgres() -> Option<&'static PostgresServer> {
    static SERVER: OnceLock<Option<PostgresServer>> = OnceLock::new();
    SERVER.get_or_init(start_postgres).as_ref()
}

/// The server of all tests, or one that a test may crash.
#[derive(Clone)]
enum Server {
    Of(&'static PostgresServer),
    Own(Arc<PostgresServer>),
}

impl std::ops::Deref for Server {
    type Target = PostgresServer;

    fn deref(&self) -> &PostgresServer {
        match self {
            Self::Of(server) => server,
            Self::Own(server) => server,
        }
    }
}

/// A database in which the queue is opened repeatedly.
struct Database {
    server: Server,
    url: String,
}

impl Database {
    /// A new one; `None` without PostgreSQL.
    fn new() -> Option<Self> {
        Some(Self::on(Server::Of(shared_postgres()?)))
    }

    /// A new one on a server of its own, which the test may crash; `None` without PostgreSQL.
    fn alone() -> Option<Self> {
        Some(Self::on(Server::Own(Arc::new(start_postgres()?))))
    }

    fn on(server: Server) -> Self {
        let url = server.database();
        Self { server, url }
    }

    /// Opens the queue as one more node.
    async fn node(
        &self,
        name: &str,
        options: QueueOptions,
    ) -> (Arc<dyn Queue>, mpsc::UnboundedReceiver<Event>) {
        let (events, heard) = mpsc::unbounded_channel();
        let queue = open_postgres(&self.options(name), options, events).await;
        (queue.expect("a queue"), heard)
    }

    fn name(&self) -> &str {
        self.url.rsplit('=').next().expect("a name")
    }

    fn options(&self, name: &str) -> PostgresOptions {
        PostgresOptions {
            url: self.url.clone(),
            direct_url: None,
            connections: 3,
            name: name.to_owned(),
        }
    }

    /// Waits until no node is alive: a queue that was dropped closes its connections a little later.
    async fn is_left(&self) {
        let alive = "SELECT count(*) FROM pg_locks l JOIN pg_database d ON d.oid = l.database \
                     WHERE l.locktype = 'advisory' AND l.objsubid = 2 \
                     AND d.datname = current_database()";
        while self.server.sql(self.name(), alive) != "0" {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

impl Stand for Database {
    async fn open(
        &mut self,
        options: QueueOptions,
    ) -> (Arc<dyn Queue>, mpsc::UnboundedReceiver<Event>) {
        self.is_left().await;
        self.node("node", options).await
    }
}

queue_contract!(Database::new());

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn another_schema_or_program_is_refused_with_what_to_do() {
    let Some(database) = Database::new() else {
        return;
    };
    let refusal = async |database: &Database| {
        let (events, _) = mpsc::unbounded_channel();
        let options = database.options("node");
        let opened = open_postgres(&options, QueueOptions::default(), events).await;
        opened.err().expect("a refusal").to_string()
    };
    database
        .server
        .sql(database.name(), "CREATE TABLE jobs (other text)");
    let said = refusal(&database).await;
    assert!(said.contains("a database of its own"), "{said}");
    database.server.sql(database.name(), "DROP TABLE jobs");
    drop(database.node("first", QueueOptions::default()).await);
    database
        .server
        .sql(database.name(), "UPDATE meta SET version = 99");
    let said = refusal(&database).await;
    assert!(said.contains("schema version 99"), "{said}");
    let nobody = Database {
        server: database.server.clone(),
        url: "host=/nowhere user=secret password=hidden".to_owned(),
    };
    let said = refusal(&nobody).await;
    assert!(!said.contains("hidden"), "{said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_of_an_older_version_is_upgraded_and_keeps_its_jobs() {
    // What turns the tables into those of each older version.
    const SINCE_4: &str = "DROP INDEX jobs_open_due";
    const SINCE_3: &str =
        "DROP INDEX jobs_open_due; ALTER TABLE jobs DROP COLUMN result_uri, DROP COLUMN delivery";
    let since_2 = format!("{SINCE_3}, DROP COLUMN trace, DROP COLUMN webhook; DROP TABLE outbox");
    for (version, change) in [
        (4, SINCE_4.to_owned()),
        (3, format!("{SINCE_3}; DROP INDEX outbox_job")),
        (2, since_2),
    ] {
        let Some(database) = Database::new() else {
            return;
        };
        let (queue, heard) = database.node("first", QueueOptions::default()).await;
        let job = queue.submit(submission("a")).await.expect("a queue");
        drop((queue, heard));
        database.is_left().await;
        let run = |sql: &str| database.server.sql(database.name(), sql);
        let columns = "SELECT string_agg(table_name || column_name || data_type, ' ' \
                       ORDER BY table_name, ordinal_position) FROM information_schema.columns \
                       WHERE table_schema = 'public'";
        let indexes = "SELECT string_agg(indexname, ' ' ORDER BY indexname) FROM pg_indexes";
        let fresh = [columns, indexes].map(run);
        run(&format!("{change}; UPDATE meta SET version = {version}"));
        let migrated = migrate_postgres(&database.options("second")).await;
        let upgrade = Migration {
            from: version,
            to: 5,
        };
        assert_eq!(migrated, Ok(upgrade));
        // A column that is dropped keeps its number.
        assert_eq!([columns, indexes].map(run), fresh);
        assert_eq!(run("SELECT version FROM meta"), "5");
        let (queue, _heard) = database.node("second", QueueOptions::default()).await;
        let held = queue.lease("worker", DeviceKind::Cpu).await.expect("a job");
        let Submitted::New(job) = job else {
            unreachable!("it was new");
        };
        assert_eq!(held.job.id, job.id);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_fail_in_time_while_the_database_hangs_and_work_afterwards() {
    // What is stopped may hold locks of the whole server.
    let Some(database) = Database::alone() else {
        return;
    };
    let (queue, _heard) = database.node("one", QueueOptions::default()).await;
    let Ok(Submitted::New(job)) = queue.submit(submission("a")).await else {
        unreachable!("it is new");
    };
    // The machine of the database answers for its stopped processes: connections open and do not end.
    let pids = "SELECT split_part(pg_read_file('postmaster.pid'), E'\\n', 1) || ' ' || \
                string_agg(pid::text, ' ') FROM pg_stat_activity WHERE pid <> pg_backend_pid()";
    let pids = database.server.sql(database.name(), pids);
    let send = |signal: &str| {
        let sent = Command::new("kill")
            .arg(signal)
            .args(pids.split(' '))
            .status();
        assert!(sent.expect("kill runs").success(), "{pids}");
    };
    send("-STOP");
    let keyed = |id| Submission {
        id,
        idempotency: Some(Idempotency {
            key: "key".to_owned(),
            fingerprint: [1; 32],
        }),
        ..submission("a")
    };
    let (first, second) = (JobId::fresh(), JobId::fresh());
    let asked = queue.submit(keyed(first));
    let answer = tokio::time::timeout(Duration::from_secs(60), asked).await;
    send("-CONT");
    let refused = answer.expect("an answer while the database hangs");
    assert!(matches!(refused, Err(QueueError::Store(_))), "{refused:?}");
    let held = queue.lease("worker", DeviceKind::Cpu).await.expect("a job");
    assert_eq!(held.job.id, job.id);
    // Its caller has left: the database goes on with the change, and it is not committed.
    tokio::time::sleep(Duration::from_secs(2)).await;
    assert_eq!(queue.known(vec![first]).await, Ok(Vec::new()));
    let again = queue.submit(keyed(second)).await;
    assert!(matches!(again, Ok(Submitted::New(_))), "{again:?}");
}

#[tokio::test]
async fn the_statements_of_the_hot_path_use_their_indexes() {
    let Some(database) = Database::new() else {
        return;
    };
    let (_queue, _heard) = database.node("one", QueueOptions::default()).await;
    let run = |sql: &str| database.server.sql(database.name(), sql);
    run(
        "INSERT INTO jobs (id, tenant, kind, pair_index, pairs, pairs_left, priority, state, durable, \
         delayed, attempt, failures, crashes, delays, cost, virtual_start, virtual_finish, options, \
         created, expires, due, error_retryable, dead, cancel_requested, device, backward, after, \
         has_dependents, ready, closes, sees_from, sees_to, origin) \
         SELECT int8send(n), 't' || n % 10, 0, 0, 0, 0, n % 3, 0, 1, 0, 0, 0, 0, 0, 1, n, n + 1, '{}', \
         n, 9, 9, 0, 0, 0, n / 3 % 3, 0, int8send(n), 0, n, 0, 0, 2, 1 \
         FROM generate_series(1, 50000) AS n; ANALYZE jobs",
    );
    for (sql, index) in [
        (leases::FIRST_READY, "jobs_ready"),
        (fair_queue::FOLLOWERS, "jobs_after"),
        (fair_queue::FIRST_TAG, "jobs_ready"),
        (standing::HIGHER, "jobs_ready"),
        (standing::EARLIER, "jobs_ready"),
        (fair_queue::LAST_OF_TENANT, "jobs_tail"),
        (expiry::OLDEST, "jobs_age"),
        (expiry::NEXT_DUE, "jobs_due"),
        (expiry::DUE_OPEN, "jobs_open_due"),
        (expiry::DUE_ENDED, "jobs_due"),
    ] {
        let parameters = ["'t1'", "1"];
        let mut text = for_postgres(sql);
        let values = match index {
            "jobs_tail" => parameters,
            "jobs_after" => ["'\\x01'", "1"],
            _ => ["1", "1"],
        };
        for (place, value) in ["$1", "$2"].iter().zip(values) {
            text = text.replace(place, value);
        }
        for (place, value) in [("$3", "10000"), ("$4", "25000"), ("$5", "1")] {
            text = text.replace(place, value);
        }
        let plan = run(&format!("EXPLAIN {text}"));
        assert!(
            plan.contains(index) && !plan.contains("Sort"),
            "{text}: {plan}"
        );
        assert!(!plan.contains("Seq Scan"), "{text}: {plan}");
    }
}
