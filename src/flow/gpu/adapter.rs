//! Enumeration of the GPUs (adapters) of the machine, and selection of one.

use core::fmt;
use core::str::FromStr;

use crate::flow::field::BackendError;

/// The kind of an adapter. The order is that of preference, the usually fastest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AdapterKind {
    /// A GPU with its own memory.
    Discrete,
    /// A GPU that is part of the processor's package and shares its memory.
    Integrated,
    /// A share of a GPU, provided by a hypervisor.
    Virtual,
    /// The driver does not report the kind.
    Other,
    /// No GPU: a driver that computes on the CPU, many times slower than the CPU backend.
    Software,
}

impl AdapterKind {
    /// The name used in reports: `discrete`, `integrated`, `virtual`, `other` or `software`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Discrete => "discrete",
            Self::Integrated => "integrated",
            Self::Virtual => "virtual",
            Self::Other => "other",
            Self::Software => "software",
        }
    }
}

/// A GPU, or a software device, that a driver offers. [`super::Gpu::open`] opens it.
#[derive(Clone, Debug)]
pub struct Adapter {
    /// Its index in the list of [`adapters`], from 0.
    pub index: usize,
    /// Its name, as the driver reports it.
    pub name: String,
    /// PCI address, such as `0000:01:00.0`; empty if the driver does not report it.
    pub pci_id: String,
    /// The driver and its version.
    pub driver: String,
    /// The graphics API: `vulkan`, `metal` or `dx12`.
    pub interface: &'static str,
    /// The kind of the GPU.
    pub kind: AdapterKind,
    /// The largest buffer that a kernel can bind, bytes.
    pub max_binding_bytes: u64,
    /// Workgroup memory per workgroup, bytes.
    pub workgroup_bytes: u32,
    /// The tile sizes and types that the matrix units multiply, such as `16x16x16 f16 -> f32`: the
    /// sizes m x n x k, the type of the factors, and the type of the sums. Empty if there are none.
    pub matrix_tiles: Vec<String>,
    pub(super) handle: wgpu::Adapter,
}

/// Names the GPU that [`select`] returns. Parsed from text, a number is [`Self::Index`], an empty
/// text [`Self::Any`], and any other text [`Self::Named`]. Parsing never fails.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Selector {
    /// The first of [`adapters`] that is not a software device. If the argument `software` of
    /// [`select`] is true, the first of any kind.
    #[default]
    Any,
    /// The adapter with this [`Adapter::index`]. If there is none, the first whose name contains
    /// the number, such as 4090. Both may be a software device.
    Index(usize),
    /// The first adapter with this [`Adapter::pci_id`] or with this text in its name, ignoring
    /// case. It may be a software device.
    Named(String),
}

impl FromStr for Selector {
    type Err = core::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(match text.parse() {
            Ok(index) => Self::Index(index),
            Err(_) if text.is_empty() => Self::Any,
            Err(_) => Self::Named(text.to_owned()),
        })
    }
}

impl fmt::Display for Selector {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Any => formatter.write_str("gpu"),
            Self::Index(index) => write!(formatter, "gpu:{index}"),
            Self::Named(name) => write!(formatter, "gpu:{name}"),
        }
    }
}

/// All GPUs and software devices of the machine with a driver for Vulkan, Metal or DX12, in the
/// order of [`AdapterKind`]. Empty if there are none.
pub fn adapters() -> Vec<Adapter> {
    let mut found: Vec<_> =
        pollster::block_on(instance().enumerate_adapters(wgpu::Backends::all()))
            .into_iter()
            .filter_map(described)
            .collect();
    found.sort_by_key(|adapter| adapter.kind);
    for (index, adapter) in found.iter_mut().enumerate() {
        adapter.index = index;
    }
    found
}

