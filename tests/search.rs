//! Searches: the runs of their trials, successive halving, interruptions, shares, and the best trial.

use crate::common::{Answer, finish, harness};
use crate::interruption::{
    Results, assert_same, assert_whole, counts, end, kill_after, run, signal, start, succeed,
};
use crate::terminal::{plain, raw, too_wide};
use harness::registry::{Registry, Status};
use rand::{RngExt, SeedableRng};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// A search of 64 trials of milliseconds: 64 to epoch 1, 16 to epoch 4, and 4 to epoch 6.
const SPEC: &str = "\
name: tiny
scenarios: [empty]
input: [proprioception]
output: [proprioception, contact_force]
latent: [2]
network: {preset: single_to_multi}
simulation: {episodes: 4, actuations_per_episode: 2}
training: {epochs: 6, batch_size: 8, patience: null}
search:
  method: sobol
  trials: 64
  space:
    network.hidden: {choice: [[4], [8]]}
    training.learning_rate: {log_uniform: [0.0001, 0.1]}
  objective: {term: contact_force}
";
const HALVING: &str = "  halving: {eta: 4, min_epochs: 1}\n";

/// A folder with a spec and its results.
struct Case {
    folder: Results,
    results: PathBuf,
    spec: String,
}

impl Case {
    fn new(text: &str) -> Self {
        let folder = Results::new();
        let spec = folder.path().join("tiny.yaml");
        std::fs::write(&spec, text).unwrap();
        Self { results: folder.path().join("results"), spec: spec.to_str().unwrap().to_owned(), folder }
    }

    fn halving() -> Self {
        Self::new(&format!("{SPEC}{HALVING}"))
    }

    fn path(&self) -> &Path {
        &self.results
    }

