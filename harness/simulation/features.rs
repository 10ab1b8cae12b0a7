//! Features of MuJoCo that change what a recorded value means. docs/recorded-values.md describes each of them.

use super::controls::Control;
use super::load::can_sleep;
use super::names::{ACTUATOR, FLEX, GEOM, JOINT, NAMES_SHOWN, ObjectKind, SENSOR, name_of};
use super::resolved::Reading;
use super::scene::Scene;
use harness_shared::numbers::first_few;
use mujoco_rs::prelude::*;

impl Scene {
    /// Returns the number of the rules by which the model is simulated and recorded; `None` for a model to which the
    /// first rules apply. They ignored that actuators can have several controls or states, that joints can be coupled,
    /// adhesion, the contacts of sleeping bodies, and the poses of mocap bodies in keyframes.
    pub fn rule(&self) -> Option<u32> {
        let (model, settling) = (&self.model, &self.resolved.settling);
        let is_shifted = (0..).zip(model.actuator_ctrladr()).any(|(actuator, address)| actuator != *address);
        let is_settled = !settling.couplings.is_empty() || !settling.states.is_empty();
        let newer = [MjtGain::mjGAIN_PID, MjtGain::mjGAIN_DCMOTOR];
        let is_later = is_shifted
            || !settling.delayed.is_empty()
            || self.resolved.keyframe.is_none()
                && (is_settled || model.actuator_gaintype().iter().any(|gain| newer.contains(gain)))
            || self.resolved.forces > 0 && model.flg_adhesion()
            || self.senses_sleepers()
            || self.resolved.keyframe.is_some() && model.nmocap() > 0 && !self.resolved.flows.is_empty();
        is_later.then_some(2)
    }

    /// Whether a contact is sensed that could be one of a sleeping body.
    fn senses_sleepers(&self) -> bool {
        let model = &self.model;
        if !can_sleep(model) {
            return false;
        }
        let awake = [MjtSleepPolicy::mjSLEEP_NEVER, MjtSleepPolicy::mjSLEEP_AUTO_NEVER];
        let sleeps = |tree: usize| !awake.contains(&model.tree_sleep_policy()[tree]);
        // What can't move touches sleeping bodies.
        let can_rest = |body: i32| usize::try_from(model.body_treeid()[body as usize]).map_or(true, sleeps);
        let geoms = self.resolved.force_of_geom.iter().zip(model.geom_bodyid());
        let is_sensed = geoms.into_iter().any(|(force, body)| force.is_some() && can_rest(*body));
        (0..model.ntree() as usize).any(sleeps)
            && (is_sensed || self.resolved.force_of_flex.iter().any(Option::is_some))
    }
}

/// Returns a sentence for each feature that the world uses.
pub(super) fn features(scene: &Scene) -> Vec<String> {
    let mut found: Vec<String> = idle_controls(scene);
    found.extend(states(scene));
    found.extend(delays(scene));
    found.extend(couplings(scene));
    found.extend(disabled(scene));
    if scene.resolved.forces > 0 {
        found.extend(adhesion(scene));
        found.extend(sleepers(scene));
        found.extend(margins(scene));
        found.extend(passive_flexes(scene));
    }
    found
}

fn names(model: &MjModel, kind: ObjectKind, ids: impl Iterator<Item = usize>) -> Option<String> {
    let mut names: Vec<String> = ids.map(|id| name_of(model, kind, id)).collect();
    names.dedup();
    (!names.is_empty()).then(|| first_few(&names, NAMES_SHOWN))
}

fn is_driven(scene: &Scene, control: Control) -> bool {
    let index = control.index(&scene.model);
    scene.resolved.actuators.iter().any(|driven| driven.controls.contains(&index))
}

/// The actuators that the action moves.
fn driven(scene: &Scene) -> impl Iterator<Item = usize> {
    let all = 0..scene.model.nactuator() as usize;
    all.filter(|actuator| Control::all_of(&scene.model, *actuator).any(|control| is_driven(scene, control)))
}

/// Controls that no setpoint drives, of actuators that have others.
fn idle_controls(scene: &Scene) -> Vec<String> {
    let model = &scene.model;
    let value = if scene.resolved.keyframe.is_some() { "as in the keyframe" } else { "0" };
    let note = |actuator: usize| {
        let idle = Control::all_of(model, actuator).filter(|control| !is_driven(scene, *control));
        let idle: Vec<&str> = idle.filter_map(|control| control.name(model)).collect();
        let name = name_of(model, ACTUATOR, actuator);
        (!idle.is_empty()).then(|| {
            format!(
                "the action does not drive the controls {} of the actuator {name}, which stay {value}",
                idle.join(", ")
            )
        })
    };
    driven(scene).filter_map(note).collect()
}

