//! Compacted tables give the same answers as the runs' own files, even after changes and damage to either.

use crate::common::{SMOKE, copy_folder, finish, fresh, harness, succeed};
use harness::analysis::Question;
use harness::catalog::{QueryError, query, query_of};
use harness::experiment::provenance;
use harness::judge::{MetricRow, PredictionRow};
use harness::learning::training::{Epoch, Losses, TOTAL};
use harness::metrics::evaluate;
use harness::progress::Silent;
use harness::registry::{Decision, Outcome, Registry, RunRecord};
use harness::seal;
use harness::spec::{self, Layout, Modality, Task};
use polars::prelude::DataFrame;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

/// A little more than the time after its last change when a file may be compacted.
const SETTLED: Duration = Duration::from_millis(3200);

const QUERIES: [&str; 13] = [
    "select experiment, run, status, dataset, group_hash from runs order by experiment, run",
    "select * from metrics",
    "select * from metrics limit 7",
    "select * from metrics where model = 'ridge' and seed in (3, 40) limit 5",
    "select * from epochs where epoch = 2",
    "select run, sample, predicted from predictions order by predicted desc limit 20",
    "select experiment, metric, count(*), avg(value), stddev(value) from metrics group by all",
    "select count(*) from metrics",
    "select count(*) from forces",
    "select * from frames",
    "select r.status, m.run, m.value from runs r join metrics m on r.run = m.run where m.index = 3",
    "select a.run, b.value from metrics a join metrics b on a.run = b.run where a.index = 1 and b.index = 2",
    "select seed, value from metrics where metric = 'r2' and index is null and direction is null order by value",
];

/// Writes finished runs of these seeds. Their numbers are computed from the seed and `scale`.
fn write_runs(results: &Path, experiment: &str, seeds: Range<u64>, scale: f32) {
    let registry = Registry::new(results);
    let seeds = format!("seeds={:?}", seeds.collect::<Vec<_>>());
    let name = format!("name={experiment}");
    let overrides = ["scenarios=[empty]".into(), "tasks=[prediction]".into(), name, seeds];
    let made = spec::load(Path::new(SMOKE), &overrides, false).unwrap();
    let by = provenance(1, "harness run".into());
    made.runs().par_iter().for_each(|spec| {
        let folder = registry.run(experiment, spec, "empty-00000000");
        let run = registry.claim(&folder).unwrap().unwrap();
        let record = run.begin(spec, &Layout::finger(), &by).unwrap();
        std::fs::write(folder.checkpoint(Task::Prediction), "made up").unwrap();
        run.finish(record, &outcome(spec.seed, scale)).unwrap();
    });
}

fn outcome(seed: u64, scale: f32) -> Outcome {
    let value = |place: usize| ((place as f32 + seed as f32) * 0.37).sin();
    let reference: Vec<f32> = (0..40).map(value).collect();
    let predicted: Vec<f32> = reference.iter().enumerate().map(|(n, x)| x + scale * value(n * 7)).collect();
    let rows = evaluate(&Layout::finger()[Modality::PROPRIOCEPTION], &reference, &predicted).unwrap();
    let losses = |epoch: usize| Losses::from([(TOTAL.to_owned(), f64::from(value(epoch)))]);
    let epoch = |epoch| Epoch { epoch, train: losses(epoch), validation: losses(epoch + 1), seconds: 0.5 };
    let of_models = ["network", "ridge"].into_iter().flat_map(|model| {
        rows.iter().map(move |row| MetricRow {
            horizon: 1,
            given: None,
            task: Task::Prediction,
            model: String::from(model),
            row: row.clone(),
        })
    });
    let prediction = |(place, (reference, predicted)): (usize, (f32, f32))| PredictionRow {
        horizon: 1,
        given: None,
        task: Task::Prediction,
        modality: Modality::PROPRIOCEPTION,
        episode: 3,
        sample: (place / 20) as u32,
        index: (place % 20) as u32,
        reference,
        predicted,
    };
    Outcome {
        epochs: [1, 2].map(|number| (Task::Prediction, epoch(number))).to_vec(),
        metrics: of_models.collect(),
        predictions: reference.iter().copied().zip(predicted).enumerate().map(prediction).collect(),
        ..Outcome::default()
    }
}

/// The answers of all queries, and the means of `compare`.
fn answers(results: &Path) -> Vec<DataFrame> {
    let registry = Registry::new(results);
    let mut answers: Vec<DataFrame> = QUERIES
        .iter()
        .map(|sql| query(&registry, sql).unwrap_or_else(|error| panic!("{sql}: {error}")))
        .collect();
    answers.push(Question::default().ask(&registry).unwrap().frame().unwrap());
    assert_eq!(registry.left_out(), Vec::<String>::new());
    answers
}

