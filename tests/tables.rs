//! The result tables, read with other programs: pyarrow, pandas, DuckDB, Polars, scikit-learn.

use crate::common::{smoke_run, succeed};
use harness::schema::{Column, Table, image_columns, sample_columns};
use harness::simulation::Scene;
use harness::spec::{Layout, Scenario};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, LazyLock};

/// The output of tests/python/read_tables.py for a results folder.
#[derive(Deserialize)]
struct Answer {
    files: Vec<File>,
    metrics: Vec<Metric>,
}

#[derive(Deserialize)]
struct File {
    path: PathBuf,
    /// The number of rows that each reader finds.
    rows: BTreeMap<String, usize>,
    columns: Vec<String>,
    metadata: BTreeMap<String, String>,
}

/// A metric of the table, and the value that scikit-learn and NumPy compute from the predictions.
#[derive(Debug, Deserialize)]
struct Metric {
    run: String,
    task: String,
    modality: String,
    direction: Option<String>,
    index: Option<u32>,
    metric: String,
    table: Option<f64>,
    computed: Option<f64>,
}

static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| smoke_run("tables"));
static ANSWER: LazyLock<Answer> = LazyLock::new(|| {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new(root.join(".venv/bin/python"))
        .arg(root.join("tests/python/read_tables.py"))
        .arg(&*RESULTS)
        .output()
        .expect("the virtual environment of the tests is there: `make test` sets it up");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
});

impl File {
    fn table(&self) -> Table {
        let name = self.path.file_stem().unwrap().to_str().unwrap();
        let table = Table::ALL.into_iter().find(|table| table.name() == name);
        table.unwrap_or_else(|| {
            assert!(name.starts_with("episode_"), "{name}");
            Table::Episodes
        })
    }

    /// The columns that the file must have.
    fn expected_columns(&self) -> Vec<Column> {
        if self.table() != Table::Episodes {
            return self.table().columns();
        }
        let is_of =
            |scenario: &Scenario| self.path.to_string_lossy().contains(&format!("datasets/{scenario}-"));
        let layout = layout_of(Scenario::PAPER.into_iter().find(is_of).unwrap());
        [sample_columns(&layout), image_columns(&layout)].concat()
    }
}

fn layout_of(scenario: Scenario) -> Arc<Layout> {
    Scene::paper(scenario).unwrap().layout().clone()
}

#[test]
fn every_table_opens_in_every_reader_with_the_same_rows() {
    // Two scenarios of four episodes, and two runs of six tables.
    assert_eq!(ANSWER.files.len(), 2 * 4 + 2 * 6);
    for File { path, rows, .. } in &ANSWER.files {
        assert_eq!(rows.keys().collect::<Vec<_>>(), ["duckdb", "pandas", "polars", "pyarrow"]);
        let first = rows["pyarrow"];
        assert!(rows.values().all(|count| *count == first) && first > 0, "{}: {rows:?}", path.display());
    }
    for file in ANSWER.files.iter().filter(|file| file.table() == Table::Episodes) {
        assert_eq!(file.rows["pyarrow"], 30);
    }
    let rows = |table| {
        ANSWER.files.iter().filter(move |file| file.table() == table).map(|file| file.rows["pyarrow"])
    };
    // Forces: two kinds on 20 links, for the dataset and its four episodes. Frames: five test transitions of two tasks.
    assert_eq!(rows(Table::Forces).collect::<Vec<_>>(), [2 * 5 * 20; 2]);
    assert_eq!(rows(Table::Frames).collect::<Vec<_>>(), [5 * 2; 2]);
    // The test episode has 29 transitions. Joints and forces are predicted, and joints are reconstructed: 3 times 20.
    for file in ANSWER.files.iter().filter(|file| file.table() == Table::Predictions) {
        assert_eq!(file.rows["pyarrow"], 29 * 20 * 3);
    }
}

#[test]
fn every_file_describes_its_columns_with_units() {
    for file in &ANSWER.files {
        let described: serde_json::Value = serde_json::from_str(&file.metadata["harness.columns"]).unwrap();
        let expected = file.expected_columns();
        assert_eq!(described, serde_json::to_value(&expected).unwrap(), "{}", file.path.display());
        let names: Vec<&str> = expected.iter().map(|column| column.name.as_str()).collect();
        assert_eq!(file.columns, names, "{}", file.path.display());
    }
}

#[test]
fn the_printed_schema_says_the_same_as_the_files() {
    let printed = succeed(&RESULTS, &["schema", "--tables"]);
    let mut tables: BTreeMap<&str, Vec<(String, String, String)>> = BTreeMap::new();
    let mut table = "";
    for line in printed.lines() {
        match line.strip_prefix("  ") {
            None => table = line.split_once(": ").unwrap().0,
            Some(column) => {
                let (name, rest) = column.split_once(' ').unwrap();
                let rest = &rest[28 - name.len()..];
                let (unit, meaning) = rest.split_at(8);
                let row = (name.to_owned(), unit.trim().to_owned(), meaning.to_owned());
                tables.entry(table).or_default().push(row);
            }
        }
    }
    for table in Table::ALL {
        let columns = match table {
            Table::Episodes => sample_columns(&layout_of(Scenario::CLUTTERED)),
            _ => table.columns(),
        };
        let expected: Vec<_> = columns
            .into_iter()
            .map(|column| (column.name, column.unit.into_owned(), column.meaning))
            .collect();
        assert_eq!(tables[table.name()], expected, "{}", table.name());
    }
    assert_eq!(tables.len(), Table::ALL.len());
}

