//! Failures and timeouts: deadlines, retries, lost leases, crashes and retention.

use super::*;

pub(crate) async fn a_deadline_that_passes_in_the_queue_ends_the_job_without_any_worker(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let late = Submission {
        deadline: Some(Timestamp::now().after(Duration::from_millis(60))),
        ..submission("a")
    };
    let job = submit(&queue, late).await;
    let expired = reaches(&queue, &job, State::Expired).await;
    let error = expired.error.as_ref().expect("a reason");
    assert_eq!(error.code, "deadline_in_queue");
    nothing_is_ready(&queue).await;
    assert_eq!(queue.backlog().queued().jobs, 0);
}

pub(crate) async fn failures_are_retried_later_and_given_up_in_the_end(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(quick()).await;
    let job = submit(&queue, submission("a")).await;
    for attempt in 1..=3 {
        let held = lease(&queue).await;
        assert_eq!((held.job.id, held.job.attempt), (job.id, attempt));
        let committed = finish(&queue, &held.job, failure(true)).await;
        let expected = if attempt < 3 {
            State::Queued
        } else {
            State::Failed
        };
        assert_eq!(committed, Committed::Yes(expected));
    }
    let dead = queue.job(&job.tenant, job.id).await.expect("known");
    assert!(dead.dead);
    assert_eq!(
        dead.error.as_ref().map(|error| error.code.as_str()),
        Some("broken")
    );
    let again = queue.requeue(job.id, false).await.expect("it has ended");
    assert!(!again.dead && again.state == State::Queued && again.error.is_none());
    assert_eq!(lease(&queue).await.job.attempt, 4);
    let running = queue.requeue(job.id, false).await;
    assert_eq!(running, Err(QueueError::NotTerminal(State::Running)));
}

pub(crate) async fn an_error_of_the_input_is_not_retried(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    submit(&queue, submission("a")).await;
    let held = lease(&queue).await;
    let committed = finish(&queue, &held.job, failure(false)).await;
    assert_eq!(committed, Committed::Yes(State::Failed));
    let failed = queue
        .job(&held.job.tenant, held.job.id)
        .await
        .expect("known");
    assert!(!failed.dead);
}

pub(crate) async fn a_released_job_is_queued_again_without_blame(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    submit(&queue, submission("a")).await;
    for attempt in 1..=6 {
        let held = lease(&queue).await;
        assert_eq!(held.job.attempt, attempt);
        let committed = finish(&queue, &held.job, Outcome::Released).await;
        assert_eq!(committed, Committed::Yes(State::Queued));
    }
}

pub(crate) async fn a_silent_worker_loses_its_lease_and_its_late_result(stand: &mut impl Stand) {
    let (queue, mut events) = stand.open(quick()).await;
    let job = submit(&queue, submission("a")).await;
    let zombie = lease(&queue).await;
    let heir = lease(&queue).await;
    assert_eq!((heir.job.id, heir.job.attempt), (job.id, 2));
    assert_eq!(zombie.heartbeat.beat(None), Signal::Lost);
    assert_eq!(finish(&queue, &zombie.job, done()).await, Committed::Fenced);
    assert_eq!(state(&queue, &job).await, State::Running);
    // Heartbeats keep the lease for many times its length.
    for _ in 0..20 {
        tokio::time::sleep(Duration::from_millis(50)).await;
        assert_eq!(heir.heartbeat.beat(None), Signal::Continue);
    }
    assert_eq!(
        finish(&queue, &heir.job, done()).await,
        Committed::Yes(State::Succeeded)
    );
    let mut expiries = 0;
    while let Ok(event) = events.try_recv() {
        expiries += u32::from(matches!(event, Event::LeaseExpired(_)));
    }
    assert_eq!(expiries, 1);
}

pub(crate) async fn a_crash_keeps_promises_and_forgets_what_nobody_waits_for(
    stand: &mut impl Stand,
) {
    let (queue, events) = stand.open(QueueOptions::default()).await;
    let running = submit(&queue, submission("a")).await;
    let held = lease(&queue).await;
    let waiting = submit(&queue, submission("a")).await;
    let awaited = Submission {
        durable: false,
        ..submission("a")
    };
    let awaited = submit(&queue, awaited).await;
    let ended = submit(&queue, submission("b")).await;
    let other = lease(&queue).await;
    assert_eq!(other.job.id, ended.id);
    finish(&queue, &other.job, done()).await;
    drop((queue, events));

    let (queue, mut events) = stand.open(QueueOptions::default()).await;
    assert_eq!(state(&queue, &ended).await, State::Succeeded);
    let gone = queue.job(&awaited.tenant, awaited.id).await;
    assert_eq!(gone, Err(QueueError::NotFound));
    let deleted = |event: &Event| matches!(event, Event::Deleted(id) if *id == awaited.id);
    let mut told = false;
    while let Ok(event) = events.try_recv() {
        told |= deleted(&event);
    }
    assert!(told, "nobody was told to clean up");
    assert_eq!(queue.backlog().queued().jobs, 2);
    let resumed = lease(&queue).await;
    assert_eq!((resumed.job.id, resumed.job.attempt), (running.id, 2));
    assert_eq!(finish(&queue, &held.job, done()).await, Committed::Fenced);
    assert_eq!(lease(&queue).await.job.id, waiting.id);
}

