//! What ended jobs are kept for.

use super::*;

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

pub(crate) async fn a_pair_is_not_done_again_while_its_sequence_is_being_closed(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let whole = submit(
        &queue,
        Submission {
            finalizer_seconds: Some(1.0),
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
    queue
        .requeue(pairs[0].id, true)
        .await
        .expect("it has ended");
    assert_eq!(lease(&queue).await.job.id, pairs[0].id);
}
