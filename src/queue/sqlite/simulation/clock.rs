//! Tests of a wall clock that is set while the queue is open.

use std::time::{Duration, Instant};

use super::calls::{Answer, Asked, Call};
use super::process::{Disk, Process};
use super::promises::Promises;
use crate::clock::Timestamp;
use crate::job::State;
use crate::queue::contract_tests::submission;
use crate::queue::time;

const DAY_MS: i64 = 24 * 3600 * 1000;

/// A process with one job, and both clocks.
struct Stand {
    process: Process,
    wall: Timestamp,
    monotonic: Instant,
}

impl Stand {
    fn new() -> Self {
        let (wall, monotonic) = (Timestamp::from_millis(50 * DAY_MS), Instant::now());
        time::set(wall, monotonic);
        let mut process = Process::start(Disk::new(), &Promises::options(), true);
        let queue = std::sync::Arc::clone(&process.queue);
        let submitting = async move { queue.submit(submission("a")).await.map(Answer::Submitted) };
        let mut call = Call::new(Asked::Other, submitting);
        assert!(call.poll().is_none());
        process.turn(false);
        assert!(matches!(call.poll(), Some(Ok(Answer::Submitted(_)))));
        Self {
            process,
            wall,
            monotonic,
        }
    }

    /// The process ends, the wall clock is set by this many milliseconds, and the next one starts.
    fn restarted(self, set_ms: i64) -> Self {
        let wall = self.wall.on_clock_ahead(set_ms);
        time::set(wall, self.monotonic);
        let disk = self.process.end();
        Self {
            process: Process::start(disk, &Promises::options(), true),
            wall,
            ..self
        }
    }

    /// Time passes, and the wall clock is set by this many milliseconds.
    fn pass(&mut self, seconds: u64, set_ms: i64) {
        let passed = Duration::from_secs(seconds);
        self.wall = self.wall.after(passed).on_clock_ahead(set_ms);
        self.monotonic += passed;
        time::set(self.wall, self.monotonic);
        self.process.turn(false);
    }

    /// The state of the job; `None` once it is deleted.
    fn state(&self) -> Option<State> {
        self.process.with(|connection| {
            let mut statement = connection.prepare("SELECT state FROM jobs").expect("SQL");
            let mut rows = statement.query([]).expect("rows");
            let row = rows.next().expect("a row or none");
            row.map(|row| State::ALL[row.get::<_, i64>(0).expect("a state") as usize])
        })
    }
}

#[test]
fn a_job_waits_and_is_kept_as_long_as_promised_when_the_wall_clock_is_set() {
    // By the options of the simulation it may wait for 60 s, and is kept for 100 s after its end.
    for set_ms in [-DAY_MS, -60_000, 60_000, DAY_MS] {
        let mut stand = Stand::new();
        stand.pass(50, set_ms);
        assert_eq!(stand.state(), Some(State::Queued), "{set_ms}");
        stand.pass(11, 0);
        assert_eq!(stand.state(), Some(State::Expired), "{set_ms}");
        stand.pass(90, -set_ms);
        assert_eq!(stand.state(), Some(State::Expired), "{set_ms}");
        stand.pass(11, 0);
        assert_eq!(stand.state(), None, "{set_ms}");
    }
}

#[test]
fn what_a_clock_that_was_ahead_has_promised_is_due_in_time_after_a_restart() {
    let mut stand = Stand::new().restarted(-DAY_MS);
    stand.pass(50, 0);
    assert_eq!(stand.state(), Some(State::Queued));
    stand.pass(11, 0);
    assert_eq!(stand.state(), Some(State::Expired));
    let mut stand = stand.restarted(-DAY_MS);
    stand.pass(101, 0);
    assert_eq!(stand.state(), None);
}
