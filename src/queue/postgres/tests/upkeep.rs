//! Tests of what is due.

use std::time::Duration;

use super::{Database, until};
use crate::job::{DeliveryState, DeviceKind, Job, JobId};
use crate::queue::contract_tests::{done, submission};
use crate::queue::outgoing::{Action, Settled};
use crate::queue::types::{QueueOptions, Submission, Submitted};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_cannot_be_deleted_keeps_no_other() {
    const JOBS: usize = 200;
    let Some(database) = Database::new() else {
        return;
    };
    let (queue, _heard) = database.node("one", QueueOptions::default()).await;
    let mut ids = Vec::new();
    for _ in 0..JOBS {
        let submitted = queue.submit(submission("a")).await.expect("accepted");
        let Submitted::New(job) = submitted else {
            unreachable!("it is new");
        };
        queue.cancel(job.id).await.expect("cancelled");
        ids.push(job.id);
    }
    let run = |text: &str| database.server.sql(database.name(), text);
    let hex = |id: JobId| {
        let digits = id.as_bytes().iter().map(|byte| format!("{byte:02x}"));
        digits.collect::<String>()
    };
    let kept = ids[JOBS / 2];
    run(&format!(
        "CREATE FUNCTION refuse() RETURNS trigger AS $$ BEGIN RAISE 'it stays'; END $$ \
         LANGUAGE plpgsql; \
         CREATE TRIGGER refuse BEFORE DELETE ON jobs FOR EACH ROW \
         WHEN (OLD.id = '\\x{}') EXECUTE FUNCTION refuse(); \
         UPDATE jobs SET due = 1",
        hex(kept)
    ));
    let is_alone = async || queue.known(ids.clone()).await == Ok(vec![kept]);
    until("others are kept as well", is_alone).await;
}

/// A notice is put off while its delivery is done at another node.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_notice_that_is_put_off_as_its_delivery_ends_is_due_at_once() {
    let Some(database) = Database::new() else {
        return;
    };
    let (queue, _heard) = database.node("one", QueueOptions::default()).await;
    let told = Submission {
        result_uri: Some("s3://a/one.npz".to_owned()),
        webhook: Some("https://a.example/x".to_owned()),
        ..submission("a")
    };
    queue.submit(told).await.expect("accepted");
    let held = queue.lease("worker", DeviceKind::Cpu).await;
    let job: std::sync::Arc<Job> = held.expect("a job").job;
    let finished = queue.finish(job.id, job.attempt, done()).await;
    finished.expect("finished");
    let hold = Duration::from_secs(60);
    let taken = queue.take_outgoing(1, hold).await.expect("taken");
    let [delivery] = &taken[..] else {
        unreachable!("the delivery comes first: {taken:?}");
    };
    assert!(matches!(delivery.action, Action::Deliver(_)), "{taken:?}");
    let (server, name) = (database.server.clone(), database.name().to_owned());
    let put_off = "BEGIN; SELECT seq FROM outbox WHERE body IS NOT NULL FOR UPDATE; \
                   SELECT pg_sleep(3); \
                   UPDATE outbox SET due = due + 600000 WHERE body IS NOT NULL; COMMIT";
    let other = tokio::task::spawn_blocking(move || server.sql(&name, put_off));
    tokio::time::sleep(Duration::from_secs(1)).await;
    let settled = queue.settle(vec![(delivery.number, Settled::Done)]).await;
    settled.expect("settled");
    other.await.expect("no panic");
    let found = queue.job(&job.tenant, job.id).await.expect("known");
    let state = found.delivery.as_ref().map(|delivery| delivery.state);
    assert_eq!(state, Some(DeliveryState::Delivered));
    let is_told = async || {
        let taken = queue.take_outgoing(1, hold).await.expect("taken");
        matches!(&taken[..], [one] if matches!(one.action, Action::Notify { .. }))
    };
    until("it is told in ten minutes", is_told).await;
}
