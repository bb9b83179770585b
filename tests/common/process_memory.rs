//! Memory of a process, from Linux's `/proc`.

/// The number of kB after `key` in the status of a process, in bytes: `VmRSS:` is its resident memory,
/// and `VmHWM:` the most so far. None where `/proc` does not list it.
pub(crate) fn memory_bytes(process: u32, key: &str) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key))?;
    let number = line.trim().strip_suffix("kB")?.trim();
    number.parse::<u64>().ok().map(|kibibytes| kibibytes * 1024)
}
