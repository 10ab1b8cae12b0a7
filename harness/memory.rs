//! How much memory there is to use.

use sysinfo::{Pid, ProcessRefreshKind, ProcessesToUpdate, System};

/// Memory that this process may still take, bytes: what the machine has free, or what is left under the limit of its
/// control group (a container, a Slurm job) if that is less. Caches, which the system gives up on demand, count as free.
pub fn available_bytes() -> u64 {
    let mut system = System::new();
    system.refresh_memory();
    let own = Pid::from_u32(std::process::id());
    system.refresh_processes_specifics(ProcessesToUpdate::Some(&[own]), false, ProcessRefreshKind::nothing());
    let limits = system.process(own).and_then(|process| process.cgroup_limits());
    let left = limits.map_or(u64::MAX, |limits| limits.total_memory.saturating_sub(limits.rss));
    system.available_memory().min(left)
}
