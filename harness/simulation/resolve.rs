//! Looks up the names of a world file in its MuJoCo model.

use super::SimulationError;
use super::controls::Control;
use super::joints::is_single;
use super::names::{
    ACTUATOR, BODY, CAMERA, FLEX, GEOM, JOINT, KEYFRAME, LIGHT, ObjectKind, SENSOR, SITE, listed, name_of,
    named_or_asked,
};
use super::settled::Settling;
use super::standing::FreeBody;
use harness_spec::{
    Axis, Definition, Drawing, Element, Group, Kind, Layout, Modality, Motion, Ordered, Percentage, Posed,
    Property, Segmentation, Source, World, clearance_setting, matching, range_setting,
};
use mujoco_rs::prelude::*;
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;

/// A world file with its names resolved in the model.
#[derive(Debug)]
pub(super) struct Parts {
    pub layout: Arc<Layout>,
    /// For each modality of the layout, the sources of its elements; empty for images and differences.
    pub readings: Vec<Vec<Reading>>,
    pub cameras: Vec<SceneCamera>,
    pub flows: Vec<SceneFlow>,
    pub sights: Vec<SceneSight>,
    /// The bodies and sites whose poses are sensed, by their indices in the model.
    pub posed: Vec<PosedObject>,
    pub actuators: Vec<Driven>,
    /// What else is settled at the start of an episode.
    pub settling: Settling,
    /// For each geom, the index of the force to which its contacts are added.
    pub force_of_geom: Vec<Option<usize>>,
    /// The same for each flex.
    pub force_of_flex: Vec<Option<usize>>,
    /// Number of contact forces that are sensed.
    pub forces: usize,
    /// What a probing motion feels; `None` if the motion is another one.
    pub touch: Option<Touch>,
    /// Divisions of the contacts into kinds.
    pub contact_kinds: Vec<ContactKinds>,
    /// Directions of contacts that are sensed.
    pub normals: Vec<ContactNormal>,
    pub placements: Vec<Placement>,
    pub factors: Vec<SceneFactor>,
    /// The camera for figures and videos; `None` for MuJoCo's free camera.
    pub view: Option<usize>,
    /// Body and geom of the last link whose contacts are sensed.
    pub tip: Option<Tip>,
    /// The keyframe from which episodes start, if the world names one.
    pub keyframe: Option<usize>,
}

/// A body or a site whose pose is sensed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PosedObject {
    pub of: Posed,
    /// Index of the body or the site.
    pub id: usize,
    /// Index of the body in whose frame the pose is given; `None` for the world.
    pub relative_to: Option<usize>,
}

/// The source of an element of a vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Reading {
    /// Index into `qpos`.
    Position(usize),
    /// A value of a quaternion in `qpos`: the index of its w, and of the value from there. The sign is that with which
    /// w is not negative.
    Orientation(usize, usize),
    /// Index into `qvel`.
    Velocity(usize),
    /// A value of one of the scene's poses: x, y and z, then w, x, y and z.
    Pose(usize, usize),
    /// One of the scene's forces, at the instant.
    Force(usize),
    /// The same, averaged since the sample before.
    MeanForce(usize),
    /// The kind of the contact of one of the scene's forces, by one of the scene's divisions into kinds.
    ContactKind(usize, usize),
    /// A value of one of the scene's directions of contacts: x, y and z.
    ContactNormal(usize, usize),
    /// Index into `sensordata`.
    Sensor(usize),
    /// An element of what the actuators are commanded.
    Setpoint(usize),
}

/// A division of contacts into kinds by the geom on the other side of the contact.
#[derive(Debug, Clone)]
pub(super) struct ContactKinds {
    /// The value of each geom's kind. Geoms of no kind have the last value.
    pub of_geom: Vec<usize>,
    /// The largest value. The value 0 means no contact.
    pub last: usize,
    /// Whether the force is averaged, so that the impulses since the sample before are compared.
    pub averages: bool,
}

/// A direction of contacts that is sensed.
#[derive(Debug, Clone, Copy)]
pub(super) struct ContactNormal {
    /// The index of the force that has this direction.
    pub force: usize,
    /// The body in whose frame it is given.
    pub body: usize,
}

/// What a probing motion feels.
#[derive(Debug, Clone)]
pub(super) struct Touch {
    /// The indices of the forces that are added.
    pub forces: Vec<usize>,
    /// The sum from which something is touched, N.
    pub least_n: f64,
}

/// The default of [`Touch::least_n`].
const PROBE_FORCE_N: f64 = 1.0;

/// A camera that is recorded.
#[derive(Debug, Clone, Copy)]
pub(super) struct SceneCamera {
    pub modality: Modality,
    /// Its place in the layout.
    pub position: usize,
    pub camera: usize,
    /// Rows and columns.
    pub size: [usize; 2],
}

/// The last link whose contacts are sensed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tip {
    /// Its body, whose origin is its joint.
    pub body: usize,
    /// Its capsule, whose middle is half-way from the joint to the fingertip.
    pub geom: usize,
}

/// The actuators that get the setpoint of an element of the action, or the coordinate of a mocap body.
#[derive(Debug, Clone)]
pub(super) struct Driven {
    /// Of joints' position servos, the indices into `qpos`: an episode starts with the joints at their setpoint.
    pub qpos: Vec<usize>,
    /// The controls, as indices into `ctrl`. None if a mocap body is moved.
    pub controls: Vec<usize>,
    /// The index of a mocap body among these bodies, and the coordinate that is moved.
    pub mocap: Option<(usize, usize)>,
    /// Setpoints that the limits of all actuators and their joints allow.
    pub limits: [f64; 2],
    /// The setting of a spec that has its range.
    pub setting: String,
}

/// Bodies that each episode places.
#[derive(Debug, Clone)]
pub(super) struct Placement {
    /// Its name in the world file.
    pub name: String,
    pub boxes: Vec<FreeBody>,
    /// The setting of a spec that has their clearance.
    pub setting: String,
    pub clearance_m: f64,
    pub area: Area,
}

/// Where bodies are placed.
#[derive(Debug, Clone, Copy)]
pub(super) enum Area {
    Sector(Mount),
    /// Lowest and highest x and y, m.
    Rectangle([[f64; 2]; 2]),
}

/// Where an arm's body hangs: at the bearing `bearing + rotation` and the distance `radius + extension` from the arm's
/// vertical axis.
#[derive(Debug, Clone, Copy)]
pub(super) struct Mount {
    /// The elements of the action that turn and extend it.
    pub elements: [usize; 2],
    /// The axis on the ground, m.
    pub axis: [f64; 2],
    /// Distance with the extension at 0, m.
    pub radius: f64,
    /// Bearing with the rotation at 0, rad.
    pub bearing: f64,
    /// Radius of the body, m.
    pub body_radius: f64,
}

impl Mount {
    /// The point of the ground plane under the body, m.
    pub fn below(&self, rotation: f64, extension: f64) -> [f64; 2] {
        let (sin, cos) = (self.bearing + rotation).sin_cos();
        let radius = self.radius + extension;
        [self.axis[0] + radius * cos, self.axis[1] + radius * sin]
    }
}

