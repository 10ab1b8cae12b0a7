//! What else is settled at the start of an episode, besides the joints of position servos: joints that an equality
//! couples to others, the states of actuators, and controls that take effect with a delay.

use super::controls::{Control, feeds_position_back};
use mujoco_rs::prelude::*;
use std::sync::Arc;

/// Settles the start of an episode.
#[derive(Debug)]
pub(super) struct Settling {
    pub couplings: Vec<Coupling>,
    pub states: Vec<State>,
    /// Actuators with a delay.
    pub delayed: Vec<usize>,
}

/// A joint whose position an equality computes from that of another joint.
#[derive(Debug)]
pub(super) struct Coupling {
    pub joint: usize,
    /// The other joint; `None` if the position is constant.
    pub to: Option<usize>,
    /// Of the polynomial of the other joint's displacement from its position in `qpos0`.
    coefficients: [f64; 5],
}

/// A state of an actuator, which MuJoCo calls an activation.
#[derive(Debug)]
pub(super) struct State {
    /// Its index in `act`.
    index: usize,
    settled: Settled,
    range: [f64; 2],
}

/// What a settled state of an actuator is equal to.
#[derive(Debug)]
enum Settled {
    /// The control with this index.
    Control(usize),
    /// The length with this index, to which the actuator returns.
    Length(usize),
}

impl Settling {
    /// Finds what must be settled. `servos` are the joints of the position servos that the action moves.
    pub fn of(model: &MjModel, servos: &[usize]) -> Self {
        let actuators = 0..model.nactuator() as usize;
        Self {
            couplings: couplings(model, servos),
            states: actuators.clone().flat_map(|actuator| states(model, actuator)).collect(),
            delayed: actuators.filter(|actuator| model.actuator_delay()[*actuator] > 0.0).collect(),
        }
    }

    /// Sets the positions of coupled joints.
    pub fn couple(&self, model: &MjModel, qpos: &mut [f64]) {
        let place = |joint: usize| model.jnt_qposadr()[joint] as usize;
        // A joint can be coupled to one that is coupled itself.
        for coupling in self.couplings.iter().flat_map(|_| &self.couplings) {
            let away = coupling.to.map_or(0.0, |to| qpos[place(to)] - model.qpos0()[place(to)]);
            let shift = coupling.coefficients.iter().rev().fold(0.0, |sum, value| sum * away + value);
            qpos[place(coupling.joint)] = model.qpos0()[place(coupling.joint)] + shift;
        }
    }

    /// Sets the states of actuators to what they tend to with the present controls.
    pub fn settle_states(&self, data: &mut MjData<Arc<MjModel>>) {
        if self.states.iter().any(|state| matches!(state.settled, Settled::Length(_))) {
            data.kinematics();
            data.com_pos();
            data.tendon_comp();
            data.transmission();
        }
        for State { index, settled, range: [low, high], .. } in &self.states {
            let value = match settled {
                Settled::Control(control) => data.ctrl()[*control],
                Settled::Length(output) => data.actuator_length()[*output],
            };
            data.act_mut()[*index] = value.clamp(*low, *high);
        }
    }

    /// Lets delayed actuators begin as if the present controls had been commanded before.
    pub fn fill_delays(&self, data: &mut MjData<Arc<MjModel>>) {
        for actuator in &self.delayed {
            let model = data.model();
            let samples = model.actuator_history()[*actuator][0] as usize;
            let own = Control::all_of(model, *actuator).map(|control| data.ctrl()[control.index(model)]);
            let values = own.collect::<Vec<f64>>().repeat(samples);
            data.init_ctrl_history(*actuator, None, &values).expect("a delayed actuator has a history");
        }
    }
}

/// Returns the couplings of joints by active equalities. A joint of a position servo keeps its position, so the other
/// joint of its equality follows it.
fn couplings(model: &MjModel, servos: &[usize]) -> Vec<Coupling> {
    let is_on = model.opt().disableflags & MjtDisableBit::mjDSBL_EQUALITY as i32 == 0;
    let equalities = (0..model.neq() as usize).filter(|equality| {
        is_on && model.eq_active0()[*equality] && model.eq_type()[*equality] == MjtEq::mjEQ_JOINT
    });
    let coupling = |equality: usize| {
        let (joint, to) = (model.eq_obj1id()[equality] as usize, model.eq_obj2id()[equality]);
        let to = usize::try_from(to).ok();
        let coefficients: [f64; 5] = std::array::from_fn(|power| model.eq_data()[equality][power]);
        let leads = |joint: usize| servos.contains(&joint);
        match (to, coefficients) {
            _ if !leads(joint) => Some(Coupling { joint, to, coefficients }),
            // The inverse, if there is one.
            (Some(to), [shift, slope, 0.0, 0.0, 0.0]) if !leads(to) && slope != 0.0 => {
                let coefficients = [-shift / slope, 1.0 / slope, 0.0, 0.0, 0.0];
                Some(Coupling { joint: to, to: Some(joint), coefficients })
            }
            _ => None,
        }
    };
    equalities.filter_map(coupling).collect()
}

/// Returns the states of an actuator that it would not have at rest if they were 0.
fn states(model: &MjModel, actuator: usize) -> Vec<State> {
    let (first, count) = (model.actuator_actadr()[actuator], model.actuator_actnum()[actuator] as usize);
    let Ok(first) = usize::try_from(first) else { return Vec::new() };
    // Plugins have states of their own.
    if count == 0 || model.actuator_plugin()[actuator] >= 0 {
        return Vec::new();
    }
    let is_limited = model.actuator_actlimited()[actuator];
    let range =
        if is_limited { model.actuator_actrange()[actuator] } else { [f64::NEG_INFINITY, f64::INFINITY] };
    let state = |index: usize, settled: Settled, range: [f64; 2]| State { index, settled, range };
    let control = model.actuator_ctrladr()[actuator] as usize;
    let output = model.actuator_outadr()[actuator] as usize;
    let (last, dynamics) = (first + count - 1, model.actuator_dynprm()[actuator]);
    let returns =
        || feeds_position_back(model, actuator) || model.actuator_gaintype()[actuator] == MjtGain::mjGAIN_SO3;
    match model.actuator_dyntype()[actuator] {
        MjtDyn::mjDYN_FILTER | MjtDyn::mjDYN_FILTEREXACT => {
            vec![state(last, Settled::Control(control), range)]
        }
        MjtDyn::mjDYN_MUSCLE => vec![state(last, Settled::Control(control), [0.0, 1.0])],
        MjtDyn::mjDYN_INTEGRATOR if returns() => {
            let outputs = model.actuator_outnum()[actuator] as usize;
            let integrated = (last + 1 - outputs..=last).zip(output..);
            integrated.map(|(index, output)| state(index, Settled::Length(output), range)).collect()
        }
        // The setpoint in effect, whose rate is limited, is the first state.
        MjtDyn::mjDYN_PID if dynamics[1] > 0.0 => vec![state(first, Settled::Control(control), range)],
        MjtDyn::mjDYN_DCMOTOR if dynamics[7] > 0.0 => vec![state(first, Settled::Control(control), range)],
        _ => Vec::new(),
    }
}
