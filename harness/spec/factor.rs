//! Factors of variation: properties of a model that are drawn at random for each episode, if a spec turns them on.

use super::values::{ascending, globs};
use crate::layout::{Element, names};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};
use std::fmt;

/// A factor of variation: exactly one of `joint_stiffness`, `joint_damping`, `body_mass`, `geom_friction`, `geom_size`,
/// `geom_colour`, `light_brightness`, `camera_position`, `camera_rotation`, `actuator_strength`, `gravity`,
/// `joint_start` and `sensor_noise`, and its distribution.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Factor {
    /// Stiffness of joints.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub joint_stiffness: Option<Vec<String>>,
    /// Damping of joints.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub joint_damping: Option<Vec<String>>,
    /// Masses and inertias of bodies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub body_mass: Option<Vec<String>>,
    /// Sliding, torsional and rolling friction of geoms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub geom_friction: Option<Vec<String>>,
    /// Sizes of spheres, capsules, ellipsoids, cylinders and boxes. Masses and inertias stay as they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub geom_size: Option<Vec<String>>,
    /// Red, green and blue of geoms, each between 0 and 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub geom_colour: Option<Vec<String>>,
    /// Brightness of lights.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub light_brightness: Option<Vec<String>>,
    /// Positions of cameras, m, along the axes of the body that carries them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub camera_position: Option<Vec<String>>,
    /// Orientations of cameras, rad: a rotation vector along the camera's own axes (right, up, backwards).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub camera_rotation: Option<Vec<String>>,
    /// Forces of actuators: their gains and biases.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub actuator_strength: Option<Vec<String>>,
    /// Gravity, of the body `world`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub gravity: Option<Vec<String>>,
    /// Positions of hinges (rad) and slides (m) at the start of an episode, within the limits of the joints. The joints
    /// of position servos that the action moves start at their setpoints instead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub joint_start: Option<Vec<String>>,
    /// Noise of modalities, by their names in this file: the standard deviation of normally distributed numbers. Each
    /// recorded value of a vector gets a number of its own, at each sample anew.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub sensor_noise: Option<Vec<String>>,
    /// Distribution of the number by which the model's value is multiplied, for stiffness, damping, mass, friction,
    /// size, brightness, strength and gravity.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "distribution")]
    pub scale_by: Option<Distribution>,
    /// Distribution of the number that is added to the model's value, for each channel of a color, each axis of a
    /// position or rotation, and the start of a joint; or of the standard deviation of noise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "distribution")]
    pub offset_by: Option<Distribution>,
    /// Whether each joint, body, geom, light or camera gets its own value. The default is one value for all.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub each: bool,
}

/// The distribution of a value: exactly one of `uniform`, `log_uniform`, `normal` and `choice`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Distribution {
    /// Uniform between the lowest and the highest value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "range")]
    pub uniform: Option<[f64; 2]>,
    /// Uniform in the logarithm, between the lowest and the highest value. A half is then as likely as a double.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "range")]
    pub log_uniform: Option<[f64; 2]>,
    /// A truncated normal distribution.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "normal")]
    pub normal: Option<Normal>,
    /// One of several values with equal probability.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "values")]
    pub choice: Option<Vec<f64>>,
}

/// A truncated normal distribution. Values outside of a range are drawn again.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Normal {
    /// Mean before truncation. It must be within the range.
    pub mean: f64,
    /// Standard deviation before truncation.
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub deviation: f64,
    /// Lowest and highest value.
    pub range: [f64; 2],
}

/// The distribution of a factor, after the checks.
#[derive(Debug, Clone, PartialEq)]
pub enum Drawing {
    /// Uniform between the lowest and the highest value.
    Uniform([f64; 2]),
    /// Uniform in the logarithm, between the lowest and the highest value.
    LogUniform([f64; 2]),
    /// A truncated normal distribution.
    Normal(Normal),
    /// One of several values with equal probability.
    Choice(Vec<f64>),
}

