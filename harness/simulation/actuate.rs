//! Adds to a model without actuators what an action can move.

use super::SimulationError;
use super::joints::is_single;
use super::load::load_file;
use super::names::{BODY, JOINT, called};
use super::scene::prepare;
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_editing::{MjtLimited, PositionConfig};
use std::collections::BTreeSet;
use std::f64::consts::TAU;
use std::path::Path;

/// Natural frequency of a joint with its servo, Hz.
const SERVO_HZ: f64 = 5.0;
/// Largest change of the phase of this oscillation in a simulation step, rad. It keeps the simulation stable.
const STEP_RAD: f64 = 0.2;
/// How far a servo moves a hinge without limits to each side, rad.
const HINGE_RAD: f64 = 1.0;
/// How far a servo moves a slide without limits to each side, as a part of the model's extent.
const SLIDE_PART: f64 = 0.1;
/// Radius of the probe, as a part of the diagonal of what moves.
const PROBE_PART: f64 = 0.05;

/// What can be added to a model without actuators.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Addable {
    /// A position servo on each of this number of hinges and slides.
    Servos(usize),
    /// A mocap body that touches what moves.
    Probe,
    /// Nothing, because nothing moves.
    Nothing,
}

impl Addable {
    pub(super) fn to(model: &MjModel) -> Self {
        match (servo_joints(model).len(), model.njnt()) {
            (0, 0) => Self::Nothing,
            (0, _) => Self::Probe,
            (servos, _) => Self::Servos(servos),
        }
    }
}

/// A mocap body that was added to a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Probe {
    /// Its name.
    pub body: String,
    /// Where its coordinates x, y and z can be, m. The highest z is above everything that moves.
    pub ranges: [[f64; 2]; 3],
}

/// A copy of a model, with what an action can move.
#[derive(Debug, Clone, PartialEq)]
pub struct Actuated {
    /// The MJCF of the copy.
    pub mjcf: String,
    /// The mocap body that was added; `None` if servos were.
    pub probe: Option<Probe>,
}

/// Returns the joints that are parts of flexes.
pub(super) fn flex_joints(model: &MjModel) -> BTreeSet<usize> {
    let bodies: BTreeSet<i32> =
        model.flex_vertbodyid().iter().chain(model.flex_nodebodyid()).copied().collect();
    let has_name = |joint: usize| model.id_to_name(JOINT.0, joint).is_some_and(|name| !name.is_empty());
    // A vertex can also be attached to a body of the robot, whose joints mostly have names.
    let is_part = |joint: &usize| bodies.contains(&model.jnt_bodyid()[*joint]) && !has_name(*joint);
    (0..model.njnt() as usize).filter(is_part).collect()
}

/// Returns the joints that can have servos: the hinges and slides that are not parts of flexes.
fn servo_joints(model: &MjModel) -> Vec<usize> {
    let of_flex = flex_joints(model);
    (0..model.njnt() as usize).filter(|joint| is_single(model, *joint) && !of_flex.contains(joint)).collect()
}

/// Returns a copy of the model at the path `model` with a position servo on each hinge and slide or, if there is none,
/// a mocap body that touches what moves. The copy finds the files of the model from any folder if `is_elsewhere`, and
/// else from the model's own.
///
/// # Errors
/// When the model can't be read or compiled, has an actuator or a mocap body already, or nothing in it moves.
pub fn actuate(model: &Path, is_elsewhere: bool) -> Result<Actuated, SimulationError> {
    prepare()?;
    let scene = model.display().to_string();
    let unsuitable = |problem| SimulationError::Unsuitable { scene: scene.clone(), problem };
    let edited = |error: MjEditError| unsuitable(format!("MuJoCo can't add to it: {error}"));
    let path = model;
    let model = load_file(path)?;
    if model.nactuator() + model.nmocap() > 0 {
        return Err(unsuitable("it has an actuator or a mocap body already; leave out --actuate".into()));
    }
    let mut spec = MjSpec::from_xml(path).map_err(edited)?;
    // Gives the elements their numbers.
    spec.compile().map_err(edited)?;
    let probe = match Addable::to(&model) {
        Addable::Servos(_) => {
            add_servos(&model, &mut spec).map_err(edited)?;
            None
        }
        Addable::Probe => Some(add_probe(&model, &mut spec).map_err(edited)?),
        adds @ Addable::Nothing => return Err(SimulationError::NoAction { scene, adds }),
    };
    if is_elsewhere {
        let folder =
            path.parent().and_then(|folder| std::fs::canonicalize(folder.join(".")).ok()).unwrap_or_default();
        let compiler = spec.compiler_mut();
        let [meshes, textures] = [compiler.meshdir(), compiler.texturedir()]
            .map(|own| folder.join(own).to_string_lossy().into_owned());
        compiler.set_meshdir(&meshes);
        compiler.set_texturedir(&textures);
    }
    spec.compile().map_err(edited)?;
    let mjcf = match spec.save_xml_string(1) {
        Err(MjEditError::XmlBufferTooSmall { required_size }) => spec.save_xml_string(required_size + 1),
        other => other,
    };
    Ok(Actuated { mjcf: mjcf.map_err(edited)?, probe })
}

