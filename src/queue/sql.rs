//! The SQL interface that the state transitions are written against, and the values it carries.
//!
//! One text of each statement serves SQLite and PostgreSQL. It uses the SQL that both know, with
//! the placeholders `?1`, `?2` and so on, and two clauses that each engine drops if it is not its
//! own: `INDEXED BY`, which only SQLite has, and `FOR UPDATE` or `FOR SHARE`, which only
//! PostgreSQL has. Flags are the integers 0 and 1.

use crate::clock::Timestamp;
use crate::job::{JobId, Priority, Tenant};
use crate::queue::types::QueueError;

/// An open transaction of one of the engines.
pub(super) trait Sql {
    /// Runs a statement and returns its rows, which of a change are those of `RETURNING`.
    ///
    /// # Errors
    /// [`QueueError::Store`] or [`QueueError::Full`] if the engine refuses it or cannot be reached.
    fn query(&self, sql: &str, parameters: &[Value]) -> Result<Vec<Row>, QueueError>;

    /// The time by the clock that all nodes of the queue share.
    fn now(&self) -> Timestamp;

    /// How far that clock is ahead of the clock of this process, milliseconds.
    fn ahead_ms(&self) -> i64 {
        0
    }

    /// The number of this node. The rows of jobs name it: where they were submitted and who holds
    /// them.
    fn node(&self) -> i64;

    /// Checks that the other nodes have not taken this one for dead: they would not look after what
    /// it takes.
    ///
    /// # Errors
    /// [`QueueError::Store`] if they have.
    fn check_node(&self) -> Result<(), QueueError> {
        Ok(())
    }

    /// Excludes other transactions that give fair tags to this tenant's jobs of this priority,
    /// until the end of this transaction.
    ///
    /// # Errors
    /// As [`Sql::query`].
    fn lock_share(&self, tenant: &Tenant, priority: Priority) -> Result<(), QueueError>;

    /// Runs a statement of which at most one row is expected.
    fn first(&self, sql: &str, parameters: &[Value]) -> Result<Option<Row>, QueueError> {
        Ok(self.query(sql, parameters)?.into_iter().next())
    }

    /// Runs a statement of which exactly one row is expected.
    fn only(&self, sql: &str, parameters: &[Value]) -> Result<Row, QueueError> {
        let gone = || QueueError::Store("a row is not there any more".to_owned());
        self.first(sql, parameters)?.ok_or_else(gone)
    }
}

/// A parameter of a statement or a cell of a row.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    Null,
    Int(i64),
    Real(f64),
    Text(String),
    Blob(Vec<u8>),
}

/// The parameters of a statement: `values![a, b]` converts each with [`Value::from`].
macro_rules! values {
    ($($value:expr),* $(,)?) => { &[$($crate::queue::sql::Value::from($value)),*] };
}
pub(super) use values;

impl<T> From<Option<T>> for Value
where
    Self: From<T>,
{
    fn from(value: Option<T>) -> Self {
        value.map_or(Self::Null, Self::from)
    }
}

macro_rules! integers {
    ($($kind:ty),*) => { $(
        impl From<$kind> for Value {
            fn from(value: $kind) -> Self {
                Self::Int(i64::from(value))
            }
        }

        impl FromValue for $kind {
            fn from_value(value: Value) -> Option<Self> {
                match value {
                    Value::Int(value) => Self::try_from(value).ok(),
                    _ => None,
                }
            }
        }
    )* };
}
integers!(i64, i32, u32);

impl From<bool> for Value {
    fn from(value: bool) -> Self {
        Self::Int(i64::from(value))
    }
}

impl From<f64> for Value {
    fn from(value: f64) -> Self {
        Self::Real(value)
    }
}

impl From<&str> for Value {
    fn from(value: &str) -> Self {
        Self::Text(value.to_owned())
    }
}

impl From<&[u8]> for Value {
    fn from(value: &[u8]) -> Self {
        Self::Blob(value.to_vec())
    }
}

impl From<JobId> for Value {
    fn from(value: JobId) -> Self {
        Self::Blob(value.as_bytes().to_vec())
    }
}

impl From<Timestamp> for Value {
    fn from(value: Timestamp) -> Self {
        Self::Int(value.as_millis())
    }
}

/// A type that a cell converts to.
pub(super) trait FromValue: Sized {
    /// The value; `None` if the cell has another type or is out of range.
    fn from_value(value: Value) -> Option<Self>;
}

impl<T: FromValue> FromValue for Option<T> {
    fn from_value(value: Value) -> Option<Self> {
        match value {
            Value::Null => Some(None),
            value => T::from_value(value).map(Some),
        }
    }
}

