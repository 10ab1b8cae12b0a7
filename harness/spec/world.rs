//! Worlds: a YAML file beside an MJCF model that defines the modalities, the action and the random parts of an episode.

use super::error::SpecError;
use super::factor::Factor;
use super::hints::HINTS;
use super::kind::FileKind;
use super::origin::Scenario;
use super::simulation::{self, Setting, Simulation};
use super::text::read_text;
use super::values::{ascending, globs, matching};
use crate::layout::{
    CLASS_COLORS, CONTACT_KIND, CONTACT_PARTS, Modality, NO_CONTACT, Percentage, Region, Scale, Scaling,
    present,
};
use crate::yaml::{
    NAME, Node, Problem, Value, allow_single_values, check_against, is_name, list_single, parse, shorten,
    unknown,
};
use schemars::JsonSchema;
use serde::de::{Deserializer, MapAccess, Visitor};
use serde::ser::{SerializeMap, Serializer};
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;
use std::collections::BTreeMap;
use std::fmt;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock};

/// The longest side of an image that a world can declare, pixels.
const MAX_IMAGE_SIDE: usize = 1024;

/// Entries of a section of a file, as names and values in the file's order.
#[derive(Debug, Clone, PartialEq)]
pub struct Ordered<T>(pub Vec<(String, T)>);

impl<T> Default for Ordered<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Ordered<T> {
    /// Iterates over the names and values in the file's order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &T)> {
        self.0.iter().map(|(name, value)| (name.as_str(), value))
    }

    /// Returns the names in the file's order.
    fn names(&self) -> Vec<&str> {
        self.iter().map(|(name, _)| name).collect()
    }

    /// Returns whether there is no entry.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl<T: Serialize> Serialize for Ordered<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        self.0.iter().try_for_each(|(name, value)| map.serialize_entry(name, value))?;
        map.end()
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Ordered<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Entries<T>(PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for Entries<T> {
            type Value = Ordered<T>;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                write!(f, "a section of keys")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Ordered<T>, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(Ordered(entries))
            }
        }
        deserializer.deserialize_map(Entries(PhantomData))
    }
}

/// A world file. It refers to joints, geoms, sensors, cameras, actuators and bodies by their names in the MJCF. In
/// lists of names, `*`, `?` and `[abc]` match as in a shell. Matches are in the model's order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WorldFile {
    /// Description of the world, in a sentence.
    #[serde(default)]
    pub description: String,
    /// Path of the MJCF file, relative to this file's folder.
    pub model: String,
    /// Simulation steps per second, Hz: 1 / the model's `timestep`.
    #[schemars(range(max = 1_000_000.0), extend("exclusiveMinimum" = 0.0))]
    pub step_rate_hz: f64,
    /// Samples recorded per second, Hz, if a spec does not set it.
    #[serde(default = "ten")]
    #[schemars(range(max = 100_000.0), extend("exclusiveMinimum" = 0.0))]
    pub sample_rate_hz: f64,
    /// The modalities that are recorded at each sample, by name.
    #[schemars(with = "BTreeMap<String, Sensing>")]
    pub modalities: Ordered<Sensing>,
    /// The keyframe of the MJCF from which episodes start: its positions, velocities and activations. The setpoints
    /// start at its controls, within their ranges.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub keyframe: Option<String>,
    /// The actuators and their random moves.
    pub action: Acting,
    /// Bodies that each episode places at random. Each entry has a name for a group of bodies.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    #[schemars(with = "BTreeMap<String, Placing>")]
    pub placement: Ordered<Placing>,
    /// Factors of variation: properties of the model that each episode draws anew, by name. They are off unless a spec
    /// lists them in `simulation.factors`.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    #[schemars(with = "BTreeMap<String, Factor>")]
    pub factors: Ordered<Factor>,
    /// Regions of the images whose errors are reported separately, by name. A pixel that matches two regions belongs to
    /// the later one.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    #[schemars(with = "BTreeMap<String, Colors>")]
    pub regions: Ordered<Colors>,
}