pub(crate) async fn a_job_that_kills_the_process_again_and_again_is_given_up(
    stand: &mut impl Stand,
) {
    let options = QueueOptions {
        max_crashes: 3,
        ..QueueOptions::default()
    };
    let (mut queue, mut events) = stand.open(options.clone()).await;
    let job = submit(&queue, submission("a")).await;
    for crash in 1..=5 {
        let held = lease(&queue).await;
        // The second run stores a snapshot, which resets the crash counter.
        if crash == 2 {
            held.heartbeat.snapshot_kept();
            queue.make_durable(job.id).await.expect("known");
        }
        drop((queue, events));
        (queue, events) = stand.open(options.clone()).await;
        let expected = if crash == 4 {
            State::Failed
        } else {
            State::Queued
        };
        let now = queue.job(&job.tenant, job.id).await.expect("known");
        assert_eq!(now.state, expected, "after {crash} crashes");
        if now.state == State::Failed {
            assert!(now.dead);
            return;
        }
    }
}

pub(crate) async fn a_job_made_durable_survives(stand: &mut impl Stand) {
    let (queue, events) = stand.open(QueueOptions::default()).await;
    let awaited = Submission {
        durable: false,
        ..submission("a")
    };
    let job = submit(&queue, awaited).await;
    assert!(queue.make_durable(job.id).await.expect("known").durable);
    drop((queue, events));
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    assert_eq!(state(&queue, &job).await, State::Queued);
}

pub(crate) async fn ended_jobs_are_kept_for_a_while_and_then_deleted(stand: &mut impl Stand) {
    let (queue, mut events) = stand
        .open(QueueOptions {
            retention: Duration::from_millis(80),
            ..QueueOptions::default()
        })
        .await;
    let job = submit(&queue, sequence(1)).await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let mut deleted = Vec::new();
    while deleted.len() < 2 {
        let event = timeout(PATIENCE, events.recv()).await.expect("in time");
        if let Some(Event::Deleted(id)) = event {
            deleted.push(id);
        }
    }
    assert!(deleted.contains(&job.id) && deleted.contains(&held.job.id));
    let gone = queue.job(&job.tenant, job.id).await;
    assert_eq!(gone, Err(QueueError::NotFound));
    let known = queue.known(vec![job.id]).await.expect("an answer");
    assert_eq!(known, []);
}

pub(crate) async fn an_abandoned_job_ends_and_gives_up_its_key_unless_it_was_promised(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let keyed = || Submission {
        durable: false,
        idempotency: Some(Idempotency {
            key: "k".to_owned(),
            fingerprint: [1; 32],
        }),
        ..submission("a")
    };
    let first = submit(&queue, keyed()).await;
    queue.abandon(first.id).await.expect("known");
    assert_eq!(state(&queue, &first).await, State::Cancelled);
    // A new submission with the same key must not find the abandoned job.
    let second = submit(&queue, keyed()).await;
    assert_ne!(second.id, first.id);
    queue.make_durable(second.id).await.expect("known");
    queue.abandon(second.id).await.expect("known");
    assert_eq!(state(&queue, &second).await, State::Queued);
    queue.abandon(JobId::fresh()).await.expect("nothing to do");
}

pub(crate) async fn jobs_that_come_and_go_at_once_are_not_counted_any_more(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    for _ in 0..50 {
        let (_, first, second) = tokio::join!(
            async {
                submit(&queue, submission("a")).await;
                submit(&queue, submission("b")).await;
            },
            lease(&queue),
            lease(&queue),
        );
        finish(&queue, &first.job, done()).await;
        finish(&queue, &second.job, done()).await;
    }
    // Several nodes count now and then, and one of their counts may be under way.
    let counted = || {
        let backlog = queue.backlog();
        backlog.queued().jobs + backlog.running().jobs
    };
    let gone = async {
        while counted() > 0 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    timeout(PATIENCE, gone).await.expect("none is counted");
}

pub(crate) async fn a_cancelled_job_whose_worker_is_silent_is_not_tried_again(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(quick()).await;
    let job = submit(&queue, submission("a")).await;
    let silent = lease(&queue).await;
    queue.cancel(job.id).await.expect("known");
    reaches(&queue, &job, State::Cancelled).await;
    nothing_is_ready(&queue).await;
    let late = finish(&queue, &silent.job, done()).await;
    assert_eq!(late, Committed::Fenced);
}

pub(crate) async fn a_job_that_is_asked_for_again_waits_for_its_turn(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let old = submit(&queue, submission("a")).await;
    queue.cancel(old.id).await.expect("known");
    let mut waiting = Vec::new();
    for _ in 0..3 {
        waiting.push(submit(&queue, submission("a")).await.id);
    }
    queue.requeue(old.id, false).await.expect("it has ended");
    waiting.push(old.id);
    for id in waiting {
        assert_eq!(lease(&queue).await.job.id, id);
    }
    let held = lease_of_a_success(&queue).await;
    let refused = queue.requeue(held, false).await;
    assert_eq!(refused, Err(QueueError::NotTerminal(State::Succeeded)));
}

async fn lease_of_a_success(queue: &Arc<dyn Queue>) -> JobId {
    let job = submit(queue, submission("b")).await;
    let held = lease(queue).await;
    finish(queue, &held.job, done()).await;
    job.id
}
