//! OpenGL contexts to render with.

use super::SimulationError;
use super::scene::prepare;
use libloading::Library;
use mujoco_rs::prelude::*;
use mujoco_rs::renderer::{MjRenderer, MjRendererBuilder};
use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::ptr::{null, null_mut};

/// Largest number of things in an image that are not geoms, such as sites and the segments of tendons. MuJoCo leaves
/// out further ones without a warning. The limit of Python's `mujoco.Renderer` is also 10,000.
pub(super) const DECORATIONS: u32 = 10_000;

/// Limits software rendering to the calling threads, because the simulators already use all cores.
///
/// Otherwise Mesa's llvmpipe starts a thread pool for every OpenGL context, which costs more than rendering images of
/// 64 x 64 pixels. A value of `LP_NUM_THREADS` that the user has set is kept. GPUs ignore the variable.
///
/// # Safety
/// It changes the environment, so no other thread may run. Call it at the start of `main`.
pub unsafe fn prepare_rendering() {
    if std::env::var_os("LP_NUM_THREADS").is_none() {
        // SAFETY: the caller promises that this is the only thread.
        unsafe { std::env::set_var("LP_NUM_THREADS", "0") };
    }
}

/// Returns the name of the OpenGL renderer, for example "llvmpipe (LLVM 15.0.6, 256 bits)", and the device that it uses;
/// `None` if EGL does not say.
///
/// # Errors
/// When there is no OpenGL to render with, or MuJoCo's library has another version.
pub fn rendering() -> Result<(String, Option<RenderingDevice>), SimulationError> {
    prepare()?;
    let model = MjModel::from_xml_string("<mujoco/>").expect("an empty model compiles");
    let _renderer = open_renderer(&model, 1, 1)?;
    Ok((current_renderer_name(), current_device()))
}

/// Returns a copy of the model that is rendered without shadows and smooth edges.
pub(super) fn plain(model: &MjModel) -> MjModel {
    let mut model = model.clone();
    let quality = &mut model.vis_mut().quality;
    (quality.shadowsize, quality.offsamples) = (0, 0);
    model
}

/// Opens an OpenGL context with buffers for images of the model.
pub(super) fn open_renderer(model: &MjModel, width: u32, height: u32) -> Result<MjRenderer, SimulationError> {
    let renderer = MjRendererBuilder::new().width(width).height(height).num_visual_internal_geom(DECORATIONS);
    renderer.build(model).map_err(|error| match error {
        RendererError::GlutinError(cause) => SimulationError::NoRenderer(cause.to_string()),
        other => SimulationError::Render(other),
    })
}

/// Returns the `GL_RENDERER` of the OpenGL context that is current on this thread, or `unknown`.
pub(super) fn current_renderer_name() -> String {
    const GL_RENDERER: c_uint = 0x1F01;
    type GetString = unsafe extern "C" fn(c_uint) -> *const c_char;
    let name = || {
        let egl = Egl::new()?;
        // SAFETY: the function has this type by its specification. Its result is a constant string or null.
        unsafe {
            let name = egl.function::<GetString>(c"glGetString")?(GL_RENDERER);
            (!name.is_null()).then(|| CStr::from_ptr(name).to_string_lossy().into_owned())
        }
    };
    name().unwrap_or_else(|| "unknown".to_owned())
}

/// A device that EGL offers to render with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RenderingDevice {
    /// Its position among the devices, from 0.
    pub index: usize,
    /// Number of devices.
    pub devices: usize,
}

/// Returns the device of the OpenGL context that is current on this thread; `None` if EGL does not say.
fn current_device() -> Option<RenderingDevice> {
    const EGL_DEVICE_EXT: c_int = 0x322C;
    type Pointer = *const c_void;
    type CurrentDisplay = unsafe extern "C" fn() -> Pointer;
    type DisplayAttribute = unsafe extern "C" fn(Pointer, c_int, *mut isize) -> c_uint;
    type Devices = unsafe extern "C" fn(c_int, *mut Pointer, *mut c_int) -> c_uint;
    let egl = Egl::new()?;
    // SAFETY: the functions have these types by their specifications (EGL_EXT_device_query and
    // EGL_EXT_device_enumeration). `devices` has room for as many pointers as are asked for.
    unsafe {
        let display = egl.function::<CurrentDisplay>(c"eglGetCurrentDisplay")?();
        let (mut device, mut count) = (0, 0);
        let attribute = egl.function::<DisplayAttribute>(c"eglQueryDisplayAttribEXT")?;
        let list = egl.function::<Devices>(c"eglQueryDevicesEXT")?;
        if attribute(display, EGL_DEVICE_EXT, &mut device) == 0 || list(0, null_mut(), &mut count) == 0 {
            return None;
        }
        let mut devices = vec![null(); usize::try_from(count).ok()?];
        list(count, devices.as_mut_ptr(), &mut count);
        let index = devices.iter().position(|other| *other as isize == device)?;
        Some(RenderingDevice { index, devices: devices.len() })
    }
}

/// The EGL library.
struct Egl(Library);

impl Egl {
    fn new() -> Option<Self> {
        // SAFETY: the library is the one that made the context, so loading it runs no code.
        unsafe { Library::new("libEGL.so.1") }.ok().map(Self)
    }

    /// Returns the function of EGL or OpenGL with this name.
    ///
    /// # Safety
    /// `F` must be a pointer to a function, of the function's type.
    unsafe fn function<F: Copy>(&self, name: &CStr) -> Option<F> {
        type GetAddress = unsafe extern "C" fn(*const c_char) -> Option<unsafe extern "C" fn()>;
        // SAFETY: `eglGetProcAddress` has this type, and the caller promises that of the other function.
        unsafe {
            let address = self.0.get::<GetAddress>(b"eglGetProcAddress\0").ok()?(name.as_ptr())?;
            Some(std::mem::transmute_copy(&address))
        }
    }
}
