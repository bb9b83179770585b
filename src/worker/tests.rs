//! A worker on a real queue and store, with a device that fails on command.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::run::{Drain, Worker, WorkerOptions};
use crate::cost::{CostModel, Lanes};
use crate::engine::{Device, Health, Switches};
use crate::flow::{MotionField, Point};
use crate::job::{DeviceKind, Job, JobError, JobId, Kind, Priority, State, Tenant};
use crate::metrics::Metrics;
use crate::payload::{StoredCloud, StoredFlow};
use crate::queue::{Outcome, PairOf, Queue, QueueOptions, Submission, Submitted, open_sqlite};
use crate::storage::{Blob, Blobs, Fsync};

/// Timeout, long enough for a loaded machine. Only a failing test waits this long.
const PATIENCE: Duration = Duration::from_secs(120);

/// Points of the tests' pairs; differs from the pair of the self-test.
const POINTS: usize = 900;

/// A worker with its queue, store and device, in a temporary folder.
struct Stand {
    queue: Arc<dyn Queue>,
    blobs: Blobs,
    worker: Worker,
    switches: Arc<Switches>,
    _folder: tempfile::TempDir,
}

async fn stand() -> Stand {
    stand_with(1, None).await
}

async fn stand_with(lanes: usize, overflow_kind: Option<DeviceKind>) -> Stand {
    let folder = tempfile::tempdir().expect("a folder");
    let options = QueueOptions {
        retry_delay: Duration::from_millis(20),
        ..QueueOptions::default()
    };
    let (events, _) = mpsc::unbounded_channel();
    let queue = open_sqlite(folder.path(), options, events).expect("a queue");
    let blobs = Blobs::open(&folder.path().join("blobs")).expect("a store");
    blobs.set_identity(queue.identity()).await.expect("written");
    let switches = Arc::new(Switches::default());
    let metrics = Arc::new(Metrics::new(&["fragile"]));
    let device = Device::start(switches.gpu("fragile", lanes), &metrics).expect("a thread");
    let mut health = device.health();
    let ready = health.wait_for(|health| *health == Health::Ready);
    timeout(PATIENCE, ready)
        .await
        .expect("in time")
        .expect("a thread");
    let worker = Worker {
        queue: Arc::clone(&queue),
        blobs: blobs.clone(),
        lane: device.lanes().next().expect("a lane"),
        cost: Arc::new(CostModel::new(Lanes { cpu: 0, gpu: 1 })),
        metrics,
        options: WorkerOptions {
            snapshot_interval: Duration::from_secs(1),
            overflow_kind,
        },
        drain: Drain::default(),
        isolation: Arc::default(),
        store: Arc::new(crate::worker::StoreProbe::new(
            Arc::clone(&queue),
            blobs.clone(),
            Arc::default(),
        )),
    };
    Stand {
        queue,
        blobs,
        worker,
        switches,
        _folder: folder,
    }
}

/// A wall of points, and the same wall 0.1 m further along x.
fn clouds() -> [Vec<Point>; 2] {
    let source: Vec<Point> = (0..900u16)
        .map(|i| [8.0, f32::from(i % 30) * 0.2, f32::from(i / 30) * 0.2])
        .collect();
    let target = source.iter().map(|[x, y, z]| [x + 0.1, *y, *z]).collect();
    [source, target]
}

impl Stand {
    async fn submit(&self, sweeps: usize) -> Arc<Job> {
        self.submit_after(sweeps, None).await
    }

    /// Submits a pair that follows the job `after`.
    async fn submit_after(&self, sweeps: usize, after: Option<JobId>) -> Arc<Job> {
        self.submit_clouds(clouds().into_iter().take(sweeps), after)
            .await
    }

