//! The controls of actuators. Most actuators have one, some have several, and a few none, so the number of an actuator
//! is not the index of its control.

use super::joints::is_single;
use mujoco_rs::mujoco_c::mjtCtrlInput;
use mujoco_rs::prelude::*;

/// A control of an actuator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Control {
    pub actuator: usize,
    /// Its place among the controls of the actuator.
    place: usize,
}

impl Control {
    /// Returns the controls of an actuator, in the model's order.
    pub fn all_of(model: &MjModel, actuator: usize) -> impl Iterator<Item = Self> + use<> {
        let count = model.actuator_ctrlnum()[actuator] as usize;
        (0..count).map(move |place| Self { actuator, place })
    }

    /// Returns its index among the controls of the model.
    pub fn index(self, model: &MjModel) -> usize {
        model.actuator_ctrladr()[self.actuator] as usize + self.place
    }

    /// Returns MuJoCo's name of it, such as `pos`; `None` if it has none.
    pub fn name(self, model: &MjModel) -> Option<&'static str> {
        model.actuator_input_name(self.actuator, self.place)
    }

    /// Returns the hinge or slide whose position it is.
    pub fn servo(self, model: &MjModel) -> Option<usize> {
        let output = model.actuator_outadr()[self.actuator] as usize;
        let is_servo = self.place == 0
            && model.actuator_trntype()[self.actuator] == MjtTrn::mjTRN_JOINT
            && model.actuator_gear()[output][0] == 1.0
            && is_position(model, self.actuator);
        let joint = usize::try_from(model.actuator_trnid()[self.actuator][0]).ok().filter(|_| is_servo)?;
        is_single(model, joint).then_some(joint)
    }

    /// Returns the lowest and the highest setpoint that the actuator and, of a position servo, its joint allow.
    /// Infinite without a limit.
    pub fn limits(self, model: &MjModel) -> [f64; 2] {
        let (joint, index) =
            (self.servo(model).filter(|joint| model.jnt_limited()[*joint]), self.index(model));
        let of_joint = joint.map(|joint| model.jnt_range()[joint]);
        let of_control = model.actuator_ctrllimited()[index].then(|| model.actuator_ctrlrange()[index]);
        let both = [of_joint, of_control].into_iter().flatten();
        both.fold([f64::NEG_INFINITY, f64::INFINITY], |[low, high], own| [low.max(own[0]), high.min(own[1])])
    }
}

/// Whether the first control of an actuator is the position at which a settled actuator has no force.
fn is_position(model: &MjModel, actuator: usize) -> bool {
    let (gain, bias) = (model.actuator_gainprm()[actuator], model.actuator_biasprm()[actuator]);
    let takes_position = model.actuator_ctrlspec()[actuator] & mjtCtrlInput::mjINPUT_POS as i32 != 0;
    match model.actuator_gaintype()[actuator] {
        MjtGain::mjGAIN_PID => takes_position && bias[1] != 0.0,
        MjtGain::mjGAIN_DCMOTOR => takes_position && gain[4] != 0.0,
        _ => {
            let settles = [MjtDyn::mjDYN_NONE, MjtDyn::mjDYN_FILTER, MjtDyn::mjDYN_FILTEREXACT];
            feeds_position_back(model, actuator) && settles.contains(&model.actuator_dyntype()[actuator])
        }
    }
}

/// Whether the force of an actuator is proportional to the difference between its control or state and its length.
pub(super) fn feeds_position_back(model: &MjModel, actuator: usize) -> bool {
    let (gain, bias) = (model.actuator_gainprm()[actuator][0], model.actuator_biasprm()[actuator][1]);
    model.actuator_biastype()[actuator] == MjtBias::mjBIAS_AFFINE && gain != 0.0 && gain == -bias
}
