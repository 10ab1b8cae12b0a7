//! Values that are computed from the state after each step: contact forces, and MuJoCo's warnings.

use super::load::can_sleep;
use super::resolved::{ContactKinds, ContactNormal};
use super::scene::Scene;
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_auxiliary::MjContact;
use mujoco_rs::wrappers::mj_model::traits::ModelType;
use std::sync::Arc;

/// A contact of a sensed link.
#[derive(Debug, Clone, Copy)]
struct Touch {
    /// The index of the link's force.
    link: usize,
    /// The geom on the other side; negative for a flex.
    other: i32,
    /// The normal force, N. It is negative where adhesion pulls.
    force: f64,
    /// The unit vector in the world along which a positive force pushes the link.
    normal: [f64; 3],
}

/// Writes the normal force on each sensed link, N: the sum over the link's contacts. There is one value for each of the
/// scene's forces. A contact between two links counts for both.
pub(super) fn sum_forces(
    scene: &Scene,
    data: &MjData<impl ModelType>,
    resting: &Resting,
    forces: &mut [f64],
) {
    forces.fill(0.0);
    if forces.is_empty() {
        return;
    }
    each_touch(scene, data, resting, |touch| forces[touch.link] += touch.force);
}

/// Adds the forces of contacts to the sums by kind, `[forces, kinds]`.
pub(super) fn add_kinds(
    scene: &Scene,
    kinds: &ContactKinds,
    data: &MjData<impl ModelType>,
    resting: &Resting,
    sums: &mut [f64],
) {
    each_touch(scene, data, resting, |touch| {
        let kind = usize::try_from(touch.other).map_or(kinds.last, |geom| kinds.of_geom[geom]);
        sums[touch.link * (kinds.last + 1) + kind] += touch.force;
    });
}

/// Writes the kind of each force's contact: the kind with the largest sum of [`add_kinds`], or 0 if no contact has a
/// force. Of equal sums, the later kind counts. Clears the sums.
pub(super) fn take_largest_kinds(kinds: &ContactKinds, sums: &mut [f64], found: &mut [usize]) {
    let width = kinds.last + 1;
    for (found, sums) in found.iter_mut().zip(sums.chunks_exact(width)) {
        let largest = |a: &usize, b: &usize| sums[*a].abs().total_cmp(&sums[*b].abs());
        *found = (0..width).filter(|kind| sums[*kind] != 0.0).max_by(largest).unwrap_or(0);
    }
    sums.fill(0.0);
}

/// Writes the directions of contacts: unit vectors in the frames of bodies along the sum of the normal forces, each with
/// its normal, or 0 if the sum is 0.
pub(super) fn write_normals(
    scene: &Scene,
    data: &MjData<impl ModelType>,
    resting: &Resting,
    found: &mut [[f64; 3]],
) {
    if found.is_empty() {
        return;
    }
    let mut sums = vec![[0.0; 3]; scene.resolved.forces];
    each_touch(scene, data, resting, |Touch { link, force, normal, .. }| {
        sums[link].iter_mut().zip(normal).for_each(|(sum, part)| *sum += force * part);
    });
    for (found, ContactNormal { force, body }) in found.iter_mut().zip(&scene.resolved.normals) {
        let (sum, axes) = (sums[*force], data.xmat()[*body]);
        let length = sum.iter().map(|part| part * part).sum::<f64>().sqrt();
        let along = |axis: usize| (0..3).map(|row| axes[3 * row + axis] * sum[row]).sum::<f64>() / length;
        *found = if length > 0.0 { std::array::from_fn(along) } else { [0.0; 3] };
    }
}

/// Calls `found` with each contact of a sensed link. A contact between two links counts for both, and one within a link
/// once.
fn each_touch(scene: &Scene, data: &MjData<impl ModelType>, resting: &Resting, mut found: impl FnMut(Touch)) {
    for (index, contact) in data.contact().iter().enumerate() {
        touches(scene, data, index, contact).into_iter().flatten().for_each(&mut found);
    }
    resting.touches.iter().for_each(|(_, touch)| found(*touch));
}

