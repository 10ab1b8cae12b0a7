//! What is shown of trainings that are running: their epochs in the tables, and `harness watch`.

use crate::common::{PATIENCE, SMOKE, ask, finish, fresh, harness, succeed};
use crate::interruption::signal;
use crate::terminal::{plain, raw, raw_while, too_wide};
use std::io::{BufRead, BufReader};
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
        assert!(begin.elapsed() < PATIENCE, "no epochs appear");
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

/// Waits until a run has begun.
#[track_caller]
fn wait_for_record(results: &Path) {
    let begin = Instant::now();
    let runs = || std::fs::read_dir(results.join("runs/smoke")).into_iter().flatten().flatten();
    while !runs().any(|run| run.path().join("run.json").exists()) {
        assert!(begin.elapsed() < PATIENCE, "no run begins");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn epochs_of_a_running_training_are_in_tables_but_in_no_result() {
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
        unknown.code == 2 && unknown.stderr.contains("no run of 'smok' has started"),
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
fn a_trial_is_watched_up_to_the_epoch_where_halving_compares_it() {
    let results = fresh("live-halving");
    let spec = results.with_extension("yaml");
    // Each epoch has many small steps, so that the first trial lasts long enough to be seen.
    let text = "name: tiny\nscenarios: [empty]\ninput: [proprioception]\noutput: [proprioception, \
                contact_force]\nlatent: [2]\n\
        network: {preset: single_to_multi, hidden: [8]}\nsimulation: {episodes: 4, actuations_per_episode: 2}\n\
        training: {epochs: 90000, batch_size: 2, patience: null}\n\
        search:\n  method: sobol\n  trials: 2\n  space:\n    training.batch_size: {choice: [1, 2]}\n  \
        objective: {term: contact_force}\n  halving: {eta: 2, min_epochs: 45000}\n";
    std::fs::write(&spec, text).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_harness"));
    command.arg("--results").arg(&results).arg("run").arg(&spec);
    let _run = Running(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    let begin = Instant::now();
    let row = loop {
        assert!(begin.elapsed() < PATIENCE, "no trial is trained");
        std::thread::sleep(Duration::from_millis(200));
        let watched = finish(&mut harness(&results, &["watch", "--once"])).stdout;
        if let Some(row) = watched.lines().find(|line| line.contains("trial=0000") && line.contains('/')) {
            break row.to_owned();
        }
    };
    assert!(row.contains("/45000 "), "{row}");
}

#[test]
fn a_killed_and_resumed_training_has_each_epoch_once() {
    let (whole, killed) = (fresh("live-whole"), fresh("live-killed"));
    assert!(training(&whole, 600).status().unwrap().success());
    {
        let _run = Running(training(&killed, 600).spawn().unwrap());
        wait_for_epochs(&killed, 0);
    }
    let again = Running(training(&killed, 600).spawn().unwrap());
    let mut again = again;
    // While it goes on, `epochs` checks that every epoch is there once.
    while again.0.try_wait().unwrap().is_none() {
        epochs(&killed);
        std::thread::sleep(Duration::from_millis(200));
    }
    let of = |results: &Path| {
        ask(results, "select epoch, split, term, value from epochs order by epoch, split, term")
    };
    assert_eq!(epochs(&killed), 600);
    assert_eq!(of(&killed), of(&whole));
    let left = std::fs::read_dir(killed.join("runs/smoke"))
        .unwrap()
        .flatten()
        .flat_map(|run| std::fs::read_dir(run.path()).unwrap());
    let left: Vec<_> = left.flatten().map(|file| file.file_name().into_string().unwrap()).collect();
    assert!(!left.iter().any(|name| name.contains("epochs.json")), "{left:?}");
}

#[test]
fn watching_ends_when_nobody_reads_it() {
    let results = fresh("live-unread");
    let run = Running(training(&results, 100_000).spawn().unwrap());
    wait_for_record(&results);
    signal(&run.0, libc::SIGSTOP);
    let mut watch = Command::new(env!("CARGO_BIN_EXE_harness"));
    let watch = watch.arg("--results").arg(&results).arg("watch").stdout(Stdio::piped());
    let mut watch = Running(watch.spawn().unwrap());
    let mut line = String::new();
    BufReader::new(watch.0.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert!(line.starts_with("1 running ("), "{line}");
    let begin = Instant::now();
    while watch.0.try_wait().unwrap().is_none() {
        assert!(begin.elapsed() < PATIENCE, "it still runs");
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(watch.0.wait().unwrap().success());
}

#[test]
fn watching_ends_when_the_training_does() {
    let results = fresh("live-watched");
    let mut run = Running(training(&results, 1500).spawn().unwrap());
    wait_for_record(&results);
    // The training stands still until its picture was replaced.
    signal(&run.0, libc::SIGSTOP);
    let mut watch = Command::new(env!("CARGO_BIN_EXE_harness"));
    let shown = raw_while(watch.arg("--results").arg(&results).arg("watch"), 80, |shown| {
        if shown.contains("\x1b[J") {
            signal(&run.0, libc::SIGCONT);
        }
    });
    assert!(run.0.wait().unwrap().success());
    assert!(shown.contains("\x1b[J"), "pictures replace each other: {shown:?}");
    let shown = plain(&shown);
    assert!(
        shown.contains("1 running (") && shown.lines().last().unwrap().starts_with("1 done ("),
        "{shown}"
    );
}
