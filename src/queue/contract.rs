//! The contract's tests: what every implementation of [`Queue`] must show.
//!
//! `queue_contract!` makes a test of each for one implementation. An implementation gives
//! [`Stand`]: a queue that can be opened, and opened again after its process "died".

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::timeout;

use super::{
    Committed, Event, Filter, Idempotency, Lease, Outcome, Queue, QueueError, QueueOptions, Signal,
    Submission, Submitted,
};
use crate::clock::Timestamp;
use crate::job::{Job, JobError, JobId, JobProgress, Kind, Priority, State, Tenant};

/// Long enough for a loaded machine; only a failure waits so long.
const PATIENCE: Duration = Duration::from_secs(20);

/// A place where one queue lives.
pub(crate) trait Stand {
    /// Opens it; the one that was open before is gone, as after a crash.
    fn open(&mut self, options: QueueOptions) -> (Arc<dyn Queue>, mpsc::UnboundedReceiver<Event>);
}

/// Makes one test of every claim of the contract.
macro_rules! queue_contract {
    ($stand:expr) => {
        $crate::queue::contract::queue_contract! { $stand;
            a_submitted_job_is_leased_once_and_ends_with_its_outcome,
            a_repeated_key_finds_the_first_job_and_another_payload_is_refused,
            higher_priorities_go_first_and_equals_in_order,
            tenants_share_by_predicted_work,
            a_cancelled_job_ends_at_once_or_through_its_worker,
            a_deadline_that_passes_in_the_queue_ends_the_job_without_any_worker,
            failures_are_retried_later_and_given_up_in_the_end,
            an_error_of_the_input_is_not_retried,
            a_released_job_is_queued_again_without_blame,
            a_silent_worker_loses_its_lease_and_its_late_result,
            a_crash_keeps_promises_and_forgets_what_nobody_waits_for,
            a_job_that_kills_the_process_again_and_again_is_given_up,
            a_job_made_durable_survives,
            a_sequence_ends_with_its_last_pair,
            a_sequence_is_cancelled_with_its_pairs_and_can_be_asked_for_again,
            ended_jobs_are_kept_for_a_while_and_then_forgotten,
            followers_see_every_state,
            lists_are_latest_first_in_pages_and_of_one_tenant,
        }
    };
    ($stand:expr; $($name:ident,)*) => {
        $(
            #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $name() {
                $crate::queue::contract::$name(&mut $stand).await;
            }
        )*
    };
}
pub(crate) use queue_contract;

fn tenant(name: &str) -> Tenant {
    name.parse().expect("a good name")
}

pub(crate) fn submission(of: &str) -> Submission {
    Submission {
        id: JobId::fresh(),
        tenant: tenant(of),
        kind: Kind::Pair,
        pairs: 0,
        priority: Priority::Normal,
        cost_seconds: 1.0,
        options: "{}".to_owned(),
        deadline: None,
        idempotency: None,
        durable: true,
    }
}

async fn submit(queue: &Arc<dyn Queue>, submission: Submission) -> Arc<Job> {
    match queue.submit(submission).await.expect("accepted") {
        Submitted::New(job) => job,
        Submitted::Known(job) => panic!("{} is not new", job.id),
    }
}

async fn lease(queue: &Arc<dyn Queue>) -> Lease {
    timeout(PATIENCE, queue.lease("worker"))
        .await
        .expect("a job is ready")
        .expect("a lease")
}

async fn nothing_is_ready(queue: &Arc<dyn Queue>) {
    let soon = timeout(Duration::from_millis(50), queue.lease("worker")).await;
    assert!(soon.is_err(), "a job was ready");
}

fn done() -> Outcome {
    Outcome::Succeeded {
        stop_reason: "converged".to_owned(),
        report: "{}".to_owned(),
    }
}

fn failure(retryable: bool) -> Outcome {
    Outcome::Failed(JobError {
        code: "broken".to_owned(),
        message: "it broke".to_owned(),
        retryable,
    })
}

async fn finish(queue: &Arc<dyn Queue>, job: &Job, outcome: Outcome) -> Committed {
    queue
        .finish(job.id, job.attempt, outcome)
        .await
        .expect("the store works")
}

async fn state(queue: &Arc<dyn Queue>, job: &Job) -> State {
    queue.job(&job.tenant, job.id).await.expect("known").state
}

