//! Figure of the error of reconstructing the observation from the latent state, over the latent size.

use super::curves::{Curves, explain, pair, remarks, stack};
use super::page::{COLUMN, Page};
use super::source::{Source, Study};
use super::{Drawing, FigureError};
use harness_metrics::Metric;
use harness_spec::{Modality, Task};

/// Draws the figure.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    let [single, multi] = [source.runs(Study::SingleToMulti)?, source.runs(Study::MultiToMulti)?];
    let curves = |runs, letter| Curves {
        runs,
        task: Task::Reconstruction,
        modality: Modality::PROPRIOCEPTION,
        metric: Metric::Smape,
        letter,
        // The only baseline of reconstruction is the training mean. Its error is far too large for the axis.
        baseline: None,
    };
    let a = curves(&single, "a");
    let b = curves(&multi, "b");
    let [a, b] = [a.measure()?, b.measure()?];

    let mut page = Page::new(COLUMN, 158.0, "Reconstruction errors of proprioception over latent size");
    explain(&mut page, COLUMN / 2.0, 9.0);
    let is_cut = pair(&mut page, [34.0, 86.0], [&a, &b], "proprioception, SMAPE (%)");
    remarks(&mut page, 153.0, is_cut, &[]);
    let data = stack(&[&a, &b])?;
    Ok(Drawing { page, data })
}
