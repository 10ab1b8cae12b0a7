//! Collects how well each element of a vector is predicted, such as the angle of a joint or the force on a link.

use super::subjects::{Subject, direction_of, of_each};
use super::{Absent, Asked, short};
use harness_analysis::models::NETWORK;
use harness_analysis::{Interval, LEVEL, mean_interval, replicates};
use harness_catalog::rows;
use harness_figures::FigureError;
use harness_figures::source::{Runs, Source};
use harness_metrics::Direction;
use harness_spec::{Definition, Modality, Origin, Task};
use polars::prelude::{DataType, IntoLazy, col};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// A mean over datasets or seeds: `[mean]` for one of them, or `[mean, low, high]` with the ends of its interval.
pub type Value = Vec<f64>;

/// The values of a metric for one cell, or for a baseline.
#[derive(Serialize)]
pub struct Series {
    #[serde(flatten)]
    of: Of,
    /// The datasets or seeds that the means are over: `one seed`, `3 seeds` or `3 datasets`.
    over: String,
    /// The names of the elements.
    elements: Vec<String>,
    /// The direction of each joint or link, if it is one of the paper's two.
    directions: Vec<Option<&'static str>>,
    /// The value of each element. `None` if the metric isn't defined there.
    values: Vec<Option<Value>>,
    /// The value over all elements of a group (keys such as `fe` and `aa`) or unit (`in rad`), or over all of them
    /// (`all`).
    overall: BTreeMap<String, Value>,
}

/// What a series shows. No two series have the same.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
struct Of {
    task: Task,
    modality: Modality,
    metric: String,
    scenario: Origin,
    /// The networks' latent size. `None` for a baseline.
    latent: Option<u64>,
    /// The name of the study or experiment.
    study: String,
    /// What tells its networks apart, in words.
    input: String,
    model: String,
    unit: String,
}

/// The columns by which rows are grouped. Rows of a group differ only in their seed and the seed of their dataset.
#[derive(Deserialize)]
struct Row {
    task: Task,
    modality: Modality,
    metric: String,
    scenario: Origin,
    latent: u64,
    model: String,
    unit: String,
    direction: Option<String>,
    index: Option<usize>,
}

/// A value with the seed of its dataset.
type Replicate = (u64, f64);

/// A value's place in its series.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    /// The element of this index.
    Joint(usize),
    /// All elements of a group or unit, or `all` of them.
    Overall(String),
}

/// Returns the series of all subjects, and a reason for each subject without runs.
///
/// # Errors
/// When a table can't be read.
pub fn series(
    source: &Source,
    subjects: &[Subject],
    asked: &Asked,
) -> Result<(Vec<Series>, BTreeSet<Absent>), FigureError> {
    let sql = if asked.experiments.is_empty() { SQL } else { ALL_SQL };
    of_each(source, subjects, asked, |runs, subject| of_subject(runs, subject, sql))
}

/// The query on the metrics table for the rows of every modality.
pub const ALL_SQL: &str = "select task, modality, metric, scenario, latent, model, unit, direction, index, \
    dataset_seed, value from metrics join runs using (experiment, run, scenario, latent) \
    where model in ('network', 'persistence', 'ridge')";

/// The query on the metrics table for the rows of the paper's joints and links.
pub const SQL: &str = "select task, modality, metric, scenario, latent, model, unit, direction, index, dataset_seed, \
    value from metrics join runs using (experiment, run, scenario, latent) \
    where modality in ('proprioception', 'contact_force') and model in ('network', 'persistence', 'ridge')";

fn of_subject(runs: &Runs, subject: &Subject, sql: &str) -> Result<Vec<Series>, FigureError> {
    let keys =
        ["task", "modality", "metric", "scenario", "latent", "model", "unit", "direction", "index"].map(col);
    let values = [col("dataset_seed").cast(DataType::UInt64), col("value")];
    let mut groups = runs.query(sql)?.lazy().group_by_stable(keys).agg(values).collect()?;
    let [datasets, values] = [groups.drop_in_place("dataset_seed")?, groups.drop_in_place("value")?];
    let (datasets, values) = (datasets.list()?, values.list()?);
    let mut all: BTreeMap<Of, BTreeMap<Place, Vec<Replicate>>> = BTreeMap::new();
    for (group, row) in rows::<Row>(&mut groups)?.into_iter().enumerate() {
        if !subject.modalities.contains(&row.modality) {
            continue;
        }
        let is_network = row.model == NETWORK;
        let of = Of {
            task: row.task,
            modality: row.modality,
            metric: row.metric,
            scenario: row.scenario,
            latent: is_network.then_some(row.latent),
            study: subject.name.clone(),
            input: subject.words.clone(),
            model: row.model,
            unit: row.unit,
        };
        let place = match row.index {
            Some(joint) => Place::Joint(joint),
            None => Place::Overall(row.direction.unwrap_or_else(|| "all".into())),
        };
        let found = all.entry(of).or_default().entry(place).or_default();
        if let (Some(datasets), Some(values)) = (datasets.get_as_series(group), values.get_as_series(group)) {
            let pairs = datasets.u64()?.iter().zip(values.f64()?.iter());
            // An imported dataset has no seed.
            found.extend(pairs.filter_map(|(dataset, value)| Some((dataset.unwrap_or_default(), value?))));
        }
        // A baseline has no seed and no latent size. Every run on a dataset has the same value of it, so one is kept.
        if !is_network {
            found.sort_by_key(|(dataset, _)| *dataset);
            found.dedup_by_key(|(dataset, _)| *dataset);
        }
    }
    if all.is_empty() {
        return Err(runs.no_rows());
    }
    let series = |(of, places): (Of, _)| {
        let mut of_scenario = runs.all.iter().filter(|run| run.record.spec.scenario == of.scenario);
        let definition = of_scenario.find_map(|run| run.record.layout.get(of.modality))?;
        Some(Series::new(of, definition, places))
    };
    Ok(all.into_iter().filter_map(series).collect())
}

impl Series {
    /// Whether the elements are the joints or links of a finger.
    pub fn is_of_finger(&self) -> bool {
        self.directions.iter().any(Option::is_some)
    }

    fn new(of: Of, definition: &Definition, places: BTreeMap<Place, Vec<Replicate>>) -> Self {
        let width = definition.width();
        let directions = (0..width).map(|joint| direction_of(definition, joint).map(Direction::name));
        let datasets: BTreeSet<u64> = places.values().flatten().map(|(dataset, _)| *dataset).collect();
        let noun = if datasets.len() > 1 { "datasets" } else { "seeds" };
        let mut most = 0;
        let mut series = Self {
            of,
            over: String::new(),
            elements: definition.elements().iter().map(|element| element.name.clone()).collect(),
            directions: directions.collect(),
            values: vec![None; width],
            overall: BTreeMap::new(),
        };
        for (place, values) in places {
            let values = replicates(values);
            most = most.max(values.len());
            let Some(interval) = mean_interval(&values, LEVEL) else {
                continue;
            };
            match place {
                Place::Joint(joint) if joint < width => series.values[joint] = Some(value(&interval)),
                Place::Joint(_) => {}
                Place::Overall(direction) => drop(series.overall.insert(direction, value(&interval))),
            }
        }
        series.over = if most == 1 { "one seed".into() } else { format!("{most} {noun}") };
        series
    }
}

/// Converts an interval to the form that the page's script reads.
pub fn value(interval: &Interval) -> Value {
    let ends = interval.bounds.into_iter().flat_map(|(low, high)| [low, high]);
    std::iter::once(interval.mean).chain(ends).map(short).collect()
}
