//! Provenance of results: source tree, versions, machine, command.

use crate::dataset::WorldVersion;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::process::Command;
use sysinfo::System;

/// Versions of the libraries that simulate and learn. The caller passes them, because this crate uses neither.
#[derive(Debug, Clone, Copy)]
pub struct Versions {
    /// Version of MuJoCo, such as `3.17.0`.
    pub mujoco: &'static str,
    /// Version of candle.
    pub candle: &'static str,
}

/// Shows all uncommitted changes as a patch, whatever the user's settings of git are.
const DIFF: [&str; 8] = [
    "diff",
    "--binary",
    "--no-color",
    "--no-ext-diff",
    "--no-textconv",
    "--src-prefix=a/",
    "--dst-prefix=b/",
    "HEAD",
];

/// The provenance of a command's runs: source tree, versions, machine and the command itself.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Commit of the git repository that the command ran in, or `None` outside of a repository.
    pub git_commit: Option<String>,
    /// Whether tracked files had uncommitted changes, or `None` outside of a repository.
    pub git_dirty: Option<bool>,
    /// The uncommitted changes, as a patch that `git apply` can apply. They are stored in a file of their own.
    #[serde(skip)]
    pub uncommitted: Option<Vec<u8>>,
    /// Version of the harness.
    pub harness_version: String,
    /// Version of MuJoCo.
    pub mujoco_version: String,
    /// Version of candle.
    pub candle_version: String,
    /// Name of the machine, empty if unknown.
    pub host: String,
    /// Brand of the processor, empty if unknown.
    pub processor: String,
    /// Number of threads of the command.
    pub threads: usize,
    /// Absolute path of the run's world file. `None` for a built-in world and an imported dataset, and in records of
    /// earlier versions. Two world files in different folders may have the same name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub world_file: Option<PathBuf>,
    /// The version of the run's world. `None` for an imported dataset.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub world: Option<WorldVersion>,
    /// Absolute path of the world file of the run's test, if it is in another world that is not built in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub test_world_file: Option<PathBuf>,
    /// The version of the world of the run's test, if it is another one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub test_world: Option<WorldVersion>,
    /// The question of the experiment, as its spec says. Empty in records of earlier versions.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub description: String,
    /// The command, quoted for a shell. A run's record has the command that makes only this run.
    pub command: String,
}

impl Provenance {
    /// Collects the provenance from the git repository of the current folder and from this machine.
    pub fn gather(versions: Versions, threads: usize, command: String) -> Self {
        let line = |output: Vec<u8>| String::from_utf8_lossy(&output).trim().to_owned();
        let commit = git(&["rev-parse", "HEAD"]).map(line);
        let status = commit.as_ref().and_then(|_| git(&["status", "--porcelain", "--untracked-files=no"]));
        let dirty = status.map(|status| !status.is_empty());
        let system = System::new_with_specifics(
            sysinfo::RefreshKind::nothing().with_cpu(sysinfo::CpuRefreshKind::nothing()),
        );
        Self {
            uncommitted: if dirty == Some(true) { git(&DIFF) } else { None },
            git_commit: commit,
            git_dirty: dirty,
            harness_version: env!("CARGO_PKG_VERSION").into(),
            mujoco_version: versions.mujoco.into(),
            candle_version: versions.candle.into(),
            host: System::host_name().unwrap_or_default(),
            processor: system.cpus().first().map(|cpu| cpu.brand().to_owned()).unwrap_or_default(),
            threads,
            world_file: None,
            world: None,
            test_world_file: None,
            test_world: None,
            description: String::new(),
            command,
        }
    }
}

/// The output of a git command, or `None` if git is not installed or fails.
fn git(arguments: &[&str]) -> Option<Vec<u8>> {
    let output = Command::new("git").args(arguments).output().ok()?;
    output.status.success().then_some(output.stdout)
}

/// The peak resident memory of this process so far, in bytes, or `None` where the system does not report it.
pub fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kibibytes * 1024)
}