/// The same answers from a copy that can't be compacted, because a file has the name of the folder.
fn plain_answers(results: &Path) -> Vec<DataFrame> {
    let copy = tempfile::tempdir().unwrap();
    copy_folder(&results.join("runs"), &copy.path().join("runs"));
    std::fs::write(copy.path().join("compacted"), "in the way").unwrap();
    answers(copy.path())
}

#[track_caller]
fn assert_same(found: &[DataFrame], expected: &[DataFrame]) {
    assert_eq!(found.len(), expected.len());
    for (place, (found, expected)) in found.iter().zip(expected).enumerate() {
        let name = QUERIES.get(place).unwrap_or(&"compare");
        assert!(found.equals_missing(expected), "{name}:\n{found}\ninstead of\n{expected}");
    }
}

/// The compacted files of a table, with their contents.
fn parts(results: &Path, experiment: &str, table: &str) -> BTreeMap<PathBuf, Vec<u8>> {
    let files = std::fs::read_dir(results.join("compacted").join(experiment)).into_iter().flatten().flatten();
    let is_of =
        |path: &PathBuf| path.file_name().unwrap().to_string_lossy().starts_with(&format!("{table}-"));
    files
        .map(|file| file.path())
        .filter(is_of)
        .map(|path| (path.clone(), std::fs::read(path).unwrap()))
        .collect()
}

/// The folder of the run with a seed.
fn folder(results: &Path, experiment: &str, seed: u64) -> PathBuf {
    let records = Registry::new(results).records();
    let run = records.iter().find(|run| run.experiment == experiment && run.spec.seed == seed).unwrap();
    results.join("runs").join(experiment).join(&run.run)
}

fn means(results: &Path) -> Result<DataFrame, QueryError> {
    query(&Registry::new(results), "select run, sum(value) from metrics group by run order by run")
}

#[test]
fn answers_are_the_same_with_and_without_compacted_tables() {
    let results = fresh("compacted-same");
    write_runs(&results, "few", 0..40, 0.1);
    write_runs(&results, "many", 0..130, 0.1);
    let expected = plain_answers(&results);
    std::thread::sleep(SETTLED);
    assert_same(&answers(&results), &expected);
    assert_eq!(parts(&results, "few", "metrics").len(), 0, "too few to keep together");
    let first = parts(&results, "many", "metrics");
    assert_eq!(first.len(), 1);
    assert_same(&answers(&results), &expected);
    assert_eq!(parts(&results, "many", "metrics"), first, "reading it writes nothing");

    // A few more runs are read from their own files. Their rows are in the order of the runs all the same.
    write_runs(&results, "many", 130..140, 0.2);
    std::thread::sleep(SETTLED);
    assert_same(&answers(&results), &plain_answers(&results));
    assert_eq!(parts(&results, "many", "metrics"), first);
    // Many more runs get another compacted file, and the first one stays.
    write_runs(&results, "many", 140..200, 0.2);
    std::thread::sleep(SETTLED);
    let expected = plain_answers(&results);
    assert_same(&answers(&results), &expected);
    let both = parts(&results, "many", "metrics");
    assert_eq!(both.len(), 2);
    assert!(first.iter().all(|(path, bytes)| both.get(path) == Some(bytes)));
    assert_same(&answers(&results), &expected);

    // The folder can be deleted at any time.
    std::fs::remove_dir_all(results.join("compacted")).unwrap();
    assert_same(&answers(&results), &expected);
    let said = finish(&mut harness(&results, &["verify"])).stdout;
    assert!(said.contains("/datasets/empty-00000000: ") && !said.contains("/compacted/"), "{said}");
}

