//! Figure of predictions over references at the fingertip, in the cluttered scenario.

use super::axes::{Panel, Scale, legend, remarks, words_of};
use super::clouds::{Cloud, LINE, LOOKS, PANELS, POINTS, draw, evenly};
use super::page::{COLUMN, GRAY, Page, Stroke, Type};
use super::source::{Runs, Source, Study, integers, reals, replicated};
use super::{Drawing, FigureError};
use harness_analysis::{Interval, intervals};
use harness_metrics::Direction;
use harness_spec::{Modality, Scenario};
use polars::prelude::*;
use std::collections::BTreeMap;

/// The axes of angles are about linear up to this angle and logarithmic beyond, so that they show the many small values
/// as well as the few large ones.
const LINEAR_RAD: f64 = 0.003;
/// The same limit for the axes of forces.
const LINEAR_N: f64 = 3.0;
/// The part of the predictions at each end that may lie beyond the vertical axis.
const RARE: f64 = 0.002;
const LEFT: f64 = 33.0;
const GAP: f64 = 5.0;
/// Width and height of a panel, points.
const SIDE: f64 = (COLUMN - LEFT - 4.0 - 2.0 * GAP) / PANELS as f64;

/// One study's predictions of one modality.
struct Predictions {
    /// The inputs of the networks, in words.
    input: String,
    latents: Vec<usize>,
    /// Pairs of reference and prediction, by latent size and direction.
    points: BTreeMap<(usize, Direction), Vec<[f64; 2]>>,
    /// R² over all test samples, by latent size and direction.
    r2: BTreeMap<(usize, Direction), Interval>,
    /// The figure's CSV rows of these predictions.
    data: DataFrame,
}

/// Draws the figure.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    let [single, multi] = [source.runs(Study::SingleToMulti)?, source.runs(Study::MultiToMulti)?];
    let of = |modality, panel| -> Result<[Predictions; 2], FigureError> {
        Ok([predictions(&single, modality, panel)?, predictions(&multi, modality, panel)?])
    };
    let [angles, forces] = [of(Modality::PROPRIOCEPTION, "a")?, of(Modality::CONTACT_FORCE, "b")?];

    let leaves_out = angles.iter().any(|study| study.latents.len() > PANELS);
    let height = if leaves_out { 501.0 } else { 492.5 };
    let mut page = Page::new(COLUMN, height, "Predictions over references at the fingertip, in clutter");
    let tips = tips(&single);
    let axes = Direction::FINGER.map(words_of);
    let joints = [0, 1].map(|place| format!("joint {}, {}", tips[place], axes[place]));
    let tip = |link: usize| if Some(link) == tips.into_iter().max() { ", the tip" } else { "" };
    let links = tips.map(|link| format!("link {link}{}", tip(link)));
    let a = Block { letter: "a", quantity: "angle", unit: "rad", linear: LINEAR_RAD, names: joints };
    a.render(&mut page, 8.0, &angles);
    let b = Block { letter: "b", quantity: "force", unit: "N", linear: LINEAR_N, names: links };
    b.render(&mut page, 232.0, &forces);
    let spread = match [single.replicates(), multi.replicates()] {
        [Some(a), Some(b)] if a == b => format!(", mean over {a} ± 95 % interval"),
        [Some(a), Some(b)] => format!(", mean over {a} (above) and {b} (below) ± 95 %"),
        _ => String::new(),
    };
    let mut lines = vec![
        format!("R²: of all test samples{spread}"),
        format!("dots: at most {POINTS} test samples of one network, evenly chosen; denser:"),
        "several on one spot; grey line: perfect prediction; axes: linear".to_owned(),
        format!("around 0, logarithmic beyond about {LINEAR_RAD} rad and {LINEAR_N} N;"),
        "predictions beyond the axis are drawn at its end".to_owned(),
    ];
    if leaves_out {
        lines.push(format!("only the {PANELS} smallest latent sizes are drawn; the CSV file has all"));
    }
    remarks(&mut page, 454.0, lines);
    let mut data = angles[0].data.clone();
    for more in [&angles[1], &forces[0], &forces[1]] {
        data.vstack_mut(&more.data)?;
    }
    Ok(Drawing { page, data })
}

