//! Renders the cameras' images: small ones for the networks and large ones for figures and videos.

use super::SimulationError;
use super::factors::FactorValues;
use super::opengl::{current_renderer_name, open_renderer, plain};
use super::resolved::{Code, SceneCamera};
use super::scene::{Scene, write_state};
use super::sight::Sight;
use image::RgbImage;
use mujoco_rs::prelude::*;
use mujoco_rs::renderer::MjRenderer;
use mujoco_rs::wrappers::mj_model::traits::ModelType;
use std::sync::Arc;
use std::time::Instant;

/// Longest side of a picture, pixels. A buffer larger than the driver's limit would end the process.
const MAX_PICTURE_SIDE: u32 = 4096;

/// Renders a scene's state from one of its cameras, on the thread that created it.
pub struct Camera {
    renderer: MjRenderer,
    renderer_name: String,
}

impl Camera {
    /// Creates a renderer for the scene's view, which is MuJoCo's free camera if the scene has no camera. `width` and
    /// `height` are in pixels.
    ///
    /// # Errors
    /// When there is no OpenGL to render with, or the model's offscreen buffer is smaller than the frame.
    pub fn new(scene: &Scene, width: u32, height: u32) -> Result<Self, SimulationError> {
        Self::for_model(&scene.model, scene, scene.resolved.view, width, height)
    }

    /// Creates a renderer for a camera that is recorded.
    pub(super) fn recording(scene: &Scene, recorded: &SceneCamera) -> Result<Self, SimulationError> {
        let [rows, columns] = recorded.size;
        Self::for_model(&scene.model, scene, Some(recorded.camera), columns as u32, rows as u32)
    }

    fn for_model(
        model: &MjModel,
        scene: &Scene,
        camera: Option<usize>,
        width: u32,
        height: u32,
    ) -> Result<Self, SimulationError> {
        let buffer = &model.vis().global;
        if width as i32 > buffer.offwidth || height as i32 > buffer.offheight {
            let problem = format!(
                "its offscreen buffer of {} x {} is too small for frames of {width} x {height}: \
                 set offwidth and offheight in <visual><global>",
                buffer.offwidth, buffer.offheight
            );
            return Err(SimulationError::Unsuitable { scene: scene.name.clone(), problem });
        }
        let mut renderer = open_renderer(model, width, height)?;
        let camera = camera.map_or_else(|| MjvCamera::new_free(model), MjvCamera::new_fixed);
        renderer.set_camera(camera);
        Ok(Self { renderer, renderer_name: current_renderer_name() })
    }

    /// Renders the state and returns its RGB pixels, top row first, `[height, width, 3]`.
    pub fn capture<M: ModelType>(&mut self, data: &mut MjData<M>) -> Result<&[u8], SimulationError> {
        self.renderer.sync_data(data).map_err(SimulationError::Render)?;
        self.renderer.render().map_err(SimulationError::Render)?;
        Ok(self.renderer.rgb_flat().expect("color rendering is on by default"))
    }

    /// Returns the name of the OpenGL renderer.
    pub fn renderer_name(&self) -> &str {
        &self.renderer_name
    }
}

/// Number of times that rendering is measured. The shortest time counts, because others may include other work.
const MEASUREMENTS: usize = 5;

/// How long rendering the images of a sample takes.
#[derive(Debug, Clone, Copy)]
pub struct SampleTime {
    /// With the settings of the model, s.
    pub own_s: f64,
    /// Without shadows and smooth edges, s; `None` if the model has neither.
    pub plain_s: Option<f64>,
}

/// Measures how long the images of a sample take to render; `None` if no image is recorded that is rendered.
pub(super) fn time_rendering<M: ModelType>(
    scene: &Scene,
    data: &mut MjData<M>,
) -> Result<Option<SampleTime>, SimulationError> {
    if scene.resolved.cameras.is_empty() && scene.resolved.sights.is_empty() {
        return Ok(None);
    }
    let mut coded_s = 0.0;
    for of in &scene.resolved.sights {
        let mut sight = Sight::new(scene, of)?;
        coded_s += shortest(|| sight.look(data))?;
    }
    let mut time = |model: &MjModel| -> Result<f64, SimulationError> {
        let mut total = coded_s;
        for SceneCamera { camera, size: [rows, columns], .. } in &scene.resolved.cameras {
            let mut camera = Camera::for_model(model, scene, Some(*camera), *columns as u32, *rows as u32)?;
            total += shortest(|| camera.capture(data).map(drop))?;
        }
        Ok(total)
    };
    let quality = &scene.model.vis().quality;
    let is_plain = (quality.shadowsize, quality.offsamples) == (0, 0);
    let own_s = time(&scene.model)?;
    let plain_s = if is_plain { None } else { Some(time(&plain(&scene.model))?) };
    Ok(Some(SampleTime { own_s, plain_s }))
}

