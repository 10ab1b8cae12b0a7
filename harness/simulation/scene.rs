//! A scene: the compiled MuJoCo model of a scenario, with every name the harness needs resolved once.

use super::{MUJOCO_VERSION, SimulationError, mujoco_version};
use crate::spec::{ARM_JOINTS, JOINTS, Scenario};
use mujoco_rs::prelude::*;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Once, OnceLock};

/// Movable boxes of the cluttered scenario.
pub const BOXES: usize = 8;

/// Joints and actuators of the arm, in the order of the `arm` modality.
const ARM_NAMES: [&str; ARM_JOINTS] = ["arm_rotation", "arm_lift", "arm_extension"];

/// A scenario's compiled model, shared by every thread that simulates it.
#[derive(Debug)]
pub struct Scene {
    /// Where the model came from, for messages.
    pub(super) name: String,
    scenario: Scenario,
    xml: String,
    pub(super) model: MjModel,
    /// Index into `qpos` of each finger joint, base to tip.
    pub(super) finger_qpos: [usize; JOINTS],
    pub(super) arm: [ArmJoint; ARM_JOINTS],
    /// For each geom, the finger link it belongs to.
    pub(super) link_of_geom: Vec<Option<usize>>,
    /// Radius of the finger's first link, m.
    pub(super) finger_radius: f64,
    pub(super) mount: Mount,
    pub(super) boxes: Vec<FreeBox>,
    pub(super) camera: usize,
    /// Body and geom of the finger's last link.
    pub(super) tip: Tip,
}

/// The finger's last link.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tip {
    /// Its body, whose origin is its joint.
    pub body: usize,
    /// Its capsule, whose middle is half-way from the joint to the fingertip.
    pub geom: usize,
}

/// A driven joint of the arm.
#[derive(Debug, Clone, Copy)]
pub(super) struct ArmJoint {
    pub qpos: usize,
    pub actuator: usize,
    /// Positions that the joint's and the actuator's limits allow, rad or m.
    pub limits: [f64; 2],
}

/// Where the finger hangs: at the bearing `bearing + rotation` and the distance `radius + extension` from
/// the arm's vertical axis.
#[derive(Debug, Clone, Copy)]
pub(super) struct Mount {
    /// The axis on the ground, m.
    pub axis: [f64; 2],
    /// Distance with the extension at 0, m.
    pub radius: f64,
    /// Bearing with the rotation at 0, rad.
    pub bearing: f64,
}

/// A box with a free joint.
#[derive(Debug, Clone, Copy)]
pub(super) struct FreeBox {
    /// Index into `qpos` of its position (3 values) and orientation (4).
    pub qpos: usize,
    /// Half of its sides, m.
    pub half_size: [f64; 3],
}

impl Mount {
    /// The point of the ground plane under the finger, m.
    pub fn below_finger(&self, rotation: f64, extension: f64) -> [f64; 2] {
        let (sin, cos) = (self.bearing + rotation).sin_cos();
        let radius = self.radius + extension;
        [self.axis[0] + radius * cos, self.axis[1] + radius * sin]
    }
}

impl Scene {
    /// Compiles the scenario's built-in model, or `<models>/<scenario>.xml`.
    ///
    /// The file must stand alone (no `include`, no asset files), so that its text identifies the model.
    ///
    /// # Errors
    /// When the linked MuJoCo is another version, the file cannot be read or compiled, or it lacks a name or
    /// a property that the harness relies on.
    pub fn load(scenario: Scenario, models: Option<&Path>) -> Result<Self, SimulationError> {
        let file = format!("{}.xml", scenario.name());
        let Some(folder) = models else {
            return Self::from_xml(scenario, builtin_xml(scenario), format!("the built-in models/{file}"));
        };
        let path = folder.join(file);
        let xml = std::fs::read_to_string(&path)
            .map_err(|source| SimulationError::Read { path: path.clone(), source })?;
        Self::from_xml(scenario, &xml, path.display().to_string())
    }