/// A camera whose optical flow is recorded.
#[derive(Debug, Clone, Copy)]
pub(super) struct SceneFlow {
    pub image: SceneCamera,
    /// The largest displacement that the image can encode, pixels.
    pub limit: f64,
}

/// A camera and a size of its images that encode depths or classes. One drawing gives all of them.
#[derive(Debug, Clone)]
pub(super) struct SceneSight {
    pub camera: usize,
    /// Rows and columns.
    pub size: [usize; 2],
    pub coded: Vec<SceneCoded>,
}

/// An image that encodes depths or classes.
#[derive(Debug, Clone)]
pub(super) struct SceneCoded {
    pub image: SceneCamera,
    pub code: Code,
}

/// What an image encodes.
#[derive(Debug, Clone)]
pub(super) enum Code {
    /// Depths, with the lowest and the highest one, m.
    Depth([f64; 2]),
    /// The index of the class of each geom and of each flex.
    Classes { of_geom: Vec<Option<usize>>, of_flex: Vec<Option<usize>> },
}

/// A factor of a world, with its names resolved in the model.
#[derive(Debug, Clone)]
pub(super) struct SceneFactor {
    pub name: String,
    pub property: Property,
    pub drawing: Drawing,
    /// Indices of the joints, bodies, geoms, lights, cameras or actuators of the model that it changes, or the places
    /// of modalities in the layout.
    pub things: Vec<usize>,
    /// Their names.
    pub names: Vec<String>,
    /// Whether each of them has its own values.
    pub each: bool,
    /// Names and units of the values that are drawn.
    pub elements: Vec<Element>,
}

const HINGE: MjtJoint = MjtJoint::mjJNT_HINGE;
const SLIDE: MjtJoint = MjtJoint::mjJNT_SLIDE;

/// A column that both of two modalities have in the files of episodes, in which changes are not stored.
fn shared_column(one: &Definition, other: &Definition) -> Option<String> {
    let stored = |definition: &Definition| -> Vec<String> {
        match (definition.difference_of, definition.is_image()) {
            (Some(_), _) => Vec::new(),
            (None, true) => vec![definition.name.name().to_owned()],
            (None, false) => definition.columns().collect(),
        }
    };
    let own = stored(one);
    stored(other).into_iter().find(|column| own.contains(column))
}

/// Whether a camera is a perspective camera that only its field of view defines.
pub(super) fn is_pinhole(model: &MjModel, camera: usize) -> bool {
    let is_perspective =
        model.cam_projection()[camera] == mujoco_rs::wrappers::mj_model::MjtProjection::mjPROJ_PERSPECTIVE;
    is_perspective && model.cam_sensorsize()[camera] == [0.0; 2]
}

/// Adds an image to those of the same camera and size.
fn add_coded(sights: &mut Vec<SceneSight>, coded: SceneCoded) {
    let SceneCamera { camera, size, .. } = coded.image;
    match sights.iter_mut().find(|sight| (sight.camera, sight.size) == (camera, size)) {
        Some(sight) => sight.coded.push(coded),
        None => sights.push(SceneSight { camera, size, coded: vec![coded] }),
    }
}

/// Looks the names of a world file up in its model, with errors that say what is missing where.
pub(super) struct Resolver<'a> {
    world: &'a World,
    model: &'a MjModel,
    force_of_geom: Vec<Option<usize>>,
    force_of_flex: Vec<Option<usize>>,
    forces: usize,
    contact_kinds: Vec<ContactKinds>,
    normals: Vec<ContactNormal>,
    posed: Vec<PosedObject>,
    tip: Option<Tip>,
}

impl<'a> Resolver<'a> {
    pub fn new(world: &'a World, model: &'a MjModel) -> Self {
        Self {
            world,
            model,
            force_of_geom: vec![None; model.ngeom() as usize],
            force_of_flex: vec![None; model.nflex() as usize],
            forces: 0,
            contact_kinds: Vec::new(),
            normals: Vec::new(),
            posed: Vec::new(),
            tip: None,
        }
    }

    pub fn resolve(mut self) -> Result<Parts, SimulationError> {
        let (file, step_rate) = (self.world.file(), 1.0 / self.model.opt().timestep);
        if (file.step_rate_hz - step_rate).abs() > 1e-6 * step_rate {
            let message =
                format!("the model's timestep is {} s; write {step_rate}", self.model.opt().timestep);
            return Err(self.fault("step_rate_hz", message));
        }
        let actuators = self.actuators()?;
        let settling = self.settling(&actuators);
        let mut modalities: Vec<(Definition, Vec<Reading>)> = Vec::new();
        let (mut cameras, mut flows, mut sights) = (Vec::new(), Vec::new(), Vec::new());
        for (name, sensing) in file.modalities.iter() {
            let Some(modality) = Modality::new(name) else { continue };
            let path = format!("modalities.{name}.{}", sensing.source().key());
            let position = modalities.len();
            match sensing.source() {
                Source::Camera { name, size } => {
                    let camera = self.find(CAMERA, name, &path)?;
                    cameras.push(SceneCamera { modality, position, camera, size });
                }
                Source::OpticalFlow { camera, size, limit } => {
                    let camera = self.pinhole(camera, "an optical flow", &path)?;
                    flows.push(SceneFlow { image: SceneCamera { modality, position, camera, size }, limit });
                }
                Source::Depth { camera, size, range_m } => {
                    let camera = self.pinhole(camera, "a depth image", &path)?;
                    let image = SceneCamera { modality, position, camera, size };
                    add_coded(&mut sights, SceneCoded { image, code: Code::Depth(range_m) });
                }
                Source::Segmentation { camera, size, classes } => {
                    let camera = self.find(CAMERA, camera, &path)?;
                    let code = self.classes(classes, &format!("modalities.{name}.classes"))?;
                    let image = SceneCamera { modality, position, camera, size };
                    add_coded(&mut sights, SceneCoded { image, code });
                }
                _ => {}
            }
            let sensed = self.modality(modality, sensing, &path, &modalities)?;
            let kinds = self.contact_kinds(sensing, &sensed)?;
            for sensed in [Some(sensed), kinds].into_iter().flatten() {
                for (other, _) in &modalities {
                    if let Some(column) = shared_column(other, &sensed.0) {
                        let message = format!(
                            "'{}' and '{}' would both have the column '{column}'; rename one of them",
                            sensed.0.name, other.name
                        );
                        return Err(self.fault(&format!("modalities.{modality}"), message));
                    }
                }
                modalities.push(sensed);
            }
        }
        let setpoint = self.setpoint();
        for (definition, _) in &modalities {
            if let Some(column) = shared_column(definition, &setpoint.0) {
                let message =
                    format!("'{}' and the action would both have the column '{column}'", definition.name);
                let path = format!("modalities.{}", definition.name);
                return Err(self.fault(&path, message + "; rename one of them"));
            }
        }
        let is_sensed =
            |(definition, _): &(Definition, Vec<Reading>)| definition.elements() == setpoint.0.elements();
        let place = modalities.iter().position(is_sensed).map_or(modalities.len(), |index| index + 1);
        modalities.insert(place, setpoint);
        for coded in sights.iter().flat_map(|sight| &sight.coded) {
            let is_of = |camera: &&SceneCamera| {
                (camera.camera, camera.size) == (coded.image.camera, coded.image.size)
            };
            // The setpoint was inserted, so that the modality may have another place by now.
            let definitions = modalities.iter_mut().map(|(definition, _)| definition);
            let mut own = definitions.filter(|definition| definition.name == coded.image.modality);
            if let Some(segmentation) = own.find_map(|definition| definition.segmentation.as_mut()) {
                segmentation.of = cameras.iter().filter(is_of).map(|camera| camera.modality).collect();
            }
        }
        let coded = sights.iter_mut().flat_map(|sight| &mut sight.coded).map(|coded| &mut coded.image);
        let images = cameras.iter_mut().chain(flows.iter_mut().map(|flow| &mut flow.image)).chain(coded);
        images.filter(|image| image.position >= place).for_each(|image| image.position += 1);
        let touch = self.touch(&modalities);
        let (definitions, readings): (Vec<Definition>, _) = modalities.into_iter().unzip();
        let (placements, factors) =
            (self.placements(&actuators)?, self.factors(&actuators, &settling, &definitions)?);
        self.check_columns(&factors, &definitions)?;
        let keyframe =
            file.keyframe.as_deref().map(|name| self.find(KEYFRAME, name, "keyframe")).transpose()?;
        let view = cameras.first().map(|camera| camera.camera).or((self.model.ncam() > 0).then_some(0));
        Ok(Parts {
            layout: Arc::new(Layout {
                modalities: definitions,
                regions: self.world.regions(),
                labels: Vec::new(),
            }),
            readings,
            cameras,
            flows,
            sights,
            posed: self.posed,
            actuators,
            settling,
            force_of_geom: self.force_of_geom,
            force_of_flex: self.force_of_flex,
            forces: self.forces,
            touch,
            contact_kinds: self.contact_kinds,
            normals: self.normals,
            placements,
            factors,
            view,
            tip: self.tip,
            keyframe,
        })
    }

