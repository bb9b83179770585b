//! The cards that are there, and the choice of one. Opens nothing.

use core::fmt;
use core::str::FromStr;

use crate::flow::field::BackendError;

/// What kind of device an adapter is, fastest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AdapterKind {
    /// A card with its own memory.
    Discrete,
    /// A part of the processor's package.
    Integrated,
    /// A share of a card that a hypervisor gives.
    Virtual,
    /// The driver does not say.
    Other,
    /// No card: a driver that computes on the CPU, many times slower than the CPU backend.
    Software,
}

impl AdapterKind {
    /// The name that reports use.
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

/// A card that can be opened.
#[derive(Clone, Debug)]
pub struct Adapter {
    /// Its place among all, fastest kind first.
    pub index: usize,
    /// Its name, as the driver gives it.
    pub name: String,
    /// Where it is plugged in, such as `0000:01:00.0`; empty where the driver does not say.
    pub pci_id: String,
    /// The driver and its version.
    pub driver: String,
    /// The programming interface: `vulkan`, `metal` or `dx12`.
    pub interface: &'static str,
    /// What kind of device it is.
    pub kind: AdapterKind,
    /// The largest buffer that a kernel can see, bytes.
    pub max_binding_bytes: u64,
    /// Workgroup memory, bytes.
    pub workgroup_bytes: u32,
    /// Matrix units: the tiles that they multiply, such as `16x16x16 f16 -> f32`.
    pub matrix_tiles: Vec<String>,
    pub(super) handle: wgpu::Adapter,
}

/// Which card is meant.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Selector {
    /// The first that is no software.
    #[default]
    Any,
    /// The one with this [`Adapter::index`]; where there is none, the first whose name has the
    /// number in it.
    Index(usize),
    /// The one at this [`Adapter::pci_id`], or the first whose name has this in it, upper and
    /// lower case alike.
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

/// All cards, fastest kind first.
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

/// The card that `selector` means. A software device is given where it is selected by its place or
/// its name, or where `software` says that it is welcome.
///
/// # Errors
/// [`BackendError::NoDevice`] where there is none such, with what there is.
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
        // A number may be a part of a name, such as 4090.
        Selector::Index(index) if *index >= candidates.len() => candidates
            .find(|adapter| is_named(adapter, &index.to_string()))
            .ok_or_else(|| no_such("")),
        Selector::Index(index) => candidates.nth(*index).ok_or_else(|| no_such("")),
        Selector::Named(name) => candidates
            .find(|adapter| is_named(adapter, name))
            .ok_or_else(|| no_such("")),
    }
}

/// Whether the card is at this PCI id or has this in its name.
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
    // Near a full card an allocation is refused, rather than every later one slow.
    description.memory_budget_thresholds.for_resource_creation = Some(95);
    wgpu::Instance::new(description)
}

/// What the adapter says of itself; nothing where it cannot compute.
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
