//! Panels that show an error over the latent size, by scenario and direction. Two figures consist of them.

use super::FigureError;
use super::axes::{self, Look, Panel, Scale, color_of, legend, look_of, words_of};
use super::page::{BLACK, GRAY, Page, Stroke, Type};
use super::source::{Runs, integers, replicated, texts};
use harness_analysis::models::NETWORK;
use harness_analysis::{Interval, interval, intervals};
use harness_metrics::{Direction, Metric};
use harness_spec::{Modality, Scenario, Task};
use polars::prelude::*;
use std::collections::BTreeMap;

/// The error of predicting zero, %. By SMAPE and by WMAPE, it is as large as the reference.
const ZERO: f64 = 100.0;
/// The highest R², that of predictions without an error.
const PERFECT: f64 = 1.0;
/// The lowest R² that the axis includes.
const LOWEST_R2: f64 = -1.0;

/// Describes what a panel shows.
pub struct Curves<'a> {
    /// The runs of the study.
    pub runs: &'a Runs<'a>,
    /// The networks' task.
    pub task: Task,
    /// The modality whose error is shown.
    pub modality: Modality,
    /// The metric: an error in percent, or R².
    pub metric: Metric,
    /// The panel's letter.
    pub letter: &'static str,
    /// A baseline to show beside the networks: its name in the tables, and its name on the axis.
    pub baseline: Option<(&'static str, &'static str)>,
}

/// One curve: the network's interval by latent size, and the baseline's.
struct Curve {
    scenario: Scenario,
    direction: Direction,
    network: Vec<(usize, Interval)>,
    baseline: Option<Interval>,
}

/// The numbers that a panel shows.
pub struct Measured<'a> {
    of: &'a Curves<'a>,
    latents: Vec<usize>,
    curves: Vec<Curve>,
    /// The panel's rows of the figure's CSV file.
    pub data: DataFrame,
}

impl Curves<'_> {
    /// Reads the panel's numbers from the tables.
    ///
    /// # Errors
    /// When the query fails or has no rows.
    pub fn measure(&self) -> Result<Measured<'_>, FigureError> {
        let (task, modality, metric) = (self.task, self.modality, self.metric.name());
        let baseline = self.baseline.map_or(NETWORK, |(name, _)| name);
        let rows = self.runs.query(&format!(
            "select scenario, direction, model, latent, dataset_seed, value \
             from metrics join runs using (experiment, run, scenario, latent) where task = '{task}' \
             and modality = '{modality}' and metric = '{metric}' and direction is not null and index is null \
             and model in ('{NETWORK}', '{baseline}')"
        ))?;
        let (scenarios, directions) = (texts(&rows, "scenario")?, texts(&rows, "direction")?);
        let (models, latents) = (texts(&rows, "model")?, integers(&rows, "latent")?);
        let values = replicated(&rows)?;
        let of = |scenario: Scenario, direction: Direction, model: &str| {
            let is_of = |row: &usize| {
                scenarios[*row] == scenario.name()
                    && directions[*row] == direction.name()
                    && models[*row] == model
            };
            (0..values.len()).filter(is_of).collect::<Vec<_>>()
        };
        let mut curves = Vec::new();
        for scenario in Scenario::PAPER {
            for direction in Direction::FINGER {
                let network = of(scenario, direction, NETWORK).into_iter();
                let network =
                    intervals(network.map(|row| (latents[row] as usize, values[row].0, values[row].1)));
                let network: Vec<_> = network.into_iter().collect();
                if network.is_empty() {
                    continue;
                }
                // A baseline has no seed and no latent size. Every run on a dataset has the same value of it.
                let baseline = self.baseline.and_then(|(name, _)| {
                    let rows = of(scenario, direction, name).into_iter();
                    let by_dataset: BTreeMap<u64, f64> =
                        rows.filter_map(|row| Some((values[row].0, values[row].1?))).collect();
                    interval(by_dataset)
                });
                curves.push(Curve { scenario, direction, network, baseline });
            }
        }
        let data = self.data(&curves)?;
        Ok(Measured { of: self, latents: self.runs.latents(), curves, data })
    }

    fn is_r2(&self) -> bool {
        self.metric == Metric::R2
    }

    fn data(&self, curves: &[Curve]) -> Result<DataFrame, FigureError> {
        let mut rows: Vec<(&Curve, &str, Option<usize>, Interval)> = Vec::new();
        for curve in curves {
            rows.extend(
                curve.network.iter().map(|(latent, value)| (curve, "network", Some(*latent), *value)),
            );
            let baseline = self.baseline.zip(curve.baseline);
            rows.extend(baseline.map(|((name, _), value)| (curve, name, None, value)));
        }
        let bounds = |end: fn((f64, f64)) -> f64| rows.iter().map(move |row| row.3.bounds.map(end));
        Ok(df!(
            "panel" => vec![self.letter; rows.len()],
            "experiment" => vec![self.runs.experiment.as_str(); rows.len()],
            "task" => vec![self.task.name(); rows.len()],
            "modality" => vec![self.modality.name(); rows.len()],
            "metric" => vec![self.metric.name(); rows.len()],
            "unit" => vec![if self.is_r2() { "1" } else { "%" }; rows.len()],
            "scenario" => rows.iter().map(|row| row.0.scenario.name()).collect::<Vec<_>>(),
            "direction" => rows.iter().map(|row| row.0.direction.name()).collect::<Vec<_>>(),
            "model" => rows.iter().map(|row| row.1).collect::<Vec<_>>(),
            "latent" => rows.iter().map(|row| row.2.map(|latent| latent as u32)).collect::<Vec<_>>(),
            "mean" => rows.iter().map(|row| row.3.mean).collect::<Vec<_>>(),
            "low" => bounds(|(low, _)| low).collect::<Vec<_>>(),
            "high" => bounds(|(_, high)| high).collect::<Vec<_>>(),
        )?)
    }
}

