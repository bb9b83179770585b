//! The least and the most that the numbers of a configuration may be.

use super::keys::Config;

/// A key's name, its value, and the least and the most that it may be.
pub(super) type Range = (&'static str, u64, u64, u64);

macro_rules! range {
    ($section:ident.$key:ident, $least:expr, $most:expr) => {
        (
            concat!(stringify!($section), ".", stringify!($key)),
            number($section.$key),
            $least,
            $most,
        )
    };
}

fn number(value: impl TryInto<u64>) -> u64 {
    value.try_into().unwrap_or(u64::MAX)
}

impl Config {
    /// The range of every number: beyond it, conversions of units overflow and timers expire.
    pub(super) fn ranges(&self) -> [Range; 25] {
        const YEARS: u64 = 100 * 365 * 24 * 3600;
        const MIB: u64 = 1 << 43;
        let Self {
            limits,
            queue,
            shutdown,
            ..
        } = self;
        [
            range!(limits.max_points, 1, 50_000_000),
            range!(limits.max_job_memory_mib, 1, MIB),
            range!(limits.max_upload_mib, 1, MIB),
            range!(limits.max_total_upload_mib, 1, MIB),
            range!(limits.max_answers_mib, 1, MIB),
            range!(limits.min_free_disk_mib, 0, MIB),
            range!(limits.min_free_inodes, 0, 1 << 40),
            range!(limits.max_sweeps, 2, 1 << 20),
            range!(limits.max_wait_seconds, 0, YEARS),
            range!(limits.max_queue_seconds, 0, YEARS),
            range!(limits.max_tenant_queue_seconds, 0, YEARS),
            range!(limits.max_connections, 1, 1 << 20),
            range!(limits.header_timeout_seconds, 1, 3600),
            range!(limits.body_timeout_seconds, 1, 3600),
            range!(limits.write_timeout_seconds, 1, 3600),
            range!(limits.stream_prefetch_pairs, 1, 1000),
            range!(queue.postgres_connections, 1, 64),
            range!(queue.max_attempts, 1, 1000),
            range!(queue.max_crashes, 1, 1000),
            range!(queue.lease_seconds, 1, YEARS),
            range!(queue.retry_delay_seconds, 0, YEARS),
            range!(queue.time_to_live_seconds, 1, YEARS),
            range!(queue.retention_seconds, 1, YEARS),
            range!(queue.sync_result_retention_seconds, 1, YEARS),
            range!(shutdown.timeout_seconds, 0, YEARS),
        ]
    }
}
