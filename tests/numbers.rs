//! Compares every number of `compare`, `claims`, `figures` and `query` with a plain computation in Python over the same
//! files (tests/python/reference_numbers.py). The results folders have random settings, seeds, scenarios, quick runs,
//! copies and damage.
//!
//! `NUMBERS_CASES=200 cargo test --test all numbers::` tests 200 folders instead of a few.

use crate::common::finger::{FRAME_LEN, JOINTS};
use crate::common::{copy_folder, finish, fresh, harness};
use harness::claims::{Claim, load};
use harness::judge::{FrameRow, MetricRow, PredictionRow};
use harness::learning::training::{Epoch, Losses, TOTAL};
use harness::metrics::contact::by_link;
use harness::metrics::{Direction, Metric, Row};
use harness::registry::{ForceRows, Outcome, Provenance, Registry};
use harness::spec::{self, Experiment, Layout, Modality, RunSpec, Task};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

const CASES: u64 = 2;
const FIGURES: [&str; 5] = [
    "forces_dataset",
    "prediction_results",
    "propriovision_to_vision",
    "reconstruction_performance",
    "regression",
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn every_number_is_that_of_a_plain_computation_over_the_files() {
    let cases = std::env::var("NUMBERS_CASES").map_or(CASES, |count| count.parse().unwrap());
    for case in 0..cases {
        let results = fresh("numbers");
        make(&results, &mut ChaCha8Rng::seed_from_u64(case));
        let answers = fresh("numbers_answers");
        ask(&results, &answers);
        let script = root().join("tests/python/reference_numbers.py");
        let mut python = Command::new(root().join(".venv/bin/python"));
        let output = python.arg(script).arg(&results).arg(&answers).output().unwrap();
        let said =
            String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "case {case}, in {}:\n{said}", results.display());
        println!("case {case}: {}", said.trim());
    }
}

// --- a results folder ---

fn chance(random: &mut ChaCha8Rng, of_one: f64) -> bool {
    random.random::<f64>() < of_one
}

fn pick<'a, T>(random: &mut ChaCha8Rng, of: &'a [T]) -> &'a T {
    &of[random.random_range(0..of.len())]
}

/// Fills a results folder with random runs.
fn make(results: &Path, random: &mut ChaCha8Rng) {
    let registry = Registry::new(results);
    for name in ["single_to_multi", "multi_to_multi"] {
        for quick in [false, true] {
            // Half of all folders have quick runs, and nearly all have full ones.
            if chance(random, if quick { 0.5 } else { 0.95 }) {
                write_study(&registry, name, quick, random);
            }
        }
    }
    if chance(random, 0.7) {
        let sweep = ["name=sweep", "seeds=[0,1]", "vary={training.kl_weight: [0, 0.01]}"].map(str::to_owned);
        write(&registry, &load_spec("smoke", &sweep), "sweep", random);
    }
    spoil(results, random);
}

fn load_spec(name: &str, overrides: &[String]) -> Experiment {
    spec::load(&root().join(format!("experiments/{name}.yaml")), overrides, false).unwrap()
}

/// Writes runs of one of the paper's experiments, sometimes with several settings.
fn write_study(registry: &Registry, name: &str, quick: bool, random: &mut ChaCha8Rng) {
    let folder = format!("{name}{}", if quick { "-quick" } else { "" });
    let seeds = pick(random, &["seeds=[0]", "seeds=[0,1]", "seeds=[7,1,2]"]).to_string();
    let scenarios = if chance(random, 0.1) { "scenarios=[cluttered]" } else { "scenarios=[empty,cluttered]" };
    let same = [seeds, scenarios.to_owned()];
    write(registry, &load_spec(name, &same), &folder, random);
    let others = [
        "training.batch_size=16",
        "training.epochs=7",
        "training.loss_weights.contact_force=2",
        "network.hidden=32",
        "simulation.episodes=12",
        "vary={training.kl_weight: [0, 0.01]}",
    ];
    while chance(random, 0.25) {
        let mut overrides = same.to_vec();
        overrides.push((*pick(random, &others)).to_owned());
        write(registry, &load_spec(name, &overrides), &folder, random);
    }
}

fn write(registry: &Registry, experiment: &Experiment, name: &str, random: &mut ChaCha8Rng) {
    // Sometimes the models have changed, so that the datasets are different.
    let model = if chance(random, 0.1) { "b" } else { "a" };
    for spec in experiment.runs() {
        if chance(random, 0.05) {
            continue;
        }
        let moves = spec.simulation.as_ref().unwrap().actuations_per_episode;
        let folder = registry.run(name, &spec, &format!("{}-{model}{moves}", spec.scenario));
        let run = registry.claim(&folder).unwrap().unwrap();
        let record = run.begin(&spec, &Layout::finger(), &Provenance::default()).unwrap();
        match random.random_range(0..40) {
            0 => {}
            1 => run.fail(record, "the disk is full").unwrap(),
            _ => {
                for task in &spec.tasks {
                    fs::write(folder.checkpoint(*task), "made up").unwrap();
                }
                run.finish(record, &outcome(&spec, random)).unwrap();
            }
        }
    }
}

