//! Rows of further horizons, and of models that got only some inputs: where they are, and that nothing else sees them.

use crate::common::{SMOKE, copy_folder, finish, fresh, harness, succeed};
use harness::schema::{GIVEN, HORIZON, Table};
use harness::tables::{Stamp, TableFile, write_table};
use harness::{catalog, registry::Registry, seal};
use polars::prelude::*;
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};

/// Commands whose answers must not depend on further rows. `{}` is a folder of their own.
const COMMANDS: [&[&str]; 17] = [
    &["ls"],
    &["verify"],
    &["show", "senses/empty-z64-role=angles-seed0"],
    &["compare"],
    &["compare", "multi_to_multi", "--models", "network,ridge"],
    &["compare", "senses", "--format", "csv"],
    &["claims"],
    &["claims", "--format", "csv"],
    &["claims", "--readings", "--format", "csv"],
    &["query", "select count(*), avg(value) from metrics"],
    &["query", "select model, metric, avg(value), count(*) from metrics group by all order by all"],
    &["query", "select task, modality, avg(predicted), count(*) from predictions group by all order by all"],
    &["query", "select count(*) from frames"],
    &[
        "plot",
        "multi_to_multi",
        "--x",
        "latent",
        "--y",
        "r2",
        "--by",
        "modality",
        "--facet",
        "scenario",
        "-o",
        "{}/plot.svg",
    ],
    &["figures", "--output", "{}/figures", "--format", "svg"],
    &["figures", "readings", "--output", "{}/figures", "--format", "svg"],
    &["report", "--output", "{}/report.html"],
];

/// The folders of all runs below a results folder.
fn runs(results: &Path) -> Vec<PathBuf> {
    let pattern = results.join("runs/*/*/run.json");
    let records = glob::glob(pattern.to_str().unwrap()).unwrap().map(Result::unwrap);
    records.map(|record| record.parent().unwrap().to_owned()).collect()
}

/// Adds rows to a run: those that it has, 5 samples ahead, and those of a model that got only the arm. Their values are
/// far from those of the run.
fn add_further_rows(run: &Path) {
    let path = run.join("run.json");
    let mut record: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    for (table, value) in [(Table::AllMetrics, "value"), (Table::AllPredictions, "predicted")] {
        let usual = run.join(table.usual().unwrap().file_name());
        if !usual.exists() {
            continue;
        }
        let rows = TableFile::open(&usual)
            .unwrap()
            .table(None)
            .unwrap()
            .lazy()
            .with_column(col(value) + lit(1000.0));
        let with = |horizon: i64, given: Option<&'static str>| {
            let given = given.map_or(lit(NULL).cast(DataType::String), lit);
            rows.clone().with_columns([lit(horizon).cast(DataType::Int64).alias(HORIZON), given.alias(GIVEN)])
        };
        let further = concat([with(5, None), with(1, Some("arm"))], UnionArgs::default()).unwrap();
        let further = further.collect().unwrap();
        let count = further.height();
        let name = table.file_name();
        write_table(&run.join(&name), further, &table.columns(), &Stamp::new()).unwrap();
        let bytes = fs::read(run.join(&name)).unwrap();
        let sha256 = seal::hex(&<sha2::Sha256 as sha2::Digest>::digest(&bytes));
        record["files"][&name] = json!({ "bytes": bytes.len(), "rows": count, "sha256": sha256 });
    }
    record[seal::KEY] = seal::BLANK.into();
    seal::write(&path, format!("{record:#}\n").into_bytes()).unwrap();
}

/// What a command prints and writes, without the path of the results folder.
fn answer(results: &Path, command: &[&str]) -> (i32, String, Vec<(String, Vec<u8>)>) {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().to_str().unwrap();
    let arguments: Vec<String> = command.iter().map(|argument| argument.replace("{}", place)).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let answer = finish(&mut harness(results, &arguments));
    let plain = |text: String| text.replace(place, "").replace(results.to_str().unwrap(), "");
    let written = glob::glob(&format!("{place}/**/*.*")).unwrap().map(Result::unwrap);
    let written = written.filter(|path| path.is_file()).map(|path| {
        let text = String::from_utf8_lossy(&fs::read(&path).unwrap()).into_owned();
        (path.strip_prefix(place).unwrap().display().to_string(), plain(text).into_bytes())
    });
    let written = written.collect();
    (answer.code, plain(answer.stdout + &answer.stderr), written)
}

