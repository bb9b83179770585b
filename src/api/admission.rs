//! Admission control: a job is priced before it is accepted, and the backlog is bounded in
//! predicted compute seconds.
//!
//! A refusal includes a retry delay, computed from the same backlog that caused the refusal.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::error::ApiError;
use crate::cost::{CostModel, Lanes};
use crate::flow::{self, Cost, Problem};
use crate::job::{DeviceKind, Job, JobOptions, Priority, Tenant};
use crate::payload::StoredCloud;
use crate::queue::{Backlog, Queue, Standing};
use crate::sync::locked;

/// Limits on accepted work.
#[derive(Clone, Debug)]
pub struct AdmissionLimits {
    /// Maximum number of points in one cloud.
    pub max_points: usize,
    /// Maximum predicted memory of one pair or one dense cloud on a device, bytes.
    pub max_pair_bytes: usize,
    /// Maximum predicted time until the start of a job whose caller waits for the result.
    pub max_wait: Duration,
    /// Maximum predicted compute time of all queued jobs, summed over the lanes.
    pub max_queue: Duration,
    /// Maximum predicted compute time of all queued jobs of one tenant, summed over the lanes.
    pub max_tenant_queue: Duration,
}

/// Decides whether a queue accepts a job.
///
/// It checks the number of points and the required kind of device, and predicts the cost of a job.
/// It compares the predicted compute time of the queued jobs with the [`AdmissionLimits`]. An
/// accepted job reserves its predicted compute time until it is in the queue. A job that is refused
/// because too much is queued gets a retry delay.
pub struct Admission {
    limits: AdmissionLimits,
    queue: Arc<dyn Queue>,
    cost: Arc<CostModel>,
    reserved: Arc<Mutex<Reserved>>,
}

/// Nominal seconds that are reserved for each tenant.
type Reserved = HashMap<Tenant, f64>;

/// Rounding of sums of reservations, seconds.
const NOTHING_S: f64 = 1e-9;

/// Predicted compute time that is reserved for a job until the job is in the queue. Released when
/// dropped.
#[derive(Debug)]
pub struct Reservation {
    seconds: f64,
    tenant: Tenant,
    reserved: Arc<Mutex<Reserved>>,
}

impl Drop for Reservation {
    fn drop(&mut self) {
        let mut reserved = locked(&self.reserved);
        if let Some(own) = reserved.get_mut(&self.tenant) {
            *own -= self.seconds;
            if *own < NOTHING_S {
                reserved.remove(&self.tenant);
            }
        }
    }
}

/// Whether a job depends on its caller's connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Durability {
    /// The caller waits for the result. The job is cancelled when the caller disconnects.
    Ephemeral,
    /// The job is durable: once accepted it does not depend on its caller or on this process.
    Durable,
}

/// The properties of a job that admission control depends on.
#[derive(Clone, Debug)]
pub struct AdmissionRequest<'a> {
    /// The tenant of the job.
    pub tenant: &'a Tenant,
    /// The priority of the job.
    pub priority: Priority,
    /// The kind of device that the job requires. `None` if any device will do.
    pub device: Option<DeviceKind>,
    /// Nominal compute seconds of all its pairs and of its dense cloud. Zero tests whether the
    /// limits are already exceeded, without a reservation.
    pub nominal_seconds: f64,
    /// Whether the caller waits for the result.
    pub durability: Durability,
}

impl Admission {
    /// Admission control for `queue` with these limits. `cost` gives the lanes that compute the
    /// jobs, and converts nominal to real seconds.
    pub fn new(limits: AdmissionLimits, queue: Arc<dyn Queue>, cost: Arc<CostModel>) -> Self {
        Self {
            limits,
            queue,
            cost,
            reserved: Arc::default(),
        }
    }

    /// The limits on accepted work.
    pub fn limits(&self) -> &AdmissionLimits {
        &self.limits
    }

