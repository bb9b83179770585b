//! Chains of dependent jobs, their share in fair queueing, and the closing job of a sequence.

use super::*;

fn after(job: &Job) -> Submission {
    Submission {
        after: Some(job.id),
        ..submission("a")
    }
}

/// A sequence whose pairs form one chain.
fn chain(pairs: u32) -> Submission {
    Submission {
        pairs: (0..pairs).map(|index| forward(index, index > 0)).collect(),
        ..sequence(0)
    }
}

/// A sequence of two chains of two pairs, one of them backward, and a closing job.
fn closing() -> Submission {
    let back = |index, chained| PairOf {
        index,
        backward: true,
        window: [index, index + 2],
        chained,
    };
    Submission {
        pairs: vec![
            forward(0, false),
            forward(1, true),
            back(1, false),
            back(0, true),
        ],
        finalizer_seconds: Some(5.0),
        ..sequence(0)
    }
}

async fn finish_next(queue: &Arc<dyn Queue>) -> Arc<Job> {
    let held = lease(queue).await;
    finish(queue, &held.job, done()).await;
    held.job
}

pub(crate) async fn a_queued_job_knows_how_many_start_before_it(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let of = async |job: &Job| queue.standing(job.id).await.expect("an answer");
    let mut mine = Vec::new();
    for _ in 0..3 {
        mine.push(submit(&queue, submission("a")).await);
    }
    let other = submit(&queue, submission("b")).await;
    let urgent = Submission {
        priority: Priority::High,
        device: Some(DeviceKind::Gpu),
        ..submission("c")
    };
    let urgent = submit(&queue, urgent).await;
    let whole = submit(&queue, sequence(2)).await;
    // The tenants take turns, and the urgent job needs another kind of device than a job for CPUs.
    let expected = [(1, 0.0), (3, 1.0), (4, 2.0)];
    for (job, (ahead, share_seconds)) in mine.iter().zip(expected) {
        let standing = Standing {
            ahead,
            share_seconds,
        };
        assert_eq!(of(job).await, Some(standing));
    }
    assert_eq!(of(&other).await.map(|found| found.ahead), Some(2));
    assert_eq!(of(&urgent).await.map(|found| found.ahead), Some(0));
    let on_cpu = Submission {
        device: Some(DeviceKind::Cpu),
        ..submission("d")
    };
    let on_cpu = submit(&queue, on_cpu).await;
    // Behind those that came before with the same tag.
    assert_eq!(of(&on_cpu).await.map(|found| found.ahead), Some(2));
    // A sequence stands where its first pair does.
    assert_eq!(of(&whole).await.map(|found| found.share_seconds), Some(3.0));
    let held = lease_on(&queue, DeviceKind::Cpu).await;
    assert_eq!(held.job.id, mine[0].id);
    assert_eq!(of(&held.job).await, None);
    assert_eq!(
        of(&mine[1]).await.map(|found| found.share_seconds),
        Some(1.0)
    );
    queue.cancel(mine[1].id).await.expect("cancelled");
    assert_eq!(of(&mine[1]).await, None);
    assert_eq!(queue.standing(JobId::fresh()).await, Ok(None));
}

pub(crate) async fn a_job_is_leased_only_when_the_one_that_it_comes_after_has_ended(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let first = submit(&queue, submission("a")).await;
    let urgent = Submission {
        priority: Priority::High,
        ..after(&first)
    };
    let second = submit(&queue, urgent).await;
    assert_eq!((second.after, second.ready), (Some(first.id), None));
    let held = lease(&queue).await;
    assert_eq!(held.job.id, first.id);
    nothing_is_ready(&queue).await;
    // A worker that is already waiting is woken up.
    let waiting = lease(&queue);
    let ending = async {
        tokio::time::sleep(Duration::from_millis(30)).await;
        finish(&queue, &held.job, done()).await;
    };
    let (next, ()) = tokio::join!(waiting, ending);
    assert_eq!(next.job.id, second.id);
    assert!(next.job.ready.is_some());
}

pub(crate) async fn a_job_that_comes_after_one_that_has_ended_or_is_unknown_waits_for_nothing(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    submit(&queue, submission("a")).await;
    let ended = finish_next(&queue).await;
    let unknown = Submission {
        after: Some(JobId::fresh()),
        ..submission("a")
    };
    for late in [after(&ended), unknown] {
        let job = submit(&queue, late).await;
        assert_eq!(finish_next(&queue).await.id, job.id);
    }
}

pub(crate) async fn a_job_that_waits_for_another_is_queued_but_nobody_is_late_with_it(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, chain(3)).await;
    let pairs = queue.pairs(job.id).await.expect("known");
    let has_dependents: Vec<bool> = pairs.iter().map(|pair| pair.has_dependents).collect();
    assert_eq!(has_dependents, [true, true, false]);
    // Its work counts in the backlog, but it does not wait for a device.
    assert_eq!(queue.backlog().queued().jobs, 3);
    assert!(queue.oldest_queued().await.expect("an answer").is_some());
    let held = lease(&queue).await;
    assert_eq!(queue.backlog().queued().jobs, 2);
    assert_eq!(queue.oldest_queued().await, Ok(None));
    tokio::time::sleep(Duration::from_millis(20)).await;
    let ended = Timestamp::now();
    finish(&queue, &held.job, done()).await;
    let oldest = queue.oldest_queued().await.expect("an answer");
    assert!(oldest.is_some_and(|oldest| oldest >= ended));
    for _ in 0..2 {
        finish_next(&queue).await;
    }
    reaches(&queue, &job, State::Succeeded).await;
    assert_eq!(queue.backlog().queued().jobs, 0);
}

