//! A device and its lanes: the handles that workers use.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use tokio::sync::{mpsc, oneshot, watch};

use super::densify::{Densification, Densified};
use super::liveness::Liveness;
use super::slot::{Command, Request};
use super::supervisor::DeviceSupervisor;
use super::types::{DeviceFactory, DeviceOptions, EngineError, Health, Work};
use super::{densify, self_test, slot};
use crate::flow::Estimate;
use crate::flow::field::Backend;
use crate::job::DeviceKind;
use crate::metrics::Metrics;

/// Runs the self-test: fits a field to a small synthetic pair with known flow. On a GPU it also
/// compares a few iterations of the Chamfer distance and of the linear model with the CPU.
///
/// # Errors
/// The reason why the device failed: the estimate fails or panics, the mean end-point error of its
/// flow is 0.11 m or more, or not finite, or its flow differs from the CPU's by more than 0.01 m.
pub fn self_test_backend(backend: &dyn Backend) -> Result<(), String> {
    self_test::run(backend).map_err(|error| error.to_string())
}

/// Opens a device, runs the self-test, and closes the device again.
///
/// # Errors
/// The reason why the device failed: it cannot be opened, it fails its self-test, or one of them
/// panics.
pub fn try_opening(open: &DeviceFactory) -> Result<(), String> {
    self_test::opened(open).map(|opened| opened.destroy())
}

/// Handle to the thread of one lane.
struct LaneHandle {
    commands: mpsc::Sender<Command>,
    liveness: Arc<Liveness>,
}

/// Handle to a device and the threads of its lanes. Clones share them. The threads end when the
/// last [`Device`] and [`Lane`] of the device are dropped.
#[derive(Clone)]
pub struct Device {
    name: Arc<str>,
    kind: DeviceKind,
    health: watch::Receiver<Health>,
    supervisor: Arc<DeviceSupervisor>,
    lanes: Arc<[LaneHandle]>,
}

/// One lane of a device: runs one pair, or one densification, at a time. Clones share it.
#[derive(Clone)]
pub struct Lane {
    device: Device,
    index: usize,
}

impl Device {
    /// Starts the threads of the lanes. One of them opens the device and runs its self-test; this
    /// call does not wait for that. The number of lanes and the losses of the device go into
    /// `metrics`.
    ///
    /// # Errors
    /// The error of the operating system if a thread cannot be started.
    pub fn start(options: DeviceOptions, metrics: &Arc<Metrics>) -> std::io::Result<Self> {
        let (tell, health) = watch::channel(Health::Starting);
        let name: Arc<str> = Arc::from(options.name);
        let supervisor = Arc::new(DeviceSupervisor::new(
            Arc::clone(&name),
            options.open,
            options.reopening,
            Arc::clone(metrics),
            tell,
        ));
        let mut lanes = Vec::new();
        for index in 0..options.lanes.max(1) {
            let (commands, inbox) = mpsc::channel(1);
            let liveness = Arc::new(Liveness::default());
            let (lane_supervisor, lane_liveness) = (Arc::clone(&supervisor), Arc::clone(&liveness));
            thread::Builder::new()
                .name(format!("device {name} {index}"))
                .spawn(move || slot::run(&lane_supervisor, inbox, &lane_liveness))?;
            lanes.push(LaneHandle { commands, liveness });
        }
        metrics.device_lanes(&name, lanes.len());
        Ok(Self {
            name,
            kind: options.kind,
            health,
            supervisor,
            lanes: lanes.into(),
        })
    }

    /// The device's name in metrics and logs.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The kind of the device.
    pub fn kind(&self) -> DeviceKind {
        self.kind
    }

    /// A receiver of the device's health. It holds the current value and reports changes; a slow
    /// receiver misses values in between.
    pub fn health(&self) -> watch::Receiver<Health> {
        self.health.clone()
    }

    /// Whether the device works or is expected to work again. False for [`Health::Gone`], and for
    /// [`Health::Broken`] if the device has never passed its self-test.
    pub fn may_work(&self) -> bool {
        match &*self.health.borrow() {
            Health::Starting | Health::Ready => true,
            Health::Broken(_) => self.supervisor.has_worked(),
            Health::Gone(_) => false,
        }
    }