/// Returns the shortest time that some work takes, s.
fn shortest(mut work: impl FnMut() -> Result<(), SimulationError>) -> Result<f64, SimulationError> {
    let mut shortest = f64::INFINITY;
    for _ in 0..MEASUREMENTS {
        let begun = Instant::now();
        work()?;
        shortest = shortest.min(begun.elapsed().as_secs_f64());
    }
    Ok(shortest)
}

/// Renders pictures for figures and videos, with shadows, smooth edges and round capsules, up to 4096 pixels wide or
/// high.
pub struct SceneRenderer<'s> {
    scene: &'s Scene,
    /// The scene's model with better visual quality, and without factors of variation.
    model: Arc<MjModel>,
    /// The values of the model in `data`.
    factors: FactorValues,
    data: MjData<Arc<MjModel>>,
    /// The model's camera; `None` for MuJoCo's free camera.
    view: Option<usize>,
    eye: Eye,
    size: [u32; 2],
}

/// What draws a picture.
enum Eye {
    Camera(Box<Camera>),
    /// The image of a modality that encodes depth or classes.
    Sight(Box<Sight>, Code),
}

impl<'s> SceneRenderer<'s> {
    /// Creates a renderer for pictures of `width` x `height` pixels from the scene's view.
    ///
    /// # Errors
    /// When a side is 0 or above 4096 pixels, or there is no OpenGL to render with.
    pub fn new(scene: &'s Scene, width: u32, height: u32) -> Result<Self, SimulationError> {
        check_size(width, height)?;
        Self::of_model(scene, good_looking(&scene.model, width, height), scene.resolved.view, [width, height])
    }

    /// Creates a renderer for pictures of `width` x `height` pixels from a camera of the model.
    ///
    /// # Errors
    /// When the model has no camera of this name, and for the reasons of [`SceneRenderer::new`].
    pub fn from_camera(
        scene: &'s Scene,
        name: &str,
        width: u32,
        height: u32,
    ) -> Result<Self, SimulationError> {
        check_size(width, height)?;
        let cameras = scene.camera_names();
        let Some(camera) = cameras.iter().position(|camera| camera == name) else {
            return Err(unknown_camera(scene, name, &cameras));
        };
        Self::of_model(scene, good_looking(&scene.model, width, height), Some(camera), [width, height])
    }

    /// Creates a renderer for the images that a modality of the scene records, with their size and quality. Without
    /// `name`, it is the first modality that records a camera. `name` is that of the modality, which may also record a
    /// depth or a segmentation, or that of the camera.
    ///
    /// # Errors
    /// When no such modality records an image that can be rendered, or there is no OpenGL to render with.
    pub fn as_recorded(scene: &'s Scene, name: Option<&str>) -> Result<Self, SimulationError> {
        let cameras = scene.camera_names();
        let is_meant = |recorded: &&SceneCamera| {
            name.is_none_or(|name| recorded.modality.name() == name || cameras[recorded.camera] == name)
        };
        if let Some((of, coded)) = name.and_then(|name| scene.coded(name)) {
            let eye = Eye::Sight(Box::new(Sight::new(scene, of)?), coded.code.clone());
            let [rows, columns] = of.size.map(|side| side as u32);
            return Ok(Self::with_eye(scene, scene.model.clone(), Some(of.camera), eye, [columns, rows]));
        }
        let Some(recorded) = scene.resolved.cameras.iter().find(is_meant) else {
            let recorded: Vec<String> = scene.rendered().map(|recorded| recorded.to_string()).collect();
            return Err(match name {
                Some(name) if !recorded.is_empty() => unknown_camera(scene, name, &recorded),
                _ => SimulationError::Unsuitable {
                    scene: scene.name.clone(),
                    problem: "no modality records a camera, so a network sees no image of it".into(),
                },
            });
        };
        let [rows, columns] = recorded.size.map(|side| side as u32);
        Self::of_model(scene, (*scene.model).clone(), Some(recorded.camera), [columns, rows])
    }

    /// Creates a renderer whose camera is at the same place, but points at a body. Its vertical field of view is
    /// `angle_deg` degrees.
    ///
    /// # Errors
    /// When the scene has no such body or no camera, and for the reasons of [`SceneRenderer::new`].
    pub fn close_up(
        scene: &'s Scene,
        width: u32,
        height: u32,
        body: &str,
        angle_deg: f64,
    ) -> Result<Self, SimulationError> {
        check_size(width, height)?;
        let mut model = good_looking(&scene.model, width, height);
        let body = scene.id(MjtObjBase::mjOBJ_BODY, "body", body)?;
        let camera = scene.resolved.view.ok_or_else(|| SimulationError::Unsuitable {
            scene: scene.name.clone(),
            problem: "it has no camera".into(),
        })?;
        model.cam_mode_mut()[camera] = MjtCamLight::mjCAMLIGHT_TARGETBODY;
        // SAFETY: the index is that of a body of this model.
        unsafe { model.cam_targetbodyid_mut()[camera] = body as i32 };
        model.cam_fovy_mut()[camera] = angle_deg;
        Self::of_model(scene, model, Some(camera), [width, height])
    }

