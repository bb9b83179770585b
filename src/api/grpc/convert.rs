//! Conversion of jobs, flows and dense clouds into messages.

use super::proto;
use crate::api::auth::Caller;
use crate::api::error::ApiError;
use crate::api::results::Answer;
use crate::api::waiting::Waiting;
use crate::clock::Timestamp;
use crate::flow::tracks::{Track, TrackState};
use crate::flow::{Cluster, StopReason};
use crate::job::{
    Delivery, DeliveryState, DenseReport, Job, JobError, JobId, JobProgress, Kind, Labels, State,
};

fn state(state: State) -> proto::State {
    match state {
        State::Queued => proto::State::Queued,
        State::Running => proto::State::Running,
        State::Succeeded => proto::State::Succeeded,
        State::Failed => proto::State::Failed,
        State::Cancelled => proto::State::Cancelled,
        State::Expired => proto::State::Expired,
    }
}

/// The reason of a name; unspecified without one.
fn stop_reason(name: Option<&str>) -> proto::StopReason {
    let mut known = StopReason::ALL.into_iter();
    match known.find(|reason| Some(reason.name()) == name) {
        None => proto::StopReason::Unspecified,
        Some(StopReason::Completed) => proto::StopReason::Completed,
        Some(StopReason::Converged) => proto::StopReason::Converged,
        Some(StopReason::MaxIterations) => proto::StopReason::MaxIterations,
        Some(StopReason::Deadline) => proto::StopReason::Deadline,
    }
}

fn moment(time: Timestamp) -> prost_types::Timestamp {
    let millis = time.as_millis();
    prost_types::Timestamp {
        seconds: millis.div_euclid(1000),
        nanos: (millis.rem_euclid(1000) * 1_000_000) as i32,
    }
}

/// Converts a job. `pair_ids` and `wait` remain empty.
pub(super) fn job(job: &Job) -> proto::Job {
    proto::Job {
        id: job.id.to_string(),
        state: state(job.state).into(),
        kind: match job.kind {
            Kind::Pair => proto::Kind::Pair.into(),
            Kind::Sequence => proto::Kind::Sequence.into(),
        },
        created_at: Some(moment(job.created)),
        started_at: job.started.map(moment),
        finished_at: job.finished.map(moment),
        attempt: job.attempt,
        progress: job.progress.map(progress),
        stop_reason: stop_reason(job.stop_reason.as_deref()).into(),
        error: job.error.as_ref().map(job_error),
        pair_ids: Vec::new(),
        pairs: job.pairs,
        pairs_left: job.pairs_left,
        labels: Labels::of_options(&job.options).0.into_iter().collect(),
        trace_id: job.trace_id().unwrap_or_default().to_owned(),
        delivery: job.delivery.as_ref().map(delivery),
        wait: None,
    }
}

/// Converts a job for its reader. With a share link it is shown without what is for its owner alone.
pub(super) fn job_for(caller: &Caller, job: &Job) -> proto::Job {
    let mut message = self::job(job);
    if caller.shared_job.is_some() {
        message.labels.clear();
        message.delivery = None;
    }
    message
}

fn delivery(delivery: &Delivery) -> proto::Delivery {
    let state = match delivery.state {
        DeliveryState::Pending => proto::DeliveryState::Pending,
        DeliveryState::Delivered => proto::DeliveryState::Delivered,
        DeliveryState::GivenUp => proto::DeliveryState::GivenUp,
    };
    proto::Delivery {
        uri: delivery.uri.clone(),
        state: state.into(),
    }
}

/// Converts the wait of a queued job.
pub(super) fn wait(waiting: Waiting) -> proto::Wait {
    proto::Wait {
        ahead: waiting.ahead,
        seconds: waiting.seconds,
    }
}

pub(super) fn progress(progress: JobProgress) -> proto::Progress {
    proto::Progress {
        done: progress.done,
        total: progress.total,
        loss: progress.loss,
    }
}

fn job_error(error: &JobError) -> proto::JobError {
    proto::JobError {
        code: error.code.clone(),
        message: error.message.clone(),
        retryable: error.retryable,
    }
}

/// Converts the error of one pair of a streamed sequence.
pub(super) fn pair_error(error: &ApiError) -> proto::JobError {
    match error {
        ApiError::JobFailed(_, failure) => job_error(failure),
        other => proto::JobError {
            code: other.row().code.to_owned(),
            message: other.to_string(),
            retryable: other.row().retryable,
        },
    }
}

