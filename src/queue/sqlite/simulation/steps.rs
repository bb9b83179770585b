//! The steps of a schedule, read from its bytes.

use std::time::Duration;

use crate::clock::Timestamp;
use crate::job::{DeviceKind, JobError, JobId, Kind, Priority};
use crate::queue::types::{Idempotency, Outcome, PairOf, Submission};

/// Workers.
pub(in crate::queue) const WORKERS: usize = 4;

/// The unread bytes of a schedule; zeros after its end.
pub(in crate::queue) struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    pub(in crate::queue) fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    pub(in crate::queue) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn byte(&mut self) -> u8 {
        let (first, rest) = self.0.split_first().unwrap_or((&0, &[]));
        self.0 = rest;
        *first
    }

    /// An index into a list of this length, which is not 0.
    fn index(&mut self, length: usize) -> usize {
        usize::from(self.byte()) % length
    }

    fn choice<T: Copy>(&mut self, all: &[T]) -> T {
        all[self.index(all.len())]
    }

    /// One of the bits of a byte that was read.
    fn bit(byte: u8, bit: u8) -> bool {
        byte >> bit & 1 == 1
    }
}

/// One step.
#[derive(Debug)]
pub(in crate::queue) enum Step {
    Submit(Box<Submission>),
    /// A worker asks for a job, unless it has one or waits for one.
    Lease(usize, DeviceKind),
    /// The worker ends its attempt.
    Finish(usize, Outcome),
    /// A worker ends an attempt that it once held.
    FinishAgain(usize, Outcome),
    Beat(usize),
    SnapshotKept(usize),
    /// Of the job with this index among all that were submitted.
    Cancel(usize),
    Abandon(usize),
    MakeDurable(usize),
    Requeue(usize, bool),
    Remove(usize),
    /// The caller of a pending call goes away.
    HangUp(usize),
    /// The writer commits.
    Turn,
    /// The writer's commit fails.
    FailingTurn,
    /// Time passes, and the writer looks after what is due.
    Advance(Duration),
    /// Time passes while the process is paused.
    Pause(Duration),
    /// The wall clock alone is set, by this many milliseconds.
    SetClock(i64),
    TakeOutgoing,
    /// An action is done, or is to be tried again.
    Settle(usize, bool),
    /// The process is killed.
    Kill,
    /// The machine loses its power.
    LosePower,
    /// The process stops in order.
    Stop,
}

impl Step {
    /// The next step. `jobs` tells how many jobs were submitted, `now` is the time.
    pub(in crate::queue) fn next(bytes: &mut Bytes<'_>, jobs: &[JobId], now: Timestamp) -> Self {
        let worker = |bytes: &mut Bytes<'_>| bytes.index(WORKERS);
        let job = |bytes: &mut Bytes<'_>| bytes.index(jobs.len().max(1));
        match bytes.byte() % 32 {
            0..5 => Self::Submit(Box::new(submission(bytes, jobs, now))),
            5..9 => {
                let worker = worker(bytes);
                Self::Lease(worker, bytes.choice(&DeviceKind::ALL))
            }
            9..12 => Self::Finish(worker(bytes), outcome(bytes)),
            12 => Self::FinishAgain(worker(bytes), outcome(bytes)),
            13 => Self::Beat(worker(bytes)),
            14 => Self::SnapshotKept(worker(bytes)),
            15 => Self::Cancel(job(bytes)),
            16 => Self::Abandon(job(bytes)),
            17 => Self::MakeDurable(job(bytes)),
            18 => {
                let job = job(bytes);
                Self::Requeue(job, bytes.byte() % 2 == 1)
            }
            19 => Self::Remove(job(bytes)),
            20 => Self::HangUp(usize::from(bytes.byte())),
            21..25 => Self::Turn,
            25 => Self::FailingTurn,
            26 => Self::Advance(Duration::from_millis(bytes.choice(&ADVANCES_MS))),
            27 => Self::SetClock(bytes.choice(&[-3_600_000, -1000, 1000, 3_600_000])),
            28 => Self::TakeOutgoing,
            29 => {
                let action = usize::from(bytes.byte());
                Self::Settle(action, bytes.byte().is_multiple_of(2))
            }
            30 => match bytes.byte() % 3 {
                0 => Self::Stop,
                1 => Self::LosePower,
                _ => Self::Kill,
            },
            _ => Self::Pause(Duration::from_millis(bytes.choice(&ADVANCES_MS))),
        }
    }
}

