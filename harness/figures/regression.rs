//! Figure of predictions over references: a row of panels for each vector that networks predict, and a panel for each
//! latent size. The paper's figure has the fingertip's angles and forces in clutter, for both studies.

use super::axes::{Line, Look, Panel, Scale, legend, mean_words, remarks};
use super::page::{COLUMN, GRAY, GREEN, Mark, Page, Stroke, Type, WINE};
use super::source::{Runs, Source, Study, integers, reals, replicated, texts};
use super::{Drawing, FigureError};
use harness_analysis::{Interval, intervals};
use harness_spec::{Definition, Modality, Scenario};
use polars::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// Largest number of points for each element of a panel. More points would hide each other.
const POINTS: usize = 400;
/// Largest number of panels in a row. Each shows one latent size.
const PANELS: usize = 3;
const LEFT: f64 = 36.0;
const GAP: f64 = 9.0;
/// Distance between the lines of text above a panel, points.
const LINE: f64 = 7.5;
/// Width and height of a panel, points.
const SIDE: f64 = (COLUMN - LEFT - 4.0 - 2.0 * GAP) / PANELS as f64;
/// Height of a row of panels with its legend and labels, points.
const ROW: f64 = SIDE + 58.0;
/// The part of the values at each end that may lie beyond the axes.
const RARE: f64 = 0.001;
/// The axes are logarithmic if the largest reference is this many times the median of those that are not 0.
const SKEWED: f64 = 10.0;
/// The looks of the elements of a panel.
const LOOKS: [Look; 2] = [
    Look { color: GREEN, mark: Mark::Disc, hollow: false, line: Line::Solid },
    Look { color: WINE, mark: Mark::Square, hollow: false, line: Line::Solid },
];

/// Values by latent size and element.
type ByElement<T> = BTreeMap<(i64, i64), T>;

/// Predictions of one vector in one scenario.
struct Row<'a> {
    definition: &'a Definition,
    scenario: String,
    /// The inputs of the networks, in words.
    input: String,
    /// The elements that are drawn, at most two, which have one unit.
    elements: Vec<usize>,
    latents: Vec<i64>,
    /// Pairs of reference and prediction, by latent size and element.
    points: ByElement<Vec<[f64; 2]>>,
    /// R² over all test samples, by latent size and element.
    r2: ByElement<Interval>,
}

/// Draws the paper's figure.
///
/// # Errors
/// When the studies have no predictions, or a table can't be read.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    let studies = [source.runs(Study::SingleToMulti)?, source.runs(Study::MultiToMulti)?];
    let in_clutter = format!(
        "and scenario = '{}' and modality in ('{}', '{}')",
        Scenario::CLUTTERED,
        Modality::PROPRIOCEPTION,
        Modality::CONTACT_FORCE
    );
    draw(&studies, &in_clutter)
}

/// Draws the figure of any robot.
///
/// # Errors
/// When the runs have no predictions, or a table can't be read.
pub fn render_of(runs: Runs) -> Result<Drawing, FigureError> {
    draw(&[runs], "")
}

/// Draws the predictions of some studies that meet a condition of SQL.
fn draw(studies: &[Runs], condition: &str) -> Result<Drawing, FigureError> {
    let (mut all, mut data): (Vec<Row>, Option<DataFrame>) = (Vec::new(), None);
    for runs in studies {
        let (own, more) = rows(runs, condition)?;
        all.extend(own);
        data = Some(data.map_or(Ok(more.clone()), |data| data.vstack(&more))?);
    }
    if let (true, Some(runs)) = (all.is_empty(), studies.first()) {
        return Err(runs.no_rows());
    }
    all.sort_by_key(|row| (row.scenario.clone(), row.definition.name));
    let over: BTreeSet<String> = studies.iter().filter_map(Runs::replicates).collect();
    let over = over.into_iter().collect::<Vec<_>>().join(" or ");
    let over = if over.is_empty() { over } else { format!(", mean over {over} ± 95 % interval") };
    let further = studies.iter().flat_map(|runs| &runs.all).any(|run| run.record.spec.window.horizon > 1);
    let what = if further { "predictions of the next sample" } else { "test samples of one network" };
    let mut lines = vec![
        format!("R²: of all test samples{over}"),
        format!("points: at most {POINTS} {what}, evenly chosen;"),
        "those beyond an axis are drawn at its end; gray line: perfect prediction".to_owned(),
    ];
    if all.iter().any(|row| row.axes(&all).2.is_some()) {
        lines.push(
            "where small values are frequent, axes are linear around 0 and then logarithmic".to_owned(),
        );
    }
    if all.iter().any(|row| row.latents.len() > PANELS) {
        lines.push(format!("only the {PANELS} smallest latent sizes are drawn; the CSV file has all"));
    }
    let height = ROW * all.len() as f64 + 8.5 * lines.len() as f64 + 8.0;
    let mut page = Page::new(COLUMN, height, "Predictions over references");
    for (place, row) in all.iter().enumerate() {
        let title = if studies.len() > 1 { format!(", {}", row.input) } else { String::new() };
        row.render(&mut page, 10.0 + ROW * place as f64, &title, row.axes(&all));
    }
    remarks(&mut page, height - 8.5 * lines.len() as f64 + 4.0, lines);
    Ok(Drawing { page, data: data.unwrap_or_default() })
}