    /// The lanes, one for each worker.
    pub fn lanes(&self) -> impl ExactSizeIterator<Item = Lane> + '_ {
        (0..self.lanes.len()).map(|index| Lane {
            device: self.clone(),
            index,
        })
    }

    /// The reason why the device is not ready; `None` if it is ready. It is ready if at least one
    /// lane's thread runs, the self-test has passed, and every lane at work has had a heartbeat
    /// within the last 30 s.
    pub fn not_ready_reason(&self) -> Option<String> {
        if self.lanes().all(|lane| lane.has_ended()) {
            return Some(format!("{} has no thread any more", self.name));
        }
        match &*self.health.borrow() {
            Health::Starting => Some(format!("{} is being tried", self.name)),
            Health::Broken(reason) | Health::Gone(reason) => {
                Some(format!("{}: {reason}", self.name))
            }
            Health::Ready => {
                let silences = self
                    .lanes
                    .iter()
                    .map(|lane| lane.liveness.since_heartbeat());
                let since_heartbeat = silences.max().unwrap_or_default();
                (since_heartbeat > LONGEST_SILENCE).then(|| {
                    format!(
                        "{} gave no sign of life for {} s",
                        self.name,
                        since_heartbeat.as_secs()
                    )
                })
            }
        }
    }

    /// Checks whether the device was lost while idle. If so, tells the first lane to reopen it, and
    /// does not wait for that. A lane at work detects a loss itself.
    pub fn look(&self) {
        if self.supervisor.is_lost_unreported() {
            let _a_busy_lane_finds_out = self.lanes[0].commands.try_send(Command::Look);
        }
    }

    /// Total working time since the start, summed over the lanes, current work included.
    pub fn busy_time(&self) -> Duration {
        self.lanes.iter().map(|lane| lane.liveness.total()).sum()
    }
}

impl Lane {
    /// The device of this lane.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// The kind of the device.
    pub fn kind(&self) -> DeviceKind {
        self.device.kind
    }

    /// Whether the lane's thread has ended, by a panic that was not caught. It does not recover.
    pub fn has_ended(&self) -> bool {
        self.device.lanes[self.index].commands.is_closed()
    }

    /// Estimates the flow of one pair. Resumes from the snapshot, or starts afresh if there is none
    /// or it does not fit the work. Waits while the lane is at work. Dropping the future does not
    /// stop the estimate; its control does.
    ///
    /// # Errors
    /// - [`EngineError::Flow`] if the estimate refuses its input, fails or is cancelled.
    /// - [`EngineError::Panicked`] if the estimate panics.
    /// - [`EngineError::Lost`] if the device is lost during the work.
    /// - [`EngineError::Broken`] if the device could not start the work.
    ///
    /// After an error the lane takes the next pair, unless [`Device::health`] or
    /// [`Lane::has_ended`] shows otherwise.
    pub async fn estimate(&self, work: Work) -> Result<Estimate, EngineError> {
        self.run(move |backend, liveness| Ok(slot::estimate(backend, work, liveness)?))
            .await
    }

    /// Transforms the points of the sweeps of a sequence into the frame of the reference time.
    /// Waits while the lane is at work. Dropping the future does not stop the work; its control
    /// does.
    ///
    /// # Errors
    /// - [`EngineError::Densify`] if the number of sweeps is not that of the plan, a ground mask
    ///   has another length than its sweep, or the field of an edge is missing.
    /// - [`EngineError::Flow`] if the device fails, or the control interrupts.
    /// - [`EngineError::Panicked`] if the work panics.
    /// - [`EngineError::Lost`] if the device is lost during the work.
    /// - [`EngineError::Broken`] if the device could not start the work.
    pub async fn densify(&self, work: Densification) -> Result<Densified, EngineError> {
        self.run(move |backend, liveness| densify::densify(backend, &work, liveness))
            .await
    }

    async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&dyn Backend, &Liveness) -> Result<T, EngineError> + Send + 'static,
    ) -> Result<T, EngineError> {
        let gone = || EngineError::Broken("its thread has ended".to_owned());
        let (reply, answer) = oneshot::channel();
        let command = Command::Do(Box::new(Request { work, reply }));
        let commands = &self.device.lanes[self.index].commands;
        commands.send(command).await.map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?
    }
}

/// Time without a heartbeat during work after which a device counts as not ready.
const LONGEST_SILENCE: Duration = Duration::from_secs(30);