/// A modality: exactly one source, such as `joint_positions`, `camera` or `difference_of`, and its properties.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sensing {
    /// Angles (rad) of hinges and positions (m) of slides. A ball joint has a unit quaternion qw, qx, qy, qz with qw at
    /// least 0, and a free joint has x, y and z (m) before it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub joint_positions: Option<Vec<String>>,
    /// Velocities (rad/s, m/s) of hinges and slides. A ball joint has the angular velocity rx, ry, rz in the frame of
    /// its body, and a free joint has the velocity x, y, z in the world before it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub joint_velocities: Option<Vec<String>>,
    /// Positions of the origins of bodies in world coordinates: x, y and z, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub body_positions: Option<Vec<String>>,
    /// Orientations of bodies in world coordinates: unit quaternions w, x, y, z with w at least 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub body_orientations: Option<Vec<String>>,
    /// Positions of sites in world coordinates: x, y and z, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub site_positions: Option<Vec<String>>,
    /// Orientations of sites in world coordinates: unit quaternions w, x, y, z with w at least 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub site_orientations: Option<Vec<String>>,
    /// A body in whose frame the positions and orientations of bodies and sites are given. The default is the world.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub relative_to: Option<String>,
    /// `true` if the bodies or sites are a set of objects: networks treat them alike, whatever their order.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub set: bool,
    /// The normal force of all contacts of each geom, of each body's geoms, or of each flex, N.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub normal_force: Option<Vec<String>>,
    /// The direction in which the normal forces push each geom or body: a unit vector x, y, z in the frame of the body, and
    /// 0 without a contact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub contact_normal: Option<Vec<String>>,
    /// The values of sensors of the MJCF.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub sensor: Option<Vec<String>>,
    /// The image of a camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub camera: Option<String>,
    /// The true optical flow of a camera, encoded as an image: the displacement of each visible point since the
    /// previous sample, in pixels. Red is 128 plus 127 / `limit_pixels` for each pixel to the right, and green the same
    /// for each pixel downwards. Blue is 255 if the point was visible in the previous image, and 0 if it was hidden or
    /// outside of the image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub optical_flow: Option<String>,
    /// The largest displacement that an optical flow can encode, pixels. The default is 8.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "limit")]
    pub limit_pixels: Option<f64>,
    /// The depth that a camera sees, encoded as an image: the distance of each visible point from the plane of the
    /// camera. Red is 0 at the lower and 255 at the upper end of `range_m`, and linear between them. Green is 255 times
    /// the lower end over the depth. Blue is 255 where something is visible.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub depth: Option<String>,
    /// The range of depths that an image encodes, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "depths")]
    pub range_m: Option<[f64; 2]>,
    /// What a camera sees, encoded as an image in which each class of `classes` has a color. It also tells the regions
    /// of the images of the same camera and size, for their metrics.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub segmentation: Option<String>,
    /// The classes of a segmentation, by name: one to seven lists of geoms, bodies or flexes. Their colors are red,
    /// green, blue, yellow, cyan, magenta and white, in their order. All else is black.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    #[schemars(schema_with = "groups")]
    pub classes: Ordered<Vec<String>>,
    /// The change of another modality since the previous sample. It is zero at an episode's first sample.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub difference_of: Option<String>,
    /// Rows and columns of an image, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "size")]
    pub size: Option<[usize; 2]>,
    /// `sample` averages forces over the steps since the previous sample. The default is the force at the instant of
    /// the sample.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Interval")]
    pub average_over: Option<Interval>,
    /// Kinds of contact of a `normal_force`, by name. Each is a list of the geoms or bodies on the other side of the
    /// contact. The metrics of the force are also computed for the contacts of each kind, and for `none`, the elements
    /// without a contact. If an element has contacts of several kinds, the one with the largest force counts, or with
    /// the largest impulse if the force is averaged.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    #[schemars(schema_with = "groups")]
    pub contact_kinds: Ordered<Vec<String>>,
    /// Unit of a sensor's values.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub unit: Option<String>,
    /// Groups of elements that have their own metrics, by name. Each group is a list of patterns of names in the MJCF.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    #[schemars(schema_with = "groups")]
    pub groups: Ordered<Vec<String>>,
    /// The standard deviation by which values are divided for a network. The default is `shared` for forces, directions
    /// of contacts and images, and `per_element` for others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Scale")]
    pub scale: Option<Scale>,
    /// The lowest value of a prediction. `null` means no bound. The default is 0 for a `normal_force`, and no bound for
    /// others and while a factor of `sensor_noise` of the modality is on. If geoms have adhesion, a `normal_force` has no
    /// default.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "present")]
    #[schemars(schema_with = "number_or_null")]
    pub minimum: Option<Option<f64>>,
    /// The metric for errors in percent. The default is `wmape` for forces and `smape` for angles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Percentage")]
    pub percentage: Option<Percentage>,
}

/// The interval of an average.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Interval {
    /// The time since the previous sample.
    Sample,
}

/// The action: how actuators move.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Acting {
    /// Duration of a move from one random setpoint to the next, s, if a spec does not set it. A move is a smoothstep.
    #[serde(default = "second")]
    #[schemars(range(max = 60.0), extend("exclusiveMinimum" = 0.0))]
    pub seconds: f64,
    /// How the setpoints of a dataset's episodes move.
    // The default is not written, so that datasets from before this key keep their names.
    #[serde(default, skip_serializing_if = "Motion::is_default")]
    pub motion: Motion,
    /// The summed force of the first `normal_force` from which a probing motion counts as a touch, N. The default is 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "force")]
    pub probe_force_n: Option<f64>,
    /// Path of a CSV file with a recorded course, relative to this file's folder. It has a column for each element of
    /// the action and a row for each sample, and may have a column `episode`. It replaces the motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub course: Option<String>,
    /// The elements of the action, by name.
    #[schemars(with = "BTreeMap<String, Actuator>")]
    pub actuators: Ordered<Actuator>,
}

/// How setpoints move. Each episode draws its own motion, and each element moves independently of the others.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Motion {
    /// Smooth moves between setpoints that are drawn uniformly from the range.
    #[default]
    RandomSetpoints,
    /// Smooth moves between the setpoints of a random walk. A step is drawn uniformly from plus and minus 30 % of the
    /// range, and is reflected at the ends of the range.
    RandomWalk,
    /// A sinusoid within the range, with an amplitude of 25 to 50 % of the range and 0.1 to 0.45 periods in the
    /// duration of a move, both drawn uniformly. The setpoint reaches it smoothly during the first move.
    Sinusoids,
    /// The moves of random setpoints, each interrupted by its first touch: the setpoint stops for 20 % of a move, goes
    /// back to where the move began, and then makes the whole move. The world needs a `normal_force`.
    Probing,
}

impl Motion {
    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// An actuator that receives commands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Actuator {
    /// Name of the actuator in the MJCF, if it differs from the element's name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub actuator: Option<String>,
    /// Names of several actuators in the MJCF that get the same setpoint.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "globs")]
    pub actuators: Option<Vec<String>>,
    /// Name of the control that gets the setpoint, if the actuators have several: `pos`, `vel` and `ff` of a `pid` or
    /// a `dcmotor`; `rx`, `ry` and `rz`, or `qw` to `qz`, of an `orientation`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub control: Option<String>,
    /// Name of a mocap body in the MJCF. Its coordinate `axis` follows the setpoint, and no actuator does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    pub mocap: Option<String>,
    /// The coordinate of the mocap body, in the world, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Axis")]
    pub axis: Option<Axis>,
    /// Unit of the actuator's control.
    #[serde(default)]
    pub unit: String,
    /// Lowest and highest setpoint. Setpoints are drawn uniformly between them.
    pub range: [f64; 2],
    /// The setpoint at an episode's start.
    #[serde(default)]
    pub start: Start,
}

