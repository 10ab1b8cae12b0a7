//! The simulation loop: moves the actuators and passes each sampled instant to an observer.

use super::SimulationError;
use super::knowledge::Known;
use super::load::can_sleep;
use super::motion::Probe;
use super::noise::Noise;
use super::placement::check_start;
use super::plan::EpisodePlan;
use super::resolved::{ContactKinds, PosedObject, Reading};
use super::scene::{Scene, read_state};
use super::sensors::{
    MeanForces, Resting, add_kinds, instability, sum_forces, take_largest_kinds, write_normals,
};
use super::timing::Timing;
use harness_spec::{Layout, Modality, Pose, Posed, Simulation};
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::fun::utility::{mju_mat_2_quat, mju_mul_pose, mju_neg_pose};
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;

/// Largest number of steps in which contacts push apart what overlaps because of errors.
const PUSHING_STEPS: usize = 100;

/// The overlap that is always left, m.
const SLACK_M: f64 = 0.001;

/// The simulation of one scene on one thread.
pub(super) struct Physics<'s> {
    pub scene: &'s Scene,
    pub timing: Timing,
    /// MuJoCo's state, with the episode's model.
    data: MjData<Arc<MjModel>>,
    /// A copy of the state at the latest instant that was read, with all derived quantities. It is `None` if every step
    /// leaves those of the instant at which it starts in `data`.
    sampled: Option<MjData<Arc<MjModel>>>,
    /// Whether the latest step left those of another instant, so that the copy has to be read.
    is_copied: bool,
    /// Whether forces are averaged over steps.
    averages: bool,
    /// Values at the latest sampled instant.
    pub instant: Instant,
    /// Setpoint of this step.
    setpoint: Vec<f64>,
    /// Forces of the latest step whose forces are needed.
    forces: Vec<f64>,
    /// Contacts of bodies that sleep.
    resting: Resting,
    /// Mean of the forces since the latest sampled instant.
    mean: MeanForces,
    /// Sums of forces by kind of contact, for each of the scene's divisions into kinds.
    kind_sums: Vec<Vec<f64>>,
    /// Noise of the samples that follow.
    noise: Noise,
    /// The clock of a probing motion; `None` for others.
    probe: Option<Probe>,
    /// The episode that is simulated, for messages.
    episode: u32,
    /// Steps since its start.
    step: usize,
}

/// The values at a sampled instant.
pub(super) struct Instant {
    /// The scene's model, or a copy with the factors of variation that the episode drew.
    pub model: Arc<MjModel>,
    /// Generalized positions at the instant, followed by the positions of mocap bodies if the action moves some
    /// ([`read_state`]). Those in MuJoCo's state are already one step further.
    pub state: Vec<f64>,
    /// The same at the sample before. At the first sample, it equals `state`.
    pub state_before: Vec<f64>,
    /// Generalized velocities at the instant.
    pub qvel: Vec<f64>,
    pub setpoint: Vec<f64>,
    /// Poses of the scene's bodies and sites that are sensed.
    pub poses: Vec<Pose>,
    pub forces: Vec<f64>,
    /// Averaged over the steps since the previous sample.
    pub mean_forces: Vec<f64>,
    /// The kind of each force's contact, by each of the scene's divisions into kinds.
    pub contact_kinds: Vec<Vec<usize>>,
    /// The scene's directions of contacts.
    pub normals: Vec<[f64; 3]>,
    /// Values of all of the model's sensors.
    pub sensors: Vec<f64>,
    /// What is added to the values of each modality of the layout; empty for one without noise.
    noise: Vec<Vec<f64>>,
}

impl Instant {
    fn read(&self, reading: Reading) -> f64 {
        match reading {
            Reading::Position(index) => self.state[index],
            Reading::Orientation(first, index) => {
                let sign = if self.state[first] < 0.0 { -1.0 } else { 1.0 };
                sign * self.state[first + index]
            }
            Reading::Velocity(index) => self.qvel[index],
            Reading::Pose(index, value) => self.poses[index][value],
            Reading::Force(index) => self.forces[index],
            Reading::MeanForce(index) => self.mean_forces[index],
            Reading::ContactKind(division, index) => self.contact_kinds[division][index] as f64,
            Reading::ContactNormal(index, axis) => self.normals[index][axis],
            Reading::Sensor(index) => self.sensors[index],
            Reading::Setpoint(index) => self.setpoint[index],
        }
    }

