//! The answer to a question, and the answer as a table: keys tell its rows and columns apart, and baselines stand beside
//! networks.

use super::labels::has_own_words;
use super::{
    AnalysisError, Interval, Key, Label, Labels, Mean, Of, holm, note_about_shared_test, replicates_of,
};
use harness_judge::models::{NETWORK, PERSISTENCE};
use harness_metrics::{Metric, best, higher_is_better, label, rounded};
use harness_shared::numbers::Natural;
use harness_spec::{Modality, Origin, Task, model_parts, variant_parts};
use polars::prelude::{DataFrame, PolarsResult};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Differences with a corrected p-value below this are called significant.
pub const SIGNIFICANT: f64 = 0.05;

/// The answer to a [`Question`](super::Question). Every table, figure, page and file shows what it holds, and selects,
/// groups and names nothing itself.
pub struct Answer {
    /// The keys that tell columns apart; all others tell rows apart.
    pub by: Vec<Key>,
    /// The names of the metrics, in the order of the rows.
    pub metrics: Vec<String>,
    /// The short names of variants and of the values of settings.
    pub labels: Labels,
    /// The means or, of a question with [`against`](super::Question::against), the means of that column and differences
    /// from them.
    pub cells: Vec<Mean>,
    /// The column from which the other ones are differences, if they are.
    pub against: Option<Side>,
    /// What is missing and why.
    pub notes: Vec<String>,
    /// The samples per second of all runs; `None` if the runs differ, or are on imported data.
    pub(super) sample_rate_hz: Option<f64>,
}

impl Answer {
    /// The cells as a data frame; see [`Mean::frame`].
    ///
    /// # Errors
    /// When Polars can't build it, for which no reason is known.
    pub fn frame(&self) -> PolarsResult<DataFrame> {
        Mean::frame(&self.cells)
    }

