//! Tests of several nodes of one queue, and of crashes of nodes and of the database.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::task::JoinSet;
use tokio::time::timeout;

use super::{Database, PATIENCE, until};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, JobId, JobProgress, Priority, State};
use crate::queue::contract_tests::{done, submission};
use crate::queue::interface::Queue;
use crate::queue::lease::{Lease, Signal};
use crate::queue::types::{
    Committed, Event, Idempotency, Outcome, QueueOptions, Submission, Submitted,
};

async fn lease(queue: &Arc<dyn Queue>) -> Lease {
    let leased = timeout(PATIENCE, queue.lease("worker", DeviceKind::Cpu)).await;
    leased.expect("a job is ready").expect("a lease")
}

async fn finish(queue: &Arc<dyn Queue>, held: &Lease, outcome: Outcome) -> Committed {
    let finished = queue.finish(held.job.id, held.job.attempt, outcome).await;
    finished.expect("the store works")
}

async fn submit(queue: &Arc<dyn Queue>, submission: Submission) -> JobId {
    match queue.submit(submission).await.expect("accepted") {
        Submitted::New(job) => job.id,
        Submitted::Known(job) => panic!("{} is not new", job.id),
    }
}

/// Waits until a worker hears this.
async fn hears(held: &Lease, signal: Signal) {
    let otherwise = format!("it does not hear {signal:?}");
    until(&otherwise, async || held.heartbeat.signal() == signal).await;
}

