//! True optical flow: the displacement of each pixel's content in a camera's image since the sample before.
//!
//! A ray through the center of each pixel hits a point on a geom. Geoms are rigid, so the geom's pose at the sample
//! before gives the earlier position of that point. The camera's earlier pose then gives its earlier pixel.

use super::physics::Instant;
use super::resolve::{SceneCamera, SceneFlow};
use super::scene::Scene;
use harness_spec::IMAGE_CHANNELS;
use mujoco_rs::prelude::*;
use std::sync::Arc;

/// The geom groups that cameras render.
const SEEN_GROUPS: [u8; 6] = [1, 1, 1, 0, 0, 0];
/// Assumed distance if a ray hits no geom, m.
const FAR: f64 = 1e6;
/// Relative tolerance of a ray's length for rounding.
const ROUNDING: f64 = 1e-6;

/// Computes the optical flow of one camera.
pub(super) struct Flow {
    of: SceneFlow,
    now: MjData<Arc<MjModel>>,
    before: MjData<Arc<MjModel>>,
    pixels: Vec<u8>,
}

/// The pose of a camera at an instant.
struct View {
    place: [f64; 3],
    /// Rotation matrix, row by row. Its columns are the camera's axes (right, up, backwards).
    turn: [f64; 9],
    /// Focal length, pixels.
    focal: f64,
    size: [usize; 2],
}

impl Flow {
    pub fn new(scene: &Scene, of: SceneFlow) -> Self {
        let data = || MjData::new(scene.model.clone());
        Self { of, now: data(), before: data(), pixels: Vec::new() }
    }

    /// Computes the flow at a sample as an image, `[rows, columns, 3]`. Red is 128 plus 127 / limit for each pixel of
    /// displacement to the right, and green is the same downwards. Blue is 255 if the point was visible at the sample
    /// before, and 0 otherwise.
    pub fn render(&mut self, instant: &Instant) -> &[u8] {
        for (data, qpos) in [(&mut self.now, &instant.qpos), (&mut self.before, &instant.qpos_before)] {
            data.swap_model(instant.model.clone());
            data.qpos_mut().copy_from_slice(qpos);
            data.kinematics();
            data.com_pos();
            data.camlight();
        }
        let SceneCamera { camera, size: [rows, columns], .. } = self.of.image;
        let [now, before] = [&self.now, &self.before].map(|data| View::new(data, camera, [rows, columns]));
        let pixels =
            (0..rows * columns).map(|pixel| [pixel % columns, pixel / columns].map(|at| at as f64 + 0.5));
        let pixels: Vec<[f64; 2]> = pixels.collect();
        let rays: Vec<[f64; 3]> = pixels.iter().map(|pixel| now.ray(*pixel)).collect();
        let (geoms, distances) = cast(&mut self.now, now.place, &rays);
        let places: Vec<[f64; 3]> = (0..rays.len())
            .map(|ray| {
                let distance = if geoms[ray].is_some() { distances[ray] } else { FAR };
                let place = std::array::from_fn(|axis| now.place[axis] + distance * rays[ray][axis]);
                geoms[ray].map_or(place, |geom| self.moved_back(geom, place))
            })
            .collect();
        // Rays from the earlier camera to the earlier points. A ray that ends before its point hits something in front
        // of it.
        let ways: Vec<([f64; 3], f64)> = places.iter().map(|place| direction(before.place, *place)).collect();
        let directions: Vec<[f64; 3]> = ways.iter().map(|(direction, _)| *direction).collect();
        let (met, reached) = cast(&mut self.before, before.place, &directions);
        self.pixels.clear();
        for (index, [column, row]) in pixels.into_iter().enumerate() {
            let was = before.project(places[index]);
            let is_in_sight = met[index].is_none() || reached[index] >= (1.0 - ROUNDING) * ways[index].1;
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
        let own = to_own(&now.geom_xmat()[geom], away);
        let turned = to_world(&before.geom_xmat()[geom], own);
        std::array::from_fn(|axis| before.geom_xpos()[geom][axis] + turned[axis])
    }
}

/// Casts rays of length 1 from a point. Returns the geom that each one hits and the distance to it, m.
fn cast(
    data: &mut MjData<Arc<MjModel>>,
    from: [f64; 3],
    rays: &[[f64; 3]],
) -> (Vec<Option<usize>>, Vec<f64>) {
    data.multi_ray(&from, rays, Some(&SEEN_GROUPS), true, None, FAR, None)
}

impl View {
    fn new(data: &MjData<Arc<MjModel>>, camera: usize, size: [usize; 2]) -> Self {
        let half_angle = 0.5 * data.model().cam_fovy()[camera].to_radians();
        let focal = 0.5 * size[0] as f64 / half_angle.tan();
        Self { place: data.cam_xpos()[camera], turn: data.cam_xmat()[camera], focal, size }
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

/// Transforms a vector from the world's axes to the columns of a rotation matrix.
fn to_own(turn: &[f64; 9], vector: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|column| (0..3).map(|row| turn[3 * row + column] * vector[row]).sum())
}

/// Transforms a vector from the columns of a rotation matrix to the world's axes.
fn to_world(turn: &[f64; 9], vector: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|row| (0..3).map(|column| turn[3 * row + column] * vector[column]).sum())
}