    /// The cells as a table.
    pub fn table(&self) -> Comparison<'_> {
        Comparison::new(&self.cells, &self.by, &self.metrics, &self.labels)
    }

    /// The cells as tables for a page: one for each scenario, task and group of runs.
    pub fn parts(&self) -> Vec<Part> {
        self.table().parts(&self.metrics)
    }

    /// Says how far ahead the predictions are, or how long a sample is if they are at several horizons. `None` without
    /// predictions at a horizon.
    pub fn ahead(&self) -> Option<String> {
        let horizons: BTreeSet<usize> = self.horizons().collect();
        let seconds = |samples: usize| self.sample_rate_hz.map(|rate| samples as f64 / rate);
        match horizons.iter().collect::<Vec<_>>()[..] {
            [] => None,
            [0] => Some("estimates of the present sample".to_owned()),
            [1] => Some("predictions of the next sample".to_owned()),
            [samples] => {
                let time = seconds(*samples).map(|time| format!(" ({} s)", number(time))).unwrap_or_default();
                Some(format!("predictions {samples} samples{time} ahead"))
            }
            _ => seconds(1).map(|time| format!("horizons in samples of {} s", number(time))),
        }
    }

    /// The horizons of predictions, in samples.
    fn horizons(&self) -> impl Iterator<Item = usize> {
        let predictions = self.cells.iter().filter(|cell| cell.of.task == Task::Prediction);
        predictions.filter_map(|cell| cell.of.horizon)
    }

    /// Sentences about what the cells are, and then the notes.
    pub fn explained(&self) -> Vec<String> {
        let mut all: Vec<String> = self.replicates().into_iter().collect();
        if self.cells.iter().any(|cell| cell.of.direction.is_some()) {
            all.push(BY_UNIT.to_owned());
        }
        all.extend(self.differences().map(|differences| format!("the other columns have the {differences}")));
        all.extend(self.ahead());
        if self.cells.iter().any(|cell| cell.of.metric == Metric::SkillHorizon.name()) {
            all.push("a skill horizon that is the last horizon of the runs is a lower bound".to_owned());
        }
        all.extend(note_about_shared_test(&self.cells));
        if self.cells.iter().any(|cell| cell.against.is_some() && cell.test_to_training.is_some()) {
            all.push("differences on folds allow for the training data that folds share".to_owned());
        }
        all.extend(self.notes.iter().cloned());
        all
    }

    /// Says from what values are differences, and of which runs; `None` if they are none.
    pub fn differences(&self) -> Option<String> {
        let base = self.against.as_ref()?;
        let is_across_data = self.cells.iter().any(|cell| cell.is_across_data);
        let runs = match (base.baseline.is_some(), is_across_data) {
            (true, false) => "on the same dataset",
            (false, false) => "with the same dataset and seed",
            (true, true) => "on datasets with the same seed, which differ otherwise",
            (false, true) => "with the same seeds, on datasets that differ otherwise",
        };
        Some(format!("differences from {}, of runs {runs}", base.name()))
    }

    /// Says what the intervals of networks are; `None` if all cells are of baselines.
    fn replicates(&self) -> Option<String> {
        let networks = || self.cells.iter().filter(|cell| !cell.of.is_baseline());
        let over = networks().next()?.over;
        let has_bounds = networks().any(|cell| cell.interval.bounds.is_some());
        Some(match replicates_of(networks()) {
            Some(replicates) if has_bounds => format!("mean ± half of the {}", over.described(&replicates)),
            Some(replicates) => {
                format!("means over {replicates} without intervals, which need several datasets")
            }
            None => "one seed, so without intervals".to_owned(),
        })
    }

    /// Replaces the cells of each column by their differences from those of the column with the heading `base`. If this
    /// is a column of networks, those of baselines are left out, because a baseline has no seed.
    pub(super) fn subtract(&mut self, base: &str) -> Result<(), AnalysisError> {
        let table = self.table();
        let sides = table.sides();
        let Some(side) = sides.iter().find(|side| side.name() == base) else {
            let columns = sides.iter().map(|side| side.name()).collect::<Vec<_>>().join("', '");
            return Err(AnalysisError::Unanswerable(format!(
                "there is no column '{base}'; the columns are '{columns}'"
            )));
        };
        let side = (*side).clone();
        let mut lone: Vec<&Side> = sides.into_iter().filter(|other| other.baseline.is_none()).collect();
        // A baseline stands in the rows of the networks of every size.
        let mut cells: BTreeMap<Of, Mean> = BTreeMap::new();
        for ((subject, own), mean) in &table.values {
            let Some(of_base) =
                table.mean(subject, &side).filter(|_| own.baseline.is_none() || side.baseline.is_some())
            else {
                continue;
            };
            let cell = match *own == side {
                true => Some((*mean).clone()),
                false => mean.difference_from(of_base, base),
            };
            lone.retain(|other| cell.is_none() || *other != own);
            cells.extend(cell.map(|cell| (cell.of.clone(), cell)));
        }
        let lone: Vec<String> = lone.into_iter().map(Side::name).collect();
        let mut cells: Vec<Mean> = cells.into_values().collect();
        let p_values: Vec<f64> = cells.iter().filter_map(|cell| cell.p).collect();
        for (cell, p) in cells.iter_mut().filter(|cell| cell.p.is_some()).zip(holm(&p_values)) {
            cell.p = Some(p);
        }
        if !lone.is_empty() {
            self.notes.push(format!(
                "left out, because {base} has no runs with the same seeds beside them: {}",
                lone.join(", ")
            ));
        }
        (self.cells, self.against) = (cells, Some(side));
        Ok(())
    }
}

/// The note of a table with modalities whose elements have different units.
pub const BY_UNIT: &str = "a modality whose elements have different units is judged by unit";

/// The values of some keys for a row or a column; `None` for all other keys.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// The experiment.
    pub experiment: Option<String>,
    /// The scenario or imported dataset.
    pub scenario: Option<Origin>,
    /// The size of the latent state.
    pub latent: Option<usize>,
    /// The short name of the variant.
    pub variant: Option<Label>,
    /// Settings, each with the short name of its value.
    pub values: Vec<(&'static str, Label)>,
    /// The other settings in which the runs of an experiment differ.
    pub settings: Option<Natural>,
    /// The number of samples from the present to the predicted one.
    pub horizon: Option<usize>,
    /// What the networks got.
    pub given: Option<Label>,
}

impl Place {
    fn of(of: &Of, labels: &Labels, has: impl Fn(Key) -> bool) -> Self {
        let values = of.values.iter().filter(|(key, _)| has(Key::Setting(key)));
        Self {
            experiment: has(Key::Experiment).then(|| of.experiment.clone()),
            scenario: has(Key::Scenario).then(|| of.scenario.clone()),
            latent: of.latent.filter(|_| has(Key::Latent)),
            variant: has(Key::Variant).then(|| labels.variant(&of.variant)),
            values: values.map(|(key, value)| (*key, labels.value(key, value))).collect(),
            settings: has(Key::Settings).then(|| Natural::new(&of.settings)),
            horizon: of.horizon.filter(|_| has(Key::Horizon)),
            given: (has(Key::Given) && !of.is_baseline()).then(|| labels.given(of.given.as_deref())),
        }
    }