    /// Returns what a probing motion feels: the forces of the first modality that has some.
    fn touch(&self, modalities: &[(Definition, Vec<Reading>)]) -> Option<Touch> {
        let action = &self.world.file().action;
        let force = |reading: &Reading| match reading {
            Reading::Force(force) | Reading::MeanForce(force) => Some(*force),
            _ => None,
        };
        let mut forces =
            modalities.iter().map(|(_, readings)| readings.iter().filter_map(force).collect::<Vec<_>>());
        let forces = forces.find(|forces| !forces.is_empty())?;
        let is_probing = action.motion == Motion::Probing && action.course.is_none();
        is_probing.then(|| Touch { forces, least_n: action.probe_force_n.unwrap_or(PROBE_FORCE_N) })
    }

    fn fault(&self, path: &str, message: impl Into<String>) -> SimulationError {
        self.world.fault(path, message).into()
    }

    fn find(&self, kind: ObjectKind, name: &str, path: &str) -> Result<usize, SimulationError> {
        let all = named_or_asked(self.model, kind, [name]);
        let found = all.iter().find(|(other, _)| *other == name).map(|(_, id)| *id);
        found.ok_or_else(|| {
            let there = listed(self.model, kind);
            self.fault(path, format!("the model has no {} '{name}'; {there}", kind.1))
        })
    }

    /// Returns the names and indices of the objects of a kind that match the patterns.
    fn matches(
        &self,
        kind: ObjectKind,
        patterns: &'a [String],
        path: &str,
    ) -> Result<Vec<(&'a str, usize)>, SimulationError> {
        let all = named_or_asked(self.model, kind, patterns.iter().map(String::as_str));
        let names: Vec<&str> = all.iter().map(|(name, _)| *name).collect();
        let found = matching(patterns, &names).map_err(|(pattern, problem)| {
            let there = listed(self.model, kind);
            self.fault(path, format!("'{pattern}' {problem} among the model's {} names; {there}", kind.1))
        })?;
        Ok(found.into_iter().map(|index| all[index]).collect())
    }

    /// Returns the definition of a modality and the sources of its elements.
    fn modality(
        &mut self,
        name: Modality,
        sensing: &'a harness_spec::Sensing,
        path: &str,
        others: &[(Definition, Vec<Reading>)],
    ) -> Result<(Definition, Vec<Reading>), SimulationError> {
        let source = sensing.source();
        let is_force = matches!(source, Source::NormalForce { .. });
        if is_force && self.model.flg_adhesion() && sensing.minimum.is_none() {
            let message = "geoms have adhesion, which makes forces negative where it pulls, so this needs the lower \
                           bound of its predictions: minimum: null, for no bound, or a number (N)";
            return Err(self.fault(path, message));
        }
        let scaling = self.world.scaling(name, &[]).unwrap_or(harness_spec::Scaling::plain(false));
        let mut definition = Definition {
            scale: scaling.scale,
            minimum: scaling.minimum,
            percentage: sensing.percentage,
            ..Definition::vector(name, "", Vec::new())
        };
        let values = match source {
            Source::Camera { name, size } => {
                definition.kind = Kind::Image { size };
                definition.meaning = format!("Image of the camera {name}");
                return Ok((definition, Vec::new()));
            }
            Source::OpticalFlow { camera, size, limit } => {
                definition.kind = Kind::Image { size };
                definition.optical_flow = true;
                definition.meaning =
                    format!("Optical flow of the camera {camera}, up to {limit} pixels a sample");
                return Ok((definition, Vec::new()));
            }
            Source::Depth { camera, size, range_m: [low, high] } => {
                definition.kind = Kind::Image { size };
                definition.depth_range_m = Some([low, high]);
                definition.meaning = format!("Depth in the image of the camera {camera}, {low} to {high} m");
                return Ok((definition, Vec::new()));
            }
            Source::Segmentation { camera, size, classes } => {
                definition.kind = Kind::Image { size };
                let names: Vec<String> = classes.iter().map(|(class, _)| class.to_owned()).collect();
                definition.meaning =
                    format!("Classes in the image of the camera {camera}: {}", names.join(", "));
                definition.segmentation = Some(Segmentation { classes: names, of: Vec::new() });
                return Ok((definition, Vec::new()));
            }
            Source::DifferenceOf(of) => {
                definition.meaning = format!("Change of {of} since the sample before");
                definition.difference_of = Some(of);
                if let Some((other, _)) = others.iter().find(|(other, _)| other.name == of) {
                    definition.kind = other.kind.clone();
                    definition.groups = other.groups.clone();
                    definition.optical_flow = other.optical_flow;
                    definition.depth_range_m = other.depth_range_m;
                    definition.segmentation = other.segmentation.clone();
                    return Ok((definition, Vec::new()));
                }
                return Err(self.fault(path, format!("'{of}' must be listed before its difference")));
            }
            Source::JointPositions(patterns) => {
                definition.meaning = "Position of joint".into();
                self.joints(patterns, path, JointValue::Position)?
            }
            Source::JointVelocities(patterns) => {
                definition.meaning = "Velocity of joint".into();
                self.joints(patterns, path, JointValue::Velocity)?
            }
            Source::NormalForce { names, mean } => {
                definition.meaning = match mean {
                    false => "Normal contact force, at the instant, on link".into(),
                    true => {
                        "Normal contact force, averaged over the interval up to the instant, on link".into()
                    }
                };
                self.contact_forces(names, path, mean)?
            }
            Source::ContactNormal(names) => {
                definition.meaning =
                    "Direction of the normal contact force, in the frame of the body, on link".into();
                definition.unit_vectors = true;
                self.contact_normals(names, path)?
            }
            Source::Pose { names, of, orientation, relative_to } => {
                let what = if orientation { "Orientation" } else { "Position" };
                definition.meaning = match relative_to {
                    None => format!("{what} in the world of"),
                    Some(body) => format!("{what} in the frame of {body} of"),
                };
                let at = format!("modalities.{name}.relative_to");
                let relative_to = relative_to.map(|body| self.find(BODY, body, &at)).transpose()?;
                let values = self.poses(names, path, of, orientation, relative_to)?;
                let object = if orientation { 4 } else { 3 };
                definition.objects = sensing.set.then_some(values.len() / object);
                values
            }
            Source::Sensor(patterns) => {
                definition.meaning = "Value of sensor".into();
                self.sensors(patterns, path, sensing.unit.as_deref().unwrap_or_default())?
            }
        };
        let names: Vec<&str> = values.iter().map(|value| value.name.as_str()).collect();
        let element = |value: &Sensed| Element { name: value.element.clone(), unit: value.unit.clone() };
        definition.kind = Kind::Vector { elements: values.iter().map(element).collect() };
        for (group, patterns) in sensing.groups.iter() {
            let path = format!("modalities.{name}.groups.{group}");
            let elements = matching(patterns, &names).map_err(|(pattern, problem)| {
                self.fault(&path, format!("'{pattern}' {problem} among {}", names.join(", ")))
            })?;
            definition.groups.push(Group { name: group.to_owned(), elements });
        }
        definition.contact_kinds = sensing.contact_kinds.iter().map(|(kind, _)| kind.to_owned()).collect();
        if definition.percentage.is_none() {
            definition.percentage = match source {
                Source::NormalForce { .. } => Some(Percentage::Wmape),
                Source::JointPositions(_) if definition.unit() == Some("rad") => Some(Percentage::Smape),
                _ => None,
            };
        }
        Ok((definition, values.into_iter().map(|value| value.reading).collect()))
    }

