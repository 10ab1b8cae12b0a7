//! How well the next observation is predicted, over latent sizes.

use super::axes::Panel;
use super::curves::{Curves, Measured, explain, explain_bars, stack};
use super::page::{COLUMN, Page};
use super::source::{Source, Study};
use super::{Drawing, FigureError};
use harness_metrics::Metric;
use harness_spec::{Modality, Task};

const LEFT: f64 = 33.0;
const WIDTH: f64 = 97.0;
const HEIGHT: f64 = 78.0;

pub fn draw(source: &Source) -> Result<Drawing, FigureError> {
    let [single, multi] = [source.runs(Study::SingleToMulti)?, source.runs(Study::MultiToMulti)?];
    let curves = |runs, modality, metric, letter, title| Curves {
        runs,
        task: Task::Prediction,
        modality,
        metric,
        letter,
        title,
        baseline: Some(("persistence", "pers.")),
    };
    let (body, force) = (Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE);
    let a = curves(&single, body, Metric::Smape, "a", Study::SingleToMulti.input());
    let b = curves(&single, force, Metric::Wmape, "b", Study::SingleToMulti.input());
    let c = curves(&multi, body, Metric::Smape, "c", Study::MultiToMulti.input());
    let d = curves(&multi, force, Metric::Wmape, "d", Study::MultiToMulti.input());
    let [a, b, c, d] = [a.measure()?, b.measure()?, c.measure()?, d.measure()?];

    let mut page = Page::new(COLUMN, 268.0, "Prediction errors over latent size");
    explain(&mut page, COLUMN / 2.0, 9.0);
    let row = |page: &mut Page, top: f64, panels: [&Measured; 2], label: &str| {
        let highest = panels[0].highest().max(panels[1].highest());
        let left = Panel { left: LEFT, top, width: WIDTH, height: HEIGHT };
        let right = Panel { left: LEFT + WIDTH + 10.0, ..left };
        panels[0].draw(page, &left, highest, Some(label));
        panels[1].draw(page, &right, highest, None);
    };
    row(&mut page, 34.0, [&a, &c], "proprioception, SMAPE (%)");
    row(&mut page, 152.0, [&b, &d], "contact force, WMAPE (%)");
    explain_bars(&mut page, COLUMN / 2.0, 263.0, &[&single, &multi], "; pers.: next = now");
    let data = stack(&[&a, &b, &c, &d])?;
    Ok(Drawing { page, data })
}
