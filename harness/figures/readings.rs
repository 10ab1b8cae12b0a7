//! Figure of the gain by vision under each reading of the paper: a specification curve.

use super::axes::{Line, Look, Panel, Scale, color_of, remark};
use super::page::{BLACK, COLUMN, GRAY, Mark, PALE, Page, Stroke, Type};
use super::source::{Source, Study, dataset_seeds, reals, texts};
use super::{Drawing, FigureError};
use harness_analysis::{Interval, interval};
use harness_spec::{Modality, Reading, Scenario};
use polars::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

const LEFT: f64 = 56.0;
const WIDTH: f64 = 86.0;
const BETWEEN: f64 = 12.0;
const HEIGHT: f64 = 62.0;
/// Height of a row of the matrix below a panel, points.
const ROW: f64 = 7.6;

/// The modality of each row of panels, with the label of its vertical axis.
const QUANTITIES: [(Modality, &str); 2] =
    [(Modality::CONTACT_FORCE, "gain in R2, force"), (Modality::PROPRIOCEPTION, "gain in R2, angles")];

/// The gain by vision under one reading: R² with vision minus R² without.
struct Gain {
    modality: Modality,
    scenario: Scenario,
    reading: String,
    datasets: usize,
    value: Interval,
}

/// Draws the figure.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    let gains = gains(source)?;
    let readings = readings(&gains);
    let matrix = ROW * readings.len() as f64;
    let block = HEIGHT + matrix + 34.0;
    let mut page = Page::new(COLUMN, 2.0 * block + 26.0, "Gain by vision under each reading of the paper");
    let mut is_cut = false;
    for (row, (modality, label)) in QUANTITIES.into_iter().enumerate() {
        let of_row: Vec<&Gain> = gains.iter().filter(|gain| gain.modality == modality).collect();
        let ends = |of: fn(f64, f64) -> f64, end: fn(&Interval) -> f64| {
            of_row.iter().map(|gain| within(&of_row, end(&gain.value))).fold(0.0, of)
        };
        let (low, high) = (ends(f64::min, Interval::low), ends(f64::max, Interval::high));
        for (column, scenario) in Scenario::PAPER.into_iter().enumerate() {
            let left = LEFT + column as f64 * (WIDTH + BETWEEN);
            let panel = Panel { left, top: 16.0 + row as f64 * block, width: WIDTH, height: HEIGHT };
            let scale = Scale::linear(low, high, 5, panel.upwards());
            is_cut |= of_row.iter().any(|gain| scale.cuts(&gain.value));
            panel.left_axis(&mut page, &scale, (column == 0).then_some(label));
            panel.heading(&mut page, ["a", "b", "c", "d"][2 * row + column], scenario.name());
            let zero = scale.at(0.0);
            page.line([panel.left, zero], [panel.right(), zero], Stroke::new(BLACK, 0.7));
            let mut own: Vec<&Gain> =
                of_row.iter().copied().filter(|gain| gain.scenario == scenario).collect();
            own.sort_by(|a, b| a.value.mean.total_cmp(&b.value.mean));
            let slots = panel.slots(own.len());
            for (gain, x) in own.iter().zip(&slots) {
                let decided = gain.value.bounds.is_some_and(|(low, high)| low > 0.0 || high < 0.0);
                let look =
                    Look { color: color_of(scenario), mark: Mark::Disc, hollow: !decided, line: Line::None };
                look.point(&mut page, *x, &scale, &gain.value);
            }
            choices(&mut page, &panel, &readings, &own, &slots, column == 0);
        }
    }
    let datasets: BTreeSet<usize> = gains.iter().map(|gain| gain.datasets).collect();
    let counts: Vec<String> = datasets.iter().map(usize::to_string).collect();
    let bars = match datasets.last() {
        Some(1) | None => "bars: 95 % intervals over the seeds of one dataset".to_owned(),
        _ => format!("bars: 95 % intervals over {} datasets", counts.join(" or ")),
    };
    let bottom = 2.0 * block + 12.0;
    remark(&mut page, &format!("{bars}; filled: not around 0"), [COLUMN / 2.0, bottom]);
    if is_cut {
        remark(&mut page, "bars without a cap go on beyond the axis", [COLUMN / 2.0, bottom + 8.5]);
    }
    Ok(Drawing { page, data: data(&gains)? })
}

/// Limits a value to the range of an axis. The range includes every mean, and a margin beyond the means for intervals.
fn within(gains: &[&Gain], value: f64) -> f64 {
    let means = || gains.iter().map(|gain| gain.value.mean);
    let (low, high) = (means().fold(0.0, f64::min), means().fold(0.0, f64::max));
    let margin = 0.75 * (high - low).max(0.02);
    value.clamp(low - margin, high + margin)
}

