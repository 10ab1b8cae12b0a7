//! The program from its users' point of view: a whole experiment, every command, and bad input.

use crate::common::{Answer, PATIENCE, SMOKE, ask, finish, harness, smoke_run, succeed};
use harness::files::UNFINISHED;
use harness::tables::read_footer;
use image::AnimationDecoder;
use polars::prelude::SerReader;
use predicates::prelude::*;
use std::collections::BTreeMap;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::LazyLock;
use std::time::{Duration, Instant};

/// Results of the smoke experiment. Tests must not change them.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| smoke_run("cli"));
/// One short run of the smoke experiment.
const ONE: [&str; 5] =
    ["run", SMOKE, "scenarios=[empty]", "training.epochs=1", "simulation.actuations_per_episode=2"];

/// A temporary folder for one test.
struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, content: &str) -> String {
        let path = self.path(name);
        std::fs::write(&path, content).unwrap();
        path.display().to_string()
    }
}

/// Every file below a folder, sorted.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() { files.extend(self::files(&path)) } else { files.push(path) }
    }
    files.sort();
    files
}

/// Checks that a folder contains no unfinished files.
#[track_caller]
fn assert_whole(folder: &Path) {
    for path in files(folder) {
        let name = path.file_name().unwrap().to_string_lossy();
        assert!(!name.starts_with(UNFINISHED) || name.ends_with("-lock"), "{} is left", path.display());
        if name.ends_with(".parquet") {
            read_footer(&path).unwrap();
        }
    }
}

fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    files(folder).into_iter().map(|path| (path.clone(), std::fs::read(path).unwrap())).collect()
}

/// The error message of a command, without `error: `. It must be a single line.
#[track_caller]
fn error(answer: &Answer, code: i32) -> String {
    assert_eq!(answer.code, code, "{}{}", answer.stdout, answer.stderr);
    let line = answer.stderr.strip_suffix('\n').and_then(|text| text.strip_prefix("error: "));
    let line = line.unwrap_or_else(|| panic!("no error alone: {}", answer.stderr));
    assert!(!line.contains('\n'), "several lines: {line}");
    assert_eq!(answer.stdout, "");
    line.to_owned()
}

/// The error of a command on the results of the smoke run.
#[track_caller]
fn refusal(arguments: &[&str], code: i32) -> String {
    error(&finish(&mut harness(&RESULTS, arguments)), code)
}

// --- an experiment ---

#[test]
fn an_experiment_writes_everything_and_its_second_run_nothing() {
    let runs = std::fs::read_dir(RESULTS.join("runs/smoke")).unwrap();
    let runs: Vec<PathBuf> = runs.map(|entry| entry.unwrap().path()).collect();
    assert_eq!(runs.len(), 2);
    for run in &runs {
        let names = files(run).iter().map(|path| path.file_name().unwrap().to_owned()).collect::<Vec<_>>();
        let expected = [
            "epochs.parquet",
            "forces.parquet",
            "frames.parquet",
            "metrics.parquet",
            "prediction.safetensors",
            "predictions.parquet",
            "reconstruction.safetensors",
            "run.json",
            "spec.yaml",
        ];
        for name in expected {
            assert!(names.iter().any(|found| found == name), "{} lacks {name}", run.display());
        }
        assert!(!names.iter().any(|name| name.to_string_lossy().contains(".state.")), "{names:?}");
    }
    assert_whole(&RESULTS);

    let before = contents(&RESULTS);
    let said = succeed(&RESULTS, &["run", SMOKE]);
    assert!(said.contains("0 done, 2 done before, 0 failed"), "{said}");
    assert!(said.contains("persistence") && said.contains("relative error ↓"), "the results: {said}");
    assert!(contents(&RESULTS) == before, "nothing was written");
}

#[test]
fn a_dry_run_says_what_would_be_done_and_why_and_does_nothing() {
    let before = contents(&RESULTS);
    let done = succeed(&RESULTS, &["run", SMOKE, "--dry-run"]);
    let skip = predicate::str::is_match(r"(?m)^skip +empty-z4-seed0-[0-9a-f]{8} +it is done$").unwrap();
    assert!(skip.eval(&done), "{done}");
    let own = predicate::str::is_match(r"(?m)^  training.epochs = 2 +\S+smoke.yaml:21$").unwrap();
    assert!(own.eval(&done) && !done.contains("training.dropout"), "{done}");
    let all = succeed(&RESULTS, &["run", SMOKE, "--dry-run=all", "training.epochs=2"]);
    let lines = predicate::str::is_match(
        r"(?m)^  training.epochs = 2 +override\n(.*\n)*  training.dropout = 0.0 +default$",
    );
    assert!(lines.unwrap().eval(&all), "{all}");
    let changed = succeed(&RESULTS, &["run", SMOKE, "--dry-run", "training.epochs=3", "latent=[4,5]"]);
    let line = |run: &str| changed.lines().find(|line| line.contains(run)).unwrap().to_owned();
    assert!(line("cluttered-z4").starts_with("run "), "{changed}");
    assert!(line("cluttered-z4").ends_with("differs in training.epochs (2, now 3)"), "{changed}");
    assert!(line("cluttered-z5").ends_with(" new"), "{changed}");
    assert!(contents(&RESULTS) == before);

    let nowhere = Folder::new().path("results");
    succeed(&nowhere, &["run", SMOKE, "--dry-run"]);
    assert!(!nowhere.exists());
}

/// The runs of a dry run, without their hashes.
fn planned(more: &[&str]) -> Vec<String> {
    let plan = succeed(&RESULTS, &[&["run", SMOKE, "--dry-run", "latent=[4,5]"][..], more].concat());
    let decisions = plan.lines().filter(|line| line.starts_with("run ") || line.starts_with("skip "));
    let id = |line: &str| line.split_whitespace().nth(1).unwrap().rsplit_once('-').unwrap().0.to_owned();
    decisions.map(id).collect()
}