/// Actuators whose force depends on a state that follows the setpoint.
fn states(scene: &Scene) -> Option<String> {
    let with_state = |actuator: &usize| scene.model.actuator_actnum()[*actuator] > 0;
    let names = names(&scene.model, ACTUATOR, driven(scene).filter(with_state))?;
    let start = if scene.resolved.keyframe.is_some() { "the keyframe gives it" } else { "it is settled" };
    Some(format!(
        "{names} has a state of its own (a filter, an integral, a muscle); at the start of an episode, {start}"
    ))
}

/// Actuators and sensors with a delay.
fn delays(scene: &Scene) -> Vec<String> {
    let model = &scene.model;
    let delayed = driven(scene).filter(|actuator| model.actuator_delay()[*actuator] > 0.0);
    let of_actuators = names(model, ACTUATOR, delayed).map(|names| {
        format!("{names} takes the setpoint with a delay; before an episode, it had the first one")
    });
    let is_read = |sensor: &usize| {
        let first = model.sensor_adr()[*sensor] as usize;
        let values = first..first + model.sensor_dim()[*sensor] as usize;
        let reads = |reading: &Reading| matches!(reading, Reading::Sensor(index) if values.contains(index));
        scene.resolved.readings.iter().flatten().any(reads)
    };
    let late =
        |sensor: &usize| model.sensor_delay()[*sensor] > 0.0 || model.sensor_interval()[*sensor][0] > 0.0;
    let sensors = (0..model.nsensor() as usize).filter(is_read).filter(late);
    let of_sensors = names(model, SENSOR, sensors).map(|names| {
        format!("the sensor {names} has a delay or an interval; what is recorded is what it says, which is 0 at first")
    });
    [of_actuators, of_sensors].into_iter().flatten().collect()
}

/// Joints that an equality couples to others.
fn couplings(scene: &Scene) -> Option<String> {
    let coupled = scene.resolved.settling.couplings.iter().map(|coupling| coupling.joint);
    let names = names(&scene.model, JOINT, coupled.filter(|_| scene.resolved.keyframe.is_none()))?;
    Some(format!("{names} is coupled by an equality, which says where it starts"))
}

/// Actuators that move nothing.
fn disabled(scene: &Scene) -> Option<String> {
    let (model, option) = (&scene.model, scene.model.opt());
    let all = option.disableflags & MjtDisableBit::mjDSBL_ACTUATION as i32 != 0;
    let is_off = |actuator: &usize| {
        let group = model.actuator_group()[*actuator];
        all || (0..31).contains(&group) && option.disableactuator & (1 << group) != 0
    };
    let names = names(model, ACTUATOR, driven(scene).filter(is_off))?;
    Some(format!(
        "the model switches {names} off (actuatorgroupdisable or actuation), so its setpoint moves nothing"
    ))
}

fn adhesion(scene: &Scene) -> Vec<String> {
    let model = &scene.model;
    let of_geoms = model.flg_adhesion().then(|| {
        "geoms have adhesion: normal_force is the contact's force less the adhesion, and negative where it pulls".into()
    });
    let is_active = |actuator: &usize| model.actuator_trntype()[*actuator] == MjtTrn::mjTRN_BODY;
    let of_actuators =
        names(model, ACTUATOR, (0..model.nactuator() as usize).filter(is_active)).map(|names| {
            format!(
                "{names} presses the contacts of a body together, and normal_force includes what it presses"
            )
        });
    [of_geoms, of_actuators].into_iter().flatten().collect()
}

fn sleepers(scene: &Scene) -> Option<String> {
    let note = "bodies can sleep: MuJoCo computes no contacts of a sleeping body, so normal_force stays as it was when \
                it fell asleep";
    scene.senses_sleepers().then(|| note.into())
}

/// Geoms whose contacts have forces at a distance.
fn margins(scene: &Scene) -> Option<String> {
    let model = &scene.model;
    let is_overridden = model.opt().enableflags & MjtEnableBit::mjENBL_OVERRIDE as i32 != 0;
    let distance = match is_overridden {
        true => model.opt().o_margin,
        false => {
            let geoms = model.geom_margin().iter().chain(model.pair_margin()).chain(model.flex_margin());
            geoms.copied().fold(0.0, f64::max)
        }
    };
    (distance > 0.0).then(|| {
        let wide = (0..model.ngeom() as usize).filter(|geom| !is_overridden && model.geom_margin()[*geom] > 0.0);
        let of = names(model, GEOM, wide).map_or("contacts".into(), |names| format!("contacts of {names}"));
        format!(
            "{of} have a margin, of up to {distance} m: normal_force begins at the sum of the margins of two geoms, \
             before they touch"
        )
    })
}

/// Flexes some of whose contacts MuJoCo does not report.
fn passive_flexes(scene: &Scene) -> Option<String> {
    let model = &scene.model;
    let passive = (0..model.nflex() as usize).filter(|flex| model.flex_passive()[*flex] != 0);
    let names = names(model, FLEX, passive)?;
    Some(format!(
        "the flex {names} has passive contacts: normal_force leaves out its contacts with itself, with other flexes \
         and with what can't move, because MuJoCo does not report their forces"
    ))
}
