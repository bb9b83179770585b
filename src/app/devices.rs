//! Device selection: turns the `devices` entries of the configuration into devices to open.
//!
//! It opens no device, except to probe the GPUs that `auto` finds. Independent of queues and
//! protocols.

use std::collections::HashSet;
use std::str::FromStr;
use std::thread;

use anyhow::{anyhow, bail};

use super::shared_threads::{SharedThreads, Threaded};
use crate::config::{Config, MAX_LANES, NodeRole};
use crate::cost::Lanes;
use crate::engine::{DeviceFactory, DeviceOptions, ReopenPolicy, try_opening};
use crate::flow::cpu::CpuBackend;
use crate::flow::field::BackendError;
use crate::flow::gpu;
use crate::flow::gpu::{Adapter, AdapterKind, Gpu, GpuOptions, Selector};
use crate::job::DeviceKind;

/// Default number of lanes of a hardware GPU. Small pairs alone leave a large GPU idle.
const GPU_LANES: usize = 8;

/// Threads of a CPU for each of its lanes, by default. With fewer, a pair takes longer and hardly more
/// pairs are done.
const THREADS_OF_A_LANE: usize = 2;

/// Default number of lanes of a software GPU, which shares the CPU cores with everything else.
const SOFTWARE_LANES: usize = 2;

/// Tests whether the device behind an opener works; the error is the reason why it does not.
type Probe<'a> = &'a dyn Fn(&DeviceFactory) -> Result<(), String>;

/// The devices of one server.
pub(super) struct Pool {
    /// Not opened yet.
    pub(super) devices: Vec<DeviceOptions>,
    /// Whether `auto` found no working GPU and chose the CPU instead.
    pub(super) fell_back: bool,
}

impl Pool {
    /// The devices that the configuration names. For `auto`, each GPU found is opened, self-tested
    /// and closed again.
    ///
    /// # Errors
    /// If an entry is malformed, or names a device that does not exist.
    pub(super) fn of(config: &Config) -> anyhow::Result<Self> {
        Self::probed(config, &try_opening)
    }

    /// The same without opening a GPU: every GPU found counts as working.
    ///
    /// # Errors
    /// If an entry is malformed, or names a device that does not exist.
    pub(super) fn unopened(config: &Config) -> anyhow::Result<Self> {
        Self::probed(config, &|_| Ok(()))
    }

    fn probed(config: &Config, probe: Probe<'_>) -> anyhow::Result<Self> {
        let mut pool = Self {
            devices: Vec::new(),
            fell_back: false,
        };
        // A node that only answers requests computes nothing.
        let computes = config.role != NodeRole::Api;
        for named in config.devices.iter().filter(|_| computes) {
            match named.as_str() {
                "auto" => pool.add_the_best(config, probe)?,
                "cpu" => pool.add_cpu(None, config)?,
                "gpu" => pool.add_every_gpu(config)?,
                other => match other.split_once(':') {
                    Some(("cpu", threads)) => pool.add_cpu(Some(threads), config)?,
                    Some(("gpu", adapter)) if !adapter.is_empty() => {
                        let Ok(selector) = Selector::from_str(adapter);
                        pool.add_gpu(chosen(&selector, config)?, config);
                    }
                    _ => bail!(
                        "devices: {other:?} is none; known are \"auto\", \"cpu\", \"cpu:THREADS\", \
                         \"gpu\" and \"gpu:CARD\", where CARD is a number, a PCI id or a part of \
                         a name that fnsf doctor shows"
                    ),
                },
            }
        }
        Ok(pool)
    }

    /// Number of pairs that run at the same time, by device kind.
    pub(super) fn lanes(&self) -> Lanes {
        let of = |kind| {
            let devices = self.devices.iter().filter(|device| device.kind == kind);
            devices.map(|device| device.lanes).sum()
        };
        Lanes {
            cpu: of(DeviceKind::Cpu),
            gpu: of(DeviceKind::Gpu),
        }
    }

