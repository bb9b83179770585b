//! Whether a job is accepted: priced before anything is kept, bounded in predicted seconds.
//!
//! A refusal says when to come back, from the same numbers that it was made with.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::error::ApiError;
use crate::cost::CostModel;
use crate::flow::{self, Cost, Problem};
use crate::job::{DeviceKind, JobOptions, Priority, Tenant};
use crate::payload::StoredCloud;
use crate::queue::{Backlog, Queue};

/// What is accepted at most.
#[derive(Clone, Debug)]
pub struct AdmissionLimits {
    /// Points of one cloud.
    pub max_points: usize,
    /// Memory that one pair, or one dense cloud, may take on a device, bytes.
    pub max_pair_bytes: usize,
    /// Predicted wait of somebody who waits on the line.
    pub max_wait: Duration,
    /// Predicted compute time of everything that waits.
    pub max_queue: Duration,
    /// Predicted compute time of everything that one tenant has waiting.
    pub max_tenant_queue: Duration,
}

/// The gate.
pub struct Admission {
    limits: AdmissionLimits,
    queue: Arc<dyn Queue>,
    cost: Arc<CostModel>,
    reserved: Arc<Mutex<f64>>,
}

/// A place in the queue that is kept until the job is in it.
#[derive(Debug)]
pub struct Reservation {
    seconds: f64,
    reserved: Arc<Mutex<f64>>,
}

impl Drop for Reservation {
    fn drop(&mut self) {
        *self.reserved.lock().unwrap_or_else(PoisonError::into_inner) -= self.seconds;
    }
}

/// Who waits for a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Promise {
    /// Somebody waits on the line: the job ends with the call.
    WhileAwaited,
    /// Nobody has to: the job outlives everything once it is accepted.
    Durable,
}

/// Who asks for what.
#[derive(Clone, Debug)]
pub struct Asked<'a> {
    /// Whose job it is.
    pub tenant: &'a Tenant,
    /// How urgent it is.
    pub priority: Priority,
    /// The kind of device that it has to be done on; none where any will do.
    pub device: Option<DeviceKind>,
    /// Nominal seconds of all its pairs.
    pub nominal_seconds: f64,
    /// Who waits.
    pub promise: Promise,
}

impl Admission {
    /// A gate before `queue`, behind which the lanes of `cost` work.
    pub fn new(limits: AdmissionLimits, queue: Arc<dyn Queue>, cost: Arc<CostModel>) -> Self {
        Self {
            limits,
            queue,
            cost,
            reserved: Arc::default(),
        }
    }

    /// Points that one cloud may have.
    pub fn max_points(&self) -> usize {
        self.limits.max_points
    }

    /// Refuses a cloud with too many points.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`].
    pub fn check_points(&self, points: usize) -> Result<(), ApiError> {
        let limit = self.limits.max_points;
        if points > limit {
            return Err(ApiError::TooLarge(format!(
                "a cloud has {points} points, this server takes {limit}"
            )));
        }
        Ok(())
    }

    /// Refuses a job for a kind of device that is not here.
    ///
    /// # Errors
    /// [`ApiError::NoDevice`].
    pub fn check_device(&self, device: Option<DeviceKind>) -> Result<(), ApiError> {
        match device {
            Some(kind) if self.cost.lanes().of(kind) == 0 => Err(ApiError::NoDevice(kind)),
            _ => Ok(()),
        }
    }

    /// Memory that one pair, or one dense cloud, may take.
    pub(super) fn max_pair_bytes(&self) -> usize {
        self.limits.max_pair_bytes
    }