#[test]
fn run_does_the_runs_that_have_the_chosen_settings() {
    let all = ["empty-z4-seed0", "empty-z5-seed0", "cluttered-z4-seed0", "cluttered-z5-seed0"];
    assert_eq!(planned(&[]), all);
    assert_eq!(planned(&["--where", "scenario=empty"]), all[..2]);
    assert_eq!(planned(&["--where", "scenario=empty", "--where", "latent=5"]), all[1..2]);
    assert_eq!(planned(&["--where", "latent=4", "--where", "latent=5"]), all);

    let refused = |spec: &str, setting: &str| {
        finish(&mut harness(&RESULTS, &["run", spec, "--dry-run", "--where", setting])).stderr
    };
    assert_eq!(
        refused(SMOKE, "scenario=emty"),
        "error: no planned run has scenario=emty; planned runs have scenario (cluttered, empty)\n"
    );
    assert_eq!(refused(SMOKE, "latnt=4"), "error: no run has a setting 'latnt'; did you mean 'latent'?\n");
    assert!(refused("experiments/search.yaml", "latent=4").contains("trials of a search"));
}

/// The layers of the smoke run, calculated by hand: 4 x 4 kernels from 3 to 4 channels and back, 16 hidden units,
/// 20 joints and 20 links, a latent state of 4, an action of 3.
const LAYERS: [(&str, &str, usize); 11] = [
    ("encoder.conv", "4 x 32 x 32", 4 * 3 * 16 + 4),
    ("encoder.hidden", "16", 16 * (4 * 32 * 32 + 20) + 16),
    ("encoder.posterior", "8", 8 * 16 + 8),
    ("decoder.hidden", "16", 16 * (4 + 3) + 16),
    ("decoder.vector", "40", 40 * 16 + 40),
    ("decoder.frame", "4096", 4096 * 16 + 4096),
    ("decoder.conv", "3 x 64 x 64", 3 * 4 * 16 + 3),
    ("reconstruction.hidden", "16", 16 * 4 + 16),
    ("reconstruction.vector", "20", 20 * 16 + 20),
    ("reconstruction.frame", "4096", 4096 * 16 + 4096),
    ("reconstruction.conv", "3 x 64 x 64", 3 * 4 * 16 + 3),
];

#[test]
fn every_layer_is_printed_with_its_shape_and_its_parameters() {
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let sum = |part: &str| -> usize {
        LAYERS.iter().filter(|(name, ..)| name.starts_with(part)).map(|(.., parameters)| parameters).sum()
    };
    let mut expected: Vec<String> =
        LAYERS.iter().map(|(name, output, parameters)| format!("{name} {output} {parameters}")).collect();
    let trained = sum("encoder.") + sum("decoder.");
    expected.push(format!("prediction in all {trained}"));
    expected.push(format!("reconstruction in all {}", sum("reconstruction.")));
    for printed in [["show", "cluttered", "--all"].as_slice(), &["run", SMOKE, "--dry-run"]] {
        let printed = succeed(&RESULTS, printed);
        let lines: Vec<String> = printed.lines().map(words).collect();
        for line in &expected {
            assert_eq!(lines.iter().filter(|printed| *printed == line).count(), 1, "{line} in {printed}");
        }
    }
    let parameters = succeed(&RESULTS, &["query", "select distinct parameters from runs"]);
    assert!(words(&parameters).contains(&trained.to_string()), "{parameters}");
    // Each different network is printed once, with the runs that train it.
    let plan = succeed(&RESULTS, &["run", SMOKE, "--dry-run", "latent=[4,5]"]);
    let blocks: Vec<&str> = plan.lines().filter(|line| line.starts_with("the network of ")).collect();
    assert_eq!(blocks.len(), 2, "{plan}");
    assert!(blocks[0].contains("empty-z4-seed0-") && blocks[0].ends_with(" and 1 more:"), "{plan}");
    assert!(blocks[1].contains("empty-z5-seed0-") && blocks[1].ends_with(" and 1 more:"), "{plan}");
}

#[test]
fn a_run_gives_the_same_tables_whatever_the_threads() {
    let with_memory = ["window.context=6", "window.horizon=2", "window.start=rest"];
    for (memory, settings) in [("none", &[][..]), ("gru", &with_memory), ("rssm", &with_memory)] {
        let folder = Folder::new();
        let memory = format!("network.memory={memory}");
        let networks = ["1", "2"].map(|threads| {
            let results = folder.path(threads);
            succeed(&results, &[&ONE[..], &[&memory, "--threads", threads], settings].concat());
            let query =
                "select task, model, modality, direction, index, metric, horizon, value from all_metrics";
            let metrics = folder.path("metrics.csv");
            succeed(&results, &["query", query, "--output", metrics.to_str().unwrap()]);
            let checkpoints =
                files(&results).into_iter().filter(|path| path.ends_with("prediction.safetensors"));
            (
                std::fs::read(metrics).unwrap(),
                checkpoints.map(|path| std::fs::read(path).unwrap()).collect::<Vec<_>>(),
            )
        });
        assert_eq!(networks[0].1.len(), 1);
        assert!(networks[0] == networks[1], "{memory}");
    }
}

#[test]
fn a_damaged_episode_is_made_again_and_said_so() {
    let folder = Folder::new();
    let results = folder.path("results");
    succeed(&results, &ONE);
    let episode = files(&results).into_iter().find(|path| path.ends_with("episode_00002.parquet")).unwrap();
    let whole = std::fs::read(&episode).unwrap();
    let mut damaged = whole.clone();
    // These bytes are the pages of the first joints.
    damaged[whole.len() / 8..whole.len() / 4].fill(0xAA);
    std::fs::write(&episode, damaged).unwrap();
    let answer = finish(&mut harness(&results, &[&ONE[..], &["seeds=[1]"]].concat()));
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    let said = predicate::str::contains("episode_00002.parquet is damaged")
        .and(predicate::str::contains("collected again"));
    assert!(said.eval(&answer.stderr), "{}", answer.stderr);
    assert!(std::fs::read(&episode).unwrap() == whole);
}