    /// Adds every working GPU, or the CPU if there is none. A GPU that fails its probe is left out:
    /// the configuration does not name it, and a server that waited for it would do no work.
    fn add_the_best(&mut self, config: &Config, probe: Probe<'_>) -> anyhow::Result<()> {
        let mut found = false;
        let mut taken = Taken::default();
        for adapter in welcome(config) {
            if taken.has(&adapter) {
                continue;
            }
            let (name, pci_id) = (adapter.name.clone(), adapter.pci_id.clone());
            let (lanes, open) = adapter_factory(adapter, config);
            match probe(&open) {
                Ok(()) => {
                    found = true;
                    taken.take(pci_id);
                    self.add(DeviceKind::Gpu, lanes, open);
                }
                Err(reason) => tracing::warn!(adapter = name, reason, "a GPU is left out"),
            }
        }
        if found {
            return Ok(());
        }
        self.fell_back = true;
        self.add_cpu(None, config)
    }

    fn add_every_gpu(&mut self, config: &Config) -> anyhow::Result<()> {
        let adapters = welcome(config);
        if adapters.is_empty() {
            // Returns the error that lists the available GPUs.
            chosen(&Selector::Any, config)?;
        }
        let mut taken = Taken::default();
        for adapter in adapters {
            if !taken.has(&adapter) {
                taken.take(adapter.pci_id.clone());
                self.add_gpu(adapter, config);
            }
        }
        Ok(())
    }

    fn add_cpu(&mut self, threads: Option<&str>, config: &Config) -> anyhow::Result<()> {
        let cores = thread::available_parallelism().map_or(1, usize::from);
        let threads = match threads {
            None => Some(cores.min(256)),
            Some(threads) => threads.parse().ok(),
        };
        let threads = threads.filter(|threads| (1..=256).contains(threads));
        let threads = threads.ok_or_else(|| anyhow!("devices: \"cpu:THREADS\" takes 1 to 256"))?;
        let lanes = config.cpu_lanes.unwrap_or(threads / THREADS_OF_A_LANE);
        let lanes = lanes.clamp(1, MAX_LANES).min(threads);
        let open: DeviceFactory = Box::new(move || {
            let cpu = CpuBackend::new(Some(threads))?;
            Ok(Box::new(SharedThreads::new(cpu, lanes)))
        });
        self.add(DeviceKind::Cpu, lanes, open);
        Ok(())
    }

    fn add_gpu(&mut self, adapter: Adapter, config: &Config) {
        let (lanes, open) = adapter_factory(adapter, config);
        self.add(DeviceKind::Gpu, lanes, open);
    }

    fn add(&mut self, kind: DeviceKind, lanes: usize, open: DeviceFactory) {
        let before = self.devices.iter().filter(|device| device.kind == kind);
        self.devices.push(DeviceOptions {
            name: format!("{}{}", kind.name(), before.count()),
            kind,
            lanes,
            open,
            reopening: ReopenPolicy::default(),
        });
    }
}

/// The number of lanes of a GPU, and its opener.
fn adapter_factory(adapter: Adapter, config: &Config) -> (usize, DeviceFactory) {
    let wanted = config.gpu_lanes.unwrap_or(match adapter.kind {
        AdapterKind::Software => SOFTWARE_LANES,
        _ => GPU_LANES,
    });
    let lanes = fitting_lanes(wanted, adapter.max_binding_bytes);
    if lanes < wanted {
        tracing::warn!(
            adapter = adapter.name,
            wanted,
            lanes,
            "no more pairs fit on the GPU"
        );
    }
    let options = GpuOptions {
        lanes,
        memory_bytes: config.gpu_memory_mib.map(|mib| mib << 20),
        ..GpuOptions::default()
    };
    let open: DeviceFactory = Box::new(move || {
        let gpu = Gpu::open(&found_again(&adapter)?, &options)?;
        Ok(Box::new(SharedThreads::new(gpu, options.lanes)))
    });
    (lanes, open)
}