/// Two rows of panels that show one quantity.
struct Block {
    letter: &'static str,
    quantity: &'static str,
    unit: &'static str,
    /// The value up to which the axes are about linear.
    linear: f64,
    /// The names of the two directions' marks in the legend.
    names: [String; 2],
}

impl Block {
    /// Draws a legend and two rows of panels: predictions without vision, and predictions with vision.
    fn render(&self, page: &mut Page, top: f64, studies: &[Predictions; 2]) {
        let entries = [0, 1].map(|place| (LOOKS[place], self.names[place].as_str()));
        legend(page, COLUMN / 2.0, top, &entries);
        for (row, study) in studies.iter().enumerate() {
            let panel = Panel { left: LEFT, top: top + 33.0, width: SIDE, height: SIDE };
            let panel = Panel { top: panel.top + row as f64 * (SIDE + 30.0), ..panel };
            let above = Panel { top: panel.top - 2.0 * LINE, width: COLUMN - panel.left - 4.0, ..panel };
            if row == 0 {
                above.heading(
                    page,
                    self.letter,
                    &format!("fingertip {} in clutter, {}", self.quantity, study.input),
                );
            } else {
                page.text(&study.input, [panel.left - 1.0, above.top - 4.5], Type::LABEL.start());
            }
            let latents = &study.latents[..study.latents.len().min(PANELS)];
            for (column, latent) in latents.iter().enumerate() {
                let panel = Panel { left: LEFT + column as f64 * (SIDE + GAP), ..panel };
                let (first, middle) = (column == 0, column == (latents.len() - 1) / 2);
                let [x, y] = self.scales(&panel, studies);
                let predicted = format!("predicted ({})", self.unit);
                panel.left_axis(page, &y, first.then_some(predicted.as_str()));
                let reference = if middle { format!("reference ({})", self.unit) } else { String::new() };
                panel.bottom_axis(page, &x, (row == 1).then_some(reference.as_str()));
                study.render(page, &panel, *latent, [&x, &y]);
            }
        }
    }

    /// The horizontal and the vertical axis of all panels. They include all references, and all predictions but the
    /// [`RARE`] part at each end.
    fn scales(&self, panel: &Panel, studies: &[Predictions; 2]) -> [Scale; 2] {
        let values = |axis: usize| {
            let points = studies.iter().flat_map(|study| study.points.values().flatten());
            let mut values: Vec<f64> = points.map(|at| at[axis]).collect();
            values.sort_by(f64::total_cmp);
            values
        };
        let (references, predictions) = (values(0), values(1));
        let ends = |values: &[f64], rare: f64| {
            let left_out = (values.len() as f64 * rare) as usize;
            let kept = values.get(left_out..values.len() - left_out).unwrap_or_default();
            (kept.iter().copied().fold(0.0, f64::min), kept.iter().copied().fold(0.0, f64::max))
        };
        let (low, high) = ends(&references, 0.0);
        let (low_predicted, high_predicted) = ends(&predictions, RARE);
        [
            Scale::symmetric(low, high, self.linear, panel.across()),
            Scale::symmetric(low_predicted.min(low), high_predicted.max(high), self.linear, panel.upwards()),
        ]
    }
}

impl Predictions {
    /// Draws a latent size's points, the line of perfect predictions behind them, and R² above the panel.
    fn render(&self, page: &mut Page, panel: &Panel, latent: usize, [x, y]: [&Scale; 2]) {
        let ([left, right], [bottom, top]) = (x.range(), y.range());
        let perfect = [left.max(bottom), right.min(top)].map(|value| [x.at(value), y.at(value)]);
        page.line(perfect[0], perfect[1], Stroke::new(GRAY, 0.6));
        let clouds = Direction::FINGER.map(|direction| {
            let key = (latent, direction);
            Some(Cloud { points: self.points.get(&key)?, r2: self.r2.get(&key) })
        });
        draw(page, panel, [x, y], &clouds, latent as i64);
    }
}

/// For each direction, the index of the last joint, which is also the index of the link that it turns.
fn tips(runs: &Runs) -> [usize; 2] {
    let definition = &runs.layout()[Modality::PROPRIOCEPTION];
    Direction::FINGER.map(|direction| direction.elements(definition).last().copied().unwrap_or_default())
}

