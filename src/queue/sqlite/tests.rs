//! Contract tests of the embedded queue, and tests of its query plans, lock and files.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rusqlite::{Connection, params};
use tokio::sync::mpsc;

use super::engine::{SqliteEngine, open_sqlite};
use super::schema;
use super::statements::SqliteSql;
use crate::job::{DeviceKind, State, Tenant};
use crate::queue::contract_tests::{Stand, queue_contract, submission};
use crate::queue::database::Engine;
use crate::queue::interface::Queue;
use crate::queue::lease::Signal;
use crate::queue::sql::for_sqlite;
use crate::queue::transitions::{expiry, fair_queue, leases, lists, outbox, standing};
use crate::queue::types::{Event, Filter, QueueError, QueueOptions};

/// A folder in which the queue is opened repeatedly.
struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a folder"))
    }
}

impl Stand for Folder {
    async fn open(
        &mut self,
        options: QueueOptions,
    ) -> (Arc<dyn Queue>, mpsc::UnboundedReceiver<Event>) {
        let (events, heard) = mpsc::unbounded_channel();
        // The previous queue may release its lock with a delay.
        let patience = Instant::now() + Duration::from_secs(10);
        loop {
            match open_sqlite(self.0.path(), options.clone(), events.clone()) {
                Ok(queue) => return (queue, heard),
                Err(error) => assert!(Instant::now() < patience, "{error}"),
            }
            std::thread::yield_now();
        }
    }
}

queue_contract!(Some(Folder::new()));

/// Rows in the table of the query plan test.
const BACKLOG: u32 = 20_000;

/// The query plan of a statement.
fn plan(connection: &Connection, sql: &str, parameters: usize) -> String {
    let mut statement = connection
        .prepare(&format!("EXPLAIN QUERY PLAN {}", for_sqlite(sql)))
        .expect("a good statement");
    let values = vec![0i64; parameters];
    let details = statement
        .query_map(rusqlite::params_from_iter(values), |row| {
            row.get::<_, String>(3)
        })
        .expect("a plan");
    let details: Vec<String> = details.collect::<rusqlite::Result<_>>().expect("a plan");
    details.join("; ")
}

#[test]
fn the_statements_of_the_hot_path_sort_nothing_and_scan_no_table() {
    let folder = Folder::new();
    let path = folder.0.path().join("queue.sqlite3");
    let connection = schema::open_writer(&path).expect("a file");
    connection.execute_batch("BEGIN").expect("a transaction");
    for row in 0..BACKLOG {
        connection
            .execute(
                "INSERT INTO jobs (id, tenant, kind, pair_index, pairs, pairs_left, priority, state, \
                 durable, delayed, attempt, failures, crashes, delays, cost, virtual_start, \
                 virtual_finish, options, created, expires, due, error_retryable, dead, \
                 cancel_requested, device, backward, after, has_dependents, ready, closes, \
                 sees_from, sees_to, origin) \
                 VALUES (?1, 't', 0, 0, 0, 0, ?2, 0, 1, 0, 0, 0, 0, 0, \
                 1.0, ?1, ?1 + 1, '{}', ?1, 9, 9, 0, 0, 0, ?3, 0, ?1, 0, ?1, 0, 0, 2, 0)",
                params![row, row % 3, row / 3 % 3],
            )
            .expect("a row");
    }
    connection
        .execute_batch("COMMIT; ANALYZE")
        .expect("a commit");
    let claim = plan(&connection, leases::FIRST_READY, 1);
    assert!(claim.contains("jobs_ready (device=?)"), "{claim}");
    for (sql, parameters) in [
        (leases::FIRST_READY, 1),
        (fair_queue::FOLLOWERS, 1),
        (fair_queue::FIRST_TAG, 2),
        (standing::HIGHER, 3),
        (standing::EARLIER, 5),
        (fair_queue::LAST_OF_TENANT, 2),
        (expiry::OLDEST, 0),
        (expiry::NEXT_DUE, 0),
        (expiry::DUE_OPEN, 2),
        (expiry::DUE_ENDED, 2),
        (outbox::DUE, 2),
        (outbox::UNDELIVERED, 1),
        (outbox::WAKE_NOTICES, 2),
    ] {
        let plan = plan(&connection, sql, parameters);
        assert!(!plan.contains("TEMP B-TREE"), "{sql}: {plan}");
        assert!(
            !plan.contains("SCAN jobs") || plan.contains("INDEX"),
            "{sql}: {plan}"
        );
    }
    for (state, label) in [(false, false), (true, false), (false, true), (true, true)] {
        let filter = Filter {
            tenant: Tenant::default(),
            state: state.then_some(State::Failed),
            label: label.then(|| "drive=1".to_owned()),
            before: None,
            limit: 50,
        };
        let sql = lists::statement(&filter);
        let plan = plan(
            &connection,
            &sql,
            3 + usize::from(state) + usize::from(label),
        );
        assert!(!plan.contains("TEMP B-TREE"), "{sql}: {plan}");
        assert!(!plan.contains("SCAN"), "{sql}: {plan}");
    }
    assert!(
        expiry::next_due(&SqliteSql(&connection))
            .expect("an answer")
            .is_some()
    );
}