impl Measured<'_> {
    fn values(&self) -> impl Iterator<Item = &Interval> {
        self.curves
            .iter()
            .flat_map(|curve| curve.network.iter().map(|(_, value)| value).chain(&curve.baseline))
    }

    /// The highest value on the vertical axis. The axis includes every mean, and every interval up to 1.3 times the
    /// highest mean.
    fn highest(&self) -> f64 {
        let mean = self.values().map(|value| value.mean).fold(0.0, f64::max);
        self.values().map(|value| value.high().min(mean * 1.3)).fold(mean, f64::max)
    }

    /// The lowest value on the vertical axis: 0 for errors. For R², the axis includes every mean above [`LOWEST_R2`].
    fn lowest(&self) -> f64 {
        let means = self.values().map(|value| value.mean);
        if self.of.is_r2() { means.fold(0.0, f64::min).max(LOWEST_R2) } else { 0.0 }
    }

    /// Whether an end of an interval lies beyond the axis.
    fn is_cut(&self, scale: &Scale) -> bool {
        self.values().any(|value| scale.cuts(value))
    }

    /// Draws the panel. Without an axis label it has no numbers at its vertical axis, because it shares those of the
    /// panel to its left.
    fn render(&self, page: &mut Page, panel: &Panel, scale: &Scale, label: Option<&str>) {
        panel.left_axis(page, scale, label);
        let note = Type::SMALL.color(GRAY);
        let line = if self.of.is_r2() { 0.0 } else { ZERO };
        let mut below_notes = panel.top;
        if scale.clamp(line) == line {
            let y = scale.at(line);
            page.line([panel.left, y], [panel.right(), y], Stroke::new(BLACK, 0.6).dashed());
        } else {
            let text = format!("predicting zero: {ZERO} %");
            let [x, y] = [panel.left + 3.0, panel.top + 9.0];
            page.text(&text, [x, y], note.start());
            let x = x + note.width(&text) + 5.0;
            page.arrow(&[[x, y], [x, y - 8.0]], Stroke::new(GRAY, 0.6));
            below_notes = y + 4.0;
        }
        let mut names: Vec<String> = self.latents.iter().map(usize::to_string).collect();
        names.extend(self.of.baseline.map(|(_, name)| name.to_owned()));
        let slots = panel.slots(names.len());
        let over = self.of.runs.replicates().unwrap_or_else(|| "one seed, no bars".to_owned());
        panel.bottom_names(page, &slots, &names, &format!("latent size ({over})"));
        panel.heading(page, self.of.letter, &self.of.runs.input());
        let width = panel.width / names.len() as f64;
        if self.of.baseline.is_some() {
            let x = panel.right() - width;
            page.line([x, below_notes], [x, panel.bottom()], Stroke::new(GRAY, 0.5).dashed());
        }
        for curve in &self.curves {
            let second = [curve.scenario != Scenario::PAPER[0], curve.direction != Direction::FINGER[0]];
            let place = usize::from(second[0]) * 2 + usize::from(second[1]);
            let aside = (place as f64 - 1.5) * width * 0.17;
            let look = look_of(color_of(curve.scenario), curve.direction);
            let at = |latent: &usize| slots[self.latents.binary_search(latent).unwrap_or_default()] + aside;
            let points: Vec<_> = curve
                .network
                .iter()
                .map(|(latent, value)| [at(latent), scale.at(scale.clamp(value.mean))])
                .collect();
            look.path(page, &points);
            for (latent, value) in &curve.network {
                look.point(page, at(latent), scale, value);
            }
            if let (Some(value), Some(slot)) = (&curve.baseline, slots.last()) {
                look.point(page, slot + aside, scale, value);
            }
        }
    }
}

