//! The stepping loop: drives the arm along its motion and shows each sampled instant to an observer.

use super::SimulationError;
use super::course::Course;
use super::motion::{Timing, check_ranges};
use super::scene::Scene;
use super::sensors::{LinkForces, MeanForces, divergence, link_forces};
use crate::spec::{ARM_JOINTS, Simulation};
use mujoco_rs::prelude::*;
use std::mem::take;

/// MuJoCo's state of one scene on one thread.
pub(super) struct Physics<'s> {
    pub scene: &'s Scene,
    pub timing: Timing,
    pub data: MjData<&'s MjModel>,
    /// What holds at the latest sampled instant.
    pub instant: Instant,
    /// Forces since that instant.
    mean: MeanForces,
    /// The episode that is simulated, for messages.
    episode: u32,
    /// Steps since its start.
    step: usize,
}

/// A sampled instant.
pub(super) struct Instant {
    /// Generalised positions; the state's own are those after the instant's step.
    pub qpos: Vec<f64>,
    pub setpoint: [f64; ARM_JOINTS],
    pub forces: LinkForces,
    /// Averaged over the steps since the previous sample.
    pub mean_forces: LinkForces,
}

/// Receives each sampled instant, and the state whose derived quantities (poses for the camera) belong to it.
pub(super) type Observer<'o, 's> =
    dyn FnMut(&Instant, &mut MjData<&'s MjModel>) -> Result<(), SimulationError> + 'o;

impl<'s> Physics<'s> {
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene.
    pub fn new(scene: &'s Scene, spec: &Simulation) -> Result<Self, SimulationError> {
        check_ranges(spec, scene)?;
        let timing = Timing::new(spec, scene.step_s())?;
        let instant = Instant {
            qpos: scene.model.qpos0().to_vec(),
            setpoint: [0.0; ARM_JOINTS],
            forces: LinkForces::default(),
            mean_forces: LinkForces::default(),
        };
        let data = MjData::new(&scene.model);
        Ok(Self { scene, timing, data, instant, mean: MeanForces::default(), episode: 0, step: 0 })
    }

    /// Simulates one episode from rest.
    ///
    /// # Errors
    /// When the simulation diverges, or with what the observer returns.
    pub fn run(&mut self, course: &Course, observe: &mut Observer<'_, 's>) -> Result<(), SimulationError> {
        self.start(course);
        for _ in 0..self.timing.samples {
            self.advance(|step| course.setpoint(step))?;
            observe(&self.instant, &mut self.data)?;
        }
        Ok(())
    }

    /// Simulates up to the next sampled instant, which is the start itself at first; `setpoint` commands the arm at
    /// each step, counted from the start.
    ///
    /// A step computes the forces and poses of the instant it starts from, and then moves the positions on.
    /// So a sample takes its positions before a step, and everything else after it, at no extra cost.
    ///
    /// # Errors
    /// When the simulation diverges.
    pub fn advance(&mut self, setpoint: impl Fn(usize) -> [f64; ARM_JOINTS]) -> Result<(), SimulationError> {
        loop {
            let is_sample = self.step.is_multiple_of(self.timing.steps_per_sample);
            let setpoint = setpoint(self.step);
            self.command(setpoint);
            if is_sample {
                self.instant.qpos.copy_from_slice(self.data.qpos());
            }
            self.data.step();
            if let Some(what) = divergence(&self.data) {
                let time_s = self.step as f64 * self.timing.step_s;
                let scene = self.scene.name.clone();
                return Err(SimulationError::Diverged { scene, episode: self.episode, time_s, what });
            }
            self.step += 1;
            let forces = link_forces(self.scene, &self.data);
            self.mean.add(&forces);
            if is_sample {
                let mean_forces = self.mean.take();
                self.instant = Instant { setpoint, forces, mean_forces, qpos: take(&mut self.instant.qpos) };
                return Ok(());
            }
        }
    }

    /// Steps since the start.
    pub fn step(&self) -> usize {
        self.step
    }

    /// Puts the arm at the motion's start, the finger straight and the boxes in their places, all at rest.
    pub fn start(&mut self, course: &Course) {
        (self.episode, self.step, self.mean) = (course.episode, 0, MeanForces::default());
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
