//! The stepping loop: drives the actuators along their motion and shows each sampled instant to an observer.

use super::SimulationError;
use super::motion::{Timing, check_ranges};
use super::plan::EpisodePlan;
use super::scene::{Reading, Scene};
use super::sensors::{MeanForces, instability, sum_forces};
use harness_spec::{Layout, Modality, Pose, Posed, Simulation};
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::fun::utility::mju_mat_2_quat;
use std::sync::Arc;

/// MuJoCo's state of one scene on one thread.
pub(super) struct Physics<'s> {
    pub scene: &'s Scene,
    pub timing: Timing,
    /// Of the episode's model.
    pub data: MjData<Arc<MjModel>>,
    /// What holds at the latest sampled instant.
    pub instant: Instant,
    /// What is commanded at this step.
    setpoint: Vec<f64>,
    /// Forces of the latest step.
    forces: Vec<f64>,
    /// Forces since that instant.
    mean: MeanForces,
    /// The episode that is simulated, for messages.
    episode: u32,
    /// Steps since its start.
    step: usize,
}

/// A sampled instant.
pub(super) struct Instant {
    /// The scene's model, or a copy with the factors of variation that the episode drew.
    pub model: Arc<MjModel>,
    /// Generalised positions; the state's own are those after the instant's step.
    pub qpos: Vec<f64>,
    /// Those at the sample before; at the first sample, the same.
    pub qpos_before: Vec<f64>,
    /// Generalised velocities, likewise.
    pub qvel: Vec<f64>,
    pub setpoint: Vec<f64>,
    /// Of the scene's bodies and sites whose poses are sensed.
    pub poses: Vec<Pose>,
    pub forces: Vec<f64>,
    /// Averaged over the steps since the previous sample.
    pub mean_forces: Vec<f64>,
    /// Values of all of the model's sensors.
    pub sensors: Vec<f64>,
}

impl Instant {
    fn read(&self, reading: Reading) -> f32 {
        let value = match reading {
            Reading::Position(index) => self.qpos[index],
            Reading::Velocity(index) => self.qvel[index],
            Reading::Pose(index, value) => self.poses[index][value],
            Reading::Force(index) => self.forces[index],
            Reading::MeanForce(index) => self.mean_forces[index],
            Reading::Sensor(index) => self.sensors[index],
            Reading::Setpoint(index) => self.setpoint[index],
        };
        value as f32
    }

    /// The elements of a vector, by its position in the scene's layout.
    pub fn vector(&self, scene: &Scene, position: usize) -> impl Iterator<Item = f32> {
        scene.readings[position].iter().map(|reading| self.read(*reading))
    }
}

/// The pose of a body or a site, with an orientation whose w is not negative: both signs mean the same rotation.
fn pose_of(data: &MjData<Arc<MjModel>>, of: Posed, id: usize) -> Pose {
    let (place, turn) = match of {
        Posed::Body => (data.xpos()[id], data.xquat()[id]),
        Posed::Site => {
            let mut turn = [0.0; 4];
            mju_mat_2_quat(&mut turn, &data.site_xmat()[id]);
            (data.site_xpos()[id], turn)
        }
    };
    let sign = if turn[0] < 0.0 { -1.0 } else { 1.0 };
    std::array::from_fn(|index| if index < 3 { place[index] } else { sign * turn[index - 3] })
}

/// The position in a layout of a vector that is sensed.
pub(super) fn sensed_position(layout: &Layout, modality: Modality) -> Option<usize> {
    let is_it = |definition: &harness_spec::Definition| {
        definition.name == modality && !definition.is_image() && definition.difference_of.is_none()
    };
    layout.modalities.iter().position(is_it)
}

/// Receives each sampled instant, and the state whose derived quantities (poses for the camera) belong to it.
pub(super) type Observer<'o> =
    dyn FnMut(&Instant, &mut MjData<Arc<MjModel>>) -> Result<(), SimulationError> + 'o;

