//! `harness compare`.

use super::DONE;
use super::format::{Destination, Form};
use super::plot::key;
use super::results::BY_UNIT;
use super::sheet::{Sheet, Style, best, rounded};
use super::table::width;
use anyhow::Result;
use clap::Args;
use clap::builder::PossibleValuesParser;
use harness::analysis::{Analysis, Interval, Key, Label, Labels, Mean, Of, Setting, replicates_of};
use harness::judge::models::{self, NETWORK};
use harness::metrics::Metric;
use harness::numbers::Natural;
use harness::registry::Registry;
use harness::spec::{Modality, Origin, Task, model_parts, variant_parts};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;

#[derive(Args)]
pub struct Compare {
    /// Experiments to compare, as `harness ls` names them [default: all]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// The keys that distinguish the columns, separated by commas: those below, or settings, such as input or
    /// network.hidden. All other keys distinguish rows or tables [default: latent, or variant if the runs of one
    /// experiment have several variants and one latent size]
    #[arg(long, value_name = "KEY", value_delimiter = ',', value_parser = key(&Key::OF_COLUMNS))]
    by: Vec<Key>,
    /// The metrics, separated by commas: r2, rmse, mae, smape, wmape, relative_error, relative_error_REGION for the
    /// pixels of a region, such as finger, skill over persistence, or skill_horizon, up to which the skill is positive
    #[arg(
        long,
        value_name = "METRIC",
        value_delimiter = ',',
        default_value = "smape,wmape,r2,relative_error"
    )]
    metrics: Vec<String>,
    /// The models, separated by commas: network, which stands for all networks and models of other programs, the
    /// baselines persistence, ridge and training_mean, or the name of a model of another program
    #[arg(
        long,
        value_name = "MODEL",
        value_delimiter = ',',
        default_value = "network,persistence,ridge,training_mean"
    )]
    models: Vec<String>,
    /// Compare only this task [default: both]
    #[arg(long, value_parser = PossibleValuesParser::new(Task::ALL.iter().map(|task| task.name())))]
    task: Option<String>,
    /// Show how much the other columns differ from the column with this heading. Differences are paired: they are those
    /// of runs with the same dataset and seed
    #[arg(long, value_name = "COLUMN")]
    difference_from: Option<String>,
    /// Use only runs with this setting, for example training.epochs=200; may be given several times
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
    #[command(flatten)]
    to: Destination,
}

/// A note about skill horizons.
const LAST_HORIZON: &str = "a skill horizon that is the last horizon of the runs is a lower bound";

/// A note about horizons, given the number of samples per second.
fn of_samples(rate_hz: f64) -> String {
    format!("horizons in samples of {} s", 1.0 / rate_hz)
}

/// The reason why there is nothing to compare.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// No run has the requested metrics. The field is a command that lists those that runs have.
    #[error("no run has these metrics for this task and model; `{0}` lists those that runs have")]
    Empty(String),
    /// A metric is none of the harness, and no run has it as a metric of the user.
    #[error("there is no metric '{wanted}'; {allowed}{}", own.iter().map(|own| format!(", {own}")).collect::<String>())]
    Metric {
        /// The name.
        wanted: String,
        /// The metrics of the harness, in words.
        allowed: String,
        /// The metrics that users added to runs.
        own: BTreeSet<String>,
    },
    /// A model is none of the harness, and no run is of a model of that name.
    #[error("there is no model '{wanted}'; there are {known}")]
    Model {
        /// The name.
        wanted: String,
        /// The models that there are.
        known: String,
    },
    /// No column of networks has the heading of `--difference-from`.
    #[error("there is no column '{wanted}'; the columns of networks are {}", columns.join(", "))]
    Column {
        /// The heading.
        wanted: String,
        /// The headings of the columns of networks.
        columns: Vec<String>,
    },
    /// Columns of different scenarios can't be subtracted.
    #[error(
        "--difference-from compares runs on the same data, and each scenario has its own; leave scenario out of --by"
    )]
    Scenarios,
    /// There are no finished runs. The field is a command that makes some.
    #[error("there are no finished runs to compare; `{0}` makes some")]
    Nothing(String),
}

