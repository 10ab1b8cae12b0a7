//! True optical flow: the displacement of each pixel's content in a camera's image since the sample before.
//!
//! A ray through the center of each pixel hits a point on a geom. Geoms are rigid, so the geom's pose at the sample
//! before gives the earlier position of that point. The camera's earlier pose then gives its earlier pixel. Rays pass
//! through what is not rendered: faces that look away from the camera, and what is nearer than the near plane. A camera
//! inside a geom therefore does not see this geom.

use super::physics::Instant;
use super::resolved::{SceneCamera, SceneFlow};
use super::scene::{Scene, write_state};
use harness_spec::IMAGE_CHANNELS;
use mujoco_rs::prelude::*;
use std::collections::BTreeSet;
use std::sync::Arc;

/// The geom groups that cameras render.
const SEEN_GROUPS: [u8; 6] = [1, 1, 1, 0, 0, 0];
/// Assumed distance if a ray hits no geom, m.
const FAR: f64 = 1e6;
/// By how much a ray continues behind what it passes through, in distances of the near plane.
const STEP: f64 = 1e-4;
/// Relative tolerance of a ray's length for rounding.
const ROUNDING: f64 = 1e-6;

/// Computes the optical flow of one camera.
pub(super) struct Flow {
    of: SceneFlow,
    now: MjData<Arc<MjModel>>,
    before: MjData<Arc<MjModel>>,
    pixels: Vec<u8>,
}

/// Returns the geoms that a camera would see, but does not render, because it is inside them or too near.
pub(super) fn unrendered(data: &mut MjData<Arc<MjModel>>, image: &SceneCamera) -> BTreeSet<usize> {
    let view = View::new(data, image.camera, image.size);
    let rays: Vec<[f64; 3]> = pixels_of(image.size).map(|pixel| view.ray(pixel)).collect();
    let hits = view.hits(data, &rays);
    let missed =
        hits.into_iter().zip(rays).filter_map(|(hit, ray)| hit.filter(|hit| !view.renders(ray, hit)));
    missed.map(|hit| hit.geom).collect()
}

/// Returns the centers of an image's pixels (column, row), row by row.
fn pixels_of([rows, columns]: [usize; 2]) -> impl Iterator<Item = [f64; 2]> {
    (0..rows * columns).map(move |pixel| [pixel % columns, pixel / columns].map(|at| at as f64 + 0.5))
}

/// A point on a geom's surface that a ray reaches.
#[derive(Clone, Copy)]
struct Hit {
    geom: usize,
    distance: f64,
    /// The direction, of length 1, in which the surface looks.
    normal: [f64; 3],
}

/// The pose of a camera at an instant.
struct View {
    place: [f64; 3],
    /// Rotation matrix, row by row. Its columns are the camera's axes (right, up, backwards).
    turn: [f64; 9],
    /// Focal length, pixels.
    focal: f64,
    /// Distance of the near plane, m. Nothing nearer is rendered.
    near: f64,
    size: [usize; 2],
}

impl Flow {
    pub fn new(scene: &Scene, of: SceneFlow) -> Self {
        let data = || scene.at_rest(scene.model.clone());
        Self { of, now: data(), before: data(), pixels: Vec::new() }
    }