pub(crate) async fn a_chain_goes_on_behind_a_member_that_fails_is_cancelled_or_expires(
    stand: &mut impl Stand,
) {
    let options = QueueOptions {
        retry_delay: Duration::from_millis(40),
        ..QueueOptions::default()
    };
    let (queue, _events) = stand.open(options).await;
    let first = submit(&queue, submission("a")).await;
    let expiring = Submission {
        deadline: Some(Timestamp::now().after(Duration::from_millis(1500))),
        ..after(&first)
    };
    let expiring = submit(&queue, expiring).await;
    let cancelled = submit(&queue, after(&expiring)).await;
    let failing = submit(&queue, after(&cancelled)).await;
    let last = submit(&queue, after(&failing)).await;
    let held = lease(&queue).await;
    nothing_is_ready(&queue).await;
    reaches(&queue, &expiring, State::Expired).await;
    queue.cancel(cancelled.id).await.expect("known");
    let retried = lease(&queue).await;
    assert_eq!(retried.job.id, failing.id);
    // A job that is retried has not ended.
    finish(&queue, &retried.job, failure(true)).await;
    let again = lease(&queue).await;
    assert_eq!(again.job.id, failing.id);
    finish(&queue, &again.job, failure(false)).await;
    assert_eq!(lease(&queue).await.job.id, last.id);
    assert_eq!(state(&queue, &failing).await, State::Failed);
    assert_eq!(held.heartbeat.signal(), Signal::Continue);
}