/// Starts a command, and kills it as soon as `ready` returns true.
fn kill_when(mut command: std::process::Command, ready: impl Fn() -> bool) {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let begin = Instant::now();
    while !ready() {
        assert!(begin.elapsed() < PATIENCE, "it never got so far");
        assert!(child.try_wait().unwrap().is_none(), "it ended before it could be killed");
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
}

/// The program on a results folder, as a command to spawn.
fn spawnable(results: &Path, arguments: &[&str]) -> std::process::Command {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_harness"));
    command.current_dir(env!("CARGO_MANIFEST_DIR")).arg("--results").arg(results).args(arguments);
    command
}

#[test]
fn a_killed_collection_goes_on_from_the_whole_episodes_it_left() {
    let folder = Folder::new();
    let results = folder.path("results");
    let collect = ["collect", SMOKE, "scenarios=[empty]", "simulation.episodes=40", "--threads", "1"];
    let episodes =
        || files(&results).into_iter().filter(|path| path.extension().is_some_and(|end| end == "parquet"));
    kill_when(spawnable(&results, &collect), || episodes().count() >= 2);
    let made = episodes().count();
    assert!((2..40).contains(&made));
    let said = succeed(&results, &collect);
    assert!(said.contains(&format!("{} episodes made, 1200 samples in all", 40 - made)), "{said}");
    // The smoke run collected the first four episodes of the same dataset without an interruption.
    for episode in episodes().take(4) {
        let undisturbed = RESULTS.join(episode.strip_prefix(&results).unwrap());
        assert!(
            std::fs::read(&episode).unwrap() == std::fs::read(undisturbed).unwrap(),
            "{}",
            episode.display()
        );
    }
}

#[test]
fn a_record_holds_the_command_and_not_where_the_program_lies() {
    let answer = succeed(&RESULTS, &["show", "smoke/empty"]);
    assert!(answer.contains("harness --results ") && !answer.contains("/harness --results "), "{answer}");
}

#[test]
fn a_training_that_stops_early_says_after_how_many_epochs() {
    let folder = Folder::new();
    let results = folder.path("results");
    let hasty =
        ["tasks=[prediction]", "training.epochs=60", "training.patience=1", "training.learning_rate=0.03"];
    let answer = finish(&mut harness(&results, &[&ONE[..3], &hasty].concat()));
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    let csv = folder.path("epochs.csv");
    let query = "select max(epoch) as epochs from epochs";
    succeed(&results, &["query", query, "--output", csv.to_str().unwrap()]);
    let epochs = std::fs::read_to_string(csv).unwrap();
    let epochs = epochs.lines().last().unwrap();
    assert_ne!(epochs, "60");
    assert!(
        answer.stderr.contains(&format!("prediction: {epochs} epochs in ")),
        "{epochs}: {}",
        answer.stderr
    );
}

#[test]
fn a_killed_run_is_listed_as_interrupted_and_planned_again() {
    let folder = Folder::new();
    let results = folder.path("results");
    let long = ["run", SMOKE, "scenarios=[empty]", "training.epochs=100000", "training.patience=null"];
    let begun = || files(&results).iter().any(|path| path.ends_with("run.json"));
    kill_when(spawnable(&results, &long), begun);
    let plan = succeed(&results, &[&long[..], &["--dry-run"]].concat());
    let line = plan.lines().next().unwrap();
    assert!(line.starts_with("run ") && line.ends_with("it was interrupted"), "{plan}");
    assert!(succeed(&results, &["ls"]).contains("interrupted"));
}

// --- the other commands ---

#[test]
fn queries_print_or_write_their_answer() {
    let folder = Folder::new();
    let query = "select scenario, count(*) as samples, max(time) as last from episodes group by scenario order by \
                 scenario";
    let printed = succeed(&RESULTS, &["query", query]);
    assert!(printed.contains("cluttered      120  2.900"), "{printed}");
    for ending in ["parquet", "csv", "json", "JSON"] {
        let path = folder.path(&format!("answer.{ending}"));
        let said = succeed(&RESULTS, &["query", query, "--output", path.to_str().unwrap()]);
        assert_eq!(said, format!("2 rows in {}\n", path.display()));
    }
    let csv = std::fs::read_to_string(folder.path("answer.csv")).unwrap();
    assert!(csv.starts_with("scenario,samples,last\ncluttered,120,2.9"), "{csv}");
    let json: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.path("answer.json")).unwrap()).unwrap();
    assert_eq!(json[1]["scenario"], "empty");
    assert_eq!(json[1]["samples"], 120);
    let parquet = std::fs::File::open(folder.path("answer.parquet")).unwrap();
    assert_eq!(polars::prelude::ParquetReader::new(parquet).finish().unwrap().shape(), (2, 3));
    assert_eq!(files(folder.0.path()).len(), 4, "nothing else is left");
}

#[test]
fn rows_can_be_counted_in_every_table() {
    for table in harness::schema::Table::ALL {
        let name = table.name();
        let counted = succeed(&RESULTS, &["query", &format!("select count(*) from {name}")]);
        let grouped = succeed(&RESULTS, &["query", &format!("select count(scenario) from {name}")]);
        let number = |answer: &str| answer.chars().filter(char::is_ascii_digit).collect::<String>();
        assert!(!number(&counted).is_empty() && number(&counted) != "0", "{counted}");
        assert_eq!(number(&counted), number(&grouped), "{name}");
    }
}

#[test]
fn tables_are_found_in_folders_of_any_name() {
    let folder = Folder::new();
    let results = folder.path("my results [2*]");
    succeed(&results, &ONE);
    let count = succeed(&results, &["query", "select count(*) from episodes"]);
    assert_eq!(count.lines().last().map(str::trim), Some("80"), "{count}");
    assert!(succeed(&results, &["query", "select distinct run from metrics"]).contains("empty-z4-seed0-"));
    assert_whole(&results);
}

#[test]
fn a_results_folder_without_runs_has_empty_answers() {
    let folder = Folder::new();
    std::fs::create_dir(folder.path("runs")).unwrap();
    for table in harness::schema::Table::ALL {
        let answer = succeed(folder.0.path(), &["query", &format!("select * from {}", table.name())]);
        assert!(answer.contains("scenario"), "{answer}");
    }
    assert!(succeed(folder.0.path(), &["ls"]).contains("experiment"));
}

