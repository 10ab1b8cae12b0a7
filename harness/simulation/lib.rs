//! The simulated world: MuJoCo scenes, the arm's motion, what the robot senses, and the camera's frames.
//!
//! A [`Scene`] is a compiled model, shared by all threads; a [`Simulator`] steps and films it on one thread and
//! yields [`Episode`]s. An episode depends on the spec, the scene and its own index, on nothing else. A
//! [`LiveSimulation`] is stepped from outside instead, and a [`Batch`] of them in parallel.

mod batch;
mod camera;
mod draft;
mod episode;
mod factors;
mod flow;
mod live;
mod motion;
mod physics;
mod placement;
mod plan;
mod scene;
mod sensors;

pub use batch::Batch;
pub use camera::{Camera, SceneRenderer, prepare_rendering, renderer_name};
pub use draft::draft_world;
pub use episode::{Simulator, replay};
pub use factors::FactorValues;
pub use live::LiveSimulation;
pub use plan::EpisodePlan;
pub use scene::Scene;
pub use sensors::link_forces;

pub use harness_spec::{Episode, Pose};

use harness_spec::SpecError;
use mujoco_rs::prelude::RendererError;

/// The MuJoCo release that the bindings, the models and the published numbers are for.
pub const MUJOCO_VERSION: &str = "3.17.0";

/// The version of the MuJoCo library that this process runs.
pub fn mujoco_version() -> &'static str {
    mujoco_rs::mujoco_version()
}

/// Why a scene, an episode or a picture could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimulationError {
    #[error("MuJoCo {found} is linked, but this program is built for {MUJOCO_VERSION}: run `make setup`")]
    Version { found: String },

    #[error(transparent)]
    World(#[from] SpecError),

    #[error("{scene} does not compile: {message}")]
    Compile { scene: String, message: String },

    #[error("{scene} has no {kind} named `{name}`")]
    Missing { scene: String, kind: &'static str, name: String },

    #[error("{scene}: {problem}")]
    Unsuitable { scene: String, problem: String },

    #[error("simulation.{field}: {problem}")]
    Spec { field: String, problem: String },

    #[error(
        "episode {episode}: no free place for box {placed} of {boxes} after {attempts} draws; \
         widen the ranges or the area that boxes are placed in, or lower simulation.{setting}"
    )]
    Placement { episode: u32, placed: usize, boxes: usize, attempts: usize, setting: String },

    #[error("episode {episode} of {scene} diverged {time_s:.3} s after its start: {what}")]
    Diverged { scene: String, episode: u32, time_s: f64, what: String },

    #[error("episode {episode} was cancelled")]
    Cancelled { episode: u32 },

    #[error(
        "no OpenGL context for offscreen rendering: EGL says {cause}; install an EGL driver \
         (Debian: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri)"
    )]
    NoRenderer { cause: String },

    #[error("rendering failed")]
    Render(#[source] RendererError),

    #[error("a picture of {width} x {height} pixels is out of range: each side must be 1 to {max}")]
    PictureSize { width: u32, height: u32, max: u32 },

    #[error(
        "the setpoint {setpoint:?} of simulation {index} must be {expected} finite numbers, one an element of the action"
    )]
    Setpoint { index: usize, setpoint: Vec<f64>, expected: usize },

    #[error("{0}")]
    Batch(String),

    #[error("a state of {found} values does not fit {scene}, which has {expected} position coordinates")]
    StateSize { scene: String, found: usize, expected: usize },
}