    /// Prices a pair, and refuses what no device could do. One that `goes_on` from the pair before
    /// takes as many iterations as that allows.
    ///
    /// # Errors
    /// [`ApiError::BadInput`] or [`ApiError::TooLarge`], with what the solver says.
    pub fn price(
        &self,
        source: &StoredCloud,
        target: &StoredCloud,
        options: &JobOptions,
        goes_on: bool,
    ) -> Result<Cost, ApiError> {
        let ground = source.ground.as_deref().zip(target.ground.as_deref());
        let problem = Problem {
            source: &source.points,
            target: &target.points,
            ground: ground.map(<[_; 2]>::from),
            before: None,
            around: &[],
        };
        let points = source.points.len().max(target.points.len());
        let mut options = options.solver_options(points);
        if let Some(warm_start) = options.warm_start.filter(|_| goes_on) {
            options = options.warmed(warm_start);
        }
        let price = flow::price(&problem, &options).map_err(|error| {
            if error.is_input() {
                ApiError::BadInput(error.to_string())
            } else {
                ApiError::internal(error)
            }
        })?;
        self.check_bytes(&price)?;
        Ok(price)
    }

    /// Refuses what needs more memory than a pair may take.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`].
    pub(super) fn check_bytes(&self, price: &Cost) -> Result<(), ApiError> {
        let limit = self.limits.max_pair_bytes;
        if price.bytes > limit {
            return Err(ApiError::TooLarge(format!(
                "the pair needs {} MiB on the device, {} are allowed: crop with range_m",
                price.bytes >> 20,
                limit >> 20
            )));
        }
        Ok(())
    }

    /// Keeps a place for a job, or says when to come back. Asked for no seconds it costs nothing
    /// and says whether a body is worth reading.
    ///
    /// # Errors
    /// [`ApiError::TenantLimit`] or [`ApiError::ServerFull`].
    pub fn admit(&self, asked: &Asked<'_>) -> Result<Reservation, ApiError> {
        let backlog = self.queue.backlog();
        let mut reserved = self.reserved.lock().unwrap_or_else(PoisonError::into_inner);
        let real = |nominal: f64| self.cost.seconds(nominal);
        let lanes = self.cost.lanes().total().max(1) as f64;

        let own = real(backlog.queued_of(asked.tenant).seconds + asked.nominal_seconds);
        let tenant_excess = own - self.limits.max_tenant_queue.as_secs_f64();
        if tenant_excess > 0.0 {
            return Err(ApiError::TenantLimit(retry_after(tenant_excess / lanes)));
        }
        let all = real(backlog.queued().seconds + *reserved + asked.nominal_seconds);
        let mut excess = all - self.limits.max_queue.as_secs_f64();
        if asked.promise == Promise::WhileAwaited {
            let wait = self.wait(&backlog, asked, *reserved);
            excess = excess.max((wait - self.limits.max_wait.as_secs_f64()) * lanes);
        }
        if excess > 0.0 {
            return Err(ApiError::ServerFull(retry_after(excess / lanes)));
        }
        *reserved += asked.nominal_seconds;
        Ok(Reservation {
            seconds: asked.nominal_seconds,
            reserved: Arc::clone(&self.reserved),
        })
    }
}

impl Admission {
    /// Predicted seconds until a new job is started: all lanes share what any of them may do, and
    /// one kind's own queue comes on top. A job that may go anywhere waits for the sooner kind.
    fn wait(&self, backlog: &Backlog, asked: &Asked<'_>, reserved: f64) -> f64 {
        let ahead =
            |device| backlog.ahead_of(asked.tenant, asked.priority, asked.nominal_seconds, device);
        let shared = ahead(None) + backlog.running().seconds + reserved;
        let kinds = DeviceKind::ALL.into_iter().filter(|kind| {
            self.cost.lanes().of(*kind) > 0 && asked.device.is_none_or(|asked| asked == *kind)
        });
        let own = kinds.map(|kind| ahead(Some(kind)) / self.cost.rate(kind));
        shared / self.cost.total_rate() + own.reduce(f64::min).unwrap_or(0.0)
    }
}

/// Whole seconds, at least one: what HTTP's header can say.
fn retry_after(seconds: f64) -> Duration {
    const LONGEST: f64 = 3600.0;
    Duration::from_secs(seconds.ceil().clamp(1.0, LONGEST) as u64)
}