fn predictions(runs: &Runs, modality: Modality, panel: &str) -> Result<Predictions, FigureError> {
    let tips = tips(runs);
    let place = format!(
        "scenario = '{}' and task = 'prediction' and modality = '{modality}' and index in ({}, {})",
        Scenario::CLUTTERED,
        tips[0],
        tips[1]
    );
    let rows = runs.query(&format!(
        "select latent, index, dataset_seed, value from metrics join runs using (experiment, run, scenario, latent) \
         where {place} and metric = 'r2' and model = 'network'"
    ))?;
    let direction = |index: i64| Direction::FINGER[usize::from(index as usize == tips[1])];
    let key = |latent: i64, index: i64| (latent as usize, direction(index));
    let (latents, links) = (integers(&rows, "latent")?, integers(&rows, "index")?);
    let values = replicated(&rows)?.into_iter().enumerate();
    let r2 = intervals(values.map(|(row, (seed, value))| (key(latents[row], links[row]), seed, value)));

    let rows = runs.query_first_seeds(&format!(
        "select latent, index, episode, sample, reference, predicted from predictions \
         where {place} order by latent, index, episode, sample"
    ))?;
    let mut groups: BTreeMap<(usize, Direction), Vec<usize>> = BTreeMap::new();
    let (latents, links) = (integers(&rows, "latent")?, integers(&rows, "index")?);
    for row in 0..rows.height() {
        groups.entry(key(latents[row], links[row])).or_default().push(row);
    }
    groups.values_mut().for_each(|rows| *rows = evenly(rows));
    let (references, predicted) = (reals(&rows, "reference")?, reals(&rows, "predicted")?);
    let pair = |row: &usize| Some([references[*row]?, predicted[*row]?]);
    let points = groups.iter().map(|(key, rows)| (*key, rows.iter().filter_map(pair).collect())).collect();

    let chosen: Vec<u32> = groups.values().flatten().map(|row| *row as u32).collect();
    let mut data = rows.take(&IdxCa::from_vec("row".into(), chosen))?;
    let count = data.height();
    let interval = |row: usize| {
        let rows = (data.column("latent"), data.column("index"));
        let (latent, index) = (
            rows.0.ok()?.get(row).ok()?.try_extract::<i64>().ok()?,
            rows.1.ok()?.get(row).ok()?.try_extract::<i64>().ok()?,
        );
        r2.get(&key(latent, index)).copied()
    };
    let found: Vec<Option<Interval>> = (0..count).map(interval).collect();
    let of = |value: fn(&Interval) -> Option<f64>| {
        found.iter().map(|found| found.as_ref().and_then(value)).collect::<Vec<_>>()
    };
    let directions: Vec<&str> =
        groups.iter().flat_map(|((_, direction), rows)| vec![direction.name(); rows.len()]).collect();
    let unit = if modality == Modality::PROPRIOCEPTION { "rad" } else { "N" };
    let more = [
        Column::new("r2".into(), of(|r2| Some(r2.mean))),
        Column::new("r2_low".into(), of(|r2| r2.bounds.map(|bounds| bounds.0))),
        Column::new("r2_high".into(), of(|r2| r2.bounds.map(|bounds| bounds.1))),
        Column::new("direction".into(), directions),
        Column::new("panel".into(), vec![panel; count]),
        Column::new("experiment".into(), vec![runs.experiment.as_str(); count]),
        Column::new("modality".into(), vec![modality.name(); count]),
        Column::new("unit".into(), vec![unit; count]),
    ];
    for column in more {
        data.with_column(column)?;
    }
    let data = data.select([
        "panel",
        "experiment",
        "modality",
        "unit",
        "latent",
        "direction",
        "index",
        "episode",
        "sample",
        "reference",
        "predicted",
        "r2",
        "r2_low",
        "r2_high",
    ])?;
    let mut latents: Vec<usize> = groups.keys().map(|(latent, _)| *latent).collect();
    latents.dedup();
    Ok(Predictions { input: runs.input(), latents, points, r2, data })
}