/// Returns what the links on both sides of a contact feel.
fn touches(
    scene: &Scene,
    data: &MjData<impl ModelType>,
    index: usize,
    contact: &MjContact,
) -> [Option<Touch>; 2] {
    // What is not a geom is a flex, and the other way round. The index of what it is not is negative.
    let of = |forces: &[Option<usize>], id: i32| forces.get(usize::try_from(id).ok()?).copied().flatten();
    let links = [0, 1].map(|side| {
        of(&scene.resolved.force_of_geom, contact.geom[side])
            .or(of(&scene.resolved.force_of_flex, contact.flex[side]))
    });
    if links == [None, None] {
        return [None; 2];
    }
    let force = data.contact_force(index)[0];
    // MuJoCo's normal points from the first side to the second.
    let normal = |side: usize| [0, 1, 2].map(|axis| [-1.0, 1.0][side] * contact.frame[axis]);
    let touch = |side: usize| {
        Some(Touch { link: links[side]?, other: contact.geom[1 - side], force, normal: normal(side) })
    };
    [touch(0), touch(1).filter(|_| links[0] != links[1])]
}

/// Contacts of sleeping bodies. MuJoCo does not compute them while all bodies in contact sleep, but then they do not
/// change either.
#[derive(Debug, Clone, Default)]
pub(super) struct Resting {
    /// For each kinematic tree whether it sleeps; empty if no contact of a body that can sleep is sensed.
    asleep: Vec<bool>,
    /// The contacts, each with the tree with which it sleeps.
    touches: Vec<(usize, Touch)>,
}

impl Resting {
    /// Begins an episode. Bodies that the model starts asleep have the contacts that they would have awake.
    pub fn restart(&mut self, scene: &Scene, data: &MjData<Arc<MjModel>>) {
        self.touches.clear();
        self.asleep.clear();
        if scene.resolved.forces == 0 || !can_sleep(data.model()) {
            return;
        }
        self.asleep.resize(data.tree_asleep().len(), false);
        if data.tree_asleep().iter().any(|tree| *tree >= 0) {
            let mut model = Box::new(MjModel::clone(data.model()));
            model.opt_mut().enableflags &= !(MjtEnableBit::mjENBL_SLEEP as i32);
            let mut awake = MjData::new(model);
            awake.qpos_mut().copy_from_slice(data.qpos());
            awake.ctrl_mut().copy_from_slice(data.ctrl());
            awake.act_mut().copy_from_slice(data.act());
            awake.mocap_pos_mut().copy_from_slice(data.mocap_pos());
            awake.mocap_quat_mut().copy_from_slice(data.mocap_quat());
            awake.forward();
            self.keep(scene, data.tree_asleep(), &awake);
        }
    }

    /// Keeps the contacts of bodies that the latest step let fall asleep. Must be called before the next step.
    pub fn fall_asleep(&mut self, scene: &Scene, data: &MjData<impl ModelType>) {
        if !self.asleep.is_empty() {
            self.keep(scene, data.tree_asleep(), data);
        }
    }

    /// Forgets the contacts of bodies that the latest step woke.
    pub fn wake(&mut self, data: &MjData<impl ModelType>) {
        let trees = data.tree_asleep();
        self.touches.retain(|(tree, _)| trees[*tree] >= 0);
        self.asleep.iter_mut().zip(trees).for_each(|(asleep, tree)| *asleep &= *tree >= 0);
    }

    /// Keeps the contacts in `data` of bodies that have fallen asleep. MuJoCo gives awake trees a negative number.
    fn keep(&mut self, scene: &Scene, trees: &[i32], data: &MjData<impl ModelType>) {
        let is_new = |(asleep, tree): (&bool, &i32)| !asleep && *tree >= 0;
        if !self.asleep.iter().zip(trees).any(is_new) {
            return;
        }
        for (index, contact) in data.contact().iter().enumerate() {
            let own = [0, 1].map(|side| tree_of(data.model(), contact, side));
            let tree = own.into_iter().flatten().find(|tree| is_new((&self.asleep[*tree], &trees[*tree])));
            if let Some(tree) = tree {
                let found = touches(scene, data, index, contact).into_iter().flatten();
                self.touches.extend(found.map(|touch| (tree, touch)));
            }
        }
        self.asleep.iter_mut().zip(trees).for_each(|(asleep, tree)| *asleep = *tree >= 0);
    }
}

