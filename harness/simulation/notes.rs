//! What a user should know about a world before recording it.

use super::SimulationError;
use super::camera::{SampleTime, time_rendering};
use super::features::features;
use super::flow::unrendered;
use super::joints::{ball_and_free, described, is_single, touches, word};
use super::names::{GEOM, JOINT, NAMES_SHOWN, name_of};
use super::physics::Physics;
use super::plan::EpisodePlan;
use super::resolve::is_pinhole;
use super::resolved::{PosedObject, Reading};
use super::scene::Scene;
use harness_shared::numbers::first_few;
use harness_spec::{Definition, Posed, Simulation};
use mujoco_rs::prelude::*;
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

/// How far a hinge (rad) or a slide (m) of a settled robot may move in a sample.
const STILL: f64 = 1e-3;
/// How many times as long as the fastest rendering the model's own must take to be worth a note.
const SLOW: f64 = 1.5;

/// The most simulation steps in which a vector must change, and the most time that they may take.
const TRIED_STEPS: usize = 20_000;
const TRIED_FOR: Duration = Duration::from_secs(2);

/// What is known about a world besides its layout.
pub struct Notes {
    /// A sentence for each property of the world that may surprise.
    pub notes: Vec<String>,
    /// The time that rendering a sample takes; `None` if no camera is recorded, or nothing can be rendered.
    pub rendering: Option<SampleTime>,
}

/// Examines a world at the start of its first episode, and measures how long rendering takes.
///
/// # Errors
/// When the boxes find no place, the simulation diverges, or rendering fails for another reason than a missing driver.
pub fn notes(scene: &Scene) -> Result<Notes, SimulationError> {
    let spec = scene.world().simulation();
    let mut physics = Physics::new(scene, &spec)?;
    physics.start(&EpisodePlan::draw(scene, &spec, 0)?);
    let data = physics.sampled().1;
    data.forward();
    let mut notes = Vec::new();
    notes.extend(integrator(scene));
    notes.extend(several_units(scene));
    notes.extend(unlimited(scene));
    notes.extend(features(scene));
    notes.extend(unsettled(scene, &spec)?);
    notes.extend(unrecorded_bodies(scene));
    notes.extend(unrecorded_forces(scene));
    notes.extend(unrendered_geoms(scene, data));
    let rendering = match time_rendering(scene, data) {
        Err(error @ SimulationError::NoRenderer(_)) => {
            notes.push(format!("rendering was not tried: {error}"));
            None
        }
        other => other?,
    };
    notes.extend(rendering.as_ref().and_then(slow_rendering));
    notes.extend(simulated(scene, physics)?);
    Ok(Notes { notes, rendering })
}

fn integrator(scene: &Scene) -> Option<String> {
    let note = "the model's integrator is RK4, so each sample takes one more evaluation of the dynamics, at the \
                sample's instant; a step of RK4 leaves poses, forces and images of a later instant";
    (scene.model.opt().integrator == MjtIntegrator::mjINT_RK4 as i32).then(|| note.to_owned())
}

/// Modalities whose elements have different units, so that their errors can't be added.
fn several_units(scene: &Scene) -> Vec<String> {
    let vectors = scene.layout().stored_vectors().filter(|definition| definition.unit().is_none());
    let note = |definition: &Definition| {
        let units: Vec<&str> = definition.by_unit().into_iter().map(|(unit, _)| unit).collect();
        let name = definition.name;
        format!(
            "the elements of '{name}' have the units {}, so its metrics are computed for each unit",
            units.join(", ")
        )
    };
    vectors.map(note).collect()
}

/// Actuators whose setpoints the model does not limit.
fn unlimited(scene: &Scene) -> Vec<String> {
    let actuators = scene.world().file().action.actuators.iter();
    let free = actuators
        .zip(&scene.resolved.actuators)
        .filter(|(_, driven)| driven.mocap.is_none() && driven.limits.map(f64::is_finite) == [false; 2]);
    free.map(|((element, actuator), _)| {
        let [low, high] = actuator.range;
        format!(
            "the model sets no ctrlrange for the actuator of '{element}', so only the world file limits it: [{low}, \
             {high}]"
        )
    })
    .collect()
}

/// The hinges and slides that move although the setpoints do not.
fn unsettled(scene: &Scene, spec: &Simulation) -> Result<Option<String>, SimulationError> {
    let mut physics = Physics::new(scene, spec)?;
    let plan = EpisodePlan::draw(scene, spec, 0)?;
    physics.start(&plan);
    for _ in 0..2 {
        physics.advance(|_, setpoint| plan.setpoint(0, setpoint))?;
    }
    let (model, instant) = (&scene.model, &physics.instant);
    let moved = |joint: &usize| {
        let place = model.jnt_qposadr()[*joint] as usize;
        (instant.state[place] - instant.state_before[place]).abs()
    };
    let joints = (0..model.njnt() as usize).filter(|joint| is_single(model, *joint));
    let mut joints: Vec<usize> = joints.filter(|joint| moved(joint) > STILL).collect();
    joints.sort_by(|one, other| moved(other).total_cmp(&moved(one)));
    let Some(most) = joints.first() else { return Ok(None) };
    let unit = if model.jnt_type()[*most] == MjtJoint::mjJNT_SLIDE { "m" } else { "rad" };
    let names: Vec<String> = joints.iter().map(|joint| name_of(model, JOINT, *joint)).collect();
    Ok(Some(format!(
        "an episode does not start settled: with the first setpoints, the joints {} move by up to {:.2e} {unit} until \
         the second sample",
        first_few(&names, NAMES_SHOWN),
        moved(most)
    )))
}

