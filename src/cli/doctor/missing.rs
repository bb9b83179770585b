//! Detection of missing GPU prerequisites: the Vulkan loader, a driver's manifest, a container's
//! permissions.
//!
//! [`Environment::here`] inspects files and environment variables. [`Environment::advice`] turns
//! the findings into advice, without any access to the system.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};

/// Environment variables that replace the loader's list of manifests. The second is an older name.
const DRIVER_FILES: [&str; 2] = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"];

/// Folders that the loader searches for drivers' manifests.
const MANIFESTS: [&str; 4] = [
    "/usr/share/vulkan/icd.d",
    "/usr/local/share/vulkan/icd.d",
    "/etc/vulkan/icd.d",
    "/usr/local/etc/vulkan/icd.d",
];

/// The Vulkan loader's shared library.
const LOADER: &str = "libvulkan.so.1";

/// The GPU prerequisites found on this machine.
#[derive(Clone, Debug, Default)]
pub(super) struct Environment {
    /// GPUs that drivers offer, software drivers not counted.
    hardware: usize,
    /// All adapters that drivers offer, software drivers included.
    answering: usize,
    loader: bool,
    manifests: usize,
    /// The first of `DRIVER_FILES` that is set, and whether any file that it names exists.
    restricted: Option<(&'static str, bool)>,
    /// Device files of GPUs, such as `/dev/dri/renderD128`.
    devices: Vec<String>,
    nvidia: bool,
    container: bool,
    /// The value of `NVIDIA_DRIVER_CAPABILITIES`, where it is set.
    capabilities: Option<String>,
}

impl Environment {
    /// Inspects this machine. `hardware` and `answering` are the numbers of GPUs that drivers
    /// offer, without and with software drivers.
    pub(super) fn here(hardware: usize, answering: usize) -> Self {
        let restricted = DRIVER_FILES.into_iter().find_map(|name| {
            let files = env::var_os(name)?;
            let there = env::split_paths(&files).any(|file| file.exists());
            Some((name, there))
        });
        let render = names("/dev/dri", |name| name.starts_with("renderD"));
        let nvidia = names("/dev", |name| {
            let number = name.strip_prefix("nvidia");
            number.is_some_and(|number| number.parse::<u32>().is_ok())
        });
        let manifests = MANIFESTS.into_iter().map(|folder| {
            let json = |name: &str| name.ends_with(".json");
            names(folder, json).len()
        });
        Self {
            hardware,
            answering,
            loader: loader_is_there(),
            manifests: manifests.sum(),
            restricted,
            nvidia: !nvidia.is_empty(),
            devices: [nvidia, render].concat(),
            container: ["/.dockerenv", "/run/.containerenv"]
                .into_iter()
                .any(|sign| Path::new(sign).exists()),
            capabilities: env::var("NVIDIA_DRIVER_CAPABILITIES").ok(),
        }
    }

    /// Advice on missing prerequisites, in the order in which to fix them; empty where a GPU was
    /// found.
    pub(super) fn advice(&self) -> Vec<String> {
        if self.hardware > 0 {
            return Vec::new();
        }
        let mut advice = Vec::new();
        if self.answering > 0 {
            advice.push("only software answers: many times slower than the CPU itself".to_owned());
        } else if !self.loader {
            advice.push(format!(
                "the Vulkan loader is missing ({LOADER}): apt-get install libvulkan1"
            ));
        }
        match self.restricted {
            Some((name, false)) => advice.push(format!(
                "{name} names no file that is there: unset it, or name a driver's manifest"
            )),
            Some((name, true)) => advice.push(format!(
                "{name} restricts the drivers: unset it to see every card"
            )),
            None if self.manifests == 0 => advice.push(format!(
                "no driver has a manifest in {}: install the card's driver with its Vulkan part \
                 (NVIDIA's driver, or mesa-vulkan-drivers for AMD and Intel)",
                MANIFESTS.join(", ")
            )),
            None => {}
        }
        if self.nvidia {
            let may = self.capabilities.as_deref();
            let may_draw = may.is_none_or(|may| may.contains("graphics") || may.contains("all"));
            if self.container && !(may_draw && may.is_some()) {
                advice.push(
                    "start the container with NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics: \
                     without graphics no Vulkan driver is mounted, while nvidia-smi works"
                        .to_owned(),
                );
            } else {
                advice.push(
                    "an NVIDIA card is there and its Vulkan driver does not answer: install the \
                     driver's graphics part (libnvidia-gl), of nvidia-smi's version"
                        .to_owned(),
                );
            }
        } else if !self.devices.is_empty() {
            advice.push(format!(
                "a card is there ({}) and no driver answers for it: install mesa-vulkan-drivers, \
                 and see that this user may open it (group render)",
                self.devices.join(", ")
            ));
        } else if self.container {
            advice.push(
                "no card is let into this container: docker run --gpus all, or --device /dev/dri"
                    .to_owned(),
            );
        } else {
            advice.push("no card is plugged in, as far as the system says".to_owned());
        }
        advice
    }
}

/// Paths of a folder's entries whose names are `wanted`, sorted.
fn names(folder: &str, wanted: impl Fn(&str) -> bool) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut found: Vec<String> = entries
        .filter(|entry| entry.file_name().to_str().is_some_and(&wanted))
        .map(|entry| entry.path().display().to_string())
        .collect();
    found.sort();
    found
}

