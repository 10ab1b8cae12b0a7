//! What someone knows of the state from which a simulation goes on: how precisely, and what not at all.

use super::SimulationError;
use super::factors::{product, stream};
use super::joints::{is_free, is_single};
use super::names::{BODY, JOINT, named};
use super::resolved::Reading;
use super::scene::Scene;
use harness_spec::{Modality, Simulation, matching};
use mujoco_rs::prelude::*;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use std::str::FromStr;

/// How far a body is moved that is not known, m.
const OUT_OF_REACH_M: f64 = 100.0;

/// What is known of a state. The default is everything.
#[derive(Debug, Clone, PartialEq)]
pub struct Knowledge {
    /// Errors of the positions.
    pub errors: Vec<PositionError>,
    /// Whether the velocities are not known. They are then 0.
    pub at_rest: bool,
    /// Names or patterns of freely moving bodies that are not known. They are moved 100 m away.
    pub without: Vec<String>,
    /// How many times a simulation goes on from each state, each time with other errors.
    pub restarts: usize,
}

impl Default for Knowledge {
    fn default() -> Self {
        Self { errors: Vec::new(), at_rest: false, without: Vec::new(), restarts: 1 }
    }
}

impl Knowledge {
    /// Whether all is known.
    pub fn is_all(&self) -> bool {
        self.errors.is_empty() && !self.at_rest && self.without.is_empty()
    }
}

/// Normally distributed errors of positions, with a mean of 0.
#[derive(Debug, Clone, PartialEq)]
pub struct PositionError {
    /// A modality, or the name or a pattern of joints or of freely moving bodies.
    pub of: String,
    /// Their standard deviation.
    pub size: ErrorSize,
    /// The size as it was written: `0.5deg`.
    pub text: String,
}

/// The standard deviation of an error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ErrorSize {
    /// Of rotations, rad: of hinges, and around each axis of ball joints and free bodies.
    Rotation(f64),
    /// Of translations, m: of slides, and along each axis of free bodies.
    Translation(f64),
}

impl FromStr for PositionError {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let form = "write NAME=SIZE with a size in deg, rad, mm, cm or m, such as arm=0.5deg";
        let (of, size) = text.split_once('=').ok_or(form)?;
        let (of, size) = (of.trim(), size.trim());
        let unit = size.trim_start_matches(|c: char| c.is_ascii_digit() || ".eE+-".contains(c));
        let number: f64 = size[..size.len() - unit.len()].parse().map_err(|_| form)?;
        if of.is_empty() || !number.is_finite() || number < 0.0 {
            return Err(form.into());
        }
        let size = match unit.trim() {
            "deg" => ErrorSize::Rotation(number.to_radians()),
            "rad" => ErrorSize::Rotation(number),
            "mm" => ErrorSize::Translation(number / 1000.0),
            "cm" => ErrorSize::Translation(number / 100.0),
            "m" => ErrorSize::Translation(number),
            _ => return Err(form.into()),
        };
        Ok(Self { of: of.to_owned(), size, text: text.trim().to_owned() })
    }
}

/// A part of `qpos` that has errors.
#[derive(Debug, Clone, Copy)]
enum Erring {
    /// A number, and the standard deviation of its error.
    Number(usize, f64),
    /// The first number of a quaternion, and the standard deviation around each axis.
    Quaternion(usize, f64),
}

/// What is known of the states of a scene.
pub(super) struct Known<'k> {
    knowledge: &'k Knowledge,
    erring: Vec<Erring>,
    /// Indices into `qpos` of the first coordinates of the bodies that are not known.
    without: Vec<usize>,
}

impl<'k> Known<'k> {
    /// Finds what the names stand for.
    ///
    /// # Errors
    /// When a name is that of nothing whose position can be unknown, or has no position of the error's kind.
    pub fn new(scene: &Scene, knowledge: &'k Knowledge) -> Result<Self, SimulationError> {
        let model = scene.model();
        let mut erring = Vec::new();
        for error in &knowledge.errors {
            let joints = joints(scene, &error.of)?;
            let before = erring.len();
            joints.iter().for_each(|joint| erring.extend(parts(model, *joint, error.size)));
            if erring.len() == before {
                let kind = match error.size {
                    ErrorSize::Rotation(_) => "rotates",
                    ErrorSize::Translation(_) => "moves along an axis",
                };
                return Err(unsuitable(
                    scene,
                    format!("nothing in '{}' {kind}, so it has no error of {}", error.of, error.text),
                ));
            }
        }
        let mut without = Vec::new();
        for name in &knowledge.without {
            let free: Vec<usize> =
                joints(scene, name)?.into_iter().filter(|joint| is_free(model, *joint)).collect();
            if free.is_empty() {
                return Err(unsuitable(
                    scene,
                    format!("'{name}' moves with others, so the world can't be without it"),
                ));
            }
            without.extend(free.iter().map(|joint| model.jnt_qposadr()[*joint] as usize));
        }
        without.sort_unstable();
        without.dedup();
        Ok(Self { knowledge, erring, without })
    }

