//! Contract tests: the behavior that every implementation of [`Queue`] must show.
//!
//! `queue_contract!` generates one test per function for one implementation. The implementation
//! provides a [`Stand`]: a queue that can be opened, and reopened after a simulated crash of its
//! process.

mod devices;
mod failures;
mod fairness;
mod lifecycle;
mod outbox;
mod retention;

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::timeout;

use super::interface::Queue;
use super::lease::{Lease, Signal};
use super::standing::Standing;
use super::types::{
    Committed, Event, Filter, Idempotency, Outcome, PairOf, QueueError, QueueOptions, Submission,
    Submitted,
};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobError, JobId, JobProgress, Kind, Priority, State, Tenant};

/// Timeout, long enough for a loaded machine. Only a failing test waits this long.
const PATIENCE: Duration = Duration::from_secs(20);

/// Storage of one queue, independent of the open queue.
pub(crate) trait Stand {
    /// Opens the queue. The queue that was open before must be dropped, as after a crash.
    async fn open(
        &mut self,
        options: QueueOptions,
    ) -> (Arc<dyn Queue>, mpsc::UnboundedReceiver<Event>);
}

/// Generates one test for each function of the contract. Without the stand, `None`, a test is
/// skipped.
macro_rules! queue_contract {
    ($stand:expr) => {
        $crate::queue::contract_tests::queue_contract! { $stand;
            a_submitted_job_is_leased_once_and_ends_with_its_outcome,
            a_repeated_key_finds_the_first_job_and_another_payload_is_refused,
            higher_priorities_go_first_and_equals_in_order,
            tenants_share_by_predicted_work,
            a_queued_job_knows_how_many_start_before_it,
            a_cancelled_job_ends_at_once_or_through_its_worker,
            a_deadline_that_passes_in_the_queue_ends_the_job_without_any_worker,
            failures_are_retried_later_and_given_up_in_the_end,
            an_error_of_the_input_is_not_retried,
            a_released_job_is_queued_again_without_blame,
            a_silent_worker_loses_its_lease_and_its_late_result,
            a_crash_keeps_promises_and_forgets_what_nobody_waits_for,
            a_job_that_kills_the_process_again_and_again_is_given_up,
            a_job_made_durable_survives,
            an_abandoned_job_ends_and_gives_up_its_key_unless_it_was_promised,
            a_job_that_was_given_up_frees_its_key_at_once_and_is_promised_to_nobody,
            a_job_whose_result_is_lost_can_be_asked_for_again,
            a_probe_leaves_nothing,
            jobs_that_come_and_go_at_once_are_not_counted_any_more,
            a_cancelled_job_whose_worker_is_silent_is_not_tried_again,
            a_job_that_is_asked_for_again_waits_for_its_turn,
            a_sequence_ends_with_its_last_pair,
            jobs_are_found_by_their_labels_until_they_are_removed,
            a_pair_says_which_sweeps_it_is_of_and_found_from,
            a_sequence_is_cancelled_with_its_pairs_and_can_be_asked_for_again,
            ended_jobs_are_kept_for_a_while_and_then_deleted,
            an_ended_job_is_removed_when_its_owner_asks_for_it,
            a_result_that_somebody_waits_to_read_is_kept,
            a_result_that_is_still_to_be_delivered_is_kept,
            a_pair_is_not_done_again_while_its_sequence_is_being_closed,
            a_sequence_that_is_asked_for_again_repeats_what_a_deadline_stopped_early,
            followers_see_every_state,
            lists_are_latest_first_in_pages_and_of_one_tenant,
            a_job_goes_only_to_the_kind_of_device_that_it_needs,
            jobs_that_wait_for_one_kind_hold_up_no_other,
            a_worker_that_leaves_claims_nothing,
            a_job_that_moves_waits_for_the_other_kind_without_blame,
            a_device_that_dies_under_a_job_again_and_again_ends_it,
            jobs_for_a_kind_survive_a_crash,
            a_job_is_leased_only_when_the_one_that_it_comes_after_has_ended,
            a_job_that_comes_after_one_that_has_ended_or_is_unknown_waits_for_nothing,
            a_job_that_waits_for_another_is_queued_but_nobody_is_late_with_it,
            a_chain_goes_on_behind_a_member_that_fails_is_cancelled_or_expires,
            a_chain_is_cancelled_whole_and_asked_for_again_in_its_order,
            a_chain_survives_a_crash_in_its_order,
            what_is_left_of_a_sequence_counts_in_its_tenants_share,
            chains_go_side_by_side_and_leave_other_tenants_their_share,
            what_others_come_after_is_kept_until_they_have_ended,
            a_sequence_with_something_left_to_do_is_leased_when_its_pairs_have_succeeded,
            what_is_left_of_a_sequence_survives_crashes_and_is_retried_cancelled_and_asked_for_again,
            a_pair_that_fails_back_in_time_is_named_and_nothing_is_left_to_do,
            the_end_of_a_job_is_told_once_per_end_and_not_of_the_pairs_of_a_sequence,
            what_is_promised_is_taken_once_and_again_after_its_hold_or_delay_or_a_crash,
            a_result_is_delivered_before_the_end_of_its_job_is_told,
            each_forward_pair_of_a_sequence_is_delivered_and_then_its_end_is_told,
            nothing_is_delivered_of_a_job_that_was_removed_or_is_done_again,
            notices_that_wait_for_a_delivery_hold_up_no_other,
        }
    };
    ($stand:expr; $($name:ident,)*) => {
        $(
            #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $name() {
                if let Some(mut stand) = $stand {
                    $crate::queue::contract_tests::$name(&mut stand).await;
                }
            }
        )*
    };
}
pub(crate) use super::contract_tests::devices::*;
pub(crate) use super::contract_tests::failures::*;
pub(crate) use super::contract_tests::fairness::*;
pub(crate) use super::contract_tests::lifecycle::*;
pub(crate) use super::contract_tests::outbox::*;
pub(crate) use super::contract_tests::retention::*;
pub(crate) use queue_contract;

