//! Diagram of the network that predicts the next observation: the idea, and the layers.

use super::anatomy::Anatomy;
use super::diagram::{ACTION, INPUT, LATENT, LINE, block, network};
use super::page::{Page, Type, WHITE};
use super::source::Source;
use super::{Drawing, FigureError};
use harness_spec::Task;

/// Draws the figure.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    let anatomy = Anatomy::of(source, Task::Prediction)?;
    let remark = format!("{}; numbers: values that a layer gives", anatomy.parameter_words());
    let page = network("The network that predicts the next observation", 88.0, &anatomy, &remark, |page| {
        page.text("a", [2.0, 9.0], Type::BOLD);
        page.text("the idea: fuse, compress, predict", [10.0, 9.0], Type::LABEL.start());
        idea(page, 28.0);
        page.text("b", [2.0, 82.0], Type::BOLD);
        page.text("as a conditional variational auto-encoder", [10.0, 82.0], Type::LABEL.start());
    });
    Ok(Drawing { page, data: anatomy.data()? })
}

/// Draws the idea: the encoder maps the observation to a state, and the predictor maps state and action to the next
/// observation.
fn idea(page: &mut Page, y: f64) {
    let lines = |name: &str, more: &str| vec![name.to_owned(), more.to_owned()];
    let boxes = [
        (24.0, 44.0, INPUT, lines("observation", "*s*_{t}")),
        (76.0, 36.0, WHITE, lines("encoder", "*f*")),
        (122.0, 32.0, LATENT, lines("state", "*f*(*s*_{t})")),
        (166.0, 36.0, WHITE, lines("predictor", "*h*")),
        (216.0, 46.0, INPUT, lines("prediction", "*ŝ*_{t+1}")),
    ];
    for (x, width, fill, lines) in &boxes {
        block(page, [*x, y], [*width, 22.0], fill, lines);
    }
    for pair in boxes.windows(2) {
        page.arrow(&[[pair[0].0 + pair[0].1 / 2.0, y], [pair[1].0 - pair[1].1 / 2.0, y]], LINE);
    }
    block(page, [118.0, y + 30.0], [40.0, 22.0], ACTION, &lines("action", "*a*_{t}"));
    page.arrow(&[[138.0, y + 30.0], [166.0, y + 30.0], [166.0, y + 11.0]], LINE);
}