    /// Positions or velocities of joints. A hinge or a slide has one of each. A free joint has the position and the
    /// velocity of its body, and it and a ball joint have a quaternion and an angular velocity.
    fn joints(
        &self,
        patterns: &'a [String],
        path: &str,
        of: JointValue,
    ) -> Result<Vec<Sensed>, SimulationError> {
        let found = self.matches(JOINT, patterns, path)?;
        let elements = short_names(patterns, &names_of(&found));
        let values = found.into_iter().zip(elements).flat_map(|((name, id), element)| {
            let sensed = move |(end, unit, reading): (&str, &str, Reading)| Sensed {
                name: format!("{name}{end}"),
                element: format!("{element}{end}"),
                unit: unit.to_owned(),
                reading,
            };
            joint_values(self.model, id, of).into_iter().map(sensed)
        });
        Ok(values.collect())
    }

    /// Positions or orientations of bodies or sites.
    fn poses(
        &mut self,
        patterns: &'a [String],
        path: &str,
        of: Posed,
        orientation: bool,
        relative_to: Option<usize>,
    ) -> Result<Vec<Sensed>, SimulationError> {
        let found = self.matches(if of == Posed::Body { BODY } else { SITE }, patterns, path)?;
        let (values, unit) = match orientation {
            false => (["x", "y", "z"].as_slice(), "m"),
            true => (["w", "x", "y", "z"].as_slice(), "1"),
        };
        let first = if orientation { 3 } else { 0 };
        let mut sensed = Vec::new();
        for (name, (_, id)) in short_names(patterns, &names_of(&found)).into_iter().zip(found) {
            let object = PosedObject { of, id, relative_to };
            let known = self.posed.iter().position(|posed| *posed == object);
            let pose = known.unwrap_or_else(|| {
                self.posed.push(object);
                self.posed.len() - 1
            });
            sensed.extend(values.iter().enumerate().map(|(index, value)| Sensed {
                name: format!("{name}_{value}"),
                element: format!("{name}_{value}"),
                unit: unit.to_owned(),
                reading: Reading::Pose(pose, first + index),
            }));
        }
        Ok(sensed)
    }

    /// Returns the index of a camera. It must be a perspective camera defined only by its field of view, which `what`
    /// needs.
    fn pinhole(&self, name: &str, what: &str, path: &str) -> Result<usize, SimulationError> {
        let camera = self.find(CAMERA, name, path)?;
        if is_pinhole(self.model, camera) {
            return Ok(camera);
        }
        let message = format!(
            "camera '{name}' is orthographic or has a sensor size; {what} needs a perspective camera with a fovy"
        );
        Err(self.fault(path, message))
    }

    /// Returns the class of each geom and of each flex. A pattern names geoms or, where no geom matches, bodies or
    /// flexes.
    fn classes(&self, classes: &'a Ordered<Vec<String>>, path: &str) -> Result<Code, SimulationError> {
        let mut of_geom = vec![None; self.model.ngeom() as usize];
        let mut of_flex = vec![None; self.model.nflex() as usize];
        for (class, (name, patterns)) in classes.iter().enumerate() {
            let path = format!("{path}.{name}");
            for pattern in patterns.chunks(1) {
                let (of, found) = match (self.touchable(pattern, &path), self.matches(FLEX, pattern, &path)) {
                    (Ok(found), _) => (&mut of_geom, found),
                    (Err(_), Ok(flexes)) => (
                        &mut of_flex,
                        flexes.into_iter().map(|(name, flex)| (name, flex..flex + 1)).collect(),
                    ),
                    (Err(error), Err(_)) => return Err(error),
                };
                for (thing, ids) in found {
                    for id in ids {
                        if let Some((other, _)) = of[id].and_then(|other: usize| classes.0.get(other))
                            && other != name
                        {
                            let message = format!("'{thing}' belongs to the class '{other}' as well");
                            return Err(self.fault(&path, message));
                        }
                        of[id] = Some(class);
                    }
                }
            }
        }
        Ok(Code::Classes { of_geom, of_flex })
    }

    /// Returns the modality that tells the kind of each contact of a force, if the world file divides them into kinds.
    fn contact_kinds(
        &mut self,
        sensing: &'a harness_spec::Sensing,
        (force, readings): &(Definition, Vec<Reading>),
    ) -> Result<Option<(Definition, Vec<Reading>)>, SimulationError> {
        let Some(name) = force.contact_kind() else { return Ok(None) };
        let last = force.contact_kinds.len() + 1;
        let mut of_geom = vec![last; self.model.ngeom() as usize];
        for (kind, (kind_name, patterns)) in (1..).zip(sensing.contact_kinds.iter()) {
            let path = format!("modalities.{}.contact_kinds.{kind_name}", force.name);
            for (touched, geoms) in self.touchable(patterns, &path)? {
                for geom in geoms {
                    if of_geom[geom] != last {
                        let other = &force.contact_kinds[of_geom[geom] - 1];
                        return Err(
                            self.fault(&path, format!("'{touched}' belongs to the kind '{other}' as well"))
                        );
                    }
                    of_geom[geom] = kind;
                }
            }
        }
        let averages = sensing.average_over.is_some();
        self.contact_kinds.push(ContactKinds { of_geom, last, averages });
        let division = self.contact_kinds.len() - 1;
        let kinds: Vec<String> =
            (1..).zip(&force.contact_kinds).map(|(value, kind)| format!("{value} {kind}")).collect();
        let largest = if averages { "contact with the largest impulse" } else { "largest contact" };
        let meaning = format!("Kind of the {largest} (0 none, {}, {last} other) on link", kinds.join(", "));
        let elements =
            force.elements().iter().map(|element| Element { name: element.name.clone(), unit: "1".into() });
        let of_force = |reading: &Reading| match reading {
            Reading::Force(force) | Reading::MeanForce(force) => Reading::ContactKind(division, *force),
            other => *other,
        };
        Ok(Some((
            Definition::vector(name, meaning, elements.collect()),
            readings.iter().map(of_force).collect(),
        )))
    }