impl<'s> Physics<'s> {
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene.
    pub fn new(scene: &'s Scene, spec: &Simulation) -> Result<Self, SimulationError> {
        check_ranges(spec, scene)?;
        let timing = Timing::new(spec, scene.step_s())?;
        let data = MjData::new(scene.model.clone());
        let elements = scene.actuators.len();
        let instant = Instant {
            model: scene.model.clone(),
            qpos: scene.model.qpos0().to_vec(),
            qpos_before: scene.model.qpos0().to_vec(),
            qvel: data.qvel().to_vec(),
            setpoint: vec![0.0; elements],
            poses: vec![Pose::default(); scene.posed.len()],
            forces: vec![0.0; scene.forces],
            mean_forces: vec![0.0; scene.forces],
            sensors: data.sensordata().to_vec(),
        };
        Ok(Self {
            scene,
            timing,
            data,
            instant,
            setpoint: vec![0.0; elements],
            forces: vec![0.0; scene.forces],
            mean: MeanForces::new(scene.forces),
            episode: 0,
            step: 0,
        })
    }

    /// Simulates one episode from rest.
    ///
    /// # Errors
    /// When the simulation diverges, or with what the observer returns.
    pub fn run(&mut self, plan: &EpisodePlan, observe: &mut Observer<'_>) -> Result<(), SimulationError> {
        self.start(plan);
        for _ in 0..self.timing.samples {
            self.advance(|step, setpoint| plan.setpoint(step, setpoint))?;
            observe(&self.instant, &mut self.data)?;
        }
        Ok(())
    }

    /// Simulates up to the next sampled instant, which is the start itself at first; `setpoint` writes what is
    /// commanded at each step, counted from the start.
    ///
    /// A step computes the forces and poses of the instant it starts from, and then moves the positions on.
    /// So a sample takes its positions before a step, and everything else after it, at no extra cost.
    ///
    /// # Errors
    /// When the simulation diverges.
    pub fn advance(&mut self, setpoint: impl Fn(usize, &mut [f64])) -> Result<(), SimulationError> {
        loop {
            let is_sample = self.step.is_multiple_of(self.timing.steps_per_sample);
            setpoint(self.step, &mut self.setpoint);
            self.command();
            if is_sample {
                let before = if self.step == 0 { self.data.qpos() } else { &self.instant.qpos };
                self.instant.qpos_before.copy_from_slice(before);
                self.instant.qpos.copy_from_slice(self.data.qpos());
                self.instant.qvel.copy_from_slice(self.data.qvel());
            }
            self.data.step();
            if let Some(what) = instability(&self.data) {
                let time_s = self.step as f64 * self.timing.step_s;
                let scene = self.scene.name.clone();
                return Err(SimulationError::Diverged { scene, episode: self.episode, time_s, what });
            }
            self.step += 1;
            sum_forces(self.scene, &self.data, &mut self.forces);
            self.mean.add(&self.forces);
            if is_sample {
                self.instant.setpoint.copy_from_slice(&self.setpoint);
                self.instant.forces.copy_from_slice(&self.forces);
                self.mean.take(&mut self.instant.mean_forces);
                self.instant.sensors.copy_from_slice(self.data.sensordata());
                for (pose, (of, id)) in self.instant.poses.iter_mut().zip(&self.scene.posed) {
                    *pose = pose_of(&self.data, *of, *id);
                }
                return Ok(());
            }
        }
    }

    /// Steps since the start.
    pub fn step(&self) -> usize {
        self.step
    }

    /// Takes the model that the episode drew, and puts what position servos drive at the motion's start and the boxes in
    /// their places, all at rest.
    pub fn start(&mut self, plan: &EpisodePlan) {
        (self.episode, self.step) = (plan.episode, 0);
        self.mean.clear();
        // Always from the scene's own model, so that nothing is left of the episode before.
        self.instant.model = plan.factors.apply(self.scene, &self.scene.model);
        self.data.swap_model(self.instant.model.clone());
        self.data.reset();
        plan.setpoint(0, &mut self.setpoint);
        let qpos = self.data.qpos_mut();
        for (driven, value) in self.scene.actuators.iter().zip(&self.setpoint) {
            if let Some(index) = driven.qpos {
                qpos[index] = *value;
            }
        }
        let boxes = self.scene.placements.iter().flat_map(|placement| &placement.boxes);
        for (body, pose) in boxes.zip(&plan.boxes) {
            qpos[body.qpos..body.qpos + pose.len()].copy_from_slice(pose);
        }
    }

    fn command(&mut self) {
        let ctrl = self.data.ctrl_mut();
        for (driven, value) in self.scene.actuators.iter().zip(&self.setpoint) {
            ctrl[driven.actuator] = *value;
        }
    }
}
