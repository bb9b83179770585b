//! What ended jobs are kept for.

use super::*;
use crate::job::DeliveryState;
use crate::queue::outgoing::Settled;

pub(crate) async fn a_result_that_somebody_waits_to_read_is_kept(stand: &mut impl Stand) {
    let retention = Duration::from_millis(600);
    let options = QueueOptions {
        answered_retention: retention,
        ..QueueOptions::default()
    };
    let (queue, _events) = stand.open(options).await;
    assert_eq!(queue.keep(JobId::fresh()).await, Err(QueueError::NotFound));
    let ephemeral = || Submission {
        durable: false,
        ..submission("a")
    };
    let kept = submit(&queue, ephemeral()).await;
    let left = submit(&queue, ephemeral()).await;
    for _ in 0..2 {
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    for _ in 0..6 {
        tokio::time::sleep(retention / 3).await;
        assert_eq!(queue.keep(kept.id).await, Ok(retention));
    }
    assert_eq!(state(&queue, &kept).await, State::Succeeded);
    let gone = queue.job(&left.tenant, left.id).await;
    assert_eq!(gone.map(drop), Err(QueueError::NotFound));
}

pub(crate) async fn a_result_that_is_still_to_be_delivered_is_kept(stand: &mut impl Stand) {
    let retention = Duration::from_millis(300);
    let options = QueueOptions {
        retention,
        answered_retention: retention,
        ..QueueOptions::default()
    };
    let (queue, _events) = stand.open(options).await;
    let delivered = Submission {
        result_uri: Some("s3://a/{index}.npz".to_owned()),
        ..sequence(1)
    };
    let whole = submit(&queue, delivered).await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let hold = Duration::from_secs(60);
    let taken = queue.take_outgoing(10, hold).await.expect("taken");
    assert_eq!(taken.len(), 1, "{taken:?}");
    // The bucket is away for longer than the retention.
    let again = vec![(taken[0].number, Settled::Again(hold))];
    queue.settle(again).await.expect("settled");
    tokio::time::sleep(retention * 4).await;
    assert_eq!(state(&queue, &whole).await, State::Succeeded);
    let done = vec![(taken[0].number, Settled::Done)];
    queue.settle(done).await.expect("settled");
    let deleted = async {
        while queue.known(vec![whole.id]).await != Ok(Vec::new()) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, deleted).await.expect("in time");
}

pub(crate) async fn a_pair_is_not_done_again_while_its_sequence_is_being_closed(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let whole = submit(
        &queue,
        Submission {
            finalizer_seconds: Some(1.0),
            result_uri: Some("s3://a/dense.ply".to_owned()),
            ..sequence(2)
        },
    )
    .await;
    let pairs = queue.pairs(whole.id).await.expect("known");
    for _ in 0..2 {
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    let again = queue.requeue(pairs[0].id, true).await;
    assert_eq!(again.map(drop), Err(QueueError::NotTerminal(State::Queued)));
    let closing = lease(&queue).await;
    assert_eq!(closing.job.id, whole.id);
    let again = queue.requeue(pairs[0].id, true).await;
    assert_eq!(
        again.map(drop),
        Err(QueueError::NotTerminal(State::Running))
    );
    finish(&queue, &closing.job, done()).await;
    let hold = Duration::from_secs(60);
    let taken = queue.take_outgoing(10, hold).await.expect("taken");
    let settled = taken.iter().map(|one| (one.number, Settled::Done));
    queue.settle(settled.collect()).await.expect("settled");
    let now = async || queue.job(&whole.tenant, whole.id).await.expect("known");
    let delivery = |job: &Job| job.delivery.as_ref().map(|delivery| delivery.state);
    let ended = now().await;
    assert!(ended.report.is_some() && ended.stop_reason.is_some());
    assert_eq!(delivery(&ended), Some(DeliveryState::Delivered));
    queue
        .requeue(pairs[0].id, true)
        .await
        .expect("it has ended");
    // The sequence has nothing of its first end.
    let reopened = now().await;
    assert_eq!(reopened.state, State::Queued);
    assert!(reopened.report.is_none() && reopened.stop_reason.is_none());
    assert_eq!(delivery(&reopened), Some(DeliveryState::Pending));
    assert_eq!(lease(&queue).await.job.id, pairs[0].id);
}