    /// Returns the elements of the vector with this index in the scene's layout.
    pub fn vector(&self, scene: &Scene, position: usize) -> impl Iterator<Item = f32> {
        let noise = &self.noise[position];
        scene.resolved.readings[position].iter().enumerate().map(move |(index, reading)| {
            let value = self.read(*reading);
            noise.get(index).map_or(value, |noise| value + noise) as f32
        })
    }
}

/// Returns the pose of a body or a site. The orientation's w is not negative, which makes the quaternion unique.
fn pose_of(data: &MjData<Arc<MjModel>>, object: PosedObject) -> Pose {
    let PosedObject { of, id, relative_to } = object;
    let (mut place, mut turn) = match of {
        Posed::Body => (data.xpos()[id], data.xquat()[id]),
        Posed::Site => {
            let mut turn = [0.0; 4];
            mju_mat_2_quat(&mut turn, &data.site_xmat()[id]);
            (data.site_xpos()[id], turn)
        }
    };
    if let Some(body) = relative_to {
        let (mut origin, mut back) = ([0.0; 3], [0.0; 4]);
        mju_neg_pose(&mut origin, &mut back, &data.xpos()[body], &data.xquat()[body]);
        let (in_world, turned) = (place, turn);
        mju_mul_pose(&mut place, &mut turn, &origin, &back, &in_world, &turned);
    }
    let sign = if turn[0] < 0.0 { -1.0 } else { 1.0 };
    std::array::from_fn(|index| if index < 3 { place[index] } else { sign * turn[index - 3] })
}

/// Returns the index in a layout of a vector that is sensed; `None` for images, differences and unknown modalities.
pub(super) fn sensed_position(layout: &Layout, modality: Modality) -> Option<usize> {
    let is_it = |definition: &harness_spec::Definition| {
        definition.name == modality && !definition.is_image() && definition.difference_of.is_none()
    };
    layout.modalities.iter().position(is_it)
}

/// Whether each step evaluates the derived quantities at later instants within it, and leaves those of the last one.
/// Only the sensors keep the values of the first.
fn is_runge_kutta(model: &MjModel) -> bool {
    model.opt().integrator == MjtIntegrator::mjINT_RK4 as i32
}

/// Whether the next step may let bodies fall asleep. It then stops them, and computes the derived quantities once more.
/// A negative number of a tree counts the steps until it may sleep: -2 before the last one, and -1 while it waits for
/// the trees that it touches.
fn may_fall_asleep(data: &MjData<Arc<MjModel>>) -> bool {
    data.tree_asleep().iter().any(|tree| (-2..0).contains(tree))
}

/// Returns by how much two surfaces overlap at most, m.
fn deepest_m(data: &MjData<Arc<MjModel>>) -> f64 {
    data.contact().iter().map(|contact| -contact.dist).fold(0.0, f64::max)
}

/// Receives each sampled instant, and the state whose derived quantities (such as the poses for the camera) belong to
/// it.
pub(super) type Observer<'o> =
    dyn FnMut(&Instant, &mut MjData<Arc<MjModel>>) -> Result<(), SimulationError> + 'o;