fn tenant(name: &str) -> Tenant {
    name.parse().expect("a good name")
}

pub(crate) fn submission(of: &str) -> Submission {
    Submission {
        cost_seconds: 1.0,
        options: "{}".to_owned(),
        ..Submission::pair(tenant(of))
    }
}

async fn submit(queue: &Arc<dyn Queue>, submission: Submission) -> Arc<Job> {
    match queue.submit(submission).await.expect("accepted") {
        Submitted::New(job) => job,
        Submitted::Known(job) => panic!("{} is not new", job.id),
    }
}

async fn lease(queue: &Arc<dyn Queue>) -> Lease {
    lease_on(queue, DeviceKind::Cpu).await
}

async fn lease_on(queue: &Arc<dyn Queue>, kind: DeviceKind) -> Lease {
    timeout(PATIENCE, queue.lease("worker", kind))
        .await
        .expect("a job is ready")
        .expect("a lease")
}

async fn nothing_is_ready(queue: &Arc<dyn Queue>) {
    nothing_is_ready_for(queue, DeviceKind::Cpu).await;
}

async fn nothing_is_ready_for(queue: &Arc<dyn Queue>, kind: DeviceKind) {
    let soon = timeout(Duration::from_millis(50), queue.lease("worker", kind)).await;
    assert!(soon.is_err(), "a job was ready");
}

pub(crate) fn done() -> Outcome {
    Outcome::Succeeded {
        stop_reason: Some("converged".to_owned()),
        report: "{}".to_owned(),
        progress: Some(JobProgress {
            done: 9,
            total: 150,
            loss: 0.125,
        }),
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

fn sequence(pairs: u32) -> Submission {
    Submission {
        kind: Kind::Sequence,
        pairs: (0..pairs).map(|index| forward(index, false)).collect(),
        ..submission("a")
    }
}

fn forward(index: u32, chained: bool) -> PairOf {
    PairOf {
        index,
        backward: false,
        window: [index, index + 2],
        chained,
    }
}
