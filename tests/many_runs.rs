//! The time of commands in a results folder of thousands of runs, which must not grow with the square of their number.

use crate::common::{SMOKE, fresh, succeed};
use harness::registry::Registry;
use harness::seal;
use std::io::Read;
use std::path::Path;
use std::process::Stdio;

/// Number of runs in the folder.
const RUNS: u64 = 3000;
/// The maximum processor time of a command in seconds. Most of it is for starting the program and reading the records.
const MOST_SECONDS: f64 = 1.0;

/// Writes the records of [`RUNS`] finished runs with different seeds.
fn write_records(results: &Path) {
    succeed(results, &["run", SMOKE, "scenarios=[empty]", "training.epochs=1", "tasks=[prediction]"]);
    let registry = Registry::new(results);
    let mut record = registry.records().remove(0);
    for seed in 1..RUNS {
        record.spec.seed = seed;
        record.spec_hash = record.spec.hash();
        let folder = registry.run(&record.experiment, &record.spec, &record.dataset);
        record.run = folder.id().to_owned();
        let mut json = serde_json::to_value(&record).unwrap();
        json[seal::KEY] = seal::BLANK.into();
        let mut bytes = json.to_string().into_bytes();
        seal::seal(&mut bytes).unwrap();
        std::fs::create_dir_all(folder.path()).unwrap();
        // `seal::write` would wait for the disk.
        std::fs::write(folder.path().join("run.json"), bytes).unwrap();
    }
}

/// The output of a command that must succeed, and its processor time in seconds.
#[allow(clippy::zombie_processes, reason = "wait4 waits for the child, and tells what it took")]
fn measure(results: &Path, arguments: &[&str]) -> (String, f64) {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_harness"));
    command.current_dir(env!("CARGO_MANIFEST_DIR")).arg("--results").arg(results).args(arguments);
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    let mut said = String::new();
    child.stdout.take().unwrap().read_to_string(&mut said).unwrap();
    let (process, mut status) = (child.id() as libc::pid_t, 0);
    // SAFETY: `rusage` consists of numbers, and the call fills it. Nothing else waits for this child.
    let usage = unsafe {
        let mut usage = std::mem::zeroed::<libc::rusage>();
        assert_eq!(libc::wait4(process, &mut status, 0, &mut usage), process);
        usage
    };
    assert_eq!(status, 0, "{arguments:?}");
    let seconds = |time: libc::timeval| time.tv_sec as f64 + time.tv_usec as f64 / 1e6;
    (said, seconds(usage.ru_utime) + seconds(usage.ru_stime))
}

#[test]
fn commands_take_little_time_in_a_folder_of_thousands_of_runs() {
    let results = fresh("many_runs");
    write_records(&results);
    let seeds = format!("seeds={:?}", (0..RUNS).collect::<Vec<_>>());
    let same = ["scenarios=[empty]", "tasks=[prediction]", seeds.as_str()];
    let plan = [&["run", SMOKE, "--dry-run", "training.epochs=3"], &same[..]].concat();
    let commands: [(&[&str], &str); 3] = [
        (&["ls"], "more rows"),
        (&["query", "select status, count(run) from runs group by status"], "3000"),
        (&plan, "differs in training.epochs (1, now 3)"),
    ];
    for (arguments, expected) in commands {
        let (said, seconds) = measure(&results, arguments);
        println!("{}: {seconds:.2} s of processor time", arguments[0]);
        assert!(said.contains(expected), "{}", said.lines().take(5).collect::<Vec<_>>().join("\n"));
        assert!(seconds < MOST_SECONDS, "{}: {seconds} s", arguments[0]);
    }
}
