//! Places the bodies of a world at random.

use super::SimulationError;
use super::factors::{FactorValues, largest_size, product};
use super::resolved::{Area, Mount, Placement};
use super::scene::Scene;
use super::standing::FreeBody;
use harness_spec::{Pose, Simulation};
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_model::traits::ModelType;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::f64::consts::PI;

/// Largest number of draws for the bodies of one placement. If the bodies fit at all, far fewer are needed.
const MAX_DRAWS: usize = 100_000;

/// The deepest overlap at an episode's start that is not an error, as a part of a body's radius.
const SLACK: f64 = 0.01;

/// A circle on the ground that a body must stay in, m.
#[derive(Clone, Copy)]
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

/// A body's place, and half of its yaw.
type Drawn = (Footprint, f64);

/// Draws places of one episode's bodies.
struct Draws<'a> {
    scene: &'a Scene,
    spec: &'a Simulation,
    ranges: Vec<[f64; 2]>,
    episode: u32,
}

impl Draws<'_> {
    /// Draws a place for a body of this radius, up to `attempts` times, until it is far enough from `others`. A yaw is
    /// drawn for each place that is. Draws are subtracted from `attempts`.
    fn draw(
        &self,
        placement: &Placement,
        radius: f64,
        others: &[Footprint],
        attempts: &mut usize,
        rng: &mut impl Rng,
    ) -> Option<Drawn> {
        let clearance = self.spec.number(&placement.setting).unwrap_or(placement.clearance_m);
        while *attempts > 0 {
            *attempts -= 1;
            let center = match &placement.area {
                Area::Sector(mount) => draw_in_sector(mount, &self.ranges, rng),
                Area::Rectangle(sides) => sides.map(|[low, high]| rng.random_range(low..=high)),
            };
            let drawn = Footprint { center, radius };
            if others.iter().all(|other| drawn.gap(other) >= clearance) {
                return Some((drawn, 0.5 * rng.random_range(-PI..PI)));
            }
        }
        None
    }

    fn no_place(&self, placement: &Placement, place: usize) -> SimulationError {
        SimulationError::Other(format!(
            "episode {}: no free place for box {} of {} after {MAX_DRAWS} draws; widen the ranges or the area that \
             boxes are placed in, or lower simulation.{}",
            self.episode,
            place + 1,
            self.scene.boxes(),
            placement.setting
        ))
    }

    /// Draws the bodies that would be too near another one at the largest sizes that the spec's factors can draw again.
    /// The sizes that the episode draws therefore have no influence on the places.
    fn make_room(&self, kept_free: &[Footprint], drawn: &mut [Drawn]) -> Result<(), SimulationError> {
        let largest = |geom| largest_size(self.scene, self.spec, geom);
        let mut rng = room_stream(self.scene, self.spec.stream(), self.episode);
        let bodies: Vec<(&Placement, &FreeBody)> = bodies(self.scene).collect();
        for ((footprint, _), (_, body)) in drawn.iter_mut().zip(&bodies) {
            footprint.radius = body.radius(largest);
        }
        for (place, (placement, _)) in bodies.iter().enumerate() {
            let clearance = self.spec.number(&placement.setting).unwrap_or(placement.clearance_m);
            let own = drawn[place].0;
            let before = || kept_free.iter().chain(drawn[..place].iter().map(|(footprint, _)| footprint));
            if before().any(|other| own.gap(other) < clearance) {
                let after = drawn[place + 1..].iter().map(|(footprint, _)| footprint);
                let others: Vec<Footprint> = before().chain(after).copied().collect();
                let again = self.draw(placement, own.radius, &others, &mut MAX_DRAWS.clone(), &mut rng);
                drawn[place] = again.ok_or_else(|| self.no_place(placement, place))?;
            }
        }
        Ok(())
    }
}

/// Returns the bodies that an episode places, in their order.
fn bodies(scene: &Scene) -> impl Iterator<Item = (&Placement, &FreeBody)> {
    let placements = scene.resolved.placements.iter();
    placements.flat_map(|placement| placement.boxes.iter().map(move |body| (placement, body)))
}

