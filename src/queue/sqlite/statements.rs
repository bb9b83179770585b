//! Runs the statements of the state transitions on a SQLite connection.

use rusqlite::types::{ToSqlOutput, ValueRef};
use rusqlite::{Connection, params_from_iter};

use crate::clock::Timestamp;
use crate::job::{Priority, Tenant};
use crate::queue::sql::{Row, Sql, Value, for_sqlite};
use crate::queue::time;
use crate::queue::types::QueueError;

/// The number of the only node.
pub(super) const NODE: i64 = 0;

/// A connection, inside a transaction or for reading.
pub(super) struct SqliteSql<'a>(pub(super) &'a Connection);

impl Sql for SqliteSql<'_> {
    fn query(&self, sql: &str, parameters: &[Value]) -> Result<Vec<Row>, QueueError> {
        let mut statement = self.0.prepare_cached(&for_sqlite(sql))?;
        let columns = statement.column_count();
        let mut rows = statement.query(params_from_iter(parameters))?;
        let mut found = Vec::new();
        while let Some(row) = rows.next()? {
            let cells = (0..columns).map(|column| Ok(cell(row.get_ref(column)?)));
            found.push(Row(cells.collect::<Result<_, rusqlite::Error>>()?));
        }
        Ok(found)
    }

    fn now(&self) -> Timestamp {
        time::wall()
    }

    fn node(&self) -> i64 {
        NODE
    }

    fn lock_share(&self, _: &Tenant, _: Priority) -> Result<(), QueueError> {
        // One transaction at a time writes.
        Ok(())
    }
}

fn cell(value: ValueRef<'_>) -> Value {
    match value {
        ValueRef::Null => Value::Null,
        ValueRef::Integer(value) => Value::Int(value),
        ValueRef::Real(value) => Value::Real(value),
        ValueRef::Text(value) => Value::Text(String::from_utf8_lossy(value).into_owned()),
        ValueRef::Blob(value) => Value::Blob(value.to_vec()),
    }
}

impl rusqlite::ToSql for Value {
    fn to_sql(&self) -> rusqlite::Result<ToSqlOutput<'_>> {
        Ok(ToSqlOutput::Borrowed(match self {
            Self::Null => ValueRef::Null,
            Self::Int(value) => ValueRef::Integer(*value),
            Self::Real(value) => ValueRef::Real(*value),
            Self::Text(value) => ValueRef::Text(value.as_bytes()),
            Self::Blob(value) => ValueRef::Blob(value),
        }))
    }
}

impl From<rusqlite::Error> for QueueError {
    fn from(error: rusqlite::Error) -> Self {
        // Every database error counts as a fault of the machine, not of a job.
        match error.sqlite_error_code() {
            Some(rusqlite::ErrorCode::DiskFull) => Self::Full(error.to_string()),
            _ => Self::Store(error.to_string()),
        }
    }
}
