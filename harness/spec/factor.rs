//! Factors of variation: properties of a model that each episode draws anew, where a spec turns them on.

use super::modality::Element;
use super::types::names;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};
use std::fmt;

/// A factor of variation: exactly one of `joint_stiffness`, `joint_damping`, `body_mass`, `geom_friction`, `geom_size`,
/// `geom_colour`, `light_brightness`, `camera_position` and `camera_rotation`, and how it is drawn.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Factor {
    /// The springs of joints.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub joint_stiffness: Option<Vec<String>>,
    /// The dampers of joints.
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
    /// How bright lights are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub light_brightness: Option<Vec<String>>,
    /// Where cameras are, m, along the axes of the body that carries them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub camera_position: Option<Vec<String>>,
    /// Where cameras look, rad: a rotation vector along the camera's own axes (right, up, backwards).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub camera_rotation: Option<Vec<String>>,
    /// What the model's own value is multiplied by: for stiffness, damping, mass, friction, size and brightness.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "distribution")]
    pub scale_by: Option<Distribution>,
    /// What is added to the model's own value: for each channel of a colour, and each axis of a position or rotation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "distribution")]
    pub offset_by: Option<Distribution>,
    /// Whether each joint, body, geom, light or camera has a value of its own, instead of one for all.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub each: bool,
}

/// How a value is drawn: exactly one of `uniform`, `log_uniform`, `normal` and `choice`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Distribution {
    /// Uniformly between the lowest and the highest value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "range")]
    pub uniform: Option<[f64; 2]>,
    /// Uniformly in its logarithm, so that a half is as likely as a double.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "range")]
    pub log_uniform: Option<[f64; 2]>,
    /// A truncated normal distribution.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "normal")]
    pub normal: Option<Normal>,
    /// One of several values, each as likely as the others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "values")]
    pub choice: Option<Vec<f64>>,
}

/// A normal distribution, of which what lies outside of a range is drawn again.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Normal {
    /// The mean, if nothing were cut off; within the range.
    pub mean: f64,
    /// The standard deviation, if nothing were cut off.
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub deviation: f64,
    /// Lowest and highest value.
    pub range: [f64; 2],
}

/// A distribution that was checked.
#[derive(Debug, Clone, PartialEq)]
pub enum Drawing {
    Uniform([f64; 2]),
    LogUniform([f64; 2]),
    Normal(Normal),
    Choice(Vec<f64>),
}

/// What a factor changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Property {
    JointStiffness,
    JointDamping,
    BodyMass,
    GeomFriction,
    GeomSize,
    GeomColour,
    LightBrightness,
    CameraPosition,
    CameraRotation,
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
});

impl Property {
    /// What its values are of, unless each thing has a single one.
    fn components(self) -> &'static [&'static str] {
        match self {
            Self::GeomColour => &["red", "green", "blue"],
            Self::CameraPosition | Self::CameraRotation => &["x", "y", "z"],
            _ => &[],
        }
    }

    /// Values that are drawn for one thing.
    pub fn width(self) -> usize {
        self.components().len().max(1)
    }

    fn unit(self) -> &'static str {
        match self {
            Self::CameraPosition => "m",
            Self::CameraRotation => "rad",
            _ => "1",
        }
    }

    /// Whether a value is added to the model's own, rather than multiplied by it.
    fn is_offset(self) -> bool {
        !self.components().is_empty()
    }

    /// The values that can be drawn.
    fn bounds(self) -> [f64; 2] {
        match self {
            Self::GeomColour => [-1.0, 1.0],
            Self::CameraPosition => [-1000.0, 1000.0],
            Self::CameraRotation => [-std::f64::consts::PI, std::f64::consts::PI],
            _ => [1e-3, 1e3],
        }
    }

    /// The elements of what a factor of that name draws; `things` are those that have values of their own, if any.
    pub fn elements(self, factor: &str, things: Option<&[String]>) -> Vec<Element> {
        let starts = match things {
            Some(things) => things.iter().map(|thing| format!("{factor}_{thing}")).collect(),
            None => vec![factor.to_owned()],
        };
        let names = starts.iter().flat_map(|start| match self.components() {
            [] => vec![start.clone()],
            components => components.iter().map(|component| format!("{start}_{component}")).collect(),
        });
        names.map(|name| Element { name, unit: self.unit().to_owned() }).collect()
    }
}

impl Factor {
    /// What it changes, and the patterns of the names of the things; of a file that was checked.
    pub fn property(&self) -> (Property, &[String]) {
        self.properties().next().unwrap_or((Property::JointStiffness, &[]))
    }

    fn properties(&self) -> impl Iterator<Item = (Property, &[String])> {
        let patterns = [
            &self.joint_stiffness,
            &self.joint_damping,
            &self.body_mass,
            &self.geom_friction,
            &self.geom_size,
            &self.geom_colour,
            &self.light_brightness,
            &self.camera_position,
            &self.camera_rotation,
        ];
        let given = Property::ALL.iter().zip(patterns);
        given.filter_map(|(property, patterns)| Some((*property, patterns.as_deref()?)))
    }

    /// How its values are drawn; of a file that was checked.
    pub fn drawing(&self) -> Drawing {
        let given = self.scale_by.iter().chain(&self.offset_by).flat_map(Distribution::drawings).next();
        given.unwrap_or(Drawing::Choice(vec![1.0]))
    }

    /// What the schema can't say: the key at fault, if it is one, and what is wrong.
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
    fn check(&self, property: Property) -> Result<(), String> {
        let [low, high] = match self {
            Self::Uniform(range) | Self::LogUniform(range) | Self::Normal(Normal { range, .. }) => *range,
            Self::Choice(values) if values.is_empty() => {
                return Err("'choice' lists no value; give at least one".into());
            }
            Self::Choice(values) => {
                values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| {
                    [low.min(*value), high.max(*value)]
                })
            }
        };
        super::world::ascending([low, high])?;
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

/// A list of patterns, which one text may stand for.
fn globs(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "items": { "type": "string" } })
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
