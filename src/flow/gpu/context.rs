//! An opened GPU: queue, kernels, buffers, and detection of a lost device.

use core::time::Duration;
use std::sync::{Arc, Mutex, mpsc};

use super::adapter::{Adapter, AdapterKind};
use super::allocator::Allocator;
use super::buffers::{Buffers, Mapping, Write, allocated, largest};
use super::health::Watchdog;
use super::layout::ARRAYS;
use super::matrix_units;
use super::matrix_units::Tile;
use super::memory::{Budget, GpuOptions};
use super::pipelines::Kernels;
use crate::flow::data::locked;
use crate::flow::field::{BackendError, Parameters};

/// Time without an answer after which a GPU counts as hung. It is well below the default job lease
/// of 60 s.
const LONGEST_SILENCE: Duration = Duration::from_secs(20);
/// The same limit for a software device, whose speed depends on the load of the machine.
const SOFTWARE_SILENCE: Duration = Duration::from_secs(120);
/// Distances that are computed in one submission to the driver: 7 s at 1e10 a second.
const MOST_DISTANCES: usize = 1 << 36;
/// The same on a software device: 17 s at 1e9 a second.
const SOFTWARE_DISTANCES: usize = 1 << 34;

/// An opened GPU: its queue, its kernels, its buffers, its health.
pub(super) struct Context {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) kernels: Kernels,
    pub(super) buffers: Buffers,
    pub(super) budget: Budget,
    pub(super) allocator: Allocator,
    /// Seconds per tick of the GPU's timestamps; none if it has none.
    pub(super) tick: Option<f64>,
    pub(super) watchdog: Arc<Watchdog>,
    /// One more owner for each fit of a linear model.
    pub(super) linear_fits: Arc<()>,
    /// The tile of its matrix units, or the reason why they cannot be used.
    pub(super) tile: Result<Tile, String>,
    networks: Mutex<Vec<u32>>,
    longest_silence: Duration,
    /// Distances that are computed in one submission to the driver.
    pub(super) most_distances: usize,
}