#[test]
fn commands_that_read_say_that_there_are_no_results() {
    let folder = Folder::new();
    let nowhere = folder.path("reslts");
    let commands: [&[&str]; 9] = [
        &["ls"],
        &["verify"],
        &["query", "select * from runs"],
        &["show", "empty"],
        &["claims"],
        &["compare"],
        &["figures"],
        &["report"],
        &["publish", "smoke"],
    ];
    for arguments in commands {
        let message = error(&finish(&mut harness(&nowhere, arguments)), 2);
        let expected = format!("there are no results in {}: there is no such folder; ", nowhere.display());
        assert!(message.starts_with(&expected), "{message}");
        assert!(message.contains("--results"), "{message}");
        // The folder exists, but contains something else.
        let message = error(&finish(&mut harness(folder.0.path(), arguments)), 2);
        assert!(message.contains(": it holds neither runs nor datasets; "), "{message}");
    }
    // A file of the user that is not there comes first.
    for arguments in [
        &["claims", "--file", "none.yaml"][..],
        &["report", "--claims", "none.yaml"],
        &["serve", "--claims", "none.yaml"],
    ] {
        let message = error(&finish(&mut harness(&nowhere, arguments)), 2);
        assert_eq!(message, "none.yaml: there is no such file", "{arguments:?}");
    }
    assert!(files(folder.0.path()).is_empty());
}

#[test]
fn a_run_keeps_the_part_of_the_command_that_makes_it_alone() {
    let folder = Folder::new();
    let results = folder.path("my results");
    let lists = ["seeds=[3, 4]", "latent=[2,4]", "vary={training.kl_weight: [0, 0.01]}"];
    let some = ["scenarios=[empty]", "tasks=[prediction]", "simulation.actuations_per_episode=2"];
    succeed(&results, &[&["run", SMOKE, "training.epochs=1"], &lists[..], &some].concat());
    let json = folder.path("runs.json").display().to_string();
    succeed(&results, &["query", "select run, command from runs order by run", "--output", &json]);
    let rows: serde_json::Value = serde_json::from_slice(&std::fs::read(json).unwrap()).unwrap();
    let rows = rows.as_array().unwrap();
    assert_eq!(rows.len(), 8);
    for row in rows {
        let (run, command) = (row["run"].as_str().unwrap(), row["command"].as_str().unwrap());
        // A shell splits the command into these words. The command must work as it is printed.
        let words = shlex::split(command).unwrap();
        let words: Vec<&str> = words.iter().skip(1).map(String::as_str).chain(["--dry-run"]).collect();
        let planned = finish(
            assert_cmd::cargo::cargo_bin_cmd!("harness").current_dir(env!("CARGO_MANIFEST_DIR")).args(words),
        );
        // A blank line and the layers of the network follow.
        let runs = planned.stdout.lines().take_while(|line| !line.is_empty()).count();
        assert_eq!(runs, 1, "{command}: {}{}", planned.stdout, planned.stderr);
        assert!(
            planned.stdout.contains(run) && planned.stdout.starts_with("skip"),
            "{command}: {}",
            planned.stdout
        );
    }
}

#[test]
fn runs_are_listed_and_shown() {
    let list = succeed(&RESULTS, &["ls"]);
    assert_eq!(
        list.lines().filter(|line| line.contains("smoke") && line.contains("done")).count(),
        2,
        "{list}"
    );
    let shown = succeed(&RESULTS, &["show", "cluttered", "--all"]);
    for part in ["smoke/cluttered-z4-seed0-", ": done", "epochs: 2", "mujoco_version", "3.17.0", "WMAPE"] {
        assert!(shown.contains(part), "no {part} in {shown}");
    }
}

#[test]
fn a_run_is_shown_as_its_own_experiment_made_it() {
    let folder = Folder::new();
    let results = folder.path("results");
    for name in ["name=first", "name=second"] {
        succeed(&results, &[&ONE[..], &[name]].concat());
    }
    for name in ["first", "second"] {
        let shown = succeed(&results, &["show", &format!("{name}/empty")]);
        assert!(shown.contains(&format!("name={name}")), "{shown}");
    }
}

#[test]
fn a_spec_is_validated_with_its_overrides() {
    let said = succeed(&RESULTS, &["validate", SMOKE, "latent=[2,3]", "seeds=[5]"]);
    assert!(said.starts_with("experiments/smoke.yaml is valid: 4 runs\n  empty-z2-seed5\n"), "{said}");
}

#[test]
fn the_schema_for_editors_is_the_checked_in_one() {
    for (arguments, file) in
        [(&["schema"][..], "schema.json"), (&["schema", "--mapping"][..], "mapping.schema.json")]
    {
        let printed: serde_json::Value = serde_json::from_str(&succeed(&RESULTS, arguments)).unwrap();
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments").join(file);
        let checked_in: serde_json::Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
        assert!(printed == checked_in, "run `harness {} > experiments/{file}`", arguments.join(" "));
    }
}

#[test]
fn outputs_that_are_pipes_or_links_stay_what_they_are() {
    let folder = Folder::new();
    let (pipe, link, file) = (folder.path("pipe.csv"), folder.path("link.csv"), folder.path("file.csv"));
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    std::fs::write(&file, "before").unwrap();
    std::os::unix::fs::symlink(&file, &link).unwrap();
    let read = {
        let pipe = pipe.clone();
        std::thread::spawn(move || std::fs::read_to_string(pipe).unwrap())
    };
    for path in [&pipe, &link] {
        succeed(&RESULTS, &["query", "select 1 as one", "--output", path.to_str().unwrap()]);
    }
    assert_eq!(read.join().unwrap(), "one\n1\n");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "one\n1\n");
    assert!(std::fs::symlink_metadata(&link).unwrap().is_symlink());
    let empty = finish(&mut harness(&RESULTS, &["render", "empty", "--samples", "0", "--output", "no.gif"]));
    assert!(
        empty.code == 2 && empty.stderr.contains("invalid value '0' for '--samples <N>'"),
        "{}",
        empty.stderr
    );
}