    fn command<'a>(&'a self, more: &[&'a str]) -> Vec<&'a str> {
        [&["run", self.spec.as_str()], more].concat()
    }

    #[track_caller]
    fn run(&self, more: &[&str]) -> Answer {
        let answer = run(self.path(), &self.command(more));
        assert_eq!(answer.code, 0, "{}{}", answer.stdout, answer.stderr);
        answer
    }

    /// The epochs for which each trial has been trained; every run is done.
    fn epochs(&self) -> BTreeMap<usize, usize> {
        let records = Registry::new(self.path()).records();
        let mut epochs = BTreeMap::new();
        for record in &records {
            assert_eq!(record.status, Status::Done);
            let training = &record.spec.trained().unwrap().training;
            let trained = training.last_epoch.unwrap_or(training.epochs);
            assert_eq!(epochs.insert(record.spec.trial().unwrap(), trained), None, "each trial counts once");
        }
        epochs
    }

    /// The validation loss of each trial's contact force after an epoch.
    fn losses(&self, epoch: usize) -> BTreeMap<usize, f64> {
        let path = self.folder.path().join("losses.json");
        let query = format!(
            "select variant, value from epochs where task = 'prediction' and split = 'validation' and \
             term = 'contact_force' and epoch = {epoch}"
        );
        succeed(self.path(), &["query", &query, "--output", path.to_str().unwrap()]);
        let rows: Vec<Value> = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
        let number = |variant: &str| variant["trial=".len()..][..4].parse().unwrap();
        rows.iter()
            .map(|row| (number(row["variant"].as_str().unwrap()), row["value"].as_f64().unwrap()))
            .collect()
    }
}

/// The trials with the lowest losses.
fn lowest(losses: &BTreeMap<usize, f64>, among: &BTreeSet<usize>, count: usize) -> BTreeSet<usize> {
    let mut trials: Vec<usize> = among.iter().copied().collect();
    trials.sort_by(|a, b| losses[a].total_cmp(&losses[b]));
    trials.into_iter().take(count).collect()
}

/// The lines that name the best trial, without the path of the results folder.
fn best(answer: &Answer) -> Vec<&str> {
    answer.stdout.lines().skip_while(|line| !line.starts_with("best run ")).take(2).collect()
}

#[test]
fn halving_trains_the_best_trials_on_as_if_trained_at_once() {
    let case = Case::halving();
    let answer = case.run(&[]);
    assert_eq!(counts(&answer), [64, 0, 0]);
    assert!(answer.stdout.contains("20 continued after a comparison"), "{}", answer.stdout);
    assert_whole(case.path(), true);
    let epochs = case.epochs();
    let longer_than = |epoch: usize| -> BTreeSet<usize> {
        epochs.iter().filter(|(_, trained)| **trained > epoch).map(|(trial, _)| *trial).collect()
    };
    assert_eq!(epochs.keys().copied().collect::<Vec<_>>(), (0..64).collect::<Vec<_>>());
    // Each rung has the trials with the lowest losses of the rung before.
    assert_eq!(longer_than(1), lowest(&case.losses(1), &longer_than(0), 16));
    assert_eq!(longer_than(4), lowest(&case.losses(4), &longer_than(1), 4));
    let winner = lowest(&case.losses(6), &longer_than(4), 1).into_iter().next().unwrap();
    let lines = best(&answer);
    let start = format!("best run   empty-z2-trial={winner:04} (lowest validation loss of contact_force, ");
    assert!(lines[0].starts_with(&start) && lines[0].ends_with(", of 64 trials)"), "{lines:?}");

    // The search without halving trains all trials to the end. The runs that both have are equal.
    let whole = Case::new(SPEC);
    whole.run(&[]);
    let folders = |results: &Path| -> BTreeSet<PathBuf> {
        let entries = std::fs::read_dir(results.join("runs/tiny")).unwrap();
        entries.map(|entry| entry.unwrap().file_name().into()).collect()
    };
    let (some, all) = (folders(case.path()), folders(whole.path()));
    let both: Vec<&PathBuf> = some.intersection(&all).collect();
    assert_eq!((all.len(), both.len()), (64, 4));
    for run in both {
        for file in
            ["prediction.safetensors", "reconstruction.safetensors", "predictions.parquet", "metrics.parquet"]
        {
            let read =
                |case: &Case| std::fs::read(case.path().join("runs/tiny").join(run).join(file)).unwrap();
            assert!(read(&case) == read(&whole), "{}/{file} differs", run.display());
        }
    }

    // Nothing is done twice.
    let again = case.run(&["--jobs", "2"]);
    assert_eq!(counts(&again), [0, 64, 0]);
    assert_eq!(best(&again), lines);
}

/// Kills a search at random moments, with SIGKILL or SIGTERM, and starts it again each time.
fn killed(text: &str, kills: usize, seed: u64) {
    let undisturbed = Case::new(text);
    let begin = Instant::now();
    let expected = undisturbed.run(&[]);
    let whole = begin.elapsed();
    let case = Case::new(text);
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    for _ in 0..kills {
        // Starting takes part of the time.
        let delay = whole.mul_f64(0.1 + random.random::<f64>() * 0.5);
        let jobs = ["1", "2"][random.random_range(0..2)];
        let mut child = start(case.path(), &case.command(&["--jobs", jobs]));
        if random.random() {
            kill_after(child, delay);
        } else {
            std::thread::sleep(delay);
            if child.try_wait().unwrap().is_none() {
                signal(&child, libc::SIGTERM);
            }
            let ended = child.wait_with_output().unwrap();
            // Before the program listens to the signal, it is killed by it.
            let (code, signal) = (ended.status.code(), ended.status.signal());
            let said = String::from_utf8_lossy(&ended.stderr);
            assert!(
                [Some(0), Some(143)].contains(&code) || signal == Some(libc::SIGTERM),
                "{code:?}: {said}"
            );
            assert!(!said.contains("panicked"), "{said}");
        }
        assert_whole(case.path(), false);
    }
    let answer = case.run(&[]);
    assert_eq!(best(&answer), best(&expected));
    assert_eq!(case.epochs(), undisturbed.epochs());
    assert_same(case.path(), undisturbed.path());
    assert_whole(case.path(), true);
}

#[test]
fn a_search_killed_a_few_times_ends_as_one_undisturbed() {
    killed(&SPEC.replace("trials: 64", "trials: 16"), 3, 1);
}

#[test]
fn a_halving_killed_a_few_times_ends_as_one_undisturbed() {
    killed(&format!("{SPEC}{HALVING}"), 4, 2);
}

#[test]
#[ignore = "takes minutes: make soak"]
fn searches_killed_at_60_moments_end_as_those_undisturbed() {
    for seed in 0..6 {
        killed(SPEC, 4, seed);
        killed(&format!("{SPEC}{HALVING}"), 6, seed);
    }
}

#[test]
fn shares_of_a_halving_wait_and_do_what_the_others_leave() {
    let text = format!("{SPEC}{HALVING}").replace("trials: 64", "trials: 16");
    let undisturbed = Case::new(&text);
    undisturbed.run(&[]);
    let case = Case::new(&text);
    // A share that does not wait ends before the comparison.
    let first = case.run(&["--shard", "1/3", "--no-wait"]);
    assert_eq!(counts(&first), [6, 0, 0]);
    let left = "10 are left to other shares; when they are done, the same command continues the best trials";
    assert!(first.stdout.lines().any(|line| line == left), "{}", first.stdout);
    assert_eq!(case.epochs().values().collect::<BTreeSet<_>>(), [&1].into());
    // Two that wait do the rest together, and the share of the one that is not there.
    let others = ["1/3", "2/3"].map(|shard| start(case.path(), &case.command(&["--shard", shard])));
    for answer in others.map(end) {
        assert_eq!(answer.code, 0, "{}", answer.stderr);
    }
    assert_eq!(case.epochs(), undisturbed.epochs());
    assert_same(case.path(), undisturbed.path());
    assert_whole(case.path(), true);
}

#[test]
fn a_diverging_trial_is_the_worst_and_is_not_tried_again() {
    let text = format!("{SPEC}{HALVING}")
        .replace("{log_uniform: [0.0001, 0.1]}", "{choice: [0.001, 1]}")
        .replace("trials: 64", "trials: 8")
        .replace("epochs: 6,", "epochs: 60, kl_weight: 1000000,")
        .replace("min_epochs: 1", "min_epochs: 30");
    let case = Case::new(&text);
    let answer = case.run(&[]);
    assert!(answer.stdout.contains("\n4 diverged: "), "{}{}", answer.stdout, answer.stderr);
    assert_eq!(counts(&answer), [4, 0, 0]);
    assert!(answer.stdout.contains("\n2 continued after a comparison of trials\n"), "{}", answer.stdout);
    assert!(best(&answer)[0].ends_with(", of 8 trials)"), "{:?}", best(&answer));
    let plan = succeed(case.path(), &case.command(&["--dry-run"]));
    let failed = plan.lines().filter(|line| line.starts_with("failed "));
    assert_eq!(failed.filter(|line| line.contains("learning_rate=1") && line.contains("finite")).count(), 4);
    let again = case.run(&[]);
    assert_eq!(counts(&again), [0, 4, 0]);
    assert_eq!(best(&again), best(&answer));
}

#[test]
fn the_plan_of_a_search_shows_each_trial_and_the_rungs() {
    let case = Case::halving();
    let plan = succeed(case.path(), &case.command(&["search.trials=5", "--dry-run"]));
    let trials: Vec<&str> = plan.lines().filter(|line| line.starts_with("run ")).collect();
    assert_eq!(trials.len(), 5);
    for (number, line) in trials.iter().enumerate() {
        assert!(line.contains(&format!("empty-z2-trial={number:04}-seed0-")), "{line}");
        assert!(
            line.contains(" hidden=") && line.contains(" learning_rate=0.") && line.ends_with(": new"),
            "{line}"
        );
    }
    let rungs =
        "successive halving trains trials: 5 to epoch 1, the best 1 to epoch 4, the best 1 to epoch 6";
    assert!(plan.lines().any(|line| line == rungs), "{plan}");
    assert!(!case.path().join("runs").exists());
}

#[test]
fn the_commands_after_a_search_work() {
    let case = Case::new(&SPEC.replace("trials: 64", "trials: 4"));
    let answer = case.run(&[]);
    let settings = best(&answer)[1].trim();
    for (label, expected) in [("retrain    ", "1 done, 0 done before, 0 failed"), ("next       ", settings)] {
        let command = answer.stdout.lines().find_map(|line| line.strip_prefix(label)).unwrap();
        let words = shlex::split(command).unwrap();
        assert_eq!((words[0].as_str(), words[1].as_str()), ("harness", "--results"));
        let arguments: Vec<&str> = words[3..].iter().map(String::as_str).collect();
        let said = finish(&mut harness(Path::new(&words[2]), &arguments));
        assert_eq!(said.code, 0, "{command}: {}", said.stderr);
        let said = said.stdout;
        assert!(said.contains(expected) || said.replace(", ", " ").contains(expected), "{command}: {said}");
    }
    // The run of the command has the drawn settings, and is no trial.
    let records = Registry::new(case.path()).records();
    let alone: Vec<_> = records.iter().filter(|record| record.spec.trial().is_none()).collect();
    assert_eq!(alone.len(), 1);
    let same = records
        .iter()
        .filter(|record| record.spec.trial().is_some() && record.spec.model == alone[0].spec.model);
    assert_eq!(same.count(), 1);
}

#[test]
fn the_command_to_retrain_a_best_trial_has_the_varied_settings() {
    let text = SPEC
        .replace("trials: 64", "trials: 2")
        .replace("search:", "vary: {training.kl_weight: [0, 0.01]}\nsearch:");
    let case = Case::new(&text);
    let answer = case.run(&[]);
    let commands: Vec<&str> =
        answer.stdout.lines().filter_map(|line| line.strip_prefix("retrain    ")).collect();
    assert_eq!(commands.len(), 2, "{}", answer.stdout);
    for (command, weight) in commands.iter().zip(["=0'", "=0.01'"]) {
        assert!(command.contains(&format!("training.kl_weight{weight}")), "{command}");
        let words = shlex::split(command).unwrap();
        let arguments: Vec<&str> = words[3..].iter().map(String::as_str).chain(["--dry-run"]).collect();
        let plan = succeed(case.path(), &arguments);
        assert_eq!(plan.lines().filter(|line| line.starts_with("run ")).count(), 1, "{plan}");
    }
}

#[test]
fn a_comparison_of_trials_fits_and_says_how_far_each_trained() {
    let case = Case::new(&format!("{SPEC}{HALVING}").replace("trials: 64", "trials: 8"));
    case.run(&[]);
    for width in [60, 80, 120] {
        for arguments in [&["compare", "tiny"][..], &["compare", "tiny", "--by", "variant"]] {
            let mut compare = std::process::Command::new(env!("CARGO_BIN_EXE_harness"));
            let said = plain(&raw(compare.arg("--results").arg(case.path()).args(arguments), width));
            assert!(too_wide(&said, width).is_empty(), "{arguments:?} at {width}: {said}");
            assert!(said.contains("trained to epoch 1") && said.contains("trained to the end"), "{said}");
            assert!(!said.contains("last_epoch") && !said.contains("tasks="), "{said}");
            // The settings of each trial are listed once, below the tables.
            assert_eq!(said.matches(" hidden=").count(), 8, "{said}");
            // All trials have the same baselines, which are columns of their own.
            assert!(!said.contains("persistence, trial"), "{said}");
        }
    }
}

#[test]
fn trials_with_one_number_and_other_settings_are_told_apart() {
    let spec = SPEC.replace("trials: 64", "trials: 2");
    let case = Case::new(&spec);
    case.run(&[]);
    let compare = || run(case.path(), &["compare", "tiny", "--metrics", "r2", "--models", "network"]).stdout;
    let once = compare();
    assert!(!once.contains("trial=0000, hidden=") && once.contains("\ntrial=0000  hidden="), "{once}");
    std::fs::write(&case.spec, spec.replace("[0.0001, 0.1]", "[0.001, 0.2]")).unwrap();
    case.run(&[]);
    let twice = compare();
    let records = Registry::new(case.path()).records();
    assert_eq!(records.len(), 4);
    for record in records {
        let (_, number, settings) = record.spec.variant_parts();
        let trial = format!("trial={}, {}", number.unwrap(), settings.replace(',', ", "));
        // The prediction and the reconstruction have a table of each trial.
        assert_eq!(twice.matches(&trial).count(), 2, "{trial} in {twice}");
    }
}

/// tests/python_package/test_documentation.py runs the commands.
#[test]
fn the_search_in_the_documentation_is_that_of_the_experiment() {
    let section = include_str!("../docs/experiments.md").split("\n## Searches\n").nth(1).unwrap();
    let example = section.split("```yaml\n").nth(1).unwrap().split("```").next().unwrap();
    assert!(include_str!("../experiments/search.yaml").contains(example), "{example}");
}