impl Compare {
    /// Prints the table, or prints or writes the means.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let form = self.to.form()?;
        let analysis = Analysis::finished(registry, &self.experiments, &self.settings)?;
        if analysis.experiments().next().is_none() {
            return Err(CompareError::Nothing(registry.command("run single_to_multi")).into());
        }
        let mut all = analysis.means_by(&self.by)?;
        if self.has(Metric::SkillHorizon) {
            all.extend(analysis.skill_horizons_by(&self.by)?);
        }
        self.check_metrics(&all)?;
        self.check_models(&all)?;
        let is_wanted = |mean: &Mean| {
            let is_model = |name: &String| *name == mean.of.model || mean.of.external() == Some(name);
            self.metrics.contains(&mean.of.metric)
                && self.models.iter().any(is_model)
                && self.task.as_ref().is_none_or(|task| task == mean.of.task.name())
        };
        let means: Vec<Mean> = all.into_iter().filter(is_wanted).collect();
        if means.is_empty() {
            let list = "query \"select distinct experiment, task, model, modality, metric from metrics\"";
            return Err(CompareError::Empty(registry.command(list)).into());
        }
        let labels = Labels::new(&analysis, &self.by);
        let by = if self.by.is_empty() { vec![usual(&means, &labels)] } else { self.by };
        let mut comparison = Comparison::new(&means, &by, &self.metrics, &labels);
        if let Some(base) = &self.difference_from {
            if by.contains(&Key::Scenario) {
                return Err(CompareError::Scenarios.into());
            }
            comparison.subtract(base)?;
        }
        let style = match form {
            Form::Page(style) => style,
            Form::Data(data) => {
                for note in analysis.notes() {
                    eprintln!("{note}");
                }
                let means: Vec<Mean> =
                    if self.difference_from.is_some() { comparison.means() } else { means };
                return data.write(&mut Mean::frame(&means)?, "mean");
            }
        };
        if by.contains(&Key::Horizon) {
            comparison.notes.extend(analysis.sample_rate_hz().map(of_samples));
        }
        if means.iter().any(|mean| mean.of.metric == Metric::SkillHorizon.name()) {
            comparison.notes.push(LAST_HORIZON.to_owned());
        }
        comparison.notes.extend(analysis.notes().iter().cloned());
        print!("{}", comparison.sheet(style).render(style, width()));
        Ok(ExitCode::from(DONE))
    }

    /// Whether this metric is wanted.
    fn has(&self, metric: Metric) -> bool {
        self.metrics.iter().any(|name| name == metric.name())
    }

    /// Returns an error if a metric is none of the harness, and no run has it.
    fn check_metrics(&self, means: &[Mean]) -> Result<(), CompareError> {
        for wanted in &self.metrics {
            let Err(allowed) = wanted.parse::<Metric>() else { continue };
            let names = means.iter().map(|mean| &mean.of.metric);
            let own: BTreeSet<String> = names.filter(|name| Metric::named(name).is_none()).cloned().collect();
            if !own.contains(wanted) {
                return Err(CompareError::Metric { wanted: wanted.clone(), allowed, own });
            }
        }
        Ok(())
    }

    /// Returns an error if a model is none of the harness, and no run is of a model of that name.
    fn check_models(&self, means: &[Mean]) -> Result<(), CompareError> {
        let external: BTreeSet<&str> = means.iter().filter_map(|mean| mean.of.external()).collect();
        let known: Vec<&str> = models::ALL.into_iter().chain(external).collect();
        match self.models.iter().find(|wanted| !known.contains(&wanted.as_str())) {
            Some(wanted) => Err(CompareError::Model { wanted: wanted.clone(), known: known.join(", ") }),
            None => Ok(()),
        }
    }
}

/// The key that distinguishes columns if none is given.
fn usual(means: &[Mean], labels: &Labels) -> Key {
    let experiments: BTreeSet<&str> = means.iter().map(|mean| mean.of.experiment.as_str()).collect();
    let sizes: BTreeSet<usize> = means.iter().filter_map(|mean| mean.of.latent).collect();
    if labels.has_variants() && experiments.len() == 1 && sizes.len() < 2 {
        Key::Variant
    } else {
        Key::Latent
    }
}