/// The GPU that `selector` selects among [`adapters`]. [`Selector::Any`] selects a software device
/// only if `software` is true. The other selectors ignore `software`.
///
/// # Errors
/// [`BackendError::NoDevice`] if no adapter matches; its text lists the adapters.
pub fn select(selector: &Selector, software: bool) -> Result<Adapter, BackendError> {
    let all = adapters();
    let there = match all.is_empty() {
        true => "the system has none that a driver answers for".to_owned(),
        false => {
            let names: Vec<_> = all.iter().map(described_shortly).collect();
            format!("there is {}", names.join(", "))
        }
    };
    let wanted = selector.to_string();
    let no_such = |hint: &str| BackendError::NoDevice(format!("{wanted}: {there}{hint}"));
    let mut candidates = all.into_iter();
    match selector {
        Selector::Any => {
            let only_software = candidates.len() > 0;
            let hint = if only_software {
                "; software is many times slower than the CPU backend and taken only by name"
            } else {
                ""
            };
            candidates
                .find(|adapter| software || adapter.kind != AdapterKind::Software)
                .ok_or_else(|| no_such(hint))
        }
        // A number may be part of a name, such as 4090.
        Selector::Index(index) if *index >= candidates.len() => candidates
            .find(|adapter| is_named(adapter, &index.to_string()))
            .ok_or_else(|| no_such("")),
        Selector::Index(index) => candidates.nth(*index).ok_or_else(|| no_such("")),
        Selector::Named(name) => candidates
            .find(|adapter| is_named(adapter, name))
            .ok_or_else(|| no_such("")),
    }
}

/// Whether the adapter has this PCI address, or this text in its name.
fn is_named(adapter: &Adapter, name: &str) -> bool {
    let name = name.to_lowercase();
    adapter.pci_id.to_lowercase() == name || adapter.name.to_lowercase().contains(&name)
}

fn described_shortly(adapter: &Adapter) -> String {
    format!(
        "gpu:{} {} ({})",
        adapter.index,
        adapter.name,
        adapter.kind.name()
    )
}

fn instance() -> wgpu::Instance {
    let mut description = wgpu::InstanceDescriptor::new_without_display_handle();
    // Above 95 % of the GPU's memory an allocation is refused. Otherwise every later one would be
    // slow.
    description.memory_budget_thresholds.for_resource_creation = Some(95);
    wgpu::Instance::new(description)
}

/// The adapter's description; none for an API that is not supported.
fn described(handle: wgpu::Adapter) -> Option<Adapter> {
    let info = handle.get_info();
    let interface = match info.backend {
        wgpu::Backend::Vulkan => "vulkan",
        wgpu::Backend::Metal => "metal",
        wgpu::Backend::Dx12 => "dx12",
        _ => return None,
    };
    let kind = match info.device_type {
        wgpu::DeviceType::DiscreteGpu => AdapterKind::Discrete,
        wgpu::DeviceType::IntegratedGpu => AdapterKind::Integrated,
        wgpu::DeviceType::VirtualGpu => AdapterKind::Virtual,
        wgpu::DeviceType::Other => AdapterKind::Other,
        wgpu::DeviceType::Cpu => AdapterKind::Software,
    };
    let limits = handle.limits();
    let tile = |tile: &wgpu::CooperativeMatrixProperties| {
        format!(
            "{}x{}x{} {:?} -> {:?}",
            tile.m_size, tile.n_size, tile.k_size, tile.ab_type, tile.cr_type
        )
        .to_lowercase()
    };
    Some(Adapter {
        index: 0,
        name: info.name,
        pci_id: info.device_pci_bus_id,
        driver: format!("{} {}", info.driver, info.driver_info),
        interface,
        kind,
        max_binding_bytes: limits.max_storage_buffer_binding_size,
        workgroup_bytes: limits.max_compute_workgroup_storage_size,
        matrix_tiles: handle
            .cooperative_matrix_properties()
            .iter()
            .map(tile)
            .collect(),
        handle,
    })
}
