//! Killed, stopped by a signal, run twice at the same time, out of memory or disk: no results are lost or changed.

use crate::common::{Answer, Disk, FAILING, PATIENCE, SMOKE, smoke_run};
use harness::files::{FolderLock, LOCK, UNFINISHED};
use harness::tables::read_footer;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::sync::LazyLock;
use std::time::{Duration, Instant};

/// A run of about two seconds, with every stage.
const RUN: [&str; 5] = ["run", SMOKE, "scenarios=[empty]", "training.epochs=150", "training.patience=null"];
/// Settings of a network with memory, which predicts further than the next sample.
const WITH_MEMORY: [&str; 3] = ["window.context=8", "window.horizon=3", "window.start=rest"];
/// A collection of about two seconds.
const COLLECTION: [&str; 6] =
    ["collect", SMOKE, "scenarios=[empty]", "simulation.episodes=40", "--threads", "1"];
/// Twelve runs, six of each scenario.
const TWELVE: [&str; 6] =
    ["run", SMOKE, "latent=[2,3,4]", "seeds=[0,1]", "training.epochs=24", "training.patience=null"];

/// The results of the run and of the twelve runs without interruption.
static UNDISTURBED: LazyLock<PathBuf> = LazyLock::new(|| undisturbed("undisturbed", &RUN));
static ALONE: LazyLock<PathBuf> = LazyLock::new(|| undisturbed("alone", &TWELVE));

// --- helpers ---

/// A temporary results folder for one test.
pub struct Results(tempfile::TempDir);

impl Results {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn path(&self) -> &Path {
        self.0.path()
    }
}

/// Every file below a folder, sorted.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() { files.extend(self::files(&path)) } else { files.push(path) }
    }
    files.sort();
    files
}

fn name(path: &Path) -> String {
    path.file_name().unwrap().to_string_lossy().into_owned()
}

/// The bytes of everything that must not depend on interruptions, by its path in the results folder.
fn numbers(results: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let timeless = |path: &PathBuf| {
        let name = name(path);
        name.ends_with("metrics.parquet")
            || name.ends_with("predictions.parquet")
            || ["prediction.safetensors", "reconstruction.safetensors"].contains(&name.as_str())
            || name.starts_with("episode_")
    };
    // A process that is killed while it removes a superseded run leaves the folder that it has set aside for `harness
    // gc`.
    let is_set_aside = |path: &PathBuf| {
        let first = path.strip_prefix(results).unwrap().components().next().unwrap();
        first.as_os_str().to_string_lossy().starts_with(".unfinished-removal-")
    };
    let read =
        |path: PathBuf| (path.strip_prefix(results).unwrap().to_owned(), std::fs::read(&path).unwrap());
    files(results).into_iter().filter(|path| timeless(path) && !is_set_aside(path)).map(read).collect()
}

/// Checks that two results folders have the same numbers, bit by bit.
#[track_caller]
pub fn assert_same(results: &Path, undisturbed: &Path) {
    let (found, expected) = (numbers(results), numbers(undisturbed));
    assert!(!expected.is_empty());
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (path, bytes) in &expected {
        assert!(found[path] == *bytes, "{} differs", path.display());
    }
}

/// Checks that every table can be read and, if no process is working, that there are no unfinished files.
#[track_caller]
pub fn assert_whole(results: &Path, at_rest: bool) {
    for path in files(results) {
        let name = name(&path);
        assert!(
            !at_rest || name == LOCK || !name.starts_with(UNFINISHED) && !name.contains(".state."),
            "{} is left",
            path.display()
        );
        if name.ends_with(".parquet") {
            read_footer(&path).unwrap();
        }
    }
}

/// Starts the program. It finds no git repository: the repository's state is written to every file, and may change
/// during the test.
pub fn start(results: &Path, arguments: &[&str]) -> Child {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_harness"));
    command.arg("--results").arg(results).args(arguments).env("TMPDIR", env!("CARGO_TARGET_TMPDIR"));
    start_command(command.stdout(Stdio::piped()).stderr(Stdio::piped()))
}