    /// Computes the flow at a sample as an image, `[rows, columns, 3]`. Red is 128 plus 127 / limit for each pixel of
    /// displacement to the right, and green is the same downwards. Blue is 255 if the point was visible at the sample
    /// before, and 0 otherwise.
    pub fn render(&mut self, instant: &Instant) -> &[u8] {
        for (data, state) in [(&mut self.now, &instant.state), (&mut self.before, &instant.state_before)] {
            data.swap_model(instant.model.clone());
            write_state(state, data);
            data.kinematics();
            data.com_pos();
            data.camlight();
        }
        let SceneCamera { camera, size: [rows, columns], .. } = self.of.image;
        let [now, before] = [&self.now, &self.before].map(|data| View::new(data, camera, [rows, columns]));
        let pixels: Vec<[f64; 2]> = pixels_of([rows, columns]).collect();
        let rays: Vec<[f64; 3]> = pixels.iter().map(|pixel| now.ray(*pixel)).collect();
        let hits = now.cast(&mut self.now, &rays);
        let places: Vec<[f64; 3]> = rays
            .iter()
            .zip(&hits)
            .map(|(ray, hit)| {
                let place = along(now.place, *ray, hit.map_or(FAR, |hit| hit.distance));
                hit.map_or(place, |hit| self.moved_back(hit.geom, place))
            })
            .collect();
        // Rays from the earlier camera to the earlier points. A ray that ends before its point hits something in front
        // of it.
        let ways: Vec<([f64; 3], f64)> = places.iter().map(|place| direction(before.place, *place)).collect();
        let directions: Vec<[f64; 3]> = ways.iter().map(|(direction, _)| *direction).collect();
        let met = before.cast(&mut self.before, &directions);
        self.pixels.clear();
        for (index, [column, row]) in pixels.into_iter().enumerate() {
            let was = before.project(places[index]);
            let (direction, length) = ways[index];
            let was_rendered = hits[index].is_none_or(|hit| {
                let normal = self.turned_back(hit.geom, hit.normal);
                before.renders(direction, &Hit { distance: length, normal, ..hit })
            });
            let is_in_sight =
                was_rendered && met[index].is_none_or(|hit| hit.distance >= (1.0 - ROUNDING) * length);
            let is_in_frame = was.is_some_and(|[column, row]| {
                (0.0..columns as f64).contains(&column) && (0.0..rows as f64).contains(&row)
            });
            let [right, down] = was.map_or([0.0; 2], |was| [column - was[0], row - was[1]]);
            let coded =
                |pixels: f64| (128.0 + 127.0 * (pixels / self.of.limit).clamp(-1.0, 1.0)).round() as u8;
            let seen = if is_in_sight && is_in_frame { 255 } else { 0 };
            let pixel: [u8; IMAGE_CHANNELS] = [coded(right), coded(down), seen];
            self.pixels.extend(pixel);
        }
        &self.pixels
    }

    /// Returns where a point on a geom was at the sample before.
    fn moved_back(&self, geom: usize, place: [f64; 3]) -> [f64; 3] {
        let (now, before) = (&self.now, &self.before);
        let away: [f64; 3] = std::array::from_fn(|axis| place[axis] - now.geom_xpos()[geom][axis]);
        let turned = self.turned_back(geom, away);
        std::array::from_fn(|axis| before.geom_xpos()[geom][axis] + turned[axis])
    }

    /// Returns the direction at the sample before of a vector that turns with a geom.
    fn turned_back(&self, geom: usize, vector: [f64; 3]) -> [f64; 3] {
        to_world(&self.before.geom_xmat()[geom], to_own(&self.now.geom_xmat()[geom], vector))
    }
}

impl View {
    fn new(data: &MjData<Arc<MjModel>>, camera: usize, size: [usize; 2]) -> Self {
        let half_angle = 0.5 * data.model().cam_fovy()[camera].to_radians();
        let focal = 0.5 * size[0] as f64 / half_angle.tan();
        let near = f64::from(data.model().vis().map.znear) * data.model().stat().extent;
        Self { place: data.cam_xpos()[camera], turn: data.cam_xmat()[camera], focal, near, size }
    }

    /// Casts rays of length 1 from the camera, and returns what is rendered along each.
    fn cast(&self, data: &mut MjData<Arc<MjModel>>, rays: &[[f64; 3]]) -> Vec<Option<Hit>> {
        let hits = self.hits(data, rays);
        hits.into_iter().zip(rays).map(|(hit, ray)| self.rendered(data, *ray, hit)).collect()
    }

