//! Where results come from: source, versions, machine.

use serde::{Deserialize, Serialize};
use std::process::Command;
use sysinfo::System;

/// Versions of what simulates and learns.
#[derive(Debug, Clone, Copy)]
pub struct Versions {
    pub mujoco: &'static str,
    pub candle: &'static str,
}

/// What stood behind a command; the same for all of its runs.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Commit of the source tree that the command ran in; `None` outside one.
    pub git_commit: Option<String>,
    pub git_dirty: Option<bool>,
    /// The uncommitted changes, as a patch; stored in a file of its own.
    #[serde(skip)]
    pub uncommitted: Option<String>,
    pub harness_version: String,
    pub mujoco_version: String,
    pub candle_version: String,
    pub host: String,
    pub processor: String,
    pub threads: usize,
    /// As a shell takes it. A run keeps the part of it that makes the run alone.
    pub command: String,
}

impl Provenance {
    /// Looks at the current folder's git repository and at this machine.
    pub fn gather(versions: Versions, threads: usize, command: String) -> Self {
        let commit = git(&["rev-parse", "HEAD"]);
        let status = commit.as_ref().and_then(|_| git(&["status", "--porcelain", "--untracked-files=no"]));
        let dirty = status.map(|status| !status.is_empty());
        let system = System::new_with_specifics(
            sysinfo::RefreshKind::nothing().with_cpu(sysinfo::CpuRefreshKind::nothing()),
        );
        Self {
            uncommitted: if dirty == Some(true) { git(&["diff", "HEAD"]) } else { None },
            git_commit: commit,
            git_dirty: dirty,
            harness_version: env!("CARGO_PKG_VERSION").into(),
            mujoco_version: versions.mujoco.into(),
            candle_version: versions.candle.into(),
            host: System::host_name().unwrap_or_default(),
            processor: system.cpus().first().map(|cpu| cpu.brand().to_owned()).unwrap_or_default(),
            threads,
            command,
        }
    }
}

/// The trimmed output of a git command, if git is there and succeeds.
fn git(arguments: &[&str]) -> Option<String> {
    let output =
        Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// The largest amount of memory that this process has had in use so far, bytes; `None` where the system does
/// not tell.
pub fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kibibytes * 1024)
}
