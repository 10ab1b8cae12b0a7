//! Means of metrics over datasets and seeds.

use super::episodes::Jackknives;
use super::rows::Row;
use super::{Analysis, Estimate, Interval, Jackknife, Key, LEVEL, Over, Run, replicates};
use harness_catalog::QueryError;
use harness_judge::models::{NETWORK, UNTRAINED, is_baseline};
use harness_metrics::higher_is_better;
use harness_shared::numbers::enumerated;
use harness_spec::{Modality, Origin, Task, model_parts};
use harness_tables::column_of;
use harness_tables::schema::{GIVEN, HORIZON, Table};
use polars::prelude::{DataFrame, PolarsResult};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

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
    /// The names of the datasets that each value's run was trained on. Empty for differences.
    trained_on: Vec<String>,
    /// Of differences, whether runs of a pair were trained on different datasets, which only have the same seed.
    pub is_across_data: bool,
    /// Their mean, with an interval.
    pub interval: Interval,
    /// What the interval is to contain.
    pub over: Over,
    /// The heading of the column from which the values are differences, if they are.
    pub against: Option<String>,
    /// Of a difference, the p-value of Student's t-test that it is 0, corrected by Holm's method for the number of
    /// differences in the answer. `None` with fewer than two values.
    pub p: Option<f64>,
    /// Of values on folds, the number of test samples for each training sample. Folds share training data, so that
    /// differences between models are less certain than their deviations say.
    pub test_to_training: Option<f64>,
    /// How each value depends on the test episodes, if all are on the same ones. It is empty if this is not known,
    /// because the metric is no ratio of sums over episodes.
    pub test: Option<Vec<Jackknife>>,
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
    /// The values of the settings by which means are told apart.
    pub values: BTreeMap<&'static str, String>,
    /// Number of samples from the present to the predicted one; 0 for the present one. `None` for a skill horizon, and
    /// for what judges the latent state.
    pub horizon: Option<usize>,
    /// The modalities that the model got, joined by a comma; `None` if it got all of its run's input.
    pub given: Option<String>,
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

    /// Returns the name of the model, if it is neither the network nor a baseline: that of another program, or an
    /// untrained encoder.
    pub fn other(&self) -> Option<&str> {
        Some(self.model.as_str()).filter(|model| *model != NETWORK && !is_baseline(model))
    }

    /// Whether the value is of the model with this name. [`NETWORK`] stands for all models but baselines and untrained
    /// encoders.
    pub fn is_by(&self, model: &str) -> bool {
        self.model == model || model == NETWORK && !self.is_baseline() && self.model != UNTRAINED
    }
}

/// The name of a modality, followed by the part of it that `direction` names.
pub(super) fn predicted(modality: Modality, direction: Option<&str>) -> String {
    std::iter::once(modality.name()).chain(direction).collect::<Vec<_>>().join(" ")
}

impl Of {
    /// Returns the name of the modality, followed by the unit of its elements if they are only a part of it: `joints in
    /// rad`.
    pub fn predicted(&self) -> String {
        predicted(self.modality, self.direction.as_deref())
    }

    /// Whether `name` is that of the predicted modality, or of the part of it with one unit.
    pub fn is_of(&self, name: &str) -> bool {
        self.modality.name() == name || self.predicted() == name
    }
}

impl Mean {
    /// The mean of some values, with an interval for `over`; `None` without values.
    fn new(of: Of, unit: String, replicates: Vec<Replicate>, over: Over) -> Option<Self> {
        let values: Vec<f64> = replicates.iter().map(|replicate| replicate.value).collect();
        let seeds: Vec<(u64, u64)> = replicates.iter().map(|replicate| replicate.seeds).collect();
        let tests: BTreeSet<&Option<String>> = replicates.iter().map(|replicate| &replicate.test).collect();
        let is_shared = tests.len() == 1 && tests.iter().all(|test| test.is_some());
        let jackknives: Option<Vec<_>> =
            replicates.iter().map(|replicate| replicate.jackknife.clone()).collect();
        let test = is_shared.then(|| jackknives.unwrap_or_default());
        let test_to_training = replicates.first().and_then(|replicate| replicate.test_to_training);
        let trained_on = replicates.into_iter().map(|replicate| replicate.dataset).collect();
        Some(Self { test_to_training, trained_on, ..Self::of_values(of, unit, values, seeds, test, over)? })
    }

