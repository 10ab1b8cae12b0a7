//! Damaged results: every damage is detected, no damaged data are read, and the commands of `harness verify` repair it.

use crate::common::{Answer, SMOKE, copy_folder, finish, harness, smoke_run, succeed};
use harness::catalog::{QueryError, query};
use harness::collection::{collect, dataset_of};
use harness::dataset::DatasetError;
use harness::files::{FolderLock, LOCK, UNFINISHED};
use harness::learning::LearningError;
use harness::learning::tensors::TensorFile;
use harness::progress::Silent;
use harness::registry::{Registry, RegistryError};
use harness::schema::Table;
use harness::simulation::Scene;
use harness::spec::{Scenario, Simulation};
use harness::tables::{TableError, TableFile};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

/// The number of flipped bits that are tested in each file, and the number of lengths that it is truncated to.
const POSITIONS: usize = 120;

/// Results that tests copy before they damage them.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| smoke_run("integrity"));

/// A copy of the smoke run's results, in a folder whose name must be quoted for a shell.
struct Copy {
    _folder: tempfile::TempDir,
    results: PathBuf,
}

impl Copy {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let results = folder.path().join("it's all here");
        copy_folder(&RESULTS, &results);
        Self { _folder: folder, results }
    }

    fn registry(&self) -> Registry {
        Registry::new(&self.results)
    }

    /// The folder of the only run on a scenario.
    fn run(&self, scenario: &str) -> PathBuf {
        child(&self.results.join("runs/smoke"), scenario)
    }

    fn dataset(&self, scenario: &str) -> PathBuf {
        child(&self.results.join("datasets"), scenario)
    }
}

fn child(folder: &Path, prefix: &str) -> PathBuf {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut found: Vec<PathBuf> =
        entries.filter(|path| path.file_name().unwrap().to_string_lossy().starts_with(prefix)).collect();
    assert_eq!(found.len(), 1, "{found:?}");
    found.remove(0)
}

/// Copies of a file with one flipped bit, and truncated copies, at random places: the bytes and what was changed.
fn damages(whole: &[u8], seed: u64) -> Vec<(Vec<u8>, String)> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut damages = Vec::new();
    for _ in 0..POSITIONS {
        let (at, bit) = (random.random_range(0..whole.len()), random.random_range(0..8));
        let mut flipped = whole.to_vec();
        flipped[at] ^= 1 << bit;
        damages.push((flipped, format!("bit {bit} of byte {at} flipped")));
        let length = random.random_range(0..whole.len());
        damages.push((whole[..length].to_vec(), format!("cut off after {length} bytes")));
    }
    for (name, bytes) in
        [("empty", vec![]), ("zeros", vec![0; whole.len()]), ("longer", [whole, &[0]].concat())]
    {
        damages.push((bytes, name.to_owned()));
    }
    damages
}

/// Damages a file in each of these ways, calls `check` with what was changed, and restores the file at the end.
fn damage(path: &Path, seed: u64, check: impl Fn(&str)) {
    let whole = std::fs::read(path).unwrap();
    for (bytes, what) in damages(&whole, seed) {
        std::fs::write(path, bytes).unwrap();
        check(&format!("{}: {what}", path.display()));
    }
    std::fs::write(path, whole).unwrap();
}

// --- every damaged byte ---

#[test]
fn a_damaged_episode_is_never_read() {
    let scene = Scene::paper(Scenario::EMPTY).unwrap();
    let spec = Simulation { episodes: 4, actuations_per_episode: 3, ..Simulation::default() };
    let root = tempfile::tempdir().unwrap();
    let dataset = dataset_of(root.path(), &scene, &spec);
    collect(&dataset, &scene, 2, &Silent).unwrap();
    let episode = dataset.folder().join("episode_00002.parquet");
    damage(&episode, 1, |what| {
        for frames in [false, true] {
            let error = dataset.read(2, frames).expect_err(what);
            assert!(matches!(error, DatasetError::Damaged { .. }), "{what}: {error}");
            assert!(error.to_string().contains("episode_00002.parquet is damaged"), "{what}: {error}");
        }
        assert_eq!(dataset.missing(), [2], "{what}");
    });
    assert!(dataset.missing().is_empty());
}

