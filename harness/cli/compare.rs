//! `harness compare`.

use super::DONE;
use super::sheet::{Sheet, Style, best, rounded};
use super::table::{shown, width};
use anyhow::Result;
use clap::builder::PossibleValuesParser;
use clap::{Args, ValueEnum};
use harness::analysis::{Analysis, Interval, Mean, NETWORK, Of, Selection, Setting};
use harness::metrics::Metric;
use harness::registry::{Registry, save};
use harness::spec::{Modality, Origin, Task};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Compare {
    /// Experiments to compare, as `harness ls` names them [default: all]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// The keys that distinguish columns; the other keys distinguish rows
    #[arg(long, value_name = "KEY", value_delimiter = ',', default_value = "latent")]
    by: Vec<Key>,
    /// The metrics to compare
    #[arg(long, value_name = "METRIC", value_delimiter = ',', default_value = "smape,wmape,r2,relative_error",
          value_parser = metric)]
    metrics: Vec<String>,
    /// The network, baselines or both
    #[arg(long, value_name = "MODEL", value_delimiter = ',', default_value = "network,persistence,ridge,training_mean",
          value_parser = PossibleValuesParser::new([NETWORK, "persistence", "ridge", "training_mean"]))]
    models: Vec<String>,
    /// Only this task
    #[arg(long, value_parser = PossibleValuesParser::new(Task::ALL.iter().map(|task| task.name())))]
    task: Option<String>,
    /// Only runs with this setting, such as training.batch_size=64
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
    /// The format of the table
    #[arg(long, value_name = "FORMAT", default_value = "text")]
    format: Style,
    /// Write the means to a file instead, one per row: .parquet, .csv or .json
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Parses the name of a metric.
pub fn metric(name: &str) -> Result<String, String> {
    let names = Metric::GENERAL.map(Metric::name).join(", ");
    let found = Metric::named(name).map(|metric| metric.name().to_owned());
    found.ok_or_else(|| format!("the metrics are {names}, and relative_error_REGION of a world's regions, as relative_error_finger"))
}

/// A key by which the cells of the table are distinguished.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
enum Key {
    Experiment,
    Scenario,
    Latent,
    /// Settings that an experiment varies.
    Variant,
    /// The other settings in which runs of an experiment differ.
    Settings,
}

/// The reason why there is nothing to compare.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// No run has the requested metrics. The field is a command that prints all means.
    #[error("no run has these metrics of this task and model; `{0}` prints what there is")]
    Empty(String),
    /// There are no finished runs. The field is a command that makes some.
    #[error("there are no finished runs to compare; `{0}` makes some")]
    Nothing(String),
}

impl Compare {
    /// Prints the table, or writes the means to a file.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let selection = Selection {
            experiments: self.experiments.clone(),
            settings: self.settings.clone(),
            simulated: false,
        };
        let analysis = Analysis::new(registry, &selection)?;
        analysis.check_finished(&self.experiments)?;
        if analysis.experiments().next().is_none() {
            return Err(CompareError::Nothing(analysis.command("single_to_multi", false)).into());
        }
        let is_wanted = |mean: &Mean| {
            self.metrics.contains(&mean.of.metric)
                && self.models.contains(&mean.of.model)
                && self.task.as_ref().is_none_or(|task| task == mean.of.task.name())
        };
        let means: Vec<Mean> = analysis.means()?.into_iter().filter(is_wanted).collect();
        if let Some(path) = self.output {
            save(&mut Mean::frame(&means)?, &path)?;
            println!("{} means in {}", means.len(), shown(&path));
            return Ok(ExitCode::from(DONE));
        }
        let mut comparison = Comparison::new(means.iter(), &self.by, &self.metrics);
        comparison.notes.extend(analysis.notes().iter().cloned());
        if comparison.values.is_empty() {
            return Err(CompareError::Empty(registry.command("compare")).into());
        }
        print!("{}", comparison.sheet(self.format).render(self.format, width()));
        Ok(ExitCode::from(DONE))
    }
}

/// The values of some keys for a row or a column; `None` for all other keys.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    experiment: Option<String>,
    scenario: Option<Origin>,
    latent: Option<usize>,
    variant: Option<String>,
    settings: Option<String>,
}

impl Place {
    fn of(of: &Of, has: impl Fn(Key) -> bool) -> Self {
        Self {
            experiment: has(Key::Experiment).then(|| of.experiment.clone()),
            scenario: has(Key::Scenario).then(|| of.scenario.clone()),
            latent: of.latent.filter(|_| has(Key::Latent)),
            variant: has(Key::Variant).then(|| of.variant.clone()),
            settings: has(Key::Settings).then(|| of.settings.clone()),
        }
    }

