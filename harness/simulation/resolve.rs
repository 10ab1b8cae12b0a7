//! Looks up the names of a world file in its MuJoCo model.

mod action;
mod factors;

use super::SimulationError;
use super::names::{
    BODY, CAMERA, FLEX, GEOM, JOINT, KEYFRAME, ObjectKind, SENSOR, SITE, listed, named_or_asked,
};
use super::resolved::{
    Code, ContactKinds, ContactNormal, PosedObject, Reading, Resolved, SceneCamera, SceneCoded, SceneFlow,
    SceneSight, Tip, Touch,
};
use harness_spec::{
    Definition, Element, Group, Kind, Layout, Modality, Motion, Ordered, Percentage, Posed, Segmentation,
    Source, World, matching,
};
use mujoco_rs::prelude::*;
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;

/// The default of [`Touch::least_n`].
const PROBE_FORCE_N: f64 = 1.0;

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

    pub fn resolve(mut self) -> Result<Resolved, SimulationError> {
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
        Ok(Resolved {
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
