//! Rows of further horizons, and of models that got only some inputs: where they are, and that nothing else sees them.

use crate::common::{SMOKE, divide, finish, fresh, harness, in_chromium, published_only, succeed};
use crate::figures::assert_whole;
use harness::analysis::{LEVEL, mean_interval};
use harness::experiment::rollout;
use harness::registry::{Registry, read_columns};
use harness::schema::{GIVEN, HORIZON, Table};
use harness::spec::Modality;
use harness::tables::{Stamp, write_table};
use harness::{catalog, seal};
use image::AnimationDecoder;
use image::codecs::gif::GifDecoder;
use polars::prelude::*;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::LazyLock;

/// Commands whose answers must not depend on further rows. `{}` is a folder of their own.
const COMMANDS: [&[&str]; 16] = [
    &["ls"],
    &["verify"],
    &["show", "which_sense/empty-z64-senses=finger-seed0"],
    &["diff", "which_sense/empty-z64-senses=finger-seed0", "which_sense/empty-z64-senses=arm-seed0"],
    &["compare"],
    &["compare", "reproduction", "--models", "network,ridge"],
    &["compare", "which_sense", "--format", "csv"],
    &["claims"],
    &["claims", "--format", "csv"],
    &["query", "select count(*), avg(value) from metrics"],
    &["query", "select model, metric, avg(value), count(*) from metrics group by all order by all"],
    &["query", "select task, modality, avg(predicted), count(*) from predictions group by all order by all"],
    &["query", "select count(*) from frames"],
    &[
        "plot",
        "reproduction",
        "--where",
        "role=single_to_multi",
        "--where",
        "reading=base",
        "--x",
        "latent",
        "--metrics",
        "r2",
        "--by",
        "modality",
        "--facet",
        "scenario",
        "-o",
        "{}/plot.svg",
    ],
    &["figures", "--output", "{}/figures", "--format", "svg"],
    &["report", "--output", "{}/report.html"],
];

/// The arguments that make runs of vectors, with two seeds, which predict four samples ahead.
const RUN: [&str; 8] = [
    "run",
    SMOKE,
    "input=[proprioception]",
    "output=[proprioception, contact_force]",
    "scenarios=[empty]",
    "window.horizon=4",
    "window.context=2",
    "seeds=[0,1]",
];

pub static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| {
    let results = fresh("horizons_run");
    succeed(&results, &RUN);
    results
});

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
        let columns: Vec<String> =
            table.usual().unwrap().columns().into_iter().map(|column| column.name).collect();
        let rows = read_columns(&fs::read(&usual).unwrap(), &columns, None).unwrap();
        let rows = rows.lazy().with_column(col(value) + lit(1000.0));
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
    // The page escapes paths.
    let escaped = results.to_str().unwrap().replace('/', "&#x2f;");
    let plain =
        |text: String| text.replace(place, "").replace(results.to_str().unwrap(), "").replace(&escaped, "");
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
    let [plain, further] = ["horizons_plain", "horizons_further"]
        .map(|name| published_only(&["oracle", "reproduction", "which_sense"], name));
    // Some runs have further rows already, and two datasets are enough, or one of the largest experiment.
    for results in [&plain, &further] {
        let is_of_more = |run: &str| {
            ["-data2-", "-data3-"].iter().any(|part| run.contains(part))
                || run.contains("-data1-") && run.contains("role=")
        };
        divide(results, |record| !is_of_more(&record.run) && !record.has(Table::AllMetrics));
    }
    let added = runs(&further);
    assert!(added.len() > 30);
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
    let means = |given: &[&str]| -> Vec<f64> {
        let asked = ["compare", "which_sense", "--models", "network", "--metrics", "r2", "--format", "json"];
        let said = succeed(&further, &[&asked[..], given].concat());
        let rows: Vec<Value> = serde_json::from_str(&said).unwrap();
        rows.iter().map(|row| row["mean"].as_f64().unwrap()).collect()
    };
    let pairs: Vec<_> = means(&[]).into_iter().zip(means(&["--given", "arm"])).collect();
    assert!(!pairs.is_empty() && pairs.iter().all(|(usual, arm)| (arm - usual - 1000.0).abs() < 1e-6));
    let refused = finish(&mut harness(&further, &["compare", "--given", "vision"])).stderr;
    assert!(
        refused.contains("no model got only vision of its run's inputs; some got only arm\n"),
        "{refused}"
    );
    let pages = [&plain, &further].map(|results| served_of_next_sample(results));
    assert_eq!(pages[0], pages[1]);
    // What copies the runs takes the further rows along, and changes no other.
    let moved = [&plain, &further].map(|results| moved(results));
    for (expected, found) in moved[0].iter().zip(&moved[1]) {
        for command in &COMMANDS[..COMMANDS.len() - 3] {
            if ["verify", "show", "claims"].contains(&command[0]) || command.contains(&"reproduction") {
                continue;
            }
            assert_eq!(
                answer(expected, command),
                answer(found, command),
                "{command:?} in {}",
                found.display()
            );
        }
        assert_eq!(count(found, "all_metrics"), 3 * count(expected, "metrics"));
        fs::remove_dir_all(expected).and_then(|()| fs::remove_dir_all(found)).unwrap();
    }
    [plain, further].iter().for_each(|folder| fs::remove_dir_all(folder).unwrap());
}

