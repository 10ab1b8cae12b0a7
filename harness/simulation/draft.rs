//! Writes a first world file for any model.

use super::SimulationError;
use super::resolve::named;
use super::scene::{compile_error, prepare};
use mujoco_rs::prelude::*;
use std::fmt::Write;
use std::path::Path;

/// Side of the images in a first world file, pixels.
const SIDE: usize = 64;

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
    let mut text = format!(
        "# Written by `harness world new`. Remove what is not sensed; `harness world check` lists what each name matches.\n\
         description: {}\nmodel: {}\nstep_rate_hz: {}\nsample_rate_hz: 10\n\nmodalities:\n",
        quoted(&format!("The robot of {file}")),
        quoted(called),
        1.0 / model.opt().timestep,
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
    text.push_str("\naction:\n  seconds: 1\n  actuators:\n");
    for (index, (name, id)) in actuators.into_iter().enumerate() {
        let [low, high] =
            if model.actuator_ctrllimited()[id] { model.actuator_ctrlrange()[id] } else { [-1.0, 1.0] };
        let element = name.to_lowercase();
        let element = if harness_spec::is_name(&element) { element } else { format!("actuator_{index}") };
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
