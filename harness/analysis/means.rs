//! Means of metrics over datasets and seeds.

use super::rows::Row;
use super::skill::{skill_horizons, skills};
use super::{
    Analysis, AnalysisError, Estimate, Interval, Key, LEVEL, Over, Run, Setting, interval, replicates,
};
use harness_catalog::{OVERALL, QueryError, rows};
use harness_judge::models::{self, NETWORK, is_baseline};
use harness_metrics::Metric;
use harness_registry::Registry;
use harness_spec::{Modality, Origin, Task, model_parts};
use harness_tables::column_of;
use harness_tables::schema::{GIVEN, HORIZON, Table};
use polars::prelude::{DataFrame, PolarsResult};
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
    /// The seed of the dataset and the seed of the training that each value is of.
    pub seeds: Vec<(u64, u64)>,
    /// Number of datasets that the values are of.
    pub datasets: usize,
    /// Their mean, with an interval.
    pub interval: Interval,
    /// What the interval is to contain.
    pub over: Over,
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
    /// The values of the settings by which means are told apart; see [`Analysis::means_by`].
    pub values: BTreeMap<&'static str, String>,
    /// Number of samples from the present to the predicted one; 0 for a reconstruction. `None` for a mean of
    /// [`Analysis::means`], and for a skill horizon.
    pub horizon: Option<usize>,
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
    /// [`NETWORK`], the name of a baseline, or that of a model of another program.
    pub model: String,
}

impl Of {
    /// Whether the value is of a baseline.
    pub fn is_baseline(&self) -> bool {
        is_baseline(&self.model)
    }

    /// Returns the name of the model of another program that the value is of, if it is of one.
    pub fn external(&self) -> Option<&str> {
        Some(self.model.as_str()).filter(|model| *model != NETWORK && !is_baseline(model))
    }

    /// Whether the value is of the model with this name. [`NETWORK`] stands for all models but baselines.
    pub fn is_by(&self, model: &str) -> bool {
        self.model == model || model == NETWORK && !self.is_baseline()
    }
}

/// The means of the finished runs of some experiments, or of all, as a table with one row for each mean. Those of the
/// next sample, or of these horizons in samples if there are any.
///
/// # Errors
/// When one of the experiments has no finished runs, no run has a requested setting or horizon, or a table is damaged.
pub fn compare(
    registry: &Registry,
    experiments: &[String],
    settings: &[Setting],
    horizons: &BTreeSet<usize>,
) -> Result<DataFrame, AnalysisError> {
    let analysis = Analysis::finished(registry, experiments, settings)?;
    let means = if horizons.is_empty() { analysis.means()? } else { analysis.means_at(horizons, &[])? };
    Ok(Mean::frame(&means).map_err(QueryError::Sql)?)
}

/// Checks that each of these names is one of a model of the harness, or of a model of another program that some means
/// are of.
///
/// # Errors
/// When one of them is not.
pub fn check_models(wanted: &[String], means: &[Mean]) -> Result<(), AnalysisError> {
    let external: BTreeSet<&str> = means.iter().filter_map(|mean| mean.of.external()).collect();
    let known: Vec<&str> = models::ALL.into_iter().chain(external).collect();
    match wanted.iter().find(|wanted| !known.contains(&wanted.as_str())) {
        None => Ok(()),
        Some(wanted) => {
            let known = known.into_iter().map(str::to_owned).collect();
            Err(AnalysisError::UnknownModel { wanted: wanted.clone(), known })
        }
    }
}

impl Of {
    /// Returns the name of the modality, followed by the unit of its elements if they are only a part of it: `joints in
    /// rad`.
    pub fn predicted(&self) -> String {
        let part = self.direction.iter().map(String::as_str);
        std::iter::once(self.modality.name()).chain(part).collect::<Vec<_>>().join(" ")
    }

    /// Whether `name` is that of the predicted modality, or of the part of it with one unit.
    pub fn is_of(&self, name: &str) -> bool {
        self.modality.name() == name || self.predicted() == name
    }
}

impl Mean {
    /// The mean of some values with the seeds of their dataset and training; `None` without values.
    fn new(of: Of, unit: String, replicates: Vec<((u64, u64), f64)>) -> Option<Self> {
        let interval = interval(replicates.iter().map(|((dataset, _), value)| (*dataset, *value)))?;
        let (seeds, values): (Vec<(u64, u64)>, Vec<f64>) = replicates.into_iter().unzip();
        let datasets = seeds.iter().map(|(dataset, _)| dataset).collect::<BTreeSet<_>>().len();
        Some(Self { of, unit, values, seeds, datasets, interval, over: Over::Mean })
    }