    /// The lanes that compute the jobs.
    pub fn lanes(&self) -> Lanes {
        self.cost.lanes()
    }

    /// Refuses a cloud with too many points.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`] if `points` is above the limit.
    pub fn check_points(&self, points: usize) -> Result<(), ApiError> {
        let limit = self.limits.max_points;
        if points > limit {
            return Err(ApiError::TooLarge(format!(
                "a cloud has {points} points, this server takes {limit}"
            )));
        }
        Ok(())
    }

    /// Refuses a job for a kind of device that this server does not have. `None`, for any device,
    /// is accepted.
    ///
    /// # Errors
    /// [`ApiError::NoDevice`] if no lane is of the required kind.
    pub fn check_device(&self, device: Option<DeviceKind>) -> Result<(), ApiError> {
        match device {
            Some(kind) if self.cost.lanes().of(kind) == 0 => Err(ApiError::NoDevice(kind)),
            _ => Ok(()),
        }
    }

    /// The maximum memory of one pair or one dense cloud, bytes.
    pub(super) fn max_pair_bytes(&self) -> usize {
        self.limits.max_pair_bytes
    }

    /// Predicts the cost of a pair, without neighbor sweeps, and refuses a pair that exceeds the
    /// memory limit. With `chained` the pair starts from the field of the pair before, so its
    /// number of iterations is that of a warm start.
    ///
    /// # Errors
    /// - [`ApiError::BadInput`] if the pair cannot be estimated, with the message of the solver.
    /// - [`ApiError::TooLarge`] if the pair needs more memory than the limit.
    /// - [`ApiError::Internal`] if the prediction fails for another reason.
    pub fn predict_cost(
        &self,
        source: &StoredCloud,
        target: &StoredCloud,
        options: &JobOptions,
        chained: bool,
    ) -> Result<Cost, ApiError> {
        let ground = source.ground.as_deref().zip(target.ground.as_deref());
        let problem = Problem {
            source: &source.points,
            target: &target.points,
            ground: ground.map(<[_; 2]>::from),
            times: None,
            before: None,
            neighbors: &[],
        };
        let points = source.points.len().max(target.points.len());
        let mut options = options.solver_options(points);
        if let Some(field) = options.field_mut().filter(|_| chained)
            && let Some(warm_start) = field.warm_start
        {
            *field = field.warmed(warm_start);
        }
        let cost = flow::predict_cost(&problem, &options).map_err(|error| {
            if error.is_input() {
                ApiError::BadInput(error.to_string())
            } else {
                ApiError::internal(error)
            }
        })?;
        self.check_bytes(&cost)?;
        Ok(cost)
    }

    /// Refuses a cost that exceeds the memory limit of a pair.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`].
    pub(super) fn check_bytes(&self, cost: &Cost) -> Result<(), ApiError> {
        let limit = self.limits.max_pair_bytes;
        if cost.bytes > limit {
            return Err(ApiError::TooLarge(format!(
                "the pair needs {} MiB on the device, {} are allowed: crop with crop_m",
                cost.bytes >> 20,
                limit >> 20
            )));
        }
        Ok(())
    }