    /// A text for each key, empty if it has no value.
    pub fn words(&self) -> Vec<String> {
        let scenario = self.scenario.as_ref().map(|scenario| scenario.name().to_owned());
        let latent = self.latent.map(|latent| format!("latent {latent}"));
        let variant = self.variant.as_ref().map(|label| label.text().to_owned());
        let before = [self.experiment.clone(), scenario, latent, variant].map(Option::unwrap_or_default);
        let values = self.values.iter().map(|(key, label)| with_key(key, label.text()));
        let settings = self.settings.as_ref().map(|settings| settings.text().to_owned());
        let horizon = self.horizon.map(|horizon| format!("horizon {horizon}"));
        let given = self.given.as_ref().map(|label| label.text().to_owned());
        let after = [settings, horizon, given].map(Option::unwrap_or_default);
        before.into_iter().chain(values).chain(after).collect()
    }
}

/// The value of a setting with the name of the setting, as in a variant: `hidden=64`. Modalities say that they are an
/// input, and the labels of an axis say what they are.
fn with_key(key: &str, value: &str) -> String {
    match key.split_once('.').map_or(key, |(_section, name)| name) {
        "input" => value.to_owned(),
        axis if has_own_words(axis) => value.to_owned(),
        name => format!("{name}={value}"),
    }
}

/// A column. Columns of networks come first, then those of each external model and each baseline.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Side {
    /// The name of the baseline; `None` for networks and external models.
    pub baseline: Option<String>,
    /// The name of a model of another program, if the variant does not tell it apart, or of an untrained encoder.
    pub model: Option<String>,
    /// What tells columns of the same model apart.
    pub place: Place,
}

impl Side {
    /// The column's heading. A network that no key distinguishes from the others is called the network.
    pub fn name(&self) -> String {
        let baseline = self.baseline.as_ref().map(|name| name.replace('_', " "));
        let model = baseline.or_else(|| self.model.clone());
        let words = model.into_iter().chain(self.place.words());
        let words: Vec<String> = words.filter(|word| !word.is_empty()).collect();
        if words.is_empty() { NETWORK.to_owned() } else { words.join(", ") }
    }
}

/// A row.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Subject {
    /// The task that is evaluated.
    pub task: Task,
    /// What tells rows of the same metric apart.
    pub place: Place,
    /// The predicted modality.
    pub modality: Modality,
    /// The unit of the elements, if the modality has elements of different units.
    pub direction: Option<String>,
    /// The position of the metric among the requested metrics.
    pub metric: usize,
}

impl Subject {
    /// The row of baselines that belongs to this one.
    fn without_latent(&self) -> Self {
        Self { place: Place { latent: None, ..self.place.clone() }, ..self.clone() }
    }

    /// The name of the modality for people, followed by the unit of its elements if they are only a part of it.
    pub fn predicted(&self) -> String {
        let part = self.direction.iter().map(|direction| format!(" {direction}"));
        self.modality.name().replace('_', " ") + &part.collect::<String>()
    }

    /// Like [`predicted`](Self::predicted), followed by how far ahead it is predicted if rows differ in that: `contact
    /// force, 5 samples ahead`.
    pub fn predicted_ahead(&self) -> String {
        match self.place.horizon {
            Some(0) if self.task == Task::Prediction => format!("{}, present sample", self.predicted()),
            None | Some(0) => self.predicted(),
            Some(1) => format!("{}, next sample", self.predicted()),
            Some(horizon) => format!("{}, {horizon} samples ahead", self.predicted()),
        }
    }
}

/// Rows of a table that differ only in what is predicted and in the metric, for a page.
#[derive(Serialize)]
pub struct Part {
    task: Task,
    scenario: Option<String>,
    /// What tells these runs from those of other parts, in words; empty if nothing does.
    settings: String,
    /// The columns in which the rows have values.
    columns: Vec<Column>,
    rows: Vec<Row>,
    /// What the intervals of networks are over, such as `3 seeds`; `None` if each value is of one run.
    over: Option<String>,
}

/// A column of a [`Part`].
#[derive(Serialize)]
struct Column {
    name: String,
    is_baseline: bool,
    /// Whether it is of another baseline than persistence, which a page with many columns folds.
    is_further: bool,
}

/// A row of a [`Part`].
#[derive(Serialize)]
struct Row {
    /// What is predicted and, if rows differ in it, how far ahead.
    modality: String,
    /// The name of the metric, with the unit.
    metric: String,
    /// Whether higher values are better; `None` if neither are.
    better: Option<bool>,
    cells: Vec<Option<Cell>>,
}