/// Whether the dynamic linker would find the loader: in its cache, in `LD_LIBRARY_PATH`, or in a
/// default folder.
fn loader_is_there() -> bool {
    let cached = fs::read("/etc/ld.so.cache").unwrap_or_default();
    let needle = LOADER.as_bytes();
    if cached.windows(needle.len()).any(|window| window == needle) {
        return true;
    }
    let named = env::var_os("LD_LIBRARY_PATH").unwrap_or_default();
    let usual = ["/lib", "/usr/lib", "/lib64", "/usr/lib64", "/usr/local/lib"];
    let mut folders = env::split_paths(&named).chain(usual.map(PathBuf::from));
    folders.any(|folder| folder.join(LOADER).exists())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A machine with a loader and a driver's manifest, but without a GPU.
    fn machine() -> Environment {
        Environment {
            loader: true,
            manifests: 1,
            ..Environment::default()
        }
    }

    fn advice(found: &Environment) -> String {
        found.advice().join("\n")
    }

    #[test]
    fn a_machine_whose_card_answers_needs_no_advice() {
        let found = Environment {
            hardware: 1,
            answering: 1,
            ..Environment::default()
        };
        assert_eq!(found.advice(), [""; 0]);
    }

    #[test]
    fn what_is_missing_is_named_with_what_mends_it() {
        let card = || vec!["/dev/dri/renderD128".to_owned()];
        let nvidia = |capabilities: Option<&str>, container| Environment {
            nvidia: true,
            container,
            devices: vec!["/dev/nvidia0".to_owned()],
            capabilities: capabilities.map(str::to_owned),
            ..machine()
        };
        for (found, said) in [
            (
                Environment {
                    loader: false,
                    ..machine()
                },
                "apt-get install libvulkan1",
            ),
            (
                Environment {
                    manifests: 0,
                    ..machine()
                },
                "mesa-vulkan-drivers",
            ),
            (
                Environment {
                    restricted: Some(("VK_DRIVER_FILES", false)),
                    ..machine()
                },
                "VK_DRIVER_FILES names no file",
            ),
            (
                Environment {
                    devices: card(),
                    ..machine()
                },
                "group render",
            ),
            (
                Environment {
                    container: true,
                    ..machine()
                },
                "--gpus all",
            ),
            (
                Environment {
                    answering: 1,
                    ..machine()
                },
                "only software answers",
            ),
            (machine(), "no card is plugged in"),
            (
                nvidia(Some("compute,utility"), true),
                "NVIDIA_DRIVER_CAPABILITIES",
            ),
            (nvidia(None, true), "NVIDIA_DRIVER_CAPABILITIES"),
            (
                nvidia(Some("compute,utility,graphics"), true),
                "libnvidia-gl",
            ),
            (nvidia(Some("all"), true), "libnvidia-gl"),
            (nvidia(None, false), "libnvidia-gl"),
        ] {
            let advice = advice(&found);
            assert!(advice.contains(said), "{said}: {advice}");
        }
    }

    #[test]
    fn a_loader_that_is_there_is_not_asked_for() {
        assert!(!advice(&machine()).contains("libvulkan1"));
    }
}