impl Actuator {
    /// Refuses keys that can't be combined. The error is the message.
    fn check(&self) -> Result<(), &'static str> {
        match (&self.actuator, &self.actuators, &self.mocap, self.axis) {
            (Some(_), Some(_), ..) => {
                Err("'actuators' names several, and 'actuator' one; leave one of them out")
            }
            (Some(_), _, Some(_), _) | (_, Some(_), Some(_), _) => {
                Err("'mocap' moves a body without an actuator; leave one of them out")
            }
            (.., Some(_), _) if self.control.is_some() => {
                Err("'mocap' moves a body, which has no 'control'; leave one of them out")
            }
            (.., Some(_), None) => Err("'mocap' needs an 'axis': x, y or z"),
            (.., None, Some(_)) => Err("only a 'mocap' has an 'axis'"),
            _ => Ok(()),
        }
    }
}

/// A coordinate in the world.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Axis {
    /// The first coordinate.
    X,
    /// The second coordinate.
    Y,
    /// The third coordinate, upwards in most models.
    Z,
}

/// The place in an actuator's range where the setpoint starts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// The lowest setpoint.
    Low,
    /// The middle of the range.
    #[default]
    Middle,
    /// The highest setpoint.
    High,
}

/// Bodies with free joints that each episode places on the ground, uniformly over an area and with a random yaw. The
/// ground is the highest surface of geoms that can't move, below the height that the body has in the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Placing {
    /// Names of the bodies. Each needs a free joint, and a geom that can touch something.
    pub bodies: Vec<String>,
    /// Smallest distance between two bodies, m. A body that is drawn nearer to another is drawn again.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub clearance_m: f64,
    /// The area is the sector that an arm sweeps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Sector")]
    pub sector: Option<Sector>,
    /// The area is a rectangle: lowest and highest x, lowest and highest y, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "rectangle")]
    pub rectangle: Option<[[f64; 2]; 2]>,
}

/// The sector that an arm sweeps, if it turns about a vertical axis and extends away from it. The place under `body` at
/// an episode's start is kept free.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sector {
    /// The element of the action that turns the arm.
    pub rotation: String,
    /// The element of the action that extends the arm.
    pub extension: String,
    /// The body that the arm carries. It needs a geom of the same name.
    pub body: String,
}

/// A region of pixels, selected by color.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Colors {
    /// The range of (red - blue) / (the pixel's brightest channel). The upper bound is excluded.
    pub red_minus_blue: [f64; 2],
}

fn ten() -> f64 {
    10.0
}
fn second() -> f64 {
    1.0
}

/// The schemas of the values of optional keys. Without them, the schemas would also allow `null`.
mod plain {
    use super::{MAX_IMAGE_SIDE, globs};
    use schemars::{Schema, SchemaGenerator, json_schema};

    pub fn groups(generator: &mut SchemaGenerator) -> Schema {
        let globs = globs(generator).to_value();
        json_schema!({ "type": "object", "properties": {}, "additionalProperties": globs })
    }
    pub fn limit(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "number", "exclusiveMinimum": 0.0, "maximum": MAX_IMAGE_SIDE })
    }
    pub fn depths(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "type": "array", "minItems": 2, "maxItems": 2, "items": { "type": "number", "exclusiveMinimum": 0.0 },
        })
    }
    pub fn force(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "number", "exclusiveMinimum": 0.0 })
    }
    pub fn number_or_null(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": ["number", "null"] })
    }
    pub fn size(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "type": "array", "minItems": 2, "maxItems": 2,
            "items": { "type": "integer", "minimum": 1, "maximum": MAX_IMAGE_SIDE },
        })
    }
    pub fn rectangle(_: &mut SchemaGenerator) -> Schema {
        let range = json_schema!({
            "type": "array", "minItems": 2, "maxItems": 2, "items": { "type": "number" },
        });
        json_schema!({ "type": "array", "minItems": 2, "maxItems": 2, "items": range })
    }
}
use plain::{depths, force, groups, limit, number_or_null, rectangle, size};

/// The schema of a world file.
static SCHEMA: LazyLock<Json> = LazyLock::new(|| schemars::schema_for!(WorldFile).to_value());

/// Returns the JSON schema of a world file, for editors.
pub fn world_schema() -> Json {
    let mut schema = SCHEMA.clone();
    allow_single_values(&mut schema);
    schema
}

