//! The time of commands in a results folder of thousands of runs, which must not grow with the square of their number.

use crate::common::{SMOKE, fresh, succeed};
use harness::registry::{Registry, RunRecord};
use harness::seal;
use std::io::Read;
use std::path::Path;
use std::process::Stdio;

/// Numbers of runs in two folders.
const FEW: u64 = 300;
const MANY: u64 = 3000;
/// How many times the processor time a command may take at most with ten times as many runs. With a time that grows
/// with their square, it would be up to 100 times as much.
const MOST_TIMES: f64 = 20.0;

/// Writes records of finished runs with different seeds.
fn write_records(results: &Path, mut record: RunRecord, count: u64) {
    let registry = Registry::new(results);
    for seed in 0..count {
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

/// The processor times in seconds of commands in a folder with this many runs like `record`.
fn times(record: &RunRecord, count: u64) -> [f64; 3] {
    let results = fresh(&format!("many_runs_{count}"));
    write_records(&results, record.clone(), count);
    let seeds = format!("seeds={:?}", (0..count).collect::<Vec<_>>());
    let same = ["scenarios=[empty]", "tasks=[prediction]", seeds.as_str()];
    let plan = [&["run", SMOKE, "--dry-run", "training.epochs=3"], &same[..]].concat();
    let commands: [(&[&str], &str); 3] = [
        (&["ls"], "smoke"),
        (&["query", "select status, count(run) from runs group by status"], &count.to_string()),
        (&plan, "differs in training.epochs (1, now 3)"),
    ];
    commands.map(|(arguments, expected)| {
        let once = |_| {
            let (said, seconds) = measure(&results, arguments);
            assert!(said.contains(expected), "{}", said.lines().take(5).collect::<Vec<_>>().join("\n"));
            seconds
        };
        // A command takes longer while others displace its data from the caches.
        let least = (0..3).map(once).fold(f64::INFINITY, f64::min);
        println!("{} with {count} runs: {least:.2} s of processor time", arguments[0]);
        least
    })
}

#[test]
fn command_times_do_not_grow_with_the_square_of_the_runs() {
    let one = fresh("many_runs_one");
    succeed(&one, &["run", SMOKE, "scenarios=[empty]", "training.epochs=1", "tasks=[prediction]"]);
    let record = Registry::new(&one).records().remove(0);
    for (few, many) in times(&record, FEW).into_iter().zip(times(&record, MANY)) {
        assert!(many < MOST_TIMES * few, "{few} s with {FEW} runs, and {many} s with {MANY}");
    }
}