/// The values of some keys for a row or a column; `None` for all other keys.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    experiment: Option<String>,
    scenario: Option<Origin>,
    latent: Option<usize>,
    variant: Option<Label>,
    values: Vec<(&'static str, Label)>,
    settings: Option<Natural>,
    horizon: Option<usize>,
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

    /// A text for each key, empty if it has no value. In text, each of the trials in `legend` has its number only, and
    /// there are spaces at which lines can be broken.
    fn words(&self, style: Style, legend: &BTreeMap<String, String>) -> Vec<String> {
        let scenario = self.scenario.as_ref().map(|scenario| scenario.name().to_owned());
        let latent = self.latent.map(|latent| format!("latent {latent}"));
        let mut variant = self.variant.as_ref().map(|label| label.text().to_owned());
        let mut settings = self.settings.as_ref().map(|settings| settings.text().to_owned());
        if style == Style::Text {
            let short = |variant: String| match trial(&variant) {
                Some((name, _)) => if legend.contains_key(&name) { name } else { variant }.replace(',', ", "),
                None => variant,
            };
            variant = variant.map(short);
            settings = settings.map(|settings| with_training(&settings));
        }
        let before = [self.experiment.clone(), scenario, latent, variant].map(Option::unwrap_or_default);
        let values = self.values.iter().map(|(key, label)| with_key(key, label.text()));
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

/// The name of a trial without its settings, and its settings. `None` if the variant is not that of a trial.
fn trial(variant: &str) -> Option<(String, String)> {
    let (varied, number, settings) = variant_parts(variant);
    let number = format!("trial={}", number?);
    let names: Vec<&str> = [varied, &number].into_iter().filter(|name| !name.is_empty()).collect();
    Some((names.join(","), settings.replace(',', ", ")))
}

/// Settings in which runs differ, with words for how far successive halving has trained them. It sets two settings of
/// the trials that it does not train to the end.
fn with_training(settings: &str) -> String {
    const LAST: &str = "training.last_epoch=";
    if !settings.contains(LAST) {
        return settings.to_owned();
    }
    let word = |setting: &str| match setting.strip_prefix(LAST) {
        Some("null") => "trained to the end".to_owned(),
        Some(epoch) => format!("trained to epoch {epoch}"),
        None => setting.to_owned(),
    };
    let shown = settings.split(", ").filter(|setting| !setting.starts_with("tasks="));
    shown.map(word).collect::<Vec<_>>().join(", ")
}

/// A mean and half of its interval, as they are printed.
fn printed(interval: &Interval, unit: &str) -> (String, Option<String>) {
    let number = |value: f64| rounded(value, unit);
    (number(interval.mean), interval.bounds.map(|(_, high)| number(high - interval.mean)))
}

/// A column of the table. Columns of the network come first, then those of each external model and each baseline.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Side {
    /// `None` for the network and external models.
    baseline: Option<String>,
    /// The name of an external model, if the variant does not distinguish columns.
    model: Option<String>,
    place: Place,
}

impl Side {
    /// The column's heading. A network that no key distinguishes from the others is called the network.
    fn name(&self, style: Style, legend: &BTreeMap<String, String>) -> String {
        let baseline = self.baseline.as_ref().map(|name| name.replace('_', " "));
        let model = baseline.or_else(|| self.model.clone());
        let words = model.into_iter().chain(self.place.words(style, legend));
        let words: Vec<String> = words.filter(|word| !word.is_empty()).collect();
        if words.is_empty() { NETWORK.to_owned() } else { words.join(", ") }
    }
}

/// A row of the table.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Subject {
    task: Task,
    place: Place,
    modality: Modality,
    /// The unit of the elements, if the modality has elements of different units.
    direction: Option<String>,
    /// The position of the metric among the requested metrics.
    metric: usize,
}

impl Subject {
    /// The row of baselines that belongs to this one.
    fn without_latent(&self) -> Self {
        Self { place: Place { latent: None, ..self.place.clone() }, ..self.clone() }
    }
}

/// The means of all rows and columns.
struct Comparison<'a> {
    metrics: &'a [String],
    units: BTreeMap<Subject, &'a str>,
    values: BTreeMap<(Subject, Side), Cow<'a, Mean>>,
    /// The column from which the values of all other columns are differences, if they are.
    base: Option<Side>,
    notes: Vec<String>,
}

