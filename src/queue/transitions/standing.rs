//! The standing of a queued job among those that are ready.

use super::fair_queue::virtual_now;
use super::rows::{DEVICES, device_code};
use crate::job::{DeviceKind, JobId, Priority};
use crate::queue::sql::{Sql, values};
use crate::queue::standing::Standing;
use crate::queue::types::QueueError;

/// The statement that counts the ready jobs of a higher priority, of one device requirement. The query
/// plan test also uses it.
pub(in crate::queue) const HIGHER: &str = "SELECT count(*) FROM (SELECT seq FROM jobs \
    INDEXED BY jobs_ready WHERE state = 0 AND ready IS NOT NULL AND delayed = 0 AND device = ?1 \
    AND priority > ?2 LIMIT ?3) AS ahead";

/// The same for those of the same priority with an earlier tag.
pub(in crate::queue) const EARLIER: &str = "SELECT count(*) FROM (SELECT seq FROM jobs \
    INDEXED BY jobs_ready WHERE state = 0 AND ready IS NOT NULL AND delayed = 0 AND device = ?1 \
    AND priority = ?2 AND virtual_start <= ?4 AND (virtual_start < ?4 OR seq < ?5) LIMIT ?3) AS ahead";

/// The standing of a queued job. Of a sequence it is that of its first queued pair or of its closing job.
/// `None` if nothing of the job is queued.
pub(in crate::queue) fn standing(sql: &dyn Sql, id: JobId) -> Result<Option<Standing>, QueueError> {
    let own = "SELECT priority, virtual_start, seq, device FROM jobs INDEXED BY jobs_id \
               WHERE id = ?1 AND state = 0 AND (kind = 0 OR ready IS NOT NULL)";
    let of_pairs = "SELECT priority, virtual_start, seq, device FROM jobs INDEXED BY jobs_parent \
                    WHERE parent = ?1 AND state = 0 ORDER BY virtual_start, seq LIMIT 1";
    let row = match sql.first(own, values![id])? {
        Some(row) => row,
        None => match sql.first(of_pairs, values![id])? {
            Some(row) => row,
            None => return Ok(None),
        },
    };
    let (code, start, seq): (i64, f64, i64) = (row.get(0)?, row.get(1)?, row.get(2)?);
    let device: Option<DeviceKind> = row.choice(3, &DEVICES)?;
    let mut ahead = 0;
    // It shares its lanes with the jobs for any device, and one for any device with all.
    for other in DEVICES {
        if device.is_some() && other.is_some() && other != device {
            continue;
        }
        let other = device_code(other);
        let higher = sql.only(HIGHER, values![other, code, Standing::MOST])?;
        let earlier = values![other, code, Standing::MOST, start, seq];
        for row in [higher, sql.only(EARLIER, earlier)?] {
            ahead += row.get::<i64>(0)?;
        }
    }
    let priority = row.choice(0, &Priority::ALL)?;
    let served = virtual_now(sql, priority)?.unwrap_or(start);
    Ok(Some(Standing {
        ahead: ahead.min(Standing::MOST),
        share_seconds: (start - served).max(0.0),
    }))
}