/// Tables of random numbers. Numbers that depend only on the dataset are the same in all runs of a scenario.
fn outcome(spec: &RunSpec, random: &mut ChaCha8Rng) -> Outcome {
    let mut outcome = Outcome { parameters: random.random_range(1000..2000), ..Outcome::default() };
    let mut of_dataset = ChaCha8Rng::seed_from_u64(u64::from(spec.scenario.name() == "empty"));
    for task in &spec.tasks {
        let output = if *task == Task::Prediction { &spec.output } else { &spec.input };
        for modality in output {
            for model in ["network", "persistence", "ridge", "training_mean"] {
                // A baseline has the same values in every run.
                let source = if model == "network" { &mut *random } else { &mut of_dataset };
                outcome.metrics.extend(metrics(*task, *modality, model, source));
            }
        }
        let epochs = random.random_range(3..7);
        outcome.epochs.extend((1..=epochs).map(|epoch| {
            let mut losses = || Losses::from([(TOTAL.to_owned(), random.random::<f64>())]);
            (*task, Epoch { epoch, train: losses(), validation: losses(), seconds: 1.0 })
        }));
    }
    for modality in [Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE] {
        let places = (0..12).flat_map(|sample| [18, 19].map(|index| (sample, index)));
        outcome.predictions.extend(places.map(|(sample, index)| PredictionRow {
            horizon: 1,
            given: None,
            task: Task::Prediction,
            modality,
            episode: 3 + sample / 6,
            sample: sample % 6,
            index,
            reference: random.random(),
            predicted: random.random(),
        }));
    }
    for episode in [None, Some(0), Some(1), Some(2)] {
        let forces: Vec<f32> =
            (0..40 * JOINTS).map(|_| (of_dataset.random::<f32>() - 0.4).max(0.0)).collect();
        outcome.forces.push(ForceRows {
            modality: Modality::CONTACT_FORCE,
            episode,
            links: by_link(&forces, JOINTS),
        });
    }
    if spec.output.contains(&Modality::FRAME_DIFFERENCE) {
        outcome.frames.extend((1..3).map(|sample| FrameRow {
            task: Task::Prediction,
            modality: Modality::FRAME_DIFFERENCE,
            episode: 3,
            sample,
            motion: 0.1 * f64::from(sample),
            reference: vec![100; FRAME_LEN],
            predicted: vec![random.random(); FRAME_LEN],
        }));
    }
    outcome
}

fn metrics(task: Task, modality: Modality, model: &'static str, random: &mut ChaCha8Rng) -> Vec<MetricRow> {
    let directions = Direction::FINGER.map(|direction| (Some(direction), None));
    let layout = Layout::finger();
    let joints = (0..JOINTS as u32).map(|index| (Some(Direction::FINGER[index as usize % 2]), Some(index)));
    let parts = directions.into_iter().chain(joints).filter(|_| !layout[modality].is_image());
    let places: Vec<_> = [(None, None)].into_iter().chain(parts).collect();
    let mut rows = Vec::new();
    for (direction, index) in places {
        let regions = layout.regions.iter().filter(|_| layout[modality].difference_of.is_some());
        let regional = regions.map(|region| Metric::RelativeError.in_region(&region.name));
        for metric in Metric::of(&layout[modality]).into_iter().chain(regional) {
            let value = match metric {
                Metric::R2 => 1.0 - 1.5 * random.random::<f64>(),
                Metric::Smape | Metric::Wmape => 100.0 * random.random::<f64>(),
                _ => random.random::<f64>(),
            };
            let unit = match metric {
                Metric::Smape | Metric::Wmape => "%",
                Metric::Rmse | Metric::Mae => "N",
                _ => "1",
            };
            // Some metrics are undefined.
            let value = (index.is_none() || !chance(random, 0.05)).then_some(value);
            rows.push(MetricRow {
                horizon: 1,
                given: None,
                task,
                model: model.to_owned(),
                row: Row { modality, direction, index, metric, value, unit: unit.into() },
            });
        }
    }
    rows
}

// --- copies and damage ---

fn folders(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut folders: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(|path| path.is_dir()).collect();
    folders.sort();
    folders
}

