//! Means of metrics over datasets and seeds.

use super::{Analysis, AnalysisError, Interval, Run, Setting, interval};
use harness_catalog::{OVERALL, QueryError, rows};
use harness_judge::models::NETWORK;
use harness_registry::Registry;
use harness_spec::{Modality, Origin, Task};
use polars::prelude::{Column, DataFrame, PolarsResult};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// The mean of a metric for the networks of a group of runs, or for a baseline. The metric is computed over all joints,
/// links or pixels, or over those with the same unit if their units differ.
#[derive(Debug, Clone, PartialEq)]
pub struct Mean {
    /// The group, the model and the metric.
    pub of: Of,
    /// Unit of the values.
    pub unit: String,
    /// The values of all datasets and seeds. A baseline has one value for each dataset, because it has no seed.
    pub values: Vec<f64>,
    /// Number of datasets that the values are of.
    pub datasets: usize,
    /// Their mean, with a confidence interval.
    pub interval: Interval,
}

/// The group, the model and the metric of a [`Mean`].
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Of {
    /// The name of the experiment.
    pub experiment: String,
    /// The scenario or imported dataset.
    pub scenario: Origin,
    /// The settings that the experiment varies, such as `kl_weight=0.001`; empty if it varies none.
    pub variant: String,
    /// The other settings in which the experiment's runs differ; see [`Analysis::settings`].
    pub settings: String,
    /// Size of the latent state; `None` for a baseline and an external model, which have none.
    pub latent: Option<usize>,
    /// The task that is evaluated.
    pub task: Task,
    /// The predicted modality.
    pub modality: Modality,
    /// `in` and the unit of the elements, such as `in rad`, if the modality has elements of different units.
    pub direction: Option<String>,
    /// The name of the metric, such as `r2`.
    pub metric: String,
    /// [`NETWORK`], or the name of a baseline.
    pub model: String,
}

/// The means of the finished runs of some experiments, or of all, as a table with one row for each mean.
///
/// # Errors
/// When one of the experiments has no finished runs, no run has a requested setting, or a table is damaged.
pub fn compare(
    registry: &Registry,
    experiments: &[String],
    settings: &[Setting],
) -> Result<DataFrame, AnalysisError> {
    let analysis = Analysis::finished(registry, experiments, settings)?;
    Ok(Mean::frame(&analysis.means()?).map_err(QueryError::Sql)?)
}

impl Of {
    /// Returns the name of the modality, followed by the unit of its elements if they are only a part of it: `joints in
    /// rad`.
    pub fn predicted(&self) -> String {
        let part = self.direction.iter().map(String::as_str);
        std::iter::once(self.modality.name()).chain(part).collect::<Vec<_>>().join(" ")
    }
}

impl Mean {
    /// Converts means to a table with one row for each mean.
    ///
    /// # Errors
    /// When Polars can't build the table, for which no reason is known.
    pub fn frame(means: &[Mean]) -> PolarsResult<DataFrame> {
        let text = |name: &str, of: &dyn Fn(&Mean) -> String| {
            Column::new(name.into(), means.iter().map(of).collect::<Vec<_>>())
        };
        let number = |name: &str, of: &dyn Fn(&Mean) -> Option<f64>| {
            Column::new(name.into(), means.iter().map(of).collect::<Vec<_>>())
        };
        let count = |name: &str, of: &dyn Fn(&Mean) -> Option<i64>| {
            Column::new(name.into(), means.iter().map(of).collect::<Vec<_>>())
        };
        let columns = vec![
            text("experiment", &|mean| mean.of.experiment.clone()),
            text("scenario", &|mean| mean.of.scenario.to_string()),
            count("latent", &|mean| mean.of.latent.map(|latent| latent as i64)),
            text("variant", &|mean| mean.of.variant.clone()),
            text("settings", &|mean| mean.of.settings.clone()),
            text("task", &|mean| mean.of.task.to_string()),
            text("model", &|mean| mean.of.model.clone()),
            text("modality", &|mean| mean.of.modality.to_string()),
            Column::new(
                "direction".into(),
                means.iter().map(|mean| mean.of.direction.clone()).collect::<Vec<_>>(),
            ),
            text("metric", &|mean| mean.of.metric.clone()),
            text("unit", &|mean| mean.unit.clone()),
            count("datasets", &|mean| Some(mean.datasets as i64)),
            count("seeds", &|mean| Some(mean.values.len() as i64)),
            number("mean", &|mean| Some(mean.interval.mean)),
            number("low", &|mean| mean.interval.bounds.map(|(low, _)| low)),
            number("high", &|mean| mean.interval.bounds.map(|(_, high)| high)),
        ];
        DataFrame::new(means.len(), columns)
    }
}

