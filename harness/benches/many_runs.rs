//! Fills a results folder with runs that look like trained ones, to measure how commands perform with many runs.
//!
//!     cargo run --release --example many_runs -- --results many --seeds 250
//!
//! The runs are those of `single_to_multi` and `multi_to_multi` with `--seeds` seeds, 12 runs for each seed. Their
//! records, specs, losses, metrics, forces and images have the size of real ones. The same arguments give the same
//! numbers. There are fewer test samples than in real runs, networks are empty files, and there is no dataset.

use clap::Parser;
use harness::collection::dataset_of;
use harness::experiment::provenance;
use harness::judge::{FrameRow, MetricRow, PredictionRow};
use harness::learning::training::{Epoch, Losses, TOTAL};
use harness::metrics::contact::{Contact, by_link};
use harness::metrics::{Row, evaluate};
use harness::registry::{ForceRows, Outcome, Provenance, Registry, Timings};
use harness::simulation::Scene;
use harness::spec::{self, Definition, Experiment, Layout, Modality, RunSpec, Scenario, Task};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Number of test samples whose predictions are stored, over four test episodes. A real run has 4,000.
const SAMPLES: usize = 80;
const EPISODES: u32 = 4;

#[derive(Parser)]
struct Arguments {
    /// The results folder, which may contain other runs
    #[arg(long)]
    results: PathBuf,
    /// Seeds of each cell; each seed makes 12 runs
    #[arg(long, default_value_t = 250)]
    seeds: u64,
    /// Epochs of each training
    #[arg(long, default_value_t = 200)]
    epochs: usize,
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments = Arguments::parse();
    let registry = Registry::new(&arguments.results);
    let seeds: Vec<u64> = (0..arguments.seeds).collect();
    let mut made = 0;
    for name in ["single_to_multi", "multi_to_multi"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("experiments/{name}.yaml"));
        let setting = format!("seeds={seeds:?}").replace(' ', "");
        let command =
            format!("harness run experiments/{name}.yaml {setting} training.epochs={}", arguments.epochs);
        let overrides = [setting, format!("training.epochs={}", arguments.epochs)];
        let experiment = spec::load(&path, &overrides, false)?;
        let datasets = datasets(&registry, &experiment)?;
        let provenance = provenance(2, command);
        let runs = experiment.runs();
        runs.par_iter().try_for_each(|spec| {
            write(&registry, &experiment.name, spec, &datasets[spec.scenario.name()], &provenance)
                .map_err(|error| format!("{}: {error}", spec.label()))
        })?;
        made += runs.len();
    }
    println!("{made} runs in {}", arguments.results.display());
    Ok(())
}

/// The name and the layout of a dataset, which isn't collected.
type Named = (String, Arc<Layout>);

/// Returns each scenario's dataset.
fn datasets(
    registry: &Registry,
    experiment: &Experiment,
) -> Result<BTreeMap<&'static str, Named>, Box<dyn Error>> {
    let named = |scenario: &Scenario| {
        let (scene, simulation) = (Scene::paper(*scenario)?, &experiment.simulation);
        let dataset = dataset_of(&registry.datasets(), &scene, simulation);
        Ok((scenario.name(), (dataset.name().to_owned(), scene.layout_of(simulation))))
    };
    Scenario::PAPER.iter().map(named).collect()
}

fn write(
    registry: &Registry,
    experiment: &str,
    spec: &RunSpec,
    (dataset, layout): &Named,
    by: &Provenance,
) -> Result<(), Box<dyn Error>> {
    let folder = registry.run(experiment, spec, dataset);
    let run = registry.claim(&folder)?.ok_or("another process is working on it")?;
    let record = run.begin(spec, layout, by)?;
    for task in &spec.tasks {
        std::fs::write(folder.checkpoint(*task), "made up")?;
    }
    Ok(run.finish(record, &outcome(spec)?)?)
}

fn outcome(spec: &RunSpec) -> Result<Outcome, Box<dyn Error>> {
    let trained = spec.trained().expect("an experiment trains its networks");
    let size = trained.latent as u64;
    let mut random =
        ChaCha8Rng::seed_from_u64(spec.seed * 1000 + size * 2 + u64::from(spec.scenario.name() == "empty"));
    let mut outcome = Outcome {
        timings: Timings { collect: 0.7, prediction: 31.8, reconstruction: Some(8.3), evaluation: 0.1 },
        parameters: 29_000,
        ..Outcome::default()
    };
    for task in &spec.tasks {
        let output = if *task == Task::Prediction { &spec.output } else { &spec.input };
        outcome
            .epochs
            .extend((1..=trained.training.epochs).map(|epoch| (*task, losses(epoch, output, &mut random))));
        for modality in output {
            judge(*task, *modality, &mut outcome, &mut random)?;
        }
    }
    outcome.forces = forces(spec);
    Ok(outcome)
}

