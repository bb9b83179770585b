//! Memory use of this process and free memory of this machine, from Linux's `/proc`.

/// The largest resident memory of this process so far, bytes. `None` where `/proc` does not list
/// it.
pub(super) fn peak_resident_bytes() -> Option<u64> {
    kibibytes("/proc/self/status", "VmHWM:")
}

/// Memory available for new allocations, bytes. `None` where `/proc` does not list it.
pub(super) fn available_bytes() -> Option<u64> {
    kibibytes("/proc/meminfo", "MemAvailable:")
}

/// The number of kB after `key` in a file of `/proc`, converted to bytes.
fn kibibytes(table: &str, key: &str) -> Option<u64> {
    let table = std::fs::read_to_string(table).ok()?;
    let line = table.lines().find_map(|line| line.strip_prefix(key))?;
    let number = line.trim().strip_suffix("kB")?.trim();
    number.parse::<u64>().ok().map(|kibibytes| kibibytes * 1024)
}
