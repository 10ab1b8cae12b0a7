//! `harness compare`.

use super::DONE;
use super::sheet::{Sheet, Style};
use anyhow::Result;
use clap::builder::PossibleValuesParser;
use clap::{Args, ValueEnum};
use harness::metrics::Metric;
use harness::metrics::interval::{Interval, LEVEL, mean_interval};
use harness::registry::{Registry, query_latest, rows};
use harness::spec::{Modality, Origin, Task};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;

/// The network among the models; the others are baselines.
const NETWORK: &str = "network";

#[derive(Args)]
pub struct Compare {
    /// Experiments to compare, as `harness ls` names them [default: all]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// What stands side by side; what is left of these tells the rows apart
    #[arg(long, value_name = "KEY", value_delimiter = ',', default_value = "latent")]
    by: Vec<Key>,
    /// What to compare
    #[arg(long, value_name = "METRIC", value_delimiter = ',', default_value = "smape,wmape,r2,relative_error",
          value_parser = PossibleValuesParser::new(Metric::ALL.map(Metric::name)))]
    metrics: Vec<String>,
    /// Whose predictions to compare
    #[arg(long, value_name = "MODEL", value_delimiter = ',', default_value = "network,persistence,ridge,training_mean",
          value_parser = PossibleValuesParser::new([NETWORK, "persistence", "ridge", "training_mean"]))]
    models: Vec<String>,
    /// One task alone
    #[arg(long, value_parser = PossibleValuesParser::new(Task::ALL.iter().map(|task| task.name())))]
    task: Option<String>,
    #[arg(long, value_name = "FORMAT", default_value = "text")]
    format: Style,
}

/// What tells cells apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
enum Key {
    Experiment,
    Scenario,
    Latent,
    /// Settings that an experiment varies.
    Variant,
}

/// Why there is nothing to compare.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    #[error("'{wanted}' has no finished runs; those that have: {}", there.join(", "))]
    Experiment { wanted: String, there: Vec<String> },
    #[error(
        "no run has these metrics of this task and model; `harness compare` without options prints what there is"
    )]
    Empty,
    #[error(
        "there are no finished runs to compare; `harness run experiments/single_to_multi.yaml` makes some"
    )]
    Nothing,
}

impl Compare {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let scores = scores(registry)?;
        let there: BTreeSet<&String> = scores.iter().map(|score| &score.experiment).collect();
        if there.is_empty() {
            return Err(CompareError::Nothing.into());
        }
        if let Some(wanted) = self.experiments.iter().find(|wanted| !there.contains(wanted)) {
            let there = there.into_iter().cloned().collect();
            return Err(CompareError::Experiment { wanted: wanted.clone(), there }.into());
        }
        let chosen = scores.iter().filter(|score| {
            (self.experiments.is_empty() || self.experiments.contains(&score.experiment))
                && self.metrics.contains(&score.metric)
                && self.models.contains(&score.model)
                && self.task.as_ref().is_none_or(|task| task == score.task.name())
        });
        let comparison = Comparison::new(chosen, &self.by, &self.metrics);
        if comparison.values.is_empty() {
            return Err(CompareError::Empty.into());
        }
        print!("{}", comparison.sheet(self.format).render(self.format));
        Ok(ExitCode::from(DONE))
    }
}

/// A metric over all joints, links or pixels.
#[derive(Deserialize)]
struct Score {
    experiment: String,
    scenario: Origin,
    latent: u64,
    variant: String,
    seed: u64,
    task: Task,
    model: String,
    modality: Modality,
    metric: String,
    value: f64,
    unit: String,
}

fn scores(registry: &Registry) -> Result<Vec<Score>> {
    let mut answer = query_latest(
        registry,
        "select experiment, scenario, latent, variant, seed, task, model, modality, metric, value, unit from metrics \
         where index is null and direction is null and value is not null",
    )?;
    Ok(rows(&mut answer)?)
}

/// Where a cell stands, by those keys that are asked for.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    experiment: Option<String>,
    scenario: Option<Origin>,
    latent: Option<u64>,
    variant: Option<String>,
}

impl Place {
    fn of(score: &Score, has: impl Fn(Key) -> bool) -> Self {
        Self {
            experiment: has(Key::Experiment).then(|| score.experiment.clone()),
            scenario: has(Key::Scenario).then(|| score.scenario.clone()),
            latent: has(Key::Latent).then_some(score.latent),
            variant: has(Key::Variant).then(|| score.variant.clone()).filter(|variant| !variant.is_empty()),
        }
    }

    /// The words of the keys that it has.
    fn words(&self) -> Vec<String> {
        let scenario = self.scenario.as_ref().map(|scenario| scenario.name().to_owned());
        let latent = self.latent.map(|latent| format!("latent {latent}"));
        [self.experiment.clone(), scenario, latent, self.variant.clone()].into_iter().flatten().collect()
    }
}

/// What a column is about: the network's cells first, then each baseline's.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Side {
    /// `None` for the network.
    baseline: Option<String>,
    place: Place,
}