/// The property of a model that a factor changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Property {
    /// Stiffness of joints, multiplied.
    JointStiffness,
    /// Damping of joints, multiplied.
    JointDamping,
    /// Mass and inertia of bodies, multiplied.
    BodyMass,
    /// Sliding, torsional and rolling friction of geoms, multiplied.
    GeomFriction,
    /// Size of geoms, multiplied.
    GeomSize,
    /// Red, green and blue of geoms, each with an offset.
    GeomColour,
    /// Brightness of lights, multiplied.
    LightBrightness,
    /// Position of cameras, with an offset along x, y and z, m.
    CameraPosition,
    /// Orientation of cameras, turned by a rotation vector, rad.
    CameraRotation,
    /// Gains and biases of actuators, multiplied.
    ActuatorStrength,
    /// Acceleration of gravity, multiplied.
    Gravity,
    /// Position of hinges and slides at the start, with an offset, rad or m.
    JointStart,
    /// Standard deviation of the noise of modalities.
    SensorNoise,
}
names!(Property {
    JointStiffness => "joint_stiffness",
    JointDamping => "joint_damping",
    BodyMass => "body_mass",
    GeomFriction => "geom_friction",
    GeomSize => "geom_size",
    GeomColour => "geom_colour",
    LightBrightness => "light_brightness",
    CameraPosition => "camera_position",
    CameraRotation => "camera_rotation",
    ActuatorStrength => "actuator_strength",
    Gravity => "gravity",
    JointStart => "joint_start",
    SensorNoise => "sensor_noise",
});

impl Property {
    /// Returns the names of the values that one object needs; none if it needs a single value.
    fn components(self) -> &'static [&'static str] {
        match self {
            Self::GeomColour => &["red", "green", "blue"],
            Self::CameraPosition | Self::CameraRotation => &["x", "y", "z"],
            _ => &[],
        }
    }

    /// Returns the number of values that are drawn for one joint, body, geom, light or camera.
    pub fn width(self) -> usize {
        self.components().len().max(1)
    }

    /// Returns the unit of the values; `None` if it depends on the object.
    pub fn unit(self) -> Option<&'static str> {
        match self {
            Self::CameraPosition => Some("m"),
            Self::CameraRotation => Some("rad"),
            Self::JointStart | Self::SensorNoise => None,
            _ => Some("1"),
        }
    }

    /// Returns whether the values are added to the model's own values. If not, they are multiplied.
    fn is_offset(self) -> bool {
        !self.components().is_empty() || !self.is_of_model()
    }

    /// Returns the value that changes nothing.
    pub fn neutral(self) -> f64 {
        if self.is_offset() { 0.0 } else { 1.0 }
    }

    /// Returns whether the property is one of the compiled model, rather than of an episode's start or its recording.
    pub fn is_of_model(self) -> bool {
        !matches!(self, Self::JointStart | Self::SensorNoise)
    }

    /// Returns the lowest and the highest value that a distribution may have.
    fn bounds(self) -> [f64; 2] {
        match self {
            Self::GeomColour => [-1.0, 1.0],
            Self::SensorNoise => [0.0, 1e6],
            Self::CameraPosition | Self::JointStart => [-1000.0, 1000.0],
            Self::CameraRotation => [-std::f64::consts::PI, std::f64::consts::PI],
            _ => [1e-3, 1e3],
        }
    }

    /// Returns the elements of the values that a factor with the name `factor` draws. `things` are the names and the
    /// units of the objects that have values of their own; a single one without a name if all share them.
    pub fn elements(self, factor: &str, things: &[(Option<&str>, &str)]) -> Vec<Element> {
        let of_thing = |(thing, unit): &(Option<&str>, &str)| {
            let start = thing.map_or(factor.to_owned(), |thing| format!("{factor}_{thing}"));
            let names = match self.components() {
                [] => vec![start],
                components => components.iter().map(|component| format!("{start}_{component}")).collect(),
            };
            names.into_iter().map(|name| Element { name, unit: (*unit).to_owned() }).collect::<Vec<_>>()
        };
        things.iter().flat_map(of_thing).collect()
    }
}

impl Factor {
    /// Returns the property that the factor changes, and the patterns of the names of the objects. The factor must have
    /// passed the checks of a world file.
    pub fn property(&self) -> (Property, &[String]) {
        self.properties().next().unwrap_or((Property::JointStiffness, &[]))
    }

    fn properties(&self) -> impl Iterator<Item = (Property, &[String])> {
        let patterns = [
            (Property::JointStiffness, &self.joint_stiffness),
            (Property::JointDamping, &self.joint_damping),
            (Property::BodyMass, &self.body_mass),
            (Property::GeomFriction, &self.geom_friction),
            (Property::GeomSize, &self.geom_size),
            (Property::GeomColour, &self.geom_colour),
            (Property::LightBrightness, &self.light_brightness),
            (Property::CameraPosition, &self.camera_position),
            (Property::CameraRotation, &self.camera_rotation),
            (Property::ActuatorStrength, &self.actuator_strength),
            (Property::Gravity, &self.gravity),
            (Property::JointStart, &self.joint_start),
            (Property::SensorNoise, &self.sensor_noise),
        ];
        patterns.into_iter().filter_map(|(property, patterns)| Some((property, patterns.as_deref()?)))
    }