/// Returns losses that fall towards a lower bound.
fn losses(epoch: usize, output: &[Modality], random: &mut ChaCha8Rng) -> Epoch {
    let mut split = || {
        let mut losses: Losses = output
            .iter()
            .map(|modality| {
                (modality.name().to_owned(), 0.3 + (1.0 + 0.1 * random.random::<f64>()) / epoch as f64)
            })
            .collect();
        losses.insert("kl".into(), 3.0 + random.random::<f64>());
        losses.insert(TOTAL.into(), losses.values().sum());
        losses
    };
    Epoch { epoch, train: split(), validation: split(), seconds: 0.15 }
}

/// Adds the metrics of a network and the baselines, and the network's predictions, for invented samples.
fn judge(
    task: Task,
    modality: Modality,
    outcome: &mut Outcome,
    random: &mut ChaCha8Rng,
) -> Result<(), Box<dyn Error>> {
    let layout = Layout::finger();
    let (definition, width): (&Definition, usize) = (&layout[modality], layout[modality].width());
    let samples = if definition.is_image() { 5 } else { SAMPLES };
    let mut values = |scale: f32| -> Vec<f32> {
        (0..samples * width).map(|_| scale * (random.random::<f32>() - 0.5)).collect()
    };
    let (reference, noise) = (values(1.0), values(0.6));
    let predicted: Vec<f32> =
        reference.iter().zip(&noise).map(|(reference, noise)| reference + noise).collect();
    let models: &[&str] = match task {
        Task::Prediction => &["network", "persistence", "ridge", "training_mean"],
        Task::Reconstruction => &["network", "training_mean"],
    };
    let rows = evaluate(definition, &reference, &predicted)?;
    for (place, &model) in models.iter().enumerate() {
        // All models have the same samples, and each model has slightly worse values than the previous one.
        let worse = |row: &Row| Row {
            value: row.value.map(|value| value * (1.0 + 0.1 * place as f64)),
            ..row.clone()
        };
        outcome.metrics.extend(rows.iter().map(|row| MetricRow {
            horizon: 1,
            given: None,
            task,
            model: String::from(model),
            row: worse(row),
        }));
    }
    if definition.is_image() {
        outcome.frames.extend((0..samples).map(|sample| FrameRow {
            task,
            modality,
            episode: 36,
            sample: sample as u32 + 1,
            motion: 0.01 * sample as f64,
            reference: (0..width).map(|place| (place / 64) as u8).collect(),
            predicted: (0..width).map(|place| (place / 64 + sample) as u8).collect(),
        }));
    } else {
        let values = reference.into_iter().zip(predicted).enumerate();
        outcome.predictions.extend(values.map(|(place, (reference, predicted))| PredictionRow {
            horizon: 1,
            given: None,
            task,
            modality,
            episode: 36 + (place / width) as u32 % EPISODES,
            sample: (place / width) as u32 / EPISODES,
            index: (place % width) as u32,
            reference,
            predicted,
        }));
    }
    Ok(())
}

/// Returns the forces of a dataset and of its episodes. They are the same for all runs of a scenario.
fn forces(spec: &RunSpec) -> Vec<ForceRows> {
    let mut random = ChaCha8Rng::seed_from_u64(u64::from(spec.scenario.name() == "empty"));
    let episodes = spec.simulation.as_ref().map_or(0, |simulation| simulation.episodes);
    let width = Layout::finger()[Modality::CONTACT_FORCE].width();
    let mut links = || -> Vec<Contact> {
        let values: Vec<f32> = (0..100 * width).map(|_| (random.random::<f32>() - 0.5).max(0.0)).collect();
        by_link(&values, width)
    };
    let mut rows = Vec::new();
    for modality in [Modality::CONTACT_FORCE, Modality::CONTACT_FORCE_MEAN] {
        let parts = std::iter::once(None).chain((0..episodes).map(Some));
        rows.extend(parts.map(|episode| ForceRows { modality, episode, links: links() }));
    }
    rows
}
