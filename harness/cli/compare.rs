//! `harness compare`.

use super::format::{Destination, Form};
use super::plot::key;
use super::results::BY_UNIT;
use super::sheet::{MOST_COLUMNS, Sheet, Style};
use super::table::width;
use super::{DONE, item, samples};
use anyhow::Result;
use clap::Args;
use clap::builder::PossibleValuesParser;
use harness::analysis::{
    Analysis, Comparison, Interval, Key, Label, Labels, Mean, Over, Place, Setting, Side, Subject,
    check_models, printed, replicates_of, usual_key,
};
use harness::meant;
use harness::metrics::{Metric, best};
use harness::numbers::{Natural, enumerated};
use harness::registry::Registry;
use harness::spec::{Modality, Task, variant_parts};
use polars::prelude::{Column, DataFrame, PolarsResult};
use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;

/// The metrics that are compared if none is asked for.
const USUAL: &str = "smape,wmape,r2,relative_error";
/// The metrics that are always defined.
const ALWAYS_DEFINED: [Metric; 2] = [Metric::Rmse, Metric::Mae];

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
    /// The metrics, separated by commas:
    /// - r2, rmse, mae, smape, wmape, relative_error
    /// - relative_error_REGION: only for the pixels of a region, such as finger
    /// - r2_KIND: only for a kind of contact, such as ground
    /// - log_r2, trimmed_r2, f1, auc: of forces, without much weight on the strongest contacts
    /// - crps, coverage_50, coverage_90, width_50, width_90: of the predictive distribution of forces
    /// - crps_PHASE: only for contact, onset, sustained, release or free
    /// - r2_from_Ns: only for the samples after N s
    /// - skill: that over persistence
    /// - skill_horizon: the horizon up to which the skill is positive
    /// - kl: that of the latent state
    /// - active: the number of dimensions of the latent state that are used
    /// - the metrics that you have added to runs, by their names
    #[arg(verbatim_doc_comment, long, value_name = "METRIC", value_delimiter = ',', value_parser = item, default_value = USUAL)]
    metrics: Vec<String>,
    /// The models, separated by commas: network, which stands for all networks and models of other programs, the
    /// baselines persistence, ridge and training_mean, or the name of a model of another program
    #[arg(
        long,
        value_name = "MODEL",
        value_delimiter = ',',
        value_parser = item,
        default_value = "network,persistence,ridge,training_mean"
    )]
    models: Vec<String>,
    /// Compare only this task [default: both]
    #[arg(long, value_parser = PossibleValuesParser::new(Task::ALL.iter().map(|task| task.name())))]
    task: Option<String>,
    /// Compare only the predictions of these modalities, separated by commas, or of the part of one with one unit, for
    /// example "arm in rad" [default: all]
    #[arg(long, value_name = "NAME", value_delimiter = ',', value_parser = item)]
    modality: Vec<String>,
    /// Compare predictions N samples ahead. Several numbers, separated by commas, are rows [default: the next sample]
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = samples)]
    horizon: Vec<u32>,
    /// Show how much the other columns differ from the column with this heading. Differences are paired: they are those
    /// of runs with the same dataset and seed, or with the same dataset if the column is a baseline
    #[arg(long, value_name = "COLUMN")]
    difference_from: Option<String>,
    /// What the intervals are to contain: the mean over all datasets and seeds, or the value on one more dataset
    #[arg(
        long,
        value_name = "OVER",
        value_parser = PossibleValuesParser::new(Over::ALL.map(Over::name)),
        default_value = Over::Mean.name()
    )]
    interval: String,
    /// Use only runs with this setting, for example training.epochs=200; may be given several times. Several values of
    /// one setting are alternatives
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
    /// In a text with many columns, also show the baselines that differ between columns, such as ridge for each input
    #[arg(long)]
    all: bool,
    #[command(flatten)]
    to: Destination,
}

/// A note about skill horizons.
const LAST_HORIZON: &str = "a skill horizon that is the last horizon of the runs is a lower bound";