    /// Returns the matching geoms or, where no geom matches, the matching bodies, each with its geoms.
    fn touchable(
        &self,
        patterns: &'a [String],
        path: &str,
    ) -> Result<Vec<(&'a str, Range<usize>)>, SimulationError> {
        let bodies = self.matches(BODY, patterns, path);
        let error = match self.matches(GEOM, patterns, path) {
            Ok(geoms) => return Ok(geoms.into_iter().map(|(name, geom)| (name, geom..geom + 1)).collect()),
            Err(error) => error,
        };
        let geoms_of = |(name, body): (&'a str, usize)| {
            let first = self.model.body_geomadr()[body].max(0) as usize;
            let geoms = first..first + self.model.body_geomnum()[body] as usize;
            match geoms.is_empty() {
                true => Err(self.fault(path, self.untouchable(name, body))),
                false => Ok((name, geoms)),
            }
        };
        bodies.map_err(|_| error)?.into_iter().map(geoms_of).collect()
    }

    /// Forces on geoms or, where no geom matches, on all geoms of each body, or on flexes.
    fn contact_forces(
        &mut self,
        patterns: &'a [String],
        path: &str,
        mean: bool,
    ) -> Result<Vec<Sensed>, SimulationError> {
        let found = match (self.touchable(patterns, path), self.matches(FLEX, patterns, path)) {
            (Ok(found), _) => found,
            (Err(_), Ok(flexes)) => return Ok(self.flex_forces(patterns, flexes, mean)),
            (Err(error), Err(_)) => return Err(error),
        };
        let names: Vec<&str> = found.iter().map(|(name, _)| *name).collect();
        let elements = short_names(patterns, &names);
        let mut sensed = Vec::new();
        for ((name, geoms), element) in found.into_iter().zip(elements) {
            let known = geoms.clone().next().and_then(|geom| self.force_of_geom[geom]);
            let force = known.unwrap_or(self.forces);
            // A known force must be that of these geoms, no more and no fewer.
            let has_force = |geom: &usize| self.force_of_geom[*geom] == known;
            let is_same =
                known.is_none() || (0..self.force_of_geom.len()).filter(has_force).eq(geoms.clone());
            if !geoms.clone().all(|geom| has_force(&geom)) || !is_same {
                return Err(self.fault(path, format!("a geom of '{name}' belongs to another force as well")));
            }
            if known.is_none() {
                self.forces += 1;
            }
            geoms.for_each(|geom| self.force_of_geom[geom] = Some(force));
            let reading = if mean { Reading::MeanForce(force) } else { Reading::Force(force) };
            sensed.push(Sensed { name: name.to_owned(), element, unit: "N".into(), reading });
        }
        if let (None, Some(last)) = (self.tip, sensed.last()) {
            let id = |(kind, _): (MjtObjBase, &str)| self.model.name_to_id(kind, &last.name);
            self.tip = id(BODY).zip(id(GEOM)).map(|(body, geom)| Tip { body, geom });
        }
        Ok(sensed)
    }

    /// Forces on flexes.
    fn flex_forces(&mut self, patterns: &'a [String], flexes: Vec<(&str, usize)>, mean: bool) -> Vec<Sensed> {
        let elements = short_names(patterns, &names_of(&flexes));
        let mut sensed = Vec::new();
        for ((name, flex), element) in flexes.into_iter().zip(elements) {
            let force = *self.force_of_flex[flex].get_or_insert_with(|| {
                self.forces += 1;
                self.forces - 1
            });
            let reading = if mean { Reading::MeanForce(force) } else { Reading::Force(force) };
            sensed.push(Sensed { name: name.to_owned(), element, unit: "N".into(), reading });
        }
        sensed
    }

    /// Directions of the forces on geoms, or on all geoms of each body.
    fn contact_normals(
        &mut self,
        patterns: &'a [String],
        path: &str,
    ) -> Result<Vec<Sensed>, SimulationError> {
        let mut sensed = Vec::new();
        for link in self.contact_forces(patterns, path, false)? {
            let is_own = |reading: &Option<usize>| reading.map(Reading::Force) == Some(link.reading);
            let Some(geom) = self.force_of_geom.iter().position(is_own) else {
                let message = format!(
                    "'{}' is a flex, which has no frame for a direction; name geoms or bodies, or sense its normal_force",
                    link.name
                );
                return Err(self.fault(path, message));
            };
            let force = self.force_of_geom[geom].expect("it has this force");
            self.normals.push(ContactNormal { force, body: self.model.geom_bodyid()[geom] as usize });
            sensed.extend(["x", "y", "z"].iter().enumerate().map(|(axis, value)| Sensed {
                name: format!("{}_{value}", link.name),
                element: format!("{}_{value}", link.element),
                unit: "1".into(),
                reading: Reading::ContactNormal(self.normals.len() - 1, axis),
            }));
        }
        Ok(sensed)
    }

    /// Why a body without geoms has no contact force.
    fn untouchable(&self, name: &str, body: usize) -> String {
        let of_flexes = self.model.flex_vertbodyid().iter().chain(self.model.flex_nodebodyid());
        if of_flexes.into_iter().any(|other| *other as usize == body) {
            return format!(
                "body '{name}' is a part of a flex, of which only the force on the whole can be sensed; name the flex"
            );
        }
        format!("body '{name}' has no geom, so nothing can touch it")
    }

    fn sensors(
        &self,
        patterns: &'a [String],
        path: &str,
        unit: &str,
    ) -> Result<Vec<Sensed>, SimulationError> {
        let found = self.matches(SENSOR, patterns, path)?;
        let short = short_names(patterns, &names_of(&found));
        let mut sensed = Vec::new();
        for ((name, id), short) in found.into_iter().zip(short) {
            let (first, count) = (self.model.sensor_adr()[id] as usize, self.model.sensor_dim()[id] as usize);
            let of = |name: &str, value| if count == 1 { name.to_owned() } else { format!("{name}_{value}") };
            sensed.extend((0..count).map(|value| Sensed {
                name: of(name, value),
                element: of(&short, value),
                unit: unit.to_owned(),
                reading: Reading::Sensor(first + value),
            }));
        }
        // A sensor `a_0` and the first value of a sensor `a` would have the same name.
        let elements: Vec<String> = sensed.iter().map(|value| value.element.clone()).collect();
        if !are_names(&elements) {
            sensed.iter_mut().zip(numbers(elements.len())).for_each(|(value, number)| value.element = number);
        }
        Ok(sensed)
    }

