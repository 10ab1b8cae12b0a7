//! The units of sensors.

use mujoco_rs::prelude::*;

/// A length or an angle that a joint, a tendon or an actuator changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Measure {
    Length,
    Angle,
    /// Different ones, or one that the model does not tell.
    Unknown,
}

impl Measure {
    /// Returns the units of the position, the velocity and the force.
    fn units(self) -> [&'static str; 3] {
        match self {
            Self::Length => ["m", "m/s", "N"],
            Self::Angle => ["rad", "rad/s", "N m"],
            Self::Unknown => ["", "", ""],
        }
    }
}

fn of_joint(model: &MjModel, joint: usize) -> Measure {
    match model.jnt_type()[joint] {
        MjtJoint::mjJNT_HINGE | MjtJoint::mjJNT_BALL => Measure::Angle,
        MjtJoint::mjJNT_SLIDE => Measure::Length,
        MjtJoint::mjJNT_FREE => Measure::Unknown,
    }
}

/// A tendon that passes sites and geoms has a length. The length of a fixed one is a sum of positions of joints.
fn of_tendon(model: &MjModel, tendon: usize) -> Measure {
    let first = model.tendon_adr()[tendon] as usize;
    let mut parts =
        (first..first + model.tendon_num()[tendon] as usize).map(|part| match model.wrap_type()[part] {
            MjtWrap::mjWRAP_JOINT => of_joint(model, model.wrap_objid()[part] as usize),
            _ => Measure::Length,
        });
    let measure = parts.next().unwrap_or(Measure::Unknown);
    if parts.all(|part| part == measure) { measure } else { Measure::Unknown }
}

fn of_actuator(model: &MjModel, actuator: usize) -> Measure {
    let target = model.actuator_trnid()[actuator][0] as usize;
    match model.actuator_trntype()[actuator] {
        MjtTrn::mjTRN_JOINT | MjtTrn::mjTRN_JOINTINPARENT => of_joint(model, target),
        MjtTrn::mjTRN_TENDON => of_tendon(model, target),
        MjtTrn::mjTRN_SLIDERCRANK => Measure::Length,
        _ => Measure::Unknown,
    }
}

/// Returns the unit of a sensor's values; empty if they have several or none that is known.
pub(super) fn unit_of_sensor(model: &MjModel, sensor: usize) -> &'static str {
    use mujoco_rs::mujoco_c::mjtSensor::*;
    let of = model.sensor_objid()[sensor] as usize;
    let [position, velocity, force] = match model.sensor_type()[sensor] {
        mjSENS_JOINTPOS | mjSENS_JOINTVEL | mjSENS_JOINTACTFRC | mjSENS_JOINTLIMITPOS
        | mjSENS_JOINTLIMITVEL | mjSENS_JOINTLIMITFRC => of_joint(model, of).units(),
        mjSENS_TENDONPOS
        | mjSENS_TENDONVEL
        | mjSENS_TENDONACTFRC
        | mjSENS_TENDONLIMITPOS
        | mjSENS_TENDONLIMITVEL
        | mjSENS_TENDONLIMITFRC => of_tendon(model, of).units(),
        mjSENS_ACTUATORPOS | mjSENS_ACTUATORVEL | mjSENS_ACTUATORFRC => of_actuator(model, of).units(),
        _ => Measure::Unknown.units(),
    };
    match model.sensor_type()[sensor] {
        mjSENS_JOINTPOS
        | mjSENS_JOINTLIMITPOS
        | mjSENS_TENDONPOS
        | mjSENS_TENDONLIMITPOS
        | mjSENS_ACTUATORPOS => position,
        mjSENS_JOINTVEL
        | mjSENS_JOINTLIMITVEL
        | mjSENS_TENDONVEL
        | mjSENS_TENDONLIMITVEL
        | mjSENS_ACTUATORVEL => velocity,
        mjSENS_JOINTACTFRC
        | mjSENS_JOINTLIMITFRC
        | mjSENS_TENDONACTFRC
        | mjSENS_TENDONLIMITFRC
        | mjSENS_ACTUATORFRC => force,
        mjSENS_TOUCH | mjSENS_FORCE => "N",
        mjSENS_TORQUE => "N m",
        mjSENS_ACCELEROMETER | mjSENS_FRAMELINACC => "m/s^2",
        mjSENS_VELOCIMETER | mjSENS_FRAMELINVEL | mjSENS_SUBTREELINVEL => "m/s",
        mjSENS_GYRO | mjSENS_FRAMEANGVEL | mjSENS_BALLANGVEL => "rad/s",
        mjSENS_FRAMEANGACC => "rad/s^2",
        mjSENS_FRAMEPOS | mjSENS_SUBTREECOM | mjSENS_GEOMDIST | mjSENS_GEOMFROMTO => "m",
        // With other data than the distance, it has more values than one.
        mjSENS_RANGEFINDER if model.sensor_dim()[sensor] == 1 => "m",
        mjSENS_FRAMEQUAT | mjSENS_BALLQUAT | mjSENS_FRAMEXAXIS | mjSENS_FRAMEYAXIS | mjSENS_FRAMEZAXIS
        | mjSENS_GEOMNORMAL | mjSENS_INSIDESITE => "1",
        mjSENS_SUBTREEANGMOM => "kg m^2/s",
        mjSENS_CAMPROJECTION => "pixels",
        mjSENS_E_POTENTIAL | mjSENS_E_KINETIC => "J",
        mjSENS_CLOCK => "s",
        _ => "",
    }
}
