//! Whether a job is accepted: priced before anything is kept, bounded in predicted seconds.
//!
//! A refusal says when to come back, from the same numbers that it was made with.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::error::ApiError;
use crate::cost::CostModel;
use crate::flow::{self, Price, Problem};
use crate::job::{JobOptions, Priority, Tenant};
use crate::payload::StoredCloud;
use crate::queue::Queue;

/// What is accepted at most.
#[derive(Clone, Debug)]
pub struct AdmissionLimits {
    /// Points of one cloud.
    pub max_points: usize,
    /// Memory that one pair may take on a device, bytes.
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
    devices: usize,
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
    /// Nominal seconds of all its pairs.
    pub nominal_seconds: f64,
    /// Who waits.
    pub promise: Promise,
}

impl Admission {
    /// A gate before `queue`, behind which `devices` work.
    pub fn new(
        limits: AdmissionLimits,
        queue: Arc<dyn Queue>,
        cost: Arc<CostModel>,
        devices: usize,
    ) -> Self {
        Self {
            limits,
            queue,
            cost,
            devices: devices.max(1),
            reserved: Arc::default(),
        }
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

    /// Prices a pair, and refuses what no device could do.
    ///
    /// # Errors
    /// [`ApiError::BadInput`] or [`ApiError::TooLarge`], with what the solver says.
    pub fn price(
        &self,
        source: &StoredCloud,
        target: &StoredCloud,
        options: &JobOptions,
    ) -> Result<Price, ApiError> {
        let ground = source.ground.as_deref().zip(target.ground.as_deref());
        let problem = Problem {
            source: &source.points,
            target: &target.points,
            ground: ground.map(<[_; 2]>::from),
        };
        let points = source.points.len().max(target.points.len());
        let price = flow::price(&problem, &options.solver_options(points)).map_err(|error| {
            if error.is_input() {
                ApiError::BadInput(error.to_string())
            } else {
                ApiError::internal(error)
            }
        })?;
        let limit = self.limits.max_pair_bytes;
        if price.bytes > limit {
            return Err(ApiError::TooLarge(format!(
                "the pair needs {} MiB on the device, {} are allowed: crop with range_m",
                price.bytes >> 20,
                limit >> 20
            )));
        }
        Ok(price)
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
        let devices = self.devices as f64;

        let own = real(backlog.queued_of(asked.tenant).seconds + asked.nominal_seconds);
        let tenant_excess = own - self.limits.max_tenant_queue.as_secs_f64();
        if tenant_excess > 0.0 {
            return Err(ApiError::TenantLimit(retry_after(tenant_excess / devices)));
        }
        let all = real(backlog.queued().seconds + *reserved + asked.nominal_seconds);
        let mut excess = all - self.limits.max_queue.as_secs_f64();
        if asked.promise == Promise::WhileAwaited {
            let ahead = backlog.ahead_of(asked.tenant, asked.priority, asked.nominal_seconds);
            let wait = real(ahead + *reserved) / devices;
            excess = excess.max((wait - self.limits.max_wait.as_secs_f64()) * devices);
        }
        if excess > 0.0 {
            return Err(ApiError::ServerFull(retry_after(excess / devices)));
        }
        *reserved += asked.nominal_seconds;
        Ok(Reservation {
            seconds: asked.nominal_seconds,
            reserved: Arc::clone(&self.reserved),
        })
    }
}

/// Whole seconds, at least one: what HTTP's header can say.
fn retry_after(seconds: f64) -> Duration {
    const LONGEST: f64 = 3600.0;
    Duration::from_secs(seconds.ceil().clamp(1.0, LONGEST) as u64)
}