/// Limits the lanes to the number of networks that fit into one GPU binding. A pair without a
/// network would be given back to the queue again and again.
fn fitting_lanes(wanted: usize, binding_bytes: u64) -> usize {
    let networks = (binding_bytes / gpu::LANE_NETWORK_BYTES).max(1);
    usize::try_from(networks).map_or(wanted, |networks| wanted.min(networks))
}

/// The GPU that a selector names.
fn chosen(selector: &Selector, config: &Config) -> anyhow::Result<Adapter> {
    let found = gpu::select(selector, config.allow_software_gpu);
    found.map_err(|error| anyhow!("devices: {error}; fnsf doctor says how to mend it"))
}

/// Every GPU that may be used without being named: software GPUs only if the configuration allows
/// them.
fn welcome(config: &Config) -> Vec<Adapter> {
    let mut adapters = gpu::adapters();
    adapters.retain(|adapter| config.allow_software_gpu || adapter.kind != AdapterKind::Software);
    adapters
}

/// PCI ids of the GPUs taken so far. Two drivers may expose the same GPU, and opening it twice
/// would use its memory twice.
#[derive(Default)]
struct Taken(HashSet<String>);

impl Taken {
    /// Whether this GPU is already taken through another driver.
    fn has(&self, adapter: &Adapter) -> bool {
        let has = self.0.contains(&adapter.pci_id);
        if has {
            tracing::info!(
                adapter = adapter.name,
                pci_id = adapter.pci_id,
                driver = adapter.driver,
                "left out: another driver answers for the same card"
            );
        }
        has
    }

    fn take(&mut self, pci_id: String) {
        // Without a PCI id every adapter counts as a separate GPU.
        if !pci_id.is_empty() {
            self.0.insert(pci_id);
        }
    }
}

/// Enumerates the adapters again and returns the same GPU. The adapter found before a loss may be
/// stale.
fn found_again(adapter: &Adapter) -> Result<Adapter, BackendError> {
    let mut alike = gpu::adapters();
    alike.retain(|other| other.name == adapter.name && other.pci_id == adapter.pci_id);
    // Without a PCI id, identical GPUs are told apart by their index.
    let twin = alike.iter().position(|other| other.index == adapter.index);
    if alike.is_empty() {
        return Err(BackendError::NoDevice(format!(
            "{} does not answer any more",
            adapter.name
        )));
    }
    Ok(alike.swap_remove(twin.unwrap_or(0)))
}

impl Threaded for Gpu {
    fn threads(&self) -> usize {
        self.host_threads()
    }

    fn beside(&self, threads: usize) -> Result<Self, BackendError> {
        Gpu::beside(self, threads)
    }

    fn is_lost(&self) -> bool {
        Gpu::is_lost(self)
    }

