//! Which joint moves a body, and whether its position is one number.

use super::names::{BODY, name_of};
use mujoco_rs::prelude::*;

/// Whether a joint is a hinge or a slide, whose position is one number.
pub(super) fn is_single(model: &MjModel, joint: usize) -> bool {
    [MjtJoint::mjJNT_HINGE, MjtJoint::mjJNT_SLIDE].contains(&model.jnt_type()[joint])
}

/// Whether a joint is a free joint.
pub(super) fn is_free(model: &MjModel, joint: usize) -> bool {
    model.jnt_type()[joint] == MjtJoint::mjJNT_FREE
}

/// The word for a ball or free joint.
pub(super) fn word(model: &MjModel, joint: usize) -> &'static str {
    if is_free(model, joint) { "free" } else { "ball" }
}

/// Returns the first joint of a body or, if it is rigidly attached to another body, of that one.
fn joint_of(model: &MjModel, body: usize) -> Option<usize> {
    let moved = model.body_weldid()[body] as usize;
    usize::try_from(model.body_jntadr()[moved]).ok()
}

/// Returns all ball and free joints.
pub(super) fn ball_and_free(model: &MjModel) -> Vec<usize> {
    (0..model.njnt() as usize).filter(|joint| !is_single(model, *joint)).collect()
}

/// Describes a ball or free joint, which often has no name, by its body.
pub(super) fn described(model: &MjModel, joint: usize) -> String {
    let body = name_of(model, BODY, model.jnt_bodyid()[joint] as usize);
    format!("the {} joint of body {body}", word(model, joint))
}

/// Whether a geom can touch something and a joint moves it that fulfills `is_wanted`.
pub(super) fn touches(model: &MjModel, geom: usize, is_wanted: impl Fn(usize) -> bool) -> bool {
    let collides = model.geom_contype()[geom] != 0 || model.geom_conaffinity()[geom] != 0;
    collides && joint_of(model, model.geom_bodyid()[geom] as usize).is_some_and(is_wanted)
}