/// Draws the legend of all curves, in two rows from `y` on.
pub fn explain(page: &mut Page, middle: f64, y: f64) {
    for (row, &scenario) in Scenario::PAPER.iter().enumerate() {
        let entries: Vec<(Look, String)> = Direction::FINGER
            .iter()
            .map(|&direction| {
                (look_of(color_of(scenario), direction), format!("{scenario}, {}", words_of(direction)))
            })
            .collect();
        let entries: Vec<(Look, &str)> =
            entries.iter().map(|(look, words)| (*look, words.as_str())).collect();
        legend(page, middle, y + 9.0 * row as f64, &entries);
    }
}

/// Draws two panels of one metric side by side, with one vertical scale. Returns whether an end of an interval lies
/// beyond the axis.
pub fn pair(page: &mut Page, [top, height]: [f64; 2], panels: [&Measured; 2], label: &str) -> bool {
    let left = Panel { left: 33.0, top, width: 97.0, height };
    let right = Panel { left: left.right() + 10.0, ..left };
    let highest = match panels[0].highest().max(panels[1].highest()) {
        _ if panels[0].of.is_r2() => PERFECT,
        // If the error of predicting zero lies far above the axis, a note about it needs room at the top.
        highest if highest < 0.75 * ZERO => highest * 1.15,
        highest => highest.max(ZERO),
    };
    let lowest = panels[0].lowest().min(panels[1].lowest());
    let scale = Scale::linear(lowest, highest, 5, left.upwards());
    panels[0].render(page, &left, &scale, Some(label));
    panels[1].render(page, &right, &scale, None);
    panels.iter().any(|panel| panel.is_cut(&scale))
}

/// Writes remarks below the panels, one per line from `y` on. The first explains the bars.
pub fn remarks(page: &mut Page, y: f64, is_cut: bool, lines: &[&str]) {
    let bars = match is_cut {
        true => "bars: 95 % intervals of the mean; what has no cap goes on beyond the axis",
        false => "bars: 95 % intervals of the mean, by Student's t",
    };
    axes::remarks(page, y, [bars].iter().chain(lines));
}

/// The rows of all panels as one table.
///
/// # Errors
/// When the panels' columns differ.
pub fn stack(panels: &[&Measured]) -> Result<DataFrame, FigureError> {
    let mut data = panels[0].data.clone();
    for panel in &panels[1..] {
        data.vstack_mut(&panel.data)?;
    }
    Ok(data)
}
