//! Runs of models of other programs: recorded, listed, compared and removed like runs that train a network.

use crate::common::{SMOKE, finish, fresh, harness, smoke_run, succeed};
use crate::figures::words_of;
use harness::judge::{MetricRow, PredictionRow};
use harness::metrics::evaluate;
use harness::registry::{Outcome, Registry};
use harness::spec::{self, Layout, Modality, Model, RunSpec, Task};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The spec of an external model's run in the empty scenario of the smoke experiment.
fn external(name: &str, seed: u64) -> RunSpec {
    let run = spec::load(Path::new(SMOKE), &[], false).unwrap().runs().remove(0);
    let (model, variant) = (Model::External(name.to_owned()), format!("model={name}"));
    RunSpec { model, variant, seed, tasks: vec![Task::Prediction], ..run }
}

/// Writes a finished run of an external model whose predictions of the contact force are wrong by `error`.
fn write(results: &Path, spec: &RunSpec, error: f32) -> String {
    let registry = Registry::new(results);
    let mut records = registry.records().into_iter();
    let dataset = records.find(|record| record.spec.scenario == spec.scenario).unwrap().dataset;
    let folder = registry.run("smoke", spec, &dataset);
    let run = registry.claim(&folder).unwrap().unwrap();
    let record =
        run.begin(spec, &Layout::finger(), &harness::experiment::provenance(1, "judge".into())).unwrap();
    let reference: Vec<f32> = (0..200).map(|place| (place as f32 * 0.37).sin().abs()).collect();
    let predicted: Vec<f32> = reference.iter().map(|value| value + error).collect();
    let (task, horizon, given) = (Task::Prediction, 1, None);
    let rows = evaluate(&Layout::finger()[Modality::CONTACT_FORCE], &reference, &predicted).unwrap();
    let model = spec.model.name().to_owned();
    let row = |row| MetricRow { task, model: model.clone(), horizon, given, row };
    let values = reference.iter().zip(&predicted).enumerate();
    let outcome = Outcome {
        metrics: rows.into_iter().map(row).collect(),
        predictions: values
            .map(|(place, (reference, predicted))| PredictionRow {
                task,
                horizon: 1,
                given,
                modality: Modality::CONTACT_FORCE,
                episode: 3,
                sample: place as u32 / 20,
                index: place as u32 % 20,
                reference: *reference,
                predicted: *predicted,
            })
            .collect(),
        ..Outcome::default()
    };
    run.finish(record, &outcome).unwrap();
    folder.id().to_owned()
}

#[test]
fn a_run_has_a_network_or_an_external_model() {
    let spec = external("my_gru", 3);
    assert_eq!(spec.label(), "empty-model=my_gru-seed3");
    let json = serde_json::to_value(&spec).unwrap();
    assert_eq!((&json["model"], json.get("latent"), json.get("training")), (&"my_gru".into(), None, None));
    assert_eq!(serde_json::from_value::<RunSpec>(json.clone()).unwrap(), spec);
    assert_ne!(external("my_gru", 4).hash(), spec.hash());
    assert_ne!(external("other", 3).hash(), spec.hash());
    let refused = |key: &str, value: serde_json::Value| {
        let mut json = json.clone();
        json[key] = value;
        serde_json::from_value::<RunSpec>(json).unwrap_err().to_string()
    };
    assert_eq!(
        refused("latent", 4.into()),
        "a run has 'latent', 'network' and 'training', or it has 'model'"
    );
    assert!(refused("colour", 4.into()).starts_with("unknown field `colour`"));
}