#[test]
fn every_file_says_what_made_it() {
    for file in &ANSWER.files {
        let keys: &[&str] = match file.table() {
            Table::Episodes => &["dataset", "episode", "renderer", "simulation_seed"],
            _ => {
                &["run", "spec_hash", "dataset", "seed", "git_commit", "git_dirty", "candle_version", "host"]
            }
        };
        for key in keys.iter().chain(&["harness_version", "mujoco_version", "seal"]) {
            let value = file.metadata.get(&format!("harness.{key}"));
            assert!(value.is_some_and(|value| !value.is_empty()), "{}: {key}", file.path.display());
        }
        assert_eq!(file.metadata["harness.mujoco_version"], "3.17.0");
        let folder = file.path.parent().unwrap().file_name().unwrap().to_str().unwrap();
        let named = if file.table() == Table::Episodes { "harness.dataset" } else { "harness.run" };
        assert_eq!(file.metadata[named], folder);
    }
}

#[test]
fn metrics_are_those_of_scikit_learn_on_written_predictions() {
    for metric in &ANSWER.metrics {
        match (metric.table, metric.computed) {
            (Some(table), Some(computed)) => {
                assert!((table - computed).abs() <= 1e-6 * computed.abs().max(1.0), "{metric:?}");
            }
            (table, computed) => assert!(table.is_none() && computed.is_none(), "{metric:?}"),
        }
    }
    // Two runs, with two modalities of the prediction and one of the reconstruction; four metrics overall, by direction
    // and by joint or link. Those of forces are there by kind of contact as well, overall and by direction.
    let of_forces_by_kind = |kinds_of_contact: usize| (1 + 2) * (4 * kinds_of_contact + 2);
    let by_kind = of_forces_by_kind(1) + of_forces_by_kind(2);
    assert_eq!(ANSWER.metrics.len(), 2 * 3 * (1 + 2 + 20) * 4 + by_kind);
    // Nothing touches a box in the test episode.
    let overall = |metric: &&Metric| {
        metric.direction.is_none() && metric.index.is_none() && !metric.metric.ends_with("_box")
    };
    let defined = |metric: &Metric| metric.table.is_some();
    assert!(ANSWER.metrics.iter().filter(overall).all(defined), "the overall metrics are defined");
    let one = |task: &str, modality: &str, name: &str| {
        ANSWER.metrics.iter().any(|metric| {
            metric.run.starts_with("cluttered-z4-seed0-")
                && (metric.task.as_str(), metric.modality.as_str(), metric.metric.as_str())
                    == (task, modality, name)
        })
    };
    assert!(one("prediction", "proprioception", "smape") && one("prediction", "contact_force", "wmape"));
    assert!(one("reconstruction", "proprioception", "r2"));
}

/// Names of runs contain `=`, which readers take for columns.
#[test]
fn the_documented_query_of_duckdb_adds_no_column_for_the_names_of_folders() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let page = std::fs::read_to_string(root.join("docs/tables.md")).unwrap();
    let line = page.lines().find(|line| line.contains("duckdb.sql(\"select * from read_parquet(")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let run = std::fs::read_dir(RESULTS.join("runs/smoke")).unwrap().next().unwrap().unwrap().path();
    for name in ["empty-z4-change=a-seed0-00000000", "empty-z4-change=b-seed0-11111111"] {
        let copy = folder.path().join("results/runs/smoke").join(name);
        std::fs::create_dir_all(&copy).unwrap();
        std::fs::copy(run.join("metrics.parquet"), copy.join("metrics.parquet")).unwrap();
    }
    let columns = |line: &str| {
        let script = format!("import duckdb\n{line}\nprint(' '.join(metrics.columns))");
        let python =
            Command::new(root.join(".venv/bin/python")).args(["-c", &script]).current_dir(&folder).output();
        let names = String::from_utf8(python.unwrap().stdout).unwrap();
        names.split_whitespace().map(str::to_owned).collect::<Vec<_>>()
    };
    let documented = columns(line);
    assert!(documented.contains(&"metric".to_owned()), "{documented:?}");
    let guessed = columns(&line.replace(", hive_partitioning=false", ""));
    assert_eq!(guessed, [&documented[..], &["empty-z4-change".to_owned()]].concat());
}

#[test]
fn an_answer_written_to_a_file_opens_elsewhere_too() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("runs.parquet");
    succeed(&RESULTS, &["query", "select * from runs", "--output", path.to_str().unwrap()]);
    let script = "import duckdb, sys; print(duckdb.from_parquet(sys.argv[1]).columns)";
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv/bin/python");
    let output = Command::new(python).args(["-c", script]).arg(&path).output().unwrap();
    let printed = String::from_utf8_lossy(&output.stdout).replace('\'', "\"");
    let names: Vec<String> = serde_json::from_str(&printed).unwrap();
    assert_eq!(names, Table::Runs.columns().into_iter().map(|column| column.name).collect::<Vec<_>>());
}