/// Draws the matrix below a panel. It has a row for each reading, with a large dot below the reading's point.
fn choices(page: &mut Page, panel: &Panel, readings: &[String], gains: &[&Gain], slots: &[f64], named: bool) {
    for (row, reading) in readings.iter().enumerate() {
        let y = panel.bottom() + 7.0 + ROW * row as f64;
        if row % 2 == 0 {
            page.rectangle([panel.left, y - ROW / 2.0], [panel.width, ROW], 0.0, PALE, None);
        }
        if named {
            let name = reading.replace('_', " ");
            page.text(&name, [panel.left - 3.0, y + 2.1], Type::SMALL.end());
        }
        for (gain, x) in gains.iter().zip(slots) {
            let is_own = gain.reading == *reading;
            let (radius, color) = if is_own { (2.0, BLACK) } else { (0.7, GRAY) };
            page.mark(Mark::Disc, [*x, y], radius, color, false);
        }
    }
}

/// The names of the readings, the base first.
fn readings(gains: &[Gain]) -> Vec<String> {
    let names: BTreeSet<&String> = gains.iter().map(|gain| &gain.reading).collect();
    let (base, others): (Vec<&String>, Vec<&String>) =
        names.into_iter().partition(|name| *name == Reading::BASE);
    base.into_iter().chain(others).cloned().collect()
}

/// The gains by vision. A gain is the R² with vision minus the R² without, on the same dataset and with the same seed.
/// Each R² is that of the best latent size.
fn gains(source: &Source) -> Result<Vec<Gain>, FigureError> {
    let [single, multi] = [Study::SingleToMulti, Study::MultiToMulti].map(Study::name);
    let rows = source.query_readings(&format!(
        "with best as (
           select reading, role, dataset_seed, metrics.scenario as scenario, metrics.seed as seed, modality,
                  max(value) as r2
           from metrics join runs on metrics.run = runs.run
           where task = 'prediction' and model = 'network' and metric = 'r2' and direction is null and index is null
             and modality in ('contact_force', 'proprioception')
           group by reading, role, dataset_seed, metrics.scenario, metrics.seed, modality
         )
         select reading, scenario, dataset_seed, seed, modality,
                max(case when role = '{multi}' then r2 end) - max(case when role = '{single}' then r2 end) as gain
         from best
         group by reading, scenario, dataset_seed, seed, modality
         having count(r2) = 2
         order by modality, scenario, reading, dataset_seed, seed"
    ))?;
    let (names, scenarios, modalities) =
        (texts(&rows, "reading")?, texts(&rows, "scenario")?, texts(&rows, "modality")?);
    let (datasets, values) = (dataset_seeds(&rows)?, reals(&rows, "gain")?);
    let mut gains = Vec::new();
    for (modality, _) in QUANTITIES {
        for scenario in Scenario::PAPER {
            let mut by_reading: BTreeMap<&str, Vec<(u64, f64)>> = BTreeMap::new();
            for row in 0..rows.height() {
                if modalities[row] == modality.name() && scenarios[row] == scenario.name() {
                    let value = values[row].map(|value| (datasets[row], value));
                    by_reading.entry(&names[row]).or_default().extend(value);
                }
            }
            for (reading, values) in by_reading {
                let datasets = values.iter().map(|(dataset, _)| dataset).collect::<BTreeSet<_>>().len();
                let Some(value) = interval(values) else { continue };
                gains.push(Gain { modality, scenario, reading: reading.to_owned(), datasets, value });
            }
        }
    }
    Ok(gains)
}

fn data(gains: &[Gain]) -> Result<DataFrame, FigureError> {
    let bounds = |end: fn((f64, f64)) -> f64| gains.iter().map(move |gain| gain.value.bounds.map(end));
    Ok(df!(
        "modality" => gains.iter().map(|gain| gain.modality.name()).collect::<Vec<_>>(),
        "metric" => vec!["r2"; gains.len()],
        "scenario" => gains.iter().map(|gain| gain.scenario.name()).collect::<Vec<_>>(),
        "reading" => gains.iter().map(|gain| gain.reading.as_str()).collect::<Vec<_>>(),
        "datasets" => gains.iter().map(|gain| gain.datasets as u32).collect::<Vec<_>>(),
        "mean" => gains.iter().map(|gain| gain.value.mean).collect::<Vec<_>>(),
        "low" => bounds(|(low, _)| low).collect::<Vec<_>>(),
        "high" => bounds(|(_, high)| high).collect::<Vec<_>>(),
    )?)
}