    /// Returns the mean with another interval. One dataset says nothing about the next, so its mean has no bounds then.
    pub fn with_interval(self, over: Over) -> Self {
        let values =
            || replicates(self.seeds.iter().map(|(dataset, _)| *dataset).zip(self.values.iter().copied()));
        let mean = self.interval.mean;
        let interval = match over {
            Over::Mean => Estimate::of(&values()).map(|estimate| estimate.interval(LEVEL)),
            Over::NextDataset if self.datasets < 2 => None,
            Over::NextDataset => Estimate::of(&values()).map(|estimate| estimate.prediction(LEVEL)),
        };
        Self { interval: interval.unwrap_or(Interval { mean, bounds: None }), over, ..self }
    }

    /// Returns the mean of the differences from `base`, over the seeds of dataset and training that both have; `None`
    /// if they share none. A baseline has no seed of training, so its value is compared with every value on the same
    /// dataset. Both must be of the same scenario, so that the values are of the same data.
    pub fn difference_from(&self, base: &Mean) -> Option<Self> {
        let key = |(dataset, seed): &(u64, u64)| (*dataset, (!base.of.is_baseline()).then_some(*seed));
        let of_base: HashMap<_, f64> = base.seeds.iter().map(key).zip(base.values.iter().copied()).collect();
        let own = self.seeds.iter().zip(&self.values);
        let differences = own.filter_map(|(seeds, value)| Some((*seeds, value - of_base.get(&key(seeds))?)));
        let difference = Self::new(self.of.clone(), self.unit.clone(), differences.collect())?;
        Some(difference.with_interval(self.over))
    }

    /// Whether two means of a baseline share datasets, and have the same value on each of them, up to rounding.
    fn agrees_with(&self, other: &Mean) -> bool {
        const ROUNDING: f64 = 1e-4;
        let of_other: HashMap<u64, f64> =
            other.seeds.iter().map(|(dataset, _)| *dataset).zip(other.values.iter().copied()).collect();
        let own = self.seeds.iter().zip(&self.values);
        let mut shared =
            own.filter_map(|((dataset, _), value)| Some((*value, *of_other.get(dataset)?))).peekable();
        let is_equal = |(a, b): (f64, f64)| (a - b).abs() <= ROUNDING * a.abs().max(b.abs());
        shared.peek().is_some() && shared.all(is_equal)
    }

    /// Converts means to a table with one row for each mean. Settings by which they are told apart are columns, and the
    /// horizon is one if the means have one.
    ///
    /// # Errors
    /// When Polars can't build the table, for which no reason is known.
    pub fn frame(means: &[Mean]) -> PolarsResult<DataFrame> {
        let keys: BTreeSet<&str> = means.iter().flat_map(|mean| mean.of.values.keys().copied()).collect();
        let value = |key: &str| column_of(means, key, |mean| mean.of.values.get(key).map(String::as_str));
        let mut columns = vec![
            column_of(means, "experiment", |mean| mean.of.experiment.as_str()),
            column_of(means, "scenario", |mean| mean.of.scenario.to_string()),
            column_of(means, "latent", |mean| mean.of.latent.map(|latent| latent as i64)),
            column_of(means, "variant", |mean| mean.of.variant.as_str()),
            column_of(means, "settings", |mean| mean.of.settings.as_str()),
            column_of(means, "task", |mean| mean.of.task.name()),
            column_of(means, "model", |mean| mean.of.model.as_str()),
            column_of(means, "modality", |mean| mean.of.modality.name()),
            column_of(means, "direction", |mean| mean.of.direction.as_deref()),
            column_of(means, "metric", |mean| mean.of.metric.as_str()),
            column_of(means, "unit", |mean| mean.unit.as_str()),
            column_of(means, "datasets", |mean| mean.datasets as i64),
            column_of(means, "seeds", |mean| mean.values.len() as i64),
            column_of(means, "mean", |mean| mean.interval.mean),
            column_of(means, "low", |mean| mean.interval.bounds.map(|(low, _)| low)),
            column_of(means, "high", |mean| mean.interval.bounds.map(|(_, high)| high)),
        ];
        let horizon = means.iter().any(|mean| mean.of.horizon.is_some());
        let horizon =
            horizon.then(|| column_of(means, HORIZON, |mean| mean.of.horizon.map(|horizon| horizon as i64)));
        let before = columns.iter().position(|column| column.name() == "task").unwrap_or_default();
        columns.splice(before..before, keys.into_iter().map(value).chain(horizon));
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

/// The part of a variant that names an external model; empty for a network.
fn model_of(variant: &str) -> String {
    model_parts(variant).1.map_or_else(String::new, |model| format!("model={model}"))
}

/// The unit of a mean, and for each run's position the seeds of its dataset and its training, and the value.
type Values = (String, BTreeMap<usize, ((u64, u64), f64)>);

impl Analysis {
    /// The means of all metrics of whole modalities (see [`OVERALL`]), for each group of runs that count, and for the
    /// baselines. The skill is one of the metrics.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn means(&self) -> Result<Vec<Mean>, QueryError> {
        self.means_by(&[])
    }

    /// Like [`Analysis::means`], with means told apart by the settings among `keys`, and by the horizon if it is one of
    /// them. Without [`Key::Horizon`], the means are those of the next sample.
    ///
    /// With settings among the keys, the variant is empty except for the name of an external model, unless it is a key
    /// too. What else the runs of an experiment differ in is in the other settings.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn means_by(&self, keys: &[Key]) -> Result<Vec<Mean>, QueryError> {
        let of = if keys.contains(&Key::Horizon) { Table::AllMetrics } else { Table::Metrics };
        let mut rows = self.rows(of, "")?;
        rows.extend(skills(&rows));
        Ok(self.means_of(rows, keys))
    }

