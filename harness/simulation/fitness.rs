//! Whether a world is fit for learning: how often and how deep its robot touches something, whether a few samples decide
//! the variance of the forces, and whether the robot stays within its limits.

use super::SimulationError;
use super::joints::is_single;
use super::load::can_sleep;
use super::names::{ACTUATOR, JOINT, name_of};
use super::physics::{Instant, Physics};
use super::plan::EpisodePlan;
use super::resolved::Driven;
use super::scene::Scene;
use harness_spec::{Motion, Simulation};
use mujoco_rs::prelude::*;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Largest penetration in 99 % of the contacts, in half the thickness of the thinner geom: 3 mm of a radius of 45 mm.
const DEEP: f64 = 3.0 / 45.0;
/// Largest penetration of all: 10 mm of a radius of 45 mm, or 15 mm where the robot can pinch what it touches.
const DEEPEST: f64 = 10.0 / 45.0;
const PINCHED: f64 = 15.0 / 45.0;
/// The samples with the largest deviation, as a part of all, and the largest parts of the variance that they may hold.
const TOP: f64 = 0.01;
const TOP_SNAPSHOT: f64 = 0.40;
const TOP_MEAN: f64 = 0.20;
/// Smallest part of the samples with a contact.
const TOUCHED: f64 = 0.3;
/// Smallest number of pairs of a link and a placed body that touch in a sample.
const PAIRS: f64 = 0.3;
/// Largest part of the samples in which an actuator is at its limit of force.
const AT_LIMIT: f64 = 0.5;
/// How far a hinge may be beyond its limit, rad, and a slide, in its range.
const BEYOND_HINGE: f64 = 0.5 * std::f64::consts::PI / 180.0;
const BEYOND_SLIDE: f64 = 0.01;
/// How far a servo may be from its setpoint at the end of a move, rad or m, if nothing was touched for [`FREE_S`].
const OFF: f64 = 5e-3;
const FREE_S: f64 = 0.5;
/// A link counts as touched if it is in this part of the samples.
const OFTEN: f64 = 0.01;

/// A property of a world that tells whether it is fit for learning.
#[derive(Debug, Clone)]
pub struct Finding {
    /// What was measured.
    pub name: &'static str,
    /// The unit of the value and of the limit; empty for parts and numbers.
    pub unit: &'static str,
    /// The value; `None` if the world has nothing of the kind.
    pub value: Option<f64>,
    /// What a world needs that is fit for learning; `None` if the value only describes it.
    pub limit: Option<Limit>,
    /// The joint or the actuator with the largest value; empty for what is measured of the whole world.
    pub of: String,
    /// What changes the value: attributes of the MJCF and keys of the world file.
    pub advice: &'static str,
}

/// A limit of a value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Limit {
    /// The largest value.
    AtMost(f64),
    /// The smallest value.
    AtLeast(f64),
}

impl Finding {
    /// Whether the value is within its limit. What has no value or no limit is.
    pub fn holds(&self) -> bool {
        match (self.value, self.limit) {
            (Some(value), Some(Limit::AtMost(limit))) => value <= limit,
            (Some(value), Some(Limit::AtLeast(limit))) => value >= limit,
            _ => true,
        }
    }
}

/// Simulates the first `episodes` of a world without rendering, and returns what tells whether it is fit for learning.
/// Every world has the same findings in the same order. They do not depend on the number of threads.
pub fn fitness(scene: &Scene, episodes: u32) -> Result<Vec<Finding>, SimulationError> {
    let spec = scene.world().simulation();
    let seen = (0..episodes).into_par_iter().map(|episode| watch(scene, &spec, episode));
    // Of several errors, that of the first episode is returned.
    let seen: Vec<Seen> = seen.collect::<Vec<_>>().into_iter().collect::<Result<_, _>>()?;
    let mut all = Seen::new(scene);
    seen.into_iter().for_each(|episode| all.add(episode));
    Ok(all.findings(scene))
}