/// At most [`POINTS`] of some rows, chosen evenly, so that all episodes are represented equally.
fn evenly(rows: &[usize]) -> Vec<usize> {
    let count = rows.len().min(POINTS);
    (0..count).map(|point| rows[point * rows.len() / count]).collect()
}

/// The rows of panels, and the rows of the CSV file.
fn rows<'a>(runs: &Runs<'a>, condition: &str) -> Result<(Vec<Row<'a>>, DataFrame), FigureError> {
    let all = runs.query_first_seeds(&format!(
        "select scenario, modality, latent, index, episode, sample, reference, predicted from predictions \
         where task = 'prediction' and latent is not null {condition} \
         order by scenario, modality, latent, index, episode, sample"
    ))?;
    let (scenarios, modalities) = (texts(&all, "scenario")?, texts(&all, "modality")?);
    let (latents, indices) = (integers(&all, "latent")?, integers(&all, "index")?);
    let (references, predicted) = (reals(&all, "reference")?, reals(&all, "predicted")?);
    let mut groups: BTreeMap<(&str, &str), ByElement<Vec<usize>>> = BTreeMap::new();
    for row in 0..all.height() {
        let group = groups.entry((scenarios[row].as_str(), modalities[row].as_str())).or_default();
        group.entry((latents[row], indices[row])).or_default().push(row);
    }
    let (mut rows, mut chosen, mut scores, mut units) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for ((scenario, modality), by_element) in &groups {
        let mut of_scenario = runs.all.iter().filter(|run| run.record.spec.scenario.name() == *scenario);
        let layout = of_scenario.next().map_or(runs.layout(), |run| &run.record.layout);
        // Probabilities of categories do not lie on a line, and a predicted direction has no length.
        let is_it = |other: &&Definition| other.name.name() == *modality && !other.has_own_loss();
        let Some(definition) = layout.modalities.iter().find(is_it) else { continue };
        let (elements, r2) = (ends(definition), r2(runs, scenario, modality)?);
        let mut points = BTreeMap::new();
        for (key, places) in by_element.iter().filter(|((_, index), _)| elements.contains(&(*index as usize)))
        {
            let places = evenly(places);
            let pair = |row: &usize| Some([references[*row]?, predicted[*row]?]);
            points.insert(*key, places.iter().filter_map(pair).collect::<Vec<_>>());
            scores.resize(scores.len() + places.len(), r2.get(key).copied());
            units.resize(units.len() + places.len(), definition.elements()[key.1 as usize].unit.clone());
            chosen.extend(places.into_iter().map(|row| row as IdxSize));
        }
        let mut latents: Vec<i64> = points.keys().map(|(latent, _)| *latent).collect();
        latents.dedup();
        let (scenario, input) = ((*scenario).to_owned(), runs.input());
        rows.push(Row { definition, scenario, input, elements, latents, points, r2 });
    }
    let mut data = all.take(&IdxCa::from_vec("row".into(), chosen))?;
    data.with_column(Column::new("experiment".into(), vec![runs.experiment.as_str(); data.height()]))?;
    data.with_column(Column::new("unit".into(), units))?;
    let end =
        |end: fn(&Interval) -> Option<f64>| scores.iter().map(|r2| end(r2.as_ref()?)).collect::<Vec<_>>();
    data.with_column(Column::new("r2".into(), end(|r2| Some(r2.mean))))?;
    data.with_column(Column::new("r2_low".into(), end(|r2| r2.bounds.map(|bounds| bounds.0))))?;
    data.with_column(Column::new("r2_high".into(), end(|r2| r2.bounds.map(|bounds| bounds.1))))?;
    Ok((rows, data))
}

/// The elements that are drawn: at most the last two of the elements at the ends of groups, which have one unit.
fn ends(definition: &Definition) -> Vec<usize> {
    let last = definition.last_elements();
    let last = last[last.len().saturating_sub(LOOKS.len())..].to_vec();
    let first = last.first().copied().into_iter().collect();
    if definition.unit_of(&last).is_some() { last } else { first }
}

fn r2(runs: &Runs, scenario: &str, modality: &str) -> Result<ByElement<Interval>, FigureError> {
    let rows = runs.query(&format!(
        "select latent, index, dataset_seed, value from metrics join runs using (experiment, run, scenario, latent) \
         where scenario = '{scenario}' and modality = '{modality}' and task = 'prediction' and metric = 'r2' \
         and model = 'network' and index is not null and latent is not null"
    ))?;
    let (latents, indices) = (integers(&rows, "latent")?, integers(&rows, "index")?);
    let values = replicated(&rows)?.into_iter().enumerate();
    Ok(intervals(values.map(|(row, (seed, value))| ((latents[row], indices[row]), seed, value))))
}