/// The header that precedes the rows of a flow.
pub(super) fn header(answer: &Answer) -> proto::FlowHeader {
    let report = &answer.report;
    let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
    let seconds = report.seconds;
    let motion = report.ego_motion.as_ref();
    use proto::flow_header::Method;
    let method = match (&report.objects, &report.field) {
        (Some(objects), _) => Some(Method::Objects(proto::ObjectSearch {
            clusters: count(objects.clusters),
            candidates: count(objects.candidates),
            own_points: objects.own_points as u64,
            searched: count(objects.searched),
            moving: count(objects.moving),
            cost_m: objects.cost_m,
        })),
        (None, Some(field)) => Some(Method::Field(proto::FieldFit {
            iterations: count(field.iterations),
            max_iterations: count(field.max_iterations),
            best_iteration: count(field.best_iteration),
            best_loss: field.best_loss,
            loss_unit: match field.loss_unit.as_str() {
                "m" => proto::LossUnit::Metres,
                "m²" => proto::LossUnit::SquareMetres,
                _ => proto::LossUnit::Unspecified,
            }
            .into(),
        })),
        (None, None) => None,
    };
    proto::FlowHeader {
        job_id: answer.job.id.to_string(),
        stop_reason: stop_reason(Some(&report.stop_reason)).into(),
        points: report.points as u64,
        valid_points: report.valid_points as u64,
        ego_motion: motion
            .map(|rows| rows.as_flattened().to_vec())
            .unwrap_or_default(),
        device: report.device.clone(),
        seconds: Some(proto::Seconds {
            precompute: seconds.precompute,
            search: seconds.search,
            query: seconds.query,
            network: seconds.network,
            total: seconds.total,
        }),
        dt_s: report.dt_s as f32,
        dt_assumed: report.dt_assumed,
        overlap: report.overlap,
        warnings: report.warnings.clone(),
        ego_covariance: report
            .ego_covariance
            .map(|rows| rows.as_flattened().to_vec())
            .unwrap_or_default(),
        method,
    }
}

/// Converts a track.
pub(super) fn track(track: &Track) -> proto::Track {
    let state = |state: &TrackState| proto::TrackState {
        sweep: state.sweep,
        center: state.bounds.center.to_vec(),
        size: state.bounds.size.to_vec(),
        yaw: state.bounds.yaw,
        velocity: state.velocity.to_vec(),
        yaw_rate: state.yaw_rate,
        points: state.points,
        confidence: state.confidence,
    };
    proto::Track {
        id: track.id,
        states: track.states.iter().map(state).collect(),
    }
}

/// Converts a cluster.
pub(super) fn cluster(cluster: &Cluster) -> proto::Cluster {
    proto::Cluster {
        points: cluster.points,
        dynamic: cluster.dynamic,
        center: cluster.bounds.center.to_vec(),
        size: cluster.bounds.size.to_vec(),
        yaw: cluster.bounds.yaw,
        velocity: cluster.velocity.to_vec(),
        yaw_rate: cluster.yaw_rate,
        confidence: cluster.confidence,
        moving: cluster.moving,
    }
}

/// The header that precedes the rows of a dense cloud.
pub(super) fn dense_header(job: JobId, report: &DenseReport) -> proto::DenseHeader {
    proto::DenseHeader {
        job_id: job.to_string(),
        points: report.points as u64,
        sweeps: u32::try_from(report.sweeps).unwrap_or(u32::MAX),
        reference_time: report.reference_time,
        substeps: report.substeps,
        device: report.device.clone(),
        seconds: report.seconds,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_and_moments_are_those_of_the_job() {
        for reason in StopReason::ALL {
            let word = format!("STOP_REASON_{}", reason.name().to_uppercase());
            assert_eq!(stop_reason(Some(reason.name())).as_str_name(), word);
        }
        assert_eq!(stop_reason(None), proto::StopReason::Unspecified);
        for (millis, seconds, nanos) in [(1_500, 1, 500_000_000), (-1, -1, 999_000_000)] {
            let moment = moment(Timestamp::from_millis(millis));
            assert_eq!((moment.seconds, moment.nanos), (seconds, nanos));
        }
    }
}
