//! Places the boxes of a world at random.

use super::SimulationError;
use super::factors::FactorValues;
use super::resolve::{Area, Mount};
use super::scene::Scene;
use harness_spec::{Pose, Simulation};
use rand::{Rng, RngExt};
use std::f64::consts::PI;

/// Largest number of draws for the boxes of one placement. If the boxes fit at all, far fewer are needed.
const MAX_DRAWS: usize = 100_000;

/// A circle on the ground that a body must stay in, m.
struct Footprint {
    center: [f64; 2],
    radius: f64,
}

impl Footprint {
    fn gap(&self, other: &Self) -> f64 {
        let [dx, dy] = [0, 1].map(|axis| self.center[axis] - other.center[axis]);
        dx.hypot(dy) - self.radius - other.radius
    }
}

/// Places the scene's boxes on the ground, uniformly over their area, with random yaw.
///
/// Each box is represented by the circle that encloses it at any yaw, and the place under an arm's body at rest by the
/// body's circle. A draw is rejected if its circle is nearer to an earlier one than the spec's clearance.
///
/// # Errors
/// When a box has no place after the largest number of draws, because the area is too small.
pub(super) fn place_boxes(
    scene: &Scene,
    spec: &Simulation,
    factors: &FactorValues,
    episode: u32,
    rng: &mut impl Rng,
) -> Result<Vec<Pose>, SimulationError> {
    let (ranges, rest) = (scene.ranges(spec), scene.start(spec));
    let mounts = scene.placements.iter().filter_map(|placement| match &placement.area {
        Area::Sector(mount) => Some(mount),
        Area::Rectangle(_) => None,
    });
    let mut taken: Vec<Footprint> = mounts
        .map(|mount| {
            let [rotation, extension] = mount.elements.map(|element| rest[element]);
            Footprint { center: mount.below(rotation, extension), radius: mount.body_radius }
        })
        .collect();
    let mut poses = Vec::with_capacity(scene.boxes());
    for placement in &scene.placements {
        let clearance = spec.number(&placement.setting).unwrap_or(placement.clearance_m);
        let mut boxes = placement.boxes.iter();
        let mut next = boxes.next();
        for _ in 0..MAX_DRAWS {
            let Some(free_box) = next else { break };
            let scale = factors.size_of(scene, free_box.geom);
            let [half_x, half_y, half_z] = free_box.half_size.map(|half| scale * half);
            let center = match &placement.area {
                Area::Sector(mount) => draw_in_sector(mount, &ranges, rng),
                Area::Rectangle(sides) => sides.map(|[low, high]| rng.random_range(low..=high)),
            };
            let drawn = Footprint { center, radius: half_x.hypot(half_y) };
            if taken.iter().all(|other| drawn.gap(other) >= clearance) {
                let half_yaw = 0.5 * rng.random_range(-PI..PI);
                let [x, y] = drawn.center;
                poses.push([x, y, half_z, half_yaw.cos(), 0.0, 0.0, half_yaw.sin()]);
                taken.push(drawn);
                next = boxes.next();
            }
        }
        if next.is_some() {
            return Err(SimulationError::Placement {
                episode,
                placed: poses.len() + 1,
                boxes: scene.boxes(),
                attempts: MAX_DRAWS,
                setting: placement.setting.clone(),
            });
        }
    }
    Ok(poses)
}

/// Draws a point of the swept sector, uniformly over its area.
fn draw_in_sector(mount: &Mount, ranges: &[[f64; 2]], rng: &mut impl Rng) -> [f64; 2] {
    let [[low, high], extension] = mount.elements.map(|element| ranges[element]);
    let rotation = rng.random_range(low..=high);
    let [inner, outer] = extension.map(|extension| (mount.radius + extension).powi(2));
    let radius = rng.random_range(inner..=outer).sqrt();
    mount.below(rotation, radius - mount.radius)
}
