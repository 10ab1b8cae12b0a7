//! The paper's figures as the page shows them.

use super::{Part, part};
use crate::figures::source::Source;
use crate::figures::{Figure, FigureError};
use crate::progress::Progress;
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
    progress.begin("drawing", Figure::ALL.len() as u64, "figures");
    let drawn = Figure::ALL.into_iter().map(|figure| {
        let svg = part(figure.draw(source).map(|drawing| drawing.page.svg()))?;
        progress.advance(1);
        Ok(Drawn { name: figure.name(), meaning: figure.meaning(), svg })
    });
    let drawn = drawn.collect();
    progress.end();
    drawn
}
