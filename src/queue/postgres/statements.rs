//! Runs the statements of the state transitions on a PostgreSQL connection.
//!
//! Statements are unnamed: the types of the parameters are sent with each, and no statement is
//! prepared on a connection that a pooler may give to somebody else.

use std::cell::{Cell, RefCell};
use std::error::Error;
use std::time::Instant;

use postgres::Client;
use postgres::error::SqlState;
use postgres::types::private::BytesMut;
use postgres::types::{FromSql, IsNull, ToSql, Type, to_sql_checked};

use super::locks::SHARES;
use super::this_node::ThisNode;
use crate::clock::Timestamp;
use crate::job::{Priority, Tenant};
use crate::queue::sql::{Row, Sql, Value, for_postgres};
use crate::queue::types::QueueError;

/// What may be done about an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// Another transaction was in the way: the same change may succeed now.
    Conflict,
    /// The connection is gone, or the database starts or stops.
    Lost,
    /// Nothing: the statement is refused, or the disk is full.
    Refused,
}

/// A transaction, or a connection for reading.
pub(super) struct PostgresSql<'a> {
    client: RefCell<&'a mut Client>,
    now: Timestamp,
    since: Instant,
    node: i64,
    is_alive: bool,
    fault: Cell<Option<Fault>>,
    wrote: Cell<bool>,
}

impl<'a> PostgresSql<'a> {
    pub(super) fn new(client: &'a mut Client, me: &ThisNode) -> Self {
        Self {
            client: RefCell::new(client),
            now: me.now(),
            since: Instant::now(),
            node: me.number(),
            is_alive: me.is_alive(),
            fault: Cell::default(),
            wrote: Cell::default(),
        }
    }

    /// The fault of the first statement that failed.
    pub(super) fn fault(&self) -> Option<Fault> {
        self.fault.get()
    }

    /// Whether a statement has run that may have changed something.
    pub(super) fn wrote(&self) -> bool {
        self.wrote.get()
    }
}

impl Sql for PostgresSql<'_> {
    fn query(&self, sql: &str, parameters: &[Value]) -> Result<Vec<Row>, QueueError> {
        let typed: Vec<_> = parameters
            .iter()
            .map(|value| (value as &(dyn ToSql + Sync), value.type_of()))
            .collect();
        if !sql.starts_with("SELECT") {
            self.wrote.set(true);
        }
        let rows = self
            .client
            .borrow_mut()
            .query_typed(&for_postgres(sql), &typed);
        let rows = rows.map_err(|error| {
            self.fault.set(self.fault.get().or(Some(fault(&error))));
            refused(&error)
        })?;
        let cells = |row: &postgres::Row| {
            let cells = (0..row.len()).map(|column| row.try_get(column));
            cells.collect::<Result<_, _>>().map(Row)
        };
        let rows = rows.iter().map(cells).collect::<Result<_, _>>();
        rows.map_err(|error| refused(&error))
    }

    fn now(&self) -> Timestamp {
        self.now.after(self.since.elapsed())
    }

    fn ahead_ms(&self) -> i64 {
        // Clocks that are kept in step differ by less, and so does the measurement.
        const IN_STEP: i64 = 100;
        let ahead = self.now().as_millis() - Timestamp::now().as_millis();
        if ahead.abs() < IN_STEP { 0 } else { ahead }
    }

    fn node(&self) -> i64 {
        self.node
    }

    fn check_node(&self) -> Result<(), QueueError> {
        if self.is_alive {
            return Ok(());
        }
        let dead = "the other nodes have taken this one for dead: it joins again in a moment";
        Err(QueueError::Store(dead.to_owned()))
    }

    fn lock_share(&self, tenant: &Tenant, priority: Priority) -> Result<(), QueueError> {
        let share = format!("{tenant} {priority:?}");
        let text = format!("SELECT pg_advisory_xact_lock({SHARES}, hashtext(?1))::text");
        self.query(&text, &[Value::Text(share)]).map(drop)
    }
}

