//! One opened card: its queue, its memory, its health. Knows no optimization.

use core::time::Duration;
use std::sync::{Arc, Mutex, OnceLock, PoisonError, mpsc};

use super::adapter::{Adapter, AdapterKind};
use super::allocator::Allocator;
use super::batcher::Batch;
use super::half::Units;
use super::layout::STEPS;
use super::memory::Budget;
use super::pipelines::Kernels;
use super::{distance, half, inference, layout};
use crate::flow::data::{Control, Point};
use crate::flow::distance::DistanceOptions;
use crate::flow::field::{Backend, BackendError, Network, Transform};
use crate::flow::host::Host;

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
pub struct Gpu(Arc<Card>);

impl Gpu {
    /// Opens a card, takes its memory and builds its kernels.
    ///
    /// # Errors
    /// [`BackendError`] where the driver refuses, or the card has too little memory.
    pub fn open(adapter: &Adapter, options: &GpuOptions) -> Result<Self, BackendError> {
        Card::open(adapter, options).map(|card| Self(Arc::new(card)))
    }

    /// Pairs that may be fitted at the same time.
    pub fn lanes(&self) -> usize {
        self.0.budget.lanes as usize
    }

    /// Bytes of the card's memory that were taken.
    pub fn memory_bytes(&self) -> u64 {
        self.0.budget.bytes()
    }

    /// The tile that the card's matrix units multiply, such as `16x16x16 f16 -> f32`, where they pass
    /// their self-test; the first call takes its time.
    ///
    /// # Errors
    /// Why half precision is not to be had on this card.
    pub fn matrix_units(&self) -> Result<String, String> {
        let units = self.0.tested_units().as_ref().map_err(Clone::clone)?;
        Ok(units.tile.name().to_owned())
    }

    /// Whether the card is gone and must be opened again.
    pub fn is_lost(&self) -> bool {
        self.0.watchdog.check().is_err()
    }

    /// Gives the card up, as if it had been lost: whatever runs on it fails.
    pub fn destroy(&self) {
        self.0.device.destroy();
        self.0.watchdog.lost("it was given up".to_owned());
    }

    /// The shared card.
    pub(super) fn card(&self) -> &Arc<Card> {
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

    fn transform(
        &self,
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        control: &dyn Control,
    ) -> Result<Box<dyn Transform>, BackendError> {
        let built = distance::build(&self.0, source, target, options, control)?;
        Ok(Box::new(built))
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        inference::network(&self.0, network, points)
    }
}

/// Why the card cannot go on, once it cannot.
#[derive(Debug, Default)]
pub(super) struct Watchdog(OnceLock<String>);

impl Watchdog {
    /// The card is gone; the first reason is kept.
    pub(super) fn lost(&self, reason: String) {
        let _the_first_counts = self.0.set(reason);
    }

    /// # Errors
    /// [`BackendError::Lost`] where the card is gone.
    pub(super) fn check(&self) -> Result<(), BackendError> {
        let lost = |reason: &String| Err(BackendError::Lost(reason.clone()));
        self.0.get().map_or(Ok(()), lost)
    }
}

/// Silence after which a card counts as hung: well within a job's lease.
const LONGEST_SILENCE: Duration = Duration::from_secs(20);
/// The same of software, which is no faster than the machine is idle.
const SOFTWARE_SILENCE: Duration = Duration::from_secs(120);
/// How often who waits for the card looks whether it is still there. Seldom: a wait that times out
/// while another thread sees the queue end trips an assertion of wgpu 30 (gfx-rs/wgpu#9958), which
/// costs the card.
const LOOK: Duration = Duration::from_secs(2);
/// Groups along one dimension of a dispatch.
const MOST_GROUPS: u32 = 65_535;

/// An opened card, shared by all who use it.
pub(super) struct Card {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) kernels: Kernels,
    pub(super) buffers: Buffers,
    pub(super) budget: Budget,
    pub(super) words: Allocator,
    pub(super) batch: Batch,
    pub(super) host: Host,
    /// Seconds of one tick of the card's clock; none where it shows none.
    pub(super) tick: Option<f64>,
    pub(super) watchdog: Arc<Watchdog>,
    /// The tile of its matrix units, or why there are none to be used.
    pub(super) tile: Result<half::Tile, String>,
    units: OnceLock<Result<Units, String>>,
    networks: Mutex<Vec<u32>>,
    longest_silence: Duration,
    name: String,
}