/// Waits until a job is in a state.
async fn reaches(queue: &Arc<dyn Queue>, job: &Job, state: State) -> Arc<Job> {
    let mut news = queue.watch(job.id).await.expect("known");
    let reached = timeout(PATIENCE, news.wait_for(|job| job.state == state)).await;
    Arc::clone(&reached.expect("in time").expect("followed"))
}

fn quick() -> QueueOptions {
    QueueOptions {
        lease: Duration::from_millis(300),
        retry_delay: Duration::from_millis(40),
        ..QueueOptions::default()
    }
}

pub(crate) async fn a_submitted_job_is_leased_once_and_ends_with_its_outcome(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default());
    let job = submit(&queue, submission("a")).await;
    assert_eq!((job.state, job.attempt), (State::Queued, 0));
    assert_eq!(queue.backlog().queued().jobs, 1);
    let lease = lease(&queue).await;
    assert_eq!((lease.job.id, lease.job.attempt), (job.id, 1));
    assert_eq!(lease.pulse.beat(None), Signal::Continue);
    nothing_is_ready(&queue).await;
    assert_eq!(queue.backlog().queued().jobs, 0);
    assert_eq!(queue.backlog().running().jobs, 1);
    let committed = finish(&queue, &lease.job, done()).await;
    assert_eq!(committed, Committed::Yes(State::Succeeded));
    let ended = queue.job(&tenant("a"), job.id).await.expect("known");
    assert_eq!(ended.stop_reason.as_deref(), Some("converged"));
    assert!(ended.finished >= ended.started && ended.started.is_some());
    assert_eq!(finish(&queue, &lease.job, done()).await, Committed::Fenced);
    assert_eq!(queue.backlog().running().jobs, 0);
    let other = queue.job(&tenant("b"), job.id).await;
    assert_eq!(other, Err(QueueError::NotFound));
}

pub(crate) async fn a_repeated_key_finds_the_first_job_and_another_payload_is_refused(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default());
    let keyed = |of: &str, print: u8| Submission {
        idempotency: Some(Idempotency {
            key: "k".to_owned(),
            fingerprint: [print; 32],
        }),
        ..submission(of)
    };
    let first = submit(&queue, keyed("a", 1)).await;
    let again = queue.submit(keyed("a", 1)).await.expect("accepted");
    assert!(matches!(again, Submitted::Known(job) if job.id == first.id));
    let other = queue.submit(keyed("a", 2)).await;
    assert_eq!(other.err(), Some(QueueError::KeyReused(first.id)));
    submit(&queue, keyed("b", 2)).await;
    assert_eq!(queue.backlog().queued().jobs, 2);
}

pub(crate) async fn higher_priorities_go_first_and_equals_in_order(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default());
    let mut expected = Vec::new();
    for priority in [Priority::Low, Priority::Normal, Priority::High] {
        let mut jobs = Vec::new();
        for _ in 0..3 {
            let job = Submission {
                priority,
                ..submission("a")
            };
            jobs.push(submit(&queue, job).await.id);
        }
        jobs.append(&mut expected);
        expected = jobs;
    }
    for id in expected {
        assert_eq!(lease(&queue).await.job.id, id);
    }
}

pub(crate) async fn tenants_share_by_predicted_work(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default());
    for _ in 0..60 {
        submit(&queue, submission("many")).await;
    }
    for _ in 0..5 {
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    for _ in 0..4 {
        let long = Submission {
            cost_seconds: 2.0,
            ..submission("few")
        };
        submit(&queue, long).await;
    }
    // Between two of the few's jobs, which are twice as long, go at most two of the others'.
    let mut others = 0;
    let mut few = 0;
    while few < 4 {
        let held = lease(&queue).await;
        if held.job.tenant == tenant("few") {
            few += 1;
            others = 0;
        } else {
            others += 1;
            assert!(others <= 2, "after {few} of the few");
        }
        finish(&queue, &held.job, done()).await;
    }
    assert_eq!(queue.backlog().queued_of(&tenant("few")).jobs, 0);
}

