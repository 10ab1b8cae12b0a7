//! The factors of a world, and what of the model they change.

use super::{Resolver, SLIDE, dofs, shared_column, short_names};
use crate::SimulationError;
use crate::joints::is_single;
use crate::names::{ACTUATOR, BODY, CAMERA, GEOM, JOINT, LIGHT, ObjectKind};
use crate::resolved::{Driven, SceneFactor};
use crate::settled::Settling;
use harness_spec::{Definition, Modality, Property, matching};
use mujoco_rs::prelude::*;

impl<'a> Resolver<'a> {
    /// The factors of variation, which must be able to change something.
    pub(super) fn factors(
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
    pub(super) fn check_columns(
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
