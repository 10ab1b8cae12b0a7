//! The harness's program as tests use it.

pub mod finger;

use assert_cmd::Command;
use std::path::{Path, PathBuf};

pub const SMOKE: &str = "experiments/smoke.yaml";
pub const SINGLE: &str = "experiments/single_to_multi.yaml";
pub const MULTI: &str = "experiments/multi_to_multi.yaml";
/// What makes the paper's experiments a matter of seconds, with two seeds.
pub const TINY: [&str; 6] = [
    "simulation.episodes=4",
    "simulation.actuations_per_episode=3",
    "training.epochs=2",
    "training.batch_size=16",
    "network.hidden=16",
    "seeds=[0,1]",
];

/// What a command ended with.
pub struct Answer {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

/// A command of the harness on a results folder, in the repository's root.
pub fn harness(results: &Path, arguments: &[&str]) -> Command {
    let mut command = assert_cmd::cargo::cargo_bin_cmd!("harness");
    command.current_dir(env!("CARGO_MANIFEST_DIR")).arg("--results").arg(results).args(arguments);
    command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
    command
}

/// Runs a command to its end, which must not be a panic or a signal.
#[track_caller]
pub fn finish(command: &mut Command) -> Answer {
    let output = command.output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("the harness writes UTF-8");
    let (stdout, stderr) = (text(output.stdout), text(output.stderr));
    assert!(!stderr.contains("panicked"), "{stderr}");
    Answer { code: output.status.code().expect("an exit code"), stdout, stderr }
}

/// The standard output of a command that must succeed.
#[track_caller]
pub fn succeed(results: &Path, arguments: &[&str]) -> String {
    let answer = finish(&mut harness(results, arguments));
    assert_eq!(answer.code, 0, "{arguments:?}: {}", answer.stderr);
    answer.stdout
}

/// Where there is no folder yet; cargo keeps what is put there until the next time.
pub fn fresh(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    folder
}

/// The results of a smoke run in a folder of its own, which cargo keeps for the tests.
pub fn smoke_run(name: &str) -> PathBuf {
    let results = fresh(name);
    let said = succeed(&results, &["run", SMOKE]);
    assert!(said.contains("2 done, 0 done before, 0 failed"), "{said}");
    results
}
