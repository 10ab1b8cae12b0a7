//! Puts the metrics of networks beside those of the baselines.

use super::{Asked, ReportError};
use harness_analysis::{Analysis, Comparison, Labels, Mean, Part, Side, Subject, usual_key};
use harness_metrics::{Metric, label};
use harness_shared::numbers::rounded;
use harness_spec::{Origin, Task};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// The metrics of an experiment's networks in a scenario, and those of the baselines. Columns are variants if there are
/// several and one latent size, and otherwise latent sizes. Rows are of the next sample, and of the horizon of the spec.
#[derive(Serialize)]
pub struct Table {
    experiment: String,
    scenario: String,
    /// The settings in which these runs differ from others of the experiment; empty if in none.
    settings: String,
    task: Task,
    columns: Vec<String>,
    rows: Vec<Row>,
    /// What the intervals are over, such as `3 seeds`; `None` if each value is of one run.
    over: Option<String>,
}

/// A metric of a modality.
#[derive(Serialize)]
struct Row {
    /// What is predicted and, if the networks predict further than the next sample, how far ahead.
    modality: String,
    metric: String,
    /// `↑` if higher values are better, and `↓` if lower ones are.
    better: &'static str,
    /// The value in each column, and whether it is the best of the row; `None` if there is none.
    values: Vec<Option<(String, bool)>>,
}

/// Returns the tables of the asked experiments; none on the page of all results.
///
/// # Errors
/// When a table is damaged.
pub fn tables(analysis: &Analysis, asked: &Asked) -> Result<Vec<Table>, ReportError> {
    if asked.experiments.is_empty() {
        return Ok(Vec::new());
    }
    let mut by_experiment: BTreeMap<_, Vec<Mean>> = BTreeMap::new();
    for mean in analysis.means_at_own_horizons()?.into_iter().filter(|mean| is_general(&mean.of.metric)) {
        let place = asked.experiments.iter().position(|name| *name == mean.of.experiment);
        by_experiment.entry(place).or_default().push(mean);
    }
    let metrics = Metric::GENERAL.map(|metric| metric.name().to_owned());
    let labels = Labels::new(analysis, &[]);
    let tables = by_experiment.into_values().flat_map(|means| {
        let comparison = Comparison::new(&means, &[usual_key(&means)], &metrics, &labels);
        let parts = comparison.parts().into_iter();
        parts.map(|part| table(&means[0].of.experiment, part, &comparison)).collect::<Vec<_>>()
    });
    Ok(tables.collect())
}

/// Whether a metric is of all pixels, links or joints, and not only of a region or a kind of contact.
fn is_general(metric: &str) -> bool {
    Metric::GENERAL.iter().any(|general| general.name() == metric)
}

/// A table of an experiment.
fn table(experiment: &str, part: Part, comparison: &Comparison) -> Table {
    Table {
        experiment: experiment.to_owned(),
        scenario: part.scenario.map(Origin::to_string).unwrap_or_default(),
        settings: part.settings,
        task: part.task,
        rows: part.rows.iter().map(|subject| Row::new(subject, &part.columns, comparison)).collect(),
        over: part.over,
        columns: part.columns.into_iter().map(name).collect(),
    }
}

/// The name of a column: `network, z = 4`, a variant, or a baseline.
fn name(side: &Side) -> String {
    match side.place.latent {
        Some(latent) => format!("network, z = {latent}"),
        None => side.name(),
    }
}

impl Row {
    fn new(subject: &Subject, columns: &BTreeSet<&Side>, comparison: &Comparison) -> Self {
        let values: BTreeMap<&Side, &Mean> = comparison.row(subject).collect();
        let (metric, unit) = (Metric::GENERAL[subject.metric], comparison.units[subject]);
        let is_up = metric.higher_is_better();
        let means = || values.values().map(|mean| mean.interval.mean);
        let best = if is_up { means().fold(f64::MIN, f64::max) } else { means().fold(f64::MAX, f64::min) };
        let words = |column: &&Side| {
            let interval = &values.get(column)?.interval;
            let half = interval.bounds.filter(|(low, high)| low < high).map(|(low, high)| (high - low) / 2.0);
            let half = half.map(|half| format!(" ± {}", rounded(half))).unwrap_or_default();
            // Equal numbers are equally good, also if they differ in digits that are not shown.
            let is_best = rounded(interval.mean) == rounded(best);
            Some((format!("{}{half}", rounded(interval.mean)), is_best))
        };
        Self {
            modality: subject.predicted_ahead(),
            metric: label(metric.name(), unit),
            better: if is_up { "↑" } else { "↓" },
            values: columns.iter().map(words).collect(),
        }
    }
}
