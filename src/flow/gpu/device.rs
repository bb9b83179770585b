//! One opened card: its queue, its health and its memory. Knows no kernels.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::adapter::Adapter;
use crate::flow::backend::{Backend, BackendError, Transform};
use crate::flow::distance::DistanceOptions;
use crate::flow::points::Point;
use crate::flow::watch::Watch;

/// How a card is opened.
#[derive(Clone, Debug)]
pub struct GpuOptions {
    /// Pairs that may be fitted at the same time.
    pub lanes: usize,
    /// Bytes of the card's memory to take; what suits the card where none are named.
    pub memory_bytes: Option<u64>,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self {
            lanes: 1,
            memory_bytes: None,
        }
    }
}

/// An opened card. Clones share it.
#[derive(Clone)]
pub struct Gpu {
    lost: Arc<AtomicBool>,
    device: wgpu::Device,
    name: String,
}

impl Gpu {
    /// Opens a card, takes its memory and builds its kernels.
    ///
    /// # Errors
    /// [`BackendError`] where the driver refuses.
    pub fn open(adapter: &Adapter, _options: &GpuOptions) -> Result<Self, BackendError> {
        let (device, _queue) =
            pollster::block_on(adapter.handle.request_device(&wgpu::DeviceDescriptor {
                required_limits: adapter.handle.limits(),
                ..wgpu::DeviceDescriptor::default()
            }))
            .map_err(|error| BackendError::NoDevice(error.to_string()))?;
        Ok(Self {
            lost: Arc::default(),
            device,
            name: adapter.name.clone(),
        })
    }

    /// Whether the card is gone and must be opened again.
    pub fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Relaxed)
    }

    /// Gives the card up, as if it had been lost: whatever runs on it fails.
    pub fn destroy(&self) {
        self.device.destroy();
    }
}

impl Backend for Gpu {
    fn name(&self) -> String {
        format!("gpu ({})", self.name)
    }

    fn transform(
        &self,
        _source: &[Point],
        _target: &[Point],
        _options: &DistanceOptions,
        _watch: &dyn Watch,
    ) -> Result<Box<dyn Transform>, BackendError> {
        Err(BackendError::Unsupported("not yet"))
    }
}
