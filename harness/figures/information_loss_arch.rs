//! Diagram of the network that reconstructs the observation: a new decoder on the frozen encoder.

use super::anatomy::Anatomy;
use super::diagram::network;
use super::source::Source;
use super::{Drawing, FigureError};
use harness_spec::Task;

/// Draws the figure.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    let anatomy = Anatomy::of(source, Task::Reconstruction)?;
    let remark = format!("{}, of which the decoder's are trained", anatomy.parameter_words());
    let page = network("The network that reconstructs the observation", 4.0, &anatomy, &remark, |_| ());
    Ok(Drawing { page, data: anatomy.data()? })
}