    /// Returns the distribution of the values. The factor must have passed the checks of a world file.
    pub fn drawing(&self) -> Drawing {
        let given = self.scale_by.iter().chain(&self.offset_by).flat_map(Distribution::drawings).next();
        given.unwrap_or(Drawing::Choice(vec![1.0]))
    }

    /// Checks the rules that the schema can't express. An error has the key at fault (empty for the factor as a whole)
    /// and the message.
    pub(super) fn check(&self) -> Result<(), (String, String)> {
        let one_of = |what: &str, all: &str, found: usize| {
            let found = if found == 0 { "none" } else { "several" };
            format!("{what} has exactly one of {all}; found {found}")
        };
        let properties: Vec<Property> = self.properties().map(|(property, _)| property).collect();
        let &[property] = properties.as_slice() else {
            let all: Vec<&str> = Property::ALL.iter().map(|property| property.name()).collect();
            return Err((String::new(), one_of("a factor", &all.join(", "), properties.len())));
        };
        let (wanted, given, other, change) = match property.is_offset() {
            true => ("offset_by", &self.offset_by, &self.scale_by, "offset"),
            false => ("scale_by", &self.scale_by, &self.offset_by, "scale"),
        };
        let (Some(distribution), None) = (given, other) else {
            let message =
                format!("a factor of {property} has a distribution of its {change} under '{wanted}'");
            return Err((String::new(), message + " and no other"));
        };
        let at = |message: String| (wanted.to_owned(), message);
        let drawings: Vec<Drawing> = distribution.drawings().collect();
        let [drawing] = drawings.as_slice() else {
            let all = "uniform, log_uniform, normal, choice";
            return Err(at(one_of("a distribution", all, drawings.len())));
        };
        drawing.check(property).map_err(at)
    }
}

impl Distribution {
    fn drawings(&self) -> impl Iterator<Item = Drawing> {
        let given = [
            self.uniform.map(Drawing::Uniform),
            self.log_uniform.map(Drawing::LogUniform),
            self.normal.map(Drawing::Normal),
            self.choice.clone().map(Drawing::Choice),
        ];
        given.into_iter().flatten()
    }
}

impl Drawing {
    /// Returns the lowest and the highest value that can be drawn.
    pub fn range(&self) -> [f64; 2] {
        match self {
            Self::Uniform(range) | Self::LogUniform(range) | Self::Normal(Normal { range, .. }) => *range,
            Self::Choice(values) => {
                values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| {
                    [low.min(*value), high.max(*value)]
                })
            }
        }
    }

    fn check(&self, property: Property) -> Result<(), String> {
        if matches!(self, Self::Choice(values) if values.is_empty()) {
            return Err("'choice' lists no value; give at least one".into());
        }
        let [low, high] = self.range();
        ascending([low, high])?;
        let [least, most] = property.bounds();
        if low < least || high > most {
            return Err(format!(
                "a factor of {property} draws values from {least} to {most}; found {low} to {high}"
            ));
        }
        match self {
            Self::LogUniform(_) if low <= 0.0 => {
                Err(format!("'log_uniform' draws values above 0; found {low}"))
            }
            Self::Normal(Normal { mean, .. }) if *mean < low || *mean > high => {
                Err(format!("the mean {mean} is outside of the range [{low}, {high}]"))
            }
            _ => Ok(()),
        }
    }
}

impl fmt::Display for Drawing {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Uniform([low, high]) => write!(f, "uniform from {low} to {high}"),
            Self::LogUniform([low, high]) => write!(f, "log-uniform from {low} to {high}"),
            Self::Normal(Normal { mean, deviation, range: [low, high] }) => {
                write!(f, "normal, {mean} ± {deviation}, from {low} to {high}")
            }
            Self::Choice(values) => write!(f, "one of {values:?}"),
        }
    }
}

fn range(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "minItems": 2, "maxItems": 2, "items": { "type": "number" } })
}
fn values(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "items": { "type": "number" } })
}
fn normal(generator: &mut SchemaGenerator) -> Schema {
    generator.subschema_for::<Normal>()
}
fn distribution(generator: &mut SchemaGenerator) -> Schema {
    generator.subschema_for::<Distribution>()
}