impl<'a> Comparison<'a> {
    fn new(means: &'a [Mean], by: &[Key], metrics: &'a [String], labels: &Labels) -> Self {
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
            baseline: (of.model != NETWORK).then(|| of.model.clone()),
            model: model_parts(&of.variant)
                .1
                .filter(|_| variants_are_rows && of.model == NETWORK)
                .map(str::to_owned),
            place: Place::of(of, labels, |key| by.contains(&key)),
        };
        let (units, values, base, notes) = Default::default();
        let mut comparison = Self { metrics, units, values, base, notes };
        let (networks, baselines): (Vec<&Mean>, Vec<&Mean>) =
            means.iter().partition(|mean| mean.of.model == NETWORK);
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
        comparison.notes.push(comparison.replicates());
        if comparison.units.keys().any(|subject| subject.direction.is_some()) {
            comparison.notes.push(BY_UNIT.to_owned());
        }
        comparison
    }

    fn insert(&mut self, subject: Subject, side: Side, mean: &'a Mean) {
        self.units.insert(subject.clone(), &mean.unit);
        self.values.insert((subject, side), Cow::Borrowed(mean));
    }

    /// Replaces the values of each column by their differences from those of the column with the heading `base`. The
    /// columns of baselines are left out, because a baseline has no seed.
    fn subtract(&mut self, base: &str) -> Result<(), CompareError> {
        let of_networks = self.values.keys().map(|(_, side)| side).filter(|side| side.baseline.is_none());
        let named: BTreeMap<&Side, String> =
            of_networks.map(|side| (side, side.name(Style::Text, &BTreeMap::new()))).collect();
        let Some((side, _)) = named.iter().find(|(_, name)| *name == base) else {
            let columns = named.into_values().collect();
            return Err(CompareError::Column { wanted: base.to_owned(), columns });
        };
        let side = (*side).clone();
        let mut differences = BTreeMap::new();
        for ((subject, own), mean) in &self.values {
            let Some(of_base) = self.values.get(&(subject.clone(), side.clone())) else { continue };
            let value =
                if *own == side { Some(mean.clone()) } else { mean.difference_from(of_base).map(Cow::Owned) };
            if let Some(value) = value.filter(|_| own.baseline.is_none()) {
                differences.insert((subject.clone(), own.clone()), value);
            }
        }
        let shown: BTreeSet<&Subject> = differences.keys().map(|(subject, _)| subject).collect();
        self.units.retain(|subject, _| shown.contains(subject));
        self.values = differences;
        self.base = Some(side);
        self.notes.push(format!(
            "the other columns have the differences from {base}, of runs with the same dataset and seed"
        ));
        Ok(())
    }

    /// The values of all rows and columns.
    fn means(self) -> Vec<Mean> {
        self.values.into_values().map(Cow::into_owned).collect()
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

    fn sheet(&self, style: Style) -> Sheet {
        let sides: BTreeSet<&Side> = self.values.keys().map(|(_, side)| side).collect();
        let legend = if style == Style::Text { self.trials() } else { BTreeMap::new() };
        let header = sides.iter().map(|side| side.name(style, &legend));
        let rows = self.units.iter().map(|(subject, unit)| {
            (self.words(subject, unit, style, &legend), self.cells(subject, unit, &sides, style))
        });
        let rows: Vec<_> = rows.collect();
        // The last two words are the modality and the metric.
        let titles = rows.first().map_or(0, |(words, _)| words.len() - 2);
        let header = header.collect();
        let (marked, notes) = (self.base.is_none(), self.notes.clone());
        Sheet { titles, header, rows, marked, notes, legend: legend.into_iter().collect() }
    }

    /// The names of trials, and their settings. A name that trials with different settings have is left out.
    fn trials(&self) -> BTreeMap<String, String> {
        let places = self.values.keys().flat_map(|(subject, side)| [&subject.place, &side.place]);
        let mut trials: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        for (name, settings) in places.filter_map(|place| trial(place.variant.as_ref()?.text())) {
            trials.entry(name).or_default().insert(settings);
        }
        let only = |(name, settings): (String, BTreeSet<String>)| match settings.len() {
            1 => settings.into_iter().next().map(|settings| (name, settings)),
            _ => None,
        };
        trials.into_iter().filter_map(only).collect()
    }

    /// The words of a row: task, keys, modality, metric and unit.
    fn words(
        &self,
        subject: &Subject,
        unit: &str,
        style: Style,
        legend: &BTreeMap<String, String>,
    ) -> Vec<String> {
        let metric = &self.metrics[subject.metric];
        let mut words = vec![subject.task.name().to_owned()];
        words.extend(subject.place.words(style, legend));
        let part = subject.direction.iter().map(|direction| format!(" {direction}"));
        let predicted = subject.modality.name().replace('_', " ") + &part.collect::<String>();
        words.extend([predicted, style.metric(metric, unit)]);
        words
    }

    /// The cells of a row: the mean and half of its interval, with the best mean marked. A missing mean is empty, and a
    /// difference has a sign.
    fn cells(&self, subject: &Subject, unit: &str, sides: &BTreeSet<&Side>, style: Style) -> Vec<String> {
        let interval = |side: &&Side| Some(self.values.get(&(subject.clone(), (**side).clone()))?.interval);
        let intervals: Vec<Option<Interval>> = sides.iter().map(interval).collect();
        let means =
            intervals.iter().map(|interval| Some(interval.as_ref()?.mean).filter(|_| self.base.is_none()));
        let best = best(&self.metrics[subject.metric], unit, &means.collect::<Vec<_>>());
        let cell = |((side, interval), is_best): ((&&Side, &Option<Interval>), bool)| {
            let Some(interval) = interval else { return String::new() };
            let (mean, half) = printed(interval, unit);
            let is_difference = self.base.as_ref().is_some_and(|base| base != *side);
            let sign = if is_difference && !mean.starts_with('-') { "+" } else { "" };
            style.number(&format!("{sign}{mean}"), half.as_deref(), is_best)
        };
        sides.iter().zip(&intervals).zip(best).map(cell).collect()
    }

    /// A note with the number of datasets and seeds of the means.
    fn replicates(&self) -> String {
        let network = self.values.iter().filter(|((_, side), _)| side.baseline.is_none());
        if self.values.keys().all(|(_, side)| side.baseline.is_some()) {
            return String::new();
        }
        match replicates_of(network.map(|(_, mean)| mean.as_ref())) {
            Some(over) => format!("mean ± half of the 95 % interval over {over}"),
            None => "one seed, so without intervals".into(),
        }
    }
}