#[test]
fn pictures_and_clips_have_the_size_and_length_asked_for() {
    let folder = Folder::new();
    let path = |name: &str| folder.path(name).display().to_string();
    let size = ["--width", "160", "--height", "100"];
    let episode = ["--spec", SMOKE, "--episode", "1"];
    let (rest, instant, clip) = (path("rest.png"), path("instant.PNG"), path("clip.gif"));
    let said = succeed(&RESULTS, &[&["render", "cluttered", "--output", &rest], &size[..]].concat());
    assert_eq!(said, format!("{rest}\n"));
    let at = ["--sample", "20"];
    succeed(&RESULTS, &[&["render", "cluttered", "--output", &instant], &size[..], &episode, &at].concat());
    let last = ["--sample", "26", "--samples", "9"];
    succeed(&RESULTS, &[&["render", "cluttered", "--output", &clip], &size[..], &episode, &last].concat());

    let rest = image::open(rest).unwrap().into_rgb8();
    let instant = image::open(instant).unwrap().into_rgb8();
    assert_eq!((rest.dimensions(), instant.dimensions()), ((160, 100), (160, 100)));
    assert!(rest != instant, "the finger has moved");
    let colors = rest.pixels().collect::<std::collections::HashSet<_>>().len();
    assert!(colors > 100, "a picture, not a surface: {colors} colors");
    let clip = std::io::BufReader::new(std::fs::File::open(clip).unwrap());
    let frames = image::codecs::gif::GifDecoder::new(clip).unwrap().into_frames().collect_frames().unwrap();
    assert_eq!(frames.len(), 4, "the episode has 30 samples");
    assert_eq!(frames[0].buffer().dimensions(), (160, 100));
    assert_eq!(frames[0].delay().numer_denom_ms(), (100, 1), "10 samples a second");
    assert_whole(folder.0.path());
}

#[test]
fn the_doctor_names_what_is_there_and_what_is_not() {
    let healthy = succeed(&RESULTS, &["doctor"]);
    assert!(healthy.lines().all(|line| line.starts_with("ok ")) && healthy.contains("3.17.0"), "{healthy}");
    let ill = finish(harness(Path::new("/proc/nope"), &["doctor"]).env(DRIVERS, "/nonexistent.json"));
    assert_eq!(ill.code, 1);
    let failed: Vec<&str> = ill.stdout.lines().filter(|line| line.starts_with("FAIL ")).collect();
    assert_eq!(failed.len(), 2, "{}", ill.stdout);
    assert!(failed[0].contains("rendering  no OpenGL context"), "{}", ill.stdout);
    assert!(failed[1].contains("can't write /proc/nope"), "{}", ill.stdout);
}

#[test]
fn the_doctor_says_which_device_renders_and_which_variables_do_not_choose_it() {
    let rendering = |device: &str| {
        let mut doctor = harness(&RESULTS, &["doctor"]);
        doctor.env("MUJOCO_GL", "egl").env("MUJOCO_EGL_DEVICE_ID", device);
        let answer = finish(&mut doctor).stdout;
        let line = answer.split("ok    MuJoCo").next().unwrap();
        line.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let line = rendering("");
    assert!(line.contains("device of EGL") || line.contains("EGL device"), "{line}");
    assert!(!line.contains("no effect"), "{line}");
    let line = rendering("7");
    assert!(line.contains("; MUJOCO_EGL_DEVICE_ID=7 has no effect: the harness renders with EGL"), "{line}");
}

#[test]
fn one_option_of_all_commands_names_the_file_or_folder_to_write() {
    for command in ["query", "ls", "claims", "compare", "figures", "plot", "render", "report", "publish"] {
        let help = succeed(&RESULTS, &[command, "--help"]);
        assert!(help.contains("  -o, --output <"), "{command}: {help}");
    }
    // Earlier names are understood, but not shown.
    for (command, option) in [("figures", "--out"), ("report", "--out")] {
        let help = succeed(&RESULTS, &[command, option, "somewhere.html", "--help"]);
        assert!(!help.contains(&format!("{option} ")), "{help}");
    }
}

#[test]
fn shells_complete_every_command() {
    let help = succeed(&RESULTS, &["--help"]);
    let listed =
        help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let commands: Vec<&str> = listed
        .filter_map(|line| line.strip_prefix("  ")?.split(' ').next())
        .filter(|name| !name.is_empty())
        .collect();
    assert!(commands.len() > 20, "{commands:?}");
    for (shell, mention) in [
        ("bash", &|name: &str| format!("harness,{name})")),
        ("zsh", &|name: &str| format!("\n'{name}:")),
        ("fish", &|name: &str| format!(" -a \"{name}\" ")),
    ] as [(&str, &dyn Fn(&str) -> String); 3]
    {
        let script = succeed(&RESULTS, &["completions", shell]);
        for name in &commands {
            assert!(script.contains(&mention(name)), "{shell} does not know {name}");
        }
        assert!(script.contains("dry-run"), "{shell} does not know --dry-run");
    }
    // Bash accepts the script, and completes the beginning of a command and of an option with it.
    let complete = |words: &str, current: usize| {
        let script = format!(
            "source <({} completions bash); COMP_WORDS=({words}); COMP_CWORD={current}; \
             _harness harness \"${{COMP_WORDS[{current}]}}\" \"${{COMP_WORDS[{current} - 1]}}\"; echo \
             ${{COMPREPLY[*]}}",
            env!("CARGO_BIN_EXE_harness")
        );
        // Bash warns of a locale that is not installed.
        let output =
            std::process::Command::new("bash").args(["-c", &script]).env("LC_ALL", "C").output().unwrap();
        assert_eq!(String::from_utf8_lossy(&output.stderr), "");
        String::from_utf8(output.stdout).unwrap()
    };
    assert_eq!(complete("harness comp", 1), "compare completions\n");
    assert_eq!(complete("harness run --dry", 2), "--dry-run\n");
}

#[test]
fn a_reader_that_goes_away_is_no_failure() {
    for arguments in [&["schema"][..], &["schema", "--tables"], &["ls"], &["query", "select * from epochs"]] {
        let mut child =
            spawnable(&RESULTS, arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        let output = child.wait_with_output().unwrap();
        assert_eq!(String::from_utf8_lossy(&output.stderr), "", "{arguments:?}");
        assert_eq!(output.status.code(), Some(0), "{arguments:?}");
    }
}

#[test]
fn an_answer_that_cannot_be_printed_is_a_failure() {
    for arguments in
        [&["schema"][..], &["ls"], &["query", "select * from epochs"], &["run", SMOKE, "--dry-run"]]
    {
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let output = spawnable(&RESULTS, arguments).stdout(full).output().unwrap();
        assert_eq!(
            String::from_utf8_lossy(&output.stderr),
            "error: the standard output can't be written: No space left on device (os error 28)\n",
            "{arguments:?}"
        );
        assert_eq!(output.status.code(), Some(1), "{arguments:?}");
    }
}

// --- arguments that are not Unicode ---

const ROBOT: &str = r#"<mujoco><option timestep="0.005"/><worldbody><body name="cart"><joint name="slide" type="slide" range="-.5 .5" damping="2"/>
    <geom type="box" size=".06 .05 .03" mass="1"/></body></worldbody>
  <actuator><position name="push" joint="slide" kp="200" ctrlrange="-.4 .4"/></actuator></mujoco>"#;
const OWN: &str = "name: own\nscenarios: robot.yaml\ninput: joints\noutput: joints\nlatent: 2\nseeds: 0\n\
                   network: {preset: multi_to_multi, hidden: [8]}\ntasks: prediction\n\
                   simulation: {episodes: 4, actuations_per_episode: 2}\ntraining: {epochs: 2, batch_size: 16}\n";

#[test]
fn arguments_that_are_no_unicode_are_paths_or_refused() {
    let folder = Folder::new();
    let strange = std::ffi::OsStr::from_bytes(b"\xff\xfe");
    let path = folder.0.path().join(strange);
    std::fs::create_dir(&path).unwrap();
    std::fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join(SMOKE), path.join("smoke.yaml")).unwrap();
    let answer = |arguments: &[&std::ffi::OsStr]| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_harness"));
        let output = command.current_dir(&path).args(arguments).output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert!(!stderr.contains("panicked"), "{stderr}");
        (output.status.code().unwrap(), String::from_utf8(output.stdout).unwrap(), stderr)
    };
    let word = std::ffi::OsStr::new;
    let spec = path.join("smoke.yaml");
    // Everything is in this folder, also a world file of its own.
    for arguments in ["world new robot.xml --output robot.yaml", "run own.yaml", "verify", "compare own"] {
        let files = [("robot.xml", ROBOT), ("own.yaml", OWN)];
        files.iter().for_each(|(name, text)| std::fs::write(path.join(name), text).unwrap());
        let (code, said, complaint) = answer(&arguments.split(' ').map(word).collect::<Vec<_>>());
        assert_eq!(code, 0, "{arguments}: {said}{complaint}");
    }
    let one =
        [word("scenarios=empty"), word("training.epochs=1"), word("simulation.actuations_per_episode=2")];
    let results = folder.path("results");
    let results = [word("--results"), results.as_os_str()];

    let (code, said, complaint) = answer(&[&results[..], &[word("run"), spec.as_os_str()], &one].concat());
    assert_eq!(code, 0, "{complaint}");
    assert!(said.contains("1 done, 0 done before, 0 failed"), "{said}");
    for arguments in
        [[word("query"), strange], [word("show"), strange], [strange, strange], [word("--results"), strange]]
    {
        let (code, _, complaint) = answer(&arguments);
        assert_eq!(code, 2, "{complaint}");
        assert!(complaint.starts_with("error: "), "{complaint}");
    }
    let (code, _, complaint) = answer(&[word("run"), spec.as_os_str(), strange]);
    assert!(code == 2 && complaint.starts_with("error: "), "{complaint}");
}

