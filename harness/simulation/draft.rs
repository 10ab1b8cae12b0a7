//! Writes a first world file for any model.

use super::SimulationError;
use super::actuate::{Addable, Probe, flex_joints};
use super::controls::Control;
use super::joints::{ball_and_free, described, is_free, is_single, touches};
use super::load::load_file;
use super::names::{
    ACTUATOR, BODY, CAMERA, FLEX, GEOM, JOINT, NAMES_SHOWN, ObjectKind, SENSOR, all_called, called, named,
};
use super::resolve::Resolver;
use super::scene::prepare;
use super::units::unit_of_sensor;
use harness_shared::numbers::first_few;
use harness_spec::{Modality, World, is_name};
use mujoco_rs::prelude::*;
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

/// Side of the images in a first world file, pixels.
const SIDE: usize = 64;

/// Largest number of cameras that are recorded. The others are in comments, because each image takes time.
const CAMERAS: usize = 8;

/// Sample rate in a first world file, unless it does not divide the rate of the simulation steps.
const SAMPLE_RATE_HZ: f64 = 10.0;

/// How far a mocap body moves to each side in a first world file, m.
const REACH_M: f64 = 0.1;

/// Returns the text of a world file for the model at the path `model`. The file has all joints, links, sensors, cameras
/// and actuators of the model, and refers to the model by the path `path`. What has no name is called by its number.
/// The coordinates of a `probe` have its ranges.
///
/// # Errors
/// When the model can't be read or compiled, has neither an actuator nor a mocap body, or has nothing to record.
pub fn draft_world(model: &Path, path: &str, probe: Option<&Probe>) -> Result<String, SimulationError> {
    prepare()?;
    let scene = model.display().to_string();
    let file = model.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let model = load_file(model)?;
    if model.nactuator() == 0 && model.nmocap() == 0 {
        return Err(SimulationError::NoAction { scene, adds: Addable::to(&model) });
    }
    let step_rate_hz = 1.0 / model.opt().timestep;
    // Ten samples in a second, or the rate that is nearest to it among those with a whole number of steps for each
    // sample.
    let steps = (step_rate_hz / SAMPLE_RATE_HZ).round().max(1.0);
    let is_whole = (step_rate_hz / SAMPLE_RATE_HZ - steps).abs() < 1e-9 * steps;
    let sample_rate_hz = if is_whole { SAMPLE_RATE_HZ } else { step_rate_hz / steps };
    let seconds = if is_whole { 1.0 } else { sample_rate_hz.round().max(1.0) * steps * model.opt().timestep };
    let mut draft = Draft { model: &model, text: String::new(), names: BTreeSet::new(), recorded: 0 };
    let _ = write!(
        draft.text,
        "# Written by `harness world new`. Remove what is not sensed; `harness world check` lists what each name \
         matches.\n\
         description: {}\nmodel: {}\nstep_rate_hz: {step_rate_hz}\nsample_rate_hz: {sample_rate_hz}\n\n\
         modalities:\n",
        quoted(&format!("The robot of {file}")),
        quoted(path),
    );
    draft.joints();
    draft.contact_forces();
    draft.sensors();
    draft.cameras();
    if draft.recorded == 0 {
        let mocap = draft.all(BODY, |body| model.body_mocapid()[body] >= 0);
        draft.vectors("body_positions", "body_positions", &mocap);
    }
    let _ = write!(draft.text, "\naction:\n  seconds: {seconds}\n  actuators:\n");
    match model.nu() {
        0 => draft.mocap(probe),
        _ => draft.actuators(),
    }
    // What no experiment can use, such as a time step of an hour, is found as in any world file.
    let world = World::parse("the world file", None, "drafted", &draft.text);
    let world = world.and_then(|world| world.check_rates().map(|()| world)).map_err(SimulationError::from);
    match world.and_then(|world| Resolver::new(&world, &model).resolve().map(|_| ())) {
        Ok(()) => Ok(draft.text),
        Err(error) => {
            Err(SimulationError::Unsuitable { scene, problem: format!("no world file suits it: {error}") })
        }
    }
}

/// A world file that is being written.
struct Draft<'m> {
    model: &'m MjModel,
    text: String,
    /// The names of the modalities, also of those in comments.
    names: BTreeSet<String>,
    /// Number of the modalities that are not in comments.
    recorded: usize,
}