/// A mean of a [`Part`], with its interval and the text that shows both.
#[derive(Serialize)]
struct Cell {
    mean: Number,
    bounds: Option<[Number; 2]>,
    text: String,
    is_best: bool,
}

/// A number. JSON has no infinite ones, so these are texts.
#[derive(Serialize)]
#[serde(untagged)]
enum Number {
    Finite(f64),
    Other(String),
}

impl From<f64> for Number {
    fn from(value: f64) -> Self {
        if value.is_finite() { Self::Finite(value) } else { Self::Other(value.to_string()) }
    }
}

/// The means of all rows and columns.
pub struct Comparison<'a> {
    /// The rows, each with the unit of its values.
    pub units: BTreeMap<Subject, &'a str>,
    /// The means by row and column.
    pub values: BTreeMap<(Subject, Side), &'a Mean>,
}

impl<'a> Comparison<'a> {
    /// Puts means into rows and columns. Rows say how far ahead they are if they differ in that.
    fn new(means: &'a [Mean], by: &[Key], metrics: &[String], labels: &Labels) -> Self {
        let predictions = means.iter().filter(|mean| mean.of.task == Task::Prediction);
        let horizons: BTreeSet<usize> = predictions.filter_map(|mean| mean.of.horizon).collect();
        let tells_apart = |key: Key| match key {
            Key::Horizon => !by.contains(&key) && horizons.len() > 1,
            // Without this key, all means are of the same inputs.
            Key::Given => false,
            _ => !by.contains(&key),
        };
        // An external model is a column beside the networks on the same data.
        let variants_are_rows = !by.contains(&Key::Variant);
        let subject = |of: &Of| Subject {
            task: of.task,
            place: Place {
                variant: variants_are_rows.then(|| labels.variant(model_parts(&of.variant).0)),
                ..Place::of(of, labels, tells_apart)
            },
            modality: of.modality,
            direction: of.direction.clone(),
            metric: metrics.iter().position(|name| *name == of.metric).unwrap_or(metrics.len()),
        };
        // The variant of a model of another program names it. That of an untrained encoder is the network's.
        let is_in_variant = |of: &Of, model: &str| model_parts(&of.variant).1 == Some(model);
        let side = |of: &Of| Side {
            baseline: of.is_baseline().then(|| of.model.clone()),
            model: of
                .other()
                .filter(|model| variants_are_rows || !is_in_variant(of, model))
                .map(str::to_owned),
            place: Place::of(of, labels, |key| by.contains(&key)),
        };
        let mut comparison = Self { units: BTreeMap::new(), values: BTreeMap::new() };
        let (networks, baselines): (Vec<&Mean>, Vec<&Mean>) =
            means.iter().partition(|mean| !mean.of.is_baseline());
        let mut rows: BTreeMap<Subject, Vec<Subject>> = BTreeMap::new();
        for mean in networks {
            let subject = subject(&mean.of);
            rows.entry(subject.without_latent()).or_default().push(subject.clone());
            comparison.insert(subject, side(&mean.of), mean);
        }
        // A baseline has no latent size, so it is in the rows of the networks of every size.
        for mean in baselines {
            let own = subject(&mean.of);
            for subject in rows.get(&own).cloned().unwrap_or_else(|| vec![own]) {
                comparison.insert(subject, side(&mean.of), mean);
            }
        }
        comparison.merge_baselines();
        comparison
    }

    /// The columns.
    pub fn sides(&self) -> BTreeSet<&Side> {
        self.values.keys().map(|(_, side)| side).collect()
    }