    async fn submit_clouds(
        &self,
        clouds: impl Iterator<Item = Vec<Point>>,
        after: Option<JobId>,
    ) -> Arc<Job> {
        let id = JobId::fresh();
        for (index, points) in (0..).zip(clouds) {
            let cloud = StoredCloud {
                points,
                ..StoredCloud::default()
            };
            let bytes = Bytes::from(cloud.to_bytes());
            let put = self.blobs.put(id, Blob::Sweep(index), bytes, Fsync::No);
            put.await.expect("written");
        }
        let submission = Submission {
            id,
            tenant: Tenant::default(),
            kind: Kind::Pair,
            pair: PairOf::ALONE,
            pairs: Vec::new(),
            finalizer_seconds: None,
            labels: Vec::new(),
            trace: None,
            webhook: None,
            result_uri: None,
            after,
            has_dependents: true,
            priority: Priority::Normal,
            device: None,
            cost_seconds: 0.1,
            options: r#"{"preset": "neural"}"#.to_owned(),
            deadline: None,
            idempotency: None,
            durable: true,
        };
        match self.queue.submit(submission).await.expect("accepted") {
            Submitted::New(job) | Submitted::Known(job) => job,
        }
    }

    async fn ended(&self, job: &Job) -> Arc<Job> {
        let mut news = self.queue.watch(job.id).await.expect("known");
        let ended = timeout(PATIENCE, news.wait_for(|job| job.state.is_end())).await;
        Arc::clone(&ended.expect("in time").expect("followed"))
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_panic_costs_one_attempt_of_one_job_and_the_device_works_again() {
    let stand = stand().await;
    stand.switches.panics.store(1, Ordering::Relaxed);
    let (first, second) = (stand.submit(2).await, stand.submit(2).await);
    tokio::spawn(stand.worker.clone().run());
    let (first, second) = (stand.ended(&first).await, stand.ended(&second).await);
    assert_eq!(
        (first.state, second.state),
        (State::Succeeded, State::Succeeded)
    );
    assert_eq!(first.attempt + second.attempt, 3);
    for job in [first, second] {
        let bytes = stand.blobs.get(job.id, Blob::Result(job.attempt)).await;
        let flow = StoredFlow::from_bytes(&bytes.expect("stored")).expect("whole");
        assert_eq!(flow.flow.len(), POINTS);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_panics_every_time_is_given_up_and_the_next_one_is_done() {
    let stand = stand().await;
    // Only pairs of this size panic, so the self-tests between the attempts pass.
    stand.switches.panics.store(3, Ordering::Relaxed);
    let poison = stand.submit(2).await;
    tokio::spawn(stand.worker.clone().run());
    let given_up = stand.ended(&poison).await;
    assert_eq!((given_up.state, given_up.attempt), (State::Failed, 3));
    assert!(given_up.dead);
    let error = given_up.error.as_ref().expect("a reason");
    assert_eq!(error.code, "panicked");
    assert!(
        error.message.contains("the device has slipped"),
        "{}",
        error.message
    );
    let next = stand.submit(2).await;
    assert_eq!(stand.ended(&next).await.state, State::Succeeded);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_payload_that_is_gone_fails_its_job_and_no_other() {
    let stand = stand().await;
    tokio::spawn(stand.worker.clone().run());
    let half = stand.submit(1).await;
    let whole = stand.submit(2).await;
    let half = stand.ended(&half).await;
    assert_eq!(half.state, State::Failed);
    assert_eq!(half.error.as_ref().expect("a reason").code, "store");
    assert_eq!(stand.ended(&whole).await.state, State::Succeeded);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pair_leaves_its_field_and_starts_afresh_where_the_one_before_has_left_none() {
    let stand = stand().await;
    tokio::spawn(stand.worker.clone().run());
    let alone = stand.submit(2).await;
    let half = stand.submit_after(1, Some(alone.id)).await;
    let afresh = stand.submit_after(2, Some(half.id)).await;
    let unknown = stand.submit_after(2, Some(JobId::fresh())).await;
    let mut flows = Vec::new();
    for (job, state) in [
        (alone, State::Succeeded),
        (half, State::Failed),
        (afresh, State::Succeeded),
        (unknown, State::Succeeded),
    ] {
        let job = stand.ended(&job).await;
        assert_eq!(job.state, state);
        if state == State::Succeeded {
            let field = stand.blobs.get(job.id, Blob::Field(job.attempt)).await;
            MotionField::from_bytes(&field.expect("stored")).expect("whole");
            let bytes = stand.blobs.get(job.id, Blob::Result(job.attempt)).await;
            flows.push(StoredFlow::from_bytes(&bytes.expect("stored")).expect("whole"));
        }
    }
    let [alone, afresh, unknown] = &flows[..] else {
        panic!("{} flows", flows.len());
    };
    assert!(afresh.flow == alone.flow && unknown.flow == alone.flow);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_is_told_to_stop_finishes_what_it_has_and_takes_nothing_more() {
    let stand = stand().await;
    let running = tokio::spawn(stand.worker.clone().run());
    let first = stand.submit(2).await;
    stand.ended(&first).await;
    stand.worker.drain.stop.cancel();
    timeout(PATIENCE, running)
        .await
        .expect("in time")
        .expect("no panic");
    let second = stand.submit(2).await;
    let left = stand
        .queue
        .job(&second.tenant, second.id)
        .await
        .expect("known");
    assert_eq!(left.state, State::Queued);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_whose_lane_has_ended_gives_its_job_back_and_takes_nothing_more() {
    let stand = stand().await;
    stand.switches.tears.store(true, Ordering::Relaxed);
    let job = stand.submit(2).await;
    let running = tokio::spawn(stand.worker.clone().run());
    timeout(PATIENCE, running)
        .await
        .expect("in time")
        .expect("no panic");
    let left = stand.queue.job(&job.tenant, job.id).await.expect("known");
    assert_eq!(left.state, State::Queued);
    assert!(left.attempt <= 1, "it was leased again");
    assert!(stand.worker.lane.device().not_ready_reason().is_some());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_device_returns_the_job_to_the_queue_and_does_it_again() {
    let stand = stand().await;
    stand.switches.brake.store(true, Ordering::Relaxed);
    let job = stand.submit(2).await;
    tokio::spawn(stand.worker.clone().run());
    stand.switches.until_at_the_brake(1).await;
    stand.switches.destroy();
    stand.switches.brake.store(false, Ordering::Relaxed);
    let done = stand.ended(&job).await;
    assert_eq!((done.state, done.attempt), (State::Succeeded, 2));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_idle_lane_of_a_lost_device_takes_no_job_until_the_device_is_open_again() {
    let stand = stand_with(2, None).await;
    stand.switches.brake.store(true, Ordering::Relaxed);
    let job = stand.submit(2).await;
    for lane in stand.worker.lane.device().lanes() {
        let worker = stand.worker.clone();
        tokio::spawn(Worker { lane, ..worker }.run());
    }
    stand.switches.until_at_the_brake(1).await;
    stand.switches.refusals.store(2, Ordering::Relaxed);
    stand.switches.destroy();
    stand.switches.brake.store(false, Ordering::Relaxed);
    let done = stand.ended(&job).await;
    assert_eq!((done.state, done.attempt), (State::Succeeded, 2));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pair_that_does_not_fit_moves_where_there_is_another_kind_and_fails_where_there_is_none()
{
    for overflow_kind in [Some(DeviceKind::Cpu), None] {
        let stand = stand_with(1, overflow_kind).await;
        stand.switches.room.store(POINTS - 1, Ordering::Relaxed);
        let job = stand.submit(2).await;
        tokio::spawn(stand.worker.clone().run());
        if overflow_kind.is_some() {
            let mut news = stand.queue.watch(job.id).await.expect("known");
            let moves = news.wait_for(|job| job.device == Some(DeviceKind::Cpu));
            let moving = timeout(PATIENCE, moves).await.expect("in time");
            drop(moving.expect("followed"));
            let moved = timeout(PATIENCE, stand.queue.lease("cpu", DeviceKind::Cpu)).await;
            let moved = moved.expect("in time").expect("a lease").job;
            assert_eq!((moved.id, moved.attempt), (job.id, 2));
        } else {
            let refused = stand.ended(&job).await;
            assert_eq!((refused.state, refused.attempt), (State::Failed, 1));
            let error = refused.error.as_ref().expect("a reason");
            assert_eq!(
                (error.code.as_str(), error.retryable),
                ("input_refused", false)
            );
            assert!(!refused.dead && error.message.contains("the device has"));
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pair_that_kills_every_device_is_given_up_and_nothing_beside_it_is() {
    const LANES: usize = 3;
    const DEADLY: usize = POINTS - 30;
    let stand = stand_with(LANES, None).await;
    stand.switches.deadly.store(DEADLY, Ordering::Relaxed);
    // All pairs start together, so the first loss also fails the pairs beside the faulty one.
    stand.switches.brake.store(true, Ordering::Relaxed);
    let fewer = clouds().map(|cloud| cloud[..DEADLY].to_vec());
    let guilty = stand.submit_clouds(fewer.into_iter(), None).await;
    let mut innocent = Vec::new();
    for _ in 0..2 * LANES {
        innocent.push(stand.submit(2).await);
    }
    for lane in stand.worker.lane.device().lanes() {
        let worker = Worker {
            lane,
            ..stand.worker.clone()
        };
        tokio::spawn(worker.run());
    }
    stand.switches.until_at_the_brake(LANES).await;
    stand.switches.brake.store(false, Ordering::Relaxed);
    let given_up = stand.ended(&guilty).await;
    assert_eq!((given_up.state, given_up.dead), (State::Failed, true));
    let error = given_up.error.as_ref().expect("a reason");
    assert_eq!(error.code, "device_lost");
    for job in &innocent {
        let done = stand.ended(job).await;
        assert_eq!(done.state, State::Succeeded, "{:?}", done.error);
        assert!(done.crashes <= 2, "{} crashes", done.crashes);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_jobs_that_may_kill_the_process_one_is_held_at_a_time_and_nothing_beside_it() {
    const LANES: usize = 3;
    let stand = stand_with(LANES, None).await;
    let mut jobs = vec![stand.submit(2).await, stand.submit(2).await];
    for _ in 0..2 {
        let queue = &stand.queue;
        let held = [
            queue.lease("gpu", DeviceKind::Gpu).await,
            queue.lease("gpu", DeviceKind::Gpu).await,
        ];
        for held in held.map(|held| held.expect("a lease").job) {
            let died = JobError {
                code: "device_lost".to_owned(),
                message: "it died".to_owned(),
                retryable: true,
            };
            let ended = queue.finish(held.id, held.attempt, Outcome::Crashed(died));
            ended.await.expect("kept");
        }
    }
    for _ in 0..LANES {
        jobs.push(stand.submit(2).await);
    }
    stand.switches.brake.store(true, Ordering::Relaxed);
    for lane in stand.worker.lane.device().lanes() {
        let worker = Worker {
            lane,
            ..stand.worker.clone()
        };
        tokio::spawn(worker.run());
    }
    let suspects = jobs[..2].to_vec();
    let held = async || {
        let mut held = Vec::new();
        for job in &jobs {
            let now = stand.queue.job(&job.tenant, job.id).await.expect("known");
            if now.state == State::Running {
                held.push(now.id);
            }
        }
        held
    };
    let only_a_suspect = async {
        loop {
            let held = held().await;
            if stand.switches.at_the_brake.load(Ordering::Relaxed) == 1
                && suspects.iter().any(|job| held == [job.id])
            {
                break;
            }
            // A job that another worker had leased before is let through.
            stand.switches.brake.store(false, Ordering::Relaxed);
            tokio::time::sleep(Duration::from_millis(1)).await;
            stand.switches.brake.store(true, Ordering::Relaxed);
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    timeout(PATIENCE, only_a_suspect)
        .await
        .expect("it is alone in the end");
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert_eq!(held().await.len(), 1);
    stand.switches.brake.store(false, Ordering::Relaxed);
    for job in &jobs {
        assert_eq!(stand.ended(job).await.state, State::Succeeded);
    }
}
