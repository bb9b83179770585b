//! The outbox: what a commit has promised is done by one node at a time, and is not lost.

use super::*;
use crate::job::DeliveryState;
use crate::queue::outgoing::{Action, Outgoing, Settled};

const HOLD: Duration = Duration::from_secs(60);

fn told(of: &str, url: &str) -> Submission {
    Submission {
        webhook: Some(url.to_owned()),
        ..submission(of)
    }
}

async fn take(queue: &Arc<dyn Queue>, hold: Duration) -> Vec<Outgoing> {
    queue
        .take_outgoing(10, hold)
        .await
        .expect("the store works")
}

pub(crate) async fn the_end_of_a_job_is_told_once_per_end_and_not_of_the_pairs_of_a_sequence(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let silent = submit(&queue, submission("a")).await;
    let held = lease(&queue).await;
    assert_eq!(held.job.id, silent.id);
    finish(&queue, &held.job, done()).await;
    assert_eq!(take(&queue, HOLD).await, []);

    let job = submit(&queue, told("a", "https://a.example/x")).await;
    queue.cancel(job.id).await.expect("it is cancelled");
    let ends = take(&queue, HOLD).await;
    let [end] = &ends[..] else {
        unreachable!("one notice: {ends:?}");
    };
    assert_eq!((end.job, end.attempts), (job.id, 1));
    let Action::Notify { url, body } = &end.action else {
        unreachable!("it is a notice: {end:?}");
    };
    assert_eq!(url, "https://a.example/x");
    assert!(
        body.contains("job.cancelled") && body.contains(&job.id.to_string()),
        "{body}"
    );
    // Asked for again, it has another end.
    queue.requeue(job.id, false).await.expect("it is queued");
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let again = take(&queue, HOLD).await;
    assert_eq!(again.len(), 1);
    assert_ne!(again[0].number, end.number);

    let whole = Submission {
        webhook: Some("https://a.example/y".to_owned()),
        ..sequence(2)
    };
    let whole = submit(&queue, whole).await;
    for _ in 0..2 {
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    let ends = take(&queue, HOLD).await;
    assert_eq!(
        ends.iter().map(|end| end.job).collect::<Vec<_>>(),
        [whole.id]
    );
}

pub(crate) async fn what_is_promised_is_taken_once_and_again_after_its_hold_or_delay_or_a_crash(
    stand: &mut impl Stand,
) {
    const SHORT: Duration = Duration::from_millis(300);
    let (queue, events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, told("a", "https://a.example/x")).await;
    queue.cancel(job.id).await.expect("it is cancelled");
    let first = take(&queue, SHORT).await;
    assert_eq!(first.len(), 1);
    assert_eq!(take(&queue, HOLD).await, [], "another node holds it");
    tokio::time::sleep(SHORT * 2).await;
    let second = take(&queue, HOLD).await;
    let seen: Vec<_> = second
        .iter()
        .map(|one| (one.number, one.attempts))
        .collect();
    assert_eq!(seen, [(first[0].number, 2)]);
    let later = vec![(first[0].number, Settled::Again(SHORT))];
    queue.settle(later).await.expect("settled");
    assert_eq!(take(&queue, HOLD).await, [], "it is due later");
    tokio::time::sleep(SHORT * 2).await;
    let third = take(&queue, SHORT).await;
    assert_eq!(third[0].attempts, 3);
    let not_tried = vec![(first[0].number, Settled::NotTried(Duration::ZERO))];
    queue.settle(not_tried).await.expect("settled");
    let third = take(&queue, SHORT).await;
    assert_eq!(third[0].attempts, 3, "it counts as an attempt");

    drop((queue, events));
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    tokio::time::sleep(SHORT * 2).await;
    let third = take(&queue, HOLD).await;
    assert_eq!(third.len(), 1, "a crash has lost it");
    let done = vec![(third[0].number, Settled::Done)];
    queue.settle(done).await.expect("settled");

    // The files of a removed job are removed the same way.
    queue.remove(job.id).await.expect("it has ended");
    let removal = take(&queue, HOLD).await;
    let seen: Vec<_> = removal.iter().map(|one| (one.job, &one.action)).collect();
    assert_eq!(seen, [(job.id, &Action::RemoveFiles)]);
}

pub(crate) async fn a_result_is_delivered_before_the_end_of_its_job_is_told(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let one = Submission {
        result_uri: Some("s3://a/one.npz".to_owned()),
        ..told("a", "https://a.example/x")
    };
    let job = submit(&queue, one).await;
    assert_eq!(
        delivery(&job),
        Some(("s3://a/one.npz", DeliveryState::Pending))
    );
    queue.cancel(job.id).await.expect("it is cancelled");
    let ends = take(&queue, HOLD).await;
    assert!(
        matches!(&ends[..], [end] if is_notice(end)),
        "nothing is delivered of it: {ends:?}"
    );

    queue.requeue(job.id, false).await.expect("it is queued");
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let taken = take(&queue, HOLD).await;
    let [deliver] = &taken[..] else {
        unreachable!("the notice waits: {taken:?}");
    };
    assert!(matches!(&deliver.action, Action::Deliver(of) if of.id == job.id));
    queue
        .settle(vec![(deliver.number, Settled::Done)])
        .await
        .expect("settled");
    let job = queue.job(&job.tenant, job.id).await.expect("known");
    assert_eq!(
        delivery(&job),
        Some(("s3://a/one.npz", DeliveryState::Delivered))
    );
    assert!(is_notice(&next(&queue).await));
}

pub(crate) async fn each_forward_pair_of_a_sequence_is_delivered_and_then_its_end_is_told(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let mut whole = Submission {
        webhook: Some("https://a.example/x".to_owned()),
        result_uri: Some("s3://a/{index}.ply".to_owned()),
        ..sequence(2)
    };
    whole.pairs.push(PairOf {
        backward: true,
        ..forward(1, false)
    });
    let whole = submit(&queue, whole).await;
    assert_eq!(delivery(&whole), None);
    for _ in 0..3 {
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    let taken = take(&queue, HOLD).await;
    let mut uris: Vec<_> = taken.iter().map(|one| one.action.clone()).collect();
    uris.sort_by_key(|action| match action {
        Action::Deliver(pair) => pair.index,
        other => unreachable!("the notice waits: {other:?}"),
    });
    let uris: Vec<_> = uris
        .iter()
        .filter_map(|action| match action {
            Action::Deliver(pair) => delivery(pair).map(|(uri, _)| uri),
            _ => None,
        })
        .collect();
    assert_eq!(uris, ["s3://a/000000.ply", "s3://a/000001.ply"]);
    // One is given up: nothing else is waited for.
    let settled = [Settled::Done, Settled::GivenUp];
    let numbers = taken.iter().map(|one| one.number).zip(settled);
    queue.settle(numbers.collect()).await.expect("settled");
    assert!(is_notice(&next(&queue).await));
    let pairs = queue.pairs(whole.id).await.expect("pairs");
    let states = pairs
        .iter()
        .filter_map(|pair| delivery(pair).map(|(_, state)| state));
    let mut states: Vec<_> = states.collect();
    states.sort_by_key(|state| *state as u8);
    assert_eq!(states, [DeliveryState::Delivered, DeliveryState::GivenUp]);
}

pub(crate) async fn nothing_is_delivered_of_a_job_that_was_removed_or_is_done_again(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let one = || Submission {
        result_uri: Some("s3://a/one.npz".to_owned()),
        ..submission("a")
    };
    let removed = submit(&queue, one()).await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    queue.remove(removed.id).await.expect("it has ended");
    let taken = take(&queue, HOLD).await;
    assert!(
        matches!(&taken[..], [one] if one.action == Action::RemoveFiles),
        "{taken:?}"
    );

    let again = submit(&queue, one()).await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    queue.requeue(again.id, true).await.expect("it is queued");
    assert_eq!(take(&queue, HOLD).await, []);
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let taken = take(&queue, HOLD).await;
    assert!(
        matches!(&taken[..], [one] if matches!(&one.action, Action::Deliver(job) if job.attempt == 2)),
        "{taken:?}"
    );
}

/// The next action that is due soon.
async fn next(queue: &Arc<dyn Queue>) -> Outgoing {
    let soon = async {
        loop {
            if let Some(one) = take(queue, HOLD).await.into_iter().next() {
                return one;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    timeout(PATIENCE, soon).await.expect("in time")
}

fn is_notice(one: &Outgoing) -> bool {
    matches!(one.action, Action::Notify { .. })
}

fn delivery(job: &Job) -> Option<(&str, DeliveryState)> {
    let delivery = job.delivery.as_ref()?;
    Some((&delivery.uri, delivery.state))
}

pub(crate) async fn notices_that_wait_for_a_delivery_hold_up_no_other(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    for number in 0..25 {
        let delivered = Submission {
            result_uri: Some(format!("s3://away/{number}.npz")),
            ..told("a", "https://a.example/x")
        };
        submit(&queue, delivered).await;
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    // The bucket is away.
    for _round in 0..15 {
        let taken = take(&queue, HOLD).await;
        let again = |one: &Outgoing| (one.number, Settled::Again(Duration::from_secs(3600)));
        let delayed: Vec<_> = taken.iter().map(again).collect();
        assert!(!taken.iter().any(is_notice), "{taken:?}");
        queue.settle(delayed).await.expect("settled");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let job = submit(&queue, told("b", "https://b.example/x")).await;
    queue.cancel(job.id).await.expect("it is cancelled");
    let taken = take(&queue, HOLD).await;
    let found: Vec<_> = taken.iter().map(|one| one.job).collect();
    assert_eq!(found, [job.id]);
}
