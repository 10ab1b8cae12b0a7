//! OpenGL contexts to render with.

use super::SimulationError;
use super::scene::prepare;
use libloading::Library;
use mujoco_rs::prelude::*;
use mujoco_rs::renderer::{MjRenderer, MjRendererBuilder};
use std::ffi::{CStr, c_char, c_uint};

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

/// Returns the name of the OpenGL renderer, for example "llvmpipe (LLVM 15.0.6, 256 bits)".
///
/// # Errors
/// When there is no OpenGL to render with, or MuJoCo's library has another version.
pub fn renderer_name() -> Result<String, SimulationError> {
    prepare()?;
    let model = MjModel::from_xml_string("<mujoco/>").expect("an empty model compiles");
    let _renderer = open_renderer(&model, 1, 1)?;
    Ok(current_renderer_name())
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
        RendererError::GlutinError(cause) => SimulationError::NoRenderer { cause: cause.to_string() },
        other => SimulationError::Render(other),
    })
}

/// Returns the `GL_RENDERER` of the OpenGL context that is current on this thread, or `unknown`.
pub(super) fn current_renderer_name() -> String {
    const GL_RENDERER: c_uint = 0x1F01;
    type GetString = unsafe extern "C" fn(c_uint) -> *const c_char;
    type GetAddress = unsafe extern "C" fn(*const c_char) -> Option<GetString>;
    let name = || {
        // SAFETY: the library is the one that made the context, so loading it runs no code. Both functions have these
        // types by their specifications. The result of glGetString is a constant string or null.
        unsafe {
            let egl = Library::new("libEGL.so.1").ok()?;
            let get_string = egl.get::<GetAddress>(b"eglGetProcAddress\0").ok()?(c"glGetString".as_ptr())?;
            let name = get_string(GL_RENDERER);
            (!name.is_null()).then(|| CStr::from_ptr(name).to_string_lossy().into_owned())
        }
    };
    name().unwrap_or_else(|| "unknown".to_owned())
}
