//! A queue's file of an older schema version with strange values: it is upgraded and served, or
//! refused, without a panic.

use std::path::Path;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use fnsf::job::{DeviceKind, Tenant};
use fnsf::queue::{Filter, Outcome, Queue, QueueOptions, open_sqlite};
use libfuzzer_sys::Corpus;
use rusqlite::Connection;
use rusqlite::types::Value;
use tokio::runtime::Runtime;

use crate::pieces::Pieces;
use crate::settings::SCRATCH;

/// Jobs in every state, as schema version 8 has them.
const OLDER: &str = include_str!("../tests/service/frozen/version_8/queue.sql");

/// Changes of cells: the row, the column, and the value.
pub(crate) fn older(bytes: &[u8]) -> Corpus {
    static RUNTIME: OnceLock<Runtime> = OnceLock::new();
    let folder = tempfile::tempdir_in(SCRATCH).expect("a folder");
    change(&folder.path().join("queue.sqlite3"), &mut Pieces(bytes)).expect("the queue's file");
    let runtime = RUNTIME.get_or_init(|| {
        let builder = tokio::runtime::Builder::new_current_thread();
        { builder }.enable_all().build().expect("a runtime")
    });
    runtime.block_on(async {
        let (events, _) = tokio::sync::mpsc::unbounded_channel();
        if let Ok(queue) = open_sqlite(folder.path(), QueueOptions::default(), events) {
            serve(queue).await;
        }
    });
    Corpus::Keep
}

fn change(path: &Path, pieces: &mut Pieces<'_>) -> rusqlite::Result<()> {
    let queue = Connection::open(path)?;
    queue.execute_batch("PRAGMA synchronous = OFF; PRAGMA journal_mode = MEMORY;")?;
    queue.execute_batch(OLDER)?;
    let columns: Vec<String> = {
        let statement = queue.prepare("SELECT * FROM jobs")?;
        statement.column_names().map(str::to_owned).collect()
    };
    let rows: i64 = queue.query_row("SELECT count(*) FROM jobs", [], |row| row.get(0))?;
    while !pieces.is_empty() {
        let row = i64::from(pieces.byte()) % rows;
        let column = &columns[usize::from(pieces.byte()) % columns.len()];
        let value = match pieces.byte() % 6 {
            0 => Value::Null,
            1 => Value::Integer(i64::from(pieces.byte())),
            2 => Value::Integer(i64::from_le_bytes(pieces.array())),
            3 => Value::Real(f64::from_le_bytes(pieces.array())),
            4 => Value::Text(String::from_utf8_lossy(pieces.counted()).into_owned()),
            _ => Value::Blob(pieces.counted().to_vec()),
        };
        // A constraint may refuse it.
        let _refused = queue.execute(
            &format!("UPDATE jobs SET {column} = ?1 WHERE seq = (SELECT seq FROM jobs ORDER BY seq LIMIT 1 OFFSET ?2)"),
            rusqlite::params![value, row],
        );
    }
    Ok(())
}

/// Every operation, on whatever jobs are found.
async fn serve(queue: Arc<dyn Queue>) {
    let filter = Filter {
        tenant: Tenant::default(),
        state: None,
        label: None,
        before: None,
        limit: 100,
    };
    let jobs = queue.list(filter).await.unwrap_or_default();
    for job in &jobs {
        let _pairs = queue.pairs(job.id).await;
        let _watched = queue.watch(job.id).await;
    }
    for _ in 0..6 {
        let leased =
            tokio::time::timeout(Duration::from_millis(2), queue.lease("w", DeviceKind::Cpu));
        let Ok(Ok(lease)) = leased.await else {
            break;
        };
        let _beat = lease.heartbeat.beat(None);
        let _finished = queue
            .finish(lease.job.id, lease.job.attempt, Outcome::Released)
            .await;
    }
    for job in &jobs {
        let _asked = (
            queue.cancel(job.id).await,
            queue.requeue(job.id, true).await,
        );
        let _asked = (
            queue.abandon(job.id).await,
            queue.make_durable(job.id).await,
        );
        let _asked = (queue.cancel(job.id).await, queue.remove(job.id).await);
    }
    let _taken = queue.take_outgoing(10, Duration::from_secs(1)).await;
    let _oldest = (
        queue.oldest_queued().await,
        queue.probe().await,
        queue.is_empty().await,
    );
    let _load = queue.backlog().queued();
}
