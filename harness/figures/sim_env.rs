//! Figure of the simulated robot: the three joints of its arm, and the finger close up.

use super::page::{BLACK, BLUE, COLUMN, Page, Point, Stroke, Type, WHITE, WINE};
use super::task::{data, label};
use super::text::Face;
use super::{Drawing, FigureError};
use harness_simulation::{Scene, SceneRenderer, SimulationError, replay};
use harness_spec::{Scenario, Simulation};

/// The episode that is shown.
const EPISODE: u32 = 0;
/// The sample that is shown. At this sample the finger bends in both directions.
const SAMPLE: usize = 40;
/// Width of the left view, points.
const WIDE: f64 = 142.0;
const HEIGHT: f64 = 140.0;
/// Width of the right view, points.
const NARROW: f64 = COLUMN - WIDE - 3.0;

/// Draws the figure.
pub fn render() -> Result<Drawing, FigureError> {
    let scene = Scene::paper(Scenario::EMPTY)?;
    let states = replay(&scene, &Simulation::default(), EPISODE)?;
    let sample = SAMPLE.min(states.len() - 1);
    let mut page = Page::new(COLUMN, HEIGHT, "The robot: a cylindrical arm with a passive finger");
    arm(&mut page, &scene, &states[sample])?;
    finger(&mut page, &scene, &states[sample])?;
    Ok(Drawing { page, data: data(scene.scenario(), EPISODE, sample, &states[sample])? })
}

/// A part of the page with a rendered picture of the scene.
struct SceneView<'s> {
    renderer: SceneRenderer<'s>,
    corner: Point,
    size: [f64; 2],
}

impl<'s> SceneView<'s> {
    /// Renders the state onto the page with a body in the middle.
    fn render(
        page: &mut Page,
        scene: &'s Scene,
        state: &[f64],
        (corner, size): (Point, [f64; 2]),
        (body, angle_deg): (&str, f64),
    ) -> Result<Self, FigureError> {
        let [width, height] = size.map(|side| (side * 600.0 / 72.0).round() as u32);
        let mut renderer = SceneRenderer::close_up(scene, width, height, body, angle_deg)?;
        page.picture(&renderer.render(state)?, corner, size, false)?;
        Ok(Self { renderer, corner, size })
    }

    /// The position on the page of a place in the world, which is given in meters.
    fn at(&self, place: [f64; 3]) -> Point {
        let [x, y] = self.renderer.project(place);
        [self.corner[0] + x * self.size[0], self.corner[1] + y * self.size[1]]
    }

    fn geom(&self, name: &str) -> Result<Point, SimulationError> {
        Ok(self.at(self.renderer.place_of(name)?))
    }
}

/// Draws an arrow with heads at both ends.
fn double_arrow(page: &mut Page, points: &[Point], color: &'static str) {
    let stroke = Stroke::new(color, 1.0);
    let middle = points.len() / 2;
    page.arrow(&points[middle - 1..], stroke);
    let back: Vec<Point> = points[..=middle].iter().rev().copied().collect();
    page.arrow(&back, stroke);
}

fn arm(page: &mut Page, scene: &Scene, state: &[f64]) -> Result<(), FigureError> {
    let view = SceneView::render(page, scene, state, ([0.0, 0.0], [WIDE, HEIGHT]), ("arm_carriage", 31.0))?;
    let name = Type { face: Face::Bold, ..Type::LABEL };
    let carriage = view.renderer.place_of("arm_carriage")?;
    let base = view.renderer.place_of("finger_link_00")?;

    // An arc around the column, on the side of the camera.
    let arc: Vec<Point> = (0..=16)
        .map(|step| (170.0 + 6.0 * f64::from(step)).to_radians())
        .map(|angle| view.at([0.36 * angle.cos(), 0.36 * angle.sin(), 0.16]))
        .collect();
    double_arrow(page, &arc, BLACK);
    let end = arc[arc.len() - 1];
    page.text("*q*_{1} rotation", [end[0] + 4.0, end[1] + 6.0], name.start());

    // An arrow beside the upper part of the shaft.
    let beside = |height: f64| {
        let [x, y] = view.at([carriage[0], carriage[1], height]);
        [x + 10.0, y]
    };
    let (low, high) = (carriage[2] + 0.25, carriage[2] + 0.75);
    let middle = beside((low + high) / 2.0);
    double_arrow(page, &[beside(low), middle, beside(high)], BLACK);
    page.text("*q*_{2} lift", [middle[0] + 4.0, middle[1] + 2.5], name.start());

    // An arrow above the beam.
    let along = |part: f64| {
        let [x, y] = view.at(std::array::from_fn(|axis| {
            let (from, to) = (carriage[axis], if axis == 2 { carriage[2] } else { base[axis] });
            from + part * (to - from)
        }));
        [x - 4.0, y - 8.0]
    };
    double_arrow(page, &[along(0.3), along(0.65), along(1.0)], BLACK);
    let [x, y] = along(0.75);
    page.text("*q*_{3} extension", [x - 3.0, y - 4.0], name.end());

    label(page, view.geom("finger_link_12")?, [24.0, 6.0], "finger");
    page.text("a", [3.0, 9.0], Type::BOLD);
    Ok(())
}

fn finger(page: &mut Page, scene: &Scene, state: &[f64]) -> Result<(), FigureError> {
    let place = ([COLUMN - NARROW, 0.0], [NARROW, HEIGHT]);
    let view = SceneView::render(page, scene, state, place, ("finger_link_10", 13.0))?;
    let small = Type::SMALL;
    for link in [0, 5, 10, 15, 19] {
        let [x, y] = view.geom(&format!("finger_link_{link:02}"))?;
        let text = format!("link {link}");
        let width = small.width(&text) + 3.0;
        // To the left where there is no room on the right.
        let from = if x + 9.0 + width <= COLUMN { x + 9.0 } else { x - 9.0 - width };
        page.line([x, y], [from.max(x - 9.0), y], Stroke::new(BLACK, 0.5));
        page.rectangle([from, y - 4.0], [width, 8.0], 1.5, WHITE, None);
        page.text(&text, [from + 1.5, y + 2.2], small.start());
    }
    // The two directions of bending at the finger's base: along the arm, and across it.
    let base = view.renderer.place_of("finger_link_00")?;
    let reach = base[0].hypot(base[1]);
    let along = [base[0] / reach, base[1] / reach];
    let from = view.at(base);
    let towards = |direction: [f64; 2]| {
        let [x, y] = view.at([base[0] + 0.16 * direction[0], base[1] + 0.16 * direction[1], base[2]]);
        [x - from[0], y - from[1]]
    };
    let middle = [COLUMN - NARROW + 30.0, 38.0];
    let ways = [(along, BLUE, "flexion/extension"), ([-along[1], along[0]], WINE, "adduction/abduction")];
    for (row, (direction, color, words)) in ways.into_iter().enumerate() {
        let [x, y] = towards(direction);
        double_arrow(page, &[[middle[0] - x, middle[1] - y], middle, [middle[0] + x, middle[1] + y]], color);
        page.text(words, [COLUMN - 3.0, HEIGHT - 12.0 + 8.5 * row as f64], small.end().color(color));
    }
    page.text("b", [COLUMN - NARROW + 3.0, 9.0], Type::BOLD);
    Ok(())
}