#[test]
fn the_last_samples_of_episodes_are_estimated_from_images_too() {
    let results = fresh("horizons_present");
    let present = ["window.horizon=0", "scenarios=[empty]", "input=[vision]", "tasks=[prediction]"];
    succeed(&results, &[&["run", SMOKE, "output=[contact_force,frame_difference]"][..], &present].concat());
    let sql = "select count(distinct sample) as n from frames where modality = 'frame_difference'";
    let frames = catalog::query(&Registry::new(&results), sql).unwrap();
    assert_eq!(frames.column("n").unwrap().get(0).unwrap().try_extract::<i64>().unwrap(), 5);
}

/// What `harness serve` answers to requests, each a method, a path and a body.
pub fn served(results: &Path, requests: &[(&str, &str, &str)]) -> Vec<Value> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_harness"));
    let command = command.arg("--results").arg(results).args(["serve", "--port", "0"]);
    let mut server = Serving(command.stdout(Stdio::piped()).spawn().unwrap());
    let mut address = String::new();
    BufReader::new(server.0.stdout.take().unwrap()).read_line(&mut address).unwrap();
    let url = address.split_whitespace().next().unwrap();
    let host = url.trim_start_matches("http://").trim_end_matches('/');
    let ask = |(method, path, body): &(&str, &str, &str)| {
        let mut stream = TcpStream::connect(host).unwrap();
        let length = body.len();
        let head =
            format!("{method} {path} HTTP/1.1\r\nHost: {host}\r\nContent-Length: {length}\r\n\r\n{body}");
        stream.write_all(head.as_bytes()).unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        assert!(head.starts_with("HTTP/1.1 200 OK") && body.len() > 1000, "{answer}");
        let mut body: Value = serde_json::from_str(body).unwrap();
        // What is about further horizons, and how long a query took.
        if let Some(values) = body.as_object_mut() {
            values.retain(|name, _| !["horizons", "seconds"].contains(&name.as_str()));
        }
        body
    };
    requests.iter().map(ask).collect()
}

/// What `harness serve` sends of metrics of the next sample: of a run, of a query, and the claims.
fn served_of_next_sample(results: &Path) -> Vec<Value> {
    let run =
        runs(results).into_iter().find(|run| run.to_str().unwrap().contains("which_sense/empty")).unwrap();
    let run = format!("which_sense/{}", run.file_name().unwrap().to_str().unwrap());
    let sql =
        "select run, metric, avg(value) as mean, count(*) as rows from metrics group by all order by all";
    let run = format!("/api/run?run={}", run.replace('/', "%2F").replace('=', "%3D"));
    served(results, &[("GET", &run, ""), ("GET", "/api/claims", ""), ("POST", "/api/sql", sql)])
}

/// A server that is stopped when this value is dropped, also if the test fails.
struct Serving(Child);

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.0.kill().and_then(|()| self.0.wait());
    }
}

/// A published copy of an experiment's runs, and a complete one.
fn moved(results: &Path) -> [PathBuf; 2] {
    let place = |name: &str| fresh(&format!("{name}_{}", results.file_name().unwrap().to_str().unwrap()));
    let [copy, complete] = ["copied", "complete"].map(place);
    succeed(results, &["publish", "which_sense", "--output", copy.to_str().unwrap()]);
    succeed(results, &["publish", "which_sense", "--complete", "--output", complete.to_str().unwrap()]);
    [copy, complete]
}