/// Starts any command in the same way.
pub fn start_command(command: &mut std::process::Command) -> Child {
    command.current_dir(env!("CARGO_MANIFEST_DIR")).env("GIT_DIR", "/nonexistent").stdin(Stdio::null());
    command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
    // SAFETY: nothing else is done between fork and exec. The tests may have been started by `nohup`.
    unsafe {
        command.pre_exec(|| {
            libc::signal(libc::SIGHUP, libc::SIG_DFL);
            Ok(())
        })
    };
    command.spawn().unwrap()
}

/// Runs the program to its end.
#[track_caller]
pub fn run(results: &Path, arguments: &[&str]) -> Answer {
    end(start(results, arguments))
}

/// Runs the program to its end with a limit of its address space.
#[track_caller]
fn run_within(kilobytes: usize, results: &Path, arguments: &[&str]) -> Answer {
    let limited = format!("ulimit -v {kilobytes}; exec \"$@\"");
    let mut command = std::process::Command::new("sh");
    command
        .args(["-c", &limited, "sh", env!("CARGO_BIN_EXE_harness"), "--threads", "2", "--results"])
        .arg(results)
        .args(arguments);
    end(start_command(command.stdout(Stdio::piped()).stderr(Stdio::piped())))
}

/// Runs a command that must succeed, and returns its standard output.
#[track_caller]
pub fn succeed(results: &Path, arguments: &[&str]) -> String {
    let answer = run(results, arguments);
    assert_eq!(answer.code, 0, "{arguments:?}: {}", answer.stderr);
    answer.stdout
}

/// Waits for the end of a program whose output fits in a pipe.
#[track_caller]
pub fn end(child: Child) -> Answer {
    let output = child.wait_with_output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    let (stdout, stderr) = (text(output.stdout), text(output.stderr));
    assert!(!stderr.contains("panicked"), "{stderr}");
    Answer { code: output.status.code().expect("an exit code"), stdout, stderr }
}

/// Waits until `so` returns true, while a program runs.
#[track_caller]
fn wait_until(child: &mut Child, what: &str, so: impl Fn() -> bool) {
    assert!(comes_to(child, what, so), "{what}: the program ended first");
}

