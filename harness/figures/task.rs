//! Figure of the scene in which the robot's sensors are recorded.

use super::page::{BLACK, COLUMN, Page, Point, Stroke, Type, WHITE};
use super::{Drawing, FigureError};
use harness_simulation::{Scene, SceneRenderer, SimulationError, replay};
use harness_spec::{Scenario, Simulation};
use polars::prelude::*;

/// The episode that is shown.
const EPISODE: u32 = 7;
/// The sample that is shown. At this sample the finger is pressed on the ground beside boxes.
const SAMPLE: usize = 79;
/// Width and height of the rendered picture, pixels. The page's PNG has the same size.
const PICTURE: [u32; 2] = [2008, 1334];

/// Draws the figure.
pub fn render() -> Result<Drawing, FigureError> {
    let scene = Scene::paper(Scenario::CLUTTERED)?;
    let states = replay(&scene, &Simulation::default(), EPISODE)?;
    let state = &states[SAMPLE.min(states.len() - 1)];
    let mut renderer = SceneRenderer::new(&scene, PICTURE[0], PICTURE[1])?;
    let picture = renderer.render(state)?;
    let height = COLUMN * f64::from(PICTURE[1]) / f64::from(PICTURE[0]);
    let mut page = Page::new(COLUMN, height, "The soft finger pressed on the ground among movable boxes");
    page.picture(&picture, [0.0, 0.0], [COLUMN, height], false)?;
    let at = |geom: &str| -> Result<Point, SimulationError> {
        let [x, y] = renderer.project(renderer.place_of(geom)?);
        Ok([x * COLUMN, y * height])
    };
    label(&mut page, at("finger_link_10")?, [-40.0, -26.0], "passive soft finger");
    label(&mut page, at("arm_sleeve")?, [-34.0, -24.0], "rigid arm");
    label(&mut page, at("box_7")?, [44.0, 16.0], &format!("{} movable boxes", scene.boxes()));
    Ok(Drawing { page, data: data(scene.scenario(), EPISODE, SAMPLE, state)? })
}

/// Writes a name beside the point `at`, shifted by `aside`, and draws a line from the point to the name.
pub fn label(page: &mut Page, at: Point, aside: [f64; 2], text: &str) {
    let end = [at[0] + aside[0], at[1] + aside[1]];
    page.line(at, end, Stroke::new(BLACK, 0.6));
    let how = Type::LABEL;
    let width = how.width(text) + 5.0;
    page.rectangle([end[0] - width / 2.0, end[1] - 5.5], [width, 11.0], 2.0, WHITE, None);
    page.text(text, [end[0], end[1] + 2.5], how);
}

/// The figure's CSV rows: the drawn state as MuJoCo's generalized positions.
///
/// # Errors
/// When Polars can't build the table.
pub fn data(
    scenario: Scenario,
    episode: u32,
    sample: usize,
    state: &[f64],
) -> Result<DataFrame, FigureError> {
    Ok(df!(
        "scenario" => vec![scenario.name(); state.len()],
        "episode" => vec![episode; state.len()],
        "sample" => vec![sample as u32; state.len()],
        "qpos_index" => (0..state.len() as u32).collect::<Vec<_>>(),
        "qpos" => state.to_vec(),
    )?)
}
