//! Promises about the rows: whatever happened, they agree with each other.

use std::collections::HashMap;

use rusqlite::Connection;

use crate::queue::backlog::Backlog;
use crate::queue::local::Local;
use crate::queue::sqlite::statements::SqliteSql;
use crate::queue::transitions::lists;
use crate::sync::locked;

/// The columns of a row that the checks read.
struct Row {
    id: Vec<u8>,
    parent: Option<Vec<u8>>,
    after: Option<Vec<u8>>,
    is_sequence: bool,
    state: u8,
    is_ready: bool,
    is_due: bool,
    is_finished: bool,
    pairs: u32,
    pairs_left: u32,
}

fn rows(connection: &Connection) -> Vec<Row> {
    let mut statement = connection
        .prepare_cached(
            "SELECT id, parent, after, kind, state, ready IS NOT NULL, due IS NOT NULL, \
             finished IS NOT NULL, pairs, pairs_left FROM jobs",
        )
        .expect("a statement");
    let found = statement.query_map([], |row| {
        Ok(Row {
            id: row.get(0)?,
            parent: row.get(1)?,
            after: row.get(2)?,
            is_sequence: row.get(3)?,
            state: row.get(4)?,
            is_ready: row.get(5)?,
            is_due: row.get(6)?,
            is_finished: row.get(7)?,
            pairs: row.get(8)?,
            pairs_left: row.get(9)?,
        })
    });
    found
        .and_then(Iterator::collect)
        .expect("rows of these types")
}

/// The number of rows of all tables.
pub(super) fn count(connection: &Connection) -> i64 {
    let all = "SELECT (SELECT count(*) FROM jobs) + (SELECT count(*) FROM labels) \
               + (SELECT count(*) FROM outbox)";
    let mut statement = connection.prepare_cached(all).expect("a statement");
    statement.query_row([], |row| row.get(0)).expect("a number")
}

/// Checks all rows.
pub(super) fn check(connection: &Connection, local: &Local) {
    let rows = rows(connection);
    let by_id: HashMap<&[u8], &Row> = rows.iter().map(|row| (row.id.as_slice(), row)).collect();
    let is_open = |row: &Row| row.state < 2;
    for row in &rows {
        let name = format!("{:?} in state {}", &row.id[8..], row.state);
        if row.is_sequence {
            let of_it = |pair: &&Row| pair.parent.as_deref() == Some(&row.id);
            let pairs: Vec<&Row> = rows.iter().filter(of_it).collect();
            let open = pairs.iter().filter(|pair| is_open(pair)).count();
            assert_eq!(pairs.len(), row.pairs as usize, "{name}: a pair is lost");
            assert_eq!(open, row.pairs_left as usize, "{name}: pairs left");
            assert!(
                open == 0 || is_open(row),
                "{name}: it has ended before its pairs"
            );
            assert!(
                open > 0 || !is_open(row) || row.is_ready,
                "{name}: nothing is left, and it is open"
            );
        } else {
            let before = row.after.as_ref().and_then(|id| by_id.get(id.as_slice()));
            // One that was let go may see the job before it queued again.
            let waits = before.is_some_and(|before| is_open(before));
            assert!(
                row.state != 0 || row.is_ready || waits,
                "{name}: a follower is held back for ever"
            );
        }
        let closing = row.is_sequence && row.is_ready && row.pairs_left == 0;
        let is_watched = !row.is_sequence || closing || !is_open(row);
        let is_kept = row.parent.is_some() && !is_open(row);
        assert_eq!(row.is_due, is_watched && !is_kept, "{name}: due");
        assert_eq!(
            row.is_finished,
            !is_open(row),
            "{name}: the time of its end"
        );
        if let Some(parent) = &row.parent {
            assert!(by_id.contains_key(parent.as_slice()), "{name}: an orphan");
        }
    }
    let counted = lists::count_backlog(&SqliteSql(connection)).expect("a count");
    let known = locked(&local.backlog).clone();
    let load = |backlog: &Backlog| {
        let rows = backlog.rows().into_iter();
        let mut rows: Vec<String> = rows
            .map(|(tenant, priority, device, load)| {
                format!("{tenant:?} {priority:?} {device:?} {}", load.jobs)
            })
            .collect();
        rows.sort();
        (rows, backlog.running().jobs)
    };
    assert_eq!(
        load(&known),
        load(&counted),
        "the load in memory and in the rows"
    );
}
