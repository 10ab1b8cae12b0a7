//! Figure of predictions over references for any robot: a row of panels for each vector that is predicted, and a panel
//! for each latent size.

use super::axes::{Line, Look, Panel, Scale, legend, mean_words, remarks};
use super::page::{COLUMN, GRAY, GREEN, Mark, Page, Stroke, Type, WINE};
use super::source::{Runs, integers, reals, replicated, texts};
use super::{Drawing, FigureError};
use harness_analysis::{Interval, intervals};
use harness_spec::Definition;
use polars::prelude::*;
use std::collections::BTreeMap;

/// Largest number of points for each element of a panel. More points would hide each other.
pub(super) const POINTS: usize = 400;
/// Largest number of panels in a row. Each shows one latent size.
pub(super) const PANELS: usize = 3;
const LEFT: f64 = 36.0;
const GAP: f64 = 9.0;
/// Distance between the lines of text above a panel, points.
pub(super) const LINE: f64 = 7.5;
/// Width and height of a panel, points.
const SIDE: f64 = (COLUMN - LEFT - 4.0 - 2.0 * GAP) / PANELS as f64;
/// Height of a row of panels with its legend and labels, points.
const ROW: f64 = SIDE + 58.0;
/// The looks of the elements of a panel.
pub(super) const LOOKS: [Look; 2] = [
    Look { color: GREEN, mark: Mark::Disc, hollow: false, line: Line::Solid },
    Look { color: WINE, mark: Mark::Square, hollow: false, line: Line::Solid },
];

/// Values by latent size and element.
type ByElement<T> = BTreeMap<(i64, i64), T>;

/// Predictions of one vector in one scenario.
struct Row<'a> {
    definition: &'a Definition,
    scenario: String,
    /// The elements that are drawn, at most two, which have one unit.
    elements: Vec<usize>,
    latents: Vec<i64>,
    /// Pairs of reference and prediction, by latent size and element.
    points: ByElement<Vec<[f64; 2]>>,
    /// R² over all test samples, by latent size and element.
    r2: ByElement<Interval>,
}

/// The points of an element in a panel, as reference and prediction, and their R².
pub(super) struct Cloud<'a> {
    pub points: &'a [[f64; 2]],
    pub r2: Option<&'a Interval>,
}

/// Draws the points of a panel's elements in the looks of [`LOOKS`], their R² above the panel, and the latent size in
/// it. An element without points keeps its look and its line of text. A point beyond an axis is drawn at its end.
pub(super) fn draw(
    page: &mut Page,
    panel: &Panel,
    [x, y]: [&Scale; 2],
    clouds: &[Option<Cloud>],
    latent: i64,
) {
    for (line, (look, cloud)) in LOOKS.iter().zip(clouds).enumerate() {
        let Some(Cloud { points, r2 }) = cloud else { continue };
        let places: Vec<_> = points.iter().map(|[r, p]| [x.at(x.clamp(*r)), y.at(y.clamp(*p))]).collect();
        page.cloud(look.mark, &places, 1.2, look.color, 0.4);
        if let Some(r2) = r2 {
            let at = [panel.left + 3.0, panel.top - 3.0 - LINE * (clouds.len() - 1 - line) as f64];
            page.text(&format!("R² {}", mean_words(r2)), at, Type::SMALL.start().color(look.color));
        }
    }
    let size = format!("*z* = {latent}");
    page.text(&size, [panel.right() - 2.0, panel.bottom() - 3.0], Type::SMALL.end());
}

/// Returns at most [`POINTS`] of some rows, chosen evenly, so that all episodes are represented equally.
pub(super) fn evenly(rows: &[usize]) -> Vec<usize> {
    let count = rows.len().min(POINTS);
    (0..count).map(|point| rows[point * rows.len() / count]).collect()
}

/// Draws the figure.
///
/// # Errors
/// When the runs have no predictions, or a table can't be read.
pub fn render(runs: &Runs) -> Result<Drawing, FigureError> {
    let (rows, data) = rows(runs)?;
    let height = ROW * rows.len() as f64 + 30.0;
    let mut page = Page::new(COLUMN, height, "Predictions over references");
    for (place, row) in rows.iter().enumerate() {
        row.render(&mut page, 10.0 + ROW * place as f64);
    }
    let over = runs.replicates().map(|over| format!(", mean over {over} ± 95 % interval"));
    let further = runs.all.iter().any(|run| run.record.spec.window.horizon > 1);
    let what = if further { "predictions of the next sample" } else { "test samples of one network" };
    let mut lines = vec![
        format!("R²: of all test samples{}; gray line: perfect prediction", over.unwrap_or_default()),
        format!("points: at most {POINTS} {what}, evenly chosen"),
    ];
    if rows.iter().any(|row| row.latents.len() > PANELS) {
        lines.push(format!("only the {PANELS} smallest latent sizes are drawn; the CSV file has all"));
    }
    remarks(&mut page, height - 8.5 * lines.len() as f64 + 4.0, lines);
    Ok(Drawing { page, data })
}