#[test]
fn further_rows_change_no_other_answer() {
    let reference = Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference");
    let [plain, further] = ["horizons_plain", "horizons_further"].map(fresh);
    copy_folder(&reference.join("runs"), &plain.join("runs"));
    copy_folder(&reference.join("runs"), &further.join("runs"));
    let added = runs(&further);
    assert!(added.len() > 100);
    added.iter().for_each(|run| add_further_rows(run));
    for command in COMMANDS {
        let (expected, found) = (answer(&plain, command), answer(&further, command));
        assert_eq!(expected.0, 0, "{command:?}: {}", expected.1);
        assert_eq!(expected.2.len(), found.2.len(), "{command:?}");
        for ((name, bytes), (_, others)) in expected.2.iter().zip(&found.2) {
            assert!(bytes == others, "{command:?} writes another {name}");
        }
        // `verify` counts files, and there are more. `report` says how long it draws.
        if !["verify", "report"].contains(&command[0]) {
            assert_eq!(expected.1, found.1, "{command:?}");
        }
    }
    let count = |results: &Path, table: &str| {
        let answer = catalog::query(&Registry::new(results), &format!("select count(*) as n from {table}"));
        answer.unwrap().column("n").unwrap().get(0).unwrap().try_extract::<i64>().unwrap()
    };
    for table in ["metrics", "predictions"] {
        let all = format!("all_{table}");
        let usual = count(&plain, table);
        assert_eq!((count(&plain, &all), count(&further, table)), (usual, usual), "{table}");
        assert_eq!(count(&further, &all), 3 * usual, "{table}");
        let of = |condition: &str| count(&further, &format!("{all} where {condition}"));
        assert_eq!(of("horizon = 5 and given is null"), usual);
        assert_eq!(of("horizon = 1 and given = 'arm'"), usual);
        assert_eq!(of("horizon <= 1 and given is null"), usual);
        assert_eq!(of("horizon = 0 and task = 'prediction'"), 0);
    }
    [plain, further].iter().for_each(|folder| fs::remove_dir_all(folder).unwrap());
}

#[test]
fn a_run_with_a_horizon_is_judged_at_each_distance() {
    let results = fresh("horizons_run");
    let vectors = ["input=[proprioception]", "output=[proprioception, contact_force]", "scenarios=[empty]"];
    let run = [&["run", SMOKE], &vectors[..], &["window.horizon=4", "window.context=2"]].concat();
    succeed(&results, &run);
    let registry = Registry::new(&results);
    let rows = |sql: &str| catalog::query(&registry, sql).unwrap();
    let horizons = rows("select distinct task, horizon from all_metrics order by task, horizon");
    assert_eq!(horizons.height(), 4);
    let horizons: Vec<i64> = horizons.column("horizon").unwrap().i64().unwrap().into_no_null_iter().collect();
    assert_eq!(horizons, [1, 2, 4, 0]);
    let models = rows("select distinct model from all_metrics where horizon = 4 order by model");
    assert_eq!(models.height(), 4);
    // Predicted samples are those after the present ones: the first window's present sample is the second one.
    let first = rows(
        "select horizon, min(sample) as first, max(sample) as last from all_predictions
                      where task = 'prediction' group by horizon order by horizon",
    );
    let values =
        |name: &str| first.column(name).unwrap().i64().unwrap().into_no_null_iter().collect::<Vec<_>>();
    assert_eq!(values("first"), [2, 3, 5]);
    let last = values("last");
    assert_eq!([last[1] - last[0], last[2] - last[1]], [1, 2]);
    // Every horizon has the same reference where they predict the same sample.
    let pairs = rows(
        "select count(*) as n, max(abs(a.reference - b.reference)) as most
                      from all_predictions a join all_predictions b
                        on a.episode = b.episode and a.sample = b.sample and a.modality = b.modality
                       and a.index = b.index and a.task = b.task
                      where a.horizon = 1 and b.horizon = 4",
    );
    assert_eq!(pairs.column("most").unwrap().get(0).unwrap().try_extract::<f64>().unwrap(), 0.0);
    assert!(succeed(&results, &["verify"]).contains("all files are intact"));
    assert!(succeed(&results, &[&run[..], &["--dry-run"]].concat()).contains("done"));
    let published = fresh("horizons_published");
    succeed(&results, &["publish", "smoke", "--output", published.to_str().unwrap()]);
    let count = "select count(*) from all_metrics where horizon = 4";
    assert_eq!(succeed(&results, &["query", count]), succeed(&published, &["query", count]));
    let refused = finish(&mut harness(&results, &["run", SMOKE, "window.horizon=2"]));
    assert!(refused.code == 2 && refused.stderr.contains("add it to the output"), "{}", refused.stderr);
}