/// Copies and damages runs, like people and disks do.
fn spoil(results: &Path, random: &mut ChaCha8Rng) {
    let experiments = folders(&results.join("runs"));
    let runs: Vec<PathBuf> = experiments.iter().flat_map(|experiment| folders(experiment)).collect();
    if runs.is_empty() {
        return;
    }
    if chance(random, 0.4) {
        let experiment = pick(random, &experiments);
        copy_folder(experiment, &experiment.with_extension("backup"));
    }
    if chance(random, 0.4) {
        let run = pick(random, &runs);
        let name = format!("{}-copy", run.file_name().unwrap().to_str().unwrap());
        copy_folder(run, &run.with_file_name(name));
    }
    if chance(random, 0.3) {
        let (from, to) = (pick(random, &runs).join("run.json"), pick(random, &runs).join("run.json"));
        if from != to {
            fs::copy(from, to).unwrap();
        }
    }
    if chance(random, 0.3) {
        flip(&pick(random, &runs).join("run.json"), random);
    }
    if chance(random, 0.25) {
        let table = pick(random, &runs).join(pick(random, &["metrics.parquet", "epochs.parquet"]));
        // An unfinished run has no tables.
        if table.exists() {
            if chance(random, 0.5) { flip(&table, random) } else { fs::remove_file(table).unwrap() }
        }
    }
}

/// Changes one bit of a file.
fn flip(path: &Path, random: &mut ChaCha8Rng) {
    let mut bytes = fs::read(path).unwrap();
    let at = random.random_range(0..bytes.len());
    bytes[at] ^= 1;
    fs::write(path, bytes).unwrap();
}

// --- the answers ---

/// Runs every command that returns numbers, and writes the answers to files.
fn ask(results: &Path, answers: &Path) {
    fs::create_dir_all(answers).unwrap();
    let mut commands = serde_json::Map::new();
    let mut ask = |name: &str, arguments: &[&str]| {
        let answer = finish(&mut harness(results, arguments));
        let said = json!({"code": answer.code, "stdout": answer.stdout, "stderr": answer.stderr});
        commands.insert(name.to_owned(), said);
    };
    let file = |name: &str| answers.join(name).to_str().unwrap().to_owned();
    ask("query_runs", &["query", "select experiment, run, status from runs", "-o", &file("runs.parquet")]);
    let metrics =
        "select experiment, run, task, model, modality, direction, index, metric, unit, value from metrics";
    ask("query_metrics", &["query", metrics, "-o", &file("metrics.parquet")]);
    let means = "select experiment, scenario, latent, variant, metric, avg(value) as mean, count(value) as n from \
                 metrics where model = 'network' and index is null and value is not null \
                 group by experiment, scenario, latent, variant, metric";
    ask("query_means", &["query", means, "-o", &file("means.parquet")]);
    ask("compare_rows", &["compare", "-o", &file("compare.csv")]);
    ask("compare", &["compare", "--format", "markdown"]);
    let has_quick = results.join("runs/single_to_multi-quick").exists();
    for quick in [false, true].into_iter().filter(|quick| !quick || has_quick) {
        let (ending, option) = if quick { ("-quick", &["--quick"][..]) } else { ("", &[][..]) };
        let verdicts = file(&format!("claims{ending}.csv"));
        ask(&format!("claims{ending}"), &[&["claims", "-o", &verdicts], option].concat());
        for figure in FIGURES {
            let out = file(&format!("{figure}{ending}.drawn"));
            ask(&format!("{figure}{ending}"), &[&["figures", figure, "--output", &out], option].concat());
            for kind in ["csv", "svg"] {
                let drawn = Path::new(&out).join(format!("{figure}.{kind}"));
                if drawn.exists() {
                    fs::rename(drawn, file(&format!("{figure}{ending}.{kind}"))).unwrap();
                }
            }
        }
    }
    fs::write(answers.join("commands.json"), serde_json::to_vec(&commands).unwrap()).unwrap();
    let claims = load(&root().join("experiments/claims.yaml")).unwrap().claims;
    let claim = |claim: &Claim| {
        json!({
            "id": claim.id(),
            "sql": claim.sql(false),
            "quick": claim.sql(true),
            "scenarios": claim.scenarios,
            "difference": claim.difference,
            "experiments": claim.experiments,
            "condition": claim.condition.to_string(),
            "required_sql": claim.required_sql(false),
            "required_quick": claim.required_sql(true),
            "required_condition": claim.requires.as_ref().map(|requirement| requirement.condition.to_string()),
        })
    };
    let claims: Vec<_> = claims.iter().map(claim).collect();
    fs::write(answers.join("claims.json"), serde_json::to_vec(&claims).unwrap()).unwrap();
}