#[test]
fn runs_changed_since_are_not_answered_from_compacted_tables() {
    let results = fresh("compacted-changed");
    write_runs(&results, "many", 0..70, 0.1);
    std::thread::sleep(SETTLED);
    let before = means(&results).unwrap();
    assert_eq!(parts(&results, "many", "metrics").len(), 1);

    // The file is changed, but its size and modification time are not.
    let path = folder(&results, "many", 7).join("metrics.parquet");
    let whole = std::fs::read(&path).unwrap();
    let modified = std::fs::metadata(&path).unwrap().modified().unwrap();
    let mut damaged = whole.clone();
    damaged[whole.len() / 2] ^= 1;
    let restore_time = |time: SystemTime| {
        std::fs::File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
    };
    std::fs::write(&path, damaged).unwrap();
    restore_time(modified);
    let error = means(&results).unwrap_err();
    assert!(matches!(error, QueryError::Registry(_)), "{error}");
    assert!(
        error.to_string().contains("metrics.parquet is damaged (it has changed since it was written"),
        "{error}"
    );
    // The file is missing.
    std::fs::remove_file(&path).unwrap();
    assert!(means(&results).unwrap_err().to_string().contains("is damaged (No such file"));
    // The same content is in a new file.
    std::fs::write(&path, &whole).unwrap();
    assert!(means(&results).unwrap().equals_missing(&before));
    // The run is done again, with other numbers.
    write_runs(&results, "many", 7..8, 0.3);
    let after = means(&results).unwrap();
    assert_eq!(after.height(), before.height());
    let differing = (0..after.height()).filter(|row| after.get(*row) != before.get(*row)).count();
    assert_eq!(differing, 1);
    assert_same(&answers(&results), &plain_answers(&results));
    // The run is removed.
    std::fs::remove_dir_all(folder(&results, "many", 7)).unwrap();
    assert_eq!(means(&results).unwrap().height(), 69);
}

#[test]
fn damage_to_a_compacted_table_is_noticed_and_repaired() {
    let results = fresh("compacted-damaged");
    write_runs(&results, "many", 0..80, 0.1);
    write_runs(&results, "other", 0..80, 0.4);
    std::thread::sleep(SETTLED);
    let expected = plain_answers(&results);
    assert_same(&answers(&results), &expected);
    let whole = parts(&results, "many", "metrics");
    let (path, bytes) = whole.first_key_value().unwrap();
    let changed = |place: usize| {
        let mut bytes = bytes.clone();
        bytes[place] ^= 0x10;
        bytes
    };
    let of_other = parts(&results, "other", "metrics").into_values().next().unwrap();
    let of_epochs = parts(&results, "many", "epochs").into_values().next().unwrap();
    for damaged in [
        changed(5),
        changed(bytes.len() / 2),
        changed(bytes.len() - 20),
        bytes[..bytes.len() - 1].to_vec(),
        Vec::new(),
        of_other,
        of_epochs,
    ] {
        std::fs::write(path, damaged).unwrap();
        assert_same(&answers(&results), &expected);
        assert_eq!(parts(&results, "many", "metrics"), whole);
    }
}

/// The names of the runs that a plan remembers.
fn remembered(results: &Path, experiment: &str) -> BTreeSet<String> {
    let path = results.join("compacted").join(experiment).join("checks.json");
    let checks: serde_json::Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    checks["runs"].as_object().unwrap().keys().cloned().collect()
}

/// Whether each run of an experiment is done with intact files, as a plan sees it.
fn intact(results: &Path, experiment: &str) -> Vec<bool> {
    let registry = Registry::new(results);
    let known = registry.known(experiment);
    let is_intact = |record: &RunRecord| {
        let folder = registry.run(experiment, &record.spec, &record.dataset);
        registry.decide(&folder, &record.spec, &known).0 == Decision::Skip
    };
    let intact = registry.records().iter().map(is_intact).collect();
    known.remember();
    intact
}

#[test]
fn a_plan_remembers_intact_runs_until_a_file_is_touched() {
    let results = fresh("compacted-checks");
    write_runs(&results, "many", 0..70, 0.1);
    let checks = results.join("compacted/many/checks.json");
    let touched = Instant::now();
    for record in Registry::new(&results).records() {
        let network = results.join("runs/many").join(&record.run).join("prediction.safetensors");
        std::fs::write(network, "made up").unwrap();
    }
    assert_eq!(intact(&results, "many"), [true; 70]);
    assert!(
        !checks.exists() || touched.elapsed() > Duration::from_secs(2),
        "the files were written just now"
    );
    std::thread::sleep(SETTLED);
    for _ in 0..2 {
        assert_eq!(intact(&results, "many"), [true; 70]);
        assert_eq!(remembered(&results, "many").len(), 70);
    }
    let run = &Registry::new(&results).records()[3];
    let network = results.join("runs/many").join(&run.run).join("prediction.safetensors");
    let expected = |broken: &[usize]| (0..70).map(|run| !broken.contains(&run)).collect::<Vec<_>>();
    // The file is changed, but its size and modification time are not.
    let modified = std::fs::metadata(&network).unwrap().modified().unwrap();
    std::fs::write(&network, "made uP").unwrap();
    std::fs::File::options().write(true).open(&network).unwrap().set_modified(modified).unwrap();
    assert_eq!(intact(&results, "many"), expected(&[3]));
    std::fs::remove_file(&network).unwrap();
    assert_eq!(intact(&results, "many"), expected(&[3]));
    std::fs::write(&network, "made up").unwrap();
    assert_eq!(intact(&results, "many"), [true; 70]);
    // Damage to the file of checks only costs time.
    let mut bytes = std::fs::read(&checks).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&checks, bytes).unwrap();
    std::thread::sleep(SETTLED);
    assert_eq!(intact(&results, "many"), [true; 70]);
    assert!(seal::read(&checks).is_ok());
}

