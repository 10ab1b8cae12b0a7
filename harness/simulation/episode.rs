//! Episodes: one seeded simulation each, recorded sample by sample.

use super::SimulationError;
use super::camera::Camera;
use super::course::{Course, Pose};
use super::physics::{Instant, Physics};
use super::scene::Scene;
use crate::spec::{ARM_JOINTS, FRAME_LEN, FRAME_SIDE, JOINTS, Simulation};
use std::fmt;
use std::ops::ControlFlow;

/// What one simulation recorded: `samples` rows an array, row k at k / `sample_rate_hz` seconds.
#[derive(Clone, Default, PartialEq)]
pub struct Episode {
    /// Its index in the dataset.
    pub index: u32,
    /// Rows of each array.
    pub samples: usize,
    /// Finger joint angles, rad, `[samples, 20]`.
    pub proprioception: Vec<f32>,
    /// Arm rotation (rad), lift (m) and extension (m), `[samples, 3]`.
    pub arm: Vec<f32>,
    /// The arm's commanded setpoint, in the same units, `[samples, 3]`.
    pub setpoint: Vec<f32>,
    /// Normal contact force of each link at the instant, N, `[samples, 20]`.
    pub contact_force: Vec<f32>,
    /// The same, averaged over the steps since the previous sample, N, `[samples, 20]`.
    pub contact_force_mean: Vec<f32>,
    /// The camera's RGB frames, top row first, `[samples, 64, 64, 3]`.
    pub vision: Vec<u8>,
    /// Each box's first position (m) and orientation (unit quaternion w, x, y, z).
    pub boxes: Vec<Pose>,
    /// The OpenGL renderer that drew the frames.
    pub renderer: String,
}

/// Simulates and films episodes of one scene, on the thread that made it.
pub struct Simulator<'s> {
    spec: Simulation,
    physics: Physics<'s>,
    camera: Camera,
}

impl<'s> Simulator<'s> {
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene, or there is no OpenGL to render with.
    pub fn new(scene: &'s Scene, spec: &Simulation) -> Result<Self, SimulationError> {
        let physics = Physics::new(scene, spec)?;
        let camera = Camera::new(scene, FRAME_SIDE as u32, FRAME_SIDE as u32)?;
        Ok(Self { spec: spec.clone(), physics, camera })
    }

    /// Simulates the episode of that index; `on_sample` is called after each sample and may cancel.
    ///
    /// # Errors
    /// When the boxes find no place, the simulation diverges, rendering fails, or `on_sample` breaks.
    pub fn run(
        &mut self,
        index: u32,
        on_sample: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> Result<Episode, SimulationError> {
        let course = Course::draw(self.physics.scene, &self.spec, index)?;
        let mut episode = Episode::new(&course, self.physics.timing.samples, self.camera.renderer_name());
        let (scene, camera) = (self.physics.scene, &mut self.camera);
        self.physics.run(&course, &mut |instant, data| {
            episode.record(scene, instant);
            episode.vision.extend_from_slice(camera.capture(data)?);
            match on_sample() {
                ControlFlow::Continue(()) => Ok(()),
                ControlFlow::Break(()) => Err(SimulationError::Cancelled { episode: index }),
            }
        })?;
        Ok(episode)
    }
}

/// Simulates an episode again, without frames: the model's generalised positions at each sample.
///
/// # Errors
/// As [`Simulator::run`], except for rendering and cancelling.
pub fn replay(scene: &Scene, spec: &Simulation, index: u32) -> Result<Vec<Vec<f64>>, SimulationError> {
    let mut physics = Physics::new(scene, spec)?;
    let course = Course::draw(scene, spec, index)?;
    let mut states = Vec::with_capacity(physics.timing.samples);
    physics.run(&course, &mut |instant, _| {
        states.push(instant.qpos.to_vec());
        Ok(())
    })?;
    Ok(states)
}

impl Episode {
    fn new(course: &Course, samples: usize, renderer: &str) -> Self {
        let rows = |width: usize| Vec::with_capacity(samples * width);
        Self {
            index: course.episode,
            samples,
            proprioception: rows(JOINTS),
            arm: rows(ARM_JOINTS),
            setpoint: rows(ARM_JOINTS),
            contact_force: rows(JOINTS),
            contact_force_mean: rows(JOINTS),
            vision: Vec::with_capacity(samples * FRAME_LEN),
            boxes: course.boxes.clone(),
            renderer: renderer.to_owned(),
        }
    }

    fn record(&mut self, scene: &Scene, instant: &Instant) {
        let single = |value: f64| value as f32;
        self.proprioception.extend(scene.finger_qpos.map(|index| single(instant.qpos[index])));
        self.arm.extend(scene.arm.map(|joint| single(instant.qpos[joint.qpos])));
        self.setpoint.extend(instant.setpoint.map(single));
        self.contact_force.extend(instant.forces.map(single));
        self.contact_force_mean.extend(instant.mean_forces.map(single));
    }
}

/// Names the episode and leaves out its megabytes.
impl fmt::Debug for Episode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut fields = f.debug_struct("Episode");
        fields.field("index", &self.index).field("samples", &self.samples).finish_non_exhaustive()
    }
}