/// What a row is about; the metric by its place among those asked for.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Subject {
    task: Task,
    place: Place,
    modality: Modality,
    metric: usize,
}

/// Values by seed, of every row and column.
struct Comparison<'a> {
    metrics: &'a [String],
    units: BTreeMap<Subject, &'a str>,
    values: BTreeMap<(Subject, Side), BTreeMap<u64, f64>>,
}

impl<'a> Comparison<'a> {
    fn new(scores: impl Iterator<Item = &'a Score>, by: &[Key], metrics: &'a [String]) -> Self {
        let mut comparison = Self { metrics, units: BTreeMap::new(), values: BTreeMap::new() };
        for score in scores {
            let baseline = (score.model != NETWORK).then(|| score.model.clone());
            // A baseline has no latent state.
            let side = |key| by.contains(&key) && (key != Key::Latent || baseline.is_none());
            let side = Place::of(score, side);
            let subject = Subject {
                task: score.task,
                place: Place::of(score, |key| !by.contains(&key)),
                modality: score.modality,
                metric: metrics.iter().position(|name| *name == score.metric).unwrap_or(metrics.len()),
            };
            comparison.units.insert(subject.clone(), &score.unit);
            // Nor has it a seed: it is the same beside every network.
            let seed = if baseline.is_none() { score.seed } else { 0 };
            let values = comparison.values.entry((subject, Side { baseline, place: side })).or_default();
            values.insert(seed, score.value);
        }
        comparison
    }

    fn sheet(&self, style: Style) -> Sheet {
        let sides: BTreeSet<&Side> = self.values.keys().map(|(_, side)| side).collect();
        let header = sides.iter().map(|side| {
            let words = side.baseline.iter().map(|name| name.replace('_', " ")).chain(side.place.words());
            words.collect::<Vec<_>>().join(", ")
        });
        let rows = self.units.iter().map(|(subject, unit)| {
            let values = sides.iter().map(|side| self.values.get(&(subject.clone(), (*side).clone())));
            (self.words(subject, unit), self.cells(subject, unit, values, style))
        });
        Sheet { header: header.collect(), rows: rows.collect(), note: self.note() }
    }

    /// What a row is about: task, place, modality, metric and unit.
    fn words(&self, subject: &Subject, unit: &str) -> Vec<String> {
        let metric = &self.metrics[subject.metric];
        let metric = match metric.as_str() {
            "smape" | "wmape" | "r2" | "rmse" | "mae" => metric.to_uppercase(),
            name => name.replace('_', " "),
        };
        let metric = if unit == "1" { metric } else { format!("{metric} ({unit})") };
        let mut words = vec![subject.task.name().to_owned()];
        words.extend(subject.place.words());
        words.extend([subject.modality.name().replace('_', " "), metric]);
        words
    }

    /// Mean and half of the interval over seeds, the best marked; empty where there is none.
    fn cells<'v>(
        &self,
        subject: &Subject,
        unit: &str,
        values: impl Iterator<Item = Option<&'v BTreeMap<u64, f64>>>,
        style: Style,
    ) -> Vec<String> {
        let intervals: Vec<Option<Interval>> =
            values.map(|seeds| mean_interval(&seeds?.values().copied().collect::<Vec<_>>(), LEVEL)).collect();
        let means = intervals.iter().flatten().map(|interval| interval.mean);
        let best = match self.metrics[subject.metric].as_str() {
            _ if intervals.iter().flatten().count() < 2 => None,
            "r2" => means.max_by(f64::total_cmp),
            _ => means.min_by(f64::total_cmp),
        };
        let decimals = match unit {
            "%" => 2,
            "1" => 3,
            _ => 4,
        };
        let cell = |interval: &Option<Interval>| {
            let Some(interval) = interval else { return String::new() };
            let number = |value: f64| without_negative_zero(format!("{value:.decimals$}"));
            let half = interval.bounds.map(|(_, high)| number(high - interval.mean));
            style.number(&number(interval.mean), half.as_deref(), best == Some(interval.mean))
        };
        intervals.iter().map(cell).collect()
    }

    fn note(&self) -> String {
        let network = self.values.iter().filter(|((_, side), _)| side.baseline.is_none());
        let seeds: BTreeSet<usize> = network.map(|(_, values)| values.len()).collect();
        match (seeds.first(), seeds.last()) {
            (Some(1), Some(1)) => "one seed, so without intervals".into(),
            (Some(fewest), Some(most)) if fewest < most => {
                format!("mean ± half of the 95 % interval over {fewest} to {most} seeds")
            }
            (Some(seeds), _) => format!("mean ± half of the 95 % interval over {seeds} seeds"),
            _ => String::new(),
        }
    }
}

fn without_negative_zero(number: String) -> String {
    match number.strip_prefix('-') {
        Some(zero) if zero.chars().all(|digit| matches!(digit, '0' | '.')) => zero.to_owned(),
        _ => number,
    }
}
