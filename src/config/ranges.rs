//! What the numbers of a configuration may be.

use super::Config;

impl Config {
    /// Every number with the least and the most that it may be: past these, units wrap around and
    /// timers end.
    pub(super) fn ranges(&self) -> [(&'static str, u64, u64, u64); 24] {
        const YEARS: u64 = 100 * 365 * 24 * 3600;
        const MIB: u64 = 1 << 43;
        let Self {
            limits,
            queue,
            drain,
            ..
        } = self;
        let count = |count: usize| count as u64;
        [
            ("limits.max_points", count(limits.max_points), 1, 50_000_000),
            ("limits.max_pair_mib", count(limits.max_pair_mib), 1, MIB),
            ("limits.max_upload_mib", limits.max_upload_mib, 1, MIB),
            ("limits.max_uploads_mib", limits.max_uploads_mib, 1, MIB),
            ("limits.max_answers_mib", limits.max_answers_mib, 1, MIB),
            ("limits.min_free_mib", limits.min_free_mib, 0, MIB),
            ("limits.min_free_inodes", limits.min_free_inodes, 0, 1 << 40),
            ("limits.max_frames", limits.max_frames.into(), 2, 1 << 20),
            ("limits.max_wait_seconds", limits.max_wait_seconds, 0, YEARS),
            (
                "limits.max_queue_seconds",
                limits.max_queue_seconds,
                0,
                YEARS,
            ),
            (
                "limits.max_tenant_queue_seconds",
                limits.max_tenant_queue_seconds,
                0,
                YEARS,
            ),
            (
                "limits.max_connections",
                count(limits.max_connections),
                1,
                1 << 20,
            ),
            (
                "limits.header_timeout_seconds",
                limits.header_timeout_seconds,
                1,
                3600,
            ),
            (
                "limits.body_timeout_seconds",
                limits.body_timeout_seconds,
                1,
                3600,
            ),
            (
                "limits.write_timeout_seconds",
                limits.write_timeout_seconds,
                1,
                3600,
            ),
            (
                "limits.sequence_ahead",
                count(limits.sequence_ahead),
                1,
                1000,
            ),
            ("queue.max_attempts", queue.max_attempts.into(), 1, 1000),
            ("queue.max_crashes", queue.max_crashes.into(), 1, 1000),
            ("queue.lease_seconds", queue.lease_seconds, 1, YEARS),
            (
                "queue.retry_delay_seconds",
                queue.retry_delay_seconds,
                0,
                YEARS,
            ),
            (
                "queue.time_to_live_seconds",
                queue.time_to_live_seconds,
                1,
                YEARS,
            ),
            ("queue.retention_seconds", queue.retention_seconds, 1, YEARS),
            (
                "queue.answered_retention_seconds",
                queue.answered_retention_seconds,
                1,
                YEARS,
            ),
            ("drain.deadline_seconds", drain.deadline_seconds, 0, YEARS),
        ]
    }
}
