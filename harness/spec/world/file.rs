//! The content of a world file.

use crate::factor::Factor;
use crate::layout::{Modality, Percentage, Scale, present};
use crate::values::globs;
use crate::yaml::allow_single_values;
use schemars::JsonSchema;
use serde::de::{Deserializer, MapAccess, Visitor};
use serde::ser::{SerializeMap, Serializer};
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;
use std::collections::BTreeMap;
use std::fmt;
use std::marker::PhantomData;
use std::sync::LazyLock;

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
    pub(super) fn names(&self) -> Vec<&str> {
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
    pub(super) fn is_default(&self) -> bool {
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
    pub(super) fn check(&self) -> Result<(), &'static str> {
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
pub(super) static SCHEMA: LazyLock<Json> = LazyLock::new(|| schemars::schema_for!(WorldFile).to_value());

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
    pub(super) const SOURCES: &str = "joint_positions, joint_velocities, body_positions, body_orientations, site_positions, \
                           site_orientations, normal_force, contact_normal, sensor, camera, optical_flow, depth, \
                           segmentation, difference_of";

    /// Returns what the values are read from. The file must have passed the checks.
    pub fn source(&self) -> Source<'_> {
        self.sources().next().unwrap_or(Source::Sensor(&[]))
    }

    pub(super) fn sources<'a>(&'a self) -> impl Iterator<Item = Source<'a>> {
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
    pub(super) fn is_image(&self) -> bool {
        [&self.camera, &self.optical_flow, &self.depth, &self.segmentation].iter().any(|key| key.is_some())
    }
}