#[test]
fn a_damaged_table_gives_no_answer() {
    let copy = Copy::new();
    let registry = copy.registry();
    for (seed, table) in [Table::Epochs, Table::Metrics, Table::Predictions].into_iter().enumerate() {
        let name = format!("{}.parquet", table.name());
        let sql = format!("select count(*), count(scenario) from {}", table.name());
        query(&registry, &sql).unwrap();
        damage(&copy.run("empty").join(&name), seed as u64, |what| {
            let error = query(&registry, &sql).expect_err(what);
            assert!(matches!(error, QueryError::Registry(RegistryError::File { .. })), "{what}: {error}");
            let message = error.to_string();
            assert!(
                message.contains(&name) && message.contains(" verify` says how to repair it"),
                "{what}: {message}"
            );
            let error = TableFile::open(&copy.run("empty").join(&name))
                .and_then(|file| file.table(None))
                .expect_err(what);
            assert!(matches!(error, TableError::Read { .. }), "{what}: {error}");
        });
        query(&registry, &sql).unwrap();
    }
    let episode = copy.dataset("cluttered").join("episode_00001.parquet");
    damage(&episode, 4, |what| {
        let message = query(&registry, "select avg(time) from episodes").expect_err(what).to_string();
        assert!(message.contains("episode_00001.parquet is damaged"), "{what}: {message}");
    });
}

#[test]
fn a_damaged_checkpoint_or_state_is_never_loaded() {
    let copy = Copy::new();
    for (seed, name) in ["prediction.safetensors", "reconstruction.safetensors"].into_iter().enumerate() {
        let path = copy.run("cluttered").join(name);
        TensorFile::read(&path).unwrap();
        damage(&path, seed as u64, |what| {
            let error = TensorFile::read(&path).expect_err(what);
            assert!(matches!(error, LearningError::Damaged { .. }), "{what}: {error}");
            assert!(error.to_string().contains(name), "{what}: {error}");
        });
    }
}

#[test]
fn a_damaged_record_is_left_out_and_said_so() {
    let copy = Copy::new();
    let registry = copy.registry();
    let count = || query(&registry, "select * from runs").unwrap().height();
    assert_eq!(count(), 2);
    damage(&copy.run("empty").join("run.json"), 5, |what| {
        let registry = copy.registry();
        assert_eq!(registry.records().len(), 1, "{what}");
        let left_out = registry.left_out();
        assert_eq!(left_out.len(), 1, "{what}");
        assert!(left_out[0].contains("run.json is not the record of a run"), "{what}: {}", left_out[0]);
    });
    let record = copy.run("empty").join("run.json");
    let edited = std::fs::read_to_string(&record).unwrap().replacen("\"seed\": 0", "\"seed\": 1", 1);
    std::fs::write(&record, edited).unwrap();
    let answer = finish(&mut harness(&copy.results, &["query", "select distinct run from metrics"]));
    assert!(
        !answer.stdout.contains("empty-z4") && answer.stdout.contains("cluttered-z4"),
        "{}",
        answer.stdout
    );
    assert!(answer.stderr.starts_with("warning: a run is left out: "), "{}", answer.stderr);
    assert!(answer.stderr.contains("its SHA-256 differs"), "{}", answer.stderr);
}

#[test]
fn a_table_of_another_run_is_not_taken_for_ones_own() {
    let copy = Copy::new();
    std::fs::copy(copy.run("empty").join("metrics.parquet"), copy.run("cluttered").join("metrics.parquet"))
        .unwrap();
    let error = query(&copy.registry(), "select * from metrics").unwrap_err();
    assert!(matches!(error, QueryError::Registry(RegistryError::File { .. })), "{error}");
}