/// Eight lanes of one node, which do jobs until there are none for two seconds. Returns how often
/// each job was leased.
async fn work(queue: Arc<dyn Queue>) -> HashMap<JobId, u32> {
    let mut lanes = JoinSet::new();
    for _ in 0..8 {
        let queue = Arc::clone(&queue);
        lanes.spawn(async move {
            let mut held = Vec::new();
            loop {
                let a_while = std::pin::pin!(tokio::time::sleep(Duration::from_secs(2)));
                let lease = queue.lease_until("worker", DeviceKind::Cpu, a_while).await;
                let Some(lease) = lease.expect("the store works") else {
                    break held;
                };
                held.push(lease.job.id);
                let ended = finish(&queue, &lease, done()).await;
                assert_eq!(ended, Committed::Yes(State::Succeeded));
            }
        });
    }
    let mut times = HashMap::new();
    for id in lanes.join_all().await.into_iter().flatten() {
        *times.entry(id).or_default() += 1;
    }
    times
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nodes_that_submit_and_work_at_once_do_every_job_once() {
    const JOBS: usize = 150;
    let Some(database) = Database::new() else {
        return;
    };
    let mut nodes = Vec::new();
    for name in ["a", "b", "c"] {
        nodes.push(database.node(name, QueueOptions::default()).await);
    }
    let mut submissions = JoinSet::new();
    for job in 0..JOBS {
        let queue = Arc::clone(&nodes[job % 3].0);
        let of = ["one", "two"][job % 2];
        submissions.spawn(async move { submit(&queue, submission(of)).await });
    }
    let workers = nodes.iter().map(|(queue, _)| work(Arc::clone(queue)));
    let done = futures_util::future::join_all(workers).await;
    assert_eq!(submissions.join_all().await.len(), JOBS);
    let mut times: HashMap<JobId, u32> = HashMap::new();
    for (id, often) in done.into_iter().flatten() {
        *times.entry(id).or_default() += often;
    }
    assert_eq!(times.len(), JOBS);
    assert!(times.values().all(|often| *often == 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_jobs_of_a_node_that_has_ended_go_to_another_at_once_and_those_of_its_callers_are_deleted()
 {
    let Some(database) = Database::new() else {
        return;
    };
    let (survivor, _heard) = database.node("survivor", QueueOptions::default()).await;
    let (victim, _) = database.node("victim", QueueOptions::default()).await;
    let kept = submit(&victim, submission("a")).await;
    let awaited = Submission {
        durable: false,
        device: Some(DeviceKind::Gpu),
        ..submission("a")
    };
    let deleted = submit(&victim, awaited).await;
    let held = lease(&victim).await;
    assert_eq!((held.job.id, held.job.attempt), (kept, 1));
    drop(victim);
    // Long before the lease of a minute expires.
    let again = lease(&survivor).await;
    assert_eq!(
        (again.job.id, again.job.attempt, again.job.crashes),
        (kept, 2, 1)
    );
    let is_gone = async || survivor.known(vec![deleted]).await == Ok(Vec::new());
    until("it is kept for nobody", is_gone).await;
    let nodes = database
        .server
        .sql(database.name(), "SELECT name FROM nodes");
    assert_eq!(nodes, "survivor");
    finish(&survivor, &again, done()).await;
    let backlog = survivor.backlog();
    assert_eq!((backlog.queued().jobs, backlog.running().jobs), (0, 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_node_that_loses_its_connections_goes_on_and_keeps_its_jobs() {
    let Some(database) = Database::new() else {
        return;
    };
    let (one, _heard) = database.node("one", QueueOptions::default()).await;
    let (_other, _heard) = database.node("other", QueueOptions::default()).await;
    submit(&one, submission("a")).await;
    let held = lease(&one).await;
    let cut = "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity \
               WHERE datname = current_database() AND application_name = 'fnsf'";
    for _ in 0..3 {
        database.server.sql(database.name(), cut);
        tokio::time::sleep(Duration::from_millis(1500)).await;
        assert_eq!(held.heartbeat.beat(None), Signal::Continue);
    }
    assert_eq!(
        finish(&one, &held, done()).await,
        Committed::Yes(State::Succeeded)
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_crash_of_the_database_loses_no_promise_and_blames_no_job() {
    let Some(database) = Database::alone() else {
        return;
    };
    let (one, _heard) = database.node("one", QueueOptions::default()).await;
    let (other, _heard) = database.node("other", QueueOptions::default()).await;
    submit(&one, submission("a")).await;
    let held = lease(&other).await;
    let mut promised = Vec::new();
    for _ in 0..3 {
        let submitting = {
            let one = Arc::clone(&one);
            tokio::spawn(async move {
                let mut ids = Vec::new();
                for _ in 0..20 {
                    ids.push(submit(&one, submission("a")).await);
                }
                ids
            })
        };
        let server = database.server.clone();
        let crash = tokio::task::spawn_blocking(move || server.crash());
        crash.await.expect("it starts again");
        promised.extend(submitting.await.expect("no panic"));
    }
    assert_eq!(held.heartbeat.beat(None), Signal::Continue);
    assert_eq!(
        finish(&other, &held, done()).await,
        Committed::Yes(State::Succeeded)
    );
    for _ in 0..promised.len() {
        let held = lease(&other).await;
        assert_eq!(held.job.crashes, 0);
        assert!(promised.contains(&held.job.id));
        assert_eq!(
            finish(&other, &held, done()).await,
            Committed::Yes(State::Succeeded)
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_follower_at_one_node_sees_the_progress_of_another_and_a_cancellation_stops_its_worker() {
    let Some(database) = Database::new() else {
        return;
    };
    let (api, _heard) = database.node("api", QueueOptions::default()).await;
    let (worker, _heard) = database.node("worker", QueueOptions::default()).await;
    let id = submit(&api, submission("a")).await;
    let mut news = api.watch(id).await.expect("known");
    let held = lease(&worker).await;
    let progress = JobProgress {
        done: 7,
        total: 150,
        loss: 0.25,
    };
    assert_eq!(held.heartbeat.beat(Some(progress)), Signal::Continue);
    let seen = timeout(
        PATIENCE,
        news.wait_for(|job| job.progress == Some(progress)),
    )
    .await;
    assert_eq!(
        seen.expect("in time").expect("followed").state,
        State::Running
    );
    let durable = api.make_durable(id).await.expect("known");
    assert!(durable.durable);
    api.cancel(id).await.expect("known");
    hears(&held, Signal::Cancel).await;
    finish(&worker, &held, Outcome::Cancelled).await;
    let ended = timeout(PATIENCE, news.wait_for(|job| job.state.is_end())).await;
    assert_eq!(
        ended.expect("in time").expect("followed").state,
        State::Cancelled
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_frozen_worker_loses_its_job_and_its_late_result() {
    let Some(database) = Database::new() else {
        return;
    };
    let options = QueueOptions {
        lease: Duration::from_millis(800),
        retry_delay: Duration::from_millis(40),
        ..QueueOptions::default()
    };
    let (frozen, _heard) = database.node("frozen", options.clone()).await;
    let (other, _heard) = database.node("other", options).await;
    submit(&frozen, submission("a")).await;
    let held = lease(&frozen).await;
    let again = lease(&other).await;
    assert_eq!((again.job.id, again.job.attempt), (held.job.id, 2));
    hears(&held, Signal::Lost).await;
    assert_eq!(finish(&frozen, &held, done()).await, Committed::Fenced);
    assert_eq!(
        finish(&other, &again, done()).await,
        Committed::Yes(State::Succeeded)
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn priorities_and_shares_hold_across_nodes() {
    let Some(database) = Database::new() else {
        return;
    };
    let (one, _heard) = database.node("one", QueueOptions::default()).await;
    let (other, _heard) = database.node("other", QueueOptions::default()).await;
    for _ in 0..30 {
        submit(&one, submission("many")).await;
    }
    for _ in 0..6 {
        submit(&other, submission("few")).await;
    }
    let urgent = Submission {
        priority: Priority::High,
        ..submission("many")
    };
    let urgent = submit(&other, urgent).await;
    assert_eq!(lease(&one).await.job.id, urgent);
    let mut few = 0;
    for turn in 0..12 {
        let queue = [&one, &other][turn % 2];
        let held = lease(queue).await;
        few += u32::from(held.job.tenant.as_str() == "few");
        finish(queue, &held, done()).await;
    }
    assert!((5..=6).contains(&few), "{few} of 12");
    // Every node knows the load of all, a moment later.
    let began = Instant::now();
    while [&one, &other].map(|queue| queue.backlog().queued().jobs) != [24, 24] {
        assert!(began.elapsed() < PATIENCE, "{:?}", one.backlog());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_key_that_comes_to_two_nodes_at_once_makes_one_job() {
    let Some(database) = Database::new() else {
        return;
    };
    let (one, _heard) = database.node("one", QueueOptions::default()).await;
    let (other, _heard) = database.node("other", QueueOptions::default()).await;
    for round in 0..20 {
        let keyed = || Submission {
            idempotency: Some(Idempotency {
                key: format!("key {round}"),
                fingerprint: [1; 32],
            }),
            ..submission("a")
        };
        let (first, second) = tokio::join!(one.submit(keyed()), other.submit(keyed()));
        let is_new = |submitted| matches!(submitted, Ok(Submitted::New(_)));
        let is_known = |submitted| matches!(submitted, Ok(Submitted::Known(_)));
        match is_new(first.clone()) {
            true => assert!(is_known(second)),
            false => assert!(is_known(first) && is_new(second)),
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_removal_is_heard_once() {
    let Some(database) = Database::new() else {
        return;
    };
    let (one, mut heard) = database.node("one", QueueOptions::default()).await;
    let (other, mut heard_by_other) = database.node("other", QueueOptions::default()).await;
    let id = submit(&one, submission("a")).await;
    let held = lease(&other).await;
    finish(&other, &held, done()).await;
    one.remove(id).await.expect("it has ended");
    tokio::time::sleep(Duration::from_millis(1500)).await;
    let mut removals = 0;
    for heard in [&mut heard, &mut heard_by_other] {
        while let Ok(event) = heard.try_recv() {
            removals += u32::from(matches!(event, Event::Deleted(of) if of == id));
        }
    }
    assert_eq!(removals, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_deadline_is_by_the_clock_of_its_worker_and_is_kept_in_the_queue() {
    let Some(database) = Database::new() else {
        return;
    };
    let (queue, _heard) = database.node("one", QueueOptions::default()).await;
    let deadline = Timestamp::now().after(Duration::from_secs(60));
    let timed = Submission {
        deadline: Some(deadline),
        ..submission("a")
    };
    submit(&queue, timed).await;
    assert_eq!(lease(&queue).await.job.deadline, Some(deadline));
}