// --- bad input ---

#[test]
fn bad_specs_are_refused_at_their_line_and_nothing_is_written() {
    let (folder, results) = (Folder::new(), Folder::new().path("results"));
    let smoke = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(SMOKE)).unwrap();
    let edited = |name: &str, old: &str, new: &str| {
        assert!(smoke.contains(old));
        folder.write(name, &smoke.replacen(old, new, 1))
    };
    let cases = [
        (folder.path("missing.yaml").display().to_string(), ": there is no such file"),
        (folder.write("nothing.yaml", ""), ":1:1: the file is empty; see `harness schema`"),
        (folder.write("broken.yaml", "name: ["), ":1:7: broken YAML: "),
        (
            edited("key.yaml", "latent:", "latnt:"),
            ":12:1: unknown key 'latnt'; did you mean 'latent'? Allowed: ",
        ),
        (
            edited("type.yaml", "epochs: 2", "epochs: two"),
            ":21:11: 'training.epochs': expected an integer of at least 1 and at most 100000, found the text 'two'",
        ),
        (
            edited("modality.yaml", ", vision]", ", vison]"),
            ":10:25: unknown modality 'vison' in 'input'; did you mean 'vision'? Allowed: proprioception, ",
        ),
        (folder.0.path().display().to_string(), ": is a directory"),
    ];
    for command in ["run", "collect", "validate"] {
        for (path, expected) in &cases {
            let message = error(&finish(&mut harness(&results, &[command, path])), 2);
            assert!(message.starts_with(&format!("{path}{expected}")), "{message}");
        }
    }
    assert!(!results.exists());
}

#[test]
fn bad_overrides_are_refused() {
    let cases = [
        ("training.epochs", "has no '='; write KEY=VALUE, as in training.epochs=3"),
        ("training.epohcs=3", "unknown key 'training.epohcs'; did you mean 'training.epochs=3'?"),
        (
            "training.epochs=0",
            "'training.epochs': expected an integer of at least 1 and at most 100000, found 0",
        ),
        ("latent=[", "broken YAML: "),
    ];
    for (text, expected) in cases {
        let message = refusal(&["run", SMOKE, text], 2);
        assert!(message.starts_with(&format!("override '{text}': {expected}")), "{message}");
    }
}