/// The buffers that are taken when the card is opened; [`Budget`] says how large.
pub(super) struct Buffers {
    /// Transforms and points.
    pub(super) store: wgpu::Buffer,
    pub(super) networks: wgpu::Buffer,
    pub(super) activations: wgpu::Buffer,
    pub(super) deltas: wgpu::Buffer,
    pub(super) flows: wgpu::Buffer,
    pub(super) loss_gradients: wgpu::Buffer,
    pub(super) partials: wgpu::Buffer,
    pub(super) lanes: wgpu::Buffer,
    pub(super) steps: wgpu::Buffer,
    pub(super) statuses: wgpu::Buffer,
    pub(super) losses: wgpu::Buffer,
}

impl Card {
    fn open(adapter: &Adapter, options: &GpuOptions) -> Result<Self, BackendError> {
        let handle = &adapter.handle;
        let clock = handle.features() & wgpu::Features::TIMESTAMP_QUERY;
        let tile = half::Tile::offered(handle);
        let (matrices, experiments) = match tile {
            Ok(_) => half::asked_for(),
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
        // Nothing here is wrong but by a defect: whatever it touched cannot be trusted.
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            heard.lost(error.to_string());
        }));

        let kernels = Kernels::new(&device, &watchdog)?;
        let (budget, buffers) = Buffers::take(&device, adapter, options)?;
        let host = Host::new(None, None)?;
        let period = f64::from(queue.get_timestamp_period());
        watchdog.check()?;
        Ok(Self {
            kernels,
            buffers,
            words: Allocator::new(budget.store_words),
            networks: Mutex::new((0..budget.lanes as u32).rev().collect()),
            budget,
            batch: Batch::default(),
            host,
            tick: (!clock.is_empty()).then_some(period * 1e-9),
            watchdog,
            longest_silence: match adapter.kind {
                AdapterKind::Software => SOFTWARE_SILENCE,
                _ => LONGEST_SILENCE,
            },
            tile,
            units: OnceLock::new(),
            name: format!(
                "{} ({}, {})",
                adapter.name, adapter.interface, adapter.driver
            ),
            device,
            queue,
        })
    }

    /// The matrix units, or why there are none to be used; tested once.
    fn tested_units(&self) -> &Result<Units, String> {
        self.units
            .get_or_init(|| Units::new(self, self.tile.clone()?))
    }

    /// The matrix units.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`] where there are none, or they failed their self-test.
    pub(super) fn units(&self) -> Result<&Units, BackendError> {
        let text = "half precision needs matrix units that pass their self-test";
        let units = self.tested_units().as_ref();
        units.map_err(|_| BackendError::Unsupported(text))
    }

    /// A free network's number.
    ///
    /// # Errors
    /// [`BackendError::Busy`] where all are taken.
    pub(super) fn take_network(&self) -> Result<u32, BackendError> {
        let mut free = self.networks.lock().unwrap_or_else(PoisonError::into_inner);
        free.pop().ok_or(BackendError::Busy)
    }

    pub(super) fn give_network_back(&self, network: u32) {
        let mut free = self.networks.lock().unwrap_or_else(PoisonError::into_inner);
        free.push(network);
    }

    /// A buffer for a moment, filled with `contents` of whole words.
    ///
    /// # Errors
    /// As [`Self::empty`].
    pub(super) fn filled(&self, contents: &[u8]) -> Result<wgpu::Buffer, BackendError> {
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let buffer = self.empty(contents.len() as u64, usage)?;
        self.queue.write_buffer(&buffer, 0, contents);
        Ok(buffer)
    }

    /// A buffer for a moment.
    ///
    /// # Errors
    /// [`BackendError::Busy`] where the card has no room now, [`BackendError::Memory`] where it
    /// never has.
    pub(super) fn empty(
        &self,
        bytes: u64,
        usage: wgpu::BufferUsages,
    ) -> Result<wgpu::Buffer, BackendError> {
        let limit = self.device.limits().max_buffer_size;
        allocated(&self.device, "work", bytes.max(16), usage).map_err(|error| match error {
            BackendError::Memory { needed, .. } if needed <= limit => BackendError::Busy,
            error => error,
        })
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

    /// Submits, waits, and gives what lies in `buffer` afterwards, `bytes` from its start.
    ///
    /// # Errors
    /// [`BackendError::Lost`] where the card does not answer.
    pub(super) fn finish(
        &self,
        mut encoder: wgpu::CommandEncoder,
        buffer: &wgpu::Buffer,
        bytes: u64,
    ) -> Result<Vec<u8>, BackendError> {
        let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        let staging = self.empty(bytes, usage)?;
        encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, bytes);
        let submission = self.queue.submit([encoder.finish()]);
        let (mapped, answer) = mpsc::channel();
        staging.map_async(wgpu::MapMode::Read, .., move |result| {
            let _who_waits_may_have_given_up = mapped.send(result);
        });
        let mut waited = Duration::ZERO;
        loop {
            self.watchdog.check()?;
            let wait = wgpu::PollType::Wait {
                submission_index: Some(submission.clone()),
                timeout: Some(LOOK),
            };
            match self.device.poll(wait) {
                Ok(_) => break,
                Err(wgpu::PollError::Timeout) => waited += LOOK,
                Err(error) => return Err(BackendError::Device(error.to_string())),
            }
            if waited > self.longest_silence {
                let seconds = waited.as_secs();
                self.watchdog.lost(format!("no answer for {seconds} s"));
            }
        }
        self.watchdog.check()?;
        // Whoever polls runs the callbacks: another thread may still be at it.
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
        Ok(view.to_vec())
    }
}

