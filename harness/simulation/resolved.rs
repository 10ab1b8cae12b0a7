//! A world file with its names resolved in its MuJoCo model.

use super::settled::Settling;
use super::standing::FreeBody;
use harness_spec::{Drawing, Element, Layout, Modality, Posed, Property};
use std::sync::Arc;

/// A world file with its names resolved in the model.
#[derive(Debug)]
pub(super) struct Resolved {
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