    /// Returns the random generator for the errors at a sample.
    pub fn stream(
        scene: &Scene,
        spec: &Simulation,
        episode: u32,
        sample: usize,
        restart: usize,
    ) -> ChaCha8Rng {
        stream(&format!("error of the state at {sample}, {restart}"), spec.seed, scene.scenario(), episode)
    }

    /// Whether velocities are not known.
    pub fn at_rest(&self) -> bool {
        self.knowledge.at_rest
    }

    /// Adds errors to positions, and moves the bodies away that are not known.
    pub fn err(&self, qpos: &mut [f64], rng: &mut ChaCha8Rng) {
        let mut normal = || -> f64 { StandardNormal.sample(rng) };
        for part in &self.erring {
            match *part {
                Erring::Number(index, deviation) => qpos[index] += deviation * normal(),
                Erring::Quaternion(first, deviation) => {
                    let vector = [(); 3].map(|()| deviation * normal());
                    let angle = vector.iter().map(|value| value * value).sum::<f64>().sqrt();
                    let along = if angle > 0.0 { (angle / 2.0).sin() / angle } else { 0.5 };
                    let [x, y, z] = vector.map(|value| value * along);
                    let turned: [f64; 4] = std::array::from_fn(|index| qpos[first + index]);
                    qpos[first..first + 4].copy_from_slice(&product([(angle / 2.0).cos(), x, y, z], turned));
                }
            }
        }
        self.without.iter().for_each(|first| qpos[*first] += OUT_OF_REACH_M);
    }
}

fn unsuitable(scene: &Scene, problem: String) -> SimulationError {
    SimulationError::Unsuitable { scene: scene.name.clone(), problem }
}

/// Returns the joints of a modality's elements, or those with this name, or those of the bodies with this name.
fn joints(scene: &Scene, name: &str) -> Result<Vec<usize>, SimulationError> {
    let model = scene.model();
    let of_body = |body: usize| {
        let first = usize::try_from(model.body_jntadr()[body]).ok()?;
        Some(first..first + model.body_jntnum()[body] as usize)
    };
    let position = |modality: Modality| scene.layout().modalities.iter().position(|one| one.name == modality);
    let mut found: Vec<usize> = match Modality::new(name).and_then(position) {
        Some(position) => {
            let of = |reading: &Reading| match *reading {
                Reading::Position(at) | Reading::Orientation(at, _) => model
                    .jnt_qposadr()
                    .iter()
                    .rposition(|first| *first as usize <= at)
                    .map(|joint| joint..joint + 1),
                Reading::Pose(index, _) => of_body(scene.resolved.posed[index].id),
                _ => None,
            };
            scene.resolved.readings[position].iter().filter_map(of).flatten().collect()
        }
        None => {
            let matched = |kind| {
                let all = named(model, kind);
                let names: Vec<&str> = all.iter().map(|(name, _)| *name).collect();
                let found = matching(&[name.to_owned()], &names).unwrap_or_default();
                found.into_iter().map(|index| all[index].1).collect::<Vec<_>>()
            };
            let joints = matched(JOINT);
            let of_bodies = || matched(BODY).into_iter().filter_map(of_body).flatten().collect();
            if joints.is_empty() { of_bodies() } else { joints }
        }
    };
    found.sort_unstable();
    found.dedup();
    if found.is_empty() {
        let what = "a modality of joint positions or of bodies' poses, a joint, or a body with joints";
        return Err(unsuitable(
            scene,
            format!("'{name}' is not the name or a pattern of the names of {what}"),
        ));
    }
    Ok(found)
}

/// Returns the parts of a joint's position that an error of this kind changes.
fn parts(model: &MjModel, joint: usize, size: ErrorSize) -> Vec<Erring> {
    let first = model.jnt_qposadr()[joint] as usize;
    let is_hinge = model.jnt_type()[joint] == MjtJoint::mjJNT_HINGE;
    match size {
        ErrorSize::Rotation(deviation) if is_hinge => vec![Erring::Number(first, deviation)],
        ErrorSize::Rotation(deviation) if !is_single(model, joint) => {
            vec![Erring::Quaternion(first + if is_free(model, joint) { 3 } else { 0 }, deviation)]
        }
        ErrorSize::Translation(deviation) if is_free(model, joint) => {
            (first..first + 3).map(|index| Erring::Number(index, deviation)).collect()
        }
        ErrorSize::Translation(deviation) if is_single(model, joint) && !is_hinge => {
            vec![Erring::Number(first, deviation)]
        }
        _ => Vec::new(),
    }
}