/// The reason why there is nothing to compare.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// No run has the requested metrics.
    #[error(
        "{}no run has these metrics for this task and model; `{list}` lists those that runs have",
        reasons.iter().map(|reason| format!("{reason}; ")).collect::<String>()
    )]
    Empty {
        /// The reasons that are known.
        reasons: Vec<String>,
        /// A command that lists the metrics that runs have.
        list: String,
    },
    /// A metric is none of the harness, and no run has it as a metric of the user.
    #[error(
        "there is no metric '{wanted}'{meant}{allowed}{}",
        own.iter().map(|own| format!(", {own}")).collect::<String>()
    )]
    Metric {
        /// The name.
        wanted: String,
        /// Which metric was probably meant, in words.
        meant: String,
        /// The metrics of the harness, in words.
        allowed: String,
        /// The metrics that users added to runs.
        own: BTreeSet<String>,
    },
    /// No column has the heading of `--difference-from`.
    #[error("there is no column '{wanted}'; the columns are {}", columns.join(", "))]
    Column {
        /// The heading.
        wanted: String,
        /// The headings of the columns.
        columns: Vec<String>,
    },
    /// No run predicts a modality.
    #[error("no run predicts '{wanted}'{}they predict {known}", meant(wanted, &known.split(", ").collect::<Vec<_>>()))]
    Modality {
        /// The name.
        wanted: String,
        /// What the runs predict.
        known: String,
    },
    /// Horizons are columns, and one is chosen.
    #[error("--horizon chooses the rows, so horizon can't be in --by")]
    Horizons,
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
    pub fn execute(mut self, registry: &Registry) -> Result<ExitCode> {
        let form = self.to.form()?;
        let analysis = Analysis::finished(registry, &self.experiments, &self.settings)?;
        if analysis.experiments().next().is_none() {
            return Err(CompareError::Nothing(registry.command("run single_to_multi")).into());
        }
        let mut all = self.means(&analysis)?;
        if self.has(Metric::SkillHorizon) {
            all.extend(analysis.skill_horizons_by(&self.by)?);
        }
        self.check_metrics(&all)?;
        check_models(&self.models, &all)?;
        self.check_modalities(&all)?;
        let undefined = analysis.undefined(self.horizons(&analysis)?.as_ref(), &self.modality)?;
        let undefined = undefined.sentences(|metric| self.metrics.iter().any(|name| name == metric));
        if !all.iter().any(|mean| self.wants(mean)) && self.metrics.join(",") == USUAL {
            self.metrics = ALWAYS_DEFINED.map(|metric| metric.name().to_owned()).to_vec();
        }
        let over = Over::ALL.into_iter().find(|over| over.name() == self.interval).unwrap_or_default();
        let wanted = all.into_iter().filter(|mean| self.wants(mean));
        let means: Vec<Mean> = wanted.map(|mean| mean.with_interval(over)).collect();
        if means.is_empty() {
            let list = "query \"select distinct experiment, task, model, modality, metric from metrics\"";
            let (reasons, list) = (undefined, registry.command(list));
            return Err(CompareError::Empty { reasons, list }.into());
        }
        let labels = Labels::new(&analysis, &self.by);
        let by = if self.by.is_empty() { vec![usual_key(&means)] } else { self.by };
        let table = Comparison::new(&means, &by, &self.metrics, &labels);
        let mut comparison = Printed::new(table, &self.metrics);
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
                let mut frame = match &self.difference_from {
                    Some(base) => comparison.differences(base)?,
                    None => Mean::frame(&means)?,
                };
                return data.write(&mut frame, "mean");
            }
        };
        let is_over_horizons = |mean: &Mean| mean.of.metric == Metric::SkillHorizon.name();
        if by.contains(&Key::Horizon) || !self.horizon.is_empty() {
            comparison.notes.extend(analysis.note_about_samples());
        } else if !means.iter().all(is_over_horizons) {
            comparison.notes.extend(analysis.note_about_next_sample());
        }
        if means.iter().any(is_over_horizons) {
            comparison.notes.push(LAST_HORIZON.to_owned());
        }
        comparison.notes.extend(analysis.note_about_shared_test());
        comparison.notes.extend(undefined);
        comparison.notes.extend(analysis.notes().iter().cloned());
        if style == Style::Text && !self.all {
            comparison.leave_out_baselines();
        }
        print!("{}", comparison.sheet(style).render(style, width()));
        Ok(ExitCode::from(DONE))
    }

    /// Whether a mean has a wanted metric, model, modality and task.
    fn wants(&self, mean: &Mean) -> bool {
        self.metrics.contains(&mean.of.metric)
            && self.models.iter().any(|model| mean.of.is_by(model))
            && (self.modality.is_empty() || self.modality.iter().any(|name| mean.of.is_of(name)))
            && self.task.as_ref().is_none_or(|task| task == mean.of.task.name())
    }

    /// The means at the chosen horizons, or by the keys.
    fn means(&self, analysis: &Analysis) -> Result<Vec<Mean>> {
        if self.horizon.is_empty() {
            return Ok(analysis.means_by(&self.by)?);
        }
        if self.by.contains(&Key::Horizon) {
            return Err(CompareError::Horizons.into());
        }
        Ok(analysis.means_at(&self.chosen_horizons(), &self.by)?)
    }

    /// The horizons that the table tells apart; `None` if its predictions are of the next sample.
    fn horizons(&self, analysis: &Analysis) -> Result<Option<BTreeSet<usize>>> {
        if self.by.contains(&Key::Horizon) {
            return Ok(Some(analysis.horizons()?));
        }
        Ok(Some(self.chosen_horizons()).filter(|chosen| !chosen.is_empty()))
    }

    fn chosen_horizons(&self) -> BTreeSet<usize> {
        self.horizon.iter().map(|horizon| *horizon as usize).collect()
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
                let mut names: Vec<&str> = Metric::all().map(|metric| metric.name()).collect();
                names.extend(own.iter().map(|own| own.as_str()));
                let meant = meant(wanted, &names);
                return Err(CompareError::Metric { wanted: wanted.clone(), meant, allowed, own });
            }
        }
        Ok(())
    }

    /// Returns an error if no run predicts a modality.
    fn check_modalities(&self, means: &[Mean]) -> Result<(), CompareError> {
        let is_missing = |name: &&String| !means.iter().any(|mean| mean.of.is_of(name));
        match self.modality.iter().find(is_missing) {
            Some(wanted) => {
                let predicted = means.iter().filter(|mean| mean.of.modality != Modality::LATENT);
                let known: BTreeSet<String> = predicted.map(|mean| mean.of.predicted()).collect();
                let known = known.into_iter().collect::<Vec<_>>().join(", ");
                Err(CompareError::Modality { wanted: wanted.clone(), known })
            }
            None => Ok(()),
        }
    }
}