pub(crate) async fn a_chain_is_cancelled_whole_and_asked_for_again_in_its_order(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, chain(4)).await;
    assert_eq!(finish_next(&queue).await.index, 0);
    let second = lease(&queue).await;
    queue.cancel(job.id).await.expect("known");
    finish(&queue, &second.job, Outcome::Cancelled).await;
    reaches(&queue, &job, State::Cancelled).await;
    nothing_is_ready(&queue).await;
    assert_eq!(queue.backlog().queued().jobs, 0);
    queue.requeue(job.id, false).await.expect("it has ended");
    assert_eq!(queue.backlog().queued().jobs, 3);
    for index in 1..4 {
        let held = lease(&queue).await;
        assert_eq!(held.job.index, index);
        nothing_is_ready(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    reaches(&queue, &job, State::Succeeded).await;
}

pub(crate) async fn a_chain_survives_a_crash_in_its_order(stand: &mut impl Stand) {
    let (queue, events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, chain(3)).await;
    let awaited = Submission {
        durable: false,
        ..submission("a")
    };
    let awaited = submit(&queue, awaited).await;
    let promised = submit(&queue, after(&awaited)).await;
    finish_next(&queue).await;
    let held = lease(&queue).await;
    assert_eq!(held.job.index, 1);
    drop((queue, events));
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    assert_eq!(queue.backlog().queued().jobs, 3);
    let again = lease(&queue).await;
    assert_eq!((again.job.index, again.job.attempt), (1, 2));
    // An ephemeral job that the crash removed does not block its followers.
    assert_eq!(lease(&queue).await.job.id, promised.id);
    nothing_is_ready(&queue).await;
    finish(&queue, &again.job, done()).await;
    assert_eq!(finish_next(&queue).await.index, 2);
    reaches(&queue, &job, State::Succeeded).await;
}

pub(crate) async fn chains_go_side_by_side_and_leave_other_tenants_their_share(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    for _ in 0..2 {
        submit(&queue, chain(6)).await;
    }
    for _ in 0..6 {
        submit(&queue, submission("b")).await;
    }
    let held = [lease(&queue).await, lease(&queue).await];
    assert!(held.iter().all(|held| held.job.index == 0));
    for held in held {
        finish(&queue, &held.job, done()).await;
    }
    let mut of_b = 0;
    for _ in 0..12 {
        of_b += u32::from(finish_next(&queue).await.tenant == tenant("b"));
    }
    assert!((5..=6).contains(&of_b), "{of_b} of 12");
}

pub(crate) async fn what_others_come_after_is_kept_until_they_have_ended(stand: &mut impl Stand) {
    let options = QueueOptions {
        answered_retention: Duration::from_millis(40),
        ..QueueOptions::default()
    };
    let (queue, _events) = stand.open(options).await;
    let awaited = |job| Submission {
        durable: false,
        ..job
    };
    let first = submit(&queue, awaited(submission("a"))).await;
    let second = submit(&queue, awaited(after(&first))).await;
    finish_next(&queue).await;
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert_eq!(state(&queue, &first).await, State::Succeeded);
    assert_eq!(finish_next(&queue).await.id, second.id);
    let began = std::time::Instant::now();
    while queue.job(&first.tenant, first.id).await.is_ok() {
        assert!(began.elapsed() < PATIENCE, "it is kept for nobody");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

pub(crate) async fn a_sequence_with_something_left_to_do_is_leased_when_its_pairs_have_succeeded(
    stand: &mut impl Stand,
) {
    let (queue, mut events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, closing()).await;
    assert_eq!((job.pairs, job.pairs_left), (4, 4));
    assert_eq!(queue.backlog().queued().jobs, 4);
    let mut indices = Vec::new();
    for _ in 0..4 {
        let pair = finish_next(&queue).await;
        indices.push((pair.backward, pair.index));
    }
    indices.sort_unstable();
    assert_eq!(indices, [(false, 0), (false, 1), (true, 0), (true, 1)]);
    let backlog = queue.backlog().queued();
    assert_eq!((backlog.jobs, backlog.seconds), (1, 5.0));
    let held = lease(&queue).await;
    assert_eq!((held.job.id, held.job.attempt), (job.id, 1));
    assert_eq!(queue.backlog().running().jobs, 1);
    assert_eq!(held.heartbeat.beat(None), Signal::Continue);
    nothing_is_ready(&queue).await;
    finish(&queue, &held.job, done()).await;
    reaches(&queue, &job, State::Succeeded).await;
    assert_eq!(queue.backlog().running().jobs, 0);
    let mut ends = 0;
    while let Ok(event) = events.try_recv() {
        ends += u32::from(matches!(event, Event::Ended(ended) if ended.id == job.id));
    }
    assert_eq!(ends, 1);
}

pub(crate) async fn what_is_left_of_a_sequence_counts_in_its_tenants_share(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, closing()).await;
    for _ in 0..4 {
        finish_next(&queue).await;
    }
    // Its closing job takes five seconds, as much as five pairs.
    let own = Submission {
        tenant: job.tenant.clone(),
        ..submission("a")
    };
    let own = submit(&queue, own).await;
    for _ in 0..4 {
        submit(&queue, submission("b")).await;
    }
    let mut order = Vec::new();
    for _ in 0..6 {
        order.push(finish_next(&queue).await.id);
    }
    assert_eq!(order.last(), Some(&own.id));
    assert!(order.contains(&job.id));
}

pub(crate) async fn what_is_left_of_a_sequence_survives_crashes_and_is_retried_cancelled_and_asked_for_again(
    stand: &mut impl Stand,
) {
    let (queue, events) = stand.open(quick()).await;
    let job = submit(&queue, closing()).await;
    for _ in 0..4 {
        finish_next(&queue).await;
    }
    assert_eq!(lease(&queue).await.job.id, job.id);
    drop((queue, events));
    let (queue, _events) = stand.open(quick()).await;
    assert_eq!(queue.backlog().queued().jobs, 1);
    let held = lease(&queue).await;
    assert_eq!((held.job.id, held.job.attempt), (job.id, 2));
    finish(&queue, &held.job, failure(true)).await;
    let held = lease(&queue).await;
    assert_eq!(held.job.attempt, 3);
    queue.cancel(job.id).await.expect("known");
    assert_eq!(held.heartbeat.signal(), Signal::Cancel);
    finish(&queue, &held.job, Outcome::Cancelled).await;
    reaches(&queue, &job, State::Cancelled).await;
    let again = queue.requeue(job.id, false).await.expect("it has ended");
    assert_eq!((again.state, again.pairs_left), (State::Queued, 0));
    assert_eq!(queue.backlog().queued().jobs, 1);
    let cancelled = queue.cancel(job.id).await.expect("known");
    assert_eq!(cancelled.state, State::Cancelled);
    assert_eq!(queue.backlog().queued().jobs, 0);
    queue.requeue(job.id, false).await.expect("it has ended");
    let held = lease(&queue).await;
    assert_eq!(held.job.id, job.id);
    finish(&queue, &held.job, failure(false)).await;
    let failed = reaches(&queue, &job, State::Failed).await;
    let error = failed.error.as_ref().expect("a reason");
    assert_eq!(error.message, "it broke");
}

pub(crate) async fn a_pair_that_fails_back_in_time_is_named_and_nothing_is_left_to_do(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, closing()).await;
    for _ in 0..4 {
        let held = lease(&queue).await;
        let breaks = held.job.backward && held.job.index == 1;
        let outcome = if breaks { failure(false) } else { done() };
        finish(&queue, &held.job, outcome).await;
    }
    let failed = reaches(&queue, &job, State::Failed).await;
    let error = failed.error.as_ref().expect("a reason");
    assert_eq!(error.message, "pair 1, back in time: it broke");
    nothing_is_ready(&queue).await;
    // Requeued, the sequence runs the failed pair and then the closing job.
    queue.requeue(job.id, false).await.expect("it has ended");
    assert!(finish_next(&queue).await.backward);
    assert_eq!(finish_next(&queue).await.id, job.id);
    reaches(&queue, &job, State::Succeeded).await;
}
