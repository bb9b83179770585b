//! The devices: opened once for each process, kind and number of threads.
//!
//! A forked child has none of its parent's threads, so it opens devices of its own. A GPU cannot be
//! used in a child of a process that used one.

use std::collections::HashMap;
use std::str::FromStr;
use std::sync::{Arc, Mutex, PoisonError};

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::field::{Backend, BackendError};
use fnsf::flow::gpu::{self, Gpu, GpuOptions, Selector};
use pyo3::exceptions::PyRuntimeWarning;
use pyo3::prelude::*;

use crate::errors::{DeviceError, device, input};

/// Environment variable for tests. Where it is 1, software drivers, which compute on the CPU, are
/// accepted as GPUs.
const SOFTWARE: &str = "FNSF_ALLOW_SOFTWARE_GPU";

/// An open device.
pub(crate) type Opened = Arc<dyn Backend>;

/// A device by name and its number of threads.
type Key = (String, Option<usize>);

/// The open devices of a process.
struct Devices {
    process: u32,
    opened: Option<HashMap<Key, Opened>>,
    /// Whether this process or a parent has opened a GPU, and which process.
    gpu_opened_by: Option<u32>,
}

/// Taken only under the interpreter's lock and never for long, so that no other thread holds it
/// during a fork.
static DEVICES: Mutex<Devices> = Mutex::new(Devices {
    process: 0,
    opened: None,
    gpu_opened_by: None,
});

fn with_devices<T>(work: impl FnOnce(&mut Devices) -> T) -> T {
    let mut devices = DEVICES.lock().unwrap_or_else(PoisonError::into_inner);
    let process = std::process::id();
    if devices.process != process {
        devices.process = process;
        // The parent's threads do not exist here: to stop them would wait for ever.
        std::mem::forget(devices.opened.take());
    }
    work(&mut devices)
}

/// Opens a device: `auto`, `cpu`, `gpu` or `gpu:CARD`. `auto` is a GPU where `has_kernels`, and the
/// CPU where there is none, with a warning.
///
/// # Errors
/// `InputError` for another name, and `DeviceError` where the device cannot be opened.
pub(crate) fn open(
    py: Python<'_>,
    name: &str,
    threads: Option<usize>,
    has_kernels: bool,
) -> PyResult<Opened> {
    let (kind, card) = match name.split_once(':') {
        Some((kind, card)) if !card.is_empty() => (kind, Some(card)),
        _ => (name, None),
    };
    match (kind, card) {
        ("cpu", None) => cpu(threads),
        ("gpu", card) => open_gpu(py, card.unwrap_or_default(), threads),
        ("auto", None) if !has_kernels => cpu(threads),
        ("auto", None) => match open_gpu(py, "", threads) {
            Ok(opened) => Ok(opened),
            Err(error) => {
                warn_of_cpu(py, &error.value(py).to_string())?;
                cpu(threads)
            }
        },
        _ => Err(input(format!(
            "device {name:?} is none of auto, cpu, gpu and gpu:CARD"
        ))),
    }
}

/// Warns that the CPU does the work of a GPU.
pub(crate) fn warn_of_cpu(py: Python<'_>, reason: &str) -> PyResult<()> {
    let text = std::ffi::CString::new(format!("the CPU does the work: {reason}"))?;
    PyErr::warn(py, &py.get_type::<PyRuntimeWarning>(), &text, 2)
}

/// The CPU with `threads` threads, or one for each core.
pub(crate) fn cpu(threads: Option<usize>) -> PyResult<Opened> {
    let cores = || std::thread::available_parallelism().map_or(1, usize::from);
    let threads = threads.unwrap_or_else(cores);
    if !(1..=256).contains(&threads) {
        return Err(input(format!(
            "threads is {threads}: 1 to 256 are possible"
        )));
    }
    with_devices(|devices| {
        let opened = devices.opened.get_or_insert_default();
        let key = ("cpu".to_owned(), Some(threads));
        if let Some(known) = opened.get(&key) {
            return Ok(Arc::clone(known));
        }
        let backend: Opened =
            Arc::new(CpuBackend::new(Some(threads)).map_err(|error| device(&error))?);
        opened.insert(key, Arc::clone(&backend));
        Ok(backend)
    })
}

fn open_gpu(py: Python<'_>, card: &str, threads: Option<usize>) -> PyResult<Opened> {
    let key: Key = (format!("gpu:{card}"), threads);
    let known = with_devices(|devices| {
        if let Some(process) = devices.gpu_opened_by
            && process != devices.process
        {
            return Err(DeviceError::new_err(format!(
                "process {process} used a GPU before it forked this one, and drivers do not survive that: \
                 start workers by spawn, or use device=\"cpu\""
            )));
        }
        Ok(devices.opened.get_or_insert_default().get(&key).cloned())
    })?;
    if let Some(known) = known {
        return Ok(known);
    }
    let Ok(selector) = Selector::from_str(card);
    let software = std::env::var_os(SOFTWARE).is_some_and(|value| value == "1");
    let opened = py.detach(|| -> Result<Opened, BackendError> {
        let adapter = gpu::select(&selector, software)?;
        Ok(Arc::new(Gpu::open(&adapter, &GpuOptions::default())?))
    });
    let opened = opened.map_err(|error| device(&error))?;
    with_devices(|devices| {
        devices.gpu_opened_by = Some(devices.process);
        let devices = devices.opened.get_or_insert_default();
        devices.insert(key, Arc::clone(&opened));
    });
    Ok(opened)
}

/// The name of a device as reports show it. It is opened if it is not open yet.
#[pyfunction]
#[pyo3(signature = (name, threads=None))]
pub(crate) fn device_name(py: Python<'_>, name: &str, threads: Option<usize>) -> PyResult<String> {
    Ok(open(py, name, threads, true)?.name())
}