/// What happened in episodes.
struct Seen {
    /// Penetrations of the contacts of all steps, m, and in half the thickness of the thinner geom.
    depths: Vec<f64>,
    shares: Vec<f64>,
    /// Forces at the samples and their means since the samples before, N, `[samples, forces]`.
    snapshots: Vec<f64>,
    means: Vec<f64>,
    /// Number of samples.
    samples: usize,
    /// Pairs of a sensed geom and one of a placed body that touch, over all samples.
    pairs: usize,
    /// Sums of the parts of the kinematic trees that sleep, over all samples.
    asleep: f64,
    /// How far each limited joint was beyond its limits at most, in what its kind may be.
    beyond: Vec<f64>,
    /// The samples in which each output of an actuator was at its limit, and any.
    at_limit: Vec<usize>,
    any_at_limit: usize,
    /// How far each servo was from its setpoint at the end of a move without a contact, rad or m.
    off: Vec<f64>,
    /// The ends of moves, and those without a contact.
    ends: usize,
    free_ends: usize,
}

/// A servo of a joint: the joint, its index in `qpos`, and the element of the action.
struct Servo {
    joint: usize,
    qpos: usize,
    element: usize,
}

fn servos(scene: &Scene) -> Vec<Servo> {
    let places = scene.model.jnt_qposadr();
    let of = |(element, driven): (usize, &Driven)| -> Vec<Servo> {
        let servo = |qpos: &usize| {
            let joint = places.iter().position(|place| *place as usize == *qpos)?;
            Some(Servo { joint, qpos: *qpos, element })
        };
        driven.qpos.iter().filter_map(servo).collect()
    };
    scene.resolved.actuators.iter().enumerate().flat_map(of).collect()
}

/// For each geom, whether it is one of a body that each episode places.
fn placed(scene: &Scene) -> Vec<bool> {
    let bodies: BTreeSet<usize> = scene
        .resolved
        .placements
        .iter()
        .flat_map(|placement| &placement.boxes)
        .map(|body| body.body)
        .collect();
    let root = |body: &i32| scene.model.body_rootid()[*body as usize] as usize;
    scene.model.geom_bodyid().iter().map(|body| bodies.contains(&root(body))).collect()
}

/// The hinges and slides with limits.
fn limited(model: &MjModel) -> impl Iterator<Item = usize> {
    (0..model.njnt() as usize).filter(|joint| model.jnt_limited()[*joint] && is_single(model, *joint))
}

fn is_slide(model: &MjModel, joint: usize) -> bool {
    model.jnt_type()[joint] == MjtJoint::mjJNT_SLIDE
}

/// Half the smallest side of a geom's bounding box, m; `None` for planes and height fields, which have no thickness.
fn half_thickness(model: &MjModel, geom: usize) -> Option<f64> {
    let is_open = [MjtGeomBase::mjGEOM_PLANE, MjtGeomBase::mjGEOM_HFIELD].contains(&model.geom_type()[geom]);
    let half = model.geom_aabb()[geom][3..].iter().copied().fold(f64::INFINITY, f64::min);
    (!is_open && half > 0.0).then_some(half)
}

/// Simulates an episode, and watches each of its steps.
fn watch(scene: &Scene, spec: &Simulation, episode: u32) -> Result<Seen, SimulationError> {
    let timing = scene.timing(spec)?;
    // Each step is a sample of the simulation, so that forces are read in each.
    let each_step = Simulation { sample_rate_hz: 1.0 / timing.step_s, ..spec.clone() };
    let mut physics = Physics::new(scene, &each_step)?;
    let plan = EpisodePlan::draw(scene, spec, episode)?;
    physics.start(&plan);
    let action = &scene.world().file().action;
    let has_moves =
        action.course.is_none() && matches!(action.motion, Motion::RandomSetpoints | Motion::RandomWalk);
    let (mut seen, servos, placed) = (Seen::new(scene), servos(scene), placed(scene));
    let (mut sums, mut steps, mut free) = (vec![0.0; scene.resolved.forces], 0, 0);
    for step in 0..=(timing.samples - 1) * timing.steps_per_sample {
        physics.follow(&plan)?;
        let (instant, data) = physics.sampled();
        if has_moves && step > 0 && step.is_multiple_of(timing.steps_per_actuation) {
            seen.ends += 1;
            if free as f64 * timing.step_s >= FREE_S {
                seen.free_ends += 1;
                for (off, servo) in seen.off.iter_mut().zip(&servos) {
                    *off = off.max((instant.state[servo.qpos] - instant.setpoint[servo.element]).abs());
                }
            }
        }
        seen.add_step(scene, instant, data);
        sums.iter_mut().zip(&instant.forces).for_each(|(sum, force)| *sum += force);
        (steps, free) =
            (steps + 1, if instant.forces.iter().any(|force| *force != 0.0) { 0 } else { free + 1 });
        if step.is_multiple_of(timing.steps_per_sample) {
            seen.add_sample(scene, instant, data, &placed);
            seen.means.extend(sums.iter().map(|sum| sum / f64::from(steps)));
            sums.fill(0.0);
            steps = 0;
        }
    }
    Ok(seen)
}

