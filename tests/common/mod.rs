//! Helpers that run the program in tests.

pub mod finger;
pub mod recorded;

use assert_cmd::Command;
use harness::registry::{Registry, RunRecord};
use harness::seal;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How long tests wait for what must happen. Only what never happens takes so long, even on a slow and busy machine.
pub const PATIENCE: Duration = Duration::from_secs(600);

pub const SMOKE: &str = "experiments/smoke.yaml";
pub const SINGLE: &str = "experiments/single_to_multi.yaml";
pub const MULTI: &str = "experiments/multi_to_multi.yaml";
/// Overrides with which the paper's experiments take seconds, with two seeds.
pub const TINY: [&str; 6] = [
    "simulation.episodes=4",
    "simulation.actuations_per_episode=3",
    "training.epochs=2",
    "training.batch_size=16",
    "network.hidden=16",
    "seeds=[0,1]",
];

/// Overrides with which every run of the smoke experiment fails: its loss is no longer finite.
pub const FAILING: [&str; 3] =
    ["training.learning_rate=1", "training.kl_weight=1000000", "training.epochs=200"];

/// The exit code and output of a command.
pub struct Answer {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

/// A command of the harness on a results folder, in the repository's root.
pub fn harness(results: &Path, arguments: &[&str]) -> Command {
    let mut command = assert_cmd::cargo::cargo_bin_cmd!("harness");
    command.current_dir(env!("CARGO_MANIFEST_DIR")).arg("--results").arg(results).args(arguments);
    command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR")).env("TMPDIR", env!("CARGO_TARGET_TMPDIR"));
    command
}

/// Runs a command to its end. It must not panic or be ended by a signal.
#[track_caller]
pub fn finish(command: &mut Command) -> Answer {
    let output = command.output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("the harness writes UTF-8");
    let (stdout, stderr) = (text(output.stdout), text(output.stderr));
    assert!(!stderr.contains("panicked"), "{stderr}");
    Answer { code: output.status.code().expect("an exit code"), stdout, stderr }
}

/// Runs a command that must succeed, and returns its standard output.
#[track_caller]
pub fn succeed(results: &Path, arguments: &[&str]) -> String {
    let answer = finish(&mut harness(results, arguments));
    assert_eq!(answer.code, 0, "{arguments:?}: {}", answer.stderr);
    answer.stdout
}

/// The rows of a query's answer.
pub fn ask(results: &Path, sql: &str) -> Vec<serde_json::Value> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("answer.json");
    succeed(results, &["query", sql, "--output", path.to_str().unwrap()]);
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// The path of a folder that does not exist yet, inside cargo's folder for the files of tests.
pub fn fresh(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    folder
}

/// Copies a folder with everything in it.
pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let copied = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy_folder(&path, &copied);
        } else {
            std::fs::copy(&path, &copied).unwrap();
        }
    }
}

/// A new results folder, named `name`, with these published experiments.
pub fn published_only(experiments: &[&str], name: &str) -> PathBuf {
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference/runs");
    let results = fresh(name);
    for experiment in experiments {
        copy_folder(&from.join(experiment), &results.join("runs").join(experiment));
    }
    results
}

/// Gives each published run of a results folder for which `is_wanted` returns true a folder of its own, as other runs
/// have, and removes the files that the runs share.
pub fn divide(results: &Path, is_wanted: impl Fn(&RunRecord) -> bool) {
    let runs = Registry::new(results).recorded();
    for (folder, record) in runs.iter().filter(|(_, record)| is_wanted(record)) {
        record.extract(folder, folder).unwrap();
    }
    for (folder, _) in runs {
        for file in std::fs::read_dir(folder.parent().unwrap()).unwrap().map(|file| file.unwrap().path()) {
            if file.is_file() {
                std::fs::remove_file(file).unwrap();
            }
        }
    }
}

/// Changes a value of a run's record.
pub fn set_in_record(run: &Path, key: &str, value: serde_json::Value) {
    let path = run.join("run.json");
    let mut record: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    *record.pointer_mut(key).unwrap() = value;
    record[seal::KEY] = seal::BLANK.into();
    seal::write(&path, format!("{record:#}\n").into_bytes()).unwrap();
}

/// The results of a smoke run, in a new folder inside cargo's folder for the files of tests.
pub fn smoke_run(name: &str) -> PathBuf {
    let results = fresh(name);
    let said = succeed(&results, &["run", SMOKE]);
    assert!(said.contains("2 done, 0 done before, 0 failed"), "{said}");
    results
}

/// Writes a shell script that can be run. A child process writes it, because a script can't be run while it is open for
/// writing, and another test's child process could inherit the open file.
pub fn write_script(path: &Path, text: &str) {
    let write = r#"printf '#!/bin/sh\n%s\n' "$2" >"$1" && chmod +x "$1""#;
    let status = std::process::Command::new("sh").args(["-c", write, "sh"]).arg(path).arg(text).status();
    assert!(status.unwrap().success());
}

/// A small disk in memory, which only root can create.
pub struct Disk(tempfile::TempDir);

impl Disk {
    pub fn new(kilobytes: usize) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let options = format!("size={kilobytes}k");
        let disk = Self(folder);
        disk.mount(&["-t", "tmpfs", "-o", &options, "tmpfs"]).then_some(disk)
    }

    pub fn path(&self) -> &Path {
        self.0.path()
    }

    pub fn remount(&self, options: &str) {
        assert!(self.mount(&["-o", &format!("remount,{options}")]));
    }

    fn mount(&self, arguments: &[&str]) -> bool {
        let output = std::process::Command::new("mount").args(arguments).arg(self.path()).output();
        output.is_ok_and(|output| output.status.success())
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = std::process::Command::new("umount").arg(self.path()).output();
    }
}

/// The path of the first of these programs that is installed.
fn program(names: &[&str]) -> Option<PathBuf> {
    let folders = std::env::var_os("PATH")?;
    let mut places =
        std::env::split_paths(&folders).flat_map(|folder| names.iter().map(move |n| folder.join(n)));
    places.find(|path| path.is_file())
}

/// The paths of Chromium and its driver, or the reason why the test is skipped.
fn browser() -> Result<(PathBuf, PathBuf), &'static str> {
    let missing =
        "skipped: no Chromium with its driver on the path; Debian: apt-get install chromium chromium-driver";
    let chromium = program(&["chromium", "chromium-browser", "google-chrome"]).ok_or(missing)?;
    Ok((chromium, program(&["chromedriver"]).ok_or(missing)?))
}

/// Runs a script of tests/python with these paths, those of Chromium and its driver, and further arguments. Returns
/// whether it found no error, and its output; `None` without a browser.
pub fn in_chromium(script: &str, paths: &[&Path], more: &[&str]) -> Option<(bool, String)> {
    let (chromium, driver) = browser().inspect_err(|reason| eprintln!("{reason}")).ok()?;
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = std::process::Command::new(root.join(".venv/bin/python"))
        .arg(root.join("tests/python").join(script))
        .args(paths)
        .args([chromium, driver])
        .args(more)
        .output()
        .unwrap();
    let said =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    Some((output.status.success(), said))
}
