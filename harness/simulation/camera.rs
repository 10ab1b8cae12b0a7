//! Cameras: small frames for the networks, large pictures for people.

use super::SimulationError;
use super::factors::FactorValues;
use super::scene::{Scene, SceneCamera, prepare};
use image::RgbImage;
use mujoco_rs::prelude::*;
use mujoco_rs::renderer::MjRenderer;
use mujoco_rs::wrappers::mj_model::traits::ModelType;
use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::sync::Arc;

/// Longest side of a picture, pixels; larger buffers than a driver has would end the process.
const MAX_PICTURE_SIDE: u32 = 4096;

/// Makes software rendering use the calling threads alone; they are as many as the cores already.
///
/// Mesa's llvmpipe otherwise starts a pool for every OpenGL context, which costs more than frames of 64 x 64
/// do. A value of `LP_NUM_THREADS` that the user has set stays. Graphics cards ignore it.
///
/// # Safety
/// Changes the environment, so no other thread may run: call it first thing in `main`.
pub unsafe fn prepare_rendering() {
    if std::env::var_os("LP_NUM_THREADS").is_none() {
        // SAFETY: the caller promises that this is the only thread.
        unsafe { std::env::set_var("LP_NUM_THREADS", "0") };
    }
}

/// Which OpenGL renderer answers, for example "llvmpipe (LLVM 15.0.6, 256 bits)".
///
/// # Errors
/// When there is no OpenGL to render with, or MuJoCo's library is of another version.
pub fn renderer_name() -> Result<String, SimulationError> {
    prepare()?;
    let model = MjModel::from_xml_string("<mujoco/>").expect("an empty model compiles");
    let _renderer = open_renderer(&model, 1, 1)?;
    Ok(current_renderer_name())
}

/// Films a scene's state from one of its cameras, on the thread that made it.
pub struct Camera {
    renderer: MjRenderer,
    renderer_name: String,
}

impl Camera {
    /// # Errors
    /// When there is no OpenGL to render with, or the model's offscreen buffer is smaller than the frame.
    pub fn new(scene: &Scene, width: u32, height: u32) -> Result<Self, SimulationError> {
        Self::for_model(&scene.model, scene, scene.view, width, height)
    }

    /// One that is recorded.
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

    /// Draws the state: RGB, top row first, `[height, width, 3]`.
    ///
    /// # Errors
    /// When OpenGL fails.
    pub fn capture<M: ModelType>(&mut self, data: &mut MjData<M>) -> Result<&[u8], SimulationError> {
        self.renderer.sync_data(data).map_err(SimulationError::Render)?;
        self.renderer.render().map_err(SimulationError::Render)?;
        Ok(self.renderer.rgb_flat().expect("colour rendering is on by default"))
    }

    /// Which OpenGL renderer draws the frames.
    pub fn renderer_name(&self) -> &str {
        &self.renderer_name
    }
}

/// Draws pictures for people: with shadows, smooth edges and round capsules, at any resolution.
pub struct SceneRenderer<'s> {
    scene: &'s Scene,
    /// The scene's model with a better look, and without what an episode drew.
    model: Arc<MjModel>,
    data: MjData<Arc<MjModel>>,
    camera: Camera,
    size: [u32; 2],
}

impl<'s> SceneRenderer<'s> {
    /// # Errors
    /// When a side is 0 or above 4096 pixels, or there is no OpenGL to render with.
    pub fn new(scene: &'s Scene, width: u32, height: u32) -> Result<Self, SimulationError> {
        check_size(width, height)?;
        Self::of_model(scene, good_looking(&scene.model, width, height), [width, height])
    }