#[test]
fn a_run_with_a_horizon_is_judged_at_each_distance() {
    let results = &*RESULTS;
    let registry = Registry::new(results);
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
    assert!(succeed(results, &["verify"]).contains("all files are intact"));
    assert!(succeed(results, &[&RUN[..], &["--dry-run"]].concat()).contains("done"));
    let published = fresh("horizons_published");
    succeed(results, &["publish", "smoke", "--output", published.to_str().unwrap()]);
    let count = "select count(*) from all_metrics where horizon = 4";
    assert_eq!(succeed(results, &["query", count]), succeed(&published, &["query", count]));
    let refused = finish(&mut harness(results, &["run", SMOKE, "window.horizon=2"]));
    assert!(refused.code == 2 && refused.stderr.contains("add it to the output"), "{}", refused.stderr);
}

/// The numbers of a file of comma-separated values, and the texts beside them.
fn csv(path: &Path) -> DataFrame {
    CsvReader::new(fs::File::open(path).unwrap()).finish().unwrap()
}

fn number(table: &DataFrame, column: &str, row: usize) -> Option<f64> {
    let value = table.column(column).unwrap().get(row).unwrap();
    (!value.is_null()).then(|| value.try_extract::<f64>().unwrap())
}

fn text(table: &DataFrame, column: &str, row: usize) -> String {
    table.column(column).unwrap().get(row).unwrap().str_value().into_owned()
}

/// The means of a comparison, as they are written to a file.
fn compared(results: &Path, arguments: &[&str]) -> DataFrame {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("means.csv");
    succeed(results, &[&["compare", "smoke"], arguments, &["--output", path.to_str().unwrap()]].concat());
    csv(&path)
}

/// The skill by model, modality and horizon, of each run, from the squared errors in the tables.
fn skills() -> BTreeMap<(String, String, i64), Vec<f64>> {
    let rows = catalog::query(
        &Registry::new(&*RESULTS),
        "select run, model, modality, horizon, value from all_metrics \
         where metric = 'rmse' and task = 'prediction' and index is null and direction is null order by run",
    );
    let rows = rows.unwrap();
    let key = |row, model: &str| {
        let horizon = number(&rows, "horizon", row).unwrap() as i64;
        (text(&rows, "run", row), model.to_owned(), text(&rows, "modality", row), horizon)
    };
    let error = |row| number(&rows, "value", row).unwrap().powi(2);
    let errors: BTreeMap<_, f64> =
        (0..rows.height()).map(|row| (key(row, &text(&rows, "model", row)), error(row))).collect();
    let mut skills: BTreeMap<_, Vec<f64>> = BTreeMap::new();
    for ((run, model, modality, horizon), error) in &errors {
        if model != "persistence" {
            let own = (run.clone(), "persistence".to_owned(), modality.clone(), *horizon);
            let skill = 1.0 - error / errors[&own];
            skills.entry((model.clone(), modality.clone(), *horizon)).or_default().push(skill);
        }
    }
    skills
}

#[test]
fn predictions_from_a_time_on_have_metrics_of_their_own() {
    let results = fresh("horizons_since");
    succeed(&results, &[&RUN[..7], &["window.since_s=[1,2]"]].concat());
    let rows = |results: &Path, sql: &str| catalog::query(&Registry::new(results), sql).unwrap();
    for since_s in [1, 2] {
        // Ten samples a second. Elements whose reference is constant have no R2.
        let expected = format!(
            "select task, modality, horizon, sqrt(sum(squared) / sum(n)) as rmse, sum(absolute) / sum(n) as mae,
                    1 - sum(case when spread > 0 then squared end) / sum(spread) as r2
             from (select task, modality, horizon, count(*) as n, variance(reference) * (count(*) - 1) as spread,
                          sum(pow(predicted - reference, 2)) as squared, sum(abs(predicted - reference)) as absolute
                   from all_predictions where sample >= {} group by task, modality, horizon, index)
             group by task, modality, horizon order by task, modality, horizon",
            10 * since_s
        );
        let expected = rows(&results, &expected);
        // Two modalities at three distances, and the reconstructed angles.
        assert_eq!(expected.height(), 2 * 3 + 1);
        for metric in ["rmse", "mae", "r2"] {
            let found = format!(
                "select task, modality, horizon, value from all_metrics
                 where metric = '{metric}_from_{since_s}s' and model = 'network' and direction is null
                 order by task, modality, horizon"
            );
            let found = rows(&results, &found);
            assert_eq!(found.height(), expected.height(), "only rows of all elements together");
            for row in 0..found.height() {
                let key = |table| ["task", "modality", "horizon"].map(|column| text(table, column, row));
                assert_eq!(key(&found), key(&expected));
                let (value, expected) = (number(&found, "value", row), number(&expected, metric, row));
                let (value, expected) = (value.unwrap(), expected.unwrap());
                assert!(
                    (value - expected).abs() < 1e-5 * (1.0 + expected.abs()),
                    "{metric}: {value} {expected}"
                );
            }
        }
    }
    // The baselines have them too, and a comparison shows them.
    let compared = compared(&results, &["--metrics", "r2_from_2s", "--task", "prediction"]);
    let models: BTreeSet<String> = (0..compared.height()).map(|row| text(&compared, "model", row)).collect();
    assert_eq!(models.len(), 4);
    // All other rows are those without the setting.
    let others =
        "select task, model, modality, horizon, direction, index, metric, value, unit from all_metrics
                  where run like 'empty-z4-seed0-%' and metric not like '%from%' order by all";
    let [with, without] = [&results, &*RESULTS].map(|results| rows(results, others));
    assert!(with.equals_missing(&without) && with.height() > 100);
    let none = rows(&RESULTS, "select count(*) as n from all_metrics where metric like '%from%'");
    assert_eq!(number(&none, "n", 0), Some(0.0));
    fs::remove_dir_all(&results).unwrap();
}

