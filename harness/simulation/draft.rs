//! Writes a first world file for any model.

use super::SimulationError;
use super::controls::Control;
use super::joints::{ball_and_free, body_name, described, is_single, touches, word};
use super::load::load_file;
use super::resolve::named;
use super::scene::prepare;
use mujoco_rs::prelude::*;
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

/// Side of the images in a first world file, pixels.
const SIDE: usize = 64;

/// Sample rate in a first world file, unless it does not divide the rate of the simulation steps.
const SAMPLE_RATE_HZ: f64 = 10.0;

/// How far a mocap body moves to each side in a first world file, m.
const REACH_M: f64 = 0.1;

/// Returns the text of a world file for the MJCF at the path `model`. The file has all named joints, links, sensors,
/// cameras and actuators of the model, and refers to the model by the path `called`.
///
/// # Errors
/// When the model can't be compiled, or has neither an actuator nor a mocap body with a name.
pub fn draft_world(model: &Path, called: &str) -> Result<String, SimulationError> {
    prepare()?;
    let shown = model.display().to_string();
    let file = model.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let model = load_file(model)?;
    let actuators = named(&model, MjtObjBase::mjOBJ_ACTUATOR);
    let bodies = named(&model, MjtObjBase::mjOBJ_BODY);
    let mocap: Vec<(&str, usize)> = match actuators.is_empty() {
        true => bodies.into_iter().filter(|(_, id)| model.body_mocapid()[*id] >= 0).collect(),
        false => Vec::new(),
    };
    if actuators.is_empty() && mocap.is_empty() {
        let problem = match model.nactuator() {
            0 => "it has neither an actuator nor a mocap body with a name, and a world's action needs one of them"
                .to_owned(),
            count => format!(
                "none of its {count} actuators has a name, which a world's action needs; write names into the MJCF, \
                 such as <motor name=\"push\" .../>"
            ),
        };
        return Err(SimulationError::Unsuitable { scene: shown, problem });
    }
    let step_rate_hz = 1.0 / model.opt().timestep;
    // Ten samples in a second, or the rate that is nearest to it among those with a whole number of steps for each
    // sample.
    let steps = (step_rate_hz / SAMPLE_RATE_HZ).round().max(1.0);
    let is_whole = (step_rate_hz / SAMPLE_RATE_HZ - steps).abs() < 1e-9 * steps;
    let sample_rate_hz = if is_whole { SAMPLE_RATE_HZ } else { step_rate_hz / steps };
    let seconds = if is_whole { 1.0 } else { sample_rate_hz.round().max(1.0) * steps * model.opt().timestep };
    let mut text = format!(
        "# Written by `harness world new`. Remove what is not sensed; `harness world check` lists what each name \
         matches.\n\
         description: {}\nmodel: {}\nstep_rate_hz: {step_rate_hz}\nsample_rate_hz: {sample_rate_hz}\n\n\
         modalities:\n",
        quoted(&format!("The robot of {file}")),
        quoted(called),
    );
    joints(&mut text, &model);
    contact_forces(&mut text, &model);
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
    for (name, id) in mocap {
        for (axis, place) in ["x", "y", "z"].into_iter().zip(model.body_pos()[id]) {
            let element = format!("{name}_{axis}").to_lowercase();
            let element =
                if harness_spec::is_name(&element) { element } else { format!("mocap_{id}_{axis}") };
            let (name, range) = (quoted(name), format!("[{:?}, {:?}]", place - REACH_M, place + REACH_M));
            let _ = writeln!(
                text,
                "    {element}: {{mocap: {name}, axis: {axis}, unit: m, range: {range}}}   # a guess: how far it moves"
            );
        }
    }
    let mut elements = BTreeSet::new();
    let controls = actuators
        .into_iter()
        .flat_map(|(name, id)| Control::all_of(&model, id).map(move |control| (name, control)));
    for (index, (name, control)) in controls.enumerate() {
        let [low, high] = control.limits(&model);
        let guess = match low.is_finite() || high.is_finite() {
            true => "",
            false => "   # a guess: the model sets no ctrlrange for this actuator",
        };
        let low = if low.is_finite() { low } else { high.min(1.0) - 2.0 };
        let high = if high.is_finite() { high } else { low + 2.0 };
        // An actuator with several controls has an element for each.
        let part =
            control.name(&model).filter(|_| Control::all_of(&model, control.actuator).nth(1).is_some());
        let mut element = part.map_or(name.to_owned(), |part| format!("{name}_{part}")).to_lowercase();
        let mut number = index;
        while !harness_spec::is_name(&element) || !elements.insert(element.clone()) {
            element = format!("actuator_{number}");
            number += 1;
        }
        let part = part.map_or(String::new(), |part| format!(", control: {part}"));
        let (name, range) = (quoted(name), format!("[{low:?}, {high:?}]"));
        let _ = writeln!(text, "    {element}: {{actuator: {name}{part}, range: {range}}}{guess}");
    }
    Ok(text)
}