impl Seen {
    fn new(scene: &Scene) -> Self {
        Self {
            depths: Vec::new(),
            shares: Vec::new(),
            snapshots: Vec::new(),
            means: Vec::new(),
            samples: 0,
            pairs: 0,
            asleep: 0.0,
            beyond: vec![0.0; limited(&scene.model).count()],
            at_limit: vec![0; scene.model.nactuator() as usize],
            any_at_limit: 0,
            off: vec![0.0; servos(scene).len()],
            ends: 0,
            free_ends: 0,
        }
    }

    fn add(&mut self, mut other: Self) {
        self.depths.append(&mut other.depths);
        self.shares.append(&mut other.shares);
        self.snapshots.append(&mut other.snapshots);
        self.means.append(&mut other.means);
        self.samples += other.samples;
        self.pairs += other.pairs;
        self.asleep += other.asleep;
        for (own, other) in [(&mut self.beyond, other.beyond), (&mut self.off, other.off)] {
            own.iter_mut().zip(other).for_each(|(own, other)| *own = own.max(other));
        }
        self.at_limit.iter_mut().zip(other.at_limit).for_each(|(own, other)| *own += other);
        self.any_at_limit += other.any_at_limit;
        self.ends += other.ends;
        self.free_ends += other.free_ends;
    }

    /// Adds the contacts of sensed geoms and the positions of joints in a step.
    fn add_step(&mut self, scene: &Scene, instant: &Instant, data: &MjData<Arc<MjModel>>) {
        let model = &*instant.model;
        for (geoms, depth, _) in contacts(scene, data) {
            if depth > 0.0 {
                self.depths.push(depth);
                let half = geoms.into_iter().flatten().filter_map(|geom| half_thickness(model, geom));
                self.shares.extend(half.reduce(f64::min).map(|half| depth / half));
            }
        }
        for (beyond, joint) in self.beyond.iter_mut().zip(limited(model)) {
            let ([low, high], place) = (model.jnt_range()[joint], model.jnt_qposadr()[joint] as usize);
            let out = (low - instant.state[place]).max(instant.state[place] - high);
            *beyond = beyond.max(if is_slide(model, joint) { out / (high - low) } else { out });
        }
    }

    fn add_sample(&mut self, scene: &Scene, instant: &Instant, data: &MjData<Arc<MjModel>>, placed: &[bool]) {
        let model = &*instant.model;
        self.samples += 1;
        self.snapshots.extend_from_slice(&instant.forces);
        let pairs: BTreeSet<[Option<usize>; 2]> =
            contacts(scene, data).filter(|(.., force)| *force > 0.0).map(|(geoms, ..)| geoms).collect();
        self.pairs += pairs.iter().filter(|geoms| geoms.iter().flatten().any(|geom| placed[*geom])).count();
        let trees = data.tree_asleep();
        self.asleep += trees.iter().filter(|tree| **tree >= 0).count() as f64 / trees.len().max(1) as f64;
        let mut any = false;
        for (actuator, count) in self.at_limit.iter_mut().enumerate() {
            let ([low, high], force) = (
                model.actuator_forcerange()[actuator],
                data.actuator_force()[model.actuator_outadr()[actuator] as usize],
            );
            let is_at = model.actuator_forcelimited()[actuator] && (force <= low || force >= high);
            (*count, any) = (*count + usize::from(is_at), any || is_at);
        }
        self.any_at_limit += usize::from(any);
    }

