//! A plot of a metric over a setting, for any runs: one series for each value of other settings, in one or several panels.

use super::axes::{Look, Panel, Scale, legend, remark};
use super::page::{BLACK, BLUE, COLUMN, GRAY, GREEN, Mark, Page, Type, VERMILION, WINE};
use super::{Drawing, FigureError};
use harness_analysis::{Analysis, Interval, Key, Mean, NETWORK, Of, replicates_of};
use harness_metrics::{Metric, label};
use harness_shared::numbers::Natural;
use harness_spec::Task;
use std::collections::BTreeSet;

/// Height of a panel, points.
const HEIGHT: f64 = 110.0;
/// Space below a panel for names, the axis label and the heading of the next panel, points.
const BELOW: f64 = 38.0;
/// The colors of the series. The second half has hollow points.
const COLORS: [&str; 6] = [BLUE, VERMILION, GREEN, WINE, BLACK, GRAY];
/// The most series that can be told apart.
const MOST_SERIES: usize = 2 * COLORS.len();
/// The most panels.
const MOST_PANELS: usize = 8;
/// Height of a row of names, points.
const ROW: f64 = 8.0;

/// A plot of a metric of networks, as means with their intervals.
#[derive(Debug, Clone)]
pub struct Plot {
    /// The key along the horizontal axis.
    pub x: Key,
    /// The metric along the vertical axis.
    pub y: Metric,
    /// The keys that distinguish series.
    pub by: Vec<Key>,
    /// The key that distinguishes panels.
    pub facet: Option<Key>,
    /// The task of the networks.
    pub task: Task,
    /// The predicted modality, or its elements with one unit (`joints in rad`); `None` for all of them.
    pub modality: Option<String>,
}

/// The values of a key that occur, in order.
type Values = BTreeSet<Natural>;

impl Plot {
    /// Draws the means of an analysis.
    ///
    /// # Errors
    /// When no run has the metric, when the means differ in a key that the plot does not show, or when there are too
    /// many series or panels.
    pub fn draw(&self, analysis: &Analysis) -> Result<Drawing, FigureError> {
        let of_task = |mean: &Mean| mean.of.model == NETWORK && mean.of.task == self.task;
        let all: Vec<Mean> = analysis.means()?.into_iter().filter(of_task).collect();
        let has_modality = |of: &Of| {
            let is_named = |name: &String| of.modality.name() == name || of.predicted() == *name;
            self.modality.as_ref().is_none_or(is_named)
        };
        let is_shown = |mean: &&Mean| mean.of.metric == self.y.name() && has_modality(&mean.of);
        let means: Vec<Mean> = all.iter().filter(is_shown).cloned().collect();
        if means.is_empty() {
            let there = all.iter().map(|mean| format!("{} of {}", mean.of.metric, mean.of.predicted()));
            let there: BTreeSet<String> = there.collect();
            return Err(FigureError::NoMeans { there: there.into_iter().collect() });
        }
        self.draw_means(&means)
    }

    /// The label of the vertical axis.
    fn label(&self, means: &[Mean]) -> String {
        let units: BTreeSet<&str> = means.iter().map(|mean| mean.unit.as_str()).collect();
        // Without a unit if the values have several.
        let label = label(self.y.name(), if units.len() == 1 { &means[0].unit } else { "1" });
        let modalities: BTreeSet<String> = means.iter().map(|mean| mean.of.predicted()).collect();
        match modalities.first() {
            Some(modality) if modalities.len() == 1 => format!("{}, {label}", modality.replace('_', " ")),
            _ => label,
        }
    }