    /// Returns the modality of the actuators' setpoints and the sources of its elements.
    fn setpoint(&self) -> (Definition, Vec<Reading>) {
        let actuators = self.world.file().action.actuators.iter();
        let element = |(name, actuator): (&str, &harness_spec::Actuator)| Element {
            name: name.to_owned(),
            unit: actuator.unit.clone(),
        };
        let elements: Vec<Element> = actuators.map(element).collect();
        let readings = (0..elements.len()).map(Reading::Setpoint).collect();
        (Definition::vector(Modality::SETPOINT, "Commanded setpoint of", elements), readings)
    }

    fn actuators(&self) -> Result<Vec<Driven>, SimulationError> {
        let mut driven = Vec::new();
        for (name, actuator) in self.world.file().action.actuators.iter() {
            let path = format!("action.actuators.{name}");
            if let Some(body) = &actuator.mocap {
                driven.push(self.mocap(name, actuator, body)?);
                continue;
            }
            let own = match (&actuator.actuator, &actuator.actuators) {
                (Some(_), _) => format!("{path}.actuator"),
                (None, Some(_)) => format!("{path}.actuators"),
                (None, None) => path.clone(),
            };
            let ids: Vec<usize> = match &actuator.actuators {
                Some(names) => self.matches(ACTUATOR, names, &own)?.into_iter().map(|(_, id)| id).collect(),
                None => vec![self.find(ACTUATOR, actuator.actuator.as_deref().unwrap_or(name), &own)?],
            };
            let controls = ids.iter().map(|id| self.control(*id, actuator.control.as_deref(), &path, &own));
            let controls = controls.collect::<Result<Vec<Control>, _>>()?;
            let indices: Vec<usize> = controls.iter().map(|control| control.index(self.model)).collect();
            if driven.iter().any(|other: &Driven| other.controls.iter().any(|index| indices.contains(index)))
            {
                let message = "another element of the action drives the same actuator; leave one of them out";
                return Err(self.fault(&own, message));
            }
            let limits = controls.iter().map(|control| control.limits(self.model));
            let limits = limits.fold([f64::NEG_INFINITY, f64::INFINITY], |[low, high], own| {
                [low.max(own[0]), high.min(own[1])]
            });
            let [low, high] = actuator.range;
            if !within([low, high], limits) {
                let [min, max] = limits;
                let message =
                    format!("[{low}, {high}] must lie within [{min}, {max}], which the model allows");
                return Err(self.fault(&format!("{path}.range"), message));
            }
            let servos = controls.iter().filter_map(|control| control.servo(self.model));
            let qpos = servos.map(|joint| self.model.jnt_qposadr()[joint] as usize).collect();
            let setting = range_setting(name, actuator);
            driven.push(Driven { qpos, controls: indices, mocap: None, limits, setting });
        }
        for (place, one) in driven.iter().enumerate() {
            if one.mocap.is_some() && driven[..place].iter().any(|other| other.mocap == one.mocap) {
                let (name, _) = &self.world.file().action.actuators.0[place];
                let message =
                    "another element of the action moves the same coordinate; leave one of them out";
                return Err(self.fault(&format!("action.actuators.{name}.mocap"), message));
            }
        }
        Ok(driven)
    }

    /// Returns the control of an actuator that a setpoint drives. Of several controls, the world file names one.
    fn control(
        &self,
        actuator: usize,
        wanted: Option<&str>,
        path: &str,
        own: &str,
    ) -> Result<Control, SimulationError> {
        let all: Vec<Control> = Control::all_of(self.model, actuator).collect();
        let names: Vec<&str> = all.iter().filter_map(|control| control.name(self.model)).collect();
        let (name, names) = (name_of(self.model, ACTUATOR, actuator), names.join(", "));
        match (wanted, all.as_slice()) {
            (_, []) => Err(self.fault(own, format!("actuator {name} has no control; leave it out"))),
            (None, [control]) => Ok(*control),
            (None, [first, ..]) => {
                let first = first.name(self.model).unwrap_or_default();
                let message = format!(
                    "actuator {name} has the controls {names}, and a setpoint is one number; name one, such as \
                     control: {first}"
                );
                Err(self.fault(own, message))
            }
            (Some(wanted), all) => {
                let found = all.iter().find(|control| control.name(self.model) == Some(wanted));
                found.copied().ok_or_else(|| {
                    let there = match names.as_str() {
                        "" => "its only control has no name; leave this out".into(),
                        names => format!("it has {names}"),
                    };
                    let message = format!("actuator {name} has no control '{wanted}'; {there}");
                    self.fault(&format!("{path}.control"), message)
                })
            }
        }
    }

    /// Finds what else is settled at the start of an episode, besides the joints of position servos.
    fn settling(&self, actuators: &[Driven]) -> Settling {
        let is_servo = |joint: &usize| {
            let place = self.model.jnt_qposadr()[*joint] as usize;
            actuators.iter().any(|driven| driven.qpos.contains(&place))
        };
        Settling::of(self.model, &(0..self.model.njnt() as usize).filter(is_servo).collect::<Vec<_>>())
    }

    /// The coordinate of a mocap body that follows a setpoint.
    fn mocap(
        &self,
        name: &str,
        actuator: &harness_spec::Actuator,
        body: &str,
    ) -> Result<Driven, SimulationError> {
        let path = format!("action.actuators.{name}.mocap");
        let id = self.find(BODY, body, &path)?;
        let Ok(mocap) = usize::try_from(self.model.body_mocapid()[id]) else {
            let message = format!("body '{body}' is no mocap body; write mocap=\"true\" into its element");
            return Err(self.fault(&path, message));
        };
        let axis = match actuator.axis {
            Some(Axis::Y) => 1,
            Some(Axis::Z) => 2,
            _ => 0,
        };
        Ok(Driven {
            qpos: Vec::new(),
            controls: Vec::new(),
            mocap: Some((mocap, axis)),
            limits: [f64::NEG_INFINITY, f64::INFINITY],
            setting: range_setting(name, actuator),
        })
    }

    fn placements(&self, actuators: &[Driven]) -> Result<Vec<Placement>, SimulationError> {
        let mut placements = Vec::new();
        for (name, placing) in self.world.file().placement.iter() {
            let path = format!("placement.{name}.bodies");
            let bodies = self.matches(BODY, &placing.bodies, &path)?;
            let boxes = bodies.into_iter().map(|(name, body)| {
                let free = FreeBody::new(self.model, body);
                free.map_err(|problem| self.fault(&path, format!("body '{name}' {problem}")))
            });
            let boxes = boxes.collect::<Result<Vec<_>, _>>()?;
            let placed = placements.iter().flat_map(|other: &Placement| &other.boxes);
            if placed.into_iter().any(|placed| boxes.iter().any(|own| own.qpos == placed.qpos)) {
                let message =
                    "a body of this placement belongs to another one as well; leave it out of one of them";
                return Err(self.fault(&path, message));
            }
            let area = match (&placing.sector, placing.rectangle) {
                (Some(sector), _) => Area::Sector(self.mount(name, sector, actuators)?),
                (None, rectangle) => Area::Rectangle(rectangle.unwrap_or_default()),
            };
            let (name, setting) = (name.to_owned(), clearance_setting(name));
            placements.push(Placement { name, boxes, setting, clearance_m: placing.clearance_m, area });
        }
        Ok(placements)
    }