/// What the values of a modality are read from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Source<'a> {
    /// Positions (rad, m) of the joints whose names match these patterns.
    JointPositions(&'a [String]),
    /// Velocities (rad/s, m/s) of the joints whose names match these patterns.
    JointVelocities(&'a [String]),
    /// Positions or orientations of bodies or sites.
    Pose {
        /// Patterns of the names of the bodies or sites.
        names: &'a [String],
        /// Whether they are bodies or sites.
        of: Posed,
        /// Whether the values are orientations (unit quaternions w, x, y, z) rather than positions (m).
        orientation: bool,
        /// Name of the body in whose frame they are given; `None` for the world.
        relative_to: Option<&'a str>,
    },
    /// Normal contact forces, N.
    NormalForce {
        /// Patterns of the names of geoms or bodies.
        names: &'a [String],
        /// Whether the forces are averaged over the steps since the sample before.
        mean: bool,
    },
    /// Directions of the summed normal forces on the geoms or bodies whose names match these patterns.
    ContactNormal(&'a [String]),
    /// Values of the sensors of the MJCF whose names match these patterns.
    Sensor(&'a [String]),
    /// The image of a camera.
    Camera {
        /// Name of the camera in the MJCF.
        name: &'a str,
        /// Rows and columns, pixels.
        size: [usize; 2],
    },
    /// The optical flow of a camera, as an image.
    OpticalFlow {
        /// Name of the camera in the MJCF.
        camera: &'a str,
        /// Rows and columns, pixels.
        size: [usize; 2],
        /// The largest displacement that the image can encode, pixels.
        limit: f64,
    },
    /// The depth that a camera sees, as an image.
    Depth {
        /// Name of the camera in the MJCF.
        camera: &'a str,
        /// Rows and columns, pixels.
        size: [usize; 2],
        /// The depths at which red is 0 and 255, m.
        range_m: [f64; 2],
    },
    /// The classes of what a camera sees, as an image.
    Segmentation {
        /// Name of the camera in the MJCF.
        camera: &'a str,
        /// Rows and columns, pixels.
        size: [usize; 2],
        /// Patterns of the names of geoms, bodies or flexes, by class.
        classes: &'a Ordered<Vec<String>>,
    },
    /// The change of another modality since the sample before.
    DifferenceOf(Modality),
}

/// The kind of object whose pose is recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Posed {
    /// A body, at its origin.
    Body,
    /// A site.
    Site,
}

/// The default of the largest displacement that an optical flow can encode, pixels.
const FLOW_LIMIT: f64 = 8.0;

impl Source<'_> {
    /// Returns the key in a world file.
    pub fn key(&self) -> &'static str {
        match self {
            Self::JointPositions(_) => "joint_positions",
            Self::JointVelocities(_) => "joint_velocities",
            Self::Pose { of: Posed::Body, orientation: false, .. } => "body_positions",
            Self::Pose { of: Posed::Body, orientation: true, .. } => "body_orientations",
            Self::Pose { of: Posed::Site, orientation: false, .. } => "site_positions",
            Self::Pose { of: Posed::Site, orientation: true, .. } => "site_orientations",
            Self::NormalForce { .. } => "normal_force",
            Self::ContactNormal(_) => "contact_normal",
            Self::Sensor(_) => "sensor",
            Self::Camera { .. } => "camera",
            Self::OpticalFlow { .. } => "optical_flow",
            Self::Depth { .. } => "depth",
            Self::Segmentation { .. } => "segmentation",
            Self::DifferenceOf(_) => "difference_of",
        }
    }
}

impl Sensing {
    /// The keys of which a modality has exactly one.
    const SOURCES: &str = "joint_positions, joint_velocities, body_positions, body_orientations, site_positions, \
                           site_orientations, normal_force, contact_normal, sensor, camera, optical_flow, depth, \
                           segmentation, difference_of";

    /// Returns what the values are read from. The file must have passed the checks.
    pub fn source(&self) -> Source<'_> {
        self.sources().next().unwrap_or(Source::Sensor(&[]))
    }

    fn sources<'a>(&'a self) -> impl Iterator<Item = Source<'a>> {
        let (mean, size) = (self.average_over.is_some(), self.size.unwrap_or([1, 1]));
        let relative_to = self.relative_to.as_deref();
        let pose = |names: &'a Option<Vec<String>>, of, orientation| {
            names.as_deref().map(|names| Source::Pose { names, of, orientation, relative_to })
        };
        let limit = self.limit_pixels.unwrap_or(FLOW_LIMIT);
        let (range_m, classes) = (self.range_m.unwrap_or_default(), &self.classes);
        let sources = [
            self.joint_positions.as_deref().map(Source::JointPositions),
            self.joint_velocities.as_deref().map(Source::JointVelocities),
            pose(&self.body_positions, Posed::Body, false),
            pose(&self.body_orientations, Posed::Body, true),
            pose(&self.site_positions, Posed::Site, false),
            pose(&self.site_orientations, Posed::Site, true),
            self.normal_force.as_deref().map(|names| Source::NormalForce { names, mean }),
            self.contact_normal.as_deref().map(Source::ContactNormal),
            self.sensor.as_deref().map(Source::Sensor),
            self.camera.as_deref().map(|name| Source::Camera { name, size }),
            self.optical_flow.as_deref().map(|camera| Source::OpticalFlow { camera, size, limit }),
            self.depth.as_deref().map(|camera| Source::Depth { camera, size, range_m }),
            self.segmentation.as_deref().map(|camera| Source::Segmentation { camera, size, classes }),
            // The checks refuse a text that is not the name of a modality.
            self.difference_of
                .as_deref()
                .map(|of| Source::DifferenceOf(Modality::new(of).unwrap_or(Modality::SETPOINT))),
        ];
        sources.into_iter().flatten()
    }

    /// Returns whether it is an image. The difference of an image does not count.
    fn is_image(&self) -> bool {
        [&self.camera, &self.optical_flow, &self.depth, &self.segmentation].iter().any(|key| key.is_some())
    }
}

/// A world file that was read, with the places of its values for messages.
#[derive(Debug, Clone)]
pub struct World {
    scenario: Scenario,
    /// Name of the file in messages.
    label: String,
    /// The folder that the model's path is relative to; `None` for a built-in world.
    folder: Option<PathBuf>,
    file: WorldFile,
    tree: Node,
}

/// Worlds with the same name and content are equal, in whatever folder they are.
impl PartialEq for World {
    fn eq(&self, other: &Self) -> bool {
        (self.scenario, &self.file) == (other.scenario, &other.file)
    }
}

/// The place of a world's MJCF.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ModelFile {
    /// The model is part of the program.
    BuiltIn {
        /// Name of the model's file without extension.
        name: &'static str,
        /// Text of the MJCF.
        xml: &'static str,
    },
    /// The model is in the file with this path.
    File(PathBuf),
}

/// What is known about a modality before the model is compiled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Known {
    /// Rows and columns of an image; `None` for a vector.
    pub size: Option<[usize; 2]>,
    pub scaling: Scaling,
}