/// What the intervals of some means are over: `2 seeds`, `1 to 2 seeds`, `3 datasets`, or `3 datasets (6 runs)`. `None`
/// if each mean is of one value.
pub fn replicates_of<'a>(means: impl IntoIterator<Item = &'a Mean>) -> Option<String> {
    let (several, one): (Vec<&Mean>, Vec<&Mean>) =
        means.into_iter().partition(|mean: &&Mean| mean.datasets > 1);
    let range = |means: &[&Mean], count: fn(&Mean) -> usize| {
        let counts = || means.iter().map(|mean| count(mean));
        let (fewest, most) = (counts().min()?, counts().max()?);
        Some(if fewest < most { format!("{fewest} to {most}") } else { most.to_string() })
    };
    let runs = |mean: &Mean| mean.values.len();
    let datasets = range(&several, |mean| mean.datasets).zip(range(&several, runs));
    let datasets = datasets.map(|(datasets, runs)| match datasets == runs {
        true => format!("{datasets} datasets"),
        false => format!("{datasets} datasets ({runs} runs)"),
    });
    let has_seeds = one.iter().any(|mean| mean.values.len() > 1);
    let seeds = range(&one, runs).filter(|_| has_seeds).map(|seeds| format!("{seeds} seeds"));
    let over: Vec<String> = datasets.into_iter().chain(seeds).collect();
    (!over.is_empty()).then(|| over.join(" or "))
}

/// A row of the metrics table.
#[derive(Deserialize)]
struct Row {
    experiment: String,
    run: String,
    task: Task,
    model: String,
    modality: Modality,
    direction: Option<String>,
    metric: String,
    value: f64,
    unit: String,
}

/// The unit of a mean, and for each run's position the seed of its dataset and the value.
type Values = (String, BTreeMap<usize, (u64, f64)>);

impl Analysis {
    /// The means of all metrics of whole modalities (see [`OVERALL`]), for each group of runs that count, and for the
    /// baselines.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn means(&self) -> Result<Vec<Mean>, QueryError> {
        let experiments: Vec<&str> = self.experiments().collect();
        let mut answer = self.query(
            &experiments,
            &format!(
                "select experiment, run, task, model, modality, direction, metric, value, unit from metrics \
                 where {OVERALL} and value is not null"
            ),
        )?;
        // A baseline's value is taken from the first run of a dataset. All runs of a group repeat it, up to rounding.
        let runs = experiments.iter().flat_map(|experiment| self.runs(experiment));
        let runs: Vec<(&Run, String)> = runs.map(|run| (run, self.settings(run))).collect();
        let name = |run: &Run| (run.record.experiment.clone(), run.record.run.clone());
        let places: HashMap<(String, String), usize> =
            runs.iter().enumerate().map(|(place, (run, _))| (name(run), place)).collect();
        let mut found: BTreeMap<Of, Values> = BTreeMap::new();
        for row in rows::<Row>(&mut answer)? {
            let Some(&place) = places.get(&(row.experiment, row.run)) else { continue };
            let (run, settings) = &runs[place];
            let spec = &run.record.spec;
            let of = Of {
                experiment: run.record.experiment.clone(),
                scenario: spec.scenario.clone(),
                variant: spec.variant.clone(),
                settings: settings.clone(),
                latent: spec.latent().filter(|_| row.model == NETWORK),
                task: row.task,
                modality: row.modality,
                direction: row.direction,
                metric: row.metric,
                model: row.model,
            };
            let (_, values) = found.entry(of).or_insert_with(|| (row.unit, BTreeMap::new()));
            values.insert(place, (spec.dataset_seed(), row.value));
        }
        let mean = |(of, (unit, values)): (Of, Values)| {
            let mut values: Vec<(u64, f64)> = values.into_values().collect();
            if of.model != NETWORK {
                let mut datasets = BTreeSet::new();
                values.retain(|(dataset, _)| datasets.insert(*dataset));
            }
            let interval = interval(values.iter().copied())?;
            let datasets = values.iter().map(|(dataset, _)| dataset).collect::<BTreeSet<_>>().len();
            let values = values.into_iter().map(|(_, value)| value).collect();
            Some(Mean { of, unit, values, datasets, interval })
        };
        Ok(found.into_iter().filter_map(mean).collect())
    }
}
