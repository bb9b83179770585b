//! Tests of what the others do when a node has ended.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{Database, until};
use crate::job::{DeviceKind, JobId};
use crate::queue::contract_tests::submission;
use crate::queue::interface::Queue;
use crate::queue::postgres::locks::RECOVERY;
use crate::queue::types::{QueueOptions, Submitted};

/// Submits a job and leases it.
async fn held(queue: &Arc<dyn Queue>) -> JobId {
    let submitted = queue.submit(submission("a")).await.expect("accepted");
    assert!(matches!(submitted, Submitted::New(_)));
    let held = queue.lease("worker", DeviceKind::Cpu).await;
    held.expect("a job").job.id
}

/// The state of the only job, by its row.
fn state(database: &Database) -> String {
    let text = "SELECT state FROM jobs";
    database.server.sql(database.name(), text)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_jobs_of_a_dead_node_are_recovered_by_one_of_the_others() {
    let Some(database) = Database::new() else {
        return;
    };
    let (_one, _heard) = database.node("one", QueueOptions::default()).await;
    let (_other, _heard) = database.node("other", QueueOptions::default()).await;
    let (victim, _) = database.node("victim", QueueOptions::default()).await;
    held(&victim).await;
    let number = "SELECT id FROM nodes WHERE name = 'victim'";
    let number = database.server.sql(database.name(), number);
    // A third one is at it, for longer than the two of them wait at their start.
    let lock = format!("SELECT pg_advisory_lock({RECOVERY}, {number}), pg_sleep(16)");
    let (server, name) = (database.server.clone(), database.name().to_owned());
    let third = tokio::task::spawn_blocking(move || server.sql(&name, &lock));
    tokio::time::sleep(Duration::from_secs(1)).await;
    drop(victim);
    while !third.is_finished() {
        let seen = state(&database);
        assert!(seen == "1" || third.is_finished(), "two nodes recover it");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    // It was killed in the middle.
    let is_queued = async || state(&database) == "0";
    until("no other node recovers the job", is_queued).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_node_that_comes_after_an_outage_leaves_the_others_time_to_come_back() {
    let Some(database) = Database::new() else {
        return;
    };
    let (lost, _heard) = database.node("lost", QueueOptions::default()).await;
    held(&lost).await;
    drop(lost);
    database.is_left().await;
    // For a minute no node was there.
    let run = |text: &str| database.server.sql(database.name(), text);
    run("UPDATE summary SET load = jsonb_set(load::jsonb, '{at}', '0')::text");
    let began = Instant::now();
    let (_fresh, _heard) = database.node("fresh", QueueOptions::default()).await;
    assert!(began.elapsed() >= Duration::from_secs(8));
    assert_eq!(state(&database), "0");
}
