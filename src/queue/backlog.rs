//! The backlog: queued and running load by tenant, priority and device kind, for admission control.

use std::collections::HashMap;

use crate::job::{DeviceKind, Job, Priority, Tenant};

/// A number of jobs and the compute time predicted for them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Load {
    /// Number of jobs.
    pub jobs: u64,
    /// Predicted compute time, nominal seconds ([`crate::cost`]).
    pub seconds: f64,
}

impl Load {
    fn add(&mut self, seconds: f64) {
        self.jobs += 1;
        self.seconds += seconds;
    }

    fn remove(&mut self, seconds: f64) {
        self.jobs = self.jobs.saturating_sub(1);
        self.seconds = if self.jobs == 0 {
            0.0
        } else {
            (self.seconds - seconds).max(0.0)
        };
    }
}

/// Key of the queued load: tenant, priority and required device kind (`None`: any).
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct BacklogKey {
    pub(super) tenant: Tenant,
    pub(super) priority: Priority,
    pub(super) device: Option<DeviceKind>,
}

impl BacklogKey {
    fn of(job: &Job) -> Self {
        Self {
            tenant: job.tenant.clone(),
            priority: job.priority,
            device: job.device,
        }
    }
}

/// Queued and running load at one point in time. Pairs of a sequence count as jobs. The sequence
/// counts only while its closing job is queued or running.
#[derive(Clone, Debug, Default)]
pub struct Backlog {
    queued: HashMap<BacklogKey, Load>,
    running: Load,
}

impl Backlog {
    /// Load of the running jobs. Each counts with its whole predicted compute time.
    pub fn running(&self) -> Load {
        self.running
    }

    /// Queued load of one priority, over all tenants.
    pub fn queued_at(&self, priority: Priority) -> Load {
        self.sum(|key| key.priority == priority)
    }

    /// Queued load in total, including jobs that follow another one or wait for a retry.
    pub fn queued(&self) -> Load {
        self.sum(|_| true)
    }

    /// Queued load of the jobs that require this kind of device. Jobs for any device do not count.
    pub fn queued_only_for(&self, device: DeviceKind) -> Load {
        self.sum(|key| key.device == Some(device))
    }

    /// Queued load of one tenant.
    pub fn queued_of(&self, tenant: &Tenant) -> Load {
        self.sum(|key| key.tenant == *tenant)
    }

    /// Queued load of one tenant at one priority, for all devices.
    pub fn share_of(&self, tenant: &Tenant, priority: Priority) -> Load {
        self.sum(|key| key.priority == priority && key.tenant == *tenant)
    }

    /// Predicted compute time of the queued jobs that run before a job, nominal seconds.
    /// `share_seconds` is the work of the job's own tenant at its priority until then: before a new
    /// job that of [`Backlog::share_of`], for the job's end its own cost besides.
    ///
    /// Only jobs with exactly this `device` requirement count (`None`: any device). Running jobs
    /// do not count. All jobs of higher priority count. Of the same priority, each tenant counts up
    /// to `share_seconds`: by fair queueing each is served as much.
    pub fn ahead_of(
        &self,
        priority: Priority,
        share_seconds: f64,
        device: Option<DeviceKind>,
    ) -> f64 {
        let higher = self.sum(|key| key.priority > priority && key.device == device);
        let equals = |key: &&BacklogKey| key.priority == priority && key.device == device;
        let waiting = self.queued.iter().filter(|(key, _)| equals(key));
        let equal: f64 = waiting
            .map(|(_, load)| load.seconds.min(share_seconds))
            .sum();
        higher.seconds + equal
    }

    fn sum(&self, take: impl Fn(&BacklogKey) -> bool) -> Load {
        let taken = self.queued.iter().filter(|(key, _)| take(key));
        taken.fold(Load::default(), |sum, (_, load)| Load {
            jobs: sum.jobs + load.jobs,
            seconds: sum.seconds + load.seconds,
        })
    }

    /// Sets the queued load of a key.
    pub(super) fn enter_many(&mut self, key: BacklogKey, load: Load) {
        self.queued.insert(key, load);
    }

    /// Adds running load.
    pub(super) fn start_many(&mut self, load: Load) {
        self.running.jobs += load.jobs;
        self.running.seconds += load.seconds;
    }

    /// The queued load by tenant, priority and required kind of device, without empty ones.
    pub fn rows(&self) -> Vec<(Tenant, Priority, Option<DeviceKind>, Load)> {
        let rows = self.queued.iter().filter(|(_, load)| load.jobs > 0);
        rows.map(|(key, load)| (key.tenant.clone(), key.priority, key.device, *load))
            .collect()
    }

    /// The queued load of each key.
    pub(super) fn queued_loads(&self) -> impl Iterator<Item = (&BacklogKey, Load)> {
        self.queued.iter().map(|(key, load)| (key, *load))
    }

    pub(super) fn entered(&mut self, job: &Job) {
        let load = self.queued.entry(BacklogKey::of(job)).or_default();
        load.add(job.cost_seconds);
    }

    pub(super) fn started(&mut self, job: &Job) {
        self.running.add(job.cost_seconds);
    }

    pub(super) fn stopped(&mut self, job: &Job) {
        self.running.remove(job.cost_seconds);
    }

    pub(super) fn left(&mut self, job: &Job) {
        let key = BacklogKey::of(job);
        if let Some(load) = self.queued.get_mut(&key) {
            load.remove(job.cost_seconds);
            if load.jobs == 0 {
                self.queued.remove(&key);
            }
        }
    }
}
