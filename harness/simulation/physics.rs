//! The stepping loop: drives the arm along its motion and shows each sampled instant to an observer.

use super::SimulationError;
use super::course::Course;
use super::motion::{Timing, check_ranges};
use super::scene::Scene;
use super::sensors::{LinkForces, MeanForces, divergence, link_forces};
use crate::spec::{ARM_JOINTS, Simulation};
use mujoco_rs::prelude::*;

/// MuJoCo's state of one scene on one thread.
pub(super) struct Physics<'s> {
    pub scene: &'s Scene,
    pub timing: Timing,
    data: MjData<&'s MjModel>,
    /// The positions at the sampled instant: the step moves `data`'s on.
    qpos: Vec<f64>,
}

/// A sampled instant.
pub(super) struct Instant<'a> {
    /// Generalised positions.
    pub qpos: &'a [f64],
    pub setpoint: [f64; ARM_JOINTS],
    pub forces: LinkForces,
    /// Averaged over the steps since the previous sample.
    pub mean_forces: LinkForces,
}

/// Receives each sampled instant, and the state whose derived quantities (poses for the camera) belong to it.
pub(super) type Observer<'o, 's> =
    dyn FnMut(&Instant<'_>, &mut MjData<&'s MjModel>) -> Result<(), SimulationError> + 'o;

impl<'s> Physics<'s> {
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene.
    pub fn new(scene: &'s Scene, spec: &Simulation) -> Result<Self, SimulationError> {
        check_ranges(spec, scene)?;
        let timing = Timing::new(spec, scene.step_s())?;
        Ok(Self { scene, timing, data: MjData::new(&scene.model), qpos: scene.model.qpos0().to_vec() })
    }

    /// Simulates one episode from rest.
    ///
    /// A step computes the forces and poses of the instant it starts from, and then moves the positions on.
    /// So a sample takes its positions before a step, and everything else after it, at no extra cost.
    ///
    /// # Errors
    /// When the simulation diverges, or with what the observer returns.
    pub fn run(&mut self, course: &Course, observe: &mut Observer<'_, 's>) -> Result<(), SimulationError> {
        self.start(course);
        let mut mean = MeanForces::default();
        let last_step = (self.timing.samples - 1) * self.timing.steps_per_sample;
        for step in 0..=last_step {
            let setpoint = course.setpoint(step);
            self.command(setpoint);
            let is_sample = step % self.timing.steps_per_sample == 0;
            if is_sample {
                self.qpos.copy_from_slice(self.data.qpos());
            }
            self.data.step();
            if let Some(what) = divergence(&self.data) {
                let time_s = step as f64 * self.timing.step_s;
                let scene = self.scene.name.clone();
                return Err(SimulationError::Diverged { scene, episode: course.episode, time_s, what });
            }
            let forces = link_forces(self.scene, &self.data);
            mean.add(&forces);
            if is_sample {
                let instant = Instant { qpos: &self.qpos, setpoint, forces, mean_forces: mean.take() };
                observe(&instant, &mut self.data)?;
            }
        }
        Ok(())
    }

    /// Puts the arm at the motion's start, the finger straight and the boxes in their places, all at rest.
    fn start(&mut self, course: &Course) {
        self.data.reset();
        let qpos = self.data.qpos_mut();
        for (joint, value) in self.scene.arm.iter().zip(course.setpoint(0)) {
            qpos[joint.qpos] = value;
        }
        for (body, pose) in self.scene.boxes.iter().zip(&course.boxes) {
            qpos[body.qpos..body.qpos + pose.len()].copy_from_slice(pose);
        }
    }

    fn command(&mut self, setpoint: [f64; ARM_JOINTS]) {
        let ctrl = self.data.ctrl_mut();
        for (joint, value) in self.scene.arm.iter().zip(setpoint) {
            ctrl[joint.actuator] = value;
        }
    }
}
