//! One simulation that is stepped from outside, a sample at a time: for control and reinforcement learning.

use super::SimulationError;
use super::camera::{Camera, Portrait};
use super::course::{Course, Pose};
use super::motion::ranges;
use super::physics::Physics;
use super::scene::Scene;
use crate::spec::{ARM_JOINTS, FRAME_SIDE, JOINTS, Scenario, Simulation};
use image::RgbImage;
use std::cell::RefCell;
use std::collections::BTreeMap;

/// A simulation of a built-in scene whose arm is told a setpoint at each sample.
///
/// What it senses is what an episode of a dataset records: the course of an episode's own, followed by
/// [`LiveSimulation::follow`], gives that episode's samples bit by bit.
pub struct LiveSimulation {
    spec: Simulation,
    physics: Physics<'static>,
    course: Course,
}

thread_local! {
    /// This thread's cameras: OpenGL contexts belong to the thread that made them, and simulations go from thread to
    /// thread.
    static CAMERAS: RefCell<BTreeMap<Scenario, Camera>> = const { RefCell::new(BTreeMap::new()) };
    /// The portrait that this thread drew last, with its scenario and size: the next is most likely alike.
    static PORTRAIT: RefCell<Option<(Picture, Box<Portrait<'static>>)>> = const { RefCell::new(None) };
}

/// What a portrait is made for: the scenario, and width and height in pixels.
type Picture = (Scenario, u32, u32);

impl LiveSimulation {
    /// A simulation at the start of the spec's first episode.
    ///
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene, the boxes find no place, or the simulation diverges.
    pub fn new(scenario: Scenario, spec: &Simulation) -> Result<Self, SimulationError> {
        let scene = Scene::builtin(scenario)?;
        let (physics, course) = (Physics::new(scene, spec)?, Course::draw(scene, spec, 0)?);
        let mut live = Self { spec: spec.clone(), physics, course };
        live.reset(spec.seed, 0)?;
        Ok(live)
    }

    /// Goes to the start of the episode of that index in the dataset of that seed.
    ///
    /// # Errors
    /// When the boxes find no place, or the simulation diverges.
    pub fn reset(&mut self, seed: u64, episode: u32) -> Result<(), SimulationError> {
        self.spec.seed = seed;
        self.course = Course::draw(self.physics.scene, &self.spec, episode)?;
        self.physics.start(&self.course);
        self.follow()
    }

    /// Goes on to the next sample while the arm's setpoint moves evenly to this one: rotation (rad), lift (m) and
    /// extension (m). What lies beyond the spec's ranges ends at their bounds.
    ///
    /// # Errors
    /// When a value is not finite, or the simulation diverges.
    pub fn step(&mut self, setpoint: [f64; ARM_JOINTS]) -> Result<(), SimulationError> {
        if !setpoint.iter().all(|value| value.is_finite()) {
            return Err(SimulationError::Setpoint { index: 0, setpoint });
        }
        let ranges = ranges(&self.spec);
        let to: [f64; ARM_JOINTS] =
            std::array::from_fn(|joint| setpoint[joint].clamp(ranges[joint][0], ranges[joint][1]));
        let from = self.physics.instant.setpoint;
        let (steps, sampled) = (self.physics.timing.steps_per_sample, self.physics.step() - 1);
        self.physics.advance(|step| match step - sampled {
            done if done == steps => to,
            done => std::array::from_fn(|joint| {
                from[joint] + done as f64 / steps as f64 * (to[joint] - from[joint])
            }),
        })
    }

    /// Goes on to the next sample along the course of the episode itself.
    ///
    /// # Errors
    /// When the simulation diverges.
    pub fn follow(&mut self) -> Result<(), SimulationError> {
        let course = &self.course;
        self.physics.advance(|step| course.setpoint(step))
    }

    /// How it is simulated; the seed is that of the latest reset.
    pub fn spec(&self) -> &Simulation {
        &self.spec
    }

    /// The setpoint at this sample: rotation (rad), lift (m), extension (m).
    pub fn setpoint(&self) -> [f64; ARM_JOINTS] {
        self.physics.instant.setpoint
    }

    /// Finger joint angles, rad, base to tip.
    pub fn proprioception(&self) -> [f32; JOINTS] {
        self.physics.scene.finger_qpos.map(|index| self.physics.instant.qpos[index] as f32)
    }

    /// The arm's rotation (rad), lift (m) and extension (m).
    pub fn arm(&self) -> [f32; ARM_JOINTS] {
        self.physics.scene.arm.map(|joint| self.physics.instant.qpos[joint.qpos] as f32)
    }

    /// Normal contact force of each link at the sample, N, base to tip.
    pub fn contact_force(&self) -> [f32; JOINTS] {
        self.physics.instant.forces.map(|force| force as f32)
    }

    /// The same, averaged over the steps since the sample before, N.
    pub fn contact_force_mean(&self) -> [f32; JOINTS] {
        self.physics.instant.mean_forces.map(|force| force as f32)
    }

    /// The end of the last link's axis in the world, m.
    pub fn fingertip(&self) -> [f64; 3] {
        let tip = self.physics.scene.tip;
        let (joint, middle) = (self.physics.data.xpos()[tip.body], self.physics.data.geom_xpos()[tip.geom]);
        std::array::from_fn(|axis| 2.0 * middle[axis] - joint[axis])
    }

    /// Where each box is in the world.
    pub fn boxes(&self) -> impl Iterator<Item = Pose> {
        let qpos = &self.physics.instant.qpos;
        self.physics.scene.boxes.iter().map(|body| std::array::from_fn(|axis| qpos[body.qpos + axis]))
    }

    /// The camera's RGB frame of the sample, top row first, `[64, 64, 3]`, written to `frame`.
    ///
    /// # Errors
    /// When there is no OpenGL to render with.
    pub fn vision(&mut self, frame: &mut [u8]) -> Result<(), SimulationError> {
        let (scene, data) = (self.physics.scene, &mut self.physics.data);
        CAMERAS.with_borrow_mut(|cameras| {
            let camera = match cameras.remove(&scene.scenario()) {
                Some(camera) => camera,
                None => Camera::new(scene, FRAME_SIDE as u32, FRAME_SIDE as u32)?,
            };
            frame.copy_from_slice(cameras.entry(scene.scenario()).or_insert(camera).capture(data)?);
            Ok(())
        })
    }

    /// A picture of the sample for people, of any size in pixels.
    ///
    /// # Errors
    /// When a side is 0 or above 4096 pixels, or there is no OpenGL to render with.
    pub fn portrait(&self, width: u32, height: u32) -> Result<RgbImage, SimulationError> {
        let scene = self.physics.scene;
        let kind = (scene.scenario(), width, height);
        PORTRAIT.with_borrow_mut(|kept| {
            let portrait = match kept.take() {
                Some((other, portrait)) if other == kind => portrait,
                _ => Box::new(Portrait::new(scene, width, height)?),
            };
            kept.insert((kind, portrait)).1.draw(&self.physics.instant.qpos)
        })
    }
}