#[test]
fn the_skill_compares_squared_errors_with_persistence() {
    let found = compared(&RESULTS, &["--by", "horizon", "--metrics", "skill"]);
    let expected = skills();
    // Three models beside persistence, two modalities, three horizons.
    assert_eq!((found.height(), expected.len()), (18, 18));
    for row in 0..found.height() {
        let horizon = number(&found, "horizon", row).unwrap() as i64;
        let (model, modality) = (text(&found, "model", row), text(&found, "modality", row));
        let values = &expected[&(model.clone(), modality, horizon)];
        // A baseline has one value for each dataset.
        let values = if model == "network" { &values[..] } else { &values[..1] };
        let interval = mean_interval(values, LEVEL).unwrap();
        let close = |found: Option<f64>, expected: Option<f64>| match (found, expected) {
            (Some(found), Some(expected)) => (found - expected).abs() < 1e-9,
            (found, expected) => found == expected,
        };
        assert!(close(number(&found, "mean", row), Some(interval.mean)), "{row}: {values:?}");
        assert!(close(number(&found, "low", row), interval.bounds.map(|(low, _)| low)), "{row}: {values:?}");
    }
    // Without the option, the horizon is that of the spec.
    let own = compared(&RESULTS, &["--metrics", "skill"]);
    let of_own: Vec<usize> =
        (0..found.height()).filter(|row| number(&found, "horizon", *row) == Some(4.0)).collect();
    let means = |table: &DataFrame, rows: &[usize]| -> Vec<Option<f64>> {
        rows.iter().map(|row| number(table, "mean", *row)).collect()
    };
    assert_eq!(means(&own, &(0..6).collect::<Vec<_>>()), means(&found, &of_own));
}

#[test]
fn the_skill_horizon_ends_before_the_first_skill_below_0() {
    // Ridge regression adds the increments to the arm's position, and the network is hardly trained.
    let results = fresh("horizons_arm");
    let settings =
        ["input=[arm]", "output=[arm]", "scenarios=[empty]", "tasks=[prediction]", "window.horizon=4"];
    succeed(&results, &[&["run", SMOKE], &settings[..]].concat());
    let skills = compared(&results, &["--by", "horizon", "--metrics", "skill"]);
    let of = |table: &DataFrame, row| (text(table, "model", row), text(table, "direction", row));
    let mut expected: BTreeMap<(String, String), BTreeMap<i64, f64>> = BTreeMap::new();
    for row in 0..skills.height() {
        let horizon = number(&skills, "horizon", row).unwrap() as i64;
        let skill = number(&skills, "mean", row).unwrap();
        expected.entry(of(&skills, row)).or_default().insert(horizon, skill);
    }
    let found = compared(&results, &["--metrics", "skill_horizon"]);
    // Three models, and elements in m and in rad.
    assert_eq!((found.height(), expected.len()), (6, 6));
    for row in 0..found.height() {
        let by_horizon = &expected[&of(&found, row)];
        let last = by_horizon.iter().take_while(|(_, skill)| **skill > 0.0).last();
        let last = last.map_or(0, |(horizon, _)| *horizon);
        assert_eq!(number(&found, "mean", row), Some(last as f64), "{by_horizon:?}");
        assert_eq!(text(&found, "unit", row), "samples");
        match text(&found, "model", row).as_str() {
            "ridge" => assert_eq!(last, 4),
            _ => assert!(last < 4, "{by_horizon:?}"),
        }
    }
    let printed = succeed(&results, &["compare", "smoke", "--metrics", "skill_horizon", "--by", "horizon"]);
    assert!(printed.contains("lower bound") && printed.contains("4.0"), "{printed}");
    fs::remove_dir_all(&results).unwrap();
}