/// Places the scene's bodies on the ground, uniformly over their area, with random yaw.
///
/// Each body is represented by the circle that encloses it at any yaw, and the place under an arm's body at rest by the
/// body's circle. A draw is rejected if its circle is nearer to an earlier one than the spec's clearance.
///
/// # Errors
/// When a body has no place after the largest number of draws, because the area is too small.
pub(super) fn place_boxes(
    scene: &Scene,
    spec: &Simulation,
    factors: &FactorValues,
    episode: u32,
    rng: &mut impl Rng,
) -> Result<Vec<Pose>, SimulationError> {
    let Some(ground) = &scene.ground else { return Ok(Vec::new()) };
    let rest = scene.start(spec);
    let mounts = scene.resolved.placements.iter().filter_map(|placement| match &placement.area {
        Area::Sector(mount) => Some(mount),
        Area::Rectangle(_) => None,
    });
    let kept_free: Vec<Footprint> = mounts
        .map(|mount| {
            let [rotation, extension] = mount.elements.map(|element| rest[element]);
            Footprint { center: mount.below(rotation, extension), radius: mount.body_radius }
        })
        .collect();
    let draws = Draws { scene, spec, ranges: scene.ranges(spec), episode };
    let (mut taken, mut drawn) = (kept_free.clone(), Vec::with_capacity(scene.boxes()));
    for placement in &scene.resolved.placements {
        let mut attempts = MAX_DRAWS;
        for body in &placement.boxes {
            let found = draws.draw(placement, body.radius(|_| 1.0), &taken, &mut attempts, rng);
            let found = found.ok_or_else(|| draws.no_place(placement, drawn.len()))?;
            taken.push(found.0);
            drawn.push(found);
        }
    }
    draws.make_room(&kept_free, &mut drawn)?;
    let mut ground = ground.ground();
    let pose = |((footprint, half_yaw), (_, body)): (Drawn, (&Placement, &FreeBody))| {
        let [x, y] = footprint.center;
        let z = body.stand(&mut ground, [x, y], |geom| factors.size_of(scene, geom));
        let [w, i, j, k] = product([half_yaw.cos(), 0.0, 0.0, half_yaw.sin()], body.tilt);
        [x, y, z, w, i, j, k]
    };
    Ok(drawn.into_iter().zip(bodies(scene)).map(pose).collect())
}

/// Returns the random generator for the bodies of an episode that are drawn again because of their size.
fn room_stream(scene: &Scene, seed: u64, episode: u32) -> ChaCha8Rng {
    let identity = format!("harness placement: seed {seed}, scenario {}, index {episode}", scene.scenario());
    ChaCha8Rng::from_seed(Sha256::digest(identity).into())
}

/// Refuses an episode in which a placed body overlaps something else. `data` has the contacts of the
/// first sample.
///
/// # Errors
/// Names what overlaps, and by how much.
pub(super) fn check_start(
    scene: &Scene,
    episode: u32,
    data: &MjData<impl ModelType>,
) -> Result<(), SimulationError> {
    let model = &scene.model;
    let mut deepest: BTreeMap<[usize; 2], f64> = BTreeMap::new();
    let mut placement = None;
    for contact in data.contact() {
        let [Ok(one), Ok(other)] = contact.geom.map(usize::try_from) else { continue };
        let roots = [one, other].map(|geom| model.body_rootid()[model.geom_bodyid()[geom] as usize] as usize);
        let placed = |(_, body): &(&Placement, &FreeBody)| roots.contains(&body.body);
        let Some((of, body)) = bodies(scene).find(placed).filter(|_| roots[0] != roots[1]) else { continue };
        if -contact.dist > SLACK * body.radius(|_| 1.0) {
            placement.get_or_insert(&of.name);
            let depth = deepest.entry([one, other]).or_default();
            *depth = depth.max(-contact.dist);
        }
    }
    let Some(placement) = placement else { return Ok(()) };
    let pair = |([one, other], depth): (&[usize; 2], &f64)| {
        format!("{} and {} by {depth:.3} m", scene.geom_name(*one), scene.geom_name(*other))
    };
    let what = deepest.iter().take(3).map(pair).collect::<Vec<_>>().join(", ");
    let more = if deepest.len() > 3 { ", …" } else { "" };
    Err(SimulationError::Overlap { episode, placement: placement.clone(), what: what + more })
}

/// Draws a point of the swept sector, uniformly over its area.
fn draw_in_sector(mount: &Mount, ranges: &[[f64; 2]], rng: &mut impl Rng) -> [f64; 2] {
    let [[low, high], extension] = mount.elements.map(|element| ranges[element]);
    let rotation = rng.random_range(low..=high);
    let [inner, outer] = extension.map(|extension| (mount.radius + extension).powi(2));
    let radius = rng.random_range(inner..=outer).sqrt();
    mount.below(rotation, radius - mount.radius)
}
