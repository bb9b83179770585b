//! Device requirements: which device kind runs a job, and jobs whose device is lost or too small.

use tokio_util::sync::CancellationToken;

use super::*;

fn needs(kind: DeviceKind) -> Submission {
    Submission {
        device: Some(kind),
        ..submission("a")
    }
}

pub(crate) async fn a_job_goes_only_to_the_kind_of_device_that_it_needs(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let gpu = submit(&queue, needs(DeviceKind::Gpu)).await;
    assert_eq!(gpu.device, Some(DeviceKind::Gpu));
    nothing_is_ready_for(&queue, DeviceKind::Cpu).await;
    let held = lease_on(&queue, DeviceKind::Gpu).await;
    assert_eq!(held.job.id, gpu.id);
    let cpu = submit(&queue, needs(DeviceKind::Cpu)).await;
    nothing_is_ready_for(&queue, DeviceKind::Gpu).await;
    assert_eq!(lease_on(&queue, DeviceKind::Cpu).await.job.id, cpu.id);
    for kind in DeviceKind::ALL {
        let any = submit(&queue, submission("a")).await;
        assert_eq!(lease_on(&queue, kind).await.job.id, any.id);
    }
}

pub(crate) async fn jobs_that_wait_for_one_kind_hold_up_no_other(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let urgent = Submission {
        priority: Priority::High,
        ..needs(DeviceKind::Gpu)
    };
    let urgent = submit(&queue, urgent).await;
    for _ in 0..20 {
        submit(&queue, needs(DeviceKind::Gpu)).await;
    }
    let first = submit(&queue, submission("a")).await;
    let second = submit(&queue, needs(DeviceKind::Cpu)).await;
    // Jobs that this kind may run keep their order, whether they require it or not.
    assert_eq!(lease_on(&queue, DeviceKind::Cpu).await.job.id, first.id);
    assert_eq!(lease_on(&queue, DeviceKind::Cpu).await.job.id, second.id);
    nothing_is_ready_for(&queue, DeviceKind::Cpu).await;
    assert_eq!(lease_on(&queue, DeviceKind::Gpu).await.job.id, urgent.id);
    let ahead = |kind| queue.backlog().ahead_of(Priority::Low, 1.0, kind);
    assert_eq!(ahead(Some(DeviceKind::Gpu)), 20.0);
    let only_for = |kind| queue.backlog().queued_only_for(kind).jobs;
    assert_eq!(DeviceKind::ALL.map(only_for), [0, 20]);
    assert_eq!((ahead(Some(DeviceKind::Cpu)), ahead(None)), (0.0, 0.0));
}

pub(crate) async fn a_worker_that_leaves_claims_nothing(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let leave = CancellationToken::new();
    let until = std::pin::pin!(leave.cancelled());
    let mut asking = queue.lease_until("worker", DeviceKind::Cpu, until);
    let soon = timeout(Duration::from_millis(50), &mut asking).await;
    assert!(soon.is_err(), "no job is ready");
    // Both happen before the worker looks again.
    let job = submit(&queue, submission("a")).await;
    leave.cancel();
    let asked = timeout(PATIENCE, asking).await.expect("in time");
    assert!(asked.expect("the store works").is_none());
    let held = lease(&queue).await;
    assert_eq!((held.job.id, held.job.attempt), (job.id, 1));
}

pub(crate) async fn a_job_that_moves_waits_for_the_other_kind_without_blame(
    stand: &mut impl Stand,
) {
    let options = QueueOptions {
        max_attempts: 1,
        max_crashes: 1,
        ..QueueOptions::default()
    };
    let (queue, _events) = stand.open(options).await;
    let job = submit(&queue, submission("a")).await;
    let held = lease_on(&queue, DeviceKind::Gpu).await;
    let moved = finish(&queue, &held.job, Outcome::Moved(DeviceKind::Cpu)).await;
    assert_eq!(moved, Committed::Yes(State::Queued));
    nothing_is_ready_for(&queue, DeviceKind::Gpu).await;
    let held = lease_on(&queue, DeviceKind::Cpu).await;
    assert_eq!((held.job.id, held.job.attempt), (job.id, 2));
    assert_eq!(queue.backlog().queued().jobs, 0);
    assert_eq!(queue.backlog().running().jobs, 1);
    finish(&queue, &held.job, done()).await;
    reaches(&queue, &job, State::Succeeded).await;
}

pub(crate) async fn a_device_that_dies_under_a_job_again_and_again_ends_it(stand: &mut impl Stand) {
    let options = QueueOptions {
        max_attempts: 1,
        max_crashes: 3,
        ..QueueOptions::default()
    };
    let (queue, _events) = stand.open(options).await;
    let job = submit(&queue, submission("a")).await;
    let crash = || {
        Outcome::Crashed(JobError {
            code: "device_lost".to_owned(),
            message: "the device was lost".to_owned(),
            retryable: true,
        })
    };
    for death in 1..=4 {
        let held = lease(&queue).await;
        // The second run stores a snapshot, which resets the crash counter.
        if death == 2 {
            held.heartbeat.snapshot_kept();
        }
        let committed = finish(&queue, &held.job, crash()).await;
        let expected = if death < 4 {
            State::Queued
        } else {
            State::Failed
        };
        assert_eq!(committed, Committed::Yes(expected), "after {death} deaths");
    }
    let ended = queue.job(&job.tenant, job.id).await.expect("known");
    assert!(ended.dead);
    let code = ended.error.as_ref().map(|error| error.code.as_str());
    assert_eq!(code, Some("device_lost"));
}

pub(crate) async fn jobs_for_a_kind_survive_a_crash(stand: &mut impl Stand) {
    let (queue, events) = stand.open(QueueOptions::default()).await;
    let waiting = submit(&queue, needs(DeviceKind::Gpu)).await;
    drop((queue, events));
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    nothing_is_ready_for(&queue, DeviceKind::Cpu).await;
    assert_eq!(lease_on(&queue, DeviceKind::Gpu).await.job.id, waiting.id);
}
