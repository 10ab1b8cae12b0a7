//! Figure of the error of predicting the next observation, over the latent size.

use super::curves::{Curves, explain, pair, remarks, stack};
use super::page::{COLUMN, Page};
use super::source::{Source, Study};
use super::{Drawing, FigureError};
use harness_analysis::models::PERSISTENCE;
use harness_metrics::Metric;
use harness_spec::{Modality, Task};

/// Height of a panel, points.
const HEIGHT: f64 = 78.0;

/// Draws the figure.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    let [single, multi] = [source.runs(Study::SingleToMulti)?, source.runs(Study::MultiToMulti)?];
    let curves = |runs, modality, metric, letter| Curves {
        runs,
        task: Task::Prediction,
        modality,
        metric,
        letter,
        baseline: Some((PERSISTENCE, "pers.")),
    };
    let (body, force) = (Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE);
    let a = curves(&single, body, Metric::Smape, "a");
    let b = curves(&single, force, Metric::Wmape, "b");
    let c = curves(&multi, body, Metric::Smape, "c");
    let d = curves(&multi, force, Metric::Wmape, "d");
    // The paper has no such panels.
    let e = curves(&single, force, Metric::R2, "e");
    let f = curves(&multi, force, Metric::R2, "f");
    let [a, b, c, d] = [a.measure()?, b.measure()?, c.measure()?, d.measure()?];
    let [e, f] = [e.measure()?, f.measure()?];

    let mut page = Page::new(COLUMN, 418.0, "Prediction errors over latent size");
    explain(&mut page, COLUMN / 2.0, 9.0);
    let is_cut = [
        pair(&mut page, [34.0, HEIGHT], [&a, &c], "proprioception, SMAPE (%)"),
        pair(&mut page, [152.0, HEIGHT], [&b, &d], "contact force, WMAPE (%)"),
        pair(&mut page, [270.0, HEIGHT], [&e, &f], "contact force, R²"),
    ];
    let lines = [
        "pers.: the next value is the present one",
        "dashed, arrow: predicting zero (a to d), predicting the mean (e, f)",
        "b, d, e, f: the force on links with such joints, from any side;",
        "adduction/abduction has the tip",
    ];
    remarks(&mut page, 381.0, is_cut.contains(&true), &lines);
    let data = stack(&[&a, &b, &c, &d, &e, &f])?;
    Ok(Drawing { page, data })
}