pub(crate) async fn a_cancelled_job_ends_at_once_or_through_its_worker(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default());
    let queued = submit(&queue, submission("a")).await;
    let ended = queue.cancel(queued.id).await.expect("known");
    assert_eq!(ended.state, State::Cancelled);
    nothing_is_ready(&queue).await;
    assert_eq!(queue.backlog().queued().jobs, 0);

    submit(&queue, submission("a")).await;
    let running = lease(&queue).await;
    let asked = queue.cancel(running.job.id).await.expect("known");
    assert!(asked.cancel_requested && asked.state == State::Running);
    assert_eq!(running.pulse.signal(), Signal::Cancel);
    // A result that comes a moment too late is not wanted either.
    let committed = finish(&queue, &running.job, done()).await;
    assert_eq!(committed, Committed::Yes(State::Cancelled));
    let again = queue.cancel(running.job.id).await.expect("known");
    assert_eq!(again.state, State::Cancelled);
    let unknown = queue.cancel(JobId::fresh()).await;
    assert_eq!(unknown, Err(QueueError::NotFound));
}

pub(crate) async fn a_deadline_that_passes_in_the_queue_ends_the_job_without_any_worker(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default());
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
    let (queue, _events) = stand.open(quick());
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
    let again = queue.requeue(job.id).await.expect("it has ended");
    assert!(!again.dead && again.state == State::Queued && again.error.is_none());
    assert_eq!(lease(&queue).await.job.attempt, 4);
    let running = queue.requeue(job.id).await;
    assert_eq!(running, Err(QueueError::NotEnded(State::Running)));
}

pub(crate) async fn an_error_of_the_input_is_not_retried(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default());
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
    let (queue, _events) = stand.open(QueueOptions::default());
    submit(&queue, submission("a")).await;
    for attempt in 1..=6 {
        let held = lease(&queue).await;
        assert_eq!(held.job.attempt, attempt);
        let committed = finish(&queue, &held.job, Outcome::Released).await;
        assert_eq!(committed, Committed::Yes(State::Queued));
    }
}

