//! Draws the paper's figures for the page.

use super::cache::cached;
use super::{Asked, Part, part};
use harness_figures::source::Source;
use harness_figures::{Figure, FigureError};
use harness_shared::progress::Progress;
use serde::Serialize;

/// A figure, or the reason why it is missing.
#[derive(Serialize)]
pub struct Drawn {
    name: &'static str,
    meaning: &'static str,
    /// The figure as an SVG element.
    pub svg: Part<String>,
}

/// Draws the paper's figures. A figure whose runs are missing becomes [`Part::Absent`]. On a page of some experiments,
/// figures of other experiments are left out, and also those of the scenes if no run is in one of them.
///
/// # Errors
/// When a figure can't be drawn although its runs exist.
pub fn render(
    source: &Source,
    asked: &Asked,
    has_scenes: bool,
    progress: &dyn Progress,
) -> Result<Vec<Drawn>, FigureError> {
    let figures = Figure::OF_THE_PAPER.into_iter().filter(|figure| has_scenes || figure.shows_runs());
    progress.begin("drawing", figures.clone().count() as u64, "figures");
    let drawn = figures.filter_map(|figure| {
        let render = || figure.render(source).map(|drawing| drawing.page.svg());
        let svg = if figure.shows_runs() { render() } else { cached(figure.name(), render) };
        progress.advance(1);
        if matches!(&svg, Err(FigureError::NoRuns { experiment, .. }) if !asked.has(experiment)) {
            return None;
        }
        Some(part(svg, asked).map(|svg| Drawn { name: figure.name(), meaning: figure.meaning(), svg }))
    });
    let drawn = drawn.collect();
    progress.end();
    drawn
}
