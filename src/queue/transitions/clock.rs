//! What is due, where the wall clock is set.
//!
//! Independent of what the rows are due for.

use std::time::Duration;

use super::leases;
use crate::queue::outgoing::MAX_OUTGOING_DELAY;
use crate::queue::sql::{Sql, values};
use crate::queue::types::{QueueError, QueueOptions};

/// Times from here on are never, and do not move.
const NEVER: i64 = i64::MAX / 2;

/// Moves all that is due with the clock, after that was set by this many milliseconds.
pub(in crate::queue) fn follow(
    sql: &dyn Sql,
    options: &QueueOptions,
    millis: i64,
) -> Result<(), QueueError> {
    for text in [
        "UPDATE jobs SET expires = expires + ?1 WHERE state < 2 AND expires < ?2",
        "UPDATE jobs SET deadline = deadline + ?1 WHERE state < 2 AND deadline < ?2",
        "UPDATE jobs SET due = due + ?1 WHERE due < ?2",
        "UPDATE outbox SET due = due + ?1 WHERE due < ?2",
    ] {
        sql.query(text, values![millis, NEVER])?;
    }
    bound(sql, options)
}

/// Lets nothing be due later than the options allow from now on. It was promised by a clock that was
/// ahead of this one.
pub(in crate::queue) fn bound(sql: &dyn Sql, options: &QueueOptions) -> Result<(), QueueError> {
    let kept = options.retention.max(options.answered_retention);
    let bounds: [(&str, Duration); 4] = [
        (
            "UPDATE jobs SET due = ?1, expires = CASE WHEN expires > ?1 THEN ?1 ELSE expires END \
             WHERE due > ?1 AND due IS NOT NULL AND state < 2 AND deadline IS NULL",
            options.time_to_live,
        ),
        (
            "UPDATE jobs SET due = ?1 WHERE due > ?1 AND due IS NOT NULL AND state < 2 AND delayed = 1",
            leases::longest_delay(options),
        ),
        (
            "UPDATE jobs SET due = ?1 WHERE due > ?1 AND state > 1",
            kept,
        ),
        (
            "UPDATE outbox SET due = ?1 WHERE due > ?1",
            MAX_OUTGOING_DELAY,
        ),
    ];
    for (text, longest) in bounds {
        sql.query(text, values![sql.now().after(longest)])?;
    }
    Ok(())
}