#[test]
fn removed_runs_are_forgotten() {
    let results = fresh("compacted-forgotten");
    write_runs(&results, "many", 0..70, 0.1);
    std::thread::sleep(SETTLED);
    assert_eq!(intact(&results, "many"), [true; 70]);
    let removed = folder(&results, "many", 3);
    std::fs::remove_dir_all(&removed).unwrap();
    write_runs(&results, "many", 70..140, 0.1);
    std::thread::sleep(SETTLED);
    assert_eq!(intact(&results, "many"), [true; 139]);
    let remembered = remembered(&results, "many");
    assert!(remembered.len() == 139 && !remembered.contains(removed.file_name().unwrap().to_str().unwrap()));
}

#[test]
fn compacted_tables_of_experiments_without_runs_are_removed() {
    let results = fresh("compacted-removed");
    write_runs(&results, "many", 0..70, 0.1);
    write_runs(&results, "other", 0..1, 0.1);
    std::thread::sleep(SETTLED);
    means(&results).unwrap();
    assert_eq!(parts(&results, "many", "metrics").len(), 1);
    succeed(&results, &["rm", "many", "--yes"]);
    assert!(!results.join("compacted/many").exists() && results.join("runs/other").exists());
}

#[test]
fn a_query_is_repeated_without_a_run_that_is_removed_meanwhile() {
    let results = fresh("compacted-meanwhile");
    write_runs(&results, "few", 0..3, 0.1);
    let removed = folder(&results, "few", 1);
    let removes = |_: &RunRecord| {
        let _ = std::fs::remove_dir_all(&removed);
        true
    };
    let sql = "select distinct seed from metrics order by seed";
    let answer = query_of(&Registry::new(&results), removes, sql).unwrap();
    let seeds: Vec<i64> = answer.columns()[0].i64().unwrap().iter().flatten().collect();
    assert_eq!(seeds, [0, 2]);
}

#[test]
fn processes_that_read_at_once_get_the_same_answers() {
    let results = fresh("compacted-at-once");
    write_runs(&results, "many", 0..150, 0.1);
    std::thread::sleep(SETTLED);
    let sql = "select seed, sum(value) as total from metrics group by seed order by seed";
    let said: Vec<String> = (0..6)
        .into_par_iter()
        .map(|process| {
            // Some processes start while others write.
            std::thread::sleep(Duration::from_millis(process * 40));
            let answer = finish(&mut harness(&results, &["query", sql]));
            assert_eq!((answer.code, answer.stderr.as_str()), (0, ""));
            answer.stdout
        })
        .collect();
    assert!(said.iter().all(|other| *other == said[0] && other.contains("149")), "{said:?}");
    assert_eq!(parts(&results, "many", "metrics").len(), 1);
    assert_same(&answers(&results), &plain_answers(&results));
}

#[test]
fn published_runs_are_neither_compacted_nor_remembered() {
    let (results, copy) = (fresh("compacted-from"), fresh("compacted-published"));
    write_runs(&results, "many", 0..70, 0.1);
    let registry = Registry::new(&results);
    let records = registry.records();
    let folders: Vec<PathBuf> =
        records.iter().map(|record| results.join("runs/many").join(&record.run)).collect();
    let chosen = folders.iter().map(PathBuf::as_path).zip(&records);
    harness::transfer::publish(
        &registry,
        chosen,
        &Registry::new(&copy),
        harness::transfer::Content::default(),
        &Silent,
    )
    .unwrap();
    std::thread::sleep(SETTLED);
    assert!(means(&copy).unwrap().equals_missing(&means(&results).unwrap()));
    assert_eq!(intact(&copy, "many"), [true; 70]);
    assert!(!copy.join("compacted").exists());
    assert!(results.join("compacted").exists());
}