/// An error in words, with its causes.
pub(super) fn said(error: &postgres::Error) -> String {
    let mut text = match error.as_db_error() {
        Some(error) => return format!("{} ({})", error.message(), error.code().code()),
        None => error.to_string(),
    };
    let mut cause = error.source();
    while let Some(next) = cause {
        text = format!("{text}: {next}");
        cause = next.source();
    }
    text
}

/// The queue's error of an error of the database.
pub(super) fn refused(error: &postgres::Error) -> QueueError {
    match error.code() {
        Some(&SqlState::DISK_FULL) => QueueError::Full(said(error)),
        _ => QueueError::Store(said(error)),
    }
}

/// What may be done about an error of the database.
pub(super) fn fault(error: &postgres::Error) -> Fault {
    let Some(code) = error.code() else {
        let is_io = error.is_closed()
            || error
                .source()
                .is_some_and(<dyn Error>::is::<std::io::Error>);
        return if is_io { Fault::Lost } else { Fault::Refused };
    };
    const CONFLICTS: [SqlState; 4] = [
        SqlState::T_R_DEADLOCK_DETECTED,
        SqlState::T_R_SERIALIZATION_FAILURE,
        // Of two submissions with the same new key, the later one now finds the earlier one.
        SqlState::UNIQUE_VIOLATION,
        SqlState::LOCK_NOT_AVAILABLE,
    ];
    if CONFLICTS.contains(code) {
        return Fault::Conflict;
    }
    // Connection exceptions, shutdowns, too many connections, and a server that is read-only
    // because another one has taken over.
    let is_lost = ["08", "57P", "53300", "25006", "25P03"];
    match is_lost.iter().any(|class| code.code().starts_with(class)) {
        true => Fault::Lost,
        false => Fault::Refused,
    }
}

impl Value {
    fn type_of(&self) -> Type {
        match self {
            // The database knows the type from the place.
            Self::Null => Type::UNKNOWN,
            Self::Int(_) => Type::INT8,
            Self::Real(_) => Type::FLOAT8,
            Self::Text(_) => Type::TEXT,
            Self::Blob(_) => Type::BYTEA,
        }
    }
}

impl ToSql for Value {
    fn to_sql(
        &self,
        kind: &Type,
        out: &mut BytesMut,
    ) -> Result<IsNull, Box<dyn Error + Sync + Send>> {
        match self {
            Self::Null => Ok(IsNull::Yes),
            Self::Int(value) => value.to_sql(kind, out),
            Self::Real(value) => value.to_sql(kind, out),
            // The database has no text with zeros.
            Self::Text(value) => value.replace('\0', "\u{fffd}").to_sql(kind, out),
            Self::Blob(value) => value.to_sql(kind, out),
        }
    }

    fn accepts(_: &Type) -> bool {
        true
    }

    to_sql_checked!();
}

impl<'a> FromSql<'a> for Value {
    fn from_sql(kind: &Type, raw: &'a [u8]) -> Result<Self, Box<dyn Error + Sync + Send>> {
        Ok(match *kind {
            Type::BOOL => Self::Int(bool::from_sql(kind, raw)?.into()),
            Type::INT2 => Self::Int(i16::from_sql(kind, raw)?.into()),
            Type::INT4 => Self::Int(i32::from_sql(kind, raw)?.into()),
            Type::INT8 => Self::Int(i64::from_sql(kind, raw)?),
            Type::FLOAT8 => Self::Real(f64::from_sql(kind, raw)?),
            Type::BYTEA => Self::Blob(Vec::from_sql(kind, raw)?),
            _ => Self::Text(String::from_sql(kind, raw)?),
        })
    }

    fn from_sql_null(_: &Type) -> Result<Self, Box<dyn Error + Sync + Send>> {
        Ok(Self::Null)
    }

    fn accepts(kind: &Type) -> bool {
        const KINDS: [Type; 7] = [
            Type::BOOL,
            Type::INT2,
            Type::INT4,
            Type::INT8,
            Type::FLOAT8,
            Type::BYTEA,
            Type::TEXT,
        ];
        KINDS.contains(kind)
    }
}