/// Returns the kinematic tree on one side of a contact; `None` if it can't move. All trees of a flex sleep together.
fn tree_of(model: &MjModel, contact: &MjContact, side: usize) -> Option<usize> {
    let tree = |body: &i32| usize::try_from(model.body_treeid()[*body as usize]).ok();
    if let Ok(geom) = usize::try_from(contact.geom[side]) {
        return tree(&model.geom_bodyid()[geom]);
    }
    let flex = usize::try_from(contact.flex[side]).ok()?;
    let (first, count) = (model.flex_vertadr()[flex] as usize, model.flex_vertnum()[flex] as usize);
    let vertices = model.flex_vertbodyid().iter().skip(first).take(count);
    let (first, count) = (model.flex_nodeadr()[flex].max(0) as usize, model.flex_nodenum()[flex] as usize);
    let nodes = model.flex_nodebodyid().iter().skip(first).take(count);
    vertices.chain(nodes).find_map(tree)
}

/// The mean of the forces since the last [`MeanForces::take`].
#[derive(Debug, Clone)]
pub(super) struct MeanForces {
    sum: Vec<f64>,
    steps: usize,
}

impl MeanForces {
    pub fn new(forces: usize) -> Self {
        Self { sum: vec![0.0; forces], steps: 0 }
    }

    pub fn add(&mut self, forces: &[f64]) {
        for (sum, force) in self.sum.iter_mut().zip(forces) {
            *sum += force;
        }
        self.steps += 1;
    }

    /// Writes the mean over the added steps, N, and clears the sum.
    pub fn take(&mut self, mean: &mut [f64]) {
        for (mean, sum) in mean.iter_mut().zip(&self.sum) {
            *mean = sum / self.steps as f64;
        }
        self.clear();
    }

    pub fn clear(&mut self) {
        self.sum.fill(0.0);
        self.steps = 0;
    }
}

/// Returns the first warning of the simulation so far, if there is one.
///
/// MuJoCo counts a warning when positions, velocities or accelerations are huge or not finite. It then resets the
/// state, so later values are not valid data. It also counts a warning when contacts or constraints do not fit its
/// memory.
pub(super) fn instability(data: &MjData<impl ModelType>) -> Option<String> {
    data.warning()
        .iter()
        .zip(WARNINGS)
        .find(|(warning, _)| warning.number > 0)
        .map(|(warning, (name, cause))| format!("{cause} (MuJoCo's warning {name}, {})", warning.lastinfo))
}

/// MuJoCo's warnings in the order of `mjtWarning`.
const WARNINGS: [(&str, &str); MjtWarning::mjNWARNING as usize] = [
    ("INERTIA", "the inertia matrix is nearly singular"),
    ("CONTACTFULL", "too many contacts for the model's memory"),
    ("CNSTRFULL", "too many constraints for the model's memory"),
    ("BADQPOS", "a position is not finite or huge"),
    ("BADQVEL", "a velocity is not finite or huge"),
    ("BADQACC", "an acceleration is not finite or huge"),
    ("BADCTRL", "a control is not finite or huge"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_is_over_the_steps_since_it_was_taken() {
        let (mut forces, mut mean) = (MeanForces::new(2), [0.0; 2]);
        forces.add(&[1.0; 2]);
        forces.add(&[4.0; 2]);
        forces.take(&mut mean);
        assert_eq!(mean, [2.5; 2]);
        forces.add(&[7.0; 2]);
        forces.take(&mut mean);
        assert_eq!(mean, [7.0; 2]);
    }

    #[test]
    fn each_of_mujocos_warnings_is_named() {
        let model = MjModel::from_xml_string("<mujoco/>").unwrap();
        let mut data = MjData::new(&model);
        assert_eq!(instability(&data), None);
        for (index, (name, _)) in WARNINGS.into_iter().enumerate() {
            data.reset();
            data.warning_mut()[index].number = 1;
            assert!(instability(&data).unwrap().contains(name));
        }
    }
}