/// The built-in worlds: name, text of the world file, text of the MJCF.
const BUILT_IN: [(&str, &str, &str); 6] = [
    ("empty", include_str!("../../models/empty.yaml"), include_str!("../../models/empty.xml")),
    ("cluttered", include_str!("../../models/cluttered.yaml"), include_str!("../../models/cluttered.xml")),
    ("crowded", include_str!("../../models/crowded.yaml"), include_str!("../../models/crowded.xml")),
    (
        "crowded_moving",
        include_str!("../../models/crowded_moving.yaml"),
        include_str!("../../models/crowded_moving.xml"),
    ),
    ("wrist", include_str!("../../models/wrist.yaml"), include_str!("../../models/wrist.xml")),
    ("tendon", include_str!("../../models/tendon.yaml"), include_str!("../../models/tendon.xml")),
];

impl World {
    /// Returns the worlds that are part of the program.
    pub fn built_in() -> &'static [Arc<World>] {
        static WORLDS: LazyLock<Vec<Arc<World>>> = LazyLock::new(|| {
            let read = |(name, yaml, _): &(&str, &str, &str)| {
                let label = format!("the built-in models/{name}.yaml");
                Arc::new(World::parse(&label, None, name, yaml).expect("a test reads every built-in world"))
            };
            BUILT_IN.iter().map(read).collect()
        });
        &WORLDS
    }

    /// Returns the built-in world with this name; `None` if there is none.
    pub fn named(name: &str) -> Option<Arc<World>> {
        Self::built_in().iter().find(|world| world.scenario.name() == name).cloned()
    }

    /// Returns the built-in world with this name, or reads the world file with this path.
    ///
    /// # Errors
    /// When neither exists, or the file has a fault.
    pub fn find(name: &str) -> Result<Arc<World>, SpecError> {
        let looks_like_path = name.contains('/') || name.contains('.');
        match Self::named(name) {
            Some(world) => Ok(world),
            None if looks_like_path => Self::load(Path::new(name)),
            None => {
                let names: Vec<&str> = Self::built_in().iter().map(|world| world.scenario.name()).collect();
                let message = unknown("world", name, "", &names, str::to_owned);
                Err(SpecError::NoWorld { message: format!("{message}, or the path of a world file") })
            }
        }
    }

    /// Returns the built-in world of one of the paper's scenarios.
    ///
    /// # Panics
    /// When there is no built-in world with the scenario's name.
    pub fn paper(scenario: Scenario) -> Arc<World> {
        Self::named(scenario.name()).expect("the paper's scenarios are built-in worlds")
    }

    /// Reads a world file. The file's name without extension becomes the scenario.
    ///
    /// # Errors
    /// Returns the first fault of the file, with its line and column.
    pub fn load(path: &Path) -> Result<Arc<World>, SpecError> {
        let label = path.display().to_string();
        let name = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        let unreadable = |message: String| SpecError::Unreadable { path: label.clone(), message };
        let text = read_text(path)?;
        if !is_name(name) {
            return Err(unreadable(format!(
                "a world is named after its file, and can't be named '{}'; use lower-case letters, digits and '_', a \
                 letter first",
                shorten(name)
            )));
        }
        if Self::named(name).is_some() {
            return Err(unreadable(format!(
                "'{name}' is the name of a built-in world; give the file another name"
            )));
        }
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        Self::parse(&label, Some(folder), name, &text).map(Arc::new)
    }

    /// Reads the world file again, as it is now; `None` for a built-in world.
    pub fn read_again(&self) -> Option<Result<Arc<World>, SpecError>> {
        self.folder.as_ref().map(|_| Self::load(Path::new(&self.label)))
    }

    /// Parses the text of a world file. Messages call the file `label`, the path of its model is relative to `folder`,
    /// and `name` becomes the scenario.
    ///
    /// # Errors
    /// Returns the first fault, with its line and column.
    pub fn parse(label: &str, folder: Option<PathBuf>, name: &str, text: &str) -> Result<World, SpecError> {
        let parsed = || -> Result<(WorldFile, Node), Problem> {
            let mut tree = parse(text)?;
            if matches!(tree.value, Value::Null) {
                return Err(Problem::new(
                    &tree.place,
                    "the file is empty; `harness world new MODEL.xml` writes one",
                ));
            }
            FileKind::World.check(&tree)?;
            list_single(&SCHEMA, &mut tree);
            check_against(&SCHEMA, &tree, &HINTS)?;
            let file: WorldFile = serde_json::from_value(tree.to_json())
                .map_err(|error| Problem::new(&tree.place, error.to_string()))?;
            check(&file).map_err(|(path, message)| Problem::new(tree.place_of(&path), message))?;
            Ok((file, tree))
        };
        let (file, tree) = parsed().map_err(|problem| SpecError::of(problem, label))?;
        let scenario = Scenario::new(name).ok_or_else(|| SpecError::Unreadable {
            path: label.to_owned(),
            message: format!("'{}' can't name a world", shorten(name)),
        })?;
        Ok(World { scenario, label: label.to_owned(), folder, file, tree })
    }

    /// Returns the name of the world.
    pub fn scenario(&self) -> Scenario {
        self.scenario
    }

    /// Returns the description of the world, one sentence; empty if the file has none.
    pub fn description(&self) -> &str {
        &self.file.description
    }

    /// Returns the content of the world file.
    pub fn file(&self) -> &WorldFile {
        &self.file
    }

    /// Returns the name of the file in messages.
    pub fn label(&self) -> &str {
        &self.label
    }

    /// Returns the absolute path of the world file, in which links to its folder are resolved; `None` for a built-in
    /// world.
    pub fn path(&self) -> Option<PathBuf> {
        let folder = self.folder.as_ref()?;
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let folder = std::fs::canonicalize(folder).or_else(|_| std::path::absolute(folder)).ok()?;
        Some(folder.join(Path::new(&self.label).file_name()?))
    }

    /// Returns the place of the world's MJCF.
    pub fn model(&self) -> ModelFile {
        let built_in = BUILT_IN.iter().find(|(name, ..)| *name == self.scenario.name());
        match (&self.folder, built_in) {
            (None, Some((name, _, xml))) => ModelFile::BuiltIn { name, xml },
            (folder, _) => ModelFile::File(folder.clone().unwrap_or_default().join(&self.file.model)),
        }
    }

    /// Returns the place of the recorded course that the world's action follows; `None` if its setpoints are random.
    pub fn course(&self) -> Option<PathBuf> {
        self.file.action.course.as_ref().map(|path| self.folder.clone().unwrap_or_default().join(path))
    }

    /// Returns an error that points to the value at a dotted path of the world file.
    pub fn fault(&self, path: &str, message: impl Into<String>) -> SpecError {
        SpecError::of(Problem::new(self.tree.place_of(path), message), &self.label)
    }

    /// Returns the parts of the world file that define the content of its datasets, besides the model and the settings.
    ///
    /// Factors are left out: the settings describe those that a spec turns on, and the others change nothing.
    pub fn identity(&self) -> Json {
        let file = WorldFile { description: String::new(), factors: Ordered::default(), ..self.file.clone() };
        let mut identity = serde_json::to_value(&file).expect("a world file is plain data");
        // Keys are sorted before they are hashed, but the samples depend on the order of these.
        if self.folder.is_some() {
            if !file.placement.is_empty() {
                // Bodies were placed by another rule before, which held for boxes on a floor at z = 0 only.
                identity["placement_rule"] = 2.into();
            }
            let classes = file.modalities.iter().map(|(_, sensing)| sensing.classes.names());
            let classes: Vec<Vec<&str>> = classes.filter(|classes| !classes.is_empty()).collect();
            if !classes.is_empty() {
                identity["classes"] = serde_json::json!(classes);
            }
            identity["order"] = serde_json::json!({
                "actuators": file.action.actuators.names(),
                "placement": file.placement.names(),
                "regions": file.regions.names(),
            });
        }
        identity
    }

    /// Returns the names and definitions of the factors of variation that a spec turns on, in the file's order.
    pub fn factors<'a>(&'a self, spec: &'a Simulation) -> impl Iterator<Item = (&'a str, &'a Factor)> {
        self.file.factors.iter().filter(|(name, _)| spec.factors.iter().any(|on| on == name))
    }

    /// Returns the modalities that a spec can name.
    pub fn modalities(&self) -> impl Iterator<Item = Modality> {
        self.file.modalities.iter().filter_map(|(name, _)| Modality::new(name))
    }

    /// Returns the regions of the world's images.
    pub fn regions(&self) -> Vec<Region> {
        let region = |(name, colors): (&str, &Colors)| Region {
            name: name.to_owned(),
            red_minus_blue: colors.red_minus_blue.map(|bound| bound as f32),
        };
        self.file.regions.iter().map(region).collect()
    }

    /// Returns what is known about a modality while these factors are on.
    pub(super) fn known(&self, modality: Modality, factors: &[String]) -> Option<Known> {
        let sensing = self.sensing(modality)?;
        let size = match sensing.source() {
            Source::DifferenceOf(of) => self.sensing(of)?.size,
            _ => sensing.size,
        };
        Some(Known { size, scaling: self.scaling(modality, factors)? })
    }

    fn sensing(&self, modality: Modality) -> Option<&Sensing> {
        self.file.modalities.iter().find(|(name, _)| *name == modality.name()).map(|(_, sensing)| sensing)
    }

    /// Returns the default scaling of a modality while these factors are on; `None` if the world has no such modality.
    pub fn scaling(&self, modality: Modality, factors: &[String]) -> Option<Scaling> {
        let sensing = self.sensing(modality)?;
        let default = match sensing.source() {
            // Noise can make a recorded force negative.
            Source::NormalForce { .. } => {
                Scaling { scale: Scale::Shared, minimum: (!self.is_noisy(modality, factors)).then_some(0.0) }
            }
            Source::ContactNormal(_) => Scaling::plain(true),
            Source::DifferenceOf(of) => Scaling::plain(self.sensing(of)?.is_image()),
            _ => Scaling::plain(sensing.is_image()),
        };
        Some(Scaling {
            scale: sensing.scale.unwrap_or(default.scale),
            minimum: sensing.minimum.unwrap_or(default.minimum),
        })
    }

    /// Whether one of these factors adds noise to a modality.
    pub fn is_noisy(&self, modality: Modality, factors: &[String]) -> bool {
        self.file.factors.iter().any(|(name, factor)| {
            let is_of = |pattern| matching(std::slice::from_ref(pattern), &[modality.name()]).is_ok();
            factors.iter().any(|on| on == name) && factor.sensor_noise.iter().flatten().any(is_of)
        })
    }

    /// Returns the world's settings that a spec can change under `simulation`, with their default values.
    pub fn settings(&self) -> Vec<(String, Setting)> {
        let ranges = self.file.action.actuators.iter();
        let ranges =
            ranges.map(|(name, actuator)| (range_setting(name, actuator), Setting::Range(actuator.range)));
        let clearances = self.file.placement.iter();
        let clearances =
            clearances.map(|(name, placing)| (clearance_setting(name), Setting::Number(placing.clearance_m)));
        ranges.chain(clearances).collect()
    }

    /// Returns `given` with the world's default for each missing setting, and without the settings and factors that the
    /// world does not have.
    pub fn complete(&self, given: &Simulation) -> Simulation {
        let settings = self.settings().into_iter().map(|(name, own)| {
            let value = given.world.get(&name).copied().unwrap_or(own);
            (name, value)
        });
        let mut factors: Vec<String> = self.factors(given).map(|(name, _)| name.to_owned()).collect();
        factors.sort();
        Simulation { world: settings.collect(), factors, ..given.clone() }
    }

    /// Returns the world's default settings.
    pub fn simulation(&self) -> Simulation {
        self.complete(&Simulation {
            sample_rate_hz: self.file.sample_rate_hz,
            actuation_seconds: self.file.action.seconds,
            ..Simulation::default()
        })
    }

    /// Checks the sample rate and the duration of a move that the file sets, which apply unless a spec sets others.
    ///
    /// # Errors
    /// When a spec that leaves them out can't be run.
    pub fn check_rates(&self) -> Result<(), SpecError> {
        self.check_sample_rate()?;
        let WorldFile { sample_rate_hz: rate, action, .. } = &self.file;
        simulation::actuation(action.seconds, *rate).map_err(|message| self.fault("action.seconds", message))
    }

    /// Checks the sample rate that the file sets.
    pub(super) fn check_sample_rate(&self) -> Result<(), SpecError> {
        let WorldFile { sample_rate_hz: rate, step_rate_hz: steps, .. } = self.file;
        simulation::sample_rate(rate, steps).map_err(|message| {
            let multiple = rate * (steps / rate).round().max(1.0);
            self.fault("sample_rate_hz", format!("{message}, or set step_rate_hz to {multiple}"))
        })
    }

    /// Refuses a value that the world's setting can't have. The error is the message.
    pub(super) fn check_setting(&self, name: &str, value: &Setting) -> Result<(), String> {
        let own = self.settings().into_iter().find(|(own, _)| own == name).map(|(_, own)| own);
        match (own, value) {
            (Some(Setting::Range(_)), Setting::Range(range)) => ascending(*range),
            (Some(Setting::Range(_)), Setting::Number(_)) => {
                Err(format!("'simulation.{name}': expected a list of 2 items, each a finite number"))
            }
            (Some(Setting::Number(_)), Setting::Range(_)) => {
                Err(format!("'simulation.{name}': expected a finite number"))
            }
            _ => Ok(()),
        }
    }
}