/// Writes the hinges and slides, and comments that record the ball and free joints and their bodies.
fn joints(text: &mut String, model: &MjModel) {
    let joints = named(model, MjtObjBase::mjOBJ_JOINT);
    let names: Vec<&str> =
        joints.iter().filter(|(_, id)| is_single(model, *id)).map(|(name, _)| *name).collect();
    if !names.is_empty() {
        entry(text, "joints", &[("joint_positions", list(&names))]);
        entry(text, "joint_velocities", &[("joint_velocities", list(&names))]);
    }
    let left_out = ball_and_free(model);
    if left_out.is_empty() {
        return;
    }
    let _ = writeln!(
        text,
        "  # Left out, because each has several values: {}.",
        left_out.iter().map(|joint| described(model, *joint)).collect::<Vec<_>>().join(", ")
    );
    let others: Vec<&str> =
        joints.iter().filter(|(_, id)| !is_single(model, *id)).map(|(name, _)| *name).collect();
    if !others.is_empty() {
        let _ = writeln!(text, "  # To record those with a name, remove the # from these lines:");
        optional_entry(text, "other_joints", &[("joint_positions", list(&others))]);
        optional_entry(text, "other_joint_velocities", &[("joint_velocities", list(&others))]);
    }
    let bodies = |is_wanted: &dyn Fn(usize) -> bool| -> Vec<&str> {
        left_out
            .iter()
            .filter(|joint| is_wanted(**joint))
            .filter_map(|joint| body_name(model, *joint))
            .collect()
    };
    let (oriented, free) = (bodies(&|_| true), bodies(&|joint| word(model, joint) == "free"));
    if !oriented.is_empty() {
        let _ = writeln!(text, "  # To record where these bodies are, remove the # from these lines:");
    }
    for key in ["body_positions", "body_orientations"] {
        let names = if key == "body_positions" { &free } else { &oriented };
        if !names.is_empty() {
            optional_entry(text, key, &[(key, list(names))]);
        }
    }
}

/// Writes the forces on the geoms that hinges and slides move or, if none of them has a name, on their bodies, and the
/// forces on flexes. Those that ball and free joints move are in a comment.
fn contact_forces(text: &mut String, model: &MjModel) {
    let geoms = named(model, MjtObjBase::mjOBJ_GEOM);
    let is_moved = |is_wanted: &dyn Fn(usize) -> bool| -> Vec<&str> {
        let touching = geoms.iter().filter(|(_, id)| touches(model, *id, is_wanted));
        let names: Vec<&str> = touching.map(|(name, _)| *name).collect();
        if !names.is_empty() {
            return names;
        }
        let body_of = |geom: usize| model.geom_bodyid()[geom] as usize;
        let links: BTreeSet<usize> = (0..model.ngeom() as usize)
            .filter(|geom| touches(model, *geom, is_wanted))
            .map(body_of)
            .collect();
        let bodies = named(model, MjtObjBase::mjOBJ_BODY);
        bodies.into_iter().filter(|(_, id)| links.contains(id)).map(|(name, _)| name).collect()
    };
    let (links, others) =
        (is_moved(&|joint| is_single(model, joint)), is_moved(&|joint| !is_single(model, joint)));
    if !links.is_empty() {
        entry(text, "contact_force", &[("normal_force", list(&links))]);
    }
    let flexes: Vec<&str> = named(model, MjtObjBase::mjOBJ_FLEX).into_iter().map(|(name, _)| name).collect();
    if !flexes.is_empty() {
        entry(text, "flex_force", &[("normal_force", list(&flexes))]);
    }
    if !others.is_empty() {
        text.push_str(
            "  # Left out, because a ball or free joint moves them. To record the forces on them, remove the #:\n",
        );
        optional_entry(text, "other_contact_force", &[("normal_force", list(&others))]);
    }
}

/// Writes an entry as a comment.
fn optional_entry(text: &mut String, name: &str, keys: &[(&str, String)]) {
    let mut line = String::new();
    entry(&mut line, name, keys);
    // Without the `#`, the line is indented like the others.
    let _ = writeln!(text, "  #{}", line.trim());
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