#[test]
fn commands_take_runs_of_external_models() {
    let results = smoke_run("external");
    let runs = [("my_gru", 0), ("my_gru", 1), ("other", 0)]
        .map(|(name, seed)| write(&results, &external(name, seed), 0.1 * (seed + 1) as f32));
    let listed = succeed(&results, &["ls"]);
    assert!(runs.iter().all(|run| listed.contains(run.as_str())), "{listed}");
    let answer = succeed(
        &results,
        &[
            "query",
            "select architecture, latent is null as without, count(*) as runs from runs group by all
                    order by architecture",
            "--format",
            "csv",
        ],
    );
    assert_eq!(answer, "architecture,without,runs\nmulti_to_multi,false,2\nmy_gru,true,2\nother,true,1\n");
    let models =
        "select model, trained_here, count(distinct run) as runs from metrics group by all order by model";
    let answer = succeed(&results, &["query", models, "--format", "csv"]);
    let expected = "my_gru,false,2\nnetwork,true,2\nother,false,1\npersistence,false,2\nridge,false,2\n\
                    training_mean,false,2\n";
    assert_eq!(answer, format!("model,trained_here,runs\n{expected}"));
    let compared = succeed(&results, &["compare", "smoke", "--format", "csv", "--where", "scenario=empty"]);
    assert!(compared.contains("model=my_gru") && compared.contains("model=other"), "{compared}");
    // These models have no latent size and no training, so settings of networks do not select among them.
    for setting in ["latent=4", "training.epochs=2"] {
        let chosen = succeed(&results, &["compare", "smoke", "--format", "csv", "--where", setting]);
        assert!(chosen.contains("model=my_gru") && chosen.contains("model=other"), "{setting}: {chosen}");
    }
    let plot = results.join("plot.svg").display().to_string();
    let asked =
        ["plot", "smoke", "--x", "modality", "--by", "variant", "--facet", "scenario", "--metrics", "r2"];
    succeed(&results, &[&asked[..], &["--output", &plot]].concat());
    let words = words_of(&std::fs::read_to_string(&plot).unwrap());
    assert!(
        words.contains("network") && words.contains("model=my_gru") && !words.contains("none"),
        "{words:?}"
    );
    // A model of another program can be named, as networks and baselines can.
    let means =
        |models: &str| succeed(&results, &["compare", "smoke", "--models", models, "--format", "csv"]);
    let named = means("my_gru");
    assert!(
        named.lines().count() > 1 && named.lines().skip(1).all(|row| row.contains("model=my_gru")),
        "{named}"
    );
    let (both, usual) = (means("ridge,my_gru"), means("ridge"));
    assert_eq!(both.lines().count(), named.lines().count() + usual.lines().count() - 1);
    let refused = finish(&mut harness(&results, &["compare", "smoke", "--models", "my_lstm"]));
    let known = "there is no model 'my_lstm'; there are network, persistence, ridge, training_mean, nearest_neighbors, untrained, my_gru, other\n";
    assert!(refused.code == 2 && refused.stderr.ends_with(known), "{}", refused.stderr);
    assert!(succeed(&results, &["verify"]).contains("all files are intact"));
    assert!(succeed(&results, &["show", &runs[0]]).contains("my_gru"));
    // The runs of the experiment are still done, and none of the others is repeated.
    assert!(succeed(&results, &["run", SMOKE]).contains("2 done before"));
    let refused = finish(&mut harness(&results, &["export", "--format", "onnx", &runs[0], "model.onnx"]));
    assert!(refused.code != 0 && refused.stderr.contains("come from another program"), "{}", refused.stderr);
    let drawn = finish(&mut harness(&results, &["render", &runs[0], "--output", "x.png"]));
    assert!(drawn.stderr.contains("come from another program"), "{}", drawn.stderr);
    succeed(&results, &["rm", &runs[2], "--yes"]);
    assert!(!succeed(&results, &["ls"]).contains(&runs[2]));
}

/// Overrides of the smoke experiment whose networks predict only vectors, one from the other.
const AHEAD: [&str; 5] = [
    "input=[proprioception]",
    "output=[proprioception,contact_force]",
    "window.horizon=5",
    "window.context=2",
    "tasks=[prediction]",
];

/// The results of the networks of [`AHEAD`], and the predictions of the network in the empty scenario in a file.
fn ahead(name: &str, file: &str) -> (PathBuf, PathBuf) {
    let (results, file) = (fresh(name), fresh(&format!("{name}.{file}")));
    let _ = std::fs::remove_file(&file);
    succeed(&results, &[&["run", SMOKE][..], &AHEAD].concat());
    let sql = "select episode, sample, horizon, modality, index, predicted as value from all_predictions
               where scenario = 'empty' order by horizon, index, sample";
    succeed(&results, &["query", sql, "--output", file.to_str().unwrap()]);
    (results, file)
}