    /// The mean of values with the seeds of their dataset and training; `None` without values.
    fn of_values(
        of: Of,
        unit: String,
        values: Vec<f64>,
        seeds: Vec<(u64, u64)>,
        test: Option<Vec<Jackknife>>,
        over: Over,
    ) -> Option<Self> {
        let datasets = seeds.iter().map(|(dataset, _)| dataset).collect::<BTreeSet<_>>().len();
        let interval = Interval { mean: 0.0, bounds: None };
        let mean = Self {
            of,
            unit,
            values,
            seeds,
            datasets,
            trained_on: Vec::new(),
            is_across_data: false,
            interval,
            over,
            against: None,
            p: None,
            test_to_training: None,
            test,
        };
        Some(mean.with_interval())
    }

    /// The seed of the dataset of each value.
    fn dataset_seeds(&self) -> Vec<u64> {
        self.seeds.iter().map(|(dataset, _)| *dataset).collect()
    }

    /// The mean with the interval of its values.
    fn with_interval(self) -> Self {
        let interval = self.estimate().map_or(self.interval, |estimate| self.interval_of(&estimate));
        Self { interval, ..self }
    }

    /// The mean over datasets and seeds, with its standard error.
    pub(super) fn estimate(&self) -> Option<Estimate> {
        let estimate =
            Estimate::of(&replicates(self.dataset_seeds().into_iter().zip(self.values.iter().copied())))?;
        let ratio = self.test_to_training.filter(|_| self.against.is_some() && self.datasets > 1);
        Some(ratio.map_or(estimate, |ratio| estimate.of_folds(ratio)))
    }

    /// How the mean depends on the test episodes, if this is known.
    fn jackknife(&self) -> Option<Jackknife> {
        Jackknife::mean(self.test.as_ref()?, &self.dataset_seeds())
    }

    /// The number of test episodes that the interval is over, besides datasets.
    fn episodes(&self) -> Option<usize> {
        self.jackknife().filter(|_| self.over == Over::Mean).map(|jackknife| jackknife.episodes())
    }

    /// The interval of an estimate of this mean. One dataset says nothing about the next, so there are no bounds then.
    fn interval_of(&self, estimate: &Estimate) -> Interval {
        match (self.over, self.jackknife()) {
            (Over::Mean, None) => estimate.interval(LEVEL),
            (Over::Mean, Some(jackknife)) => estimate.interval_with_episodes(&jackknife, LEVEL),
            (Over::NextDataset, _) if self.datasets < 2 => {
                Interval { bounds: None, ..estimate.interval(LEVEL) }
            }
            (Over::NextDataset, _) => estimate.prediction(LEVEL),
        }
    }