/// `groups` workgroups as two dimensions of a dispatch.
pub(super) fn spread(groups: u32) -> [u32; 2] {
    let across = groups.clamp(1, MOST_GROUPS);
    [across, groups.div_ceil(across)]
}

/// Bytes of a row's flow, or pull.
const ROW_VECTOR_BYTES: u64 = 16;

impl Buffers {
    /// Takes what the budget says; half as much, and again, where nobody said how much and the card
    /// has less.
    fn take(
        device: &wgpu::Device,
        adapter: &Adapter,
        options: &GpuOptions,
    ) -> Result<(Budget, Self), BackendError> {
        let asked = options.memory_bytes;
        let mut bytes = asked.unwrap_or_else(|| Budget::usual(adapter.kind, options.lanes));
        // Buffers are bound whole.
        let limits = device.limits();
        let binding = limits
            .max_storage_buffer_binding_size
            .min(limits.max_buffer_size);
        loop {
            let budget = Budget::new(options.lanes, bytes, binding)?;
            match Self::allocate(device, &budget, wgpu::BufferUsages::empty()) {
                Ok(buffers) => return Ok((budget, buffers)),
                Err(BackendError::Memory { .. }) if asked.is_none() => bytes /= 2,
                Err(error) => return Err(error),
            }
        }
    }

    /// Rows of a layer's activations.
    pub(super) fn rows(&self) -> u64 {
        self.flows.size() / ROW_VECTOR_BYTES
    }

    /// Takes what the budget says; every buffer can be used for `more`.
    ///
    /// # Errors
    /// [`BackendError::Memory`] where the card has less.
    pub(super) fn allocate(
        device: &wgpu::Device,
        budget: &Budget,
        more: wgpu::BufferUsages,
    ) -> Result<Self, BackendError> {
        let storage = wgpu::BufferUsages::STORAGE | more;
        let (to, from) = (wgpu::BufferUsages::COPY_DST, wgpu::BufferUsages::COPY_SRC);
        let buffer = |what, bytes, usage| allocated(device, what, bytes, usage);
        let records = |bytes: usize| budget.lanes * bytes as u64;
        let row_vectors = budget.rows * ROW_VECTOR_BYTES;
        Ok(Self {
            store: buffer("store", budget.store_words * 4, storage | to | from)?,
            networks: buffer("networks", budget.network_bytes(), storage | to | from)?,
            activations: buffer("activations", budget.row_bytes(), storage)?,
            deltas: buffer("deltas", budget.row_bytes(), storage)?,
            flows: buffer("flows", row_vectors, storage)?,
            loss_gradients: buffer("pulls", row_vectors, storage)?,
            partials: buffer("gradients", budget.chunk_bytes(), storage)?,
            lanes: buffer("lanes", records(size_of::<layout::Lane>()), storage | to)?,
            steps: buffer(
                "steps",
                records(STEPS * size_of::<layout::Step>()),
                storage | to,
            )?,
            statuses: buffer(
                "statuses",
                records(size_of::<layout::Status>()),
                storage | to | from,
            )?,
            losses: buffer("losses", records(STEPS * size_of::<f32>()), storage | from)?,
        })
    }
}

/// A new buffer.
pub(super) fn allocated(
    device: &wgpu::Device,
    what: &'static str,
    bytes: u64,
    usage: wgpu::BufferUsages,
) -> Result<wgpu::Buffer, BackendError> {
    let limit = device.limits().max_buffer_size;
    let refused = |available: u64| BackendError::Memory {
        what,
        needed: bytes,
        available,
    };
    if bytes > limit {
        return Err(refused(limit));
    }
    let scope = device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(what),
        size: bytes,
        usage,
        mapped_at_creation: false,
    });
    match pollster::block_on(scope.pop()) {
        None => Ok(buffer),
        Some(_) => Err(refused(0)),
    }
}