/// Calls `harness judge` for a file of predictions of the experiment of [`AHEAD`].
fn judge<'a>(file: &'a Path, more: &[&'a str]) -> Vec<&'a str> {
    [&["judge", SMOKE, file.to_str().unwrap()], &AHEAD[..], more].concat()
}

/// All metrics of the predictions of a run of the smoke experiment, as text. A network also has those of its latent
/// state.
fn metrics(results: &Path, architecture: &str) -> String {
    let sql = format!(
        "select task, case when model = '{architecture}' then 'network' else model end as model, modality, direction,
         index, metric, value, unit, horizon, given from all_metrics
         where scenario = 'empty' and architecture = '{architecture}' and modality <> 'latent' order by all"
    );
    succeed(results, &["query", &sql, "--format", "csv"])
}

/// The contents of all files below a folder.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let pattern = folder.join("**/*");
    let paths = glob::glob(pattern.to_str().unwrap()).unwrap().map(Result::unwrap);
    paths.map(|path| (path.clone(), std::fs::read(&path).unwrap_or_default())).collect()
}

#[test]
fn a_file_of_a_networks_predictions_gets_its_metrics() {
    for ending in ["parquet", "csv"] {
        let (results, file) = ahead(&format!("judged-{ending}"), ending);
        let options = ["--cell", "empty", "--model", "twin", "--note", "commit=ab12cd3"];
        let said = succeed(&results, &judge(&file, &options));
        assert!(said.contains("smoke/empty-model=twin-seed0-"), "{said}");
        let heading = said.lines().find(|line| line.contains("training mean")).unwrap();
        assert!(heading.trim().starts_with("twin") && !heading.contains("network"), "{said}");
        // The metrics of the network, and those of the baselines, to the last digit.
        let own = metrics(&results, "multi_to_multi");
        assert!(own.lines().count() > 500, "{own}");
        assert_eq!(metrics(&results, "twin"), own);
        let record = Registry::new(&results).find("smoke/empty-model=twin").unwrap().1;
        let sql = "select count(distinct task_hash) as tasks, max(notes) as notes from runs
                   where scenario = 'empty'";
        let answer = succeed(&results, &["query", sql, "--format", "json"]);
        assert_eq!(answer.trim(), r#"[{"tasks":1,"notes":"{\"commit\":\"ab12cd3\"}"}]"#);
        let submission = record.submission.unwrap();
        assert_eq!(submission.notes, BTreeMap::from([("commit".to_owned(), "ab12cd3".to_owned())]));
        assert_eq!(submission.task, record.spec.task_hash(&record.dataset));
        // The same predictions, in another order, are not judged again. Other predictions are refused.
        let before = contents(&results);
        let mut lines: Vec<String> = match ending {
            "csv" => std::fs::read_to_string(&file).unwrap().lines().map(str::to_owned).collect(),
            _ => break,
        };
        lines[1..].reverse();
        std::fs::write(&file, lines.join("\n")).unwrap();
        assert!(succeed(&results, &judge(&file, &options)).contains("judged before"));
        lines[1] = lines[1].rsplit_once(',').unwrap().0.to_owned() + ",0.123";
        std::fs::write(&file, lines.join("\n")).unwrap();
        let refused = finish(&mut harness(&results, &judge(&file, &options)));
        assert_eq!(refused.code, 2, "{}", refused.stderr);
        let (_, remedy) = refused.stderr.split_once("first `harness --results ").unwrap();
        assert_eq!(contents(&results), before);
        let remedy: Vec<&str> = remedy.split_once('`').unwrap().0.split(' ').skip(1).collect();
        succeed(&results, &[&remedy[..], &["--yes"]].concat());
        succeed(&results, &judge(&file, &options));
        assert_ne!(metrics(&results, "twin"), own);
        assert!(succeed(&results, &["verify"]).contains("all files are intact"));
    }
}

#[test]
fn a_task_says_what_a_file_must_have() {
    let results = fresh("task");
    let before = succeed(&results, &[&["task", SMOKE][..], &AHEAD].concat());
    assert!(before.contains("episodes; `harness --results") && before.contains("collect"), "{before}");
    assert!(!results.join("datasets").exists());
    let (results, file) = ahead("task", "parquet");
    let said = succeed(&results, &[&["task", SMOKE, "--cell", "empty"][..], &AHEAD].concat());
    // 30 samples in each of two episodes for training, one for validation and one for the test, without the first
    // sample and the last five.
    for words in [
        "proprioception [20] rad, contact_force [20] N",
        "1, 2, 5 samples ahead",
        "48 for training, 24 for validation, 24 for test",
        "Results so far:",
    ] {
        assert!(said.contains(words), "{words}: {said}");
    }
    let hash = said.lines().find_map(|line| line.trim().strip_prefix("task")).unwrap().trim();
    succeed(&results, &judge(&file, &["--cell", "empty", "--model", "twin", "--task", hash]));
    let other = [&["task", SMOKE, "--cell", "empty", "split.test=0.3"][..], &AHEAD].concat();
    assert!(!succeed(&results, &other).contains(hash));
}

#[test]
fn hostile_predictions_are_refused_and_leave_nothing() {
    let (results, file) = ahead("hostile-predictions", "csv");
    let good = std::fs::read_to_string(&file).unwrap();
    let rows: Vec<Vec<&str>> = good.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows[0], ["episode", "sample", "horizon", "modality", "index", "value"]);
    let before = contents(&results);
    let text = |rows: &[Vec<&str>]| rows.iter().map(|row| row.join(",")).collect::<Vec<_>>().join("\n");
    // Changes the cell in a column of the second row.
    let cell = |column: usize, value: &'static str| {
        let mut rows = rows.clone();
        rows[2][column] = value;
        text(&rows)
    };
    let header = |column: usize, name: &'static str| {
        let mut rows = rows.clone();
        rows[0][column] = name;
        text(&rows)
    };
    let without = |column: usize| {
        let mut rows = rows.clone();
        rows.iter_mut().for_each(|row| {
            row.remove(column);
        });
        text(&rows)
    };
    let kept = |is_kept: &dyn Fn(&[&str]) -> bool| {
        let rows: Vec<_> = rows.iter().filter(|row| row[0] == "episode" || is_kept(row)).cloned().collect();
        text(&rows)
    };
    let given = |of: &dyn Fn(usize) -> &'static str| {
        let mut rows = rows.clone();
        rows.iter_mut()
            .enumerate()
            .for_each(|(place, row)| row.push(if place == 0 { "given" } else { of(place) }));
        text(&rows)
    };
    let files: Vec<(String, &str)> = vec![
        (String::new(), "can't be read"),
        ("\0\u{1}\u{2}".into(), "can't be read"),
        ("just a text".into(), "it has a column 'just a text'"),
        (rows[0].join(","), "there are no predictions"),
        (text(&rows[..2]), "there are no predictions of proprioception, 2 samples ahead"),
        (text(&rows[..rows.len() - 1]), "is missing"),
        (text(&[&rows[..], &rows[1..2]].concat()), "it occurs twice"),
        (text(&[&rows[..], &rows[1..]].concat()), "it occurs twice"),
        (cell(0, "0"), "no test window predicts it"),
        (cell(0, "99"), "no test window predicts it"),
        (cell(0, "-1"), "has -1 in row 2, must be at least 0"),
        (cell(0, ""), "has no number in row 2"),
        (cell(0, "three"), "has 'three' in row 2, must be an integer"),
        (cell(0, "1.5"), "has '1.5' in row 2, must be an integer"),
        (cell(0, "99999999999999999999"), "can't be read"),
        (cell(1, "0"), "no test window predicts it"),
        (cell(1, "30"), "no test window predicts it"),
        (cell(1, "9223372036854775807"), "no test window predicts it"),
        (cell(1, "-9223372036854775808"), "must be at least 0"),
        (cell(2, "0"), "0 samples ahead; the task asks for"),
        (cell(2, "3"), "no test window predicts it"),
        (cell(2, "9223372036854775807"), "no test window predicts it"),
        (cell(3, "vision"), "nothing asks for predictions of vision"),
        (cell(3, "touch"), "the dataset has no such modality"),
        (cell(3, "Contact Force"), "is not the name of a modality"),
        (cell(3, ""), "is not the name of a modality"),
        (cell(4, "20"), "the modality has no such element"),
        (cell(4, "18446744073709551615"), "can't be read"),
        (cell(5, "NaN"), "the value is not finite"),
        (cell(5, "inf"), "the value is not finite"),
        (cell(5, "-inf"), "the value is not finite"),
        (cell(5, "1e39"), "the value is not finite"),
        (cell(5, ""), "has no number in row 2"),
        (cell(5, "nan"), "the value is not finite"),
        (cell(5, "a lot"), "has 'a lot' in row 2, must be a number"),
        (cell(5, "true"), "must be a number"),
        (header(0, "trial"), "it has a column 'trial'"),
        (header(5, "predicted"), "it has a column 'predicted'"),
        (header(0, "sample"), "can't be read"),
        (without(0), "it has no column 'episode'"),
        (without(1), "it has no column 'sample'"),
        (without(2), "it occurs twice"),
        (without(3), "it has no column 'modality'"),
        (without(4), "it has no column 'index'"),
        (without(5), "it has no column 'value'"),
        (kept(&|row| row[2] != "5"), "there are no predictions of proprioception, 5 samples ahead"),
        (kept(&|row| row[3] != "contact_force"), "there are no predictions of contact_force, 1 sample ahead"),
        (kept(&|row| row[4] != "7"), "element 7 of proprioception, 1 sample ahead, is missing"),
        (kept(&|row| row[1] != "12"), "is missing"),
        (given(&|_| "proprioception"), "all predictions are of a model that got only some inputs"),
        (given(&|place| if place == 1 { "arm" } else { "" }), "'given' has arm, which is no input"),
        (given(&|place| if place == 1 { "?" } else { "" }), "is not the name of a modality"),
    ];
    assert!(files.len() > 50);
    let refused = |arguments: &[&str], words: &str| {
        let answer = finish(&mut harness(&results, arguments));
        let (said, error) = answer.stderr.trim().rsplit_once('\n').unwrap_or(("", answer.stderr.trim()));
        let is_one = error.starts_with("error: ") && !said.contains("error");
        assert!(is_one && error.contains(words) && answer.code == 2, "{words}: {}", answer.stderr);
    };
    let options = ["--cell", "empty", "--model", "my_gru"];
    for (text, words) in files {
        std::fs::write(&file, text).unwrap();
        refused(&judge(&file, &options), words);
    }
    for bytes in [&b"PAR1"[..], b"PAR1\x00\x00\x00\x00PAR1", &[255; 4096]] {
        let file = file.with_extension("parquet");
        std::fs::write(&file, bytes).unwrap();
        refused(&judge(&file, &options), "can't be read");
    }
    std::fs::write(&file, &good).unwrap();
    refused(&judge(Path::new("nowhere.csv"), &options), "nowhere.csv can't be read");
    refused(&judge(&file, &["--model", "my_gru"]), "choose one with --cell: empty, cluttered");
    refused(&judge(&file, &["--cell", "full", "--model", "my_gru"]), "it has empty, cluttered");
    refused(&judge(&file, &["--cell", "empty", "--model", "my gru"]), "can't name a model");
    refused(&judge(&file, &["--cell", "empty", "--model", "../gru"]), "can't name a model");
    refused(&judge(&file, &["--cell", "empty", "--model", "ridge"]), "'ridge' is a model of the harness");
    let unasked = ["--cell", "empty", "--model", "gru", "window.horizon=1"];
    refused(&judge(&file, &unasked), "nothing asks for predictions of");
    let text = file.with_extension("txt");
    std::fs::copy(&file, &text).unwrap();
    refused(&judge(&text, &options), "the name of a CSV file must end in .csv");
    refused(&judge(&file, &["--cell", "empty", "--model", "gru", "--note", "=1"]), "has no name");
    refused(
        &judge(&file, &["--cell", "empty", "--model", "gru", "--task", "0123456789abcdef"]),
        "for the task 0123",
    );
    refused(
        &judge(&file, &["--cell", "empty", "--model", "gru", "--seed", "18446744073709551615"]),
        "too large",
    );
    refused(&judge(&file, &["--cell", "empty", "--model", "gru", "split.test=0.5"]), "is missing");
    refused(
        &judge(&file, &["--cell", "empty", "--model", "gru", "window.horizon=6"]),
        "no test window predicts it",
    );
    refused(&judge(&file, &["--cell", "cluttered", "--model", "gru", "simulation.seed=1"]), "simulates them");
    assert_eq!(contents(&results), before);
}