/// Refuses a unit that would divide the lines of tables.
pub(super) fn one_line(unit: &str) -> Result<(), &'static str> {
    if unit.chars().any(char::is_control) { Err("a unit has no line breaks or tabs") } else { Ok(()) }
}

/// Returns the name of the setting for the range of an element of the action: `lift_range_m`.
pub fn range_setting(name: &str, actuator: &Actuator) -> String {
    let unit: String = actuator.unit.chars().filter(char::is_ascii_alphanumeric).collect();
    if unit.is_empty() { format!("{name}_range") } else { format!("{name}_range_{}", unit.to_lowercase()) }
}

/// Returns the name of the setting for the smallest distance between placed bodies: `box_clearance_m`.
pub fn clearance_setting(name: &str) -> String {
    format!("{name}_clearance_m")
}

/// Checks the rules for a world file that the schema can't express. An error has the path at fault and the message.
fn check(file: &WorldFile) -> Result<(), (String, String)> {
    if file.modalities.is_empty() {
        return Err(("modalities".into(), "a world without modalities records nothing".into()));
    }
    for (name, sensing) in file.modalities.iter() {
        let at = |key: &str| format!("modalities.{name}.{key}");
        modality(file, name, sensing).map_err(|(key, message)| {
            (if key.is_empty() { format!("modalities.{name}") } else { at(key) }, message)
        })?;
    }
    if file.action.course.is_some() && !file.action.motion.is_default() {
        return Err((
            "action.motion".into(),
            "a recorded course replaces the motion; leave one of them out".into(),
        ));
    }
    probe(file).map_err(|(key, message)| (format!("action.{key}"), message.to_owned()))?;
    if file.action.actuators.is_empty() {
        return Err(("action.actuators".into(), "a world without actuators has no action".into()));
    }
    for (name, actuator) in file.action.actuators.iter() {
        named("an element of the action", name)
            .map_err(|message| (format!("action.actuators.{name}"), message))?;
        actuator.check().map_err(|message| (format!("action.actuators.{name}"), message.into()))?;
        ascending(actuator.range).map_err(|message| (format!("action.actuators.{name}.range"), message))?;
        one_line(&actuator.unit)
            .map_err(|message| (format!("action.actuators.{name}.unit"), message.into()))?;
    }
    for (name, placing) in file.placement.iter() {
        let at = |key: &str| format!("placement.{name}{key}");
        named("a placement", name).map_err(|message| (at(""), message))?;
        match (&placing.sector, &placing.rectangle) {
            (Some(sector), None) => {
                for (key, element) in [("rotation", &sector.rotation), ("extension", &sector.extension)] {
                    let all: Vec<&str> = file.action.actuators.iter().map(|(name, _)| name).collect();
                    if !all.contains(&element.as_str()) {
                        let message = unknown("element of the action", element, "", &all, str::to_owned);
                        return Err((at(&format!(".sector.{key}")), message));
                    }
                }
            }
            (None, Some(ranges)) => {
                ranges.iter().try_for_each(|range| ascending(*range)).map_err(|m| (at(".rectangle"), m))?;
            }
            _ => return Err((at(""), "give one of sector and rectangle".into())),
        }
    }
    for (name, factor) in file.factors.iter() {
        let at = |key: &str| {
            if key.is_empty() { format!("factors.{name}") } else { format!("factors.{name}.{key}") }
        };
        named("a factor", name).map_err(|message| (at(""), message))?;
        factor.check().map_err(|(key, message)| (at(&key), message))?;
    }
    for (name, colors) in file.regions.iter() {
        named("a region", name).map_err(|message| (format!("regions.{name}"), message))?;
        ascending(colors.red_minus_blue).map_err(|m| (format!("regions.{name}.red_minus_blue"), m))?;
    }
    Ok(())
}

