//! Figure of the error and the skill of predictions over the horizon, for any robot: a column of panels for each
//! scenario, and a row for each of both metrics.

use super::axes::{Look, Panel, Scale, legend, remarks};
use super::page::{COLUMN, GRAY, Page, Stroke};
use super::plot::{MOST_PANELS, MOST_SERIES, Plot, Values, draw, notes, plain, range, rows_of, values};
use super::source::{Source, no_runs};
use super::{Drawing, FigureError};
use harness_analysis::{Key, Label, Labels, Mean, Question, models};
use harness_metrics::Metric;
use harness_spec::{Modality, Task};
use polars::prelude::*;
use std::collections::BTreeSet;

/// Height of a panel, points.
const HEIGHT: f64 = 96.0;
/// Space below a panel of the upper and the lower row, points.
const BELOW: [f64; 2] = [18.0, 26.0];
const LEFT: f64 = 36.0;
/// Space between the columns of panels, points.
const GAP: f64 = 12.0;
/// Space between the edges of a panel and the first and the last horizon, points.
const MARGIN: f64 = 9.0;
/// Part of the least distance between two horizons over which the points of a horizon are spread.
const SPREAD: f64 = 0.5;

/// Draws the figure.
///
/// # Errors
/// When there are no runs, they predict only the next sample or not the modality, there are too many panels, or a table
/// can't be read.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    let (analysis, experiment) = (source.analysis, source.experiments.horizons.as_str());
    if analysis.runs(experiment).is_empty() {
        return Err(no_runs(analysis, experiment));
    }
    let names =
        |metrics: &[Metric]| metrics.iter().map(|metric| metric.name().to_owned()).collect::<Vec<_>>();
    let question = Question {
        experiments: vec![experiment.to_owned()],
        task: Some(Task::Prediction),
        of: source.modality.iter().cloned().collect(),
        metrics: names(&[Metric::R2, Metric::RelativeError, Metric::Skill]),
        models: models::ALL.map(str::to_owned).to_vec(),
        by: vec![Key::Horizon],
        ..Question::default()
    };
    let answer = question.answer(analysis)?;
    let horizons: BTreeSet<usize> = answer.cells.iter().filter_map(|cell| cell.of.horizon).collect();
    if horizons.len() < 2 {
        return Err(FigureError::NothingToDraw(format!(
            "the runs of {experiment} predict only the next sample; runs with another `window.horizon` predict more"
        )));
    }
    let there: BTreeSet<String> = answer.cells.iter().map(|cell| cell.of.predicted()).collect();
    let force = Modality::CONTACT_FORCE.name();
    let usual = there.iter().find(|name| *name == force).or(there.first()).map_or(force, String::as_str);
    let modality = source.modality.as_deref().unwrap_or(usual);
    let shown: Vec<Mean> = answer.cells.iter().filter(|cell| cell.of.is_of(modality)).cloned().collect();
    let is_vector = shown.iter().any(|mean| mean.of.metric == Metric::R2.name());
    let error = if is_vector { Metric::R2 } else { Metric::RelativeError };
    let labels = &answer.labels;
    let differ = |key: &Key| values(*key, &shown, labels).len() > 1;
    let by: Vec<Key> = [Key::Latent, Key::Variant, Key::Settings].into_iter().filter(differ).collect();
    let horizons: Vec<usize> = horizons.into_iter().collect();
    let seconds = analysis.sample_rate_hz().map(|rate| 1.0 / rate);
    let draw = |left_out: &[&str]| {
        let rows = [error, Metric::Skill].map(|metric| {
            let question = Question { metrics: names(&[metric]), by: by.clone(), ..question.clone() };
            let is_of_row =
                |mean: &&Mean| mean.of.metric == metric.name() && !left_out.contains(&mean.of.model.as_str());
            let means = shown.iter().filter(is_of_row).cloned().collect();
            Row { plot: Plot::new(question, Key::Horizon, Some(Key::Scenario)), means }
        });
        draw_rows(&rows, left_out, labels, &horizons, seconds)
    };
    let mut drawn = draw(&[]);
    for count in 1..=OPTIONAL.len() {
        if matches!(drawn, Err(FigureError::TooMany { .. })) {
            drawn = draw(&OPTIONAL[..count]);
        }
    }
    drawn
}

/// A row of panels, which shows one metric.
struct Row {
    plot: Plot,
    means: Vec<Mean>,
}

/// The baselines that are left out of a figure with too many series, one after the other. After them, the last networks
/// are. Each input has its own ridge regression. The other baselines have one line each. That of the training mean says
/// least, because it is at an R² of about 0.
const OPTIONAL: [&str; 2] = [models::RIDGE, models::TRAINING_MEAN];