    fn draw_means(&self, means: &[Mean]) -> Result<Drawing, FigureError> {
        let label = self.label(means);
        let values = |key: Key| -> Values { means.iter().map(|mean| value(key, &mean.of)).collect() };
        let is_shown = |key: &Key| *key == self.x || self.by.contains(key) || self.facet == Some(*key);
        for key in Key::ALL.into_iter().filter(|key| !is_shown(key)) {
            let values = values(key);
            if values.len() > 1 {
                let values: Vec<String> = values.iter().map(|value| value.text().to_owned()).collect();
                return Err(FigureError::Ambiguous { key: key.name(), values });
            }
        }
        let series_of = |of: &Of| self.by.iter().map(|key| value(*key, of)).collect::<Vec<_>>();
        let series: BTreeSet<Vec<Natural>> = means.iter().map(|mean| series_of(&mean.of)).collect();
        let panels: Vec<Natural> =
            self.facet.map_or(vec![Natural::new("")], |key| values(key).into_iter().collect());
        if series.len() > MOST_SERIES || panels.len() > MOST_PANELS {
            return Err(FigureError::TooMany { series: series.len(), panels: panels.len() });
        }
        let series: Vec<Vec<Natural>> = series.into_iter().collect();
        let names: Vec<String> = series.iter().map(|values| words(values)).collect();
        let entries: Vec<(Look, &str)> =
            names.iter().enumerate().map(|(place, name)| (look(place), name.as_str())).collect();
        let entries = if self.by.is_empty() { Vec::new() } else { entries };
        let legends = rows_of(&entries);

        let columns = panels.len().min(2);
        let left = 36.0;
        let between = 12.0;
        let width = (COLUMN - left - 4.0 - between * (columns as f64 - 1.0)) / columns as f64;
        let across: Vec<String> = values(self.x).iter().map(|value| plain(value.text())).collect();
        let name_rows = rows_of_names(&across, width / across.len() as f64);
        let below = BELOW + ROW * (name_rows as f64 - 1.0);
        let top = 8.0 + 9.0 * legends.len() as f64 + if self.facet.is_some() { 12.0 } else { 4.0 };
        let rows = panels.len().div_ceil(columns);
        let height = top + rows as f64 * (HEIGHT + below) + 4.0;

        let mut page = Page::new(COLUMN, height, &format!("{label} over {}", self.x.name()));
        for (row, entries) in legends.iter().enumerate() {
            legend(&mut page, COLUMN / 2.0, 9.0 + 9.0 * row as f64, entries);
        }
        let [low, high] = range(means);
        let mut is_cut = false;
        for (place, panel_value) in panels.iter().enumerate() {
            let (row, column) = (place / columns, place % columns);
            let panel = Panel {
                left: left + column as f64 * (width + between),
                top: top + row as f64 * (HEIGHT + below),
                width,
                height: HEIGHT,
            };
            let scale = Scale::linear(low, high, 5, panel.upwards());
            panel.left_axis(&mut page, &scale, (column == 0).then_some(label.as_str()));
            if self.facet.is_some() {
                let letter = char::from(b'a' + place as u8).to_string();
                panel.heading(&mut page, &letter, &plain(panel_value.text()));
            }
            let slots = panel.slots(across.len());
            self.name(&mut page, &panel, &slots, &across, name_rows);
            let is_here = |of: &Of| self.facet.is_none_or(|key| value(key, of) == *panel_value);
            for (place, one) in series.iter().enumerate() {
                let own = means.iter().filter(|mean| is_here(&mean.of) && series_of(&mean.of) == *one);
                let aside = (place as f64 - (series.len() as f64 - 1.0) / 2.0) * width / across.len() as f64;
                let aside = aside * 0.6 / series.len() as f64;
                let mut points: Vec<(f64, &Interval)> = own
                    .filter_map(|mean| {
                        let text = plain(value(self.x, &mean.of).text());
                        let slot = across.iter().position(|name| *name == text)?;
                        Some((slots[slot] + aside, &mean.interval))
                    })
                    .collect();
                points.sort_by(|a, b| a.0.total_cmp(&b.0));
                let path: Vec<_> = points.iter().map(|(x, value)| [*x, scale.at(value.mean)]).collect();
                look(place).path(&mut page, &path);
                for (x, value) in points {
                    look(place).point(&mut page, x, &scale, value);
                    is_cut |= scale.cuts(value);
                }
            }
        }
        remark(&mut page, &remark_of(means, is_cut), [COLUMN / 2.0, height - 4.0]);
        Ok(Drawing { page, data: Mean::frame(means)? })
    }