impl Row<'_> {
    /// The lowest and the highest value of the axes, without rare ones, and the value beyond which they are logarithmic.
    /// All rows of a modality in a scenario have the same axes.
    fn axes(&self, all: &[Row]) -> (f64, f64, Option<f64>) {
        let alike = all
            .iter()
            .filter(|row| (&row.scenario, row.definition.name) == (&self.scenario, self.definition.name));
        let points: Vec<[f64; 2]> = alike.flat_map(|row| row.points.values().flatten().copied()).collect();
        let sorted = |values: &mut dyn Iterator<Item = f64>| {
            let mut values: Vec<f64> = values.collect();
            values.sort_by(f64::total_cmp);
            values
        };
        let references = sorted(&mut points.iter().map(|point| point[0]));
        let predictions = sorted(&mut points.iter().map(|point| point[1]));
        let rare = (predictions.len() as f64 * RARE) as usize;
        let ends = |values: &[f64]| Some([*values.first()?, *values.last()?]);
        let kept = ends(predictions.get(rare..predictions.len() - rare).unwrap_or_default());
        let both = [ends(&references), kept].into_iter().flatten();
        let [low, high] = both.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]).unwrap_or_default();
        let sizes = sorted(&mut references.iter().map(|value| value.abs()).filter(|size| *size > 0.0));
        let median = sizes.get(sizes.len() / 2).copied();
        (low, high, median.filter(|median| low.abs().max(high.abs()) > SKEWED * median))
    }

    /// Draws the row below `top`. The title ends in `more`.
    fn render(&self, page: &mut Page, top: f64, more: &str, (low, high, linear): (f64, f64, Option<f64>)) {
        let name = |element: &usize| {
            let name = self.definition.elements()[*element].name.replace('_', " ");
            if name.parse::<f64>().is_ok() { format!("element {name}") } else { name }
        };
        let names: Vec<String> = self.elements.iter().map(name).collect();
        let entries: Vec<(Look, &str)> = LOOKS.into_iter().zip(names.iter().map(String::as_str)).collect();
        legend(page, COLUMN / 2.0, top + 10.0, &entries);
        let title = format!("{}, {}{more}", self.definition.name.name().replace('_', " "), self.scenario);
        page.text(&title, [LEFT, top], Type::BOLD.start());
        let unit = self.definition.unit_of(&self.elements).filter(|unit| !unit.is_empty() && *unit != "1");
        let with_unit = |word: &str| unit.map_or_else(|| word.to_owned(), |unit| format!("{word} ({unit})"));
        let margin = if high > low { 0.04 * (high - low) } else { 1.0 };
        let latents = &self.latents[..self.latents.len().min(PANELS)];
        for (column, latent) in latents.iter().enumerate() {
            let left = LEFT + column as f64 * (SIDE + GAP);
            let panel = Panel { left, top: top + 30.0, width: SIDE, height: SIDE };
            let [x, y] = [panel.across(), panel.upwards()].map(|ends| match linear {
                Some(linear) => Scale::symmetric(low, high, linear, ends),
                None => Scale::linear(low - margin, high + margin, 3, ends),
            });
            panel.left_axis(page, &y, (column == 0).then(|| with_unit("predicted")).as_deref());
            let is_middle = column == (latents.len() - 1) / 2;
            panel.bottom_axis(page, &x, is_middle.then(|| with_unit("reference")).as_deref());
            page.line([x.at(low), y.at(low)], [x.at(high), y.at(high)], Stroke::new(GRAY, 0.6));
            self.render_points(page, &panel, [&x, &y], *latent);
        }
    }

    /// Draws the points of a latent size, their R² above the panel, and the latent size in it.
    fn render_points(&self, page: &mut Page, panel: &Panel, [x, y]: [&Scale; 2], latent: i64) {
        for (line, (look, element)) in LOOKS.iter().zip(&self.elements).enumerate() {
            let key = (latent, *element as i64);
            let Some(points) = self.points.get(&key) else { continue };
            let places: Vec<_> = points.iter().map(|[r, p]| [x.at(x.clamp(*r)), y.at(y.clamp(*p))]).collect();
            page.cloud(look.mark, &places, 1.2, look.color, 0.4);
            if let Some(r2) = self.r2.get(&key) {
                let above = LINE * (self.elements.len() - 1 - line) as f64;
                let at = [panel.left + 3.0, panel.top - 3.0 - above];
                page.text(&format!("R² {}", mean_words(r2)), at, Type::SMALL.start().color(look.color));
            }
        }
        let size = format!("*z* = {latent}");
        page.text(&size, [panel.right() - 2.0, panel.bottom() - 3.0], Type::SMALL.end());
    }
}