impl Draft<'_> {
    /// Returns what the objects of a kind are called that fulfill `is_wanted`.
    fn all(&self, kind: ObjectKind, is_wanted: impl Fn(usize) -> bool) -> Vec<String> {
        let all = all_called(self.model, kind).into_iter();
        all.filter(|(_, id)| is_wanted(*id)).map(|(name, _)| name).collect()
    }

    /// Writes the hinges and slides and the links of ball joints, and comments that record the ball and free joints and
    /// their bodies. The bodies of free joints are in a comment, unless they are all that moves.
    fn joints(&mut self) {
        let model = self.model;
        let of_flex = flex_joints(model);
        let singles = self.all(JOINT, |joint| is_single(model, joint) && !of_flex.contains(&joint));
        self.vectors("joints", "joint_positions", &singles);
        self.vectors("joint_velocities", "joint_velocities", &singles);
        let mut several = ball_and_free(model);
        several.retain(|joint| !of_flex.contains(joint));
        if several.is_empty() {
            return;
        }
        let bodies = |joints: &mut dyn Iterator<Item = usize>| -> Vec<String> {
            joints.filter_map(|joint| called(model, BODY, model.jnt_bodyid()[joint] as usize)).collect()
        };
        let oriented = bodies(&mut several.iter().copied());
        let free = bodies(&mut several.iter().copied().filter(|joint| is_free(model, *joint)));
        let links = bodies(&mut several.iter().copied().filter(|joint| !is_free(model, *joint)));
        self.vectors("links", "body_positions", &links);
        let is_all = self.recorded == 0 && model.nflex() == 0 && model.nsensor() == 0;
        if is_all {
            self.vectors("body_positions", "body_positions", &free);
        }
        let described: Vec<String> = several.iter().map(|joint| described(model, *joint)).collect();
        self.comment(&format!(
            "Left out, because each has several values: {}.",
            first_few(&described, NAMES_SHOWN)
        ));
        let named: Vec<String> = named(model, JOINT)
            .into_iter()
            .filter(|(_, id)| several.contains(id))
            .map(|(name, _)| name.to_owned())
            .collect();
        if !named.is_empty() {
            self.comment("To record those with a name, remove the # from these lines:");
            self.optional("other_joints", "joint_positions", &named);
            self.optional("other_joint_velocities", "joint_velocities", &named);
        }
        // A body without a name can't be recorded if another has the name of its number.
        if oriented.is_empty() {
            return;
        }
        self.comment("To record where these bodies are, remove the # from these lines:");
        if !is_all && !free.is_empty() {
            self.optional("body_positions", "body_positions", &free);
        }
        self.optional("body_orientations", "body_orientations", &oriented);
    }

    /// Writes the forces on the geoms that hinges, slides and ball joints move or, if none of them has a name, on their
    /// bodies, and the forces on flexes. Those that free joints move are in a comment.
    fn contact_forces(&mut self) {
        let model = self.model;
        let links = self.touching(|joint| !is_free(model, joint));
        let others = self.touching(|joint| is_free(model, joint));
        // A force that adhesion can make negative has no lower bound.
        let force = |names: &[String]| {
            let minimum = model.flg_adhesion().then(|| ("minimum", "null".to_owned()));
            [("normal_force", list(names))].into_iter().chain(minimum).collect::<Vec<_>>()
        };
        let flexes = self.all(FLEX, |_| true);
        for (name, names) in [("contact_force", &links), ("flex_force", &flexes)] {
            if !names.is_empty() {
                self.entry(name, &force(names));
            }
        }
        if !others.is_empty() {
            self.comment(
                "Left out, because a free joint moves them. To record the forces on them, remove the #:",
            );
            self.optional_entry("other_contact_force", &force(&others));
        }
    }

    /// Returns the geoms that can touch something and that a joint moves which fulfills `is_wanted`. If none of them
    /// has a name, it returns their bodies.
    fn touching(&self, is_wanted: impl Fn(usize) -> bool) -> Vec<String> {
        let model = self.model;
        let geoms: BTreeSet<usize> =
            (0..model.ngeom() as usize).filter(|geom| touches(model, *geom, &is_wanted)).collect();
        let all_named = named(model, GEOM);
        let names: Vec<String> = all_named
            .iter()
            .filter(|(_, id)| geoms.contains(id))
            .map(|(name, _)| (*name).to_owned())
            .collect();
        if !names.is_empty() {
            return names;
        }
        let links: BTreeSet<usize> = geoms.iter().map(|geom| model.geom_bodyid()[*geom] as usize).collect();
        let bodies = self.all(BODY, |body| links.contains(&body));
        // A name of a body and of a geom, such as one that touches nothing, means the geom.
        let is_geom = |name: &String| all_named.iter().any(|(other, _)| other == name);
        if bodies.iter().any(is_geom) { self.all(GEOM, |geom| geoms.contains(&geom)) } else { bodies }
    }

    /// Writes the sensors, by kind and unit.
    fn sensors(&mut self) {
        let mut sensors: Vec<(String, &str, Vec<String>)> = Vec::new();
        for (name, id) in all_called(self.model, SENSOR) {
            let kind =
                format!("{:?}", self.model.sensor_type()[id]).trim_start_matches("mjSENS_").to_lowercase();
            // The columns of a modality `contact` could be those of `contact_force`.
            let kind = if kind == "contact" { "contacts".into() } else { kind };
            let unit = unit_of_sensor(self.model, id);
            match sensors.iter_mut().find(|(other, own, _)| (other, *own) == (&kind, unit)) {
                Some((.., names)) => names.push(name),
                None => sensors.push((kind, unit, vec![name])),
            }
        }
        for (kind, unit, names) in &sensors {
            let of_kind = sensors.iter().filter(|(other, ..)| other == kind).count();
            let unit_name = if unit.is_empty() { "mixed".into() } else { sanitized(unit) };
            let name = if of_kind == 1 { kind.clone() } else { format!("{kind}_{unit_name}") };
            self.entry(&name, &[("sensor", list(names)), ("unit", quoted(unit))]);
        }
    }

    /// Writes the images of the cameras and their changes. Those of a great number of cameras are in comments.
    fn cameras(&mut self) {
        let vectors = self.names.clone();
        for (index, (name, id)) in all_called(self.model, CAMERA).into_iter().enumerate() {
            let wanted =
                std::iter::once(sanitized(&name)).chain((id..).map(|number| format!("camera_{number}")));
            let difference = |modality: &str| format!("{modality}_difference");
            // A camera `joints_x` would have the column of a joint `x`.
            let is_column = |name: &str| vectors.iter().any(|other| name.starts_with(&format!("{other}_")));
            let modality = first_unused(wanted, |name| {
                let is_used = |name: &str| self.names.contains(name) || is_column(name);
                is_used(name)
                    || is_used(&difference(name))
                    || !is_name(&difference(name))
                    || Modality::RESERVED.contains(&name)
                    || name.starts_with("setpoint_")
            });
            let size = format!("[{SIDE}, {SIDE}]");
            if index == CAMERAS {
                self.comment("More cameras. To record their images, remove the # from these lines:");
            }
            let image = [("camera", quoted(&name)), ("size", size)];
            let change = [("difference_of", plain(&modality))];
            if index < CAMERAS {
                self.entry(&modality, &image);
                self.entry(&difference(&modality), &change);
            } else {
                self.optional_entry(&modality, &image);
                self.optional_entry(&difference(&modality), &change);
            }
        }
    }

    /// Writes the coordinates of the mocap bodies as elements of the action.
    fn mocap(&mut self, probe: Option<&Probe>) {
        let mut elements = BTreeSet::new();
        for (name, id) in all_called(self.model, BODY) {
            if self.model.body_mocapid()[id] < 0 {
                continue;
            }
            let probe = probe.filter(|probe| probe.body == name);
            for (axis, (letter, place)) in
                ["x", "y", "z"].into_iter().zip(self.model.body_pos()[id]).enumerate()
            {
                let wanted = [format!("{}_{letter}", sanitized(&name)), format!("mocap_{id}_{letter}")];
                let element = first_unused(wanted, |name| elements.contains(name));
                let [low, high] =
                    probe.map_or([place - REACH_M, place + REACH_M], |probe| probe.ranges[axis]);
                let start = if probe.is_some() && letter == "z" { ", start: high" } else { "" };
                let name = quoted(&name);
                let _ = writeln!(
                    self.text,
                    "    {element}: {{mocap: {name}, axis: {letter}, unit: m, range: [{low:?}, {high:?}]{start}}}   # \
                     a guess: how far it moves"
                );
                elements.insert(element);
            }
        }
    }

    /// Writes the controls of the actuators as elements of the action.
    fn actuators(&mut self) {
        let model = self.model;
        let mut elements = BTreeSet::new();
        let controls = all_called(model, ACTUATOR)
            .into_iter()
            .flat_map(|(name, id)| Control::all_of(model, id).map(move |control| (name.clone(), control)));
        for (name, control) in controls {
            let [low, high] = control.limits(model);
            let guess = match low.is_finite() || high.is_finite() {
                true => "",
                false => "   # a guess: the model sets no ctrlrange for this actuator",
            };
            let low = if low.is_finite() { low } else { high.min(1.0) - 2.0 };
            let high = if high.is_finite() { high } else { low + 2.0 };
            // An actuator with several controls has an element for each.
            let of_several = Control::all_of(model, control.actuator).nth(1).is_some();
            let part = control.name(model).filter(|_| of_several);
            let end = part.map_or(String::new(), |part| format!("_{part}"));
            let wanted = std::iter::once(sanitized(&name) + &end)
                .chain((control.actuator..).map(|number| format!("actuator_{number}{end}")));
            let element = first_unused(wanted, |name| elements.contains(name));
            let name = quoted(&name);
            if low > high {
                self.text += &format!(
                    "    # Left out: the ranges of {name} and of its joint have nothing in common.\n"
                );
                continue;
            }
            let part = part.map_or(String::new(), |part| format!(", control: {part}"));
            let range = format!("[{low:?}, {high:?}]");
            let _ = writeln!(
                self.text,
                "    {}: {{actuator: {name}{part}, range: {range}}}{guess}",
                plain(&element)
            );
            elements.insert(element);
        }
    }

    fn comment(&mut self, text: &str) {
        // A name can have line breaks.
        let _ = writeln!(self.text, "  # {}", text.replace(|c: char| c.is_control(), " "));
    }

    /// Writes a modality of the named objects, if there are any.
    fn vectors(&mut self, name: &str, key: &str, names: &[String]) {
        if !names.is_empty() {
            self.entry(name, &[(key, list(names))]);
        }
    }

    fn optional(&mut self, name: &str, key: &str, names: &[String]) {
        self.optional_entry(name, &[(key, list(names))]);
    }

    fn entry(&mut self, name: &str, keys: &[(&str, String)]) {
        let _ = writeln!(self.text, "  {}", modality(name, keys));
        self.names.insert(name.to_owned());
        self.recorded += 1;
    }

    /// Writes an entry as a comment. Without the `#`, the line is indented like the others.
    fn optional_entry(&mut self, name: &str, keys: &[(&str, String)]) {
        let _ = writeln!(self.text, "  #{}", modality(name, keys));
        self.names.insert(name.to_owned());
    }
}