#[tokio::test]
async fn jobs_that_somebody_waits_for_are_looked_after_before_those_that_are_to_be_deleted() {
    const ENDED: usize = 300;
    let mut folder = Folder::new();
    let (queue, _heard) = folder.open(QueueOptions::default()).await;
    for _ in 0..=ENDED {
        queue.submit(submission("a")).await.expect("accepted");
    }
    drop(queue);
    let path = folder.0.path().join("queue.sqlite3");
    let connection = schema::open_writer(&path).expect("the file");
    let late = format!(
        "UPDATE jobs SET state = 3, due = seq WHERE seq <= {ENDED}; \
         UPDATE jobs SET due = seq WHERE seq > {ENDED}"
    );
    connection.execute_batch(&late).expect("set");
    let due = expiry::due(&SqliteSql(&connection)).expect("an answer");
    assert_eq!(due.open.len(), 1);
    assert!(due.has_more && due.ended.len() < ENDED);
}

#[tokio::test]
async fn a_second_process_is_refused_by_name() {
    let mut folder = Folder::new();
    let first = folder.open(QueueOptions::default()).await;
    let (events, _) = mpsc::unbounded_channel();
    let second = open_sqlite(folder.0.path(), QueueOptions::default(), events);
    let error = second.err().expect("a refusal").to_string();
    assert!(error.contains("another process has the queue"), "{error}");
    drop(first);
}

#[test]
fn a_file_that_was_upgraded_has_the_tables_of_a_new_one() {
    let tables = |connection: &Connection| -> Vec<String> {
        let mut tables = connection
            .prepare(
                "SELECT m.name || ' ' || coalesce(c.name, '') || ' ' || coalesce(c.type, '') FROM \
                 sqlite_master m LEFT JOIN pragma_table_xinfo(m.name) c ORDER BY m.name, c.cid",
            )
            .expect("a list");
        let rows = tables.query_map([], |row| row.get(0)).expect("a list");
        rows.collect::<rusqlite::Result<_>>().expect("text")
    };
    let folder = Folder::new();
    let path = folder.0.path().join("queue.sqlite3");
    let old = Connection::open(&path).expect("a file");
    let frozen = include_str!("../../../tests/service/frozen/version_8/queue.sql");
    old.execute_batch(frozen).expect("a queue");
    drop(old);
    let upgraded = schema::open_writer(&path).expect("a queue");
    let other = Folder::new();
    let fresh = schema::open_writer(&other.0.path().join("queue.sqlite3")).expect("a queue");
    assert_eq!(tables(&upgraded), tables(&fresh));
}