#[test]
fn a_training_with_damaged_state_begins_anew_and_ends_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let results = folder.path().join("results");
    copy_folder(&RESULTS.join("datasets"), &results.join("datasets"));
    let undisturbed = Copy::new();
    let run = undisturbed.run("empty").file_name().unwrap().to_owned();
    let run = results.join("runs/smoke").join(run);
    std::fs::create_dir_all(&run).unwrap();
    // The file of tensors is intact, but it is not a state of this training.
    std::fs::copy(
        undisturbed.run("empty").join("prediction.safetensors"),
        run.join("prediction.state.safetensors"),
    )
    .unwrap();
    let one = ["run", SMOKE];
    let answer = finish(&mut harness(&results, &one));
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    assert!(answer.stderr.contains("prediction.state.safetensors is damaged (epochs: "), "{}", answer.stderr);
    assert!(answer.stderr.contains("its training starts again"), "{}", answer.stderr);
    for name in ["prediction.safetensors", "reconstruction.safetensors"] {
        assert!(
            std::fs::read(run.join(name)).unwrap()
                == std::fs::read(undisturbed.run("empty").join(name)).unwrap(),
            "{name}"
        );
    }
    // Flipped bits in a state of this training.
    std::fs::remove_dir_all(&run).unwrap();
    std::fs::create_dir_all(&run).unwrap();
    let mut state = std::fs::read(undisturbed.run("empty").join("prediction.safetensors")).unwrap();
    let middle = state.len() / 2;
    state[middle] ^= 1;
    std::fs::write(run.join("prediction.state.safetensors"), state).unwrap();
    let answer = finish(&mut harness(&results, &one));
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    assert!(answer.stderr.contains("is damaged (it has changed since it was written"), "{}", answer.stderr);
    assert_eq!(verify(&results).code, 0);
}

// --- harness verify ---

fn verify(results: &Path) -> Answer {
    finish(&mut harness(results, &["verify"]))
}

/// Damages a copy of the results. `verify` must name the path, the problem and a command, and must find nothing after
/// the command was run.
#[track_caller]
fn mended(act: impl Fn(&Copy) -> PathBuf, problem: &str) {
    let copy = Copy::new();
    let path = act(&copy);
    let said = verify(&copy.results);
    assert_eq!(said.code, 1, "{}{}", said.stdout, said.stderr);
    let begin = format!("broken  {}: ", path.display());
    let finding = said.stdout.lines().position(|line| line.starts_with(&begin));
    let finding = finding.unwrap_or_else(|| panic!("no '{begin}' in {}", said.stdout));
    let lines: Vec<&str> = said.stdout.lines().skip(finding).take(2).collect();
    assert!(lines[0].contains(problem), "{}", said.stdout);
    let command =
        lines[1].strip_prefix("        repair: ").unwrap_or_else(|| panic!("no command: {}", said.stdout));
    assert!(said.stdout.lines().last().unwrap().contains("broken"), "{}", said.stdout);

    shell(command);
    let said = verify(&copy.results);
    assert_eq!(said.code, 0, "after {command}: {}", said.stdout);
    assert!(said.stdout.ends_with(": all files are intact\n"), "{}", said.stdout);
}

/// Runs a command in a shell, in the repository's root.
#[track_caller]
fn shell(command: &str) {
    let program = Path::new(env!("CARGO_BIN_EXE_harness")).parent().unwrap();
    let search = format!("{}:{}", program.display(), std::env::var("PATH").unwrap());
    let shell = Command::new("sh")
        .args(["-c", command])
        .env("PATH", search)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(shell.status.success(), "{command}: {}", String::from_utf8_lossy(&shell.stderr));
}

fn flip(path: PathBuf) -> PathBuf {
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(&path, bytes).unwrap();
    path
}

fn cut(path: PathBuf) -> PathBuf {
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    path
}

fn remove(path: PathBuf) -> PathBuf {
    std::fs::remove_file(&path).unwrap();
    path
}

#[test]
fn whole_results_are_called_whole_and_left_alone() {
    let said = succeed(&RESULTS, &["verify"]);
    assert_eq!(said, "2 runs, 2 datasets, 34 files: all files are intact\n");
}