    /// Reserves predicted compute time for a job, or refuses it with a retry delay from 1 s to 3600
    /// s. With zero nominal seconds it reserves nothing, and only tests whether a request body is
    /// worth reading. Reservations count as queued jobs.
    ///
    /// # Errors
    /// - [`ApiError::TenantLimit`] if the job would exceed the limit on the tenant's queued jobs.
    /// - [`ApiError::ServerFull`] if it would exceed the limit on all queued jobs, or if its caller
    ///   would wait longer than the limit.
    pub fn admit(&self, asked: &AdmissionRequest<'_>) -> Result<Reservation, ApiError> {
        let backlog = self.queue.backlog();
        let mut reserved = locked(&self.reserved);
        let real = |nominal: f64| self.cost.seconds(nominal);
        let lanes = self.cost.lanes().total().max(1) as f64;

        let reserved_own = reserved.get(asked.tenant).copied().unwrap_or(0.0);
        let reserved_all: f64 = reserved.values().sum();
        let queued_own = backlog.queued_of(asked.tenant).seconds;
        let own = real(queued_own + reserved_own + asked.nominal_seconds);
        let tenant_excess = own - self.limits.max_tenant_queue.as_secs_f64();
        if tenant_excess > 0.0 {
            return Err(ApiError::TenantLimit(retry_after(tenant_excess / lanes)));
        }
        let all = real(backlog.queued().seconds + reserved_all + asked.nominal_seconds);
        let mut excess = all - self.limits.max_queue.as_secs_f64();
        if asked.durability == Durability::Ephemeral {
            let share = backlog.share_of(asked.tenant, asked.priority).seconds;
            let share = share + asked.nominal_seconds;
            let wait = self.wait(&backlog, asked.priority, asked.device, share, reserved_all);
            excess = excess.max((wait - self.limits.max_wait.as_secs_f64()) * lanes);
        }
        if excess > 0.0 {
            return Err(ApiError::ServerFull(retry_after(excess / lanes)));
        }
        if asked.nominal_seconds > 0.0 {
            *reserved.entry(asked.tenant.clone()).or_default() += asked.nominal_seconds;
        }
        Ok(Reservation {
            seconds: asked.nominal_seconds,
            tenant: asked.tenant.clone(),
            reserved: Arc::clone(&self.reserved),
        })
    }
}

impl Admission {
    /// The model of costs, which knows the lanes of all nodes.
    pub(super) fn cost(&self) -> &CostModel {
        &self.cost
    }

    /// Predicted seconds until a new job without cost is started that has this tenant, priority and
    /// requirement.
    pub(super) fn predicted_wait(
        &self,
        backlog: &Backlog,
        tenant: &Tenant,
        priority: Priority,
        device: Option<DeviceKind>,
    ) -> f64 {
        let share = backlog.share_of(tenant, priority).seconds;
        let reserved = locked(&self.reserved).values().sum();
        self.wait(backlog, priority, device, share, reserved)
    }

    /// Predicted seconds until a queued job is started.
    pub(super) fn predicted_start(&self, job: &Job, standing: Standing) -> f64 {
        let backlog = self.queue.backlog();
        let share = standing.share_seconds;
        self.wait(&backlog, job.priority, job.device, share, 0.0)
    }

    /// Predicted seconds until a job is started before which its tenant is served `share` nominal seconds,
    /// with `reserved` nominal seconds besides. All lanes share the jobs that may run on any
    /// device; the jobs that require one kind of device come on top. A job for any device waits for
    /// the kind that is free first.
    fn wait(
        &self,
        backlog: &Backlog,
        priority: Priority,
        device: Option<DeviceKind>,
        share: f64,
        reserved: f64,
    ) -> f64 {
        let ahead = |kind| backlog.ahead_of(priority, share, kind);
        let running = backlog.running();
        // Running jobs delay a new one only where they occupy every lane.
        let occupied = if running.jobs < self.cost.lanes().total() as u64 {
            0.0
        } else {
            running.seconds
        };
        let shared = ahead(None) + occupied + reserved;
        let kinds = DeviceKind::ALL.into_iter().filter(|kind| {
            self.cost.lanes().of(*kind) > 0 && device.is_none_or(|asked| asked == *kind)
        });
        let own = kinds.map(|kind| ahead(Some(kind)) / self.cost.rate(kind));
        shared / self.cost.total_rate() + own.reduce(f64::min).unwrap_or(0.0)
    }
}

/// A retry delay in whole seconds, from 1 s to 3600 s, as the `Retry-After` header requires.
fn retry_after(seconds: f64) -> Duration {
    const LONGEST: f64 = 3600.0;
    Duration::from_secs(seconds.ceil().clamp(1.0, LONGEST) as u64)
}
