//! How much memory there is to use.

use sysinfo::{Pid, ProcessRefreshKind, ProcessesToUpdate, System};

/// Memory that this process may have in all, bytes: what it has, and what the machine has free. Less if its control group
/// (a container, a Slurm job) leaves it less, or its address space has a limit (`ulimit -v`). Caches, which the system
/// gives up on demand, count as free.
///
/// What it has counts because it can be used again: the allocator gives nothing back.
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

/// The limit of this process's address space, bytes.
fn address_space() -> u64 {
    let mut limit = libc::rlimit { rlim_cur: libc::RLIM_INFINITY, rlim_max: libc::RLIM_INFINITY };
    // SAFETY: fills in a structure of ours. Where it fails, no limit is known.
    unsafe { libc::getrlimit(libc::RLIMIT_AS, &mut limit) };
    limit.rlim_cur
}
