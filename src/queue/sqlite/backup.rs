//! A copy of the queue's database while another process may have it open.

use std::path::Path;

use rusqlite::{Connection, OpenFlags};

use super::schema::VERSION;
use crate::job::JobId;
use crate::queue::sql::{FromValue, Value};
use crate::queue::types::QueueError;

/// What a copy of a queue holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CopiedQueue {
    /// As [`Queue::identity`](crate::queue::Queue::identity).
    pub identity: i32,
    /// All jobs, the pairs of sequences included.
    pub jobs: Vec<JobId>,
}

/// Copies the database of the embedded queue in the folder `from` to the folder `to`, as it is at one
/// moment. A process that has the queue open goes on meanwhile.
///
/// # Errors
/// [`QueueError::Store`] if there is no queue of this program's schema version, or the copy cannot be
/// written. The copy must not exist yet.
pub fn copy_sqlite(from: &Path, to: &Path) -> Result<CopiedQueue, QueueError> {
    let copy = to.join("queue.sqlite3");
    let source = open(&from.join("queue.sqlite3"))?;
    source.busy_timeout(std::time::Duration::from_secs(10))?;
    source.execute("VACUUM INTO ?1", [copy.to_string_lossy()])?;
    drop(source);
    read_copy(to)
}

/// Checks the copy of a queue in a folder: its structure and its schema version.
///
/// # Errors
/// [`QueueError::Store`] if it is damaged, is missing, or has another schema version.
pub fn read_copy(folder: &Path) -> Result<CopiedQueue, QueueError> {
    let copy = open(&folder.join("queue.sqlite3"))?;
    let version: i64 = copy.pragma_query_value(None, "user_version", |row| row.get(0))?;
    if version != VERSION {
        return Err(QueueError::Store(format!(
            "the queue has version {version}, this program knows {VERSION}: run the program of that \
             version"
        )));
    }
    let sound: String = copy.pragma_query_value(None, "integrity_check", |row| row.get(0))?;
    if sound != "ok" {
        return Err(QueueError::Store(format!("the queue is damaged: {sound}")));
    }
    let identity = copy.pragma_query_value(None, "application_id", |row| row.get(0))?;
    let mut statement = copy.prepare("SELECT id FROM jobs")?;
    let rows = statement.query_map([], |row| row.get::<_, Vec<u8>>(0))?;
    let mut jobs = Vec::new();
    for id in rows {
        let id = JobId::from_value(Value::Blob(id?));
        jobs.push(id.ok_or_else(|| QueueError::Store("a job has no id".to_owned()))?);
    }
    Ok(CopiedQueue { identity, jobs })
}

fn open(path: &Path) -> Result<Connection, QueueError> {
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    Connection::open_with_flags(path, flags)
        .map_err(|error| QueueError::Store(format!("cannot open {}: {error}", path.display())))
}