/// The indices of the ball and free joints whose bodies are not placed at random.
fn unplaced(scene: &Scene) -> Vec<usize> {
    let placed: BTreeSet<usize> = scene
        .resolved
        .placements
        .iter()
        .flat_map(|placement| &placement.boxes)
        .map(|body| body.qpos)
        .collect();
    let joints = ball_and_free(&scene.model).into_iter();
    joints.filter(|joint| !placed.contains(&(scene.model.jnt_qposadr()[*joint] as usize))).collect()
}

/// The ball and free joints of bodies whose poses are not recorded.
fn unrecorded_bodies(scene: &Scene) -> Option<String> {
    let model = &scene.model;
    let body = |PosedObject { of, id, .. }: &PosedObject| match of {
        Posed::Body => model.body_weldid()[*id],
        Posed::Site => model.body_weldid()[model.site_bodyid()[*id] as usize],
    };
    let recorded: BTreeSet<i32> = scene.resolved.posed.iter().map(body).collect();
    let is_read = |joint: usize| {
        let end = model.jnt_qposadr()[joint] as usize + if word(model, joint) == "free" { 3 } else { 0 };
        scene.resolved.readings.iter().flatten().any(|reading| *reading == Reading::Orientation(end, 0))
    };
    let mut joints = unplaced(scene);
    joints.retain(|joint| !recorded.contains(&model.jnt_bodyid()[*joint]) && !is_read(*joint));
    let names: Vec<String> = joints.into_iter().map(|joint| described(model, joint)).collect();
    (!names.is_empty()).then(|| {
        format!(
            "no modality records {}; body_positions and body_orientations can",
            first_few(&names, NAMES_SHOWN)
        )
    })
}

/// The geoms that ball and free joints move and whose contacts are not sensed, if the contacts of others are.
fn unrecorded_forces(scene: &Scene) -> Option<String> {
    let (model, unplaced) = (&scene.model, unplaced(scene));
    let is_left_out = |geom: &usize| {
        scene.resolved.force_of_geom[*geom].is_none()
            && touches(model, *geom, |joint| !is_single(model, joint) && unplaced.contains(&joint))
    };
    let geoms: Vec<usize> = (0..model.ngeom() as usize).filter(is_left_out).collect();
    let names: Vec<String> = geoms.into_iter().map(|geom| name_of(model, GEOM, geom)).collect();
    (scene.resolved.forces > 0 && !names.is_empty())
        .then(|| format!("no modality records the forces on the geoms {}", first_few(&names, NAMES_SHOWN)))
}

/// The geoms that a camera would see if it were not inside them.
fn unrendered_geoms(scene: &Scene, data: &mut MjData<std::sync::Arc<MjModel>>) -> Vec<String> {
    let mut notes: Vec<String> = Vec::new();
    for image in scene.images().filter(|image| is_pinhole(&scene.model, image.camera)) {
        let geoms = unrendered(data, &image);
        let names: Vec<String> = geoms.into_iter().map(|geom| name_of(&scene.model, GEOM, geom)).collect();
        if !names.is_empty() {
            notes.push(format!(
                "the camera of '{}' is inside of {}, or nearer than the model's near plane, so its image shows what is \
                 behind",
                image.modality,
                first_few(&names, NAMES_SHOWN)
            ));
        }
    }
    notes
}

/// Simulates the world's episodes until every vector has changed, for a limited time, or until they diverge. Notes the
/// vectors that stay the same, such as the forces of contacts that do not happen.
fn simulated(scene: &Scene, mut physics: Physics) -> Result<Vec<String>, SimulationError> {
    let spec = scene.world().simulation();
    let is_stored = |one: &Definition| one.name.is_sensed() && !one.is_image() && one.difference_of.is_none();
    let sensed = || scene.layout().modalities.iter().enumerate().filter(|(_, one)| is_stored(one));
    // Those that have not changed so far, each with its values at the first sample.
    let mut same: Vec<(usize, &Definition, Vec<f32>)> = Vec::new();
    let (begin, mut samples) = (Instant::now(), 0);
    'episodes: for episode in 0.. {
        let plan = EpisodePlan::draw(scene, &spec, episode)?;
        physics.start(&plan);
        for _ in 0..physics.timing.samples {
            let is_over =
                samples * physics.timing.steps_per_sample >= TRIED_STEPS || begin.elapsed() > TRIED_FOR;
            if is_over || samples > 0 && same.is_empty() || physics.follow(&plan).is_err() {
                break 'episodes;
            }
            let (instant, _) = physics.sampled();
            let values = |place: usize| instant.vector(scene, place);
            if samples == 0 {
                same = sensed().map(|(place, one)| (place, one, values(place).collect())).collect();
            }
            same.retain(|(place, _, first)| values(*place).eq(first.iter().copied()));
            samples += 1;
        }
    }
    let seconds = samples as f64 / spec.sample_rate_hz;
    let note = |(_, definition, first): (usize, &Definition, Vec<f32>)| {
        let is = if first.iter().all(|value| *value == 0.0) { "is 0" } else { "does not change" };
        format!(
            "'{}' {is} in {seconds:.0} s of simulation; if it is so in all test samples, its r2 is not defined",
            definition.name
        )
    };
    Ok(same.into_iter().map(note).filter(|_| samples > 1).collect())
}

fn slow_rendering(time: &SampleTime) -> Option<String> {
    let plain = time.plain_s?;
    let note = format!(
        "rendering a sample takes {:.1} ms, and {:.1} ms without shadows and smooth edges; to collect faster, write \
         `<visual><quality shadowsize=\"0\" offsamples=\"0\"/></visual>` into the MJCF",
        1e3 * time.own_s,
        1e3 * plain
    );
    (time.own_s > SLOW * plain).then_some(note)
}