    /// Returns the mean of the differences from `base`, the column with this heading, over the seeds of dataset and
    /// training that both have; `None` if they share none. A baseline has no seed of training, so its value is compared
    /// with every value on the same dataset. Both must be of the same scenario, so that the values are of the same data.
    pub(super) fn difference_from(&self, base: &Mean, heading: &str) -> Option<Self> {
        let key = |(dataset, seed): &(u64, u64)| (*dataset, (!base.of.is_baseline()).then_some(*seed));
        let places: HashMap<_, usize> = base.seeds.iter().map(key).zip(0..).collect();
        let pairs = self.seeds.iter().enumerate();
        let pairs = pairs.filter_map(|(place, seeds)| Some((place, *places.get(&key(seeds))?)));
        let pairs: Vec<(usize, usize)> = pairs.collect();
        let values = pairs.iter().map(|(own, other)| self.values[*own] - base.values[*other]).collect();
        let seeds = pairs.iter().map(|(own, _)| self.seeds[*own]).collect();
        let is_across_data =
            pairs.iter().any(|(own, other)| self.trained_on.get(*own) != base.trained_on.get(*other));
        let test = self.test.as_ref().zip(base.test.as_ref()).map(|(own, of_base)| {
            let minus = |(one, other): &(usize, usize)| own.get(*one)?.minus(of_base.get(*other)?);
            pairs.iter().map(minus).collect::<Option<Vec<_>>>().unwrap_or_default()
        });
        let mean = Self::of_values(self.of.clone(), self.unit.clone(), values, seeds, test, self.over)?;
        let (against, test_to_training) = (Some(heading.to_owned()), self.test_to_training);
        let mean = Self { against, test_to_training, is_across_data, ..mean }.with_interval();
        let estimate = mean.estimate()?;
        let p = match mean.jackknife() {
            None => estimate.p_value(0.0),
            Some(jackknife) => estimate.p_value_with_episodes(&jackknife, 0.0),
        };
        Some(Self { p, ..mean })
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

    /// Converts means to a table with one row for each mean. Settings by which they are told apart are columns.
    /// Means of models that got only some inputs have the column `given`, and differences the columns `difference_from`
    /// and `p`.
    ///
    /// # Errors
    /// When Polars can't build the table, for which no reason is known.
    pub fn frame(means: &[Mean]) -> PolarsResult<DataFrame> {
        let keys: BTreeSet<&str> = means.iter().flat_map(|mean| mean.of.values.keys().copied()).collect();
        let value = |key: &str| column_of(means, key, |mean| mean.of.values.get(key).map(String::as_str));
        let better =
            |mean: &Mean| higher_is_better(&mean.of.metric).map(|is| if is { "higher" } else { "lower" });
        let mut columns = vec![
            column_of(means, "experiment", |mean| mean.of.experiment.as_str()),
            column_of(means, "scenario", |mean| mean.of.scenario.to_string()),
            column_of(means, "latent", |mean| mean.of.latent.map(|latent| latent as i64)),
            column_of(means, "variant", |mean| mean.of.variant.as_str()),
            column_of(means, "settings", |mean| mean.of.settings.as_str()),
        ];
        columns.extend(keys.into_iter().map(value));
        columns.extend([
            column_of(means, HORIZON, |mean| mean.of.horizon.map(|horizon| horizon as i64)),
            column_of(means, "task", |mean| mean.of.task.name()),
            column_of(means, "model", |mean| mean.of.model.as_str()),
            column_of(means, "modality", |mean| mean.of.modality.name()),
            column_of(means, "direction", |mean| mean.of.direction.as_deref()),
            column_of(means, "metric", |mean| mean.of.metric.as_str()),
            column_of(means, "unit", |mean| mean.unit.as_str()),
            column_of(means, "better", better),
        ]);
        if means.iter().any(|mean| mean.of.given.is_some()) {
            columns.push(column_of(means, GIVEN, |mean| mean.of.given.as_deref()));
        }
        if means.iter().any(|mean| mean.against.is_some()) {
            columns.push(column_of(means, "difference_from", |mean| mean.against.as_deref()));
            columns.push(column_of(means, "p", |mean| mean.p));
        }
        columns.extend([
            column_of(means, "datasets", |mean| mean.datasets as i64),
            column_of(means, "seeds", |mean| mean.values.len() as i64),
            column_of(means, "mean", |mean| mean.interval.mean),
            column_of(means, "low", |mean| mean.interval.bounds.map(|(low, _)| low)),
            column_of(means, "high", |mean| mean.interval.bounds.map(|(_, high)| high)),
        ]);
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
    let most = several.iter().chain(&one).filter_map(|mean| mean.episodes()).max();
    let episodes = most.map_or_else(String::new, |most| format!(" and {most} test episodes"));
    (!over.is_empty()).then(|| over.join(" or ") + &episodes)
}

/// The note that the intervals of some metrics do not contain how much other test episodes would change the means.
/// `None` if all do.
pub(super) fn note_about_shared_test<'a>(means: impl IntoIterator<Item = &'a Mean>) -> Option<String> {
    let on_these = means.into_iter().filter(|mean| mean.test.is_some() && mean.episodes().is_none());
    let on_these: Vec<&Mean> = on_these.filter(|mean| mean.interval.bounds.is_some()).collect();
    let metrics: BTreeSet<String> = on_these.iter().map(|mean| mean.of.metric.clone()).collect();
    let what = match on_these.first()?.over {
        Over::Mean => format!("the intervals of {}", enumerated(&Vec::from_iter(metrics))),
        Over::NextDataset => "the intervals".to_owned(),
    };
    Some(format!("runs in a world share their test episodes, and {what} are those on these episodes"))
}

/// The part of a variant that names an external model; empty for a network.
fn model_of(variant: &str) -> String {
    model_parts(variant).1.map_or_else(String::new, |model| format!("model={model}"))
}

/// A value of a run.
struct Replicate {
    /// The seeds of the run's dataset and its training.
    seeds: (u64, u64),
    value: f64,
    /// The dataset that the run was trained on.
    dataset: String,
    /// The dataset of the test; `None` if it is the run's own.
    test: Option<String>,
    /// The number of test samples for each training sample, if the run is of a fold.
    test_to_training: Option<f64>,
    jackknife: Option<Jackknife>,
}

/// The value of each run by its position, and its unit.
type Values<'a> = BTreeMap<usize, (Replicate, &'a str)>;

impl Analysis {
    /// The horizons at which the runs that count predict, in samples.
    ///
    /// # Errors
    /// When a table is damaged.
    pub(super) fn horizons(&self) -> Result<BTreeSet<usize>, QueryError> {
        let experiments: Vec<&str> = self.experiments().collect();
        let sql = format!("select distinct {HORIZON} from {} where {HORIZON} > 0", Table::AllMetrics.name());
        let found = self.query(&experiments, &sql)?;
        let samples =
            || Ok(found.column(HORIZON)?.i64()?.iter().flatten().map(|samples| samples as usize).collect());
        samples().map_err(QueryError::Sql)
    }