#[test]
fn round_off_has_neither_r2_nor_skill() {
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("horizons_round_off"));
    let write = |name: &str, text: &str| {
        fs::write(folder.path().join(name), text).unwrap();
        folder.path().join(name).display().to_string()
    };
    // The arm moves in a plane, so the angle of the last joint is only the round-off of its motion.
    write(
        "arm.xml",
        r#"<mujoco><worldbody><body euler="0 0 30"><joint name="a" axis="0 1 0" damping=".1"/>
        <geom type="capsule" size=".04 .2" pos="0 0 -.3" mass="1"/>
        <body pos="0 0 -.6"><joint name="b" axis="1 0 0" damping=".1" stiffness="1"/>
        <geom type="capsule" size=".04 .2" pos="0 0 -.3" mass="1"/></body></body></worldbody>
        <actuator><position name="a" joint="a" kp="20" ctrlrange="-1 1"/></actuator></mujoco>"#,
    );
    write(
        "arm.yaml",
        "model: arm.xml\nstep_rate_hz: 500\nsample_rate_hz: 10\nmodalities:\n  moved: {joint_positions: a}\n  \
         still: {joint_positions: b}\naction: {seconds: 1, actuators: {a: {actuator: a, range: [-1, 1]}}}\n",
    );
    let spec = write(
        "arm_runs.yaml",
        "name: arm_runs\nscenarios: arm.yaml\ninput: [moved]\noutput: [moved, still]\nlatent: 2\n\
         network: {preset: multi_to_multi, hidden: [4]}\nsimulation: {episodes: 5, actuations_per_episode: 3}\n\
         training: {epochs: 1, batch_size: 8}\n",
    );
    succeed(&results, &["run", &spec]);
    let varying = "select value from metrics where modality = 'still' and metric = 'rmse' and value > 0";
    let errors = catalog::query(&Registry::new(&results), varying).unwrap();
    assert!(errors.height() > 0, "it varies");
    let said = succeed(&results, &["compare", "arm_runs", "--metrics", "r2,skill", "--format", "csv"]);
    assert!(said.contains(",moved,") && !said.contains(",still,"), "{said}");
    fs::remove_dir_all(&results).unwrap();
}

#[test]
fn horizons_are_columns_of_a_comparison() {
    let ask = ["compare", "smoke", "--metrics", "r2", "--models", "network", "--task", "prediction"];
    let as_markdown = ["--format", "markdown"];
    let usual = succeed(&RESULTS, &[&ask[..], &as_markdown].concat());
    let by_horizon = succeed(&RESULTS, &[&ask[..], &as_markdown, &["--by", "horizon"]].concat());
    let cells = |line: &str| line.split('|').map(|cell| cell.trim().replace('*', "")).collect::<Vec<_>>();
    let table = |text: &str| text.lines().filter(|line| line.starts_with('|')).map(cells).collect::<Vec<_>>();
    let (usual, table) = (table(&usual), table(&by_horizon));
    assert_eq!(table[0], ["", "", "horizon 1", "horizon 2", "horizon 4", ""]);
    assert_eq!(usual[0], ["", "", "latent 4", ""]);
    assert!(by_horizon.contains("horizons in samples of 0.1 s"), "{by_horizon}");
    // One horizon alone has the values of its column, and a time is a number of samples.
    let two = succeed(&RESULTS, &[&ask[..], &as_markdown, &["--horizon", "2"]].concat());
    assert_eq!(succeed(&RESULTS, &[&ask[..], &as_markdown, &["--horizon", "0.2s"]].concat()), two);
    let column = |table: &[Vec<String>], place: usize| -> Vec<[String; 2]> {
        table[2..].iter().map(|row| [row[1].clone(), row[place].clone()]).collect()
    };
    let cells_of_two = two.lines().filter(|line| line.starts_with('|')).map(cells).collect::<Vec<_>>();
    assert_eq!(column(&cells_of_two, 2), column(&table, 3), "{two}");
    assert!(two.contains("; predictions 2 samples (0.2 s) ahead; "), "{two}");
    // The default is the horizon of the spec.
    assert_eq!(column(&usual, 2), column(&table, 4));
    let refused = |arguments: &[&str]| finish(&mut harness(&RESULTS, &[&ask[..], arguments].concat())).stderr;
    assert_eq!(
        refused(&["--horizon", "3"]),
        "error: no run predicts 3 samples ahead; the runs predict 1, 2, 4 samples ahead\n"
    );
    assert!(refused(&["--horizon", "0.15s"]).contains("no run predicts 0.15 s ahead"));
    let chosen =
        succeed(&RESULTS, &[&ask[..], &as_markdown, &["--horizon", "1,4", "--by", "horizon"]].concat());
    let chosen = chosen.lines().filter(|line| line.starts_with('|')).map(cells).collect::<Vec<_>>();
    assert_eq!(chosen[0], ["", "", "horizon 1", "horizon 4", ""]);
    // A reconstruction is 0 samples ahead.
    let all = compared(&RESULTS, &["--by", "horizon", "--metrics", "r2"]);
    let of_task = |task: &str| {
        let rows = (0..all.height()).filter(|row| text(&all, "task", *row) == task);
        rows.map(|row| number(&all, "horizon", row).unwrap() as i64).collect::<BTreeSet<_>>()
    };
    assert_eq!((of_task("prediction"), of_task("reconstruction")), ([1, 2, 4].into(), [0].into()));
}