    fn destroy(&self) {
        Gpu::destroy(self);
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;
    use crate::engine::Opened;
    use crate::flow::field::Backend;
    use crate::gpu_in_tests;

    fn pool(devices: &[&str]) -> anyhow::Result<Pool> {
        Pool::of(&Config {
            devices: devices.iter().map(|name| (*name).to_owned()).collect(),
            ..Config::default()
        })
    }

    #[test]
    fn processors_are_numbered_and_have_a_lane_for_two_threads() {
        let pool = pool(&["cpu:3", "cpu:8"]).expect("devices");
        let names: Vec<_> = pool.devices.iter().map(|device| &device.name).collect();
        assert_eq!(names, ["cpu0", "cpu1"]);
        assert_eq!(pool.lanes(), Lanes { cpu: 5, gpu: 0 });
        assert!(!pool.fell_back);
    }

    #[test]
    fn what_is_no_device_is_refused_with_what_is() {
        for devices in [["tpu"], ["cpu:0"], ["cpu:many"], ["gpu:"], ["auto:1"]] {
            let refused = pool(&devices).err().expect("a refusal").to_string();
            assert!(refused.starts_with("devices: "), "{refused}");
        }
        let refused = pool(&["gpu:no card has this name"]).err();
        let refused = refused.expect("a refusal").to_string();
        assert!(refused.contains("no such device"), "{refused}");
    }

    #[test]
    fn auto_always_finds_something_and_says_when_it_is_no_card() {
        let pool = pool(&["auto"]).expect("a device");
        let first = pool.devices.first().expect("a device");
        assert_eq!(pool.fell_back, first.kind == DeviceKind::Cpu);
    }

    #[test]
    fn auto_leaves_out_cards_that_do_not_work_and_falls_back_to_the_cpu() {
        let config = Config {
            devices: vec!["auto".to_owned()],
            allow_software_gpu: true,
            ..Config::default()
        };
        let probed = Cell::new(0);
        let broken = |_: &DeviceFactory| {
            probed.set(probed.get() + 1);
            Err("it computes nonsense".to_owned())
        };
        let pool = Pool::probed(&config, &broken).expect("a CPU");
        assert_eq!(probed.get(), welcome(&config).len());
        let names: Vec<_> = pool.devices.iter().map(|device| &device.name).collect();
        assert_eq!(names, ["cpu0"]);
        assert!(pool.fell_back);
    }

    #[test]
    fn no_more_pairs_share_a_card_than_it_has_networks_for() {
        assert_eq!(fitting_lanes(64, 128 << 20), 57);
        assert_eq!(fitting_lanes(8, 128 << 20), 8);
        assert_eq!(fitting_lanes(64, u64::from(u32::MAX)), 64);
        assert_eq!(fitting_lanes(8, 0), 1);
    }

    #[test]
    fn a_card_that_two_drivers_answer_for_is_taken_once() {
        let adapters = gpu::adapters();
        if !gpu_in_tests::is_there(adapters.len()) {
            return;
        }
        let Some(adapter) = adapters.into_iter().next() else {
            return;
        };
        let at = |pci_id: &str| {
            let mut adapter = adapter.clone();
            pci_id.clone_into(&mut adapter.pci_id);
            adapter
        };
        let adapters = ["0000:01:00.0", "0000:02:00.0", "0000:01:00.0", "", ""].map(at);
        let mut taken = Taken::default();
        let mut kept = Vec::new();
        for adapter in adapters {
            if !taken.has(&adapter) {
                taken.take(adapter.pci_id.clone());
                kept.push(adapter.pci_id);
            }
        }
        assert_eq!(kept, ["0000:01:00.0", "0000:02:00.0", "", ""]);
    }

    #[test]
    fn the_lanes_of_a_card_share_its_memory_and_its_loss() {
        let adapters = gpu::adapters();
        if !gpu_in_tests::is_there(adapters.len()) {
            return;
        }
        let Some(adapter) = adapters.into_iter().next() else {
            return;
        };
        let options = GpuOptions {
            lanes: 2,
            host_threads: Some(4),
            ..GpuOptions::default()
        };
        let gpu = Gpu::open(&adapter, &options).expect("it opens");
        let shared = SharedThreads::new(gpu.clone(), 2);
        let lanes = [shared.lane(), shared.lane()];
        let threads = lanes.each_ref().map(|lane| lane.host().name().to_owned());
        assert_eq!(threads, ["cpu (4 threads)", "cpu (2 threads)"]);
        let half = gpu.beside(2).expect("threads");
        assert_eq!(half.memory_bytes(), gpu.memory_bytes());
        assert_eq!(half.searches_clusters(), gpu.searches_clusters());
        shared.destroy();
        assert!(shared.is_lost() && half.is_lost() && gpu.is_lost());
    }

    #[test]
    fn a_card_that_is_opened_with_the_most_lanes_has_a_network_for_each() {
        let adapters = gpu::adapters();
        if !gpu_in_tests::is_there(adapters.len()) {
            return;
        }
        let Some(adapter) = adapters.into_iter().next() else {
            return;
        };
        let lanes = fitting_lanes(64, adapter.max_binding_bytes);
        let options = GpuOptions {
            lanes,
            memory_bytes: None,
            ..GpuOptions::default()
        };
        let gpu = Gpu::open(&adapter, &options).expect("it opens");
        assert_eq!(gpu.lanes(), lanes);
    }
}