#[test]
fn a_file_of_another_version_is_refused_with_what_to_do_and_left_alone() {
    for (version, said) in [
        (schema::VERSION + 1, "run the newer program"),
        (schema::OLDEST - 1, "name another data_dir"),
    ] {
        let folder = Folder::new();
        let path = folder.0.path().join("queue.sqlite3");
        let connection = schema::open_writer(&path).expect("a file");
        connection
            .pragma_update(None, "user_version", version)
            .expect("a pragma");
        drop(connection);
        let error = schema::open_writer(&path).expect_err("a refusal");
        assert!(matches!(error, QueueError::Store(text) if text.contains(said)));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn submissions_at_the_same_time_share_commits_and_all_stand() {
    const JOBS: usize = 200;
    let mut folder = Folder::new();
    let (queue, _events) = folder.open(QueueOptions::default()).await;
    let mut submissions = tokio::task::JoinSet::new();
    for _ in 0..JOBS {
        let queue = Arc::clone(&queue);
        submissions.spawn(async move {
            let submission = submission("a");
            queue.submit(submission).await
        });
    }
    while let Some(submitted) = submissions.join_next().await {
        submitted.expect("no panic").expect("accepted");
    }
    assert_eq!(queue.backlog().queued().jobs, JOBS as u64);
    drop(queue);
    let (queue, _events) = folder.open(QueueOptions::default()).await;
    assert_eq!(queue.backlog().queued().jobs, JOBS as u64);
}

#[tokio::test]
async fn a_lease_ends_by_signs_of_life_and_not_by_the_clock() {
    let mut folder = Folder::new();
    let options = QueueOptions {
        lease: Duration::from_secs(3),
        ..QueueOptions::default()
    };
    let (queue, mut heard) = folder.open(options).await;
    queue.submit(submission("a")).await.expect("accepted");
    let held = queue
        .lease("worker", DeviceKind::Cpu)
        .await
        .expect("a lease");
    // Simulates a clock that was set a day forward, several times.
    let path = folder.0.path().join("queue.sqlite3");
    let clock = schema::open_writer(&path).expect("the file");
    for _ in 0..4 {
        clock
            .execute("UPDATE jobs SET due = 1 WHERE state = 1", [])
            .expect("set");
        // Any write triggers the expiry check.
        queue.probe().await.expect("it can be written");
        tokio::time::sleep(Duration::from_millis(300)).await;
        assert_eq!(held.heartbeat.beat(None), Signal::Continue);
        let due: i64 = clock
            .query_row("SELECT due FROM jobs", [], |row| row.get(0))
            .expect("a row");
        assert!(due > 1, "it was not looked at");
    }
    // Without heartbeats the lease still expires.
    let silent = async {
        while held.heartbeat.signal() != Signal::Lost {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(20), silent)
        .await
        .expect("in time");
    let mut expired = 0;
    while let Ok(event) = heard.try_recv() {
        expired += usize::from(matches!(event, Event::LeaseExpired(_)));
    }
    assert_eq!(expired, 1);
}

#[tokio::test]
async fn a_job_that_an_orderly_stop_could_not_give_back_is_not_blamed() {
    let options = QueueOptions {
        max_crashes: 1,
        ..QueueOptions::default()
    };
    let mut folder = Folder::new();
    let (mut queue, _heard) = folder.open(options.clone()).await;
    let job = submission("a");
    let (id, tenant) = (job.id, job.tenant.clone());
    queue.submit(job).await.expect("accepted");
    for _ in 0..3 {
        let held = queue
            .lease("worker", DeviceKind::Cpu)
            .await
            .expect("a lease");
        assert_eq!(held.job.id, id);
        queue.stopped().await;
        drop((held, queue));
        (queue, _) = folder.open(options.clone()).await;
    }
    // A restart without a graceful shutdown counts as a crash.
    let held = queue
        .lease("worker", DeviceKind::Cpu)
        .await
        .expect("a lease");
    drop((held, queue));
    let (queue, _heard) = folder.open(options).await;
    let job = queue.job(&tenant, id).await.expect("known");
    assert_eq!(job.state, State::Failed);
}

#[tokio::test]
async fn a_queue_says_when_its_thread_has_ended() {
    let (events, _heard) = mpsc::unbounded_channel();
    let folder = Folder::new();
    let engine = SqliteEngine::open(folder.0.path(), &QueueOptions::default(), events);
    let engine = engine.expect("a queue");
    let local = Arc::clone(engine.local());
    assert!(!local.ended.is_cancelled());
    drop(engine);
    let ended = tokio::time::timeout(Duration::from_secs(20), local.ended.cancelled());
    ended.await.expect("in time");
}