#[test]
fn a_metric_is_plotted_over_the_horizon() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let plot = |name: &str| {
        let path = path(name).display().to_string();
        let ask =
            ["plot", "smoke", "--x", "horizon", "--metrics", "skill", "--by", "modality", "--output", &path];
        succeed(&RESULTS, &ask);
    };
    plot("plot.csv");
    let (found, expected) = (csv(&path("plot.csv")), skills());
    assert_eq!(found.height(), 2 * 3);
    for row in 0..found.height() {
        let horizon = number(&found, "horizon", row).unwrap() as i64;
        let values = &expected[&("network".to_owned(), text(&found, "modality", row), horizon)];
        let mean = values.iter().sum::<f64>() / 2.0;
        assert!((number(&found, "mean", row).unwrap() - mean).abs() < 1e-9, "{row}");
    }
    plot("plot.svg");
    let svg = fs::read_to_string(path("plot.svg")).unwrap();
    for text in ["horizon (samples)", "1", "2", "4", "skill", "contact_force"] {
        assert!(svg.contains(&format!("aria-label=\"{text}\"")), "no {text}");
    }
}

#[test]
fn every_answer_says_how_far_ahead_its_predictions_are() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let plot = |name: &str, more: &[&str]| {
        let path = path(name).display().to_string();
        let asked =
            ["plot", "smoke", "--x", "latent", "--metrics", "r2", "--by", "modality", "--output", &path];
        succeed(&RESULTS, &[&asked[..], more].concat());
        fs::read_to_string(path).unwrap()
    };
    let (own, next) = (plot("own.csv", &[]), plot("next.csv", &["--horizon", "1"]));
    let asked = ["compare", "smoke", "--metrics", "r2", "--models", "network", "--task", "prediction"];
    let compared = |more: &[&str]| succeed(&RESULTS, &[&asked[..], more].concat());
    assert_eq!(next, compared(&["--horizon", "1", "--format", "csv"]));
    assert_eq!(own, compared(&["--format", "csv"]));
    let ahead = "predictions 4 samples (0.4 s) ahead";
    assert!(plot("next.svg", &["--horizon", "1"]).contains("predictions of the next sample"));
    assert!(plot("own.svg", &[]).contains(ahead) && compared(&[]).contains(ahead));
    let run = succeed(&RESULTS, &RUN).split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(run.contains("which differ in their seeds or folds; predictions 4 samples ahead"), "{run}");
    // Each of the pages says it too.
    let page = path("report.html").display().to_string();
    succeed(&RESULTS, &["report", "smoke", "--output", &page]);
    let page = fs::read_to_string(page).unwrap();
    let metrics = page.split("<section id=\"metrics\">").nth(1).unwrap().split("</section>").next().unwrap();
    assert!(metrics.contains(ahead), "{metrics}");
    let [tables, runs] =
        ["/api/compare?experiment=smoke", "/api/runs"].map(|path| served(&RESULTS, &[("GET", path, "")]));
    assert!(tables[0]["notes"].as_array().unwrap().contains(&json!(ahead)), "{tables:?}");
    let columns = runs[0]["columns"].as_array().unwrap();
    let column = columns.iter().find(|one| one["name"] == "contact_force r2, 4 samples ahead").unwrap();
    let sql = "select value from all_metrics where task = 'prediction' and horizon = 4 and metric = 'r2' and \
               modality = 'contact_force' and model = 'network' and index is null and direction is null order by run";
    let expected = catalog::query(&Registry::new(&*RESULTS), sql).unwrap();
    let expected: Vec<f64> = expected.column("value").unwrap().f64().unwrap().into_no_null_iter().collect();
    assert_eq!(column["values"], json!(expected));
}