    /// Like [`Analysis::means_by`], with the means of predictions at these horizons, in samples, instead of those of
    /// the next sample.
    ///
    /// # Errors
    /// When no run predicts at one of them, or a table is damaged.
    pub fn means_at(&self, horizons: &BTreeSet<usize>, keys: &[Key]) -> Result<Vec<Mean>, AnalysisError> {
        let listed: Vec<String> = horizons.iter().map(usize::to_string).collect();
        let mut rows = self.rows(Table::AllMetrics, &format!("and {HORIZON} in ({})", listed.join(", ")))?;
        let found: BTreeSet<usize> = rows.iter().filter_map(|row| row.horizon).collect();
        if let Some(wanted) = horizons.difference(&found).next() {
            let horizons = self.horizons()?;
            return Err(AnalysisError::UnknownHorizon { wanted: *wanted, horizons });
        }
        rows.extend(skills(&rows));
        Ok(self.means_of(rows, keys))
    }

    /// The means of the next sample and, of runs that predict further, those of the horizon that their spec asks for,
    /// told apart by the horizon. If no run predicts further, they have no horizon.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn means_at_own_horizons(&self) -> Result<Vec<Mean>, QueryError> {
        if !self.predicts_further() {
            return self.means();
        }
        let is_own = |of: &Of| {
            let runs = self.runs(&of.experiment).iter().map(|run| &run.record.spec);
            let mut own = runs.filter(|spec| spec.scenario == of.scenario && spec.variant == of.variant);
            of.horizon.is_some_and(|horizon| horizon < 2 || own.any(|spec| spec.window.horizon == horizon))
        };
        let mut means = self.means_by(&[Key::Horizon])?;
        means.retain(|mean| is_own(&mean.of));
        Ok(means)
    }

    /// The horizons at which the runs that count predict, in samples.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn horizons(&self) -> Result<BTreeSet<usize>, QueryError> {
        let rows = self.rows(Table::AllMetrics, &format!("and {HORIZON} > 0"))?;
        Ok(rows.into_iter().filter_map(|row| row.horizon).collect())
    }

    /// The means of the skill horizon, for each group of runs that count, and for the baselines. `keys` tell them apart
    /// as in [`Analysis::means_by`].
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn skill_horizons_by(&self, keys: &[Key]) -> Result<Vec<Mean>, QueryError> {
        let errors = self.rows(Table::AllMetrics, &format!("and metric = '{}'", Metric::Rmse.name()))?;
        Ok(self.means_of(skill_horizons(&skills(&errors)), keys))
    }

    /// The rows of a table of metrics that judge whole modalities. `and` is a further condition in SQL. Rows of models
    /// that got only some inputs are left out.
    fn rows(&self, of: Table, and: &str) -> Result<Vec<Row>, QueryError> {
        let experiments: Vec<&str> = self.experiments().collect();
        let (horizon, usual) = match of.usual() {
            Some(_) => (format!(", {HORIZON}"), format!("and {GIVEN} is null")),
            None => Default::default(),
        };
        let mut answer = self.query(
            &experiments,
            &format!(
                "select experiment, run, task, model, modality, direction, metric, value, unit{horizon} from {} \
                 where {OVERALL} and value is not null {usual} {and}",
                of.name()
            ),
        )?;
        rows(&mut answer)
    }

    /// The means of the values in `all`.
    fn means_of(&self, all: Vec<Row>, keys: &[Key]) -> Vec<Mean> {
        let asked: Vec<&'static str> = keys.iter().copied().filter_map(Key::setting).collect();
        let has_variants = asked.is_empty() || keys.contains(&Key::Variant);
        // A baseline's value is taken from the first run of a dataset. All runs of a group repeat it, up to rounding.
        let runs = self.experiments().flat_map(|experiment| self.runs(experiment));
        let settings = |run| match has_variants {
            true => self.settings(run),
            false => self.settings_apart_from(run, &asked),
        };
        let runs: Vec<(&Run, String)> = runs.map(|run| (run, settings(run))).collect();
        let name = |run: &Run| (run.record.experiment.clone(), run.record.run.clone());
        let places: HashMap<(String, String), usize> =
            runs.iter().enumerate().map(|(place, (run, _))| (name(run), place)).collect();
        let mut found: BTreeMap<Of, Values> = BTreeMap::new();
        let mut seeds: BTreeSet<(Of, u64, u64)> = BTreeSet::new();
        for row in all {
            let Some(&place) = places.get(&(row.experiment, row.run)) else { continue };
            let (run, settings) = &runs[place];
            let spec = &run.record.spec;
            let of = Of {
                experiment: run.record.experiment.clone(),
                scenario: spec.scenario.clone(),
                variant: if has_variants { spec.variant.clone() } else { model_of(&spec.variant) },
                settings: settings.clone(),
                values: asked.iter().map(|key| (*key, run.setting(key).to_owned())).collect(),
                horizon: row.horizon,
                latent: spec.latent().filter(|_| !is_baseline(&row.model)),
                task: row.task,
                modality: row.modality,
                direction: row.direction,
                metric: row.metric,
                model: row.model,
            };
            // Two variants with the same settings repeat a run.
            let is_repeated = !has_variants
                && !of.is_baseline()
                && !seeds.insert((of.clone(), spec.dataset_seed(), spec.seed));
            if is_repeated {
                continue;
            }
            let (_, values) = found.entry(of).or_insert_with(|| (row.unit, BTreeMap::new()));
            values.insert(place, ((spec.dataset_seed(), spec.seed), row.value));
        }
        let mean = |(of, (unit, values)): (Of, Values)| {
            let mut values: Vec<((u64, u64), f64)> = values.into_values().collect();
            if of.is_baseline() {
                let mut datasets = BTreeSet::new();
                values.retain(|((dataset, _), _)| datasets.insert(*dataset));
            }
            Mean::new(of, unit, values)
        };
        over_most_datasets(found.into_iter().filter_map(mean).collect())
    }
}

/// The same means, with each baseline over as many datasets as the experiment has. Some of its runs may be on fewer
/// datasets than others. A baseline that has the same values wherever both are does not depend on what they differ in.
fn over_most_datasets(means: Vec<Mean>) -> Vec<Mean> {
    let of_any_run = |of: &Of| Of {
        variant: String::new(),
        settings: String::new(),
        values: BTreeMap::new(),
        ..of.clone()
    };
    let mut alike: BTreeMap<Of, Vec<Mean>> = BTreeMap::new();
    for mean in means.iter().filter(|mean| mean.of.is_baseline()) {
        alike.entry(of_any_run(&mean.of)).or_default().push(mean.clone());
    }
    let complete = |mean: Mean| {
        if !mean.of.is_baseline() {
            return mean;
        }
        let others = alike[&of_any_run(&mean.of)].iter().filter(|other| mean.agrees_with(other));
        let most =
            others.fold(&mean, |most, other| if other.datasets > most.datasets { other } else { most });
        Mean { of: mean.of.clone(), ..most.clone() }
    };
    means.into_iter().map(complete).collect()
}
