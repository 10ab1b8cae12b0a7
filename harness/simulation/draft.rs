//! Writes a first world file for any model.

use super::SimulationError;
use super::resolve::{limits, named};
use super::scene::{compile_error, prepare};
use mujoco_rs::prelude::*;
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

/// Side of the images in a first world file, pixels.
const SIDE: usize = 64;

/// Sample rate in a first world file, unless it does not divide the rate of the simulation steps.
const SAMPLE_RATE_HZ: f64 = 10.0;

/// Returns the text of a world file for the MJCF at the path `model`. The file has all named joints, links, sensors,
/// cameras and actuators of the model, and refers to the model by the path `called`.
///
/// # Errors
/// When the model can't be compiled, or has no actuator with a name.
pub fn draft_world(model: &Path, called: &str) -> Result<String, SimulationError> {
    prepare()?;
    let shown = model.display().to_string();
    let file = model.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let model = MjModel::from_xml(model).map_err(|error| compile_error(&shown, error))?;
    let actuators = named(&model, MjtObjBase::mjOBJ_ACTUATOR);
    if actuators.is_empty() {
        let problem = "it has no actuator with a name, which a world's action needs".to_owned();
        return Err(SimulationError::Unsuitable { scene: shown, problem });
    }
    let step_rate_hz = 1.0 / model.opt().timestep;
    // Ten samples in a second, or the rate that is nearest to it among those with a whole number of steps for each sample.
    let steps = (step_rate_hz / SAMPLE_RATE_HZ).round().max(1.0);
    let is_whole = (step_rate_hz / SAMPLE_RATE_HZ - steps).abs() < 1e-9 * steps;
    let sample_rate_hz = if is_whole { SAMPLE_RATE_HZ } else { step_rate_hz / steps };
    let seconds = if is_whole { 1.0 } else { sample_rate_hz.round().max(1.0) * steps * model.opt().timestep };
    let mut text = format!(
        "# Written by `harness world new`. Remove what is not sensed; `harness world check` lists what each name matches.\n\
         description: {}\nmodel: {}\nstep_rate_hz: {step_rate_hz}\nsample_rate_hz: {sample_rate_hz}\n\n\
         modalities:\n",
        quoted(&format!("The robot of {file}")),
        quoted(called),
    );
    let joints = named(&model, MjtObjBase::mjOBJ_JOINT);
    let is_single =
        |joint: usize| [MjtJoint::mjJNT_HINGE, MjtJoint::mjJNT_SLIDE].contains(&model.jnt_type()[joint]);
    let joints: Vec<&str> = joints.iter().filter(|(_, id)| is_single(*id)).map(|(name, _)| *name).collect();
    if !joints.is_empty() {
        entry(&mut text, "joints", &[("joint_positions", list(&joints))]);
        entry(&mut text, "joint_velocities", &[("joint_velocities", list(&joints))]);
    }
    let moves = |body: usize| {
        let first = model.body_jntadr()[body];
        first >= 0 && is_single(first as usize)
    };
    let touches = |geom: usize| {
        let collides = model.geom_contype()[geom] != 0 || model.geom_conaffinity()[geom] != 0;
        collides && moves(model.geom_bodyid()[geom] as usize)
    };
    let geoms = named(&model, MjtObjBase::mjOBJ_GEOM);
    let mut links: Vec<&str> = geoms.iter().filter(|(_, id)| touches(*id)).map(|(name, _)| *name).collect();
    if links.is_empty() && geoms.is_empty() {
        let bodies = named(&model, MjtObjBase::mjOBJ_BODY);
        let is_link = |body: usize| moves(body) && model.body_geomnum()[body] > 0;
        links = bodies.iter().filter(|(_, id)| is_link(*id)).map(|(name, _)| *name).collect();
    }
    if !links.is_empty() {
        entry(&mut text, "contact_force", &[("normal_force", list(&links))]);
    }
    let mut sensors: Vec<(String, Vec<&str>)> = Vec::new();
    for (name, id) in named(&model, MjtObjBase::mjOBJ_SENSOR) {
        let kind = format!("{:?}", model.sensor_type()[id]).trim_start_matches("mjSENS_").to_lowercase();
        match sensors.iter_mut().find(|(other, _)| *other == kind) {
            Some((_, names)) => names.push(name),
            None => sensors.push((kind, vec![name])),
        }
    }
    for (kind, names) in &sensors {
        let unit = match kind.as_str() {
            "touch" | "force" | "actuatorfrc" | "tendonactfrc" => "N",
            "torque" => "N m",
            "accelerometer" | "framelinacc" => "m/s^2",
            "velocimeter" | "framelinvel" | "subtreelinvel" => "m/s",
            "gyro" | "frameangvel" => "rad/s",
            "framepos" | "rangefinder" | "subtreecom" => "m",
            _ => "",
        };
        entry(&mut text, kind, &[("sensor", list(names)), ("unit", quoted(unit))]);
    }
    for (index, (name, _)) in named(&model, MjtObjBase::mjOBJ_CAMERA).into_iter().enumerate() {
        let modality = format!("camera_{index}");
        entry(&mut text, &modality, &[("camera", quoted(name)), ("size", format!("[{SIDE}, {SIDE}]"))]);
        entry(&mut text, &format!("{modality}_difference"), &[("difference_of", modality.clone())]);
    }
    let _ = write!(text, "\naction:\n  seconds: {seconds}\n  actuators:\n");
    let mut elements = BTreeSet::new();
    for (index, (name, id)) in actuators.into_iter().enumerate() {
        let [low, high] = limits(&model, id);
        let low = if low.is_finite() { low } else { high.min(1.0) - 2.0 };
        let high = if high.is_finite() { high } else { low + 2.0 };
        let mut element = name.to_lowercase();
        let mut number = index;
        while !harness_spec::is_name(&element) || !elements.insert(element.clone()) {
            element = format!("actuator_{number}");
            number += 1;
        }
        let (name, range) = (quoted(name), format!("[{low:?}, {high:?}]"));
        let _ = writeln!(text, "    {element}: {{actuator: {name}, range: {range}}}");
    }
    Ok(text)
}

fn entry(text: &mut String, name: &str, keys: &[(&str, String)]) {
    let keys: Vec<String> = keys.iter().map(|(key, value)| format!("{key}: {value}")).collect();
    let _ = writeln!(text, "  {name}: {{{}}}", keys.join(", "));
}

fn list(names: &[&str]) -> String {
    format!("[{}]", names.iter().map(|name| quoted(name)).collect::<Vec<_>>().join(", "))
}

/// Quotes a text for YAML.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}