#[test]
fn a_task_needs_no_network_and_may_predict_further() {
    let folder = fresh("task-without-network");
    std::fs::create_dir_all(&folder).unwrap();
    let spec = folder.join("task.yaml");
    let text = "name: forces\nscenarios: [empty]\ninput: [proprioception, vision]\noutput: [contact_force]\n\
                window: {context: 5, horizon: 20}\nsimulation: {episodes: 4, actuations_per_episode: 3}\n";
    std::fs::write(&spec, text).unwrap();
    let path = spec.to_str().unwrap();
    let results = folder.join("results");
    succeed(&results, &["collect", path]);
    let said = succeed(&results, &["task", path]);
    assert!(said.contains("1, 2, 5, 10, 20 samples ahead") && said.contains("12 for training"), "{said}");
    let refused = finish(&mut harness(&results, &["run", path]));
    assert!(refused.code == 2 && refused.stderr.contains("latent"), "{}", refused.stderr);
}

#[test]
fn the_simulator_repeats_its_samples_from_a_rounded_state() {
    let results = fresh("external-simulator");
    let settings = ["input=[proprioception]", "output=[proprioception,contact_force]", "window.horizon=5"];
    let asked = [&settings[..], &["scenarios=[cluttered]"]].concat();
    succeed(&results, &[&["collect", SMOKE][..], &asked].concat());
    let judge = |more: &[&'static str]| [&["judge", SMOKE, "simulator"], &asked[..], more].concat();
    succeed(&results, &[&["--threads", "1"], &judge(&[])[..]].concat());
    let sql = "select horizon, modality, value from all_metrics where metric = 'r2' and model = 'simulator'
               and index is null and direction is null";
    let found = succeed(&results, &["query", sql, "--format", "csv"]);
    let r2: Vec<f64> =
        found.lines().skip(1).map(|row| row.rsplit(',').next().unwrap().parse().unwrap()).collect();
    // Horizons 1, 2 and 5 of two modalities.
    assert!(r2.len() == 6 && r2.iter().all(|r2| *r2 > 0.9), "{found}");
    // The rounding shows: no prediction is a copy of the sample.
    let sql = "select max(abs(predicted - reference)) from all_predictions";
    let largest = succeed(&results, &["query", sql, "--format", "csv"]);
    assert!(largest.lines().nth(1).unwrap().parse::<f64>().unwrap() > 0.0, "{largest}");
    // Whatever the threads, the values are the same.
    let again = succeed(&results, &[&["--threads", "2"], &judge(&[])[..]].concat());
    assert!(again.contains("the same predictions were judged before"), "{again}");

    // What it does not know makes it worse: little errors little, and everything much.
    let r2 = |more: &[&'static str], model: &str| {
        let judged = judge(&[more, &["--restarts", "4"]].concat());
        let first = succeed(&results, &[&["--threads", "1"], &judged[..]].concat());
        assert!(first.contains(model), "{first}");
        let again = succeed(&results, &[&["--threads", "2"], &judged[..]].concat());
        assert!(again.contains("the same predictions were judged before"), "{again}");
        let sql = format!(
            "select value from all_metrics where metric = 'r2' and model = '{model}' and modality = 'contact_force'
             and index is null and direction is null and horizon = 1"
        );
        let found = succeed(&results, &["query", &sql, "--format", "csv"]);
        found.lines().nth(1).unwrap().parse::<f64>().unwrap()
    };
    let exact = r2(&["--error", "arm=0rad"], "simulator-arm-0rad");
    let little = r2(&["--error", "arm=0.001deg"], "simulator-arm-0.001deg");
    let much =
        &["--error", "finger_joint_*=20deg", "--error", "box_*=9cm", "--error", "box_*=9deg", "--at-rest"];
    let much = r2(much, "simulator-finger_joint_-20deg-box_-9cm-box_-9deg-at-rest");
    let blind = r2(&["--without", "box_*"], "simulator-without-box_");
    assert!(
        exact > 0.9 && little > 0.9 && much < little - 0.1 && blind < 1.0,
        "{exact} {little} {much} {blind}"
    );

    let refused = |arguments: &[&str]| {
        let answer = finish(&mut harness(&results, arguments));
        assert_eq!((answer.code, &*answer.stdout), (2, ""), "{}", answer.stderr);
        answer.stderr
    };
    for (option, value, message) in [
        ("--error", "nothing=1deg", "'nothing' is not the name or a pattern of the names of a modality"),
        ("--error", "finger_joint_*=1mm", "nothing in 'finger_joint_*' moves along an axis"),
        ("--error", "arm=1", "write NAME=SIZE with a size in deg, rad, mm, cm or m"),
        ("--without", "finger_link_03", "'finger_link_03' moves with others"),
    ] {
        let found = refused(&judge(&[option, value]));
        assert!(found.contains(message), "{found}");
    }
    let of_file = refused(&[&["judge", SMOKE, "some.csv", "--error", "arm=1deg"], &asked[..]].concat());
    assert!(of_file.contains("--error is for the word `simulator`"), "{of_file}");
    let image = refused(&judge(&["output=[frame_difference]"]));
    assert!(image.contains("frame_difference is an image or a change"), "{image}");
    let unnamed = refused(&[&["judge", SMOKE, "some.csv"], &asked[..]].concat());
    assert_eq!(unnamed, "error: the model has no name; give it one, for example --model my_gru\n");
}