    /// A text for each key, empty if it has no value.
    fn words(&self) -> [String; 5] {
        let scenario = self.scenario.as_ref().map(|scenario| scenario.name().to_owned());
        let latent = self.latent.map(|latent| format!("latent {latent}"));
        [self.experiment.clone(), scenario, latent, self.variant.clone(), self.settings.clone()]
            .map(Option::unwrap_or_default)
    }
}

/// A column of the table. Columns of the network come first, then those of each baseline.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Side {
    /// `None` for the network.
    baseline: Option<String>,
    place: Place,
}

/// A row of the table.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Subject {
    task: Task,
    place: Place,
    modality: Modality,
    /// The position of the metric among the requested metrics.
    metric: usize,
}

/// The means of all rows and columns.
struct Comparison<'a> {
    metrics: &'a [String],
    units: BTreeMap<Subject, &'a str>,
    values: BTreeMap<(Subject, Side), &'a Mean>,
    notes: Vec<String>,
}

impl<'a> Comparison<'a> {
    fn new(means: impl Iterator<Item = &'a Mean>, by: &[Key], metrics: &'a [String]) -> Self {
        let mut comparison =
            Self { metrics, units: BTreeMap::new(), values: BTreeMap::new(), notes: Vec::new() };
        for mean in means {
            let of = &mean.of;
            let baseline = (of.model != NETWORK).then(|| of.model.clone());
            let side = Side { baseline, place: Place::of(of, |key| by.contains(&key)) };
            let subject = Subject {
                task: of.task,
                place: Place::of(of, |key| !by.contains(&key)),
                modality: of.modality,
                metric: metrics.iter().position(|name| *name == of.metric).unwrap_or(metrics.len()),
            };
            comparison.units.insert(subject.clone(), &mean.unit);
            comparison.values.insert((subject, side), mean);
        }
        comparison.notes.push(comparison.seeds());
        comparison
    }

    fn sheet(&self, style: Style) -> Sheet {
        let sides: BTreeSet<&Side> = self.values.keys().map(|(_, side)| side).collect();
        let header = sides.iter().map(|side| {
            let words = side.baseline.iter().map(|name| name.replace('_', " ")).chain(side.place.words());
            words.filter(|word| !word.is_empty()).collect::<Vec<_>>().join(", ")
        });
        let rows = self.units.iter().map(|(subject, unit)| {
            let values =
                sides.iter().map(|side| self.values.get(&(subject.clone(), (*side).clone())).copied());
            (self.words(subject, unit, style), self.cells(subject, unit, values, style))
        });
        let rows: Vec<_> = rows.collect();
        // The last two words are the modality and the metric.
        let titles = rows.first().map_or(0, |(words, _)| words.len() - 2);
        Sheet { titles, header: header.collect(), rows, notes: self.notes.clone() }
    }

    /// The words of a row: task, keys, modality, metric and unit.
    fn words(&self, subject: &Subject, unit: &str, style: Style) -> Vec<String> {
        let metric = &self.metrics[subject.metric];
        let mut words = vec![subject.task.name().to_owned()];
        words.extend(subject.place.words());
        words.extend([subject.modality.name().replace('_', " "), style.metric(metric, unit)]);
        words
    }

    /// The cells of a row: the mean and half of its interval, with the best mean marked. A missing mean is empty.
    fn cells<'v>(
        &self,
        subject: &Subject,
        unit: &str,
        values: impl Iterator<Item = Option<&'v Mean>>,
        style: Style,
    ) -> Vec<String> {
        let intervals: Vec<Option<Interval>> = values.map(|mean| Some(mean?.interval)).collect();
        let means: Vec<Option<f64>> =
            intervals.iter().map(|interval| Some(interval.as_ref()?.mean)).collect();
        let best = best(&self.metrics[subject.metric], &means);
        let cell = |interval: &Option<Interval>| {
            let Some(interval) = interval else { return String::new() };
            let number = |value: f64| rounded(value, unit);
            let half = interval.bounds.map(|(_, high)| number(high - interval.mean));
            style.number(&number(interval.mean), half.as_deref(), best == Some(interval.mean))
        };
        intervals.iter().map(cell).collect()
    }

    /// A note with the number of seeds of the means.
    fn seeds(&self) -> String {
        let network = self.values.iter().filter(|((_, side), _)| side.baseline.is_none());
        let seeds: BTreeSet<usize> = network.map(|(_, mean)| mean.values.len()).collect();
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