impl<'s> Physics<'s> {
    /// Creates the simulation of a scene.
    ///
    /// # Errors
    /// When the spec's ranges or rates do not suit the scene.
    pub fn new(scene: &'s Scene, spec: &Simulation) -> Result<Self, SimulationError> {
        let timing = scene.timing(spec)?;
        let data = MjData::new(scene.model.clone());
        let is_copied = is_runge_kutta(&scene.model);
        let sampled = (is_copied || can_sleep(&scene.model)).then(|| MjData::new(scene.model.clone()));
        let averages =
            scene.resolved.readings.iter().flatten().any(|reading| matches!(reading, Reading::MeanForce(_)));
        let elements = scene.resolved.actuators.len();
        let kind_sums = |kinds: &ContactKinds| vec![0.0; scene.resolved.forces * (kinds.last + 1)];
        let instant = Instant {
            model: scene.model.clone(),
            state: scene.rest().to_vec(),
            state_before: scene.rest().to_vec(),
            qvel: data.qvel().to_vec(),
            setpoint: vec![0.0; elements],
            poses: vec![Pose::default(); scene.resolved.posed.len()],
            forces: vec![0.0; scene.resolved.forces],
            mean_forces: vec![0.0; scene.resolved.forces],
            contact_kinds: vec![vec![0; scene.resolved.forces]; scene.resolved.contact_kinds.len()],
            normals: vec![[0.0; 3]; scene.resolved.normals.len()],
            sensors: data.sensordata().to_vec(),
            noise: vec![Vec::new(); scene.resolved.readings.len()],
        };
        Ok(Self {
            scene,
            timing,
            data,
            sampled,
            is_copied,
            averages,
            instant,
            setpoint: vec![0.0; elements],
            forces: vec![0.0; scene.resolved.forces],
            resting: Resting::default(),
            mean: MeanForces::new(scene.resolved.forces),
            kind_sums: scene.resolved.contact_kinds.iter().map(kind_sums).collect(),
            noise: Noise::default(),
            probe: None,
            episode: 0,
            step: 0,
        })
    }

    /// Simulates one episode from rest.
    pub fn run(&mut self, plan: &EpisodePlan, observe: &mut Observer<'_>) -> Result<(), SimulationError> {
        self.start(plan);
        for _ in 0..self.timing.samples {
            self.follow(plan)?;
            let (instant, data) = self.sampled();
            observe(instant, data)?;
        }
        Ok(())
    }

    /// Simulates up to the next sampled instant along the plan of the episode.
    pub fn follow(&mut self, plan: &EpisodePlan) -> Result<(), SimulationError> {
        self.advance_by(|physics, setpoint| {
            plan.setpoint(physics.probe.map_or(physics.step, |probe| probe.clock), setpoint);
        })
    }

    /// Simulates up to the next sampled instant. `setpoint` writes the setpoint of each step, counted from the start.
    pub fn advance(&mut self, setpoint: impl Fn(usize, &mut [f64])) -> Result<(), SimulationError> {
        self.advance_by(|physics, values| setpoint(physics.step, values))
    }

