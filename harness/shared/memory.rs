//! The memory that is available to this process.

use sysinfo::{Pid, ProcessRefreshKind, ProcessesToUpdate, System};

/// Returns the memory that this process may use in total, in bytes: the memory that it already has, and the memory that
/// the machine has free. The second part is smaller if the control group (a container, a Slurm job) or a limit of the
/// address space (`ulimit -v`) leaves less. Caches, which the system releases on demand, count as free.
///
/// The memory that the process already has counts, because the allocator reuses it and returns none to the system.
pub fn within_reach() -> u64 {
    let mut system = System::new();
    system.refresh_memory();
    let own = Pid::from_u32(std::process::id());
    let what = ProcessRefreshKind::nothing().with_memory();
    system.refresh_processes_specifics(ProcessesToUpdate::Some(&[own]), false, what);
    let free = system.available_memory();
    let Some(process) = system.process(own) else { return free };
    let in_group = process.cgroup_limits().map(|limits| limits.total_memory.saturating_sub(limits.rss));
    let addresses = address_space().saturating_sub(process.virtual_memory());
    process.memory().saturating_add(free.min(in_group.unwrap_or(u64::MAX)).min(addresses))
}

/// Returns the limit of this process's address space, in bytes.
fn address_space() -> u64 {
    let mut limit = libc::rlimit { rlim_cur: libc::RLIM_INFINITY, rlim_max: libc::RLIM_INFINITY };
    // SAFETY: `getrlimit` only writes to `limit`. If it fails, `limit` stays infinite.
    unsafe { libc::getrlimit(libc::RLIMIT_AS, &mut limit) };
    limit.rlim_cur
}