/// The rows of panels, and the rows of the CSV file.
fn rows<'a>(runs: &Runs<'a>) -> Result<(Vec<Row<'a>>, DataFrame), FigureError> {
    let all = runs.query_first_seeds(
        "select scenario, modality, latent, index, episode, sample, reference, predicted from predictions \
         where task = 'prediction' and latent is not null \
         order by scenario, modality, latent, index, episode, sample",
    )?;
    let (scenarios, modalities) = (texts(&all, "scenario")?, texts(&all, "modality")?);
    let (latents, indices) = (integers(&all, "latent")?, integers(&all, "index")?);
    let (references, predicted) = (reals(&all, "reference")?, reals(&all, "predicted")?);
    let mut groups: BTreeMap<(&str, &str), ByElement<Vec<usize>>> = BTreeMap::new();
    for row in 0..all.height() {
        let group = groups.entry((scenarios[row].as_str(), modalities[row].as_str())).or_default();
        group.entry((latents[row], indices[row])).or_default().push(row);
    }
    let (mut rows, mut chosen) = (Vec::new(), Vec::new());
    for ((scenario, modality), by_element) in &groups {
        let mut of_scenario = runs.all.iter().filter(|run| run.record.spec.scenario.name() == *scenario);
        let layout = of_scenario.next().map_or(runs.layout(), |run| &run.record.layout);
        let Some(definition) = layout.modalities.iter().find(|other| other.name.name() == *modality) else {
            continue;
        };
        let elements = ends(definition);
        let mut points = BTreeMap::new();
        for (key, places) in by_element.iter().filter(|((_, index), _)| elements.contains(&(*index as usize)))
        {
            let places = evenly(places);
            let pair = |row: &usize| Some([references[*row]?, predicted[*row]?]);
            points.insert(*key, places.iter().filter_map(pair).collect::<Vec<_>>());
            chosen.extend(places.into_iter().map(|row| row as IdxSize));
        }
        let mut latents: Vec<i64> = points.keys().map(|(latent, _)| *latent).collect();
        latents.dedup();
        let r2 = r2(runs, scenario, modality)?;
        rows.push(Row { definition, scenario: (*scenario).to_owned(), elements, latents, points, r2 });
    }
    let mut data = all.take(&IdxCa::from_vec("row".into(), chosen))?;
    data.with_column(Column::new("experiment".into(), vec![runs.experiment.as_str(); data.height()]))?;
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
    fn render(&self, page: &mut Page, top: f64) {
        let name = |element: &usize| self.definition.elements()[*element].name.replace('_', " ");
        let names: Vec<String> = self.elements.iter().map(name).collect();
        let entries: Vec<(Look, &str)> = LOOKS.into_iter().zip(names.iter().map(String::as_str)).collect();
        legend(page, COLUMN / 2.0, top + 10.0, &entries);
        let title = format!("{}, {}", self.definition.name.name().replace('_', " "), self.scenario);
        page.text(&title, [LEFT, top], Type::BOLD.start());
        let unit = self.definition.unit_of(&self.elements).filter(|unit| !unit.is_empty() && *unit != "1");
        let with_unit = |word: &str| unit.map_or_else(|| word.to_owned(), |unit| format!("{word} ({unit})"));
        let values = || self.points.values().flatten().flatten().copied();
        let (low, high) = (values().fold(f64::MAX, f64::min), values().fold(f64::MIN, f64::max));
        let margin = if high > low { 0.04 * (high - low) } else { 1.0 };
        let latents = &self.latents[..self.latents.len().min(PANELS)];
        for (column, latent) in latents.iter().enumerate() {
            let left = LEFT + column as f64 * (SIDE + GAP);
            let panel = Panel { left, top: top + 30.0, width: SIDE, height: SIDE };
            let [x, y] = [panel.across(), panel.upwards()]
                .map(|ends| Scale::linear(low - margin, high + margin, 3, ends));
            panel.left_axis(page, &y, (column == 0).then(|| with_unit("predicted")).as_deref());
            let is_middle = column == (latents.len() - 1) / 2;
            panel.bottom_axis(page, &x, is_middle.then(|| with_unit("reference")).as_deref());
            page.line([x.at(low), y.at(low)], [x.at(high), y.at(high)], Stroke::new(GRAY, 0.6));
            let clouds = self.elements.iter().map(|element| {
                let key = (*latent, *element as i64);
                Some(Cloud { points: self.points.get(&key)?, r2: self.r2.get(&key) })
            });
            draw(page, &panel, [&x, &y], &clouds.collect::<Vec<_>>(), *latent);
        }
    }
}
