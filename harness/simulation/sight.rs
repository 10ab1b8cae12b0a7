//! What each pixel of a camera's image shows and how far away it is, by MuJoCo's segmentation.
//!
//! MuJoCo draws each object in a color that is its number, without light and smooth edges, and keeps the depth of each
//! pixel. One drawing gives both.

use super::SimulationError;
use super::opengl::{DECORATIONS, current_renderer_name, open_renderer, plain};
use super::resolved::{Code, SceneSight};
use super::scene::Scene;
use harness_spec::{CLASS_COLORS, IMAGE_CHANNELS};
use mujoco_rs::prelude::*;
use mujoco_rs::renderer::MjRenderer;
use mujoco_rs::wrappers::mj_model::traits::ModelType;

/// Draws what a camera sees, on the thread that created it.
pub(super) struct Sight {
    scene: MjvScene,
    context: MjrContext,
    camera: MjvCamera,
    option: MjvOption,
    area: MjrRectangle,
    /// The color of each pixel, bottom row first: the number of the object plus 1 in 24 bits, or black.
    numbers: Vec<u8>,
    /// The depth of each pixel in the same order, from 0 at the near plane to 1 at the far plane.
    depths: Vec<f32>,
    /// The distances of both planes, m.
    planes: [f32; 2],
    renderer_name: String,
    /// Owns the OpenGL context, and can make it current. It draws nothing, and must be dropped last.
    holder: MjRenderer,
}

impl Sight {
    /// Creates a renderer for a camera and a size of the scene.
    ///
    /// # Errors
    /// When there is no OpenGL to render with.
    pub fn new(scene: &Scene, of: &SceneSight) -> Result<Self, SimulationError> {
        let [rows, columns] = of.size;
        let empty = MjModel::from_xml_string("<mujoco/>").expect("an empty model compiles");
        let holder = open_renderer(&empty, 1, 1)?;
        let model = plain(&scene.model);
        let mut drawn = MjvScene::new(&model, model.ngeom() as usize + DECORATIONS as usize);
        for flag in [MjtRndFlag::mjRND_SEGMENT, MjtRndFlag::mjRND_IDCOLOR] {
            drawn.flags_mut()[flag as usize] = 1;
        }
        // SAFETY: opening the holder has made its OpenGL context current. The holder is dropped after this one, and
        // `drop` makes the context current before.
        let context = unsafe { MjrContext::new(&model) };
        let (map, extent) = (&model.vis().map, model.stat().extent as f32);
        Ok(Self {
            scene: drawn,
            context,
            camera: MjvCamera::new_fixed(of.camera),
            option: MjvOption::default(),
            area: MjrRectangle::new(0, 0, columns as i32, rows as i32),
            numbers: vec![0; rows * columns * IMAGE_CHANNELS],
            depths: vec![0.0; rows * columns],
            planes: [map.znear * extent, map.zfar * extent],
            renderer_name: current_renderer_name(),
            holder,
        })
    }

    /// Draws a state.
    pub fn look<M: ModelType>(&mut self, data: &mut MjData<M>) -> Result<(), SimulationError> {
        self.scene.update(data, &self.option, &MjvPerturb::default(), &mut self.camera);
        self.make_current()?;
        self.context.offscreen();
        self.scene.render(&self.area, &self.context);
        self.context
            .read_pixels(Some(&mut self.numbers), Some(&mut self.depths), &self.area)
            .map_err(|error| SimulationError::Render(RendererError::ContextError(error)))
    }

    fn make_current(&mut self) -> Result<(), SimulationError> {
        // The holder's scene is empty.
        self.holder.render().map_err(SimulationError::Render)
    }

    /// Appends what was seen last to `pixels` as an image, top row first, `[rows, columns, 3]`.
    pub fn encode(&self, code: &Code, pixels: &mut Vec<u8>) {
        let columns = self.area.width as usize;
        let classes = match code {
            Code::Classes { of_geom, of_flex } => self.classes(of_geom, of_flex),
            Code::Depth(_) => Vec::new(),
        };
        let rows = self.numbers.chunks_exact(columns * IMAGE_CHANNELS).zip(self.depths.chunks_exact(columns));
        for (numbers, depths) in rows.rev() {
            for (number, depth) in numbers.chunks_exact(IMAGE_CHANNELS).zip(depths) {
                let number = number.iter().rev().fold(0, |sum, byte| sum << 8 | usize::from(*byte));
                let seen = number.checked_sub(1);
                pixels.extend(match code {
                    Code::Depth(range_m) => depth_color(seen.map(|_| self.depth_m(*depth)), *range_m),
                    Code::Classes { .. } => {
                        let class = seen.and_then(|seen| classes.get(seen).copied().flatten());
                        class.map_or([0; IMAGE_CHANNELS], |class| CLASS_COLORS[class].1)
                    }
                });
            }
        }
    }

    /// Returns the class of each object of the drawing, by its number.
    fn classes(&self, of_geom: &[Option<usize>], of_flex: &[Option<usize>]) -> Vec<Option<usize>> {
        let objects = self.scene.geoms();
        let mut classes = vec![None; objects.len()];
        for object in objects {
            let of = match object.objtype {
                kind if kind == MjtObj::mjOBJ_GEOM as i32 => of_geom,
                kind if kind == MjtObj::mjOBJ_FLEX as i32 => of_flex,
                _ => continue,
            };
            let place = usize::try_from(object.segid).ok().and_then(|number| classes.get_mut(number));
            if let (Some(class), Ok(id)) = (place, usize::try_from(object.objid)) {
                *class = of.get(id).copied().flatten();
            }
        }
        classes
    }

    /// Converts a value of the depth buffer to the distance from the camera's plane, m.
    fn depth_m(&self, value: f32) -> f64 {
        let [near, far] = self.planes;
        f64::from(near / (1.0 - value * (1.0 - near / far)))
    }

    /// Returns the name of the OpenGL renderer.
    pub fn renderer_name(&self) -> &str {
        &self.renderer_name
    }
}

impl Drop for Sight {
    fn drop(&mut self) {
        // What fails here can't be drawn either.
        let _ = self.make_current();
    }
}

/// Returns the color of a pixel of a depth image. `depth` is the distance from the camera's plane, m; `None` if nothing
/// is visible.
fn depth_color(depth: Option<f64>, [low, high]: [f64; 2]) -> [u8; IMAGE_CHANNELS] {
    let byte = |share: f64| (255.0 * share.clamp(0.0, 1.0)).round() as u8;
    match depth {
        Some(depth) => [byte((depth - low) / (high - low)), byte(low / depth), 255],
        None => [255, 0, 0],
    }
}

#[cfg(test)]
mod tests {
    use super::depth_color;

    #[test]
    fn depths_are_bytes_that_can_be_decoded() {
        for (depth, expected) in [
            (Some(0.25), [0, 255, 255]),
            (Some(0.5), [0, 255, 255]),
            // Half-way from 0.5 to 2.5 m: 127.5 is rounded up; 255 / 3.
            (Some(1.5), [128, 85, 255]),
            (Some(2.5), [255, 51, 255]),
            (Some(5.0), [255, 26, 255]),
            (None, [255, 0, 0]),
        ] {
            assert_eq!(depth_color(depth, [0.5, 2.5]), expected, "{depth:?}");
        }
    }
}