/// Waits until `so` returns true, or a program ends. Returns whether the program still runs.
#[track_caller]
fn comes_to(child: &mut Child, what: &str, so: impl Fn() -> bool) -> bool {
    let begin = Instant::now();
    while !so() {
        if child.try_wait().unwrap().is_some() {
            return false;
        }
        assert!(begin.elapsed() < PATIENCE, "{what}: not in {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(1));
    }
    true
}

/// Sends a signal to a command as soon as `so` returns true for its results folder. A command that ends before it
/// notices the signal starts again in another folder. Returns the folder and the answer.
#[track_caller]
fn stopped(arguments: &[&str], number: libc::c_int, so: impl Fn(&Path) -> bool) -> (Results, Answer) {
    for _ in 0..20 {
        let results = Results::new();
        let mut child = start(results.path(), arguments);
        if comes_to(&mut child, "a moment to stop", || so(results.path())) {
            signal(&child, number);
        }
        let answer = end(child);
        if answer.code != 0 {
            return (results, answer);
        }
    }
    panic!("{arguments:?} ended 20 times before it noticed the signal {number}");
}

pub fn signal(child: &Child, signal: libc::c_int) {
    // SAFETY: the child has not been waited for, so its process id is still valid.
    assert_eq!(unsafe { libc::kill(child.id() as libc::pid_t, signal) }, 0);
}

/// Kills a program after `delay`. Returns its answer if it ended before.
pub fn kill_after(mut child: Child, delay: Duration) -> Option<Answer> {
    let begin = Instant::now();
    while begin.elapsed() < delay {
        if child.try_wait().unwrap().is_some() {
            return Some(end(child));
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    None
}

/// Reads what a program says until it waits for another process. Returns false if it ends without waiting.
fn is_waiting(child: &mut Child) -> bool {
    // The reader takes no byte of the next line, so that the rest can be read later.
    let mut said = BufReader::with_capacity(1, child.stderr.as_mut().unwrap()).lines();
    said.any(|line| line.unwrap().starts_with("waiting for "))
}

fn has_state(results: &Path) -> bool {
    files(results).iter().any(|path| name(path).ends_with(".state.safetensors"))
}

/// The counts in the summary of `harness run`: done, done before, failed.
#[track_caller]
pub fn counts(answer: &Answer) -> [usize; 3] {
    let line = answer.stdout.lines().find(|line| line.contains(" done before, "));
    let line = line.unwrap_or_else(|| panic!("no summary: {}{}", answer.stdout, answer.stderr));
    let mut numbers = line.split(|c: char| !c.is_ascii_digit()).filter_map(|word| word.parse().ok());
    [(); 3].map(|()| numbers.next().unwrap())
}

/// The status and reason of every run.
fn statuses(results: &Path) -> Vec<(String, String)> {
    let answer = Results::new();
    let json = answer.path().join("runs.json");
    let query = "select status, reason from runs order by run";
    succeed(results, &["query", query, "--output", json.to_str().unwrap()]);
    let rows: Vec<serde_json::Value> = serde_json::from_slice(&std::fs::read(json).unwrap()).unwrap();
    let text = |row: &serde_json::Value, key: &str| row[key].as_str().unwrap_or_default().to_owned();
    rows.iter().map(|row| (text(row, "status"), text(row, "reason"))).collect()
}

/// The results of a command, in a new folder inside cargo's folder for the files of tests.
fn undisturbed(name: &str, arguments: &[&str]) -> PathBuf {
    let results = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&results);
    succeed(&results, arguments);
    results
}

// --- killed ---

/// Kills a command `kills` times at random moments, starts it again each time, and compares its results with those
/// without interruption. If it ends before it is killed, it starts in a new folder.
fn kill_again_and_again(arguments: &[&str], kills: usize) {
    let undisturbed = Results::new();
    let begin = Instant::now();
    succeed(undisturbed.path(), arguments);
    let whole = begin.elapsed();
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    let mut results = Results::new();
    let (mut killed, mut resumed, mut finished, mut in_a_row) = (0, 0, 0, 0);
    while killed < kills {
        in_a_row += 1;
        // It is killed later each time, so that it ends at last.
        let delay = whole.mul_f64(random.random::<f64>() * f64::from(4 + in_a_row) / 10.0);
        resumed += usize::from(has_state(results.path()));
        match kill_after(start(results.path(), arguments), delay) {
            None => killed += 1,
            Some(answer) => {
                assert_eq!(answer.code, 0, "{}", answer.stderr);
                assert_same(results.path(), undisturbed.path());
                assert_whole(results.path(), true);
                (results, in_a_row) = (Results::new(), 0);
                finished += 1;
            }
        }
        assert_whole(results.path(), false);
    }
    succeed(results.path(), arguments);
    assert_same(results.path(), undisturbed.path());
    assert_whole(results.path(), true);
    let seconds = begin.elapsed().as_secs_f64();
    println!(
        "{arguments:?}: {killed} kills, {resumed} starts from a saved state, {} ends, {seconds:.0} s",
        finished + 1
    );
}

#[test]
fn a_run_killed_a_few_times_ends_as_one_undisturbed() {
    kill_again_and_again(&RUN, 4);
}

#[test]
fn a_memory_killed_a_few_times_ends_as_one_undisturbed() {
    kill_again_and_again(&[&RUN[..], &["network.memory=gru"], &WITH_MEMORY].concat(), 3);
}

#[test]
fn a_collection_killed_a_few_times_ends_as_one_undisturbed() {
    kill_again_and_again(&COLLECTION, 3);
}

#[test]
#[ignore = "takes minutes: make soak"]
fn a_run_killed_at_60_moments_ends_as_one_undisturbed() {
    kill_again_and_again(&RUN, 60);
}

#[test]
#[ignore = "takes minutes: make soak"]
fn memories_killed_at_30_moments_end_as_one_undisturbed() {
    for memory in ["network.memory=gru", "network.memory=rssm"] {
        kill_again_and_again(&[&RUN[..], &[memory], &WITH_MEMORY].concat(), 30);
    }
}

#[test]
#[ignore = "takes minutes: make soak"]
fn a_collection_killed_at_60_moments_ends_as_one_undisturbed() {
    kill_again_and_again(&COLLECTION, 60);
}

#[test]
fn what_killed_processes_left_unfinished_is_removed() {
    let results = Results::new();
    succeed(results.path(), &RUN[..3]);
    let folders: Vec<PathBuf> = files(results.path())
        .iter()
        .filter(|path| name(path) == LOCK)
        .map(|path| path.parent().unwrap().to_owned())
        .collect();
    assert_eq!(folders.len(), 2, "a dataset's and a run's");
    for folder in &folders {
        std::fs::write(folder.join(format!("{UNFINISHED}Xy12Za")), "part of something").unwrap();
        let record = folder.join("run.json");
        let _ = std::fs::remove_file(record);
    }
    succeed(results.path(), &RUN[..3]);
    assert_whole(results.path(), true);
}

/// A process that is killed between its last two steps leaves the folder like this.
#[test]
fn the_state_of_a_finished_run_is_removed() {
    let results = Results::new();
    succeed(results.path(), &RUN[..3]);
    let record = files(results.path()).into_iter().find(|path| name(path) == "run.json").unwrap();
    let state = record.with_file_name("prediction.state.safetensors");
    std::fs::write(&state, "anything").unwrap();
    succeed(results.path(), &RUN[..3]);
    assert!(!state.exists());
    assert_whole(results.path(), true);
}

// --- stopped by a signal ---

#[test]
fn a_run_asked_to_stop_says_so_and_goes_on_when_asked_again() {
    let signals =
        [(libc::SIGINT, "SIGINT", 130), (libc::SIGTERM, "SIGTERM", 143), (libc::SIGHUP, "SIGHUP", 129)];
    for (number, signal_name, code) in signals {
        let (results, answer) = stopped(&RUN, number, has_state);
        assert_eq!(answer.code, code, "{}", answer.stderr);
        let last = answer.stderr.lines().last().unwrap();
        assert!(
            last.starts_with(&format!("stopped by {signal_name}; continue with the same command: "))
                && last.ends_with(&shlex::try_join(RUN).unwrap()),
            "{last}"
        );
        assert!(!answer.stderr.contains("failed"), "{}", answer.stderr);
        assert!(!answer.stdout.contains("done"), "{}", answer.stdout);
        let plan = succeed(results.path(), &[&RUN[..], &["--dry-run"]].concat());
        assert!(plan.starts_with("resume ") && plan.contains("it was interrupted"), "{plan}");
        succeed(results.path(), &RUN);
        assert_same(results.path(), &UNDISTURBED);
        assert_whole(results.path(), true);
    }
}

#[test]
fn a_run_under_nohup_outlives_its_terminal() {
    let results = Results::new();
    let mut command = std::process::Command::new("nohup");
    command.arg(env!("CARGO_BIN_EXE_harness")).arg("--results").arg(results.path()).args(RUN);
    let mut child = start_command(command.stdout(Stdio::piped()).stderr(Stdio::piped()));
    wait_until(&mut child, "a saved state", || has_state(results.path()));
    signal(&child, libc::SIGHUP);
    let answer = end(child);
    assert_eq!((answer.code, counts(&answer)), (0, [1, 0, 0]), "{}", answer.stderr);
}

/// Standard outputs that can't be written.
fn unreadable() -> [(&'static str, Stdio); 2] {
    let full = File::options().write(true).open("/dev/full").unwrap();
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    [("full", full.into()), ("closed", writer.into())]
}

#[test]
fn a_run_goes_on_where_nobody_can_read_what_it_says() {
    for ((what, stdout), (_, stderr)) in unreadable().into_iter().zip(unreadable()) {
        let results = Results::new();
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_harness"));
        command.arg("--results").arg(results.path()).args(RUN).stdout(stdout).stderr(stderr);
        assert_eq!(start_command(&mut command).wait().unwrap().code(), Some(0), "{what}");
        assert_same(results.path(), &UNDISTURBED);
        assert_whole(results.path(), true);
    }
}

/// A shell closes the streams like this with `>&- 2>&-`.
#[test]
fn a_run_goes_on_without_any_standard_output_and_error() {
    let results = Results::new();
    let mut command = std::process::Command::new("sh");
    command.args(["-c", "exec \"$@\" >&- 2>&-", "sh", env!("CARGO_BIN_EXE_harness"), "--results"]);
    command.arg(results.path()).args(RUN);
    assert_eq!(start_command(&mut command).wait().unwrap().code(), Some(0));
    assert_same(results.path(), &UNDISTURBED);
}

#[test]
fn a_full_standard_output_is_a_warning_where_something_was_done() {
    let results = Results::new();
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_harness"));
    command.arg("--results").arg(results.path()).args(COLLECTION);
    let [(_, full), _] = unreadable();
    let answer = end(start_command(command.stdout(full).stderr(Stdio::piped())));
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    let warning = "warning: the standard output can't be written: No space left on device";
    assert!(answer.stderr.lines().last().unwrap().starts_with(warning), "{}", answer.stderr);
}

#[test]
fn a_collection_that_is_asked_to_stop_keeps_its_episodes() {
    let episodes =
        |results: &Path| files(results).iter().filter(|path| name(path).starts_with("episode_")).count();
    let (results, answer) = stopped(&COLLECTION, libc::SIGTERM, |results| episodes(results) > 0);
    assert_eq!(answer.code, 143, "{}", answer.stderr);
    assert!(answer.stderr.contains("stopped by SIGTERM"), "{}", answer.stderr);
    let made = episodes(results.path());
    assert!(made < 40);
    assert_whole(results.path(), true);
    let said = succeed(results.path(), &COLLECTION);
    assert!(said.contains(&format!("{} episodes made", 40 - made)), "{said}");
}

/// Makes a dataset and locks it, so that commands that need it wait until the lock is dropped.
fn hold_dataset(results: &Path, collection: &[&str]) -> FolderLock {
    succeed(results, collection);
    let lock = files(results).into_iter().find(|path| name(path) == LOCK).unwrap();
    FolderLock::attempt(lock.parent().unwrap()).unwrap().expect("nobody else is here")
}

#[test]
fn a_second_interrupt_ends_the_process_at_once() {
    let results = Results::new();
    let _held = hold_dataset(results.path(), &COLLECTION);
    // While it waits, it checks every 100 ms whether it should stop. A busy machine takes both signals for one if they
    // come too soon after each other.
    let at_once = (0..100).any(|attempt| {
        let mut child = start(results.path(), &COLLECTION);
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        assert!(lines.next().unwrap().unwrap().starts_with("waiting for process "));
        signal(&child, libc::SIGINT);
        std::thread::sleep(Duration::from_millis(10 + attempt % 80));
        signal(&child, libc::SIGINT);
        let rest: Vec<String> = lines.map(Result::unwrap).collect();
        assert_eq!(child.wait().unwrap().code(), Some(130));
        // A process that handled the first signal prints how to continue. A process that was ended prints nothing.
        rest.is_empty()
    });
    assert!(at_once);
}

// --- at the same time ---

#[test]
fn a_run_that_another_process_works_on_is_planned_as_running() {
    let results = smoke_run("running");
    let folder = std::fs::read_dir(results.join("runs/smoke")).unwrap();
    let folder =
        folder.map(|entry| entry.unwrap().path()).find(|path| name(path).starts_with("empty")).unwrap();
    std::fs::remove_file(folder.join("run.json")).unwrap();
    let plan = |what: &str| {
        let plan = succeed(&results, &["run", SMOKE, "--dry-run"]);
        assert!(plan.lines().any(|line| line.starts_with("skip    cluttered")), "{plan}");
        let line = plan.lines().find(|line| line.contains("empty-z4")).unwrap().to_owned();
        assert!(line.starts_with(what), "{line}");
        line
    };
    let held = FolderLock::attempt(&folder).unwrap().expect("nobody else is here");
    assert!(FolderLock::attempt(&folder).unwrap().is_none(), "it is held");
    let line = plan("running ");
    assert!(line.contains(&format!("process {} on ", std::process::id())), "{line}");
    drop(held);
    plan("run ");
}

#[test]
fn two_processes_divide_an_experiment() {
    let together = Results::new();
    // Both wait for the dataset, so that none is done before the other has begun.
    let held = hold_dataset(together.path(), &["collect", SMOKE, "scenarios=[empty]"]);
    let mut children = [(); 2].map(|()| start(together.path(), &TWELVE));
    assert!(children.iter_mut().all(is_waiting), "both wait");
    drop(held);
    let answers = children.map(end);
    let summaries = answers.each_ref().map(counts);
    for (answer, [done, before, failed]) in answers.iter().zip(summaries) {
        assert_eq!((answer.code, done + before, failed), (0, 12, 0), "{}", answer.stderr);
        assert!(done > 0, "each had its part: {summaries:?}");
    }
    assert_eq!(summaries[0][0] + summaries[1][0], 12, "each run was done once: {summaries:?}");
    assert_same(together.path(), &ALONE);
    assert_whole(together.path(), true);
}

#[test]
fn the_work_of_a_killed_process_is_taken_over() {
    let together = Results::new();
    let mut first = start(together.path(), &TWELVE);
    let begun = || files(together.path()).iter().any(|path| name(path) == "run.json");
    wait_until(&mut first, "a run that has begun", begun);
    // It keeps what it works on, until the other has done all the rest.
    signal(&first, libc::SIGSTOP);
    let mut second = start(together.path(), &TWELVE);
    is_waiting(&mut second);
    first.kill().unwrap();
    first.wait().unwrap();
    let answer = end(second);
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    let [done, before, failed] = counts(&answer);
    assert_eq!((done + before, failed), (12, 0));
    assert_same(together.path(), &ALONE);
    assert_whole(together.path(), true);
}

#[test]
fn jobs_side_by_side_give_the_same_numbers() {
    for jobs in ["2", "3"] {
        let results = Results::new();
        let answer = run(results.path(), &[&TWELVE[..], &["--jobs", jobs]].concat());
        assert_eq!((answer.code, counts(&answer)), (0, [12, 0, 0]), "{}", answer.stderr);
        // Every line of progress names its run.
        let trained = answer.stderr.lines().filter(|line| line.contains(" prediction: 24 epochs in "));
        assert_eq!(trained.filter(|line| line.contains("-z")).count(), 12, "{}", answer.stderr);
        assert_same(results.path(), &ALONE);
        assert_whole(results.path(), true);
    }
}

// --- limits ---

#[test]
fn a_loss_that_is_not_finite_fails_the_run_with_its_reason() {
    let results = Results::new();
    let arguments = [&["run", SMOKE], &FAILING[..]].concat();
    let answer = run(results.path(), &arguments);
    assert_eq!((answer.code, counts(&answer)), (1, [0, 0, 2]), "{}", answer.stderr);
    for (status, reason) in statuses(results.path()) {
        assert_eq!(status, "failed");
        assert!(reason.contains("no longer finite") && reason.contains("learning_rate"), "{reason}");
    }
    let plan = succeed(results.path(), &[&arguments[..], &["--dry-run"]].concat());
    let mut runs = plan.lines().take(2);
    assert!(runs.all(|line| line.starts_with("run ") && line.contains("it failed before: ")), "{plan}");
}

#[test]
fn a_scenario_that_diverges_fails_and_the_other_goes_on() {
    let (results, models) = (Results::new(), Results::new());
    let heavy = include_str!("../models/empty.xml")
        .replace("timestep=\"0.001\"", "timestep=\"0.001\" gravity=\"0 0 -1e30\"");
    std::fs::write(models.path().join("heavy.xml"), heavy).unwrap();
    let path = models.path().join("heavy.yaml");
    let world = include_str!("../models/empty.yaml").replace("empty.xml", "heavy.xml");
    std::fs::write(&path, world).unwrap();
    let scenarios = format!("scenarios=[cluttered, {}]", path.display());
    let arguments = ["run", SMOKE, "seeds=[0,1]", &scenarios];
    let answer = run(results.path(), &arguments);
    assert_eq!((answer.code, counts(&answer)), (1, [2, 0, 2]), "{}", answer.stderr);
    let statuses = statuses(results.path());
    assert!(statuses[..2].iter().all(|(status, _)| status == "done"), "{statuses:?}");
    for (status, reason) in &statuses[2..] {
        assert!(status == "failed" && reason.contains("diverged"), "{reason}");
    }
    assert_whole(results.path(), true);
}

#[test]
fn a_dataset_larger_than_memory_is_refused_before_collection() {
    let results = Results::new();
    let size = ["simulation.episodes=100000", "simulation.actuations_per_episode=100"];
    let answer = run_within(12_000_000, results.path(), &[&["run", SMOKE], &size[..]].concat());
    assert_eq!((answer.code, counts(&answer)), (1, [0, 0, 2]), "{}", answer.stderr);
    for (status, reason) in statuses(results.path()) {
        // 10^8 samples have 166 numbers each, and 48 more with boxes. The limit is 12 GB, however much the machine has.
        let takes = if reason.contains("cluttered-") { 85.6 } else { 66.4 };
        assert!(
            status == "failed" && reason.contains(&format!(" takes {takes} GB of memory and only ")),
            "{reason}"
        );
    }
}

/// The limit is 12 GB, and 24 copies of 336 million parameters of 4 bytes take more.
#[test]
fn a_network_larger_than_memory_fails_its_run_and_others_go_on() {
    let results = Results::new();
    let networks = ["latent=4096", "vary={network.hidden: [16, 16384]}", "training.epochs=1"];
    let command = [&["run", SMOKE, "scenarios=empty"], &networks[..]].concat();
    let answer = run_within(12_000_000, results.path(), &command);
    assert_eq!((answer.code, counts(&answer)), (1, [1, 0, 1]), "{}", answer.stderr);
    let statuses = statuses(results.path());
    let (status, reason) = statuses.iter().find(|(status, _)| status != "done").unwrap();
    assert_eq!(status, "failed");
    assert!(
        reason.starts_with("the network takes up to 32.3 GB") && reason.contains("lower network.hidden"),
        "{reason}"
    );
}

/// A training takes up to 1.6 GB. The limit is 4.2 GB, of which the program itself takes 1.8 GB.
#[test]
fn trainings_that_have_no_room_side_by_side_wait_for_each_other() {
    let results = Results::new();
    let two = ["network.hidden=2048", "seeds=[0,1]", "training.epochs=1", "--jobs", "2"];
    let command = [&["run", SMOKE, "scenarios=empty"], &two[..]].concat();
    let answer = run_within(4_100_000, results.path(), &command);
    assert_eq!((answer.code, counts(&answer)), (0, [2, 0, 0]), "{}", answer.stderr);
}

#[test]
fn a_run_whose_folder_is_not_writable_fails_and_others_go_on() {
    let results = Results::new();
    let plan = succeed(results.path(), &["run", SMOKE, "--dry-run"]);
    let id = plan.split_whitespace().find(|word| word.starts_with("empty-")).unwrap();
    let folder = results.path().join("runs/smoke");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join(id), "no folder").unwrap();
    let answer = run(results.path(), &["run", SMOKE]);
    assert_eq!((answer.code, counts(&answer)), (1, [1, 0, 1]), "{}", answer.stderr);
    assert!(answer.stderr.contains(&format!("{id} failed: can't lock ")), "{}", answer.stderr);
}

#[test]
fn a_full_disk_fails_what_it_must_and_leaves_nothing_half_done() {
    let undisturbed = Results::new();
    let command = [&RUN[..3], &["training.epochs=4", "training.patience=null"]].concat();
    succeed(undisturbed.path(), &command);
    let all: u64 = files(undisturbed.path()).iter().map(|path| path.metadata().unwrap().len()).sum();
    let all = all as usize / 1024;
    // The sizes range from too small for the first episode to too small for the last table.
    for kilobytes in [16, all / 8, all / 4, all / 2, all - 100] {
        let Some(disk) = Disk::new(kilobytes) else {
            println!("skipped: no small disk can be mounted here");
            return;
        };
        let answer = run(disk.path(), &command);
        assert_eq!((answer.code, counts(&answer)), (1, [0, 0, 1]), "{kilobytes} KB: {}", answer.stderr);
        assert!(answer.stderr.contains("No space left on device"), "{kilobytes} KB: {}", answer.stderr);
        for path in files(disk.path()) {
            assert!(
                name(&path) == LOCK || !name(&path).starts_with(UNFINISHED),
                "{} is left",
                path.display()
            );
        }
        assert_whole(disk.path(), false);
        disk.remount("size=64m");
        succeed(disk.path(), &command);
        assert_same(disk.path(), undisturbed.path());
        assert_whole(disk.path(), true);
    }
}

#[test]
fn a_disk_that_cannot_be_written_is_named_and_nothing_is_tried() {
    let Some(disk) = Disk::new(64) else {
        println!("skipped: no small disk can be mounted here");
        return;
    };
    disk.remount("ro");
    for command in ["run", "collect"] {
        let answer = run(disk.path(), &[command, SMOKE]);
        assert_eq!(answer.code, 1);
        let expected = format!("error: can't write {}: Read-only file system", disk.path().display());
        assert!(answer.stderr.starts_with(&expected), "{}", answer.stderr);
        assert_eq!(answer.stderr.lines().count(), 1);
    }
}