#[test]
fn damaged_episodes_are_named_and_mended() {
    mended(|copy| flip(copy.dataset("empty").join("episode_00001.parquet")), "its SHA-256 differs");
    mended(|copy| cut(copy.dataset("empty").join("episode_00000.parquet")), "it has no seal");
    mended(
        |copy| {
            let path = copy.dataset("empty").join("episode_00001.parquet");
            std::fs::copy(copy.dataset("empty").join("episode_00003.parquet"), &path).unwrap();
            path
        },
        "it is not episode 1 of empty-",
    );
    mended(
        |copy| {
            remove(copy.dataset("cluttered").join("episode_00002.parquet"));
            copy.dataset("cluttered")
        },
        "missing episodes: 1 of the 4 that a finished run used",
    );
    mended(|copy| cut(copy.dataset("empty").join("dataset.json")), "");
    mended(|copy| flip(copy.dataset("empty").join("model.xml")), "its SHA-256 differs");
    mended(
        |copy| {
            let model = copy.dataset("empty").join("model.xml");
            remove(model.clone());
            model
        },
        "No such file",
    );
    mended(
        |copy| {
            let path = copy.dataset("empty").join("dataset.json");
            let text = std::fs::read_to_string(&path).unwrap().replace("\"seed\": 0", "\"seed\": 7");
            std::fs::write(&path, text).unwrap();
            path
        },
        "it does not describe this dataset",
    );
}

#[test]
fn damaged_runs_are_named_and_mended() {
    mended(|copy| flip(copy.run("empty").join("metrics.parquet")), "its SHA-256 differs");
    mended(|copy| cut(copy.run("cluttered").join("predictions.parquet")), "bytes instead of");
    mended(|copy| remove(copy.run("empty").join("epochs.parquet")), "No such file");
    mended(|copy| flip(copy.run("empty").join("prediction.safetensors")), "its SHA-256 differs");
    mended(|copy| flip(copy.run("empty").join("spec.yaml")), "its SHA-256 differs");
}

#[test]
fn damaged_and_lost_records_are_named_and_their_runs_done_again() {
    mended(|copy| flip(copy.run("empty").join("run.json")), "its SHA-256 differs");
    mended(|copy| cut(copy.run("cluttered").join("run.json")), "it has no seal");
    mended(|copy| remove(copy.run("empty").join("run.json")), "there is no such file");
    // Without the spec, nothing says what the run was.
    mended(
        |copy| {
            remove(copy.run("empty").join("spec.yaml"));
            flip(copy.run("empty").join("run.json"))
        },
        "its SHA-256 differs",
    );
}

#[test]
fn a_run_whose_spec_is_elsewhere_or_changed_must_not_be_removed() {
    let folder = tempfile::tempdir().unwrap();
    let (results, spec) = (folder.path().join("results"), folder.path().join("touch.yaml"));
    std::fs::copy(SMOKE, &spec).unwrap();
    let run = ["run", "touch.yaml", "scenarios=[empty]"];
    let answer = finish(harness(&results, &run).current_dir(folder.path()));
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    flip(child(&results.join("runs/smoke"), "empty").join("metrics.parquet"));
    let explained = |place: &Path, expected: &[&str]| {
        let said = finish(harness(&results, &["verify"]).current_dir(place));
        assert_eq!(said.code, 1, "{}", said.stdout);
        assert!(!said.stdout.contains("rm -r"), "{}", said.stdout);
        assert!(expected.iter().all(|part| said.stdout.contains(part)), "{}", said.stdout);
    };
    explained(folder.path(), &["repair: harness --results ", " run touch.yaml"]);
    explained(Path::new(env!("CARGO_MANIFEST_DIR")), &[" run touch.yaml", "where it was run before"]);
    let text = std::fs::read_to_string(&spec).unwrap();
    std::fs::write(&spec, text.replace("name: smoke", "name: touch")).unwrap();
    explained(folder.path(), &["touch.yaml or the harness has changed since"]);
}

#[test]
fn what_does_not_belong_is_noted_but_not_broken() {
    let copy = Copy::new();
    let strays = [
        copy.run("empty").join("notes.txt"),
        copy.run("empty").join(format!("{UNFINISHED}Xy12")),
        copy.dataset("empty").join("episode_1.csv"),
        copy.results.join("runs/loose.txt"),
    ];
    strays.iter().for_each(|path| std::fs::write(path, "?").unwrap());
    remove(copy.dataset("cluttered").join("episode_00003.parquet"));
    std::fs::remove_dir_all(copy.run("cluttered")).unwrap();
    let said = verify(&copy.results);
    assert_eq!(said.code, 0, "{}", said.stdout);
    for path in &strays {
        assert!(said.stdout.contains(&format!("note    {}: ", path.display())), "{}", said.stdout);
    }
    assert!(said.stdout.contains("1 episode to be collected"), "{}", said.stdout);
    assert_eq!(said.stdout.lines().filter(|line| line.starts_with("note ")).count(), 5, "{}", said.stdout);
}