    fn findings(mut self, scene: &Scene) -> Vec<Finding> {
        let (model, forces, samples) = (&scene.model, scene.resolved.forces, self.samples as f64);
        let has_placed = scene.boxes() > 0;
        let touched = |row: &[f64]| row.iter().any(|force| *force != 0.0);
        let often = |link: &usize| {
            let own = self.snapshots.iter().skip(*link).step_by(forces);
            own.filter(|force| **force != 0.0).count() as f64 >= OFTEN * samples
        };
        let links = (forces > 0).then(|| (0..forces).filter(often).count() as f64);
        let contact = (forces > 0)
            .then(|| self.snapshots.chunks_exact(forces).filter(|row| touched(row)).count() as f64);
        let [snapshot, mean] = [&self.snapshots, &self.means].map(|values| top_share(values, forces));
        let [depths, shares] = [&mut self.depths, &mut self.shares].map(|values| {
            values.sort_by(f64::total_cmp);
            [0.5, 0.99, 1.0].map(|part| quantile(values, part))
        });
        let mm = |value: Option<f64>| value.map(|value| 1e3 * value);
        let deepest = if has_placed { PINCHED } else { DEEPEST };
        let limits = || (0..self.at_limit.len()).filter(|actuator| model.actuator_forcelimited()[*actuator]);
        let weakest =
            limits().max_by_key(|actuator| self.at_limit[*actuator]).filter(|_| self.any_at_limit > 0);
        let servos = servos(scene);
        let off = |slides: bool| {
            let own =
                servos.iter().zip(&self.off).filter(|(servo, _)| is_slide(model, servo.joint) == slides);
            own.max_by(|one, other| one.1.total_cmp(other.1)).filter(|_| self.free_ends > 0)
        };
        let joint_name = |joint: usize| name_of(model, JOINT, joint);
        let beyond = |slides: bool| {
            let own = limited(model).zip(&self.beyond).filter(|(joint, _)| is_slide(model, *joint) == slides);
            own.max_by(|one, other| one.1.total_cmp(other.1))
        };
        let finding = |name, unit, value, limit, of: Option<String>, advice| Finding {
            name,
            unit,
            value,
            limit,
            of: of.unwrap_or_default(),
            advice,
        };
        let most = |limit| Some(Limit::AtMost(limit));
        let softer = "make the contacts stiffer (a smaller first value of solref, at least twice the timestep), or limit the \
                      force that presses (forcerange of the actuators)";
        let spikes = "limit the force that presses (forcerange of the actuators), or damp the contacts (the second value of \
                      solref above 1) and the joints (damping)";
        let servo = "raise kp, let the model bear its own weight (gravcomp), or damp the joint (damping) so that it comes to \
                     rest";
        let describe = |name, unit, value| finding(name, unit, value, None, None, "");
        vec![
            finding(
                "samples with contact",
                "",
                contact.map(|count| count / samples),
                Some(Limit::AtLeast(TOUCHED)),
                None,
                "widen the range of the actuators in the world file towards what can be touched, or move objects there \
                 (placement)",
            ),
            describe("links touched in 1 % of the samples", "", links),
            finding(
                "pairs of link and placed body in a sample",
                "",
                has_placed.then(|| self.pairs as f64 / samples),
                Some(Limit::AtLeast(PAIRS)),
                None,
                "place more or larger bodies, nearer to where the robot goes (placement)",
            ),
            describe("penetration, median", "mm", mm(depths[0])),
            describe("penetration, 99 %", "mm", mm(depths[1])),
            describe("penetration, most", "mm", mm(depths[2])),
            finding("penetration, 99 %, in half the thickness", "", shares[1], most(DEEP), None, softer),
            finding("penetration, most, in half the thickness", "", shares[2], most(deepest), None, softer),
            finding("variance in the top 1 %, force", "", snapshot, most(TOP_SNAPSHOT), None, spikes),
            finding("variance in the top 1 %, mean force", "", mean, most(TOP_MEAN), None, spikes),
            finding(
                "hinge beyond its limit",
                "degrees",
                beyond(false).map(|(_, out)| out.to_degrees()),
                most(BEYOND_HINGE.to_degrees()),
                beyond(false).map(|(joint, _)| joint_name(joint)),
                "widen the joint's range, make its limit stiffer (solreflimit), or limit the force (forcerange)",
            ),
            finding(
                "slide beyond its limit, in its range",
                "",
                beyond(true).map(|(_, out)| *out),
                most(BEYOND_SLIDE),
                beyond(true).map(|(joint, _)| joint_name(joint)),
                "widen the joint's range, make its limit stiffer (solreflimit), or limit the force (forcerange)",
            ),
            finding(
                "hinge from its setpoint, untouched",
                "mrad",
                off(false).map(|(_, off)| 1e3 * off),
                most(1e3 * OFF),
                off(false).map(|(own, _)| joint_name(own.joint)),
                servo,
            ),
            finding(
                "slide from its setpoint, untouched",
                "mm",
                off(true).map(|(_, off)| 1e3 * off),
                most(1e3 * OFF),
                off(true).map(|(own, _)| joint_name(own.joint)),
                servo,
            ),
            describe(
                "ends of moves without contact",
                "",
                (self.ends > 0).then(|| self.free_ends as f64 / self.ends as f64),
            ),
            finding(
                "samples with an actuator at its limit",
                "",
                limits().next().map(|_| self.any_at_limit as f64 / samples),
                most(AT_LIMIT),
                weakest.map(|actuator| name_of(model, ACTUATOR, actuator)),
                "raise its forcerange, or narrow its range in the world file so that it presses less",
            ),
            describe("bodies asleep", "", can_sleep(model).then(|| self.asleep / samples)),
        ]
    }
}

