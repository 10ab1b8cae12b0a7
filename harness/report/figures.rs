//! Draws the paper's figures for the page.

use super::cache::cached;
use super::{Part, part};
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

/// Draws the paper's figures. A figure whose runs are missing becomes [`Part::Absent`].
///
/// # Errors
/// When a figure can't be drawn although its runs exist.
pub fn render(source: &Source, progress: &dyn Progress) -> Result<Vec<Drawn>, FigureError> {
    progress.begin("drawing", Figure::OF_THE_PAPER.len() as u64, "figures");
    let drawn = Figure::OF_THE_PAPER.into_iter().map(|figure| {
        let render = || figure.render(source).map(|drawing| drawing.page.svg());
        let svg = if figure.shows_runs() { render() } else { cached(figure.name(), render) };
        let svg = part(svg)?;
        progress.advance(1);
        Ok(Drawn { name: figure.name(), meaning: figure.meaning(), svg })
    });
    let drawn = drawn.collect();
    progress.end();
    drawn
}