#[test]
fn unfinished_files_of_running_processes_are_not_left_over() {
    let copy = Copy::new();
    let (run, dataset) = (copy.run("empty"), copy.dataset("empty"));
    for folder in [&run, &dataset] {
        std::fs::write(folder.join(format!("{UNFINISHED}Xy12")), "?").unwrap();
    }
    // A lock alone would remove the unfinished files.
    let lock = FolderLock::attempt_shared(&dataset).unwrap().unwrap();
    let work = std::fs::File::open(run.join(LOCK)).unwrap();
    work.lock().unwrap();
    assert!(verify(&copy.results).stdout.contains("all files are intact"));
    drop((lock, work));
    let said = verify(&copy.results).stdout;
    assert_eq!(said.matches("left over from an interrupted write").count(), 2, "{said}");
}

// --- files in the wrong place ---

/// The number in a query's answer, and what was left out.
fn number(copy: &Copy, sql: &str) -> (i64, Vec<String>) {
    let registry = copy.registry();
    let answer = query(&registry, sql).unwrap();
    let number = answer.columns()[0].get(0).unwrap().try_extract().unwrap();
    (number, registry.left_out())
}

/// Copies a folder of the results to another place in the results folder. No number may change, the copy must be
/// reported as left out, and `verify` must suggest a command that removes it.
#[track_caller]
fn not_counted(from: impl Fn(&Copy) -> PathBuf, to: impl Fn(&Copy) -> PathBuf, sql: &str, copies: usize) {
    let act = |results: &Copy| {
        copy_folder(&from(results), &to(results));
        to(results)
    };
    let results = Copy::new();
    let before = number(&results, sql);
    assert_eq!(before.1, [""; 0], "nothing is left out");
    let to = act(&results);
    let (counted, left_out) = number(&results, sql);
    assert_eq!(counted, before.0, "{sql} with {}", to.display());
    assert_eq!(left_out.len(), copies, "{left_out:?}");
    assert!(left_out.iter().all(|text| text.contains(to.to_str().unwrap())), "{left_out:?}");
    let answer = finish(&mut harness(&results.results, &["query", sql]));
    assert_eq!(
        answer.stderr.lines().filter(|line| line.starts_with("warning: ")).count(),
        copies,
        "{}",
        answer.stderr
    );
    mend_all(&results);
    assert_eq!(number(&results, sql), before);
    assert!(!to.exists() || std::fs::read_dir(&to).unwrap().next().is_none(), "{}", to.display());
}

/// Runs every command that `verify` suggests. Nothing may be broken afterwards.
#[track_caller]
fn mend_all(copy: &Copy) {
    let said = verify(&copy.results);
    assert_eq!(said.code, 1, "{}", said.stdout);
    for command in said.stdout.lines().filter_map(|line| line.strip_prefix("        repair: ")) {
        shell(command);
    }
    let said = verify(&copy.results);
    assert_eq!(said.code, 0, "{}", said.stdout);
}

const RUNS: &str = "select count(run) from runs";
const METRICS: &str = "select count(run) from metrics";
const EPISODES: &str = "select count(sample) from episodes";

#[test]
fn copies_of_runs_are_not_counted() {
    let experiment = |copy: &Copy| copy.results.join("runs/smoke");
    let run = |copy: &Copy| copy.run("empty");
    let own_name = |copy: &Copy| copy.run("empty").file_name().unwrap().to_owned();
    for sql in [RUNS, METRICS] {
        not_counted(experiment, |copy| copy.results.join("runs/smoke-backup"), sql, 2);
        not_counted(run, |copy| copy.results.join("runs/smoke/zz copy of empty"), sql, 1);
        not_counted(run, |copy| copy.results.join("runs/a copy"), sql, 1);
        not_counted(run, |copy| copy.results.join("runs/other").join(own_name(copy)), sql, 1);
    }
    // A folder of runs inside an experiment's folder is not a run. Only its owner can know what to do with it.
    let results = Copy::new();
    copy_folder(&RESULTS.join("runs/smoke"), &results.results.join("runs/smoke/older"));
    let (counted, left_out) = number(&results, RUNS);
    assert_eq!((counted, left_out.len()), (2, 1), "{left_out:?}");
    assert!(verify(&results.results).stdout.contains("runs belong in runs/EXPERIMENT/RUN"));
}