    /// Casts rays of length 1 from the camera, and returns the nearest geom on each, rendered or not.
    fn hits(&self, data: &mut MjData<Arc<MjModel>>, rays: &[[f64; 3]]) -> Vec<Option<Hit>> {
        let mut normals = vec![[0.0; 3]; rays.len()];
        let (geoms, distances) =
            data.multi_ray(&self.place, rays, Some(&SEEN_GROUPS), true, None, FAR, Some(&mut normals));
        let hit = |index: usize| {
            let (distance, normal) = (distances[index], normals[index]);
            geoms[index].map(|geom| Hit { geom, distance, normal })
        };
        (0..rays.len()).map(hit).collect()
    }

    /// Follows a ray from its first hit to the first one that is rendered.
    fn rendered(&self, data: &mut MjData<Arc<MjModel>>, ray: [f64; 3], first: Option<Hit>) -> Option<Hit> {
        let mut found = first;
        while let Some(hit) = found.filter(|hit| !self.renders(ray, hit)) {
            // The ray's length up to the near plane, which no ray to a point behind the camera reaches.
            let unseen = Some(self.near / self.depth(ray)).filter(|length| (0.0..FAR).contains(length));
            let passed = (hit.distance + STEP * self.near).max(unseen.unwrap_or(0.0));
            let (from, mut normal) = (along(self.place, ray, passed), [0.0; 3]);
            let (geom, further) = data.ray(&from, &ray, Some(&SEEN_GROUPS), true, None, Some(&mut normal));
            found = geom.map(|geom| Hit { geom, distance: passed + further, normal });
        }
        found
    }

    /// Whether a point that a ray from the camera hits is on a face that looks to the camera and is behind the near
    /// plane.
    fn renders(&self, ray: [f64; 3], hit: &Hit) -> bool {
        dot(hit.normal, ray) <= 0.0 && hit.distance * self.depth(ray) >= self.near
    }

    /// Returns by how much the distance from the camera's plane grows along a ray of length 1.
    fn depth(&self, ray: [f64; 3]) -> f64 {
        -to_own(&self.turn, ray)[2]
    }

    fn middle(&self) -> [f64; 2] {
        [0.5 * self.size[1] as f64, 0.5 * self.size[0] as f64]
    }

    /// Returns the direction, of length 1, of the ray through a point in the image (column, row).
    fn ray(&self, [column, row]: [f64; 2]) -> [f64; 3] {
        let [x, y] = self.middle();
        let own = [(column - x) / self.focal, (y - row) / self.focal, -1.0];
        direction([0.0; 3], to_world(&self.turn, own)).0
    }

    /// Projects a point in the world into the image (column, row); `None` if it is behind the camera.
    fn project(&self, place: [f64; 3]) -> Option<[f64; 2]> {
        let away = std::array::from_fn(|axis| place[axis] - self.place[axis]);
        let [right, up, back] = to_own(&self.turn, away);
        let [x, y] = self.middle();
        (back < 0.0).then(|| [x - self.focal * right / back, y + self.focal * up / back])
    }
}

/// Returns the direction, of length 1, from one point to another, and the distance.
fn direction(from: [f64; 3], to: [f64; 3]) -> ([f64; 3], f64) {
    let way: [f64; 3] = std::array::from_fn(|axis| to[axis] - from[axis]);
    let length = way.iter().map(|value| value * value).sum::<f64>().sqrt();
    (way.map(|value| value / length), length)
}

/// Returns the point at a distance from another one.
fn along(from: [f64; 3], direction: [f64; 3], distance: f64) -> [f64; 3] {
    std::array::from_fn(|axis| from[axis] + distance * direction[axis])
}

fn dot(one: [f64; 3], other: [f64; 3]) -> f64 {
    one.iter().zip(other).map(|(one, other)| one * other).sum()
}

/// Transforms a vector from the world's axes to the columns of a rotation matrix.
fn to_own(turn: &[f64; 9], vector: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|column| (0..3).map(|row| turn[3 * row + column] * vector[row]).sum())
}

/// Transforms a vector from the columns of a rotation matrix to the world's axes.
fn to_world(turn: &[f64; 9], vector: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|row| (0..3).map(|column| turn[3 * row + column] * vector[column]).sum())
}