#[test]
fn the_figure_shows_error_and_skill_over_seconds() {
    let out = fresh("horizons_figure");
    let draw = |more: &[&str]| {
        let ask = ["figures", "horizon", "--experiment", "smoke", "--output", out.to_str().unwrap()];
        succeed(&RESULTS, &[&ask[..], more].concat());
        csv(&out.join("horizon.csv"))
    };
    let (found, expected) = (draw(&[]), skills());
    // The error of four models and the skill of three, at three horizons.
    assert_eq!(found.height(), (4 + 3) * 3);
    for row in 0..found.height() {
        assert_eq!(text(&found, "modality", row), "contact_force");
        let horizon = number(&found, "horizon", row).unwrap();
        assert_eq!(number(&found, "horizon_seconds", row), Some(horizon / 10.0));
        if text(&found, "metric", row) == "skill" {
            let key = (text(&found, "model", row), "contact_force".to_owned(), horizon as i64);
            let values = &expected[&key];
            let values = if key.0 == "network" { &values[..] } else { &values[..1] };
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            assert!((number(&found, "mean", row).unwrap() - mean).abs() < 1e-9, "{key:?}");
        }
    }
    let svg = fs::read_to_string(out.join("horizon.svg")).unwrap();
    assert_whole(&svg, "horizon");
    for text in ["horizon (s)", "0.1", "0.2", "0.4", "contact force, R2", "contact force, skill", "empty"] {
        assert!(svg.contains(&format!("aria-label=\"{text}\"")), "no {text}");
    }
    let angles = draw(&["--of", "proprioception"]);
    assert!((0..angles.height()).all(|row| text(&angles, "modality", row) == "proprioception"));
    let refused = |results: &Path, more: &[&str]| {
        let ask = ["figures", "horizon", "--output", out.to_str().unwrap()];
        let answer = finish(&mut harness(results, &[&ask[..], more].concat()));
        assert_ne!(answer.code, 0);
        answer.stderr
    };
    let unknown = refused(&RESULTS, &["--experiment", "smoke", "--of", "vision"]);
    assert!(unknown.contains("they predict contact_force, proprioception"), "{unknown}");
    let reference = Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference");
    let one = refused(&reference, &["--experiment", "which_sense"]);
    assert!(one.contains("the runs of which_sense predict only the next sample"), "{one}");
    let none = refused(&RESULTS, &[]);
    assert!(none.contains("has no finished runs of hidden_stiffness; make them with `"), "{none}");
}

#[test]
fn an_episode_is_predicted_as_in_the_tables_and_further() {
    let registry = Registry::new(&*RESULTS);
    let run = "smoke/empty-z4-seed0";
    let found = rollout(&registry, run, None, 4).unwrap();
    // Of four episodes, the last one is for the test.
    assert_eq!((found.episode, found.samples.len()), (3, 30));
    // The context is two samples.
    assert_eq!(found.present.len(), 30 - 1 - 4);
    for (modality, values) in &found.predicted {
        let stored = catalog::query(
            &registry,
            &format!(
                "select predicted from all_predictions where run like 'empty-z4-seed0-%' and horizon = 4 \
                 and modality = '{modality}' order by episode, sample, index"
            ),
        );
        let stored = stored.unwrap();
        assert_eq!(stored.height(), values.len(), "{modality}");
        for (row, value) in values.iter().enumerate() {
            let stored = number(&stored, "predicted", row).unwrap() as f32;
            assert!(
                (stored - value).abs() <= 1e-5 * value.abs().max(1.0),
                "{modality} {row}: {stored} {value}"
            );
        }
    }
    let further = rollout(&registry, run, Some(0), 7).unwrap();
    assert_eq!((further.episode, further.present.len()), (0, 30 - 1 - 7));
    let force = &further.predicted[&Modality::CONTACT_FORCE];
    assert_eq!(force.len(), further.present.len() * 20);
    assert!(force.iter().all(|value| value.is_finite()));
}

