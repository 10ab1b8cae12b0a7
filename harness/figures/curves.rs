//! An error over the latent size, by scenario and direction: panels of two figures.

use super::FigureError;
use super::axes::{Look, Panel, Scale, colour_of, legend, look_of, remark, words_of};
use super::page::{GREY, Page, Stroke};
use super::source::{Runs, integers, replicated, texts};
use harness_analysis::{Interval, NETWORK, intervals};
use harness_metrics::{Direction, Metric};
use harness_spec::{Modality, Scenario, Task};
use polars::prelude::*;
use std::collections::BTreeSet;

/// What a panel shows.
pub struct Curves<'a> {
    pub runs: &'a Runs<'a>,
    pub task: Task,
    pub modality: Modality,
    pub metric: Metric,
    pub letter: &'static str,
    pub title: &'static str,
    /// A baseline to show beside the networks: its name in the tables, and on the axis.
    pub baseline: Option<(&'static str, &'static str)>,
}

/// One curve: the network's interval by latent size, and the baseline's value.
struct Curve {
    scenario: Scenario,
    direction: Direction,
    network: Vec<(usize, Interval)>,
    baseline: Option<Interval>,
}

/// A panel's numbers.
pub struct Measured<'a> {
    of: &'a Curves<'a>,
    latents: Vec<usize>,
    curves: Vec<Curve>,
    /// Columns of the figure's CSV.
    pub data: DataFrame,
}

impl Curves<'_> {
    /// Looks its numbers up.
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
                // A baseline has no seed and no latent size: every run repeats its value, and the first one's stands.
                let baseline = self.baseline.and_then(|(name, _)| {
                    let mean = values[*of(scenario, direction, name).first()?].1?;
                    Some(Interval { mean, bounds: None })
                });
                curves.push(Curve { scenario, direction, network, baseline });
            }
        }
        let data = self.data(&curves)?;
        Ok(Measured { of: self, latents: self.runs.latents(), curves, data })
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
            "unit" => vec!["%"; rows.len()],
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
    /// What the vertical axis must reach: every mean, and every interval that isn't far wider than the rest.
    pub fn highest(&self) -> f64 {
        let values: Vec<&Interval> = self
            .curves
            .iter()
            .flat_map(|curve| curve.network.iter().map(|(_, value)| value).chain(&curve.baseline))
            .collect();
        let mean = values.iter().map(|value| value.mean).fold(0.0, f64::max);
        values.iter().map(|value| value.high().min(mean * 1.3)).fold(mean, f64::max)
    }

    /// Draws the panel; without an axis label, its numbers stand at the panel to the left.
    pub fn draw(&self, page: &mut Page, panel: &Panel, highest: f64, label: Option<&str>) {
        let scale = Scale::linear(0.0, highest, 5, panel.upwards());
        panel.left_axis(page, &scale, label);
        let mut names: Vec<String> = self.latents.iter().map(usize::to_string).collect();
        names.extend(self.of.baseline.map(|(_, name)| name.to_owned()));
        let slots = panel.slots(names.len());
        panel.bottom_names(page, &slots, &names, "latent size");
        panel.heading(page, self.of.letter, self.of.title);
        let width = panel.width / names.len() as f64;
        if self.of.baseline.is_some() {
            let x = panel.right() - width;
            page.line([x, panel.top], [x, panel.bottom()], Stroke::new(GREY, 0.5).dashed());
        }
        for curve in &self.curves {
            let second = [curve.scenario != Scenario::PAPER[0], curve.direction != Direction::FINGER[0]];
            let place = usize::from(second[0]) * 2 + usize::from(second[1]);
            let aside = (place as f64 - 1.5) * width * 0.17;
            let look = look_of(colour_of(curve.scenario), curve.direction);
            let at = |latent: &usize| slots[self.latents.binary_search(latent).unwrap_or_default()] + aside;
            let points: Vec<_> =
                curve.network.iter().map(|(latent, value)| [at(latent), scale.at(value.mean)]).collect();
            look.path(page, &points);
            for (latent, value) in &curve.network {
                look.point(page, at(latent), &scale, value);
            }
            if let (Some(value), Some(slot)) = (&curve.baseline, slots.last()) {
                look.point(page, slot + aside, &scale, value);
            }
        }
    }
}

/// The legend of all curves, two rows from `y` on.
pub fn explain(page: &mut Page, middle: f64, y: f64) {
    for (row, &scenario) in Scenario::PAPER.iter().enumerate() {
        let entries: Vec<(Look, String)> = Direction::FINGER
            .iter()
            .map(|&direction| {
                (look_of(colour_of(scenario), direction), format!("{scenario}, {}", words_of(direction)))
            })
            .collect();
        let entries: Vec<(Look, &str)> =
            entries.iter().map(|(look, words)| (*look, words.as_str())).collect();
        legend(page, middle, y + 9.0 * row as f64, &entries);
    }
}

/// Says what the bars are.
pub fn explain_bars(page: &mut Page, middle: f64, y: f64, runs: &[&Runs], more: &str) {
    let seeds: BTreeSet<(usize, usize)> = runs.iter().map(|runs| runs.seeds()).collect();
    let words = |(fewest, most): &(usize, usize)| {
        if fewest < most { format!("{fewest} to {most}") } else { most.to_string() }
    };
    let counts: Vec<String> = seeds.iter().map(words).collect();
    let bars = if seeds.iter().all(|(_, most)| *most < 2) {
        "one seed, so no intervals".to_owned()
    } else {
        format!("bars: 95 % intervals of the mean over {} seeds", counts.join(" and "))
    };
    remark(page, &format!("{bars}{more}"), [middle, y]);
}

/// Panels' numbers one below the other.
pub fn stack(panels: &[&Measured]) -> Result<DataFrame, FigureError> {
    let mut data = panels[0].data.clone();
    for panel in &panels[1..] {
        data.vstack_mut(&panel.data)?;
    }
    Ok(data)
}