/// Checks that a probing motion can feel something.
fn probe(file: &WorldFile) -> Result<(), (&'static str, &'static str)> {
    let is_probing = file.action.motion == Motion::Probing;
    if file.action.probe_force_n.is_some() && !is_probing {
        return Err(("probe_force_n", "only the motion 'probing' has a 'probe_force_n'"));
    }
    if is_probing && !file.modalities.iter().any(|(_, sensing)| sensing.normal_force.is_some()) {
        return Err(("motion", "a probing motion needs a touch: add a modality with a 'normal_force'"));
    }
    Ok(())
}

fn modality<'a>(file: &WorldFile, name: &str, sensing: &Sensing) -> Result<(), (&'a str, String)> {
    named("a modality", name).map_err(|message| ("", message))?;
    if Modality::RESERVED.contains(&name) {
        return Err((
            "",
            format!("'{name}' means something else in the tables; give the modality another name"),
        ));
    }
    let sources = sensing.sources().count();
    if sources != 1 {
        let found = if sources == 0 { "none" } else { "several" };
        return Err(("", format!("a modality has exactly one of {}; found {found}", Sensing::SOURCES)));
    }
    let misplaced = |key, of: &str| Err((key, format!("only {of} has '{key}'")));
    let is_camera = sensing.is_image();
    if is_camera && sensing.size.is_none() {
        return Err(("", "a camera's image needs its size: rows and columns, as [96, 96]".into()));
    }
    if !is_camera && sensing.size.is_some() {
        return misplaced("size", "a camera, an optical_flow, a depth or a segmentation");
    }
    if sensing.limit_pixels.is_some() && sensing.optical_flow.is_none() {
        return misplaced("limit_pixels", "an optical_flow");
    }
    match (&sensing.depth, sensing.range_m) {
        (Some(_), None) => return Err(("", "a depth needs the range_m that it encodes, as [0.1, 2]".into())),
        (None, Some(_)) => return misplaced("range_m", "a depth"),
        (Some(_), Some([low, high])) if low >= high => {
            return Err((
                "range_m",
                format!("the lower end must be below the upper end; found {low} and {high}"),
            ));
        }
        _ => {}
    }
    classes(sensing).map_err(|message| ("classes", message))?;
    if sensing.average_over.is_some() && sensing.normal_force.is_none() {
        return misplaced("average_over", "a normal_force");
    }
    if !sensing.contact_kinds.is_empty() {
        contact_kinds(file, name, sensing).map_err(|message| ("contact_kinds", message))?;
    }
    if sensing.unit.is_some() && sensing.sensor.is_none() {
        return misplaced("unit", "a sensor");
    }
    one_line(sensing.unit.as_deref().unwrap_or_default()).map_err(|message| ("unit", message.into()))?;
    let is_given = [
        ("scale", sensing.scale.is_some()),
        ("minimum", sensing.minimum.flatten().is_some()),
        ("percentage", sensing.percentage.is_some()),
    ];
    if let Some((key, _)) = is_given.into_iter().find(|(_, is)| *is && sensing.contact_normal.is_some()) {
        return Err((
            key,
            "only the direction of a contact_normal is learned and judged; leave this out".into(),
        ));
    }
    let is_pose = matches!(sensing.source(), Source::Pose { .. });
    for (key, is_given) in [("relative_to", sensing.relative_to.is_some()), ("set", sensing.set)] {
        if is_given && !is_pose {
            return misplaced(key, "a pose of bodies or sites");
        }
    }
    if let Some(of) = &sensing.difference_of {
        let sources: Vec<&str> =
            file.modalities.iter().filter(|(_, s)| s.difference_of.is_none()).map(|(n, _)| n).collect();
        if !sources.contains(&of.as_str()) {
            return Err(("difference_of", unknown("modality", of, "", &sources, str::to_owned)));
        }
    }
    let source =
        sensing.difference_of.as_ref().and_then(|of| file.modalities.iter().find(|(name, _)| name == of));
    let is_image = is_camera || source.is_some_and(|(_, source)| source.is_image());
    if is_image && !sensing.groups.is_empty() {
        return Err(("groups", "an image has no groups; 'regions' tell its parts apart".into()));
    }
    if is_image && sensing.scale == Some(Scale::PerElement) {
        return Err(("scale", "the values of an image share one standard deviation; use shared".into()));
    }
    if is_image && sensing.percentage.is_some() {
        return Err(("percentage", "errors of images are not given in percent".into()));
    }
    Ok(())
}

