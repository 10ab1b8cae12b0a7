//! Where the boxes of the cluttered scenario start.

use super::SimulationError;
use super::course::Pose;
use super::motion::rest;
use super::scene::Scene;
use crate::spec::Simulation;
use rand::{Rng, RngExt};
use std::f64::consts::PI;

/// Draws an episode may spend on its boxes: far more than a layout that exists needs.
const MAX_DRAWS: usize = 100_000;

/// A circle on the ground that a body must stay in, m.
struct Footprint {
    centre: [f64; 2],
    radius: f64,
}

impl Footprint {
    fn gap(&self, other: &Self) -> f64 {
        let [dx, dy] = [0, 1].map(|axis| self.centre[axis] - other.centre[axis]);
        dx.hypot(dy) - self.radius - other.radius
    }
}

/// Stands the scene's boxes on the ground, uniformly over the sector that the finger sweeps, with random yaw.
///
/// Around each box, and the finger's place at rest, the circle that encloses it in any yaw is kept free, with
/// the spec's clearance: draws that are too near to an earlier one are rejected.
///
/// # Errors
/// When the draws run out: the sector is too small for the boxes.
pub(super) fn place_boxes(
    scene: &Scene,
    spec: &Simulation,
    episode: u32,
    rng: &mut impl Rng,
) -> Result<Vec<Pose>, SimulationError> {
    let [rotation, _, extension] = rest(spec);
    let finger =
        Footprint { centre: scene.mount.below_finger(rotation, extension), radius: scene.finger_radius };
    let mut taken = vec![finger];
    let mut poses = Vec::with_capacity(scene.boxes.len());
    for _ in 0..MAX_DRAWS {
        let Some(next) = scene.boxes.get(poses.len()) else { break };
        let [half_x, half_y, half_z] = next.half_size;
        let drawn = Footprint { centre: draw_place(scene, spec, rng), radius: half_x.hypot(half_y) };
        if taken.iter().all(|other| drawn.gap(other) >= spec.box_clearance_m) {
            let half_yaw = 0.5 * rng.random_range(-PI..PI);
            let [x, y] = drawn.centre;
            poses.push([x, y, half_z, half_yaw.cos(), 0.0, 0.0, half_yaw.sin()]);
            taken.push(drawn);
        }
    }
    if poses.len() < scene.boxes.len() {
        return Err(SimulationError::Placement {
            episode,
            placed: poses.len() + 1,
            boxes: scene.boxes.len(),
            attempts: MAX_DRAWS,
        });
    }
    Ok(poses)
}

/// A point of the swept sector, each area as likely as any other of its size.
fn draw_place(scene: &Scene, spec: &Simulation, rng: &mut impl Rng) -> [f64; 2] {
    let [low, high] = spec.rotation_range_rad;
    let rotation = rng.random_range(low..=high);
    let [inner, outer] = spec.extension_range_m.map(|extension| (scene.mount.radius + extension).powi(2));
    let radius = rng.random_range(inner..=outer).sqrt();
    scene.mount.below_finger(rotation, radius - scene.mount.radius)
}