    /// A renderer from the same place, of a body in the middle and with a field of view of `angle_deg` from top to
    /// bottom.
    ///
    /// # Errors
    /// As [`SceneRenderer::new`], and when the scene has no such body.
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
        let camera = scene.view.ok_or_else(|| SimulationError::Unsuitable {
            scene: scene.name.clone(),
            problem: "it has no camera".into(),
        })?;
        model.cam_mode_mut()[camera] = MjtCamLight::mjCAMLIGHT_TARGETBODY;
        // SAFETY: the index is that of a body of this model.
        unsafe { model.cam_targetbodyid_mut()[camera] = body as i32 };
        model.cam_fovy_mut()[camera] = angle_deg;
        Self::of_model(scene, model, [width, height])
    }

    fn of_model(scene: &'s Scene, model: MjModel, size: [u32; 2]) -> Result<Self, SimulationError> {
        let model = Arc::new(model);
        let camera = Camera::for_model(&model, scene, scene.view, size[0], size[1])?;
        Ok(Self { scene, data: MjData::new(model.clone()), model, camera, size })
    }

    /// Draws what an episode drew of the factors of variation from now on, as in [`super::EpisodePlan`].
    pub fn vary(&mut self, factors: &FactorValues) {
        self.data.swap_model(factors.apply(self.scene, &self.model));
    }

    /// Where a geom's middle was in the world when the scene was drawn last, m.
    ///
    /// # Errors
    /// When the scene has no such geom.
    pub fn place_of(&self, geom: &str) -> Result<[f64; 3], SimulationError> {
        Ok(self.data.geom_xpos()[self.scene.id(MjtObjBase::mjOBJ_GEOM, "geom", geom)?])
    }

    /// Where a place in the world, m, lies in the picture that was drawn last: from its upper left corner to the
    /// right and down, in parts of its width and height. The place must be before the camera.
    ///
    /// # Panics
    /// The scene has no camera.
    pub fn project(&self, place: [f64; 3]) -> [f64; 2] {
        let view = self.scene.view.expect("the built-in scenes have a camera");
        let (camera, turn) = (self.data.cam_xpos()[view], self.data.cam_xmat()[view]);
        let away: [f64; 3] = std::array::from_fn(|axis| place[axis] - camera[axis]);
        // The camera's axes are the matrix's columns: right, up, and backwards.
        let [right, up, back]: [f64; 3] =
            std::array::from_fn(|column| (0..3).map(|row| turn[3 * row + column] * away[row]).sum());
        let half = (self.data.model().cam_fovy()[view].to_radians() / 2.0).tan();
        let aspect = f64::from(self.size[0]) / f64::from(self.size[1]);
        [0.5 + right / (-back * 2.0 * half * aspect), 0.5 - up / (-back * 2.0 * half)]
    }

    /// Draws the scene with these generalised positions, as [`super::replay`] returns them.
    ///
    /// # Errors
    /// When the positions are not as many as the scene has, or OpenGL fails.
    pub fn render(&mut self, qpos: &[f64]) -> Result<RgbImage, SimulationError> {
        if qpos.len() != self.data.qpos().len() {
            return Err(SimulationError::StateSize {
                scene: self.scene.name.clone(),
                found: qpos.len(),
                expected: self.data.qpos().len(),
            });
        }
        self.data.qpos_mut().copy_from_slice(qpos);
        self.data.forward();
        let pixels = self.camera.capture(&mut self.data)?.to_vec();
        let [width, height] = self.size;
        Ok(RgbImage::from_raw(width, height, pixels).expect("the frame has the size that was asked for"))
    }
}

fn check_size(width: u32, height: u32) -> Result<(), SimulationError> {
    let range = 1..=MAX_PICTURE_SIDE;
    if range.contains(&width) && range.contains(&height) {
        return Ok(());
    }
    Err(SimulationError::PictureSize { width, height, max: MAX_PICTURE_SIDE })
}

/// A copy of the model with MuJoCo's default visual quality, which the models lower for speed, and shadows.
fn good_looking(model: &MjModel, width: u32, height: u32) -> MjModel {
    let mut model = model.clone();
    let visual = model.vis_mut();
    visual.global.offwidth = width as i32;
    visual.global.offheight = height as i32;
    let quality = &mut visual.quality;
    (quality.shadowsize, quality.offsamples) = (4096, 4);
    (quality.numslices, quality.numstacks, quality.numquads) = (28, 16, 4);
    // The default covers less ground than the camera sees, and spoils the rest with moire.
    visual.map.shadowclip = 3.0;
    model.light_castshadow_mut().fill(true);
    model
}

fn open_renderer(model: &MjModel, width: u32, height: u32) -> Result<MjRenderer, SimulationError> {
    MjRenderer::new(model, width as usize, height as usize, 0).map_err(|error| match error {
        RendererError::GlutinError(cause) => SimulationError::NoRenderer { cause: cause.to_string() },
        other => SimulationError::Render(other),
    })
}

/// Asks the OpenGL context that is current on this thread for its `GL_RENDERER`.
fn current_renderer_name() -> String {
    const GL_RENDERER: c_uint = 0x1F01;
    type GetString = unsafe extern "C" fn(c_uint) -> *const c_char;
    unsafe extern "C" {
        fn dlopen(file: *const c_char, flags: c_int) -> *mut c_void;
        fn dlsym(library: *mut c_void, name: *const c_char) -> *mut c_void;
    }
    const RTLD_LAZY: c_int = 1;
    // SAFETY: dlopen only counts a further use of the library that made the context; both functions have these
    // types by their specifications; glGetString's result is a constant string or null.
    unsafe {
        let egl = dlopen(c"libEGL.so.1".as_ptr(), RTLD_LAZY);
        if egl.is_null() {
            return "unknown".to_owned();
        }
        let address = dlsym(egl, c"eglGetProcAddress".as_ptr());
        if address.is_null() {
            return "unknown".to_owned();
        }
        let get_address: unsafe extern "C" fn(*const c_char) -> *mut c_void = std::mem::transmute(address);
        let address = get_address(c"glGetString".as_ptr());
        if address.is_null() {
            return "unknown".to_owned();
        }
        let get_string: GetString = std::mem::transmute(address);
        let name = get_string(GL_RENDERER);
        if name.is_null() {
            "unknown".to_owned()
        } else {
            CStr::from_ptr(name).to_string_lossy().into_owned()
        }
    }
}
