//! Memory of this process, where the system says it (Linux).

/// Largest resident memory so far, or since [`reset_peak_mib`], MiB.
pub fn peak_mib() -> Option<u64> {
    let status = fs_err::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib / 1024)
}

/// Makes the largest resident memory the present one, and says it.
pub fn reset_peak_mib() -> Option<u64> {
    fs_err::write("/proc/self/clear_refs", "5").ok()?;
    peak_mib()
}
