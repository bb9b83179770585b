//! The GPU backend of the field fit.

use core::time::Duration;
use std::sync::Arc;
use std::thread;

use super::adapter::Adapter;
use super::chamfer::GpuCloud;
use super::cluster_search::has_kernel;
use super::device::Device;
use super::distance::GpuTransform;
use super::loss::GpuTarget;
use super::memory::GpuOptions;
use super::trainer::GpuTrainer;
use super::{distance, inference};
use crate::flow::data::{Control, Point};
use crate::flow::field::{Backend, BackendError, Network, PreparedTarget, Trainer};
use crate::flow::host::Host;
use crate::flow::objects::{FoundInScene, PackedScene};
use crate::flow::options::{FieldOptions, LossOptions};

/// How often a device that is destroyed is asked whether what was submitted has ended: for a second.
const MOST_POLLS: usize = 100;
/// Interval at which it is asked.
const POLL_INTERVAL: Duration = Duration::from_millis(10);

/// An opened GPU, as a [`Backend`]. Clones share it, and each can fit a pair from its own thread.
#[derive(Clone)]
pub struct Gpu(Arc<Device>);

impl Gpu {
    /// Opens a GPU, builds its kernels and allocates its memory. Starts a pool of host threads, as
    /// [`GpuOptions::host_threads`] says.
    ///
    /// # Errors
    /// - [`BackendError::NoDevice`] if the driver refuses to open the GPU.
    /// - [`BackendError::Memory`] if [`GpuOptions::memory_bytes`] is below the minimum or cannot be
    ///   allocated. Without a requested size, if even the minimum cannot be allocated. Also if a
    ///   kernel cannot bind a buffer of the minimum size.
    /// - [`BackendError::Lost`] if the driver rejects a kernel or loses the GPU meanwhile.
    /// - [`BackendError::Threads`] if the operating system cannot start the threads.
    pub fn open(adapter: &Adapter, options: &GpuOptions) -> Result<Self, BackendError> {
        Device::open(adapter, options).map(|device| Self(Arc::new(device)))
    }

    /// The same GPU, with `threads` threads of the host of its own. Both share the GPU's memory and
    /// submissions, and what is known of the latest sweeps.
    ///
    /// # Errors
    /// [`BackendError::Threads`] if the operating system cannot start the threads.
    pub fn beside(&self, threads: usize) -> Result<Self, BackendError> {
        self.0.beside(threads).map(|device| Self(Arc::new(device)))
    }

    /// Number of threads of the host.
    pub fn host_threads(&self) -> usize {
        self.0.host.threads().current_num_threads()
    }

    /// The number of lanes: pairs that can be fitted at the same time. It is smaller than
    /// [`GpuOptions::lanes`] if the networks of all lanes exceed the largest buffer that a kernel
    /// can bind.
    pub fn lanes(&self) -> usize {
        self.0.context.budget.lanes as usize
    }

    /// GPU memory that was allocated when the GPU was opened, bytes. It can be less than
    /// [`GpuOptions::memory_bytes`].
    pub fn memory_bytes(&self) -> u64 {
        self.0.context.budget.bytes()
    }

    /// The tile that the GPU's matrix units multiply in half precision, such as
    /// `16x16x16 f16 -> f32`. The self-test of the matrix units runs once, at the first call or at
    /// the first fit in half precision. All calls return its result. It runs again only if the GPU
    /// had no free memory for it.
    ///
    /// # Errors
    /// The reason why half precision is not available on this GPU, as text: a missing feature or
    /// tile, a failed self-test, or a failure of the GPU during the self-test.
    pub fn matrix_units(&self) -> Result<String, String> {
        let tested = self.0.tested_units().map_err(|error| error.to_string())?;
        let units = tested.as_ref().map_err(Clone::clone)?;
        Ok(units.tile.name().to_owned())
    }

    /// Whether the GPU is lost, or was destroyed, and must be opened again.
    pub fn is_lost(&self) -> bool {
        self.0.context.watchdog.check().is_err()
    }

    /// Destroys the device for all clones and frees its memory. All work on it fails with
    /// [`BackendError::Lost`] from then on. It waits for the threads that wait for the GPU: for one
    /// that hangs, up to twice the longest time without an answer.
    pub fn destroy(&self) {
        let context = &self.0.context;
        context.watchdog.lost("it was given up".to_owned());
        // A device that is destroyed keeps its buffers for as long as others have handles of them, and
        // those of a submission until a poll finds that it has ended.
        context.buffers.destroy();
        context.device.destroy();
        for _ in 0..MOST_POLLS {
            match context.device.poll(wgpu::PollType::Poll) {
                Ok(status) if !status.is_queue_empty() => thread::sleep(POLL_INTERVAL),
                _ => break,
            }
        }
    }

    /// Mutable access to the device, for tests.
    #[cfg(test)]
    pub(super) fn device_mut(&mut self) -> &mut Arc<Device> {
        &mut self.0
    }

    /// The device that all clones share.
    pub(super) fn device(&self) -> &Arc<Device> {
        &self.0
    }
}

impl Backend for Gpu {
    fn name(&self) -> String {
        self.0.name.clone()
    }

    fn host(&self) -> &Host {
        &self.0.host
    }

    fn searches_clusters(&self) -> bool {
        self.0.searches_clusters && has_kernel(&self.0.context)
    }

    fn search_clusters(
        &self,
        scene: &PackedScene,
        is_over: &dyn Fn() -> bool,
    ) -> Result<FoundInScene, BackendError> {
        let Device { context, kind, .. } = &*self.0;
        self.0
            .cluster_searches
            .search(context, *kind, scene, is_over)
    }

    fn prepare_target(
        &self,
        source: &[Point],
        target: &[Point],
        options: &LossOptions,
        control: &dyn Control,
    ) -> Result<Box<dyn PreparedTarget>, BackendError> {
        Ok(match options {
            LossOptions::Distance(options) => {
                let transform = &options.transform;
                Box::new(distance::build(
                    &self.0, source, target, transform, control,
                )?)
            }
            LossOptions::Chamfer(options) => {
                let cloud = GpuCloud::new(&self.0, source.len(), target, options, control)?;
                Box::new(cloud)
            }
        })
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        inference::network(&self.0.context, network, points)
    }
}

impl PreparedTarget for GpuTransform {
    fn bytes(&self) -> usize {
        self.allocation.target_bytes()
    }

    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError> {
        let samples = self.samples(points)?;
        Ok(samples.into_iter().map(|sample| sample.distance).collect())
    }

    fn start(
        &self,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + '_>, BackendError> {
        let target = GpuTarget::Transform(self);
        Ok(Box::new(GpuTrainer::new(target, source, options, seed)?))
    }
}

impl PreparedTarget for GpuCloud {
    fn bytes(&self) -> usize {
        self.allocation.target_bytes()
    }

    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError> {
        self.distances(points)
    }

    fn start(
        &self,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + '_>, BackendError> {
        let target = GpuTarget::Cloud(self);
        Ok(Box::new(GpuTrainer::new(target, source, options, seed)?))
    }
}
