//! What commands cost in a results folder of thousands of runs: nothing that grows with the square of their number.

mod common;

use common::{SMOKE, fresh, succeed};
use harness::registry::Registry;
use harness::seal;
use std::path::Path;

/// Runs in the folder.
const RUNS: u64 = 3000;
/// Processor time that a command may take, s. Most of it is the start of the program and the reading of the records.
const MOST_SECONDS: f64 = 1.0;

/// The records of as many finished runs, which differ in their seeds.
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
        // Without waiting for the disk, as `seal::write` does.
        std::fs::write(folder.path().join("run.json"), bytes).unwrap();
    }
}

/// Processor time of all processes that this one waited for, s.
fn children_seconds() -> f64 {
    // SAFETY: the structure is plain numbers, which the call fills.
    let usage = unsafe {
        let mut usage = std::mem::zeroed::<libc::rusage>();
        assert_eq!(libc::getrusage(libc::RUSAGE_CHILDREN, &mut usage), 0);
        usage
    };
    let seconds = |time: libc::timeval| time.tv_sec as f64 + time.tv_usec as f64 / 1e6;
    seconds(usage.ru_utime) + seconds(usage.ru_stime)
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
        (&["query", "select status, count(run) from runs group by status"], " 3000 "),
        (&plan, "differs in training.epochs (1, now 3)"),
    ];
    for (arguments, expected) in commands {
        let before = children_seconds();
        let said = succeed(&results, arguments);
        let seconds = children_seconds() - before;
        println!("{}: {seconds:.2} s of processor time", arguments[0]);
        assert!(said.contains(expected), "{}", said.lines().take(5).collect::<Vec<_>>().join("\n"));
        assert!(seconds < MOST_SECONDS, "{}: {seconds} s", arguments[0]);
    }
}