    /// Writes the names along the horizontal axis, in several rows if they are long.
    fn name(&self, page: &mut Page, panel: &Panel, slots: &[f64], names: &[String], rows: usize) {
        if rows == 1 {
            return panel.bottom_names(page, slots, names, self.x.name());
        }
        let none = vec![String::new(); names.len()];
        panel.bottom_names(page, slots, &none, "");
        for (place, (x, name)) in slots.iter().zip(names).enumerate() {
            let half = Type::SMALL.width(name) / 2.0;
            let x = x.clamp(panel.left.min(half), (COLUMN - half).max(panel.left));
            page.text(name, [x, panel.bottom() + 8.7 + ROW * (place % rows) as f64], Type::SMALL);
        }
        let y = panel.bottom() + 17.7 + ROW * (rows as f64 - 1.0);
        page.text(self.x.name(), [panel.left + panel.width / 2.0, y], Type::LABEL);
    }
}

/// A mean's value of a key.
fn value(key: Key, of: &Of) -> Natural {
    let text = match key {
        Key::Latent => of.latent.unwrap_or_default().to_string(),
        Key::Experiment => of.experiment.clone(),
        Key::Scenario => of.scenario.name().to_owned(),
        Key::Variant => of.variant.clone(),
        Key::Settings => of.settings.clone(),
        Key::Task => of.task.name().to_owned(),
        Key::Modality => of.predicted(),
    };
    Natural::new(if text.is_empty() { "none".into() } else { text })
}

fn look(place: usize) -> Look {
    let is_second = place >= COLORS.len();
    let mark = if place.is_multiple_of(2) { Mark::Disc } else { Mark::Square };
    Look { color: COLORS[place % COLORS.len()], mark, hollow: is_second, dashed: is_second }
}

/// The name of a series.
fn words(values: &[Natural]) -> String {
    plain(&values.iter().map(Natural::text).collect::<Vec<_>>().join(", "))
}

/// A text without the characters that a page reads as markup.
fn plain(text: &str) -> String {
    text.replace(['*', '{', '}', '^'], "")
}

/// Divides the entries of a legend into rows that fit the page.
fn rows_of<'a>(entries: &[(Look, &'a str)]) -> Vec<Vec<(Look, &'a str)>> {
    let mut rows: Vec<Vec<(Look, &str)>> = Vec::new();
    let mut taken = f64::INFINITY;
    for entry in entries {
        let width = 27.0 + Type::SMALL.width(entry.1);
        if taken + width > COLUMN - 8.0 {
            rows.push(Vec::new());
            taken = 0.0;
        }
        taken += width;
        if let Some(row) = rows.last_mut() {
            row.push(*entry);
        }
    }
    rows
}

/// In how many rows names have to be written, so that those of a row do not overlap.
fn rows_of_names(names: &[String], slot: f64) -> usize {
    let widest = names.iter().map(|name| Type::SMALL.width(name) + 4.0).fold(0.0, f64::max);
    ((widest / slot).ceil() as usize).clamp(1, names.len().clamp(1, 4))
}

/// The range of the vertical axis. It includes every mean. An interval may be cut if it is more than twice as long as the
/// range of the means.
fn range(means: &[Mean]) -> [f64; 2] {
    let values = || means.iter().map(|mean| mean.interval.mean);
    let (low, high) = (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max));
    let shortest =
        means.iter().map(|mean| mean.interval.high() - mean.interval.mean).fold(f64::INFINITY, f64::min);
    let room = (high - low).max(shortest).max(1e-9 * high.abs());
    let lows = means.iter().map(|mean| mean.interval.low().max(low - room));
    let highs = means.iter().map(|mean| mean.interval.high().min(high + room));
    [lows.fold(low, f64::min), highs.fold(high, f64::max)]
}

/// Returns the note that says what the bars are.
fn remark_of(means: &[Mean], is_cut: bool) -> String {
    let cut = if is_cut { "; without a cap, they go on beyond the axis" } else { "" };
    match replicates_of(means) {
        Some(over) => format!("bars: 95 % intervals over {over}{cut}"),
        None => "one seed, no bars".into(),
    }
}