/// Adds a position servo to each hinge and slide. It moves the joint over its range.
fn add_servos(model: &MjModel, spec: &mut MjSpec) -> Result<(), MjEditError> {
    let frequency = (TAU * SERVO_HZ).min(STEP_RAD / model.opt().timestep);
    let joints = servo_joints(model);
    let mut names = Vec::new();
    for joint in spec.joint_iter_mut() {
        let Some(id) = joint.id().filter(|id| joints.contains(id)) else { continue };
        let name = called(model, JOINT, id).unwrap_or_else(|| format!("servo_{id}"));
        if joint.name().is_empty() {
            joint.set_name(&name)?;
        }
        names.push((name, id));
    }
    for (name, id) in names {
        let inertia = model.dof_m0()[model.jnt_dofadr()[id] as usize];
        let place = model.qpos0()[model.jnt_qposadr()[id] as usize];
        let reach = match model.jnt_type()[id] {
            MjtJoint::mjJNT_HINGE => HINGE_RAD,
            _ => SLIDE_PART * model.stat().extent,
        };
        let range =
            if model.jnt_limited()[id] { model.jnt_range()[id] } else { [place - reach, place + reach] };
        let servo = spec.add_actuator();
        servo.set_name(&name)?;
        servo.set_target(&name);
        servo.set_trntype(MjtTrn::mjTRN_JOINT);
        servo.set_to_position(PositionConfig {
            kp: inertia * frequency * frequency + model.jnt_stiffness()[id],
            dampratio: Some(1.0),
            ..PositionConfig::default()
        })?;
        *servo.ctrlrange_mut() = range;
        servo.set_ctrllimited(MjtLimited::mjLIMITED_TRUE);
    }
    Ok(())
}

/// Adds a mocap body with a sphere, above everything that moves.
fn add_probe(model: &MjModel, spec: &mut MjSpec) -> Result<Probe, MjEditError> {
    let [low, high] = box_of_moving(model);
    let diagonal = (0..3).map(|axis| (high[axis] - low[axis]).powi(2)).sum::<f64>().sqrt();
    let radius = if diagonal > 0.0 { PROBE_PART * diagonal } else { PROBE_PART };
    let top = high[2] + 3.0 * radius;
    let ranges = [
        [low[0] - radius, high[0] + radius],
        [low[1] - radius, high[1] + radius],
        [0.5 * (low[2] + high[2]), top],
    ];
    let is_free = |name: &String| model.name_to_id(BODY.0, name).is_none();
    let name = std::iter::once("probe".to_owned()).chain((0..).map(|number| format!("probe_{number}")));
    let name = name.into_iter().find(is_free).unwrap_or_default();
    // It touches all that can touch anything.
    let masks =
        [model.geom_contype(), model.geom_conaffinity(), model.flex_contype(), model.flex_conaffinity()];
    let mask = masks.into_iter().flatten().fold(1, |all, own| all | own);
    let body = spec.world_body_mut().add_body();
    body.set_name(&name)?;
    *body.pos_mut() = [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), top];
    body.set_mocap(true);
    let sphere = body.add_geom();
    sphere.set_type(MjtGeomBase::mjGEOM_SPHERE);
    *sphere.size_mut() = [radius, 0.0, 0.0];
    *sphere.rgba_mut() = [0.9, 0.2, 0.1, 1.0];
    sphere.set_contype(mask);
    sphere.set_conaffinity(mask);
    Ok(Probe { body: name, ranges })
}

/// Returns the lowest and the highest coordinates of everything that moves, in the model's own positions, m.
fn box_of_moving(model: &MjModel) -> [[f64; 3]; 2] {
    let mut data = MjData::new(model);
    data.forward();
    let mut bounds = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    let mut add = |place: &[f64; 3], radius: f64| {
        for axis in 0..3 {
            bounds[0][axis] = bounds[0][axis].min(place[axis] - radius);
            bounds[1][axis] = bounds[1][axis].max(place[axis] + radius);
        }
    };
    let moves = |body: usize| model.body_weldid()[body] != 0;
    (0..model.nbody() as usize).filter(|body| moves(*body)).for_each(|body| add(&data.xpos()[body], 0.0));
    for geom in (0..model.ngeom() as usize).filter(|geom| moves(model.geom_bodyid()[*geom] as usize)) {
        add(&data.geom_xpos()[geom], model.geom_rbound()[geom]);
    }
    data.flexvert_xpos().iter().for_each(|place| add(place, 0.0));
    bounds
}