/// Returns the geoms, the penetration, m, and the normal force, N, of each contact of what is sensed. The penetration is
/// negative within a margin.
fn contacts(
    scene: &Scene,
    data: &MjData<Arc<MjModel>>,
) -> impl Iterator<Item = ([Option<usize>; 2], f64, f64)> {
    data.contact().iter().enumerate().filter_map(|(index, contact)| {
        let geoms = contact.geom.map(|geom| usize::try_from(geom).ok());
        let flexes = contact.flex.map(|flex| usize::try_from(flex).ok());
        let is_sensed = geoms.iter().flatten().any(|geom| scene.resolved.force_of_geom[*geom].is_some())
            || flexes.iter().flatten().any(|flex| scene.resolved.force_of_flex[*flex].is_some());
        (is_sensed && contact.efc_address >= 0).then(|| (geoms, -contact.dist, data.contact_force(index)[0]))
    })
}

/// Returns the part of the variance of `[samples, width]` that the samples with the largest deviation from the mean hold;
/// `None` if nothing varies.
fn top_share(values: &[f64], width: usize) -> Option<f64> {
    let rows = || values.chunks_exact(width.max(1));
    let count = rows().len();
    let mean: Vec<f64> =
        (0..width).map(|column| rows().map(|row| row[column]).sum::<f64>() / count as f64).collect();
    let square = |row: &[f64]| row.iter().zip(&mean).map(|(value, mean)| (value - mean).powi(2)).sum::<f64>();
    let mut squares: Vec<f64> = rows().map(square).collect();
    squares.sort_by(f64::total_cmp);
    let total = squares.iter().sum::<f64>();
    let top = ((TOP * count as f64).round() as usize).max(1).min(count);
    (total > 0.0).then(|| squares[count - top..].iter().sum::<f64>() / total)
}

/// Returns a quantile of sorted values, linear between them; `None` if there are none.
fn quantile(sorted: &[f64], part: f64) -> Option<f64> {
    let place = part * (sorted.len().checked_sub(1)?) as f64;
    let (low, high) = (place.floor() as usize, place.ceil() as usize);
    Some(sorted[low] + (place - place.floor()) * (sorted[high] - sorted[low]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_of_the_top_samples_and_quantiles_are_those_by_hand() {
        // 200 samples of two forces, of which the last two are 1: the mean is 0.01, and they deviate by 0.99 twice.
        let mut values = [0.0; 400];
        values[396..].fill(1.0);
        let share = top_share(&values, 2).unwrap();
        assert!(
            (share - 0.99f64.powi(2) * 2.0 / (0.99f64.powi(2) * 2.0 + 198.0 * 1e-4)).abs() < 1e-12,
            "{share}"
        );
        assert_eq!((top_share(&[3.0; 8], 2), top_share(&[], 0)), (None, None));
        assert_eq!(quantile(&[0.0, 1.0, 2.0, 3.0], 0.5), Some(1.5));
        assert_eq!(quantile(&[], 0.5), None);
    }
}
