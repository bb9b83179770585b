//! The nodes of the queue: each is alive for as long as a connection of its own holds its lock.

use std::time::{Duration, Instant};

use super::locks::{NODES, RECOVERY};
use super::session::{Call, Flush, Session};
use super::shared::Shared;
use super::this_node::ThisNode;
use crate::queue::effects::Effects;
use crate::queue::node::{Capacities, Capacity, Node};
use crate::queue::sql::{Row, Sql, values};
use crate::queue::transitions::expiry;
use crate::queue::types::QueueError;

/// The other nodes need this long to show that they are alive, as all may have been cut off: a
/// connection to a database of two addresses takes more than the 5 s for which the first one is tried.
pub(super) const GRACE: Duration = Duration::from_secs(8);

/// The same for a node that comes when others were there a moment ago, and none is.
pub(super) const GRACE_AFTER_AN_END: Duration = Duration::from_secs(2);

/// A node without its lock is dead when it was so at two looks with this time between them.
pub(super) const SECOND_LOOK: Duration = Duration::from_millis(600);

/// Values of `stopped` in the row of a node: it said that it stops, or the others took it for dead.
pub(super) const STOPPED: i64 = 1;
const DEAD: i64 = 2;

/// Number of the latest nodes whose last commits are remembered.
const COMMITS_OF: i64 = 1000;

/// Shows that this node is alive on the connection of the session, which stays open.
pub(super) fn show(session: &mut Session, me: &ThisNode, name: &str) -> Result<(), QueueError> {
    let known = me.number();
    let asked = Instant::now();
    if known > 0 {
        let lock = format!(
            "SELECT id, pg_try_advisory_lock({NODES}, id) FROM nodes WHERE id = ?1 AND stopped = 0"
        );
        let shown = session.read(asked, |sql| sql.first(&lock, values![known]))?;
        match shown.map(|row| row.get(1)).transpose()? {
            Some(true) => return Ok(()),
            Some(false) => {
                let old = "the old connection of this node still holds its lock".to_owned();
                return Err(QueueError::Store(old));
            }
            // The others have taken it for dead. It goes on as another node.
            None => {}
        }
    }
    // One statement: the others must not see a node without its lock.
    let register = format!(
        "WITH node AS (INSERT INTO nodes (name, version, started) VALUES (?1, ?2, ?3) RETURNING id) \
         SELECT id, pg_advisory_lock({NODES}, id)::text FROM node"
    );
    let version = env!("CARGO_PKG_VERSION");
    let row = session.read(asked, |sql| {
        sql.only(&register, values![name, version, sql.now()])
    })?;
    let number: i64 = row.get(0)?;
    // A node may still look up its last commits for a while after it was taken for dead.
    let forget = "DELETE FROM commits WHERE node < ?1";
    session.read(asked, |sql| sql.query(forget, values![number - COMMITS_OF]))?;
    me.set_number(number);
    Ok(())
}

/// Writes what this node can do, and reads all nodes.
pub(super) fn exchange(sql: &dyn Sql, own: Capacities) -> Result<Vec<Node>, QueueError> {
    let [cpu, gpu] = own;
    let tell = "UPDATE nodes SET cpu_lanes = ?2, cpu_rate = ?3, gpu_lanes = ?4, gpu_rate = ?5 \
                WHERE id = ?1";
    let me = sql.node();
    sql.query(tell, values![me, cpu.lanes, cpu.rate, gpu.lanes, gpu.rate])?;
    let text = "SELECT id, name, version, started, cpu_lanes, cpu_rate, gpu_lanes, gpu_rate \
                FROM nodes ORDER BY id";
    let nodes = sql.query(text, &[])?;
    let node = |row: &Row| {
        let capacity = |column| -> Result<Capacity, QueueError> {
            Ok(Capacity {
                lanes: row.get(column)?,
                rate: row.get(column + 1)?,
            })
        };
        let number = row.get(0)?;
        Ok(Node {
            number,
            name: row.get(1)?,
            version: row.get(2)?,
            started: row.get(3)?,
            is_this: number == me,
            capacities: [capacity(4)?, capacity(6)?],
        })
    };
    nodes.iter().map(node).collect()
}

/// A node that does not hold its lock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Silent {
    pub(super) node: i64,
    /// Whether it said that it stops.
    pub(super) stopped: bool,
}

/// The other nodes as far as their locks tell.
#[derive(Debug, Default)]
pub(super) struct Look {
    /// Those that do not hold their locks.
    pub(super) silent: Vec<Silent>,
    /// Number of those that do.
    pub(super) alive: u32,
    /// Whether the database has only just started, so that the silent ones may be about to take
    /// their locks again.
    pub(super) is_young: bool,
}

/// Looks at the locks of the other nodes.
pub(super) fn look(session: &mut Session, me: i64) -> Result<Look, QueueError> {
    let text = format!(
        "SELECT n.id, n.stopped, EXISTS (SELECT 1 FROM pg_locks l WHERE l.locktype = 'advisory' \
             AND l.database = (SELECT oid FROM pg_database WHERE datname = current_database()) \
             AND l.classid = {NODES}::oid AND l.objid = n.id::oid AND l.objsubid = 2 \
             AND l.granted) FROM nodes n WHERE n.id <> ?1"
    );
    let young = format!(
        "SELECT now() < pg_postmaster_start_time() + interval '{} milliseconds'",
        GRACE.as_millis()
    );
    session.read(Instant::now(), |sql| {
        let mut look = Look {
            is_young: sql.only(&young, &[])?.get(0)?,
            ..Look::default()
        };
        for row in sql.query(&text, values![me])? {
            if row.get(2)? {
                look.alive += 1;
                continue;
            }
            look.silent.push(Silent {
                node: row.get(0)?,
                stopped: row.get::<i64>(1)? == STOPPED,
            });
        }
        Ok(look)
    })
}

/// Recovers the jobs of a dead node and forgets the node, unless another node does.
pub(super) fn recover(
    session: &mut Session,
    dead: Silent,
    shared: &Shared,
) -> Result<(), QueueError> {
    let turn = |session: &mut Session, function: &str| {
        let text = format!("SELECT {function}({RECOVERY}, ?1::integer)");
        let row = session.read(Instant::now(), |sql| sql.only(&text, values![dead.node]))?;
        row.get::<bool>(0)
    };
    // The lock ends with the connection. If this node is killed, another one takes it.
    if !turn(session, "pg_try_advisory_lock")? {
        return Ok(());
    }
    tracing::warn!(
        node = dead.node,
        "a node has ended: its jobs are queued again"
    );
    let recovered = recover_and_forget(session, dead, shared);
    turn(session, "pg_advisory_unlock")?;
    recovered
}

fn recover_and_forget(
    session: &mut Session,
    dead: Silent,
    shared: &Shared,
) -> Result<(), QueueError> {
    let Silent { node, stopped } = dead;
    // From now on it claims nothing under this number.
    let mark = "UPDATE nodes SET stopped = ?2 WHERE id = ?1 AND stopped = 0";
    session.read(Instant::now(), |sql| sql.query(mark, values![node, DEAD]))?;
    let left = session.read(Instant::now(), |sql| expiry::left_behind(sql, node))?;
    for id in left {
        let recover = |sql: &dyn Sql, effects: &mut Effects| {
            expiry::recover(sql, effects, &shared.options, id, node, stopped)
        };
        shared.change(session, Flush::Always, Call::own(), recover)?;
    }
    let forget = "DELETE FROM nodes WHERE id = ?1";
    session.read(Instant::now(), |sql| sql.query(forget, values![node]))?;
    Ok(())
}