#[test]
fn bad_questions_and_names_are_refused() {
    let folder = Folder::new();
    let cases: &[(&[&str], &str)] = &[
        #[cfg(not(feature = "cuda"))]
        (
            &["run", SMOKE, "training.device=cuda"],
            "training.device: cuda can't be used: this harness was built without CUDA; build it with",
        ),
        (&["query", "selct 1"], "the query can't be answered: sql parser error: "),
        (
            &["query", "select nonsense from runs"],
            "the query can't be answered: there is no column 'nonsense'; there are experiment, run, ",
        ),
        (
            &["query", "select * from nope"],
            "the query can't be answered: there is no table 'nope'; there are runs, epochs, ",
        ),
        (&["show", "emptz-z4"], "no run matches 'emptz-z4', the nearest is 'empty-z4-seed0-"),
        (&["show", "nothing/at-all"], "no run matches 'nothing/at-all'; `"),
        (&["ls", "smok"], "no run of 'smok' has started; did you mean 'smoke'? `"),
        (&["show", ""], "'' matches several runs: smoke/cluttered-z4-seed0-"),
        (
            &["render", "empty", "--output", "a.png", "--width", "0"],
            "a picture of 0 x 800 pixels is out of range",
        ),
        (
            &["render", "empty", "--output", "a.png", "--spec", SMOKE, "--episode", "0", "--sample", "30"],
            "the episode has 30 samples, so there is no sample 30",
        ),
    ];
    for (arguments, expected) in cases {
        let message = refusal(arguments, 2);
        assert!(message.starts_with(expected), "{arguments:?}: {message}");
    }
    let table = folder.path("answer.xlsx").display().to_string();
    let message = refusal(&["query", "select * from runs", "--output", &table], 2);
    assert_eq!(message, format!("can't write to '{table}': its name must end in .parquet, .csv or .json"));
    let picture = folder.path("scene.jpg").display().to_string();
    let message = refusal(&["render", "empty", "--output", &picture], 2);
    assert_eq!(message, format!("can't write a picture to '{picture}': its name must end in .png or .gif"));
    assert!(files(folder.0.path()).is_empty());
    for (arguments, expected) in [
        (&["render", "empty", "--output", "a.png", "--sample", "3"][..], "--episode <N>"),
        (&["report", "--output", "a.pdf"], "its name must end in .html"),
    ] {
        let answer = finish(&mut harness(&RESULTS, arguments));
        assert!(answer.code == 2 && answer.stderr.contains(expected), "{}", answer.stderr);
    }
    for arguments in [&["render", "void", "--output", "a.png"][..], &["--threads", "0", "ls"], &["rum"]] {
        let answer = finish(&mut harness(&RESULTS, arguments));
        assert_eq!(answer.code, 2, "{arguments:?}");
        assert!(answer.stderr.starts_with("error: "), "{}", answer.stderr);
    }
}

#[test]
fn a_run_is_found_by_the_path_of_its_folder() {
    let folder = std::fs::read_dir(RESULTS.join("runs/smoke")).unwrap().next().unwrap().unwrap().path();
    let id = folder.file_name().unwrap().to_str().unwrap();
    for name in [format!("smoke/{id}/"), folder.display().to_string(), format!("{}/", folder.display())] {
        let said = succeed(&RESULTS, &["show", &name]);
        assert!(said.starts_with(&format!("smoke/{id}: done")), "{said}");
    }
}

#[test]
fn models_that_cannot_be_used_are_named() {
    let (folder, results) = (Folder::new(), Folder::new().path("results"));
    let world = include_str!("../models/empty.yaml").replace("model: empty.xml", "model: own.xml");
    let scenarios = format!("scenarios=[{}]", folder.write("own.yaml", &world));
    let run = |code| error(&finish(&mut harness(&results, &["run", SMOKE, &scenarios])), code);
    let path = folder.path("own.xml").display().to_string();
    let expected = format!("{}:3:8: can't read the model {path}: ", folder.path("own.yaml").display());
    assert!(run(2).starts_with(&expected), "{}", run(2));
    folder.write("own.xml", "<mujoco>\n<worldbody><geom tpye='box'/></worldbody></mujoco>");
    let message = run(2);
    assert!(message.starts_with(&format!("{path} does not compile with MuJoCo 3.17.0: ")), "{message}");
    assert!(message.contains("unrecognized attribute: 'tpye'") && message.contains("line 2"), "{message}");
    assert!(!results.exists());
}

#[test]
fn importing_is_left_to_python_with_the_words_to_type() {
    let install = ".venv/bin/pip install '.[import]'";
    let message = error(&finish(&mut harness(Path::new("results"), &["import", "my lab.yaml"])), 2);
    assert!(message.contains(&format!("`{install}`")), "{message}");
    assert!(message.contains("`.venv/bin/harness import 'my lab.yaml'`"), "{message}");
    let message = error(&finish(&mut harness(Path::new("other"), &["import", "lab.yaml"])), 2);
    assert!(message.contains("`.venv/bin/harness import lab.yaml --results other`"), "{message}");
    let message = error(
        &finish(&mut harness(Path::new("results"), &["import", "--inspect", "bag", "--output", "lab.yaml"])),
        2,
    );
    assert!(message.contains("`.venv/bin/harness import --inspect bag --output lab.yaml`"), "{message}");
    let help = succeed(&RESULTS, &["import", "--help"]);
    assert!(help.contains(install) && help.contains(".venv/bin/harness import mapping.yaml"), "{help}");
}

#[test]
fn results_that_cannot_be_written_are_named() {
    let folder = Folder::new();
    let file = PathBuf::from(folder.write("file", "not a folder"));
    for results in [file.clone(), file.join("below"), PathBuf::from("/proc/nope")] {
        for command in ["run", "collect"] {
            let message = error(&finish(&mut harness(&results, &[command, SMOKE])), 1);
            let expected = format!("can't write {}: ", results.display());
            assert!(message.starts_with(&expected), "{message}");
        }
    }
    for command in [&["run", SMOKE][..], &["ls"]] {
        let said = finish(&mut harness(&file, command)).stderr;
        assert!(said.contains(&format!("{}: it is a file, not a folder", file.display())), "{said}");
    }
    for output in [file.join("answer.csv"), PathBuf::from("/proc/nope/answer.csv")] {
        let message = refusal(&["query", "select * from runs", "--output", output.to_str().unwrap()], 1);
        assert!(message.starts_with(&format!("can't write {}: ", output.display())), "{message}");
    }
    let output = file.join("scene.png");
    let message = refusal(&["render", "empty", "--output", output.to_str().unwrap()], 1);
    assert!(message.starts_with(&format!("can't write {}: ", output.display())), "{message}");
    assert_eq!(std::fs::read_to_string(file).unwrap(), "not a folder");
}

/// The environment variable with the drivers that EGL loads.
const DRIVERS: &str = "__EGL_VENDOR_LIBRARY_FILENAMES";