#[test]
fn a_run_with_the_record_of_another_is_not_counted_but_redone() {
    let act = |copy: &Copy| {
        let record = copy.run("cluttered").join("run.json");
        std::fs::copy(copy.run("empty").join("run.json"), &record).unwrap();
        record
    };
    let copy = Copy::new();
    act(&copy);
    let (counted, left_out) = number(&copy, "select count(distinct run) from metrics");
    assert_eq!((counted, left_out.len()), (1, 1), "{left_out:?}");
    assert!(left_out[0].contains("is the record of smoke/empty-z4-seed0-"), "{left_out:?}");
    let plan = succeed(&copy.results, &["run", SMOKE, "--dry-run"]);
    assert!(plan.lines().any(|line| line.starts_with("run ") && line.contains("cluttered-z4")), "{plan}");
    mended(act, "it is the record of smoke/empty-z4-seed0-");
}

#[test]
fn moved_runs_are_not_counted_until_they_are_moved_back() {
    let copy = Copy::new();
    let moved = copy.results.join("runs/renamed");
    std::fs::rename(copy.results.join("runs/smoke"), &moved).unwrap();
    let (counted, left_out) = number(&copy, RUNS);
    assert_eq!((counted, left_out.len()), (0, 2), "{left_out:?}");
    mend_all(&copy);
    assert_eq!(number(&copy, RUNS), (2, vec![]));
}

#[test]
fn copies_of_datasets_are_not_counted() {
    not_counted(|copy| copy.dataset("empty"), |copy| copy.results.join("datasets/a copy"), EPISODES, 1);
    // A dataset in a folder with another name is missing until it is moved back.
    let copy = Copy::new();
    std::fs::rename(copy.dataset("empty"), copy.results.join("datasets/moved")).unwrap();
    let (counted, left_out) = number(&copy, EPISODES);
    assert_eq!((counted, left_out.len()), (120, 2), "{left_out:?}");
    std::fs::remove_dir_all(copy.results.join("runs")).unwrap();
    mend_all(&copy);
    assert_eq!(number(&copy, EPISODES), (240, vec![]));
}

// --- missing files ---

#[test]
fn a_query_of_episodes_notices_which_are_missing_or_swapped() {
    let refused = |act: &dyn Fn(&Copy), problem: &str| {
        let copy = Copy::new();
        assert_eq!(number(&copy, EPISODES), (240, vec![]));
        act(&copy);
        let message = query(&copy.registry(), EPISODES).unwrap_err().to_string();
        assert!(message.contains(problem) && message.contains(" verify` says how to repair it"), "{message}");
    };
    let episode = |copy: &Copy, index: u32| copy.dataset("empty").join(format!("episode_{index:05}.parquet"));
    refused(&|copy| drop(remove(episode(copy, 1))), "lacks 1 of its 4 episodes");
    refused(&|copy| drop(remove(episode(copy, 3))), "lacks 1 of its 4 episodes");
    refused(
        &|copy| {
            std::fs::copy(episode(copy, 2), episode(copy, 1)).unwrap();
        },
        "it is not episode 1 of empty-",
    );
    refused(
        &|copy| {
            let other = copy.dataset("cluttered").join("episode_00001.parquet");
            std::fs::copy(other, episode(copy, 1)).unwrap();
        },
        "it is not episode 1 of empty-",
    );
    // The dataset's description has fewer episodes than a finished run used.
    refused(
        &|copy| {
            let path = copy.dataset("empty").join("dataset.json");
            let text = std::fs::read_to_string(&path).unwrap();
            std::fs::write(&path, text.replace("\"episodes\": 4", "\"episodes\": 2")).unwrap();
            remove(episode(copy, 3));
        },
        "lacks 1 of its 4 episodes",
    );
    // Processes that share the folder are collecting it.
    let copy = Copy::new();
    let lock = FolderLock::attempt_shared(&copy.dataset("empty")).unwrap();
    remove(episode(&copy, 1));
    let (count, left_out) = number(&copy, EPISODES);
    assert_eq!((count, left_out.len()), (210, 1));
    assert!(left_out[0].ends_with("are missing; another process is collecting them"), "{left_out:?}");
    let watched = succeed(&copy.results, &["watch", "--once"]);
    let name = copy.dataset("empty").file_name().unwrap().to_string_lossy().into_owned();
    assert!(watched.contains(&format!("{name}  another process  3")), "{watched}");
    drop(lock);
    // An interrupted collection is no damage.
    let copy = Copy::new();
    std::fs::remove_dir_all(copy.run("empty")).unwrap();
    remove(episode(&copy, 1));
    let (counted, left_out) = number(&copy, EPISODES);
    assert_eq!((counted, left_out.len()), (210, 1), "{left_out:?}");
    assert!(left_out[0].contains("1 of the 4 episodes of "), "{left_out:?}");
    // A file with another name is not an episode.
    let copy = Copy::new();
    std::fs::copy(episode(&copy, 1), copy.dataset("empty").join("episode_1.parquet")).unwrap();
    assert_eq!(number(&copy, EPISODES).0, 240);
}