    /// The means of the values in `all`, told apart by the settings among `keys`, with intervals for `over`.
    ///
    /// With settings among the keys, the variant is empty except for the name of an external model, unless it is a key
    /// too. What else the runs of an experiment differ in is in the other settings.
    ///
    /// # Errors
    /// When a table is damaged.
    pub(super) fn means_of(
        &self,
        all: &[Row<'_>],
        keys: &[Key],
        over: Over,
    ) -> Result<Vec<Mean>, QueryError> {
        let jackknives = Jackknives::read(self, all)?;
        let asked: Vec<&'static str> = keys.iter().copied().filter_map(Key::setting).collect();
        let has_variants = asked.is_empty() || keys.contains(&Key::Variant);
        let settings = |run: &Run| match has_variants {
            true => self.settings(run),
            false => self.settings_apart_from(run, &asked),
        };
        // What tells a run's means from those of other runs. The other fields are those of its rows.
        let group = |run: &Run| Of {
            experiment: run.record.experiment.clone(),
            scenario: run.record.spec.scenario.clone(),
            variant: match has_variants {
                true => run.record.spec.variant.clone(),
                false => model_of(&run.record.spec.variant),
            },
            settings: settings(run),
            values: asked.iter().map(|key| (*key, run.setting(key).to_owned())).collect(),
            horizon: None,
            given: None,
            latent: run.record.spec.latent(),
            task: Task::Prediction,
            modality: Modality::LATENT,
            direction: None,
            metric: String::new(),
            model: String::new(),
        };
        let mut groups: BTreeMap<Of, usize> = BTreeMap::new();
        let mut number = |of: Of| {
            let next = groups.len();
            *groups.entry(of).or_insert(next)
        };
        let runs = self.experiments().flat_map(|experiment| self.runs(experiment)).enumerate();
        let places: HashMap<(&str, &str), _> = runs
            .map(|(place, run)| {
                let (own, seeds) = (group(run), (run.record.spec.dataset_seed(), run.record.spec.seed));
                let of_baselines = number(Of { latent: None, ..own.clone() });
                (
                    (&*run.record.experiment, &*run.record.run),
                    (place, [of_baselines, number(own)], seeds, &run.record),
                )
            })
            .collect();
        let mut by_row: HashMap<_, Values> = HashMap::new();
        let mut repeated = HashSet::new();
        for row in all {
            let Some(value) = row.value else { continue };
            let Some(&(place, groups, seeds, record)) = places.get(&(row.experiment, row.run)) else {
                continue;
            };
            let is_network = !is_baseline(row.model);
            let group = groups[usize::from(is_network)];
            let judged = (row.task, row.model, row.modality, row.direction, row.metric);
            let key = (group, judged, row.horizon, row.given);
            // Two variants with the same settings repeat a run.
            if is_network && !has_variants && !repeated.insert((key, seeds)) {
                continue;
            }
            let jackknife = jackknives.of(row).cloned();
            let replicate = Replicate {
                seeds,
                value,
                dataset: record.dataset.clone(),
                test: record.test_dataset.clone(),
                test_to_training: record.spec.split.test_to_training(),
                jackknife,
            };
            by_row.entry(key).or_default().insert(place, (replicate, row.unit));
        }
        let groups: BTreeMap<usize, Of> = groups.into_iter().map(|(of, number)| (number, of)).collect();
        let named = by_row.into_iter().map(|((group, judged, horizon, given), values)| {
            let (task, model, modality, direction, metric) = judged;
            let (direction, given) = (direction.map(str::to_owned), given.map(str::to_owned));
            let (model, metric) = (model.to_owned(), metric.to_owned());
            let group = groups[&group].clone();
            (Of { task, model, modality, direction, metric, horizon, given, ..group }, values)
        });
        let found: BTreeMap<Of, Values> = named.collect();
        // A baseline's value is taken from the first run of a dataset. All runs of a group repeat it, up to rounding.
        let mean = |(of, values): (Of, Values)| {
            let unit = values.values().next().map(|(_, unit)| (*unit).to_owned())?;
            let mut values: Vec<Replicate> = values.into_values().map(|(replicate, _)| replicate).collect();
            if of.is_baseline() {
                let mut datasets = BTreeSet::new();
                values.retain(|value| datasets.insert(value.seeds.0));
            }
            Mean::new(of, unit, values, over)
        };
        Ok(over_most_datasets(found.into_iter().filter_map(mean).collect()))
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
