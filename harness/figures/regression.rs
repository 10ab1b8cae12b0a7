//! Predictions over references at the fingertip, in clutter.

use super::axes::{Look, Panel, Scale, legend, remark, words_of};
use super::page::{COLUMN, GREEN, GREY, Mark, Page, Stroke, Type, WINE};
use super::source::{Runs, Source, Study, integers, reals, replicated};
use super::{Drawing, FigureError};
use harness_analysis::{Interval, intervals};
use harness_metrics::Direction;
use harness_spec::{Modality, Scenario};
use polars::prelude::*;
use std::collections::BTreeMap;

/// Points that a panel shows of each direction; more would hide one another.
const POINTS: usize = 300;
const LEFT: f64 = 33.0;
const GAP: f64 = 5.0;
const SIDE: f64 = (COLUMN - LEFT - 4.0 - 2.0 * GAP) / 3.0;

fn look(direction: Direction) -> Look {
    match direction {
        Direction::FLEXION_EXTENSION => {
            Look { colour: GREEN, mark: Mark::Disc, hollow: false, dashed: false }
        }
        _ => Look { colour: WINE, mark: Mark::Square, hollow: false, dashed: false },
    }
}

/// One study's predictions of one modality.
struct Predictions {
    latents: Vec<usize>,
    /// By latent size and direction: reference and prediction.
    points: BTreeMap<(usize, Direction), Vec<[f64; 2]>>,
    r2: BTreeMap<(usize, Direction), Interval>,
    data: DataFrame,
}

pub fn draw(source: &Source) -> Result<Drawing, FigureError> {
    let [single, multi] = [source.runs(Study::SingleToMulti)?, source.runs(Study::MultiToMulti)?];
    let of = |modality, panel| -> Result<[Predictions; 2], FigureError> {
        Ok([predictions(&single, modality, panel)?, predictions(&multi, modality, panel)?])
    };
    let [angles, forces] = [of(Modality::PROPRIOCEPTION, "a")?, of(Modality::CONTACT_FORCE, "b")?];

    let mut page = Page::new(COLUMN, 397.0, "Predictions over references at the fingertip, in clutter");
    let entries = Direction::FINGER.map(|direction| (look(direction), words_of(direction)));
    legend(&mut page, COLUMN / 2.0, 8.0, &entries);
    block(&mut page, 25.0, &angles, "a", "fingertip angle", "rad");
    block(&mut page, 209.0, &forces, "b", "fingertip force", "N");
    let spread =
        if single.seeds().1.max(multi.seeds().1) > 1 { ", mean over seeds ± 95 % interval" } else { "" };
    remark(&mut page, &format!("R²: of all test samples{spread}"), [COLUMN / 2.0, 384.0]);
    remark(
        &mut page,
        "dots: test samples of one network; grey line: perfect prediction",
        [COLUMN / 2.0, 393.0],
    );
    let mut data = angles[0].data.clone();
    for more in [&angles[1], &forces[0], &forces[1]] {
        data.vstack_mut(&more.data)?;
    }
    Ok(Drawing { page, data })
}

/// Two rows of panels: from proprioception alone, and with vision.
fn block(page: &mut Page, top: f64, studies: &[Predictions; 2], letter: &str, quantity: &str, unit: &str) {
    let all = || studies.iter().flat_map(|study| study.points.values().flatten().flatten().copied());
    let (low, high) = (all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max));
    for (row, (study, kind)) in studies.iter().zip(Study::BOTH).enumerate() {
        let top = top + row as f64 * (SIDE + 14.0);
        for (column, latent) in study.latents.iter().take(3).enumerate() {
            let panel = Panel { left: LEFT + column as f64 * (SIDE + GAP), top, width: SIDE, height: SIDE };
            let (x, y) =
                (Scale::tight(low, high, 3, panel.across()), Scale::tight(low, high, 3, panel.upwards()));
            let predicted = format!("predicted ({unit})");
            panel.left_axis(page, &y, (column == 0).then_some(predicted.as_str()));
            let middle = column == (study.latents.len().min(3) - 1) / 2;
            let reference = if middle { format!("reference ({unit})") } else { String::new() };
            panel.bottom_axis(page, &x, (row == 1).then_some(reference.as_str()));
            let (from, to) = (x.clamp(f64::NEG_INFINITY), x.clamp(f64::INFINITY));
            page.line([x.at(from), y.at(from)], [x.at(to), y.at(to)], Stroke::new(GREY, 0.6));
            for (line, direction) in Direction::FINGER.into_iter().enumerate() {
                let look = look(direction);
                let Some(points) = study.points.get(&(*latent, direction)) else { continue };
                let places: Vec<_> = points.iter().map(|[r, p]| [x.at(*r), y.at(*p)]).collect();
                page.cloud(look.mark, &places, 1.3, look.colour, 0.55);
                if let Some(r2) = study.r2.get(&(*latent, direction)) {
                    let at = [panel.left + 3.0, panel.top + 7.0 + 7.5 * line as f64];
                    page.text(&r2_words(r2), at, Type::SMALL.start().colour(look.colour));
                }
            }
            page.text(
                &format!("*z* = {latent}"),
                [panel.right() - 2.0, panel.bottom() - 3.0],
                Type::SMALL.end(),
            );
            if column == 0 {
                let title =
                    if row == 0 { format!("{quantity}, {}", kind.input()) } else { kind.input().to_owned() };
                if row == 0 {
                    panel.heading(page, letter, &title);
                } else {
                    page.text(&title, [panel.left - 1.0, panel.top - 4.0], Type::LABEL.start());
                }
            }
        }
    }
}

fn r2_words(r2: &Interval) -> String {
    let spread = r2.bounds.map_or(String::new(), |(low, high)| format!(" ± {:.2}", (high - low) / 2.0));
    format!("R² {:.2}{spread}", r2.mean).replace('-', "\u{2212}")
}

fn predictions(runs: &Runs, modality: Modality, panel: &str) -> Result<Predictions, FigureError> {
    let definition = &runs.layout()[modality];
    let tips =
        Direction::FINGER.map(|direction| direction.elements(definition).last().copied().unwrap_or_default());
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
    // Evenly over the test samples, so that no episode is preferred.
    for rows in groups.values_mut() {
        let count = rows.len().min(POINTS);
        *rows = (0..count).map(|point| rows[point * rows.len() / count]).collect();
    }
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
    Ok(Predictions { latents, points, r2, data })
}