/// Draws the rows, without the models that were left out. `horizons` are in samples, of which each takes `seconds`, if
/// that is known.
fn draw_rows(
    rows: &[Row; 2],
    left_out: &[&str],
    labels: &Labels,
    horizons: &[usize],
    seconds: Option<f64>,
) -> Result<Drawing, FigureError> {
    let [errors, skills] = rows;
    let panels = values(Key::Scenario, &errors.means, labels);
    let slots = values(Key::Horizon, &errors.means, labels);
    errors.plot.check(&errors.means, labels).map_err(FigureError::of_figure)?;
    let mut all = [errors, skills].map(|row| row.plot.series(&row.means, &panels, &slots, labels));
    let networks = all[0].iter().filter(|one| one.is_network).count();
    let surplus = all[0].len().saturating_sub(MOST_SERIES);
    let most = if left_out == OPTIONAL { networks } else { 0 };
    if surplus > most || 2 * panels.len() > MOST_PANELS {
        return Err(FigureError::TooMany { series: all[0].len(), panels: 2 * panels.len() });
    }
    for series in &mut all {
        series.drain(networks - surplus..networks);
    }
    let entries: Vec<(Look, &str)> = all[0].iter().map(|one| (one.look, one.name.as_str())).collect();
    let legends = rows_of(&entries);
    let scales = rows.each_ref().map(|row| {
        let [low, high] = range(&row.means);
        // The skill of persistence is 0. The skill and R² of a perfect prediction are 1.
        let is_skill = row.plot.y() == Metric::Skill.name();
        let low = if is_skill { low.min(0.0) } else { low };
        let high = if is_skill || row.plot.y() == Metric::R2.name() { high.clamp(0.0, 1.0) } else { high };
        move |ends| Scale::linear(low, high, 5, ends)
    });
    let time = |horizon: usize| seconds.map_or(horizon as f64, |seconds| horizon as f64 * seconds);
    let names: Vec<String> = horizons.iter().map(|horizon| short(time(*horizon))).collect();
    let unit = if seconds.is_some() { "s" } else { "samples" };
    let named: Values = names.iter().map(|name| Label::from(format!("{name} {unit}"))).collect();
    let beyond =
        |place: usize| rows[place].plot.beyond(&all[place], &panels, &named, &scales[place]([0.0, 1.0]));
    let persistence =
        "skill: 1 \u{2212} squared error / that of persistence; gray line: persistence".to_owned();
    let cut = (surplus > 0).then(|| format!("{surplus} of {networks} networks"));
    let absent: Vec<String> = left_out.iter().map(|model| model.replace('_', " ")).chain(cut).collect();
    let missing = (!absent.is_empty())
        .then(|| format!("not shown, because of more than {MOST_SERIES} series: {}", absent.join(", ")));
    let noted = notes(&errors.means, &[beyond(0), beyond(1)].concat(), &scales[0]([0.0, 1.0]));
    let remarked: Vec<String> = [persistence].into_iter().chain(missing).chain(noted).collect();

    let width = (COLUMN - LEFT - 4.0 - GAP * (panels.len() as f64 - 1.0)) / panels.len() as f64;
    let top = 20.0 + 9.0 * legends.len() as f64;
    let bottom = top + 2.0 * HEIGHT + BELOW.iter().sum::<f64>();
    let height = bottom + 8.5 * remarked.len() as f64;
    let mut page = Page::new(COLUMN, height, "Error and skill of predictions over the horizon");
    for (row, entries) in legends.iter().enumerate() {
        legend(&mut page, COLUMN / 2.0, 9.0 + 9.0 * row as f64, entries);
    }
    for (row, of_row) in rows.iter().enumerate() {
        let label = of_row.plot.label(&of_row.means);
        for (place, scenario) in panels.iter().enumerate() {
            let panel = Panel {
                left: LEFT + place as f64 * (width + GAP),
                top: top + row as f64 * (HEIGHT + BELOW[0]),
                width,
                height: HEIGHT,
            };
            let scale = scales[row](panel.upwards());
            panel.left_axis(&mut page, &scale, (place == 0).then_some(label.as_str()));
            let centers = centers(&panel, horizons);
            if row == 0 {
                panel.heading(
                    &mut page,
                    &char::from(b'a' + place as u8).to_string(),
                    &plain(scenario.text()),
                );
                panel.bottom_ticks(&mut page, &centers);
            } else {
                panel.bottom_names(&mut page, &centers, &names, &format!("horizon ({unit})"));
                let zero = scale.at(0.0);
                page.line([panel.left, zero], [panel.right(), zero], Stroke::new(GRAY, 0.8));
            }
            let least = centers.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
            let apart = (SPREAD * least).min(2.0 * MARGIN) / all[row].len() as f64;
            let across = |order: usize, slot: usize| {
                centers[slot] + (order as f64 - (all[row].len() as f64 - 1.0) / 2.0) * apart
            };
            draw(&mut page, &all[row], place, &scale, across);
        }
    }
    remarks(&mut page, bottom + 4.0, remarked);
    Ok(Drawing { page, data: data(rows, seconds)? })
}

/// The positions of horizons in a panel, on a logarithmic axis, points.
fn centers(panel: &Panel, horizons: &[usize]) -> Vec<f64> {
    // The present sample, at horizon 0, has no logarithm.
    let shift = usize::from(horizons.contains(&0));
    let logarithm = |horizon: &usize| ((*horizon + shift) as f64).ln();
    let (first, last) = (horizons.first().map_or(0.0, logarithm), horizons.last().map_or(1.0, logarithm));
    let room = panel.width - 2.0 * MARGIN;
    let at = |horizon: &usize| panel.left + MARGIN + room * (logarithm(horizon) - first) / (last - first);
    horizons.iter().map(at).collect()
}

/// A time with as many digits as it needs, at most three decimals.
fn short(seconds: f64) -> String {
    let text = format!("{seconds:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// The rows of the CSV file: the means, with the horizon in seconds too.
fn data(rows: &[Row; 2], seconds: Option<f64>) -> Result<DataFrame, FigureError> {
    let means: Vec<Mean> = rows.iter().flat_map(|row| row.means.iter().cloned()).collect();
    let mut data = Mean::frame(&means)?;
    let times = data.column(Key::Horizon.name())?.cast(&DataType::Float64)? * seconds.unwrap_or(f64::NAN);
    let place = data.get_column_index(Key::Horizon.name()).unwrap_or_default();
    if seconds.is_some() {
        data.insert_column(place + 1, times.with_name("horizon_seconds".into()))?;
    }
    Ok(data)
}
