//! The paper's figures as the page shows them.

use super::cache::cached;
use super::{Part, part};
use harness_figures::source::Source;
use harness_figures::{Figure, FigureError};
use harness_shared::progress::Progress;
use serde::Serialize;

/// A figure, or why it isn't there.
#[derive(Serialize)]
pub struct Drawn {
    name: &'static str,
    meaning: &'static str,
    /// An SVG element.
    pub svg: Part<String>,
}

/// Draws all figures.
///
/// # Errors
/// When one can't be drawn though its runs are there.
pub fn draw(source: &Source, progress: &dyn Progress) -> Result<Vec<Drawn>, FigureError> {
    progress.begin("drawing", Figure::OF_THE_PAPER.len() as u64, "figures");
    let drawn = Figure::OF_THE_PAPER.into_iter().map(|figure| {
        let draw = || figure.draw(source).map(|drawing| drawing.page.svg());
        let svg = if figure.shows_runs() { draw() } else { rendered(figure, draw) };
        let svg = part(svg)?;
        progress.advance(1);
        Ok(Drawn { name: figure.name(), meaning: figure.meaning(), svg })
    });
    let drawn = drawn.collect();
    progress.end();
    drawn
}

/// A figure that shows the simulated world alone, rendered unless it was before.
fn rendered(
    figure: Figure,
    draw: impl FnOnce() -> Result<String, FigureError>,
) -> Result<String, FigureError> {
    let svg = cached(figure.name(), || draw().map(String::into_bytes))?;
    String::from_utf8(svg).map_err(|error| FigureError::Picture(error.to_string()))
}