    /// Compiles MJCF text; `name` says in messages where it came from.
    ///
    /// # Errors
    /// As [`Scene::load`], except for reading.
    pub fn from_xml(scenario: Scenario, xml: &str, name: String) -> Result<Self, SimulationError> {
        require_mujoco_version()?;
        silence_mujoco_warnings();
        let model = MjModel::from_xml_string(xml).map_err(|error| compile_error(&name, error))?;
        let names = Names { scene: &name, model: &model };
        let mut link_of_geom = vec![None; model.ngeom() as usize];
        for link in 0..JOINTS {
            link_of_geom[names.geom(&format!("finger_link_{link:02}"))?] = Some(link);
        }
        names.geom("ground")?;
        let finger_qpos = try_array(|joint| names.joint(&format!("finger_joint_{joint:02}"), HINGE))?;
        let arm = try_array(|joint| names.arm_joint(ARM_NAMES[joint]))?;
        let mount = names.mount(&arm)?;
        let boxes = (0..box_count(scenario)).map(|index| names.free_box(index)).collect::<Result<_, _>>()?;
        let finger_radius = model.geom_size()[names.geom("finger_link_00")?][0];
        let camera = names.id(MjtObjBase::mjOBJ_CAMERA, "camera", "external")?;
        let last = format!("finger_link_{:02}", JOINTS - 1);
        let tip = Tip { body: names.id(MjtObjBase::mjOBJ_BODY, "body", &last)?, geom: names.geom(&last)? };
        let xml = xml.to_owned();
        Ok(Self {
            name,
            scenario,
            xml,
            model,
            finger_qpos,
            arm,
            link_of_geom,
            finger_radius,
            mount,
            boxes,
            camera,
            tip,
        })
    }

    /// The scenario's built-in model, compiled once a process and kept.
    ///
    /// # Errors
    /// When the linked MuJoCo is another version.
    pub fn builtin(scenario: Scenario) -> Result<&'static Self, SimulationError> {
        static SCENES: [OnceLock<Scene>; Scenario::ALL.len()] =
            [const { OnceLock::new() }; Scenario::ALL.len()];
        let scene = &SCENES[scenario as usize];
        match scene.get() {
            Some(scene) => Ok(scene),
            // Two threads may both compile it; the first one's is kept.
            None => Self::load(scenario, None).map(|compiled| scene.get_or_init(|| compiled)),
        }
    }

    /// The scenario it is the model of.
    pub fn scenario(&self) -> Scenario {
        self.scenario
    }

    /// The MJCF text, which decides the content of a dataset.
    pub fn xml(&self) -> &str {
        &self.xml
    }

    /// Duration of a simulation step, s.
    pub fn step_s(&self) -> f64 {
        self.model.opt().timestep
    }

    /// The generalised positions of the scene at rest.
    pub fn rest(&self) -> &[f64] {
        self.model.qpos0()
    }

    /// The index of a named thing; `word` says in messages what kind it is.
    pub(super) fn id(
        &self,
        kind: MjtObjBase,
        word: &'static str,
        name: &str,
    ) -> Result<usize, SimulationError> {
        Names { scene: &self.name, model: &self.model }.id(kind, word, name)
    }

    /// The compiled model.
    pub fn model(&self) -> &MjModel {
        &self.model
    }
}

fn builtin_xml(scenario: Scenario) -> &'static str {
    match scenario {
        Scenario::Empty => include_str!("../../models/empty.xml"),
        Scenario::Cluttered => include_str!("../../models/cluttered.xml"),
    }
}

fn box_count(scenario: Scenario) -> usize {
    match scenario {
        Scenario::Empty => 0,
        Scenario::Cluttered => BOXES,
    }
}

const HINGE: MjtJoint = MjtJoint::mjJNT_HINGE;
const SLIDE: MjtJoint = MjtJoint::mjJNT_SLIDE;
const FREE: MjtJoint = MjtJoint::mjJNT_FREE;

/// Looks names up in a model, with errors that say what is missing where.
struct Names<'a> {
    scene: &'a str,
    model: &'a MjModel,
}