    /// The mean of a row and a column, if there is one.
    pub fn mean(&self, subject: &Subject, side: &Side) -> Option<&'a Mean> {
        self.values.get(&(subject.clone(), side.clone())).copied()
    }

    /// Divides the rows of an experiment into tables.
    fn parts(&self, metrics: &[String]) -> Vec<Part> {
        let mut parts: BTreeMap<_, Vec<&Subject>> = BTreeMap::new();
        for subject in self.units.keys() {
            let place = &subject.place;
            let key = (subject.task, &place.scenario, &place.variant, &place.settings);
            parts.entry(key).or_default().push(subject);
        }
        parts.into_values().map(|rows| self.part(&rows, metrics)).collect()
    }

    /// The part of these rows.
    fn part(&self, rows: &[&Subject], metrics: &[String]) -> Part {
        let Subject { task, place: Place { scenario, variant, settings, .. }, .. } = rows[0];
        let settings = [variant.as_ref().map(Label::text), settings.as_ref().map(Natural::text)];
        let settings: Vec<&str> = settings.into_iter().flatten().filter(|text| !text.is_empty()).collect();
        let values = || self.values.iter().filter(|((subject, _), _)| rows.contains(&subject));
        let networks = values().filter(|((_, side), _)| side.baseline.is_none());
        let columns: BTreeSet<&Side> = values().map(|((_, side), _)| side).collect();
        let column = |side: &&Side| Column {
            name: side.name(),
            is_baseline: side.baseline.is_some(),
            is_further: side.baseline.as_deref().is_some_and(|baseline| baseline != PERSISTENCE),
        };
        Part {
            task: *task,
            scenario: scenario.as_ref().map(Origin::to_string),
            settings: settings.join(", "),
            over: replicates_of(networks.map(|(_, mean)| *mean)),
            rows: rows.iter().map(|subject| self.words(subject, &columns, metrics)).collect(),
            columns: columns.iter().map(column).collect(),
        }
    }

    /// A row of a part.
    fn words(&self, subject: &Subject, columns: &BTreeSet<&Side>, metrics: &[String]) -> Row {
        let (unit, metric) = (self.units[subject], &metrics[subject.metric]);
        let means: Vec<Option<&Mean>> = columns.iter().map(|side| self.mean(subject, side)).collect();
        let values: Vec<Option<f64>> = means.iter().map(|mean| Some((*mean)?.interval.mean)).collect();
        let cell = |(mean, is_best): (&Option<&Mean>, bool)| {
            let interval = (*mean)?.interval;
            let (mean, half) = printed(&interval, unit);
            Some(Cell {
                mean: interval.mean.into(),
                bounds: interval.bounds.map(|(low, high)| [low.into(), high.into()]),
                text: half.map_or(mean.clone(), |half| format!("{mean} ± {half}")),
                is_best,
            })
        };
        Row {
            modality: subject.predicted_ahead(),
            metric: label(metric, unit),
            better: higher_is_better(metric),
            cells: means.iter().zip(best(metric, unit, &values)).map(cell).collect(),
        }
    }

    fn insert(&mut self, subject: Subject, side: Side, mean: &'a Mean) {
        self.units.insert(subject.clone(), &mean.unit);
        self.values.insert((subject, side), mean);
    }

    /// Makes one column of the columns of a baseline if they show the same numbers in every row.
    fn merge_baselines(&mut self) {
        let names: BTreeSet<String> =
            self.values.keys().filter_map(|(_, side)| side.baseline.clone()).collect();
        for name in names {
            let is_own = |(_, side): &(Subject, Side)| side.baseline.as_ref() == Some(&name);
            let mut rows: BTreeMap<&Subject, BTreeSet<(String, Option<String>)>> = BTreeMap::new();
            for ((subject, _), mean) in self.values.iter().filter(|(key, _)| is_own(key)) {
                rows.entry(subject).or_default().insert(printed(&mean.interval, &mean.unit));
            }
            if rows.values().all(|numbers| numbers.len() == 1) {
                let side = Side { baseline: Some(name.clone()), model: None, place: Place::default() };
                let (own, others): (Vec<_>, Vec<_>) =
                    std::mem::take(&mut self.values).into_iter().partition(|(key, _)| is_own(key));
                let own = own.into_iter().map(|((subject, _), mean)| ((subject, side.clone()), mean));
                self.values = others.into_iter().chain(own).collect();
            }
        }
    }
}

/// A mean and half of its interval, as tables of metrics show them.
pub fn printed(interval: &Interval, unit: &str) -> (String, Option<String>) {
    let number = |value: f64| rounded(value, unit);
    (number(interval.mean), interval.bounds.map(|(_, high)| number(high - interval.mean)))
}

/// A number of seconds without the digits that only rounding has.
fn number(seconds: f64) -> f64 {
    (seconds * 1e6).round() / 1e6
}

/// The key that tells columns apart if none is asked for: the variant if the runs of one experiment have several
/// variants, not because of a search, and one latent size. Otherwise it is the latent size.
pub fn usual_key(means: &[Mean]) -> Key {
    let experiments: BTreeSet<&str> = means.iter().map(|mean| mean.of.experiment.as_str()).collect();
    let sizes: BTreeSet<usize> = means.iter().filter_map(|mean| mean.of.latent).collect();
    let variants: BTreeSet<&str> = means.iter().map(|mean| model_parts(&mean.of.variant).0).collect();
    let is_search = variants.iter().any(|variant| variant_parts(variant).1.is_some());
    match variants.len() > 1 && !is_search && experiments.len() == 1 && sizes.len() < 2 {
        true => Key::Variant,
        false => Key::Latent,
    }
}