/// The words of a row or a column for a text: each of the trials in `legend` has its number only, and there are spaces
/// at which lines can be broken. In documents, the words are complete.
fn styled(place: &Place, style: Style, legend: &BTreeMap<String, String>) -> Place {
    if style != Style::Text {
        return place.clone();
    }
    let short = |variant: &str| match trial(variant) {
        Some((name, _)) if legend.contains_key(&name) => name.replace(',', ", "),
        Some(_) => variant.replace(',', ", "),
        None => variant.to_owned(),
    };
    Place {
        variant: place.variant.as_ref().map(|label| Label::from(short(label.text()))),
        settings: place.settings.as_ref().map(|settings| Natural::new(with_training(settings.text()))),
        ..place.clone()
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

/// The heading of a column.
fn named(side: &Side, style: Style, legend: &BTreeMap<String, String>) -> String {
    Side { place: styled(&side.place, style, legend), ..side.clone() }.name()
}

/// The table that the command prints.
struct Printed<'a> {
    table: Comparison<'a>,
    metrics: &'a [String],
    /// The column from which the values of all other columns are differences, if they are.
    base: Option<Side>,
    /// Notes that follow the one with the number of datasets and seeds.
    notes: Vec<String>,
}

impl<'a> Printed<'a> {
    fn new(table: Comparison<'a>, metrics: &'a [String]) -> Self {
        let mut printed = Self { table, metrics, base: None, notes: Vec::new() };
        if printed.table.units.keys().any(|subject| subject.direction.is_some()) {
            printed.notes.push(BY_UNIT.to_owned());
        }
        printed
    }

    /// Replaces the values of each column by their differences from those of the column with the heading `base`.
    fn subtract(&mut self, base: &str) -> Result<(), CompareError> {
        let sides = self.table.sides();
        let name = |side: &Side| named(side, Style::Text, &BTreeMap::new());
        let Some(side) = sides.iter().find(|side| name(side) == base) else {
            let columns = sides.iter().map(|side| name(side)).collect();
            return Err(CompareError::Column { wanted: base.to_owned(), columns });
        };
        let side = (*side).clone();
        let pairs =
            if side.baseline.is_some() { "on the same dataset" } else { "with the same dataset and seed" };
        self.table.subtract(&side);
        self.base = Some(side);
        self.notes.push(format!("the other columns have the differences from {base}, of runs {pairs}"));
        Ok(())
    }

    /// Leaves out the baselines that have a column beside each of many columns of networks.
    fn leave_out_baselines(&mut self) {
        let sides = self.table.sides();
        let is_left_out = |side: &Side| side.baseline.is_some() && side.place != Place::default();
        let names: BTreeSet<String> = sides
            .iter()
            .filter(|side| is_left_out(side))
            .filter_map(|side| Some(side.baseline.as_ref()?.replace('_', " ")))
            .collect();
        if sides.len() <= MOST_COLUMNS || names.is_empty() || self.base.is_some() {
            return;
        }
        self.table.values.retain(|(_, side), _| !is_left_out(side));
        let shown: BTreeSet<Subject> = self.table.values.keys().map(|(subject, _)| subject.clone()).collect();
        self.table.units.retain(|subject, _| shown.contains(subject));
        let (verb, them) = if names.len() == 1 { ("is", "it") } else { ("are", "them") };
        let names = enumerated(&names.into_iter().collect::<Vec<_>>());
        self.notes.push(format!("{names} of each column {verb} left out; --all shows {them}"));
    }

    /// The means of all rows and columns as a table for programs. The column `difference_from` has the heading `base`
    /// in the rows that are differences.
    fn differences(self, base: &str) -> PolarsResult<DataFrame> {
        let of = |side: &Side| (self.base.as_ref() != Some(side)).then_some(base);
        let from: Vec<Option<&str>> = self.table.values.keys().map(|(_, side)| of(side)).collect();
        let means: Vec<Mean> = self.table.values.values().map(|mean| mean.as_ref().clone()).collect();
        let mut frame = Mean::frame(&means)?;
        let before = frame.get_column_index("datasets").unwrap_or_default();
        frame.insert_column(before, Column::new("difference_from".into(), from))?;
        Ok(frame)
    }

    fn sheet(&self, style: Style) -> Sheet {
        let sides = self.table.sides();
        let legend = if style == Style::Text { self.trials() } else { BTreeMap::new() };
        let header = sides.iter().map(|side| named(side, style, &legend));
        let rows = self.table.units.iter().map(|(subject, unit)| {
            (self.words(subject, unit, style, &legend), self.cells(subject, unit, &sides, style))
        });
        let rows: Vec<_> = rows.collect();
        // The last three words are the horizon, the modality and the metric.
        let titles = rows.first().map_or(0, |(words, _)| words.len() - 3);
        let header = header.collect();
        let notes = std::iter::once(self.replicates()).chain(self.notes.iter().cloned()).collect();
        let marked = self.base.is_none();
        Sheet { titles, header, rows, marked, notes, legend: legend.into_iter().collect() }
    }

    /// The names of trials, and their settings. A name that trials with different settings have is left out.
    fn trials(&self) -> BTreeMap<String, String> {
        let places = self.table.values.keys().flat_map(|(subject, side)| [&subject.place, &side.place]);
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
        words.extend(styled(&subject.place, style, legend).words());
        words.extend([subject.predicted(), style.metric(metric, unit)]);
        words
    }

    /// The cells of a row: the mean and half of its interval, with the best mean marked. A missing mean is empty, and a
    /// difference has a sign.
    fn cells(&self, subject: &Subject, unit: &str, sides: &BTreeSet<&Side>, style: Style) -> Vec<String> {
        let interval = |side: &&Side| Some(self.table.mean(subject, side)?.interval);
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
        let values = &self.table.values;
        let network = values.iter().filter(|((_, side), _)| side.baseline.is_none());
        if values.keys().all(|(_, side)| side.baseline.is_some()) {
            return String::new();
        }
        let means: Vec<&Mean> = network.map(|(_, mean)| mean.as_ref()).collect();
        let over = means.first().map(|mean| mean.over).unwrap_or_default();
        match replicates_of(means) {
            Some(replicates) => format!("mean ± half of the {}", over.described(&replicates)),
            None => "one seed, so without intervals".into(),
        }
    }
}