    /// Simulates up to the next sampled instant. The first one is the start of the episode. `setpoint` writes the
    /// setpoint of each step.
    ///
    /// MuJoCo's step computes the forces and poses of the instant at which it starts, and then advances the positions.
    /// A sample therefore takes its positions before a step and everything else after it, at no extra cost. With the
    /// Runge-Kutta integrator, and where bodies may fall asleep, a copy of the state computes them instead.
    fn advance_by(&mut self, setpoint: impl Fn(&Self, &mut [f64])) -> Result<(), SimulationError> {
        loop {
            let is_sample = self.step.is_multiple_of(self.timing.steps_per_sample);
            let mut values = std::mem::take(&mut self.setpoint);
            setpoint(self, &mut values);
            self.setpoint = values;
            self.command();
            if is_sample {
                std::mem::swap(&mut self.instant.state_before, &mut self.instant.state);
                read_state(&self.data, &mut self.instant.state);
                if self.step == 0 {
                    self.instant.state_before.copy_from_slice(&self.instant.state);
                }
                self.instant.qvel.copy_from_slice(self.data.qvel());
            }
            let is_read = is_sample || self.averages || self.probe.is_some();
            if let Some(sampled) = self.sampled.as_mut().filter(|_| is_read) {
                self.is_copied = is_runge_kutta(&self.scene.model) || may_fall_asleep(&self.data);
                if self.is_copied {
                    self.data.copy_to(sampled).expect("both have the episode's model");
                    sampled.forward();
                }
            }
            self.resting.fall_asleep(self.scene, &self.data);
            self.data.step();
            self.resting.wake(&self.data);
            if self.step == 0 {
                check_start(self.scene, self.episode, self.derived())?;
            }
            if let Some(what) = instability(&self.data) {
                let time_s = self.step as f64 * self.timing.step_s;
                let scene = self.scene.name.clone();
                return Err(SimulationError::Diverged { scene, episode: self.episode, time_s, what });
            }
            self.step += 1;
            let data = self.sampled.as_ref().filter(|_| self.is_copied).unwrap_or(&self.data);
            if is_read {
                sum_forces(self.scene, data, &self.resting, &mut self.forces);
                self.mean.add(&self.forces);
                for (kinds, sums) in self.scene.resolved.contact_kinds.iter().zip(&mut self.kind_sums) {
                    if is_sample || kinds.averages {
                        add_kinds(self.scene, kinds, data, &self.resting, sums);
                    }
                }
            }
            if let (Some(probe), Some(touch)) = (&mut self.probe, &self.scene.resolved.touch) {
                let force: f64 = touch.forces.iter().map(|force| self.forces[*force]).sum();
                probe.advance(force > touch.least_n);
            }
            if is_sample {
                self.instant.setpoint.copy_from_slice(&self.setpoint);
                self.instant.forces.copy_from_slice(&self.forces);
                self.mean.take(&mut self.instant.mean_forces);
                let found = self.kind_sums.iter_mut().zip(&mut self.instant.contact_kinds);
                for (kinds, (sums, found)) in self.scene.resolved.contact_kinds.iter().zip(found) {
                    take_largest_kinds(kinds, sums, found);
                }
                write_normals(self.scene, data, &self.resting, &mut self.instant.normals);
                self.instant.sensors.copy_from_slice(data.sensordata());
                for (pose, object) in self.instant.poses.iter_mut().zip(&self.scene.resolved.posed) {
                    *pose = pose_of(data, *object);
                }
                let scene = self.scene;
                self.noise.draw(|position| scene.resolved.readings[position].len(), &mut self.instant.noise);
                return Ok(());
            }
        }
    }

    /// Returns the values at the latest sampled instant, and the state whose derived quantities belong to it.
    pub fn sampled(&mut self) -> (&Instant, &mut MjData<Arc<MjModel>>) {
        (&self.instant, self.sampled.as_mut().filter(|_| self.is_copied).unwrap_or(&mut self.data))
    }

    /// Returns the state whose derived quantities belong to the latest sampled instant.
    pub fn derived(&self) -> &MjData<Arc<MjModel>> {
        self.sampled.as_ref().filter(|_| self.is_copied).unwrap_or(&self.data)
    }

    /// Returns the number of steps since the start of the episode.
    pub fn step(&self) -> usize {
        self.step
    }

    /// Starts an episode: applies its factors of variation to the model, and sets the joints of position servos to the
    /// start of the motion and the boxes to their poses, all at rest. Coupled joints and the states of actuators
    /// follow. If the world names a keyframe, the joints and the states have its values. Factors can offset other
    /// joints.
    pub fn start(&mut self, plan: &EpisodePlan) {
        (self.episode, self.step) = (plan.episode, 0);
        self.mean.clear();
        self.kind_sums.iter_mut().for_each(|sums| sums.fill(0.0));
        self.noise = plan.noise.clone();
        self.probe = self.scene.resolved.touch.as_ref().map(|_| Probe::new(&self.timing));
        // Starts from the scene's own model, so that no change of the previous episode remains.
        self.instant.model = plan.factors.apply(self.scene, &self.scene.model);
        for data in [&mut self.data].into_iter().chain(&mut self.sampled) {
            data.swap_model(self.instant.model.clone());
        }
        plan.setpoint(0, &mut self.setpoint);
        match self.scene.resolved.keyframe {
            Some(key) => self.data.reset_keyframe(key).expect("the scene has the keyframe"),
            None => self.data.reset(),
        }
        let qpos = self.data.qpos_mut();
        // In a keyframe, the author of the model says where the joints are.
        let driven = self.scene.resolved.actuators.iter().filter(|_| self.scene.resolved.keyframe.is_none());
        for (driven, value) in driven.zip(&self.setpoint) {
            driven.qpos.iter().for_each(|index| qpos[*index] = *value);
        }
        plan.factors.offset_joints(self.scene, qpos);
        let scene = self.scene;
        if scene.resolved.keyframe.is_none() {
            scene.resolved.settling.couple(&self.instant.model, qpos);
        }
        let boxes = self.scene.resolved.placements.iter().flat_map(|placement| &placement.boxes);
        for (body, pose) in boxes.zip(&plan.boxes) {
            qpos[body.qpos..body.qpos + pose.len()].copy_from_slice(pose);
        }
        self.command();
        if scene.resolved.keyframe.is_none() {
            scene.resolved.settling.settle_states(&mut self.data);
        }
        scene.resolved.settling.fill_delays(&mut self.data);
        self.resting.restart(scene, &self.data);
    }

