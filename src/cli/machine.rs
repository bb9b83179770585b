//! What this machine is and what the process takes of it.

/// The most memory that the process has held so far, bytes; none where the system does not say.
pub(super) fn peak_resident_bytes() -> Option<u64> {
    kibibytes("/proc/self/status", "VmHWM:")
}

/// Memory that could be taken now, bytes; none where the system does not say.
pub(super) fn available_bytes() -> Option<u64> {
    kibibytes("/proc/meminfo", "MemAvailable:")
}

/// The number of kB after `key` in one of the kernel's tables, as bytes.
fn kibibytes(table: &str, key: &str) -> Option<u64> {
    let table = std::fs::read_to_string(table).ok()?;
    let line = table.lines().find_map(|line| line.strip_prefix(key))?;
    let number = line.trim().strip_suffix("kB")?.trim();
    number.parse::<u64>().ok().map(|kibibytes| kibibytes * 1024)
}
