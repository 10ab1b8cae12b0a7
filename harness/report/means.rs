//! Puts the metrics of networks beside those of the baselines.

use super::{Asked, ReportError};
use harness_analysis::models::NETWORK;
use harness_analysis::{Analysis, Mean, Of, replicates_of};
use harness_metrics::{Metric, label};
use harness_shared::numbers::rounded;
use harness_spec::Task;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// The metrics of the networks of one cell, for each latent size, and those of the baselines.
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
    modality: String,
    metric: String,
    /// `↑` if higher values are better, and `↓` if lower ones are.
    better: &'static str,
    /// The value in each column, and whether it is the best of the row; `None` if there is none.
    values: Vec<Option<(String, bool)>>,
}

/// A column: the networks of a latent size, an external model, or a baseline. The networks come first.
type Column = (bool, String, Option<usize>);

/// Returns the tables of the asked experiments; none on the page of all results.
///
/// # Errors
/// When a table is damaged.
pub fn tables(analysis: &Analysis, asked: &Asked) -> Result<Vec<Table>, ReportError> {
    if asked.experiments.is_empty() {
        return Ok(Vec::new());
    }
    let means = analysis.means()?;
    let mut cells: BTreeMap<_, Vec<&Mean>> = BTreeMap::new();
    for mean in means.iter().filter(|mean| is_general(&mean.of.metric)) {
        let of = &mean.of;
        let place = asked.experiments.iter().position(|name| *name == of.experiment);
        let settings = [of.variant.as_str(), of.settings.as_str()].map(|text| text.replace(',', ", "));
        let settings: Vec<String> = settings.into_iter().filter(|text| !text.is_empty()).collect();
        let key = (place, of.task, of.scenario.clone(), settings.join(", "));
        cells.entry(key).or_default().push(mean);
    }
    let table = |((_, task, scenario, settings), means): (_, Vec<&Mean>)| {
        Table::new(task, String::from(scenario), settings, &means)
    };
    Ok(cells.into_iter().map(table).collect())
}

/// Whether a metric is of all pixels, links or joints, and not only of a region or a kind of contact.
fn is_general(metric: &str) -> bool {
    Metric::GENERAL.iter().any(|general| general.name() == metric)
}

impl Table {
    fn new(task: Task, scenario: String, settings: String, means: &[&Mean]) -> Self {
        let column = |of: &Of| -> Column { (of.model != NETWORK, of.model.clone(), of.latent) };
        let columns: BTreeSet<Column> = means.iter().map(|mean| column(&mean.of)).collect();
        let mut rows: BTreeMap<_, BTreeMap<Column, &Mean>> = BTreeMap::new();
        for &mean in means {
            let of = &mean.of;
            let place = Metric::GENERAL.iter().position(|metric| metric.name() == of.metric);
            let row = (of.modality, of.direction.clone(), place, of.metric.clone());
            rows.entry(row).or_default().insert(column(of), mean);
        }
        let rows = rows.into_values().map(|values| Row::new(&columns, &values));
        Self {
            experiment: means[0].of.experiment.clone(),
            scenario,
            settings,
            task,
            rows: rows.collect(),
            columns: columns.iter().map(name).collect(),
            over: replicates_of(means.iter().copied().filter(|mean| mean.of.model == NETWORK)),
        }
    }
}

/// The name of a column: `network, z = 4`, or that of a baseline.
fn name((_, model, latent): &Column) -> String {
    let model = model.replace('_', " ");
    match latent {
        Some(latent) => format!("{model}, z = {latent}"),
        None => model,
    }
}

impl Row {
    fn new(columns: &BTreeSet<Column>, values: &BTreeMap<Column, &Mean>) -> Self {
        let first = values.values().next().expect("a row has a value");
        let (metric, unit) = (first.of.metric.as_str(), first.unit.as_str());
        let is_up = Metric::named(metric).is_some_and(Metric::higher_is_better);
        let means = || values.values().map(|mean| mean.interval.mean);
        let best = if is_up { means().fold(f64::MIN, f64::max) } else { means().fold(f64::MAX, f64::min) };
        let words = |column: &Column| {
            let interval = &values.get(column)?.interval;
            let half = interval.bounds.filter(|(low, high)| low < high).map(|(low, high)| (high - low) / 2.0);
            let half = half.map(|half| format!(" ± {}", rounded(half))).unwrap_or_default();
            // Equal numbers are equally good, also if they differ in digits that are not shown.
            let is_best = rounded(interval.mean) == rounded(best);
            Some((format!("{}{half}", rounded(interval.mean)), is_best))
        };
        Self {
            modality: first.of.predicted().replace('_', " "),
            metric: label(metric, unit),
            better: if is_up { "↑" } else { "↓" },
            values: columns.iter().map(words).collect(),
        }
    }
}