#[test]
fn a_missing_renderer_is_reported_once_before_it_is_needed() {
    let folder = Folder::new();
    let results = folder.path("results");
    let without = |arguments: &[&str]| finish(harness(&results, arguments).env(DRIVERS, "/nonexistent.json"));
    for command in ["run", "collect"] {
        let message = error(&without(&[command, SMOKE, "seeds=[0,1]"]), 1);
        assert!(message.starts_with("no OpenGL context for offscreen rendering: EGL says "), "{message}");
        assert!(message.contains("apt-get install libegl1"), "{message}");
        assert!(files(&results).is_empty(), "{command}: {:?}", files(&results));
    }
    // With a driver, the same command succeeds. Other networks on the same episodes need none.
    assert!(succeed(&results, &["run", SMOKE]).contains("2 done, 0 done before, 0 failed"));
    let trained = without(&["run", SMOKE, "seeds=1"]);
    assert!(trained.stdout.contains("2 done, 0 done before, 0 failed"), "{}", trained.stderr);
    assert_eq!(without(&["collect", SMOKE]).code, 0);
    assert_whole(&results);
}

#[test]
fn an_ablation_of_the_camera_is_valid_and_runs() {
    let folder = Folder::new();
    let (results, spec) = (folder.path("results"), folder.path("ablation.yaml"));
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(SMOKE)).unwrap();
    let text = text.replace("input: [proprioception, vision]", "input: [proprioception]");
    let text =
        text.replace("output: [proprioception, contact_force, frame_difference]", "output: [contact_force]");
    std::fs::write(&spec, text + "vary: {input: [[proprioception], [proprioception, vision]]}\n").unwrap();
    let settings = [spec.to_str().unwrap(), "scenarios=[empty]", "tasks=prediction", "training.epochs=1"];
    let valid = succeed(&results, &[&["validate"], &settings[..]].concat());
    assert!(valid.contains("is valid: 2 runs"), "{valid}");
    let ran = succeed(&results, &[&["run"], &settings[..]].concat());
    assert!(ran.contains("2 done, 0 done before, 0 failed"), "{ran}");
    let shown = succeed(&results, &["show", "smoke/empty-z4-input=proprioception+vision", "--all"]);
    assert!(shown.contains("\n  channels:\n  - 4\n"), "{shown}");
}

#[test]
fn a_latent_state_that_nothing_uses_is_shown_with_its_divergence() {
    let results = Folder::new().path("results");
    let one = ["scenarios=[empty]", "tasks=[prediction]"];
    // A large weight of the divergence makes the posterior equal to what is expected before the sample.
    for (name, settings) in [
        ("used", &["training.kl_weight=0"][..]),
        ("unused", &["training.kl_weight=100", "training.epochs=60", "training.learning_rate=0.01"]),
    ] {
        let name = format!("name={name}");
        succeed(&results, &[&["run", SMOKE, &name][..], &one, settings].concat());
    }
    let latent = |name: &str| {
        let shown = succeed(&results, &["show", &format!("{name}/empty")]);
        let line = shown.lines().find(|line| line.starts_with("latent")).unwrap().to_owned();
        line.split_whitespace().skip(1).map(str::to_owned).collect::<Vec<_>>().join(" ")
    };
    assert!(latent("used").starts_with("4, 4 active (KL "), "{}", latent("used"));
    assert!(latent("unused").starts_with("4, 0 active (KL 0.0"), "{}", latent("unused"));
    let table = succeed(&results, &["compare", "--metrics", "kl,active", "--models", "network"]);
    assert!(table.contains("KL (nats)") && table.contains("active (dimensions)"), "{table}");
    let rows = ask(&results, "select index, value from metrics where experiment = 'used' and metric = 'kl'");
    let value = |row: &serde_json::Value| row["value"].as_f64().unwrap();
    let (whole, each): (Vec<_>, Vec<_>) = rows.iter().partition(|row| row["index"].is_null());
    let sum: f64 = each.iter().map(|row| value(row)).sum();
    assert!(whole.len() == 1 && each.len() == 4 && (value(whole[0]) - sum).abs() < 1e-12, "{rows:?}");
}

#[test]
fn what_was_probably_meant_is_named() {
    let cases: [(&[&str], &[&str]); 15] = [
        (&["rnu"], &["'run'"]),
        (&["run", SMOKE, "--seed", "1"], &["tip: a setting is written without dashes: seeds=VALUE"]),
        (&["run", SMOKE, "--batch-size=8"], &["without dashes: training.batch_size=VALUE"]),
        (&["world", "chekc", "empty"], &["'check'"]),
        (
            &["show", "smoke/none"],
            &[
                "no run matches 'smoke/none'; the runs of this experiment are cluttered-z4-seed0-",
                "ls smoke` lists them",
            ],
        ),
        (&["diff", "smoke/none", "smoke/empty"], &["the runs of this experiment are "]),
        (&["ls", "smok"], &["no run of 'smok' has started; did you mean 'smoke'?"]),
        (&["plot", "--x", "latent", "--metrics", "R2"], &["did you mean 'r2'? the metrics are"]),
        (
            &["plot", "--x", "latent", "--metrics", "r2", "--of", "contact_forc"],
            &["did you mean 'contact_force'?"],
        ),
        (&["compare", "--metrics", "R2"], &["there is no metric 'R2'; did you mean 'r2'? the metrics are"]),
        (&["compare", "--models", "rigde"], &["there is no model 'rigde'; did you mean 'ridge'?"]),
        (&["compare", "--of", "visoin"], &["no run predicts 'visoin'; did you mean"]),
        (
            &["render", "smoke/empty", "--horizon", "0.5s", "--output", "x.png"],
            &["a number of samples, not a time"],
        ),
        (
            &["run", SMOKE, "latent=[4,", "8]"],
            &[
                "override 'latent=[4,': is a part of a list that the shell divided at a space",
                "quotes: 'latent=[4, 8]'",
            ],
        ),
        (&["validate", SMOKE, "vary={latent:", "[4,", "8]}"], &["quotes: 'vary={latent: [4, 8]}'"]),
    ];
    for (arguments, parts) in cases {
        let answer = finish(&mut harness(&RESULTS, arguments));
        assert_eq!(answer.code, 2, "{arguments:?}: {}", answer.stderr);
        assert!(!answer.stderr.contains("as a value"), "an option is no value: {}", answer.stderr);
        for part in parts {
            assert!(answer.stderr.contains(part), "{arguments:?} does not say {part}: {}", answer.stderr);
        }
    }
    let folder = Folder::new();
    let smoke = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(SMOKE)).unwrap();
    let path = folder.write("versioned.yaml", &format!("version: 9\n{smoke}"));
    let message = refusal(&["validate", &path], 2);
    assert!(message.contains(":1:1: there is no key 'version'; leave it out: each run records"), "{message}");
}