    fn of_model(
        scene: &'s Scene,
        model: MjModel,
        view: Option<usize>,
        size: [u32; 2],
    ) -> Result<Self, SimulationError> {
        let model = Arc::new(model);
        let eye = Eye::Camera(Box::new(Camera::for_model(&model, scene, view, size[0], size[1])?));
        Ok(Self::with_eye(scene, model, view, eye, size))
    }

    fn with_eye(
        scene: &'s Scene,
        model: Arc<MjModel>,
        view: Option<usize>,
        eye: Eye,
        size: [u32; 2],
    ) -> Self {
        let data = scene.at_rest(model.clone());
        Self { scene, model, factors: FactorValues::default(), data, view, eye, size }
    }

    /// Renders all further pictures with these values of the factors of variation, as in [`super::EpisodePlan`].
    pub fn vary(&mut self, factors: &FactorValues) {
        if self.factors != *factors {
            self.data.swap_model(factors.apply(self.scene, &self.model));
            self.factors = factors.clone();
        }
    }

    /// Returns the position of a geom's center in the world in the last picture, m.
    pub fn place_of(&self, geom: &str) -> Result<[f64; 3], SimulationError> {
        Ok(self.data.geom_xpos()[self.scene.id(MjtObjBase::mjOBJ_GEOM, "geom", geom)?])
    }

    /// Projects a point in the world (m) into the last picture. Returns the distance from the left edge as a fraction
    /// of the width, and from the top edge as a fraction of the height. The point must be in front of the camera.
    ///
    /// # Panics
    /// When the scene has no camera.
    pub fn project(&self, place: [f64; 3]) -> [f64; 2] {
        let view = self.view.expect("the scene has no camera to project into");
        let (camera, turn) = (self.data.cam_xpos()[view], self.data.cam_xmat()[view]);
        let away: [f64; 3] = std::array::from_fn(|axis| place[axis] - camera[axis]);
        // The columns of the matrix are the camera's axes: right, up and backwards.
        let [right, up, back]: [f64; 3] =
            std::array::from_fn(|column| (0..3).map(|row| turn[3 * row + column] * away[row]).sum());
        let half = (self.data.model().cam_fovy()[view].to_radians() / 2.0).tan();
        let aspect = f64::from(self.size[0]) / f64::from(self.size[1]);
        [0.5 + right / (-back * 2.0 * half * aspect), 0.5 - up / (-back * 2.0 * half)]
    }

    /// Renders the scene with these positions, for example from [`super::replay`].
    ///
    /// # Errors
    /// When the number of positions is not that of the scene, or OpenGL fails.
    pub fn render(&mut self, state: &[f64]) -> Result<RgbImage, SimulationError> {
        let expected = self.scene.rest().len();
        if state.len() != expected {
            return Err(SimulationError::Other(format!(
                "a state of {} values does not fit {}, which has {expected} position coordinates",
                state.len(),
                self.scene.name
            )));
        }
        write_state(state, &mut self.data);
        self.data.forward();
        let pixels = match &mut self.eye {
            Eye::Camera(camera) => camera.capture(&mut self.data)?.to_vec(),
            Eye::Sight(sight, code) => {
                let mut pixels = Vec::new();
                sight.look(&mut self.data)?;
                sight.encode(code, &mut pixels);
                pixels
            }
        };
        let [width, height] = self.size;
        Ok(RgbImage::from_raw(width, height, pixels).expect("the frame has the size that was asked for"))
    }
}

/// The error that there is no camera of this name, with the names that there are.
fn unknown_camera(scene: &Scene, name: &str, there: &[String]) -> SimulationError {
    let there = if there.is_empty() { "none".into() } else { there.join(", ") };
    let problem = format!("there is no camera '{name}'; available: {there}");
    SimulationError::Unsuitable { scene: scene.name.clone(), problem }
}

fn check_size(width: u32, height: u32) -> Result<(), SimulationError> {
    let range = 1..=MAX_PICTURE_SIDE;
    if range.contains(&width) && range.contains(&height) {
        return Ok(());
    }
    Err(SimulationError::Argument(format!(
        "a picture of {width} x {height} pixels is out of range: each side must be 1 to {MAX_PICTURE_SIDE}"
    )))
}

/// Returns a copy of the model with shadows and MuJoCo's default visual quality, which the models lower for speed.
fn good_looking(model: &MjModel, width: u32, height: u32) -> MjModel {
    let mut model = model.clone();
    let visual = model.vis_mut();
    visual.global.offwidth = width as i32;
    visual.global.offheight = height as i32;
    let quality = &mut visual.quality;
    (quality.shadowsize, quality.offsamples) = (4096, 4);
    (quality.numslices, quality.numstacks, quality.numquads) = (28, 16, 4);
    // The default shadow map covers less ground than the camera sees, and causes moire on the rest.
    visual.map.shadowclip = 3.0;
    model.light_castshadow_mut().fill(true);
    model
}
