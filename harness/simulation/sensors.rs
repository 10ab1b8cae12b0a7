//! Values that are computed from the state after each step: contact forces, and MuJoCo's warnings.

use super::resolve::ContactKinds;
use super::scene::Scene;
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_auxiliary::MjContact;
use mujoco_rs::wrappers::mj_model::traits::ModelType;

/// Writes the normal force on each sensed link, N: the sum over the link's contacts. There is one value for each of the
/// scene's forces. A contact between two links counts for both.
pub(super) fn sum_forces(scene: &Scene, data: &MjData<impl ModelType>, forces: &mut [f64]) {
    forces.fill(0.0);
    if forces.is_empty() {
        return;
    }
    each_touch(scene, data, |link, _, force| forces[link] += force);
}

/// Writes the kind of each force's contact: the kind whose contacts have the largest sum of forces, or 0 if no contact
/// has a force. Of equal sums, the later kind counts.
pub(super) fn largest_kinds(
    scene: &Scene,
    kinds: &ContactKinds,
    data: &MjData<impl ModelType>,
    found: &mut [usize],
) {
    let width = kinds.last + 1;
    let mut sums = vec![0.0; found.len() * width];
    each_touch(scene, data, |link, other, force| {
        let kind = usize::try_from(other).map_or(kinds.last, |geom| kinds.of_geom[geom]);
        sums[link * width + kind] += force;
    });
    for (found, sums) in found.iter_mut().zip(sums.chunks_exact(width)) {
        let largest = |a: &usize, b: &usize| sums[*a].total_cmp(&sums[*b]);
        *found = (0..width).filter(|kind| sums[*kind] > 0.0).max_by(largest).unwrap_or(0);
    }
}

/// Calls `touch` with the force's index, the geom on the other side (negative for a flex) and the normal force, N, of
/// each contact of a sensed link. A contact between two links counts for both, and one within a link once.
fn each_touch(scene: &Scene, data: &MjData<impl ModelType>, mut touch: impl FnMut(usize, i32, f64)) {
    for contact in data.contact() {
        // What is not a geom is a flex, and the other way round. The index of what it is not is negative.
        let of = |forces: &[Option<usize>], id: i32| forces.get(usize::try_from(id).ok()?).copied().flatten();
        let links = [0, 1].map(|side| {
            of(&scene.force_of_geom, contact.geom[side]).or(of(&scene.force_of_flex, contact.flex[side]))
        });
        if links == [None, None] {
            continue;
        }
        let force = normal_force(scene, data, contact);
        let [first, second] = contact.geom;
        if let Some(link) = links[0] {
            touch(link, second, force);
        }
        if let Some(link) = links[1].filter(|link| links[0] != Some(*link)) {
            touch(link, first, force);
        }
    }
}

/// Returns the normal component of a contact's force, N. It equals the first value of `mj_contactForce`.
fn normal_force(scene: &Scene, data: &MjData<impl ModelType>, contact: &MjContact) -> f64 {
    // Contacts without constraint rows (within the margin, or excluded) have no force.
    let Ok(first) = usize::try_from(contact.efc_address) else { return 0.0 };
    let rows = match contact.dim as usize {
        // Each edge of a pyramidal friction cone carries a part of the normal force, so the sum of the rows is the
        // force.
        dim if dim > 1 && scene.model.is_pyramidal() => 2 * (dim - 1),
        _ => 1,
    };
    // SAFETY: the step that made this contact has also solved for the forces of its rows.
    let efc_force = unsafe { data.efc_force() };
    efc_force[first..first + rows].iter().sum()
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
