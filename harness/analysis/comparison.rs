//! Means as a table: keys tell its rows and columns apart, and baselines stand beside networks.

use super::{Interval, Key, Label, Labels, Mean, Of, replicates_of};
use harness_judge::models::NETWORK;
use harness_metrics::{Metric, rounded};
use harness_shared::numbers::Natural;
use harness_spec::{Modality, Origin, Task, model_parts, variant_parts};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

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
        before.into_iter().chain(values).chain([settings, horizon].map(Option::unwrap_or_default)).collect()
    }
}

/// The value of a setting with the name of the setting, as in a variant: `hidden=64`. Modalities say that they are an
/// input.
fn with_key(key: &str, value: &str) -> String {
    match key.split_once('.').map_or(key, |(_section, name)| name) {
        "input" => value.to_owned(),
        name => format!("{name}={value}"),
    }
}

/// A column. Columns of networks come first, then those of each external model and each baseline.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Side {
    /// The name of the baseline; `None` for networks and external models.
    pub baseline: Option<String>,
    /// The name of an external model, if the variant does not distinguish columns.
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
            None | Some(0) => self.predicted(),
            Some(1) => format!("{}, next sample", self.predicted()),
            Some(horizon) => format!("{}, {horizon} samples ahead", self.predicted()),
        }
    }
}

/// Rows of a table that differ only in what is predicted and in the metric.
pub struct Part<'b> {
    /// The task that is evaluated.
    pub task: Task,
    /// The scenario or imported dataset.
    pub scenario: Option<&'b Origin>,
    /// What tells these runs from those of other parts, in words; empty if nothing does.
    pub settings: String,
    /// The rows.
    pub rows: Vec<&'b Subject>,
    /// The columns in which they have values.
    pub columns: BTreeSet<&'b Side>,
    /// What the intervals of networks are over, such as `3 seeds`; `None` if each value is of one run.
    pub over: Option<String>,
}

/// The means of all rows and columns.
pub struct Comparison<'a> {
    /// The rows, each with the unit of its values.
    pub units: BTreeMap<Subject, &'a str>,
    /// The means by row and column.
    pub values: BTreeMap<(Subject, Side), Cow<'a, Mean>>,
}

impl<'a> Comparison<'a> {
    /// Puts means into rows and columns.
    ///
    /// # Arguments
    /// * `means`: the means of networks and baselines
    /// * `by`: the keys that tell columns apart; all others tell rows apart
    /// * `metrics`: the names of the metrics, in the order of the rows
    /// * `labels`: the short names of variants and values of settings
    pub fn new(means: &'a [Mean], by: &[Key], metrics: &[String], labels: &Labels) -> Self {
        // An external model is a column beside the networks on the same data.
        let variants_are_rows = !by.contains(&Key::Variant);
        let subject = |of: &Of| Subject {
            task: of.task,
            place: Place {
                variant: variants_are_rows.then(|| labels.variant(model_parts(&of.variant).0)),
                ..Place::of(of, labels, |key| !by.contains(&key))
            },
            modality: of.modality,
            direction: of.direction.clone(),
            metric: metrics.iter().position(|name| *name == of.metric).unwrap_or(metrics.len()),
        };
        let side = |of: &Of| Side {
            baseline: of.is_baseline().then(|| of.model.clone()),
            model: of.external().filter(|_| variants_are_rows).map(str::to_owned),
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
    pub fn mean(&self, subject: &Subject, side: &Side) -> Option<&Mean> {
        self.values.get(&(subject.clone(), side.clone())).map(Cow::as_ref)
    }

    /// The means of a row, each with its column.
    pub fn row(&self, subject: &Subject) -> impl Iterator<Item = (&Side, &Mean)> {
        let own = self.values.range((subject.clone(), Side::default())..);
        let own = own.take_while(move |((other, _), _)| other == subject);
        own.map(|((_, side), mean)| (side, mean.as_ref()))
    }

    /// Divides the rows of an experiment into tables.
    pub fn parts(&self) -> Vec<Part<'_>> {
        let mut parts: BTreeMap<_, Vec<&Subject>> = BTreeMap::new();
        for subject in self.units.keys() {
            let place = &subject.place;
            let key = (subject.task, &place.scenario, &place.variant, &place.settings);
            parts.entry(key).or_default().push(subject);
        }
        parts.into_values().map(|rows| self.part(rows)).collect()
    }

    /// The part of these rows.
    fn part<'b>(&'b self, rows: Vec<&'b Subject>) -> Part<'b> {
        let Subject { task, place: Place { scenario, variant, settings, .. }, .. } = rows[0];
        let settings = [variant.as_ref().map(Label::text), settings.as_ref().map(Natural::text)];
        let settings: Vec<&str> = settings.into_iter().flatten().filter(|text| !text.is_empty()).collect();
        let values = || rows.iter().flat_map(|row| self.row(row));
        let of_networks = values().filter(|(side, _)| side.baseline.is_none());
        let over = replicates_of(of_networks.map(|(_, mean)| mean));
        let columns = values().map(|(side, _)| side).collect();
        let (task, scenario, settings) = (*task, scenario.as_ref(), settings.join(", "));
        Part { task, scenario, settings, columns, over, rows }
    }

    fn insert(&mut self, subject: Subject, side: Side, mean: &'a Mean) {
        self.units.insert(subject.clone(), &mean.unit);
        self.values.insert((subject, side), Cow::Borrowed(mean));
    }

    /// Replaces the values of each column by their differences from those of the column `base`. If this is a column of
    /// networks, those of baselines are left out, because a baseline has no seed.
    pub fn subtract(&mut self, base: &Side) {
        let mut differences = BTreeMap::new();
        for ((subject, own), mean) in &self.values {
            let Some(of_base) = self.values.get(&(subject.clone(), base.clone())) else { continue };
            let value =
                if own == base { Some(mean.clone()) } else { mean.difference_from(of_base).map(Cow::Owned) };
            if let Some(value) = value.filter(|_| own.baseline.is_none() || base.baseline.is_some()) {
                differences.insert((subject.clone(), own.clone()), value);
            }
        }
        let shown: BTreeSet<&Subject> = differences.keys().map(|(subject, _)| subject).collect();
        self.units.retain(|subject, _| shown.contains(subject));
        self.values = differences;
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

/// The metrics over all elements or pixels that some means have: first those of the harness, in its order, then users'
/// own. Metrics of a region or a kind of contact are left out.
pub fn whole_metrics(means: &[Mean]) -> Vec<String> {
    let of_harness = || Metric::GENERAL.into_iter().chain(Metric::DERIVED).map(Metric::name);
    let has = |name: &str| means.iter().any(|mean| mean.of.metric == name);
    let own: BTreeSet<&str> = means.iter().map(|mean| mean.of.metric.as_str()).collect();
    let own = own.into_iter().filter(|name| Metric::named(name).is_none());
    of_harness().filter(|name| has(name)).map(str::to_owned).chain(own.map(str::to_owned)).collect()
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
