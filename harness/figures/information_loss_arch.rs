//! Diagram of the network that reconstructs the observation: a new decoder on the frozen encoder.

use super::axes::remark;
use super::diagram::{Anatomy, network};
use super::page::{COLUMN, Page};
use super::source::Source;
use super::{Drawing, FigureError};
use harness_spec::Task;

/// Draws the figure.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    let anatomy = Anatomy::of(source, Task::Reconstruction)?;
    let mut page = Page::new(COLUMN, 200.0, "The network that reconstructs the observation");
    let height = network(&mut page, COLUMN, 4.0, &anatomy);
    remark(
        &mut page,
        &format!("{}, of which the decoder's are trained", anatomy.parameter_words()),
        [COLUMN / 2.0, 4.0 + height + 9.0],
    );
    Ok(Drawing { page, data: anatomy.data()? })
}
