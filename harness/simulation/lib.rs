//! The simulation: MuJoCo scenes, the motion of the actuators, the sensed values, and the cameras' images.
//!
//! A [`Scene`] is a compiled model that all threads share. A [`Simulator`] simulates and renders it on one thread and
//! returns [`Episode`]s. An episode depends only on the spec, the scene and its index. A [`LiveSimulation`] is stepped
//! by its caller, and a [`Batch`] steps many of them in parallel.

mod actuate;
mod batch;
mod camera;
mod controls;
mod course;
mod draft;
mod episode;
mod factors;
mod features;
mod fitness;
mod flow;
mod joints;
mod knowledge;
mod live;
mod load;
mod mjcf;
mod motion;
mod names;
mod noise;
mod notes;
mod opengl;
mod physics;
mod placement;
mod plan;
mod plugins;
mod resolve;
mod resolved;
mod restart;
mod scene;
mod sensors;
mod settled;
mod sight;
mod standing;
mod timing;
mod trial;
mod units;

pub use actuate::{Actuated, Addable, Probe, actuate};
pub use batch::Batch;
pub use camera::{Camera, SampleTime, SceneRenderer};
pub use draft::draft_world;
pub use episode::{Simulator, follow_setpoints, refuse_policy, replay};
pub use factors::FactorValues;
pub use fitness::{Finding, Limit, fitness};
pub use knowledge::{ErrorSize, Knowledge, PositionError};
pub use live::LiveSimulation;
pub use load::check_model;
pub use notes::{Notes, notes};
pub use opengl::{RenderingDevice, prepare_rendering, rendering};
pub use plan::EpisodePlan;
pub use restart::{SimulatedOn, simulate_on};
pub use scene::Scene;

pub use harness_spec::{Episode, Pose};

use harness_spec::SpecError;
use mujoco_rs::prelude::RendererError;

/// The MuJoCo version that the bindings, the models and the published numbers need.
pub const MUJOCO_VERSION: &str = "3.17.0";

/// Returns the version of the MuJoCo library that this process has loaded.
pub fn mujoco_version() -> &'static str {
    mujoco_rs::mujoco_version()
}

/// Why a scene, an episode or an image could not be created.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimulationError {
    /// The world file has a fault.
    #[error(transparent)]
    World(#[from] SpecError),

    /// MuJoCo can't read or compile the model.
    #[error("{scene} does not compile with MuJoCo {MUJOCO_VERSION}: {message}")]
    Compile {
        /// Where the model came from.
        scene: String,
        /// MuJoCo's message, on one line.
        message: String,
    },

    /// The model lacks an object that is needed.
    #[error("{scene} has no {kind} named `{name}`")]
    Missing {
        /// Where the model came from.
        scene: String,
        /// Kind of the object: "body", "geom".
        kind: &'static str,
        /// Name that was looked up.
        name: String,
    },

    /// The model can't be used for what was asked.
    #[error("{scene}: {problem}")]
    Unsuitable {
        /// Where the model came from.
        scene: String,
        /// What is wrong with the model.
        problem: String,
    },

    /// The model has nothing that a world's action could move.
    #[error("{scene} has neither an actuator nor a mocap body, and a world's action needs one of them")]
    NoAction {
        /// Where the model came from.
        scene: String,
        /// What can be added to it.
        adds: Addable,
    },

    /// A setting of the spec does not suit the scene.
    #[error("simulation.{field}: {problem}")]
    Spec {
        /// Key of the setting under `simulation`.
        field: String,
        /// What is wrong with its value.
        problem: String,
    },

    /// A placed body overlaps something at an episode's start.
    #[error(
        "episode {episode} would start with an overlap of {what}; move the area of placement '{placement}' away from \
         what stands there, or raise the body in the model above the surface that it is to stand on"
    )]
    Overlap {
        /// Index of the episode.
        episode: u32,
        /// Name of the body's placement in the world file.
        placement: String,
        /// What overlaps, and by how much.
        what: String,
    },

    /// MuJoCo reported that the simulation became unstable.
    #[error("episode {episode} of {scene} diverged {time_s:.3} s after its start: {what}")]
    Diverged {
        /// Where the model came from.
        scene: String,
        /// Index of the episode.
        episode: u32,
        /// Simulated time since the start of the episode, s.
        time_s: f64,
        /// MuJoCo's warning and its cause.
        what: String,
    },

    /// Something else is in the way: the linked MuJoCo library has another version, a body finds no place, a recorded
    /// course has a fault, a state does not fit the model, or only Python can ask a policy for the setpoints. The text
    /// is the message.
    #[error("{0}")]
    Other(String),

    /// The caller cancelled the episode.
    #[error("episode {episode} was cancelled")]
    Cancelled {
        /// Index of the episode.
        episode: u32,
    },

    /// No OpenGL context could be created. The text is EGL's message.
    #[error(
        "no OpenGL context for offscreen rendering: EGL says {0}; install an EGL driver \
         (Debian: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri)"
    )]
    NoRenderer(String),

    /// OpenGL failed while rendering.
    #[error("rendering failed")]
    Render(#[source] RendererError),

    /// A setpoint has the wrong number of values, or a value that is not finite.
    #[error(
        "the setpoint {setpoint:?} of simulation {index} must be {expected} finite numbers, one an element of the \
         action"
    )]
    Setpoint {
        /// Index of the simulation in its batch.
        index: usize,
        /// The setpoint that was given.
        setpoint: Vec<f64>,
        /// Number of elements of the action.
        expected: usize,
    },

    /// An argument of a batch, the size of a picture, or the value of a factor of variation is wrong. The text is the
    /// message.
    #[error("{0}")]
    Argument(String),
}