pub(crate) async fn a_silent_worker_loses_its_lease_and_its_late_result(stand: &mut impl Stand) {
    let (queue, mut events) = stand.open(quick());
    let job = submit(&queue, submission("a")).await;
    let zombie = lease(&queue).await;
    let heir = lease(&queue).await;
    assert_eq!((heir.job.id, heir.job.attempt), (job.id, 2));
    assert_eq!(zombie.pulse.beat(None), Signal::Lost);
    assert_eq!(finish(&queue, &zombie.job, done()).await, Committed::Fenced);
    assert_eq!(state(&queue, &job).await, State::Running);
    // Signs of life keep the lease over many times its length.
    for _ in 0..20 {
        tokio::time::sleep(Duration::from_millis(50)).await;
        assert_eq!(heir.pulse.beat(None), Signal::Continue);
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
    let (queue, events) = stand.open(QueueOptions::default());
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

    let (queue, mut events) = stand.open(QueueOptions::default());
    assert_eq!(state(&queue, &ended).await, State::Succeeded);
    let gone = queue.job(&awaited.tenant, awaited.id).await;
    assert_eq!(gone, Err(QueueError::NotFound));
    let forgotten = |event: &Event| matches!(event, Event::Forgotten(id) if *id == awaited.id);
    let mut told = false;
    while let Ok(event) = events.try_recv() {
        told |= forgotten(&event);
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
    let (mut queue, mut events) = stand.open(options.clone());
    let job = submit(&queue, submission("a")).await;
    for crash in 1..=5 {
        let held = lease(&queue).await;
        // Its second run gets to a snapshot: what came before does not count any more.
        if crash == 2 {
            held.pulse.snapshot_kept();
            queue.make_durable(job.id).await.expect("known");
        }
        drop((queue, events));
        (queue, events) = stand.open(options.clone());
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
    let (queue, events) = stand.open(QueueOptions::default());
    let awaited = Submission {
        durable: false,
        ..submission("a")
    };
    let job = submit(&queue, awaited).await;
    assert!(queue.make_durable(job.id).await.expect("known").durable);
    drop((queue, events));
    let (queue, _events) = stand.open(QueueOptions::default());
    assert_eq!(state(&queue, &job).await, State::Queued);
}

fn sequence(pairs: u32) -> Submission {
    Submission {
        kind: Kind::Sequence,
        pairs,
        ..submission("a")
    }
}

pub(crate) async fn a_sequence_ends_with_its_last_pair(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default());
    let job = submit(&queue, sequence(3)).await;
    assert_eq!((job.pairs, job.pairs_left), (3, 3));
    assert_eq!(queue.backlog().queued().jobs, 3);
    for place in 0..3 {
        let held = lease(&queue).await;
        assert_eq!((held.job.parent, held.job.place), (Some(job.id), place));
        assert_eq!(state(&queue, &job).await, State::Running);
        finish(&queue, &held.job, done()).await;
    }
    let ended = reaches(&queue, &job, State::Succeeded).await;
    assert_eq!(ended.pairs_left, 0);
    let pairs = queue.pairs(job.id).await.expect("known");
    assert_eq!(pairs.len(), 3);
    let filter = Filter {
        tenant: tenant("a"),
        state: None,
        before: None,
        limit: 10,
    };
    assert_eq!(queue.list(filter).await.expect("a list").len(), 1);
}

pub(crate) async fn a_sequence_is_cancelled_with_its_pairs_and_can_be_asked_for_again(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default());
    let job = submit(&queue, sequence(3)).await;
    let first = lease(&queue).await;
    finish(&queue, &first.job, done()).await;
    let second = lease(&queue).await;
    queue.cancel(job.id).await.expect("known");
    assert_eq!(second.pulse.signal(), Signal::Cancel);
    finish(&queue, &second.job, Outcome::Cancelled).await;
    reaches(&queue, &job, State::Cancelled).await;
    nothing_is_ready(&queue).await;

    let again = queue.requeue(job.id).await.expect("it has ended");
    assert_eq!((again.state, again.pairs_left), (State::Queued, 2));
    for _ in 0..2 {
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    reaches(&queue, &job, State::Succeeded).await;

    let broken = submit(&queue, sequence(2)).await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, failure(false)).await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let ended = reaches(&queue, &broken, State::Failed).await;
    let error = ended.error.as_ref().expect("a reason");
    assert_eq!(error.message, "pair 0: it broke");
}

pub(crate) async fn ended_jobs_are_kept_for_a_while_and_then_forgotten(stand: &mut impl Stand) {
    let (queue, mut events) = stand.open(QueueOptions {
        retention: Duration::from_millis(80),
        ..QueueOptions::default()
    });
    let job = submit(&queue, sequence(1)).await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let mut forgotten = Vec::new();
    while forgotten.len() < 2 {
        let event = timeout(PATIENCE, events.recv()).await.expect("in time");
        if let Some(Event::Forgotten(id)) = event {
            forgotten.push(id);
        }
    }
    assert!(forgotten.contains(&job.id) && forgotten.contains(&held.job.id));
    let gone = queue.job(&job.tenant, job.id).await;
    assert_eq!(gone, Err(QueueError::NotFound));
    let known = queue.known(vec![job.id]).await.expect("an answer");
    assert_eq!(known, []);
}

pub(crate) async fn followers_see_every_state(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default());
    let job = submit(&queue, submission("a")).await;
    let mut news = queue.watch(job.id).await.expect("known");
    assert_eq!(news.borrow_and_update().state, State::Queued);
    let held = lease(&queue).await;
    timeout(PATIENCE, news.changed())
        .await
        .expect("in time")
        .expect("followed");
    assert_eq!(news.borrow_and_update().state, State::Running);
    let progress = JobProgress {
        iteration: 7,
        max_iterations: 150,
        loss: 0.25,
    };
    held.pulse.beat(Some(progress));
    timeout(PATIENCE, news.changed())
        .await
        .expect("in time")
        .expect("followed");
    assert_eq!(news.borrow_and_update().progress, Some(progress));
    finish(&queue, &held.job, done()).await;
    timeout(PATIENCE, news.changed())
        .await
        .expect("in time")
        .expect("followed");
    assert_eq!(news.borrow_and_update().state, State::Succeeded);
}

pub(crate) async fn lists_are_latest_first_in_pages_and_of_one_tenant(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default());
    let mut ids = Vec::new();
    for _ in 0..5 {
        ids.push(submit(&queue, submission("a")).await.id);
        submit(&queue, submission("b")).await;
    }
    ids.reverse();
    let page = |state, before, limit| {
        let filter = Filter {
            tenant: tenant("a"),
            state,
            before,
            limit,
        };
        let queue = Arc::clone(&queue);
        async move {
            let jobs = queue.list(filter).await.expect("a list");
            jobs.iter().map(|job| job.id).collect::<Vec<_>>()
        }
    };
    assert_eq!(page(None, None, 3).await, ids[..3]);
    assert_eq!(page(None, Some(ids[2]), 3).await, ids[3..]);
    queue.cancel(ids[1]).await.expect("known");
    assert_eq!(page(Some(State::Cancelled), None, 9).await, [ids[1]]);
    assert_eq!(page(Some(State::Queued), None, 9).await.len(), 4);
}
