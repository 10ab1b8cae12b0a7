//! What is shown of trainings that are running: their epochs in the tables, and `harness watch`.

use crate::common::{SMOKE, finish, fresh, harness, succeed};
use crate::terminal::{plain, raw, too_wide};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A training of one network, with this many epochs of some milliseconds.
fn training(results: &Path, epochs: usize) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_harness"));
    command.current_dir(env!("CARGO_MANIFEST_DIR")).arg("--results").arg(results).args(["run", SMOKE]);
    command.args(["scenarios=[empty]", "tasks=[prediction]", "training.patience=null"]);
    command.arg(format!("training.epochs={epochs}")).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

/// A process that is killed when the test ends.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The rows of a query's answer.
fn ask(results: &Path, sql: &str) -> Vec<serde_json::Value> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("answer.json");
    succeed(results, &["query", sql, "--output", path.to_str().unwrap()]);
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// The epochs in the table, in order. Each must be there once for each split and term, from the first to the last.
#[track_caller]
fn epochs(results: &Path) -> usize {
    let sql = "select epoch, count(*) as rows, count(distinct term) as terms, count(distinct split) as splits \
               from epochs group by epoch order by epoch";
    let rows = ask(results, sql);
    for (place, row) in rows.iter().enumerate() {
        let of = |column: &str| row[column].as_u64().unwrap();
        assert_eq!(of("epoch") as usize, place + 1, "{rows:?}");
        assert!(of("terms") == 5 && of("splits") == 2 && of("rows") == 10, "{row}");
    }
    rows.len()
}

/// Waits until the table has more than this many epochs, and returns their number.
#[track_caller]
fn wait_for_epochs(results: &Path, more_than: usize) -> usize {
    let begin = Instant::now();
    loop {
        assert!(begin.elapsed() < Duration::from_secs(100), "no epochs appear");
        std::thread::sleep(Duration::from_millis(200));
        if !results.join("runs/smoke").is_dir() {
            continue;
        }
        let there = epochs(results);
        if there > more_than {
            return there;
        }
    }
}

#[test]
fn epochs_appear_in_the_tables_while_a_network_is_trained_and_count_in_no_result() {
    let results = fresh("live");
    let mut run = Running(training(&results, 100_000).spawn().unwrap());
    let some = wait_for_epochs(&results, 0);
    let more = wait_for_epochs(&results, some);
    assert!(more > some);
    let status = ask(&results, "select distinct status from epochs join runs using (experiment, run)");
    assert_eq!(status, [serde_json::json!({ "status": "running" })]);
    // The other tables and everything that is computed from results leave the run out.
    assert_eq!(ask(&results, "select count(*) as rows from metrics")[0]["rows"], 0);
    let compared = finish(&mut harness(&results, &["compare"]));
    assert!(compared.stderr.contains("there are no finished runs to compare"), "{}", compared.stderr);

    let watched = succeed(&results, &["watch", "--once"]);
    assert!(watched.starts_with("1 running ("), "{watched}");
    let row = watched.lines().find(|line| line.starts_with("empty-z4-seed0-")).unwrap();
    assert!(row.contains(&format!(" {} ", run.0.id())), "the process: {watched}");
    assert!(row.contains("/100000 ") && !row.contains("none yet"), "{watched}");
    for width in [60, 80, 120] {
        let mut once = Command::new(env!("CARGO_BIN_EXE_harness"));
        let shown = plain(&raw(once.arg("--results").arg(&results).args(["watch", "--once"]), width));
        assert!(too_wide(&shown, width).is_empty(), "at {width}: {shown}");
        assert!(shown.contains("/100000") && shown.contains("loss"), "at {width}: {shown}");
    }
    assert_eq!(finish(&mut harness(&results, &["watch", "smoke", "--once"])).code, 0);
    let unknown = finish(&mut harness(&results, &["watch", "smok"]));
    assert!(
        unknown.code == 1 && unknown.stderr.contains("no run of 'smok' has started"),
        "{}",
        unknown.stderr
    );

    run.0.kill().unwrap();
    run.0.wait().unwrap();
    assert_eq!(epochs(&results), 0, "an interrupted run has no epochs");
    let watched = succeed(&results, &["watch"]);
    assert!(watched.starts_with("1 interrupted ("), "nothing runs, so it ends: {watched}");
}

#[test]
fn a_killed_and_resumed_training_has_each_epoch_once() {
    let (whole, killed) = (fresh("live-whole"), fresh("live-killed"));
    assert!(training(&whole, 300).status().unwrap().success());
    {
        let _run = Running(training(&killed, 300).spawn().unwrap());
        wait_for_epochs(&killed, 10);
    }
    let again = Running(training(&killed, 300).spawn().unwrap());
    let mut again = again;
    // While it goes on, `epochs` checks that every epoch is there once.
    while again.0.try_wait().unwrap().is_none() {
        epochs(&killed);
        std::thread::sleep(Duration::from_millis(200));
    }
    let of = |results: &Path| {
        ask(results, "select epoch, split, term, value from epochs order by epoch, split, term")
    };
    assert_eq!(epochs(&killed), 300);
    assert_eq!(of(&killed), of(&whole));
    let left = std::fs::read_dir(killed.join("runs/smoke"))
        .unwrap()
        .flatten()
        .flat_map(|run| std::fs::read_dir(run.path()).unwrap());
    let left: Vec<_> = left.flatten().map(|file| file.file_name().into_string().unwrap()).collect();
    assert!(!left.iter().any(|name| name.contains("epochs.json")), "{left:?}");
}

#[test]
fn watching_ends_when_the_training_does() {
    let results = fresh("live-watched");
    let mut run = Running(training(&results, 200).spawn().unwrap());
    wait_for_epochs(&results, 0);
    let mut watch = Command::new(env!("CARGO_BIN_EXE_harness"));
    let shown = raw(watch.arg("--results").arg(&results).arg("watch"), 80);
    assert!(run.0.wait().unwrap().success());
    assert!(shown.contains("\x1b[J"), "pictures replace each other: {shown:?}");
    let shown = plain(&shown);
    assert!(
        shown.contains("1 running (") && shown.lines().last().unwrap().starts_with("1 done ("),
        "{shown}"
    );
}