    /// Goes on from where another simulation of the same episode is, with the state rounded to f32 and without noise.
    /// Bodies that sleep keep their exact positions, because MuJoCo wakes what has been moved.
    pub fn go_on_from(&mut self, other: &Self) {
        other.data.copy_to(&mut self.data).expect("both have the episode's model");
        let round =
            |values: &mut [f64]| values.iter_mut().for_each(|value| *value = f64::from(*value as f32));
        let model = self.instant.model.clone();
        for (joint, first) in model.jnt_qposadr().iter().enumerate() {
            let end = model.jnt_qposadr().get(joint + 1).map_or(model.nq() as usize, |next| *next as usize);
            let tree = model.dof_treeid()[model.jnt_dofadr()[joint] as usize] as usize;
            // MuJoCo gives awake trees a negative number.
            if self.data.tree_asleep()[tree] < 0 {
                round(&mut self.data.qpos_mut()[*first as usize..end]);
            }
        }
        round(self.data.qvel_mut());
        round(self.data.act_mut());
        self.noise = Noise::default();
        self.step = other.step;
        self.probe = other.probe;
        self.resting.clone_from(&other.resting);
        self.mean.clone_from(&other.mean);
        self.kind_sums.clone_from(&other.kind_sums);
        self.setpoint.clone_from(&other.setpoint);
        self.instant.state.clone_from(&other.instant.state);
    }

    /// Adds errors to the state, as far as it is not known. Where they let surfaces overlap more than before, the
    /// contacts push them apart first: in up to [`PUSHING_STEPS`] steps without time and velocity.
    pub fn err(&mut self, known: &Known, rng: &mut ChaCha8Rng) {
        self.data.step1();
        let allowed_m = deepest_m(&self.data).max(SLACK_M);
        let (velocities, states) = (self.data.qvel().to_vec(), self.data.act().to_vec());
        let time_s = self.data.time();
        known.err(self.data.qpos_mut(), rng);
        for _ in 0..PUSHING_STEPS {
            self.data.qvel_mut().fill(0.0);
            self.data.step1();
            if deepest_m(&self.data) <= allowed_m {
                break;
            }
            self.data.step2();
        }
        match known.at_rest() {
            true => self.data.qvel_mut().fill(0.0),
            false => self.data.qvel_mut().copy_from_slice(&velocities),
        }
        self.data.act_mut().copy_from_slice(&states);
        self.data.set_time(time_s);
    }

    fn command(&mut self) {
        let ctrl = self.data.ctrl_mut();
        for (driven, value) in self.scene.resolved.actuators.iter().zip(&self.setpoint) {
            driven.controls.iter().for_each(|control| ctrl[*control] = *value);
        }
        let places = self.data.mocap_pos_mut();
        for (driven, value) in self.scene.resolved.actuators.iter().zip(&self.setpoint) {
            if let Some((mocap, axis)) = driven.mocap {
                places[mocap][axis] = *value;
            }
        }
    }
}