impl Names<'_> {
    fn id(&self, kind: MjtObjBase, word: &'static str, name: &str) -> Result<usize, SimulationError> {
        self.model.name_to_id(kind, name).ok_or_else(|| SimulationError::Missing {
            scene: self.scene.to_owned(),
            kind: word,
            name: name.to_owned(),
        })
    }

    fn geom(&self, name: &str) -> Result<usize, SimulationError> {
        self.id(MjtObjBase::mjOBJ_GEOM, "geom", name)
    }

    fn unsuitable(&self, problem: String) -> SimulationError {
        SimulationError::Unsuitable { scene: self.scene.to_owned(), problem }
    }

    /// Index into `qpos` of a joint of the given type.
    fn joint(&self, name: &str, kind: MjtJoint) -> Result<usize, SimulationError> {
        let id = self.id(MjtObjBase::mjOBJ_JOINT, "joint", name)?;
        let found = self.model.jnt_type()[id];
        if found != kind {
            return Err(self.unsuitable(format!("joint `{name}` is {found:?}, must be {kind:?}")));
        }
        Ok(self.model.jnt_qposadr()[id] as usize)
    }

    fn arm_joint(&self, name: &str) -> Result<ArmJoint, SimulationError> {
        let kind = if name == ARM_NAMES[0] { HINGE } else { SLIDE };
        let qpos = self.joint(name, kind)?;
        let joint = self.id(MjtObjBase::mjOBJ_JOINT, "joint", name)?;
        let actuator = self.id(MjtObjBase::mjOBJ_ACTUATOR, "actuator", name)?;
        if self.model.actuator_trnid()[actuator][0] as usize != joint {
            return Err(self.unsuitable(format!("actuator `{name}` does not drive the joint of that name")));
        }
        let mut limits = [f64::NEG_INFINITY, f64::INFINITY];
        let joint_range = self.model.jnt_limited()[joint].then(|| self.model.jnt_range()[joint]);
        let ctrl_range =
            self.model.actuator_ctrllimited()[actuator].then(|| self.model.actuator_ctrlrange()[actuator]);
        for [low, high] in [joint_range, ctrl_range].into_iter().flatten() {
            limits = [limits[0].max(low), limits[1].min(high)];
        }
        Ok(ArmJoint { qpos, actuator, limits })
    }

    /// Reads the finger's place off the kinematics, and checks that the arm moves it on a vertical cylinder.
    fn mount(&self, arm: &[ArmJoint; ARM_JOINTS]) -> Result<Mount, SimulationError> {
        let finger = self.id(MjtObjBase::mjOBJ_BODY, "body", "finger_link_00")?;
        let rotation = self.id(MjtObjBase::mjOBJ_JOINT, "joint", ARM_NAMES[0])?;
        let mut data = MjData::new(self.model);
        let mut finger_at = |pose: [f64; ARM_JOINTS]| {
            for (joint, value) in arm.iter().zip(pose) {
                data.qpos_mut()[joint.qpos] = value;
            }
            data.kinematics();
            (data.xpos()[finger], data.xanchor()[rotation])
        };
        let ([x, y, _], axis) = finger_at([0.0; ARM_JOINTS]);
        let (dx, dy) = (x - axis[0], y - axis[1]);
        let mount = Mount { axis: [axis[0], axis[1]], radius: dx.hypot(dy), bearing: dy.atan2(dx) };
        let (found, _) = finger_at([0.5, 0.0, 0.25]);
        let expected = mount.below_finger(0.5, 0.25);
        if (found[0] - expected[0]).hypot(found[1] - expected[1]) > 1e-6 {
            return Err(self.unsuitable(
                "the arm must turn the finger about a vertical axis, counter-clockwise from above, and extend \
                 away from that axis"
                    .to_owned(),
            ));
        }
        Ok(mount)
    }

    fn free_box(&self, index: usize) -> Result<FreeBox, SimulationError> {
        let name = format!("box_{index}");
        let geom = self.geom(&name)?;
        if self.model.geom_type()[geom] != MjtGeomBase::mjGEOM_BOX {
            return Err(self.unsuitable(format!("geom `{name}` must be a box")));
        }
        let body = self.id(MjtObjBase::mjOBJ_BODY, "body", &name)?;
        let joint = self.model.body_jntadr()[body];
        if joint < 0 || self.model.jnt_type()[joint as usize] != FREE {
            return Err(self.unsuitable(format!("body `{name}` must have a free joint")));
        }
        let qpos = self.model.jnt_qposadr()[joint as usize] as usize;
        Ok(FreeBox { qpos, half_size: self.model.geom_size()[geom] })
    }
}

fn try_array<T, const N: usize>(
    mut item: impl FnMut(usize) -> Result<T, SimulationError>,
) -> Result<[T; N], SimulationError> {
    let items = (0..N).map(&mut item).collect::<Result<Vec<_>, _>>()?;
    Ok(items.try_into().unwrap_or_else(|_| unreachable!("N items were collected")))
}

fn compile_error(scene: &str, error: MjModelError) -> SimulationError {
    let message = match error {
        // MuJoCo puts the element and its line below what is wrong with it.
        MjModelError::LoadFailed(message) => message.trim().replace('\n', "; "),
        other => other.to_string(),
    };
    SimulationError::Compile { scene: scene.to_owned(), message }
}

fn require_mujoco_version() -> Result<(), SimulationError> {
    match mujoco_version() {
        MUJOCO_VERSION => Ok(()),
        found => Err(SimulationError::Version { found: found.to_owned() }),
    }
}

/// Sends MuJoCo's messages nowhere but for fatal ones: warnings are counted in the state and reported as
/// errors, so neither the console nor a `MUJOCO_LOG.TXT` in the working folder needs them.
fn silence_mujoco_warnings() {
    static SILENCED: Once = Once::new();
    // SAFETY: every use of MuJoCo in this program starts with a scene, and `Once` holds back other threads.
    SILENCED.call_once(|| unsafe { set_log_handler(print_fatal) });
}

/// MuJoCo ends the process after an error: the reason has no other way out.
fn print_fatal(message: &MjLogMessage) {
    if message.level() == MjtLogLevel::mjLOG_ERROR {
        // A panic would hide it where the standard error is full.
        let _ = writeln!(io::stderr(), "MuJoCo stops the program: {}", message.subject());
    }
}