    /// The factors of variation, which must be able to change something.
    fn factors(
        &self,
        actuators: &[Driven],
        settling: &Settling,
        modalities: &[Definition],
    ) -> Result<Vec<SceneFactor>, SimulationError> {
        let mut factors = Vec::new();
        for (name, factor) in self.world.file().factors.iter() {
            let (property, patterns) = factor.property();
            let path = format!("factors.{name}.{property}");
            let (word, found) = match kind_of(property) {
                Some(kind) => (kind.1, self.matches(kind, patterns, &path)?),
                None => ("modality", self.measured(patterns, modalities, &path)?),
            };
            for (thing, id) in &found {
                if let Some(problem) = self.unchangeable(property, *id, actuators, settling, modalities) {
                    return Err(self.fault(&path, format!("{word} '{thing}' {problem}")));
                }
            }
            let (names, things): (Vec<&str>, Vec<usize>) = found.into_iter().unzip();
            let units: Vec<&str> = things.iter().map(|id| self.unit_of(property, *id, modalities)).collect();
            let elements = match factor.each {
                true => {
                    let names = short_names(patterns, &names);
                    let each: Vec<_> = names.iter().map(|name| Some(name.as_str())).zip(units).collect();
                    property.elements(name, &each)
                }
                false if units.iter().any(|unit| Some(unit) != units.first()) => {
                    let message = format!("the values of each {word} have different units; set each: true");
                    return Err(self.fault(&path, message));
                }
                false => property.elements(name, &[(None, units.first().copied().unwrap_or("1"))]),
            };
            factors.push(SceneFactor {
                name: name.to_owned(),
                property,
                drawing: factor.drawing(),
                things,
                names: names.into_iter().map(str::to_owned).collect(),
                each: factor.each,
                elements,
            });
        }
        Ok(factors)
    }

    /// Refuses factors whose values would be in the same column as those of another factor or a modality.
    fn check_columns(
        &self,
        factors: &[SceneFactor],
        modalities: &[Definition],
    ) -> Result<(), SimulationError> {
        let drawn = |factor: &SceneFactor| {
            Definition::vector(Modality::FACTORS, String::new(), factor.elements.clone())
        };
        for (place, factor) in factors.iter().enumerate() {
            let own = drawn(factor);
            let of_factor = |other: &SceneFactor| {
                Some((format!("factor '{}'", other.name), shared_column(&drawn(other), &own)?))
            };
            let of_modality = |other: &Definition| {
                Some((format!("modality '{}'", other.name), shared_column(other, &own)?))
            };
            let factors = factors[..place].iter().filter_map(of_factor);
            if let Some((other, column)) = factors.chain(modalities.iter().filter_map(of_modality)).next() {
                let message = format!(
                    "the factor '{}' and the {other} would both have the column '{column}'; rename one of them",
                    factor.name
                );
                return Err(self.fault(&format!("factors.{}", factor.name), message));
            }
        }
        Ok(())
    }

    /// Returns the names and the places of the modalities that match the patterns.
    fn measured<'d>(
        &self,
        patterns: &'a [String],
        modalities: &'d [Definition],
        path: &str,
    ) -> Result<Vec<(&'d str, usize)>, SimulationError> {
        let names: Vec<&str> = modalities.iter().map(|definition| definition.name.name()).collect();
        let found = matching(patterns, &names).map_err(|(pattern, problem)| {
            self.fault(path, format!("'{pattern}' {problem} among the modalities {}", names.join(", ")))
        })?;
        Ok(found.into_iter().map(|place| (names[place], place)).collect())
    }

    /// Returns the unit of the values that a factor draws for an object or a modality.
    fn unit_of<'d>(&self, property: Property, id: usize, modalities: &'d [Definition]) -> &'d str {
        property.unit().unwrap_or_else(|| match property {
            Property::SensorNoise => modalities[id].unit().unwrap_or_default(),
            _ if self.model.jnt_type()[id] == SLIDE => "m",
            _ => "rad",
        })
    }

    /// Returns why a factor can't change an object or a modality; `None` if it can.
    fn unchangeable(
        &self,
        property: Property,
        id: usize,
        actuators: &[Driven],
        settling: &Settling,
        modalities: &[Definition],
    ) -> Option<String> {
        let model = self.model;
        let is_driven = |joint: usize| {
            let place = model.jnt_qposadr()[joint] as usize;
            actuators.iter().any(|driven| driven.qpos.contains(&place))
        };
        let nothing = |word: &str| Some(format!("has no {word} that a factor could multiply"));
        match property {
            Property::JointStiffness if model.jnt_stiffness()[id] == 0.0 => nothing("stiffness"),
            Property::JointDamping if dofs(model, id).all(|dof| model.dof_damping()[dof] == 0.0) => {
                nothing("damping")
            }
            Property::BodyMass if model.body_mass()[id] == 0.0 => nothing("mass"),
            Property::GeomFriction if model.geom_friction()[id][0] == 0.0 => nothing("friction"),
            Property::GeomSize => {
                let sizes = [
                    MjtGeomBase::mjGEOM_SPHERE,
                    MjtGeomBase::mjGEOM_CAPSULE,
                    MjtGeomBase::mjGEOM_ELLIPSOID,
                    MjtGeomBase::mjGEOM_CYLINDER,
                    MjtGeomBase::mjGEOM_BOX,
                ];
                let is_known = sizes.contains(&model.geom_type()[id]);
                (!is_known).then(|| {
                    "is not a sphere, capsule, ellipsoid, cylinder or box, so its size can't be changed"
                        .into()
                })
            }
            Property::SensorNoise => unmeasured(&modalities[id], modalities).map(str::to_owned),
            Property::JointStart if !is_single(model, id) => {
                Some("is a ball or free joint; only hinges and slides have a start that can be offset".into())
            }
            Property::JointStart if is_driven(id) => {
                Some("is moved by a position servo, so it starts at the setpoint; leave it out".into())
            }
            Property::JointStart if settling.couplings.iter().any(|coupling| coupling.joint == id) => {
                Some("is coupled by an equality, which says where it starts; leave it out".into())
            }
            Property::Gravity if id != 0 => Some("has no gravity of its own; name the body 'world'".into()),
            Property::ActuatorStrength => {
                let gains = [MjtGain::mjGAIN_FIXED, MjtGain::mjGAIN_AFFINE];
                let is_known = gains.contains(&model.actuator_gaintype()[id]);
                (!is_known).then(|| {
                    "has neither a fixed nor an affine gain, so a factor can't multiply its force".into()
                })
            }
            Property::CameraRotation => {
                let mode = model.cam_mode()[id];
                let aims = [MjtCamLight::mjCAMLIGHT_TARGETBODY, MjtCamLight::mjCAMLIGHT_TARGETBODYCOM];
                aims.contains(&mode).then(|| "always looks at a body, so it can't be rotated".into())
            }
            _ => None,
        }
    }

    /// Reads the body's place off the kinematics, and checks that the arm moves it on a vertical cylinder.
    fn mount(
        &self,
        placed: &str,
        sector: &harness_spec::Sector,
        actuators: &[Driven],
    ) -> Result<Mount, SimulationError> {
        let path = format!("placement.{placed}.sector");
        let body = self.find(BODY, &sector.body, &format!("{path}.body"))?;
        let geom = self.find(GEOM, &sector.body, &format!("{path}.body"))?;
        let names: Vec<&str> = self.world.file().action.actuators.iter().map(|(name, _)| name).collect();
        let element = |name: &str| names.iter().position(|other| *other == name).unwrap_or_default();
        let elements = [element(&sector.rotation), element(&sector.extension)];
        let [&[rotation], &[extension]] = elements.map(|element| actuators[element].qpos.as_slice()) else {
            return Err(
                self.fault(&path, "rotation and extension must each be the position servo of a joint")
            );
        };
        let is_turned = |joint: &usize| self.model.jnt_qposadr()[*joint] as usize == rotation;
        let joint = (0..self.model.njnt() as usize).find(is_turned).unwrap_or_default();
        let mut data = MjData::new(self.model);
        let mut body_at = |turned: f64, extended: f64| {
            let qpos = data.qpos_mut();
            actuators.iter().flat_map(|driven| &driven.qpos).for_each(|index| qpos[*index] = 0.0);
            (qpos[rotation], qpos[extension]) = (turned, extended);
            data.kinematics();
            (data.xpos()[body], data.xanchor()[joint])
        };
        let ([x, y, _], axis) = body_at(0.0, 0.0);
        let (dx, dy) = (x - axis[0], y - axis[1]);
        let mount = Mount {
            elements,
            axis: [axis[0], axis[1]],
            radius: dx.hypot(dy),
            bearing: dy.atan2(dx),
            body_radius: self.model.geom_size()[geom][0],
        };
        let (found, _) = body_at(0.5, 0.25);
        let expected = mount.below(0.5, 0.25);
        if (found[0] - expected[0]).hypot(found[1] - expected[1]) > 1e-6 {
            return Err(self.fault(
                &path,
                "the arm must turn the body about a vertical axis, counter-clockwise from above, and extend away from \
                 that axis",
            ));
        }
        Ok(mount)
    }
}

