//! What waits and what runs, by tenant and priority: what admission looks at.

use std::collections::HashMap;

use crate::job::{Job, Priority, Tenant};

/// A number of jobs and the compute seconds predicted for them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Load {
    /// Jobs.
    pub jobs: u64,
    /// Predicted compute seconds.
    pub seconds: f64,
}

impl Load {
    pub(super) fn add(&mut self, seconds: f64) {
        self.jobs += 1;
        self.seconds += seconds;
    }

    pub(super) fn remove(&mut self, seconds: f64) {
        self.jobs = self.jobs.saturating_sub(1);
        self.seconds = if self.jobs == 0 {
            0.0
        } else {
            (self.seconds - seconds).max(0.0)
        };
    }
}

/// What waits and what runs at one moment.
#[derive(Clone, Debug, Default)]
pub struct Backlog {
    queued: HashMap<(Tenant, Priority), Load>,
    running: Load,
}

impl Backlog {
    /// What is running.
    pub fn running(&self) -> Load {
        self.running
    }

    /// All that waits at a priority.
    pub fn queued_at(&self, priority: Priority) -> Load {
        self.sum(|_, at| at == priority)
    }

    /// All that waits.
    pub fn queued(&self) -> Load {
        self.sum(|_, _| true)
    }

    /// What a tenant has waiting.
    pub fn queued_of(&self, tenant: &Tenant) -> Load {
        self.sum(|of, _| of == tenant)
    }

    /// Predicted compute seconds that go before a new job of `cost_seconds`: what is of higher
    /// priority, and of its own priority what the other tenants' shares let pass.
    pub fn ahead_of(&self, tenant: &Tenant, priority: Priority, cost_seconds: f64) -> f64 {
        let higher = self.sum(|_, at| at > priority).seconds;
        let of = |of: &Tenant| {
            let load = self.queued.get(&(of.clone(), priority));
            load.map_or(0.0, |load| load.seconds)
        };
        let own = of(tenant);
        let others = self
            .queued
            .keys()
            .filter(|(of, at)| *at == priority && of != tenant);
        // Each other tenant gets as much as this one until its own is done.
        let passing: f64 = others
            .map(|(other, _)| of(other).min(own + cost_seconds))
            .sum();
        higher + own + passing + self.running.seconds
    }

    fn sum(&self, take: impl Fn(&Tenant, Priority) -> bool) -> Load {
        let taken = self.queued.iter().filter(|((of, at), _)| take(of, *at));
        taken.fold(Load::default(), |sum, (_, load)| Load {
            jobs: sum.jobs + load.jobs,
            seconds: sum.seconds + load.seconds,
        })
    }

    pub(super) fn entered(&mut self, job: &Job) {
        let place = (job.tenant.clone(), job.priority);
        self.queued.entry(place).or_default().add(job.cost_seconds);
    }

    pub(super) fn enter_many(&mut self, place: (Tenant, Priority), load: Load) {
        self.queued.insert(place, load);
    }

    pub(super) fn left(&mut self, job: &Job) {
        let place = (job.tenant.clone(), job.priority);
        if let Some(load) = self.queued.get_mut(&place) {
            load.remove(job.cost_seconds);
            if load.jobs == 0 {
                self.queued.remove(&place);
            }
        }
    }

    pub(super) fn started(&mut self, job: &Job) {
        self.running.add(job.cost_seconds);
    }

    pub(super) fn stopped(&mut self, job: &Job) {
        self.running.remove(job.cost_seconds);
    }
}
