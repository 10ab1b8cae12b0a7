//! `harness compare`.

use super::asked::Asked;
use super::format::{Destination, Form};
use super::sheet::{MOST_COLUMNS, Mark, Sheet, Style};
use super::table::width;
use super::{DONE, usage};
use anyhow::Result;
use clap::Args;
use harness::analysis::{Answer, Comparison, Key, Label, Mean, Place, SIGNIFICANT, Side, Subject, printed};
use harness::metrics::best;
use harness::numbers::{Natural, enumerated};
use harness::registry::Registry;
use harness::spec::variant_parts;
use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;

#[derive(Args)]
pub struct Compare {
    #[command(flatten)]
    asked: Asked,
    /// In a text with many columns, also show the baselines that differ between columns, such as ridge for each input
    #[arg(long)]
    all: bool,
    #[command(flatten)]
    to: Destination,
}

impl Compare {
    /// Prints the table, or prints or writes the means.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let (form, question) = (self.to.form()?, self.asked.question());
        if let Some(key) =
            question.by.iter().find(|key| [Key::Task, Key::Modality, Key::Metric].contains(key))
        {
            let key = key.name();
            return Err(usage(format!(
                "the rows of a table differ in their {key}, so {key} can't be in --by; `harness plot` distinguishes any \
                 key"
            )));
        }
        let answer = question.ask(registry)?;
        let style = match form {
            Form::Page(style) => style,
            Form::Data(data) => {
                answer.notes.iter().for_each(|note| eprintln!("{note}"));
                return data.write(&mut answer.frame()?, "mean");
            }
        };
        let mut printed = Printed::new(&answer);
        if style == Style::Text && !self.all {
            printed.leave_out_baselines();
        }
        print!("{}", printed.sheet(style).render(style, width()));
        Ok(ExitCode::from(DONE))
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
    answer: &'a Answer,
    table: Comparison<'a>,
    notes: Vec<String>,
}

impl<'a> Printed<'a> {
    fn new(answer: &'a Answer) -> Self {
        Self { answer, table: answer.table(), notes: answer.explained() }
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
        if sides.len() <= MOST_COLUMNS || names.is_empty() || self.answer.against.is_some() {
            return;
        }
        self.table.values.retain(|(_, side), _| !is_left_out(side));
        let shown: BTreeSet<Subject> = self.table.values.keys().map(|(subject, _)| subject.clone()).collect();
        self.table.units.retain(|subject, _| shown.contains(subject));
        let (verb, them) = if names.len() == 1 { ("is", "it") } else { ("are", "them") };
        let names = enumerated(&names.into_iter().collect::<Vec<_>>());
        self.notes.push(format!("{names} of each column {verb} left out; --all shows {them}"));
    }

    fn sheet(self, style: Style) -> Sheet {
        let sides = self.table.sides();
        let legend = if style == Style::Text { self.trials() } else { BTreeMap::new() };
        let header = sides.iter().map(|side| named(side, style, &legend)).collect();
        let row = |(subject, unit): (&Subject, &&str)| {
            (self.words(subject, unit, style, &legend), self.cells(subject, unit, &sides, style))
        };
        let rows: Vec<_> = self.table.units.iter().map(row).collect();
        // The last four words are the horizon, the inputs that networks got, the modality and the metric.
        let titles = rows.first().map_or(0, |(words, _)| words.len() - 4);
        let mark = if self.answer.against.is_some() { Mark::Significant } else { Mark::Best };
        Sheet { titles, header, rows, mark, notes: self.notes, legend: legend.into_iter().collect() }
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
        let metric = &self.answer.metrics[subject.metric];
        let mut words = vec![subject.task.name().to_owned()];
        words.extend(styled(&subject.place, style, legend).words());
        words.extend([subject.predicted(), style.metric(metric, unit)]);
        words
    }

    /// The cells of a row: the mean and half of its interval. The best mean is marked, or the significant differences. A
    /// missing mean is empty, and a difference has a sign.
    fn cells(&self, subject: &Subject, unit: &str, sides: &BTreeSet<&Side>, style: Style) -> Vec<String> {
        let means: Vec<Option<&Mean>> = sides.iter().map(|side| self.table.mean(subject, side)).collect();
        let values: Vec<Option<f64>> = means.iter().map(|mean| Some((*mean)?.interval.mean)).collect();
        let best = best(&self.answer.metrics[subject.metric], unit, &values);
        let cell = |(mean, is_best): (&Option<&Mean>, bool)| {
            let Some(Mean { interval, against, p, .. }) = mean else { return String::new() };
            let (mean, half) = printed(interval, unit);
            let sign = if against.is_some() && !mean.starts_with('-') { "+" } else { "" };
            let is_marked = match self.answer.against {
                Some(_) => p.is_some_and(|p| p < SIGNIFICANT),
                None => is_best,
            };
            style.number(&format!("{sign}{mean}"), half.as_deref(), is_marked)
        };
        means.iter().zip(best).map(cell).collect()
    }
}