/// From less than a retry's delay to longer than any retention of the simulation.
const ADVANCES_MS: [u64; 8] = [1, 50, 500, 1000, 3000, 11_000, 40_000, 150_000];

/// The number of the next job that a schedule submits.
fn next_id(jobs: &[JobId]) -> JobId {
    let mut bytes = [0; 16];
    bytes[8..].copy_from_slice(&(jobs.len() as u64).to_be_bytes());
    JobId::from_bytes(bytes)
}

fn submission(bytes: &mut Bytes<'_>, jobs: &[JobId], now: Timestamp) -> Submission {
    let flags = bytes.byte();
    let more = bytes.byte();
    let tenant = bytes.choice(&["a", "b", "c"]).parse();
    let is_sequence = Bytes::bit(flags, 0) && Bytes::bit(flags, 1);
    let count = 1 + u32::from(more & 3);
    let pair = |index| PairOf {
        index,
        backward: Bytes::bit(more, 2),
        window: [index, index + 2],
        chained: Bytes::bit(flags, 2),
    };
    let of_device = bytes.byte();
    let closes = is_sequence && Bytes::bit(more, 3);
    let result_uri = match is_sequence && !closes {
        true => "s3://results/{index}.npz",
        false => "s3://results/one.npz",
    };
    let follows = Bytes::bit(flags, 3) && Bytes::bit(more, 4) && !is_sequence;
    Submission {
        id: next_id(jobs),
        kind: match is_sequence {
            true => Kind::Sequence,
            false => Kind::Pair,
        },
        pairs: (0..count * u32::from(is_sequence)).map(pair).collect(),
        finalizer_seconds: closes.then_some(2.0),
        after: jobs.last().copied().filter(|_| follows),
        has_dependents: Bytes::bit(more, 5),
        priority: match more >> 6 {
            0 => Priority::Low,
            3 => Priority::High,
            _ => Priority::Normal,
        },
        device: match of_device % 8 {
            0 => Some(DeviceKind::Cpu),
            1 => Some(DeviceKind::Gpu),
            _ => None,
        },
        cost_seconds: f64::from(bytes.byte() % 4) + 0.5,
        options: "{}".to_owned(),
        labels: match Bytes::bit(flags, 4) {
            true => vec!["of=simulation".to_owned()],
            false => Vec::new(),
        },
        webhook: Bytes::bit(flags, 5).then(|| "https://hooks.example/".to_owned()),
        result_uri: Bytes::bit(of_device, 3).then(|| result_uri.to_owned()),
        deadline: (Bytes::bit(flags, 6) && Bytes::bit(more, 1))
            .then(|| now.after(Duration::from_millis(bytes.choice(&ADVANCES_MS)))),
        idempotency: (Bytes::bit(flags, 7) && Bytes::bit(more, 0)).then(|| Idempotency {
            key: "k".to_owned(),
            fingerprint: [bytes.byte() % 2; 32],
        }),
        durable: !(Bytes::bit(flags, 7) && Bytes::bit(flags, 1)),
        ..Submission::pair(tenant.expect("a name"))
    }
}

fn outcome(bytes: &mut Bytes<'_>) -> Outcome {
    let error = |retryable| JobError {
        code: "broken".to_owned(),
        message: "it broke".to_owned(),
        retryable,
    };
    match bytes.byte() % 16 {
        0 => Outcome::Failed(error(false)),
        1..4 => Outcome::Failed(error(true)),
        4 => Outcome::Cancelled,
        5 => Outcome::Released,
        6 => Outcome::Delayed(error(true)),
        7 => Outcome::Moved(bytes.choice(&DeviceKind::ALL)),
        8 => Outcome::Crashed(error(true)),
        _ => succeeded(),
    }
}

/// A success.
pub(in crate::queue) fn succeeded() -> Outcome {
    Outcome::Succeeded {
        stop_reason: None,
        report: "{}".to_owned(),
        progress: None,
    }
}