fn modality(name: &str, keys: &[(&str, String)]) -> String {
    let keys: Vec<String> = keys.iter().map(|(key, value)| format!("{key}: {value}")).collect();
    format!("{}: {{{}}}", plain(name), keys.join(", "))
}

/// Returns the first of the names that a user can choose and that is not used.
fn first_unused(wanted: impl IntoIterator<Item = String>, is_used: impl Fn(&str) -> bool) -> String {
    wanted.into_iter().find(|name| is_name(name) && !is_used(name)).unwrap_or_default()
}

/// Returns a name in lower case, with `_` for what no name in a world file has.
fn sanitized(name: &str) -> String {
    name.to_lowercase().chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect()
}

fn list(names: &[String]) -> String {
    format!("[{}]", names.iter().map(|name| quoted(name)).collect::<Vec<_>>().join(", "))
}

/// Returns a name as YAML, with quotes if it would be read as something else, such as `null`.
fn plain(name: &str) -> String {
    let yaml = serde_yaml::to_string(&name).expect("a name is a text, which YAML can hold");
    yaml.trim_end().to_owned()
}

/// Quotes a text for YAML, in which more characters than in JSON end a line.
fn quoted(text: &str) -> String {
    let escaped = |c: char| match c {
        '\u{7f}'..='\u{9f}' | '\u{2028}' | '\u{2029}' | '\u{feff}' => format!("\\u{:04x}", u32::from(c)),
        c => c.to_string(),
    };
    serde_json::Value::from(text).to_string().chars().map(escaped).collect()
}