/// Returns why a modality can't have noise; `None` if it can.
fn unmeasured(definition: &Definition, modalities: &[Definition]) -> Option<&'static str> {
    let is_kind = modalities.iter().any(|other| other.contact_kind() == Some(definition.name));
    match definition {
        _ if definition.name == Modality::SETPOINT => Some("is the action, which is not measured"),
        _ if is_kind => Some("tells kinds of contact, which are no measured values"),
        Definition { difference_of: Some(_), .. } => {
            Some("is computed from another modality; name that one instead")
        }
        _ if definition.is_image() => Some("is an image; only vectors can have noise"),
        _ if definition.unit().is_none() => {
            Some("has values of different units; record those of each unit as a modality of their own")
        }
        _ => None,
    }
}

/// Returns the kind of the model's objects that have a property; `None` if modalities have it.
fn kind_of(property: Property) -> Option<ObjectKind> {
    Some(match property {
        Property::JointStiffness | Property::JointDamping | Property::JointStart => JOINT,
        Property::BodyMass | Property::Gravity => BODY,
        Property::ActuatorStrength => ACTUATOR,
        Property::GeomFriction | Property::GeomSize | Property::GeomColour => GEOM,
        Property::LightBrightness => LIGHT,
        Property::CameraPosition | Property::CameraRotation => CAMERA,
        Property::SensorNoise => return None,
    })
}

/// What is sensed of a joint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum JointValue {
    Position,
    Velocity,
}

/// Returns the end of the name, the unit and the source of each value of a joint.
fn joint_values(model: &MjModel, joint: usize, of: JointValue) -> Vec<(&'static str, &'static str, Reading)> {
    let (kind, is_position) = (model.jnt_type()[joint], of == JointValue::Position);
    let first = if is_position { model.jnt_qposadr()[joint] } else { model.jnt_dofadr()[joint] } as usize;
    let single: fn(usize) -> Reading = if is_position { Reading::Position } else { Reading::Velocity };
    let (length, angle) = if is_position { ("m", "rad") } else { ("m/s", "rad/s") };
    if kind == HINGE || kind == SLIDE {
        return vec![("", if kind == HINGE { angle } else { length }, single(first))];
    }
    let moves = ["_x", "_y", "_z"].into_iter().filter(|_| kind == MjtJoint::mjJNT_FREE);
    let mut values: Vec<_> = moves.zip(first..).map(|(end, index)| (end, length, single(index))).collect();
    let turned = first + values.len();
    match of {
        JointValue::Position => values.extend(
            (0..)
                .zip(["_qw", "_qx", "_qy", "_qz"])
                .map(|(index, end)| (end, "1", Reading::Orientation(turned, index))),
        ),
        JointValue::Velocity => values.extend(
            ["_rx", "_ry", "_rz"].into_iter().zip(turned..).map(|(end, index)| (end, angle, single(index))),
        ),
    }
    values
}

/// One element as it was found in the model.
struct Sensed {
    /// Its name in the model, which groups match.
    name: String,
    /// Its name in the layout.
    element: String,
    unit: String,
    reading: Reading,
}

/// Whether a range lies within limits, which may have been rounded to a few decimals.
pub(super) fn within([low, high]: [f64; 2], [min, max]: [f64; 2]) -> bool {
    let slack = 1e-6;
    low <= high && low >= min - slack && high <= max + slack
}

/// Names of elements for columns: what follows the pattern's fixed beginning, or else the whole names; in lower case,
/// with `_` for what no column's name has.
fn short_names(patterns: &[String], names: &[&str]) -> Vec<String> {
    let prefix = match patterns {
        [pattern] if !names.contains(&pattern.as_str()) => {
            pattern.split(['*', '?', '[']).next().unwrap_or_default()
        }
        _ => "",
    };
    let ends = |prefix: &str| -> Vec<String> {
        let end = |name: &&str| {
            let end = name.strip_prefix(prefix).unwrap_or(name);
            end.to_lowercase().chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect()
        };
        names.iter().map(end).collect()
    };
    let found = ends(prefix);
    if are_names(&found) {
        return found;
    }
    let whole = ends("");
    if are_names(&whole) { whole } else { numbers(names.len()) }
}

fn names_of<'a>(found: &[(&'a str, usize)]) -> Vec<&'a str> {
    found.iter().map(|(name, _)| *name).collect()
}

/// Whether names of elements are distinct and not empty.
fn are_names(names: &[String]) -> bool {
    let distinct: BTreeSet<&String> = names.iter().collect();
    distinct.len() == names.len() && names.iter().all(|name| !name.is_empty())
}

fn numbers(count: usize) -> Vec<String> {
    (0..count).map(|index| index.to_string()).collect()
}

/// Returns the indices of a joint's degrees of freedom.
pub(super) fn dofs(model: &MjModel, joint: usize) -> std::ops::Range<usize> {
    let first = model.jnt_dofadr()[joint] as usize;
    let count = match model.jnt_type()[joint] {
        MjtJoint::mjJNT_FREE => 6,
        MjtJoint::mjJNT_BALL => 3,
        _ => 1,
    };
    first..first + count
}