impl FromValue for bool {
    fn from_value(value: Value) -> Option<Self> {
        i64::from_value(value).map(|value| value != 0)
    }
}

impl FromValue for f64 {
    fn from_value(value: Value) -> Option<Self> {
        match value {
            Value::Real(value) => Some(value),
            _ => None,
        }
    }
}

impl FromValue for String {
    fn from_value(value: Value) -> Option<Self> {
        match value {
            Value::Text(value) => Some(value),
            _ => None,
        }
    }
}

impl FromValue for Vec<u8> {
    fn from_value(value: Value) -> Option<Self> {
        match value {
            Value::Blob(value) => Some(value),
            _ => None,
        }
    }
}

impl FromValue for JobId {
    fn from_value(value: Value) -> Option<Self> {
        let bytes = Vec::from_value(value)?;
        Some(Self::from_bytes(bytes.try_into().ok()?))
    }
}

impl FromValue for Timestamp {
    fn from_value(value: Value) -> Option<Self> {
        i64::from_value(value).map(Self::from_millis)
    }
}

impl FromValue for Tenant {
    fn from_value(value: Value) -> Option<Self> {
        String::from_value(value)?.parse().ok()
    }
}

/// The cells of one row, in the order of the statement's columns.
#[derive(Clone, Debug)]
pub(super) struct Row(pub(super) Vec<Value>);

impl Row {
    /// The cell in this column, from 0.
    ///
    /// # Errors
    /// [`QueueError::Store`] if there is none, or it has another type or is out of range.
    pub(super) fn get<T: FromValue>(&self, column: usize) -> Result<T, QueueError> {
        let cell = self.0.get(column).cloned();
        cell.and_then(T::from_value).ok_or_else(|| {
            QueueError::Store(format!("column {column} of a row does not hold its type"))
        })
    }

    /// The cell in this column, as an index into a list of all values of its type.
    ///
    /// # Errors
    /// [`QueueError::Store`] if it is no such index.
    pub(super) fn choice<T: Copy>(&self, column: usize, all: &[T]) -> Result<T, QueueError> {
        let code: u32 = self.get(column)?;
        all.get(code as usize).copied().ok_or_else(|| {
            QueueError::Store(format!("column {column} of a row has the code {code}"))
        })
    }
}

/// The text of a statement for SQLite: without the locks, which it does not know.
pub(super) fn for_sqlite(sql: &str) -> String {
    const LOCKS: [&str; 3] = [" FOR UPDATE SKIP LOCKED", " FOR UPDATE", " FOR SHARE"];
    let without = |sql: String, clause: &&str| sql.replace(clause, "");
    LOCKS.iter().fold(sql.to_owned(), without)
}

/// The text of a statement for PostgreSQL: with its placeholders, and without the names of indexes.
pub(super) fn for_postgres(sql: &str) -> String {
    const CLAUSE: &str = " INDEXED BY ";
    let mut text = String::with_capacity(sql.len());
    let mut parts = sql.split(CLAUSE);
    text.extend(parts.next());
    for part in parts {
        // The rest begins with the name of the index.
        let is_name = |letter: char| letter.is_ascii_alphanumeric() || letter == '_';
        text.push_str(part.trim_start_matches(is_name));
    }
    text.replace('?', "$")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_engine_gets_a_statement_without_the_clauses_of_the_other() {
        let sql = "SELECT id FROM jobs INDEXED BY jobs_ready WHERE device = ?1 AND id = (SELECT id \
                   FROM jobs INDEXED BY jobs_id WHERE seq = ?2 FOR SHARE) FOR UPDATE SKIP LOCKED";
        assert_eq!(
            for_sqlite(sql),
            "SELECT id FROM jobs INDEXED BY jobs_ready WHERE device = ?1 AND id = (SELECT id FROM \
             jobs INDEXED BY jobs_id WHERE seq = ?2)"
        );
        assert_eq!(
            for_postgres(sql),
            "SELECT id FROM jobs WHERE device = $1 AND id = (SELECT id FROM jobs WHERE seq = $2 FOR \
             SHARE) FOR UPDATE SKIP LOCKED"
        );
    }

    #[test]
    fn a_cell_is_refused_as_another_type_than_its_own() {
        let row = Row(values![7_i64, Option::<i64>::None, "a", -1_i64].to_vec());
        assert_eq!(row.get::<u32>(0), Ok(7));
        assert_eq!(row.get::<Option<u32>>(1), Ok(None));
        assert_eq!(row.choice(0, &[1, 2]).ok(), None);
        for refused in [row.get::<u32>(1), row.get(2), row.get(3), row.get(4)] {
            assert!(matches!(refused, Err(QueueError::Store(_))));
        }
    }
}