impl Context {
    pub(super) fn open(adapter: &Adapter, options: &GpuOptions) -> Result<Self, BackendError> {
        let handle = &adapter.handle;
        let clock = handle.features() & wgpu::Features::TIMESTAMP_QUERY;
        let tile = Tile::offered(handle);
        let (matrices, experiments) = match tile {
            Ok(_) => matrix_units::asked_for(),
            Err(_) => Default::default(),
        };
        let opening = handle.request_device(&wgpu::DeviceDescriptor {
            label: Some("fnsf"),
            required_features: wgpu::Features::IMMEDIATES | clock | matrices,
            experimental_features: experiments,
            required_limits: handle.limits(),
            memory_hints: wgpu::MemoryHints::MemoryUsage,
            ..wgpu::DeviceDescriptor::default()
        });
        let (device, queue) = pollster::block_on(opening)
            .map_err(|error| BackendError::NoDevice(format!("{}: {error}", adapter.name)))?;
        let watchdog = Arc::new(Watchdog::default());
        let heard = Arc::clone(&watchdog);
        device.set_device_lost_callback(move |_, reason| heard.lost(reason));
        let heard = Arc::clone(&watchdog);
        // Only a defect causes an uncaptured error, and the results that it affects cannot be
        // trusted.
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            heard.lost(error.to_string());
        }));

        let kernels = Kernels::new(&device, &watchdog)?;
        let (budget, buffers) = Buffers::take(&device, adapter, options)?;
        let period = f64::from(queue.get_timestamp_period());
        watchdog.check()?;
        Ok(Self {
            kernels,
            buffers,
            allocator: Allocator::new(budget.store_words),
            networks: Mutex::new((0..budget.lanes as u32).rev().collect()),
            budget,
            tick: (!clock.is_empty()).then_some(period * 1e-9),
            watchdog,
            linear_fits: Arc::default(),
            most_distances: match adapter.kind {
                AdapterKind::Software => SOFTWARE_DISTANCES,
                _ => MOST_DISTANCES,
            },
            longest_silence: match adapter.kind {
                AdapterKind::Software => SOFTWARE_SILENCE,
                _ => LONGEST_SILENCE,
            },
            tile,
            device,
            queue,
        })
    }

    /// Allocates a network slot and returns its index.
    ///
    /// # Errors
    /// [`BackendError::Busy`] if all slots are in use.
    pub(super) fn take_network(&self) -> Result<u32, BackendError> {
        let mut free = locked(&self.networks);
        free.pop().ok_or(BackendError::Busy)
    }

    pub(super) fn give_network_back(&self, network: u32) {
        let mut free = locked(&self.networks);
        free.push(network);
    }

    /// A temporary buffer that contains `contents`, a whole number of 32-bit words.
    ///
    /// # Errors
    /// As [`Self::empty`].
    pub(super) fn filled(&self, contents: &[u8]) -> Result<wgpu::Buffer, BackendError> {
        self.all_filled([contents]).map(|[buffer]| buffer)
    }

    /// As [`Self::filled`], for several buffers in one submission.
    ///
    /// # Errors
    /// As [`Self::empty`].
    pub(super) fn all_filled<const N: usize>(
        &self,
        contents: [&[u8]; N],
    ) -> Result<[wgpu::Buffer; N], BackendError> {
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let empty = |contents: &&[u8]| self.empty(contents.len() as u64, usage);
        let buffers: Vec<_> = contents.iter().map(empty).collect::<Result<_, _>>()?;
        let writes = buffers.iter().zip(contents);
        let writes: Vec<Write<'_>> = writes
            .map(|(buffer, contents)| (buffer, 0, contents))
            .collect();
        self.write(&writes)?;
        let mut buffers = buffers.into_iter();
        Ok([(); N].map(|()| buffers.next().expect("one for each contents")))
    }

    /// A temporary buffer of `bytes` bytes.
    ///
    /// # Errors
    /// [`BackendError::Busy`] if the GPU has no free memory now. [`BackendError::Memory`] if the
    /// size exceeds the device's limit.
    pub(super) fn empty(
        &self,
        bytes: u64,
        usage: wgpu::BufferUsages,
    ) -> Result<wgpu::Buffer, BackendError> {
        let buffer = allocated(&self.device, "work", bytes.max(16), usage, Mapping::None);
        buffer.map_err(|error| self.busy_if_it_fits(error, usage))
    }

    /// [`BackendError::Busy`] instead of a lack of memory for a buffer with `usage` that is within
    /// the device's limit.
    pub(super) fn busy_if_it_fits(
        &self,
        error: BackendError,
        usage: wgpu::BufferUsages,
    ) -> BackendError {
        match error {
            BackendError::Memory { needed, .. } if needed <= largest(&self.device, usage) => {
                BackendError::Busy
            }
            error => error,
        }
    }

    pub(super) fn bound(
        &self,
        pipeline: &wgpu::ComputePipeline,
        buffers: &[&wgpu::Buffer],
    ) -> wgpu::BindGroup {
        let entries: Vec<_> = (0..)
            .zip(buffers)
            .map(|(binding, buffer)| wgpu::BindGroupEntry {
                binding,
                resource: buffer.as_entire_binding(),
            })
            .collect();
        self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &pipeline.get_bind_group_layout(0),
            entries: &entries,
        })
    }

    pub(super) fn encoder(&self) -> wgpu::CommandEncoder {
        let description = wgpu::CommandEncoderDescriptor::default();
        self.device.create_command_encoder(&description)
    }

    /// The arrays of a fit, of `floats` floats each, which begin at the byte `at` of `buffer`.
    ///
    /// # Errors
    /// As [`Self::finish`] and [`Self::empty`].
    pub(super) fn read_arrays(
        &self,
        buffer: &wgpu::Buffer,
        at: u64,
        floats: usize,
    ) -> Result<[Parameters; ARRAYS], BackendError> {
        let bytes = floats * size_of::<f32>();
        let all = (ARRAYS * bytes) as u64;
        let read = self.finish_from(self.encoder(), buffer, at, all)?;
        Ok(core::array::from_fn(|array| {
            let mut parameters = Parameters::zeros(floats);
            let into = &mut parameters.as_mut_slice()[..floats];
            let into = bytemuck::cast_slice_mut::<f32, u8>(into);
            into.copy_from_slice(&read[array * bytes..(array + 1) * bytes]);
            parameters
        }))
    }

    /// Submits the commands, waits for them, and returns the first `bytes` bytes of `buffer`.
    ///
    /// # Errors
    /// As [`Self::finish_from`].
    pub(super) fn finish(
        &self,
        encoder: wgpu::CommandEncoder,
        buffer: &wgpu::Buffer,
        bytes: u64,
    ) -> Result<Vec<u8>, BackendError> {
        self.finish_from(encoder, buffer, 0, bytes)
    }

    /// As [`Self::finish`], for the bytes of `buffer` from `at` on.
    ///
    /// # Errors
    /// As [`Self::finish_all`].
    pub(super) fn finish_from(
        &self,
        encoder: wgpu::CommandEncoder,
        buffer: &wgpu::Buffer,
        at: u64,
        bytes: u64,
    ) -> Result<Vec<u8>, BackendError> {
        self.finish_all(encoder, &[(buffer, at, bytes)])
    }

    /// As [`Self::finish`], for parts of several buffers, which follow each other in the result: where
    /// each begins in its buffer, and its bytes.
    ///
    /// # Errors
    /// [`BackendError::Lost`] if the GPU does not answer, and [`BackendError::Busy`] if it has no
    /// free memory.
    pub(super) fn finish_all(
        &self,
        mut encoder: wgpu::CommandEncoder,
        parts: &[(&wgpu::Buffer, u64, u64)],
    ) -> Result<Vec<u8>, BackendError> {
        let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        let all = parts.iter().map(|&(_, _, bytes)| bytes).sum();
        let staging = self.empty(all, usage)?;
        let mut end = 0;
        for &(buffer, at, bytes) in parts {
            encoder.copy_buffer_to_buffer(buffer, at, &staging, end, bytes);
            end += bytes;
        }
        let submission = self.queue.submit([encoder.finish()]);
        let (mapped, answer) = mpsc::channel();
        staging.map_async(wgpu::MapMode::Read, .., move |result| {
            let _who_waits_may_have_given_up = mapped.send(result);
        });
        self.wait(&submission)?;
        // The thread that polls runs the callbacks, and another thread may still be running this
        // one.
        match answer.recv_timeout(self.longest_silence) {
            Ok(Ok(())) => {}
            Ok(Err(error)) => {
                self.watchdog.check()?;
                return Err(BackendError::Device(error.to_string()));
            }
            Err(_) => return Err(BackendError::Device("no memory was mapped".to_owned())),
        }
        let view = staging.get_mapped_range(..);
        let view = view.map_err(|error| BackendError::Device(error.to_string()))?;
        Ok(view[..all as usize].to_vec())
    }

    /// Submits the commands of `encoder`, waits for them, and leaves an empty encoder.
    ///
    /// # Errors
    /// [`BackendError::Lost`] if the GPU does not answer.
    pub(super) fn flush(&self, encoder: &mut wgpu::CommandEncoder) -> Result<(), BackendError> {
        let commands = core::mem::replace(encoder, self.encoder());
        let submission = self.queue.submit([commands.finish()]);
        self.wait(&submission)
    }

    /// Waits for a submission. A loss that another thread finds is noticed when the wait ends.
    ///
    /// # Errors
    /// [`BackendError::Lost`] if the GPU does not answer.
    pub(super) fn wait(&self, submission: &wgpu::SubmissionIndex) -> Result<(), BackendError> {
        self.watchdog.check()?;
        // Not in shorter waits: wgpu 30 panics if one times out while another thread finds the queue
        // empty (gfx-rs/wgpu#9958).
        let wait = wgpu::PollType::Wait {
            submission_index: Some(submission.clone()),
            timeout: Some(self.longest_silence),
        };
        match self.device.poll(wait) {
            Ok(_) => {}
            Err(wgpu::PollError::Timeout) => {
                let seconds = self.longest_silence.as_secs();
                self.watchdog.lost(format!("no answer for {seconds} s"));
            }
            Err(error) => return Err(BackendError::Device(error.to_string())),
        }
        self.watchdog.check()
    }
}