/// Checks the classes of a segmentation.
fn classes(sensing: &Sensing) -> Result<(), String> {
    let names = sensing.classes.names();
    match (&sensing.segmentation, names.len()) {
        (None, 0) => {}
        (None, _) => return Err("only a segmentation has 'classes'".into()),
        (Some(_), 0) => return Err("a segmentation needs classes, as {hand: hand_*, box: box_*}".into()),
        (Some(_), count) if count > CLASS_COLORS.len() => {
            return Err(format!("an image can encode {} classes; found {count}", CLASS_COLORS.len()));
        }
        _ => {}
    }
    names.into_iter().try_for_each(|name| named("a class", name))
}

/// Checks the kinds of contact of a force, whose values are recorded as a modality.
fn contact_kinds(file: &WorldFile, name: &str, sensing: &Sensing) -> Result<(), String> {
    if sensing.normal_force.is_none() {
        return Err("only a normal_force has 'contact_kinds'".into());
    }
    for (kind, _) in sensing.contact_kinds.iter() {
        named("a kind of contact", kind)?;
        if kind == NO_CONTACT {
            return Err(format!("'{NO_CONTACT}' means no contact; give this kind another name"));
        }
        if CONTACT_PARTS.contains(&kind) {
            return Err(format!("metrics call a phase of contacts '{kind}'; give this kind another name"));
        }
    }
    let recorded = format!("{name}{CONTACT_KIND}");
    named("the modality that records the kinds", &recorded)?;
    match file.modalities.iter().any(|(other, _)| other == recorded) {
        true => Err(format!(
            "the kinds are recorded as '{recorded}'; give the modality '{recorded}' another name"
        )),
        false => Ok(()),
    }
}

fn named(what: &str, name: &str) -> Result<(), String> {
    if is_name(name) {
        return Ok(());
    }
    let name = shorten(name);
    Err(format!(
        "'{name}' can't name {what}; use lower-case letters, digits and '_', a letter first ({NAME})"
    ))
}