#[test]
fn gone_datasets_of_finished_runs_are_named_and_made_again() {
    let act = |copy: &Copy| {
        let dataset = copy.dataset("empty");
        std::fs::remove_dir_all(&dataset).unwrap();
        dataset
    };
    let copy = Copy::new();
    let dataset = act(&copy);
    let (counted, left_out) = number(&copy, EPISODES);
    assert_eq!((counted, left_out.len()), (120, 1), "{left_out:?}");
    assert!(left_out[0].contains(dataset.file_name().unwrap().to_str().unwrap()), "{left_out:?}");
    mended(act, "1 finished run used this dataset, which is not there");
}

#[test]
fn a_damaged_finished_run_counts_as_undone_and_ends_the_same() {
    for (act, name) in [
        (flip as fn(PathBuf) -> PathBuf, "metrics.parquet"),
        (cut, "predictions.parquet"),
        (remove, "epochs.parquet"),
        (flip, "prediction.safetensors"),
    ] {
        let copy = Copy::new();
        let path = copy.run("empty").join(name);
        let whole = std::fs::read(copy.run("empty").join("prediction.safetensors")).unwrap();
        act(path.clone());
        let plan = succeed(&copy.results, &["run", SMOKE, "--dry-run"]);
        let line = plan.lines().find(|line| line.contains("empty-z4")).unwrap();
        assert!(line.starts_with("run ") && line.contains(&format!("{name} is damaged: ")), "{plan}");
        assert!(
            plan.lines().any(|line| line.starts_with("skip ") && line.contains("cluttered-z4")),
            "{plan}"
        );
        let answer = finish(&mut harness(&copy.results, &["run", SMOKE]));
        assert!(answer.stdout.contains("1 done, 1 done before, 0 failed"), "{}", answer.stdout);
        assert!(answer.stderr.contains(&format!("{name} is damaged")), "{}", answer.stderr);
        assert_eq!(verify(&copy.results).code, 0);
        assert!(std::fs::read(copy.run("empty").join("prediction.safetensors")).unwrap() == whole);
    }
}

#[test]
fn datasets_in_another_format_are_set_apart() {
    let copy = Copy::new();
    let path = copy.dataset("empty").join("dataset.json");
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("\"format\": 2", "\"format\": 1")).unwrap();
    cut(copy.dataset("empty").join("episode_00000.parquet"));
    let said = verify(&copy.results);
    assert_eq!(said.code, 0, "{}", said.stdout);
    assert!(said.stdout.contains("in the format of another version"), "{}", said.stdout);
    let answer = query(&copy.registry(), "select distinct scenario from episodes").unwrap();
    assert_eq!(answer.height(), 1, "the other dataset");
    let left_out = number(&copy, EPISODES).1;
    assert!(left_out[0].contains("in the format of another version"), "{left_out:?}");
}