#[test]
fn a_clip_shows_recorded_and_predicted_values_side_by_side() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let (clip, picture) = (path("clip.gif"), path("picture.png"));
    let render = ["render", "smoke/empty-z4-seed0", "--horizon", "3", "--output"];
    succeed(&RESULTS, &[&render[..], &[&clip, "--samples", "5"]].concat());
    let bytes = std::io::BufReader::new(fs::File::open(&clip).unwrap());
    let frames = GifDecoder::new(bytes).unwrap().into_frames().collect_frames().unwrap();
    assert_eq!(frames.len(), 5);
    assert!(frames.iter().all(|frame| frame.delay().numer_denom_ms() == (100, 1)), "10 Hz");
    assert!(frames.iter().all(|frame| frame.buffer().width() == 964));
    assert!(frames[0].buffer() != frames[4].buffer());
    // The first predicted sample is the one after the context of two and the horizon.
    succeed(&RESULTS, &[&render[..], &[&picture, "--episode", "3", "--sample", "10"]].concat());
    let drawn = image::open(&picture).unwrap().into_rgb8();
    let has = |color: [u8; 3]| drawn.pixels().any(|pixel| pixel.0 == color);
    assert!(has([0x00, 0x72, 0xb2]) && has([0xd5, 0x5e, 0x00]), "bars of both colors");
    let refused = |more: &[&str]| {
        let answer = finish(&mut harness(&RESULTS, &[&render[..], &[&clip], more].concat()));
        assert_eq!(answer.code, 2, "{}", answer.stderr);
        answer.stderr
    };
    let late = refused(&["--episode", "3", "--sample", "30"]);
    assert!(late.contains("samples 4 to 29 of the episode are predicted 3 samples ahead"), "{late}");
    let episode = refused(&["--episode", "4"]);
    assert!(episode.contains("there is no episode 4") && episode.contains("4 episodes"), "{episode}");
    let long = ["render", "smoke/empty-z4-seed0", "--output", &clip, "--horizon", "29"];
    let long = finish(&mut harness(&RESULTS, &long)).stderr;
    assert!(long.contains("too few for a context of 2 and a horizon of 29"), "{long}");
}

#[test]
fn the_clip_of_a_run_that_predicts_images_has_them_too() {
    let results = fresh("horizons_images");
    succeed(&results, &["run", SMOKE, "scenarios=[empty]", "tasks=[prediction]", "training.epochs=1"]);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("picture.png").display().to_string();
    let render = ["render", "smoke/empty", "--output", &path, "--horizon"];
    succeed(&results, &[&render[..], &["1"]].concat());
    let (_, height) = image::image_dimensions(&path).unwrap();
    let vectors = folder.path().join("vectors.png").display().to_string();
    succeed(&RESULTS, &["render", "smoke/empty-z4-seed0", "--output", &vectors, "--horizon", "1"]);
    // A row of pictures with the recorded and the predicted change of the image.
    assert!(height > image::image_dimensions(&vectors).unwrap().1 + 400, "{height}");
    let refused = finish(&mut harness(&results, &[&render[..], &["2"]].concat()));
    assert_eq!(refused.code, 2);
    assert!(refused.stderr.contains("lack its input 'vision'; use --horizon 1"), "{}", refused.stderr);
    fs::remove_dir_all(&results).unwrap();
}

#[test]
fn the_report_shows_curves_over_the_horizon_in_chromium() {
    let page = RESULTS.join("horizons.html");
    succeed(&RESULTS, &["report", "smoke", "--output", page.to_str().unwrap()]);
    let html = fs::read_to_string(&page).unwrap();
    let data = html.split_once("id=\"data\">").unwrap().1.split_once("</script>").unwrap().0;
    let data: Value = serde_json::from_str(data).unwrap();
    let curves = data["horizon"].as_array().unwrap();
    let is_skill = |curve: &&Value| curve["metric"] == "skill" && curve["modality"] == "contact_force";
    let names: Vec<&str> =
        curves.iter().filter(is_skill).map(|curve| curve["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["network", "ridge", "training mean"]);
    let skills = skills();
    for curve in curves.iter().filter(is_skill) {
        let model = curve["model"].as_str().unwrap();
        for (point, horizon) in curve["points"].as_array().unwrap().iter().zip([1, 2, 4]) {
            let values = &skills[&(model.to_owned(), "contact_force".to_owned(), horizon)];
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            assert_eq!(point[0], horizon as f64);
            assert!((point[1].as_f64().unwrap() - mean).abs() <= 1e-4 * mean.abs(), "{model} {horizon}");
        }
    }
    if let Some((well, said)) = in_chromium("read_page.py", &[&page, &RESULTS], &["--horizon"]) {
        assert!(well && said.contains("the page reads well"), "{said}");
    }
}

#[test]
fn the_live_page_shows_curves_over_the_horizon_in_chromium() {
    let program = Path::new(env!("CARGO_BIN_EXE_harness"));
    if let Some((well, said)) = in_chromium("use_serve.py", &[program, &RESULTS], &["--horizon"]) {
        assert!(well && said.contains("the page works"), "{said}");
    }
}
