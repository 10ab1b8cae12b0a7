//! The simulated world, compared with MuJoCo's own sensors and Python's `mujoco`, and mistakes that users can make.

use finger::{ARM_JOINTS, BOXES, FRAME_LEN, FRAME_SIDE, JOINTS};
use harness_metrics::parts::region_of;
use harness_simulation::{
    Batch, Episode, EpisodePlan, LiveSimulation, Scene, SceneRenderer, SimulationError, Simulator, replay,
};
use harness_spec::{IMAGE_CHANNELS, Layout, Modality, Scenario, Setting, Simulation, World};
use mujoco_rs::prelude::*;
use std::ffi::OsStr;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::Command;

#[path = "simulation/course.rs"]
mod course;
#[path = "simulation/factors.rs"]
mod factors;
#[path = "common/finger.rs"]
mod finger;
#[path = "simulation/fitness.rs"]
mod fitness;
#[path = "simulation/flow.rs"]
mod flow;
#[path = "simulation/integrators.rs"]
mod integrators;
#[path = "simulation/meaning.rs"]
mod meaning;
#[path = "simulation/parts.rs"]
mod parts;
#[path = "simulation/placement.rs"]
mod placement;
#[path = "simulation/probing.rs"]
mod probing;
#[path = "simulation/sight.rs"]
mod sight;

/// Path of the repository.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

const STEPS_PER_SAMPLE: usize = 100;

/// Heights of the pillars of the world `crowded`, m.
const PILLAR_HEIGHTS: [f32; 7] = [0.21, 0.25, 0.29, 0.33, 0.37, 0.41, 0.45];

fn crowded() -> Scenario {
    Scenario::new("crowded").unwrap()
}

fn scene(scenario: Scenario) -> Scene {
    Scene::paper(scenario).unwrap()
}

fn live(scenario: Scenario) -> LiveSimulation {
    LiveSimulation::new(Scene::shared(World::paper(scenario)).unwrap(), &short()).unwrap()
}

fn setpoint(plan: &EpisodePlan, step: usize) -> [f64; ARM_JOINTS] {
    let mut setpoint = [0.0; ARM_JOINTS];
    plan.setpoint(step, &mut setpoint);
    setpoint
}

/// Three episodes of ten seconds each.
fn short() -> Simulation {
    Simulation { episodes: 3, actuations_per_episode: 10, ..Default::default() }
}

fn simulate(scene: &Scene, spec: &Simulation, index: u32) -> Episode {
    Simulator::new(scene, spec).unwrap().run(index, &mut || ControlFlow::Continue(())).unwrap()
}

fn columns(values: &[f32], width: usize) -> Vec<Vec<f32>> {
    (0..width).map(|column| values.iter().skip(column).step_by(width).copied().collect()).collect()
}

fn varies(values: &[f32]) -> bool {
    values.iter().any(|value| *value != values[0])
}

#[test]
fn scenarios_record_finite_varying_observations_in_their_shape() {
    for scenario in Scenario::PAPER {
        let (scene, spec) = (scene(scenario), short());
        let episode = simulate(&scene, &spec, 0);
        let n = 100;
        assert_eq!((episode.index, episode.samples), (0, n));
        let arrays = [
            ("proprioception", episode.vector(Modality::PROPRIOCEPTION), JOINTS),
            ("arm", episode.vector(Modality::ARM), ARM_JOINTS),
            ("setpoint", episode.vector(Modality::SETPOINT), ARM_JOINTS),
            ("contact_force", episode.vector(Modality::CONTACT_FORCE), JOINTS),
            ("contact_force_mean", episode.vector(Modality::CONTACT_FORCE_MEAN), JOINTS),
        ];
        for (name, values, width) in arrays {
            assert_eq!(values.len(), n * width, "{scenario} {name}");
            assert!(values.iter().all(|value| value.is_finite()), "{scenario} {name}");
            for (index, column) in columns(values, width).iter().enumerate() {
                // Upper links may stay untouched, but not the tip.
                let must_vary = !name.starts_with("contact") || index == JOINTS - 1;
                assert!(varies(column) || !must_vary, "{scenario} {name} {index} is constant");
            }
        }
        assert!(
            episode.vector(Modality::CONTACT_FORCE).iter().all(|force| *force >= 0.0),
            "normal forces only push"
        );
        assert_eq!(episode.image(Modality::VISION).len(), n * FRAME_LEN);
        let frames: Vec<_> = episode.image(Modality::VISION).chunks(FRAME_LEN).collect();
        let moving = frames.windows(2).filter(|pair| pair[0] != pair[1]).count();
        assert!(moving > 9 * n / 10, "{scenario}: only {moving} of {n} frames differ from the one before");
        assert_eq!(episode.boxes.len(), if scenario == Scenario::CLUTTERED { BOXES } else { 0 });
        assert!(!episode.renderer.is_empty() && episode.renderer != "unknown");
    }
}

#[test]
fn an_episode_starts_at_rest_and_the_arm_follows_its_setpoint_where_nothing_is_touched() {
    for scenario in Scenario::PAPER {
        let (scene, spec) = (scene(scenario), short().with("lift_range_m", Setting::Range([-0.05, 0.0])));
        let episode = simulate(&scene, &spec, 1);
        assert_eq!(episode.vector(Modality::PROPRIOCEPTION)[..JOINTS], [0.0; JOINTS]);
        assert_eq!(episode.vector(Modality::CONTACT_FORCE)[..JOINTS], [0.0; JOINTS]);
        assert_eq!(
            episode.vector(Modality::ARM)[..ARM_JOINTS],
            episode.vector(Modality::SETPOINT)[..ARM_JOINTS]
        );
        assert_eq!(episode.vector(Modality::SETPOINT)[..ARM_JOINTS], [std::f32::consts::PI, 0.0, 0.0]);
        let plan = EpisodePlan::draw(&scene, &spec, 1).unwrap();
        for (sample, row) in episode.vector(Modality::SETPOINT).chunks(ARM_JOINTS).enumerate() {
            assert_eq!(row, setpoint(&plan, sample * STEPS_PER_SAMPLE).map(|value| value as f32));
        }
        for (arm, setpoint) in episode.vector(Modality::ARM).iter().zip(episode.vector(Modality::SETPOINT)) {
            assert!(
                (arm - setpoint).abs() < 0.05,
                "{scenario}: the arm is at {arm}, commanded to {setpoint}"
            );
        }
    }
}

#[test]
fn an_episode_depends_on_its_seed_scenario_and_index_alone() {
    for scenario in Scenario::PAPER {
        let (scene, spec) = (scene(scenario), Simulation { actuations_per_episode: 4, ..short() });
        let alone = simulate(&scene, &spec, 2);
        let after_others = std::thread::scope(|threads| {
            let worker = threads.spawn(|| {
                let mut simulator = Simulator::new(&scene, &spec).unwrap();
                [0, 1, 2].map(|index| simulator.run(index, &mut || ControlFlow::Continue(())).unwrap())
            });
            worker.join().unwrap()
        });
        assert!(alone == after_others[2], "{scenario}: the same episode differs between two simulators");
        assert_ne!(after_others[0].vector(Modality::SETPOINT), after_others[1].vector(Modality::SETPOINT));
        let reseeded = simulate(&scene, &Simulation { seed: 1, ..spec }, 2);
        assert_ne!(alone.vector(Modality::SETPOINT), reseeded.vector(Modality::SETPOINT));
    }
    let setpoints = Scenario::PAPER.iter().map(|&scenario| simulate(&scene(scenario), &short(), 0).vectors);
    let setpoints: Vec<_> = setpoints.collect();
    assert_ne!(setpoints[0], setpoints[1]);
}

/// The sensor values of a live simulation, as an episode of one sample.
fn sensed(live: &mut LiveSimulation) -> Episode {
    let mut episode = Episode::new(live.scene().layout().clone(), 0, 1);
    for (index, definition) in live.scene().layout().modalities.iter().enumerate() {
        if let Some(values) = live.vector(definition.name) {
            episode.vectors[index] = values;
        } else if definition.difference_of.is_none() {
            episode.images[index] = vec![0; definition.width()];
            live.image(definition.name, &mut episode.images[index]).unwrap();
        }
    }
    episode
}

/// One sample of an episode, as an episode.
fn sample_of(episode: &Episode, sample: usize) -> Episode {
    let mut one = Episode::new(episode.layout.clone(), 0, 1);
    for (index, definition) in episode.layout.modalities.iter().enumerate() {
        let width = definition.width();
        if !episode.vectors[index].is_empty() {
            one.vectors[index] = episode.vectors[index][sample * width..][..width].to_vec();
        }
        if !episode.images[index].is_empty() {
            one.images[index] = episode.images[index][sample * width..][..width].to_vec();
        }
    }
    one
}

#[test]
fn a_live_simulation_of_an_episodes_course_senses_it_bit_by_bit() {
    for scenario in Scenario::PAPER {
        let (scene, spec) = (scene(scenario), short());
        let mut live = live(scenario);
        // A reset from another state must leave nothing of what was simulated before.
        live.step(&[3.0, -0.9, 0.4]).unwrap();
        for index in [1, 0] {
            let episode = simulate(&scene, &spec, index);
            live.reset(spec.seed, index).unwrap();
            for sample in 0..episode.samples {
                assert!(sensed(&mut live) == sample_of(&episode, sample), "{scenario} {index} {sample}");
                live.follow().unwrap();
            }
        }
    }
}

#[test]
fn a_live_arm_goes_evenly_to_its_setpoint_within_the_ranges() {
    let mut live = live(Scenario::EMPTY);
    let start = live.setpoint().to_vec();
    let wanted = [start[0] + 0.02, -0.015, 0.02];
    live.step(&wanted).unwrap();
    assert_eq!(live.setpoint(), wanted);
    // The gains delay the setpoint by kv / kp, which is 7 ms of 100 ms.
    for joint in 0..ARM_JOINTS {
        let lag = (wanted[joint] - f64::from(live.vector(Modality::ARM).unwrap()[joint]))
            / (wanted[joint] - start[joint]);
        assert!((0.0..0.15).contains(&lag), "joint {joint} lags by {lag}");
    }
    live.step(&[99.0, 99.0, -99.0]).unwrap();
    assert_eq!(live.setpoint(), [1.25 * std::f64::consts::PI, 0.0, 0.0]);
    let refused = live.step(&[f64::NAN, 0.0, 0.0]).unwrap_err().to_string();
    assert!(refused.contains("finite"), "{refused}");
}

#[test]
fn the_fingertip_hangs_where_the_finger_ends() {
    // At rest the finger hangs straight from the mount at (-0.7, 0, 1.5) m, and is 1 m long.
    let tip = live(Scenario::EMPTY).fingertip().unwrap();
    for (found, expected) in tip.into_iter().zip([-0.7, 0.0, 0.5]) {
        assert!((found - expected).abs() < 1e-6, "{tip:?}");
    }
}

#[test]
fn a_batch_steps_as_its_simulations_do_one_by_one() {
    let mut batch =
        Batch::new(Scene::shared(World::paper(Scenario::CLUTTERED)).unwrap(), &short(), 3).unwrap();
    let mut alone = live(Scenario::CLUTTERED);
    (0..3).for_each(|index| batch.reset(index, 7, index as u32).unwrap());
    let setpoints = |sample: usize| {
        [0, 1, 2].map(|index| vec![3.0 + 0.01 * (index * sample) as f64, -0.1 * sample as f64, 0.3])
    };
    for sample in 1..10 {
        // The last simulation is not stepped after five samples.
        batch.step(&setpoints(sample), &[true, true, sample <= 5]).unwrap();
    }
    let mut frames = vec![0; 3 * FRAME_LEN];
    batch.image(Modality::VISION, &mut frames).unwrap();
    for (index, samples) in [9, 9, 5].into_iter().enumerate() {
        alone.reset(7, index as u32).unwrap();
        (1..=samples).for_each(|sample| alone.step(&setpoints(sample)[index]).unwrap());
        let member = &batch.simulations()[index];
        assert_eq!(
            member.vector(Modality::PROPRIOCEPTION).unwrap(),
            alone.vector(Modality::PROPRIOCEPTION).unwrap()
        );
        assert_eq!(
            member.vector(Modality::CONTACT_FORCE_MEAN).unwrap(),
            alone.vector(Modality::CONTACT_FORCE_MEAN).unwrap()
        );
        assert!(member.boxes().eq(alone.boxes()));
        assert!(frames[index * FRAME_LEN..][..FRAME_LEN] == sensed(&mut alone).image(Modality::VISION)[..]);
    }
}

#[test]
fn wrong_calls_of_a_batch_name_what_is_wrong() {
    let scene = Scene::shared(World::paper(Scenario::EMPTY)).unwrap();
    let failure = |count| Batch::new(scene, &short(), count).err().unwrap().to_string();
    assert!(failure(0).contains("count"));
    assert!(failure(100_000).contains("count"));
    let mut batch = Batch::new(scene, &short(), 2).unwrap();
    let nan = vec![f64::NAN, 0.0, 0.0];
    assert!(batch.reset(2, 0, 0).unwrap_err().to_string().contains("index"));
    assert!(batch.step(&[vec![0.0; 3]], &[true; 2]).unwrap_err().to_string().contains("setpoints"));
    assert!(
        batch.step(&[vec![3.0, 0.0, 0.0], nan], &[true; 2]).unwrap_err().to_string().contains("simulation 1")
    );
}

/// The scenario's scene with a touch sensor on each link, and this friction cone.
fn scene_with_touch_sensors(scenario: Scenario, cone: MjtCone) -> Scene {
    let mut spec = MjSpec::from_xml_string(scene(scenario).xml()).unwrap();
    spec.option_mut().cone = cone as i32;
    for link in 0..JOINTS {
        let name = format!("touch_{link:02}");
        let body = spec.world_body_mut().child_mut(&format!("finger_link_{link:02}")).unwrap();
        // The site is large enough for all contacts of the link. The sensor counts only contacts of this body.
        body.add_site().with_name(&name).with_size([0.2; 3]);
        let sensor = spec.add_sensor().with_name(&name).with_objname(&name);
        sensor.with_type(MjtSensor::mjSENS_TOUCH).with_objtype(MjtObjBase::mjOBJ_SITE);
    }
    spec.compile().unwrap();
    let xml = spec.save_xml_string(1 << 20).unwrap();
    Scene::from_xml(World::paper(scenario), &xml, "a scene with touch sensors".to_owned()).unwrap()
}

#[test]
fn contact_forces_are_those_of_mujocos_touch_sensors() {
    // The finger is pressed on the ground for the whole episode except its start.
    let spec = Simulation { actuations_per_episode: 6, ..Default::default() }
        .with("lift_range_m", Setting::Range([-1.0, -0.8]));
    for cone in [MjtCone::mjCONE_PYRAMIDAL, MjtCone::mjCONE_ELLIPTIC] {
        for scenario in Scenario::PAPER {
            let scene = scene_with_touch_sensors(scenario, cone);
            let plan = EpisodePlan::draw(&scene, &spec, 0).unwrap();
            let episode = simulate(&scene, &spec, 0);
            let mut data = MjData::new(scene.model());
            data.qpos_mut().copy_from_slice(&replay(&scene, &spec, 0).unwrap()[0]);
            let mut sums = [0.0; JOINTS];
            let mut touched = [0; JOINTS];
            for step in 0..=(episode.samples - 1) * STEPS_PER_SAMPLE {
                data.ctrl_mut().copy_from_slice(&setpoint(&plan, step));
                data.step();
                for link in 0..JOINTS {
                    let touch = data.sensordata()[link];
                    sums[link] += touch;
                    touched[link] += usize::from(touch > 0.0);
                }
                if step % STEPS_PER_SAMPLE == 0 {
                    let sample = step / STEPS_PER_SAMPLE;
                    let steps = if sample == 0 { 1 } else { STEPS_PER_SAMPLE };
                    let row = sample * JOINTS..(sample + 1) * JOINTS;
                    assert_close(&episode.vector(Modality::CONTACT_FORCE)[row.clone()], data.sensordata());
                    assert_close(
                        &episode.vector(Modality::CONTACT_FORCE_MEAN)[row],
                        &sums.map(|sum| sum / steps as f64),
                    );
                    sums = [0.0; JOINTS];
                }
            }
            assert!(touched[JOINTS - 1] > 1000, "{scenario}: the tip hardly touches anything: {touched:?}");
        }
    }
}

/// Expected values come from `mj_contactForce` and the names of the geoms that touch.
#[test]
fn the_kind_of_a_contact_is_that_of_the_largest_force() {
    let scene = scene(Scenario::CLUTTERED);
    let spec = Simulation { actuations_per_episode: 10, ..Default::default() }
        .with("lift_range_m", Setting::Range([-1.0, -0.8]));
    let [recorded, mean] =
        ["contact_force_kind", "contact_force_mean_kind"].map(|name| Modality::new(name).unwrap());
    let (mut seen, mut differ) = ([0; 4], 0);
    for index in 0..3 {
        let plan = EpisodePlan::draw(&scene, &spec, index).unwrap();
        let episode = simulate(&scene, &spec, index);
        let mut data = MjData::new(scene.model());
        data.qpos_mut().copy_from_slice(&replay(&scene, &spec, index).unwrap()[0]);
        let mut impulses = [[0.0; 3]; JOINTS];
        for step in 0..=(episode.samples - 1) * STEPS_PER_SAMPLE {
            data.ctrl_mut().copy_from_slice(&setpoint(&plan, step));
            data.step();
            let name =
                |geom: i32| scene.model().id_to_name(MjtObjBase::mjOBJ_GEOM, geom as usize).unwrap_or("");
            // For each link the sum of the forces by kind: ground, box, other.
            let mut sums = [[0.0; 3]; JOINTS];
            for (contact, touch) in data.contact().iter().enumerate() {
                for (one, other) in [(0, 1), (1, 0)] {
                    let Some(link) = name(touch.geom[one]).strip_prefix("finger_link_") else { continue };
                    let kind = match name(touch.geom[other]) {
                        "ground" => 0,
                        other if other.starts_with("box_") => 1,
                        _ => 2,
                    };
                    sums[link.parse::<usize>().unwrap()][kind] += data.contact_force(contact)[0];
                }
            }
            for (impulses, sums) in impulses.iter_mut().zip(&sums) {
                impulses.iter_mut().zip(sums).for_each(|(impulse, sum)| *impulse += sum);
            }
            if step % STEPS_PER_SAMPLE != 0 {
                continue;
            }
            let largest = |sums: &[f64; 3]| {
                let kinds = (0..3).filter(|kind| sums[*kind] > 0.0);
                kinds.max_by(|a, b| sums[*a].total_cmp(&sums[*b])).map_or(0, |kind| kind + 1)
            };
            let first = step / STEPS_PER_SAMPLE * JOINTS;
            for (link, (sums, impulses)) in sums.iter().zip(&impulses).enumerate() {
                let [now, since] = [sums, impulses].map(largest);
                assert_eq!(episode.vector(recorded)[first + link], now as f32, "link {link}: {sums:?}");
                assert_eq!(episode.vector(mean)[first + link], since as f32, "link {link}: {impulses:?}");
                seen[now] += 1;
                differ += usize::from(now != since);
            }
            impulses = [[0.0; 3]; JOINTS];
        }
    }
    assert!(seen[..3].iter().all(|count| *count > 10) && differ > 10, "{seen:?}, {differ}");
}

/// Checks that values are equal up to the rounding of a 32-bit float.
fn assert_close(recorded: &[f32], expected: &[f64]) {
    assert_eq!(recorded.len(), expected.len());
    for (recorded, expected) in recorded.iter().zip(expected) {
        let error = (f64::from(*recorded) - expected).abs();
        assert!(error <= 1e-6 * expected.abs(), "recorded {recorded}, expected {expected}");
    }
}

#[test]
fn a_finger_that_hangs_free_feels_nothing() {
    let spec = short().with("lift_range_m", Setting::Range([-0.2, 0.0]));
    let episode = simulate(&scene(Scenario::EMPTY), &spec, 0);
    assert!(
        episode
            .vector(Modality::CONTACT_FORCE)
            .iter()
            .chain(episode.vector(Modality::CONTACT_FORCE_MEAN))
            .all(|force| *force == 0.0)
    );
}

#[test]
fn boxes_keep_their_clearance_and_leave_the_finger_room() {
    let (scene, spec) = (scene(Scenario::CLUTTERED), Simulation::default());
    let geom = |name: &str| scene.model().name_to_id(MjtObjBase::mjOBJ_GEOM, name).unwrap();
    let boxes: Vec<_> = (0..BOXES).map(|index| geom(&format!("box_{index}"))).collect();
    let finger: Vec<_> = (0..JOINTS).map(|link| geom(&format!("finger_link_{link:02}"))).collect();
    let single = Simulation { actuations_per_episode: 1, sample_rate_hz: 1.0, ..spec.clone() };
    let mut layouts = Vec::new();
    for episode in 0..100 {
        let mut data = MjData::new(scene.model());
        data.qpos_mut().copy_from_slice(&replay(&scene, &single, episode).unwrap()[0]);
        data.forward();
        for (index, &one) in boxes.iter().enumerate() {
            let others = boxes[index + 1..].iter().chain(&finger);
            for &other in others {
                let distance = data.geom_distance(one, other, 1.0, None);
                assert!(distance >= 0.05 - 1e-6, "episode {episode}: {distance} m");
            }
            // The box is on the ground, and below a place that the finger can reach.
            let [x, y, z] = data.geom_xpos()[one];
            let (radius, bearing) = (x.hypot(y), y.atan2(x).rem_euclid(std::f64::consts::TAU));
            assert!((z - 0.2).abs() < 1e-9 && (0.7..=2.2).contains(&radius), "{x} {y} {z}");
            let [low, high] = [0.75, 1.25].map(|part| part * std::f64::consts::PI);
            assert!((low - 1e-9..=high + 1e-9).contains(&bearing), "bearing {bearing}");
        }
        layouts.push(EpisodePlan::draw(&scene, &single, episode).unwrap().boxes);
    }
    assert!(layouts.windows(2).all(|pair| pair[0] != pair[1]));
}

#[test]
fn pillars_stay_in_place_and_the_finger_often_touches_them() {
    let scene = scene(crowded());
    let spec = Simulation { actuations_per_episode: 4, ..Default::default() };
    let [places, kinds] = ["pillars", "contact_force_kind"].map(|name| Modality::new(name).unwrap());
    let (mut samples, mut on_pillars) = (0, 0);
    for index in 0..30 {
        let episode = simulate(&scene, &spec, index);
        let first = &episode.vector(places)[..3 * PILLAR_HEIGHTS.len()];
        for place in episode.vector(places).chunks_exact(first.len()) {
            assert!(
                place.iter().zip(first).all(|(now, before)| (now - before).abs() < 1e-3),
                "{index}: {place:?}"
            );
        }
        for (pillar, height) in first.chunks_exact(3).zip(PILLAR_HEIGHTS) {
            assert!((pillar[2] - height / 2.0).abs() < 1e-6, "episode {index}: {pillar:?}");
        }
        samples += episode.samples;
        on_pillars += episode.vector(kinds).chunks_exact(JOINTS).filter(|links| links.contains(&2.0)).count();
    }
    let share = on_pillars as f64 / samples as f64;
    assert!((0.15..0.4).contains(&share), "{share}");
}

/// `crowded_moving.yaml` repeats `crowded.yaml`, because a world file can't include another.
#[test]
fn the_crowded_worlds_differ_in_their_models_alone() {
    let settings = |name: &str| {
        let file = Path::new(ROOT).join(format!("models/{name}.yaml"));
        let text = std::fs::read_to_string(file).unwrap();
        let (head, settings) = text.split_once("step_rate_hz").unwrap();
        assert!(head.ends_with(&format!("model: {name}.xml\n")), "{head}");
        settings.to_owned()
    };
    assert_eq!(settings("crowded_moving"), settings("crowded"));
}

#[test]
fn light_pillars_are_pushed_away() {
    let scene = scene(Scenario::new("crowded_moving").unwrap());
    let spec = Simulation { actuations_per_episode: 4, ..Default::default() };
    let places = Modality::new("pillars").unwrap();
    let mut moved_m = Vec::new();
    for index in 0..30 {
        let episode = simulate(&scene, &spec, index);
        let width = 3 * PILLAR_HEIGHTS.len();
        let places = episode.vector(places);
        let (first, last) = (&places[..width], &places[places.len() - width..]);
        let distance = |(a, b): (&[f32], &[f32])| (a[0] - b[0]).hypot(a[1] - b[1]);
        moved_m.extend(first.chunks_exact(3).zip(last.chunks_exact(3)).map(distance));
    }
    // Of 300 episodes, models/README.md: 20 % of the pillars by more than 1 cm.
    let share = moved_m.iter().filter(|distance| **distance > 0.01).count() as f64 / moved_m.len() as f64;
    assert!((0.1..0.3).contains(&share), "{share}");
}

#[test]
fn boxes_that_cannot_be_placed_are_an_error() {
    let spec = Simulation::default().with("box_clearance_m", Setting::Number(2.0));
    let error = EpisodePlan::draw(&scene(Scenario::CLUTTERED), &spec, 5).unwrap_err().to_string();
    assert!(error.contains("episode 5") && error.contains("box_clearance_m"), "{error}");
}

#[test]
fn a_bent_finger_comes_to_rest_without_swinging() {
    let scene = scene(Scenario::EMPTY);
    let mut data = MjData::new(scene.model());
    let start = replay(&scene, &short(), 0).unwrap().swap_remove(0);
    let ctrl = setpoint(&EpisodePlan::draw(&scene, &short(), 0).unwrap(), 0);
    data.qpos_mut().copy_from_slice(&start);
    data.ctrl_mut().copy_from_slice(&ctrl);
    let id = |kind, name: &str| scene.model().name_to_id(kind, name).unwrap();
    let tip = id(MjtObjBase::mjOBJ_GEOM, "finger_link_19");
    data.forward();
    let hanging = data.geom_xpos()[tip];
    for joint in (0..JOINTS).step_by(2) {
        let joint = id(MjtObjBase::mjOBJ_JOINT, &format!("finger_joint_{joint:02}"));
        data.qpos_mut()[scene.model().jnt_qposadr()[joint] as usize] = 0.1;
    }
    data.forward();
    // The finger bends about y: x tells on which side of its rest the tip is.
    let offset = |data: &MjData<&MjModel>| data.geom_xpos()[tip][0] - hanging[0];
    let bent = offset(&data);
    assert!(bent.abs() > 0.3, "bent by {bent} m only");
    let offsets: Vec<f64> = (0..3000)
        .map(|_| {
            data.step();
            offset(&data) / bent
        })
        .collect();
    let overshoot = offsets.iter().fold(0.0, |worst: f64, offset| worst.max(-offset));
    let settled = offsets.iter().rposition(|offset| offset.abs() > 0.05).unwrap() + 1;
    println!("settles to 5 % in {settled} ms, overshoots by {overshoot:.4} of the bend");
    assert!(overshoot < 0.1, "swings to the other side by {overshoot} of the bend");
    assert!(settled < 500, "needs {settled} ms to settle: half an actuation");
}

/// Runs a script of tests/python in the project's virtual environment.
fn python(script: &str, arguments: &[&dyn AsRef<OsStr>]) {
    let root = Path::new(ROOT);
    let output = Command::new(root.join(".venv/bin/python"))
        .arg(root.join("tests/python").join(script))
        .args(arguments.iter().map(|argument| argument.as_ref()))
        .output()
        .expect("the virtual environment is there: run `make setup`");
    assert!(output.status.success(), "{script}: {}", String::from_utf8_lossy(&output.stderr));
}

fn write_floats<'a>(path: &Path, values: impl IntoIterator<Item = &'a f64>) {
    let bytes: Vec<u8> = values.into_iter().flat_map(|value| value.to_le_bytes()).collect();
    std::fs::write(path, bytes).unwrap();
}

/// Files with the first short episode of a scenario, for a script that simulates it again.
struct Trajectory {
    folder: tempfile::TempDir,
    states: Vec<Vec<f64>>,
}

impl Trajectory {
    fn of(scenario: Scenario) -> Self {
        let (scene, spec) = (scene(scenario), short());
        let states = replay(&scene, &spec, 0).unwrap();
        let plan = EpisodePlan::draw(&scene, &spec, 0).unwrap();
        let steps = (states.len() - 1) * STEPS_PER_SAMPLE + 1;
        let controls: Vec<_> = (0..steps).flat_map(|step| setpoint(&plan, step)).collect();
        let trajectory = Self { folder: tempfile::tempdir().unwrap(), states };
        write_floats(&trajectory.file("start"), &trajectory.states[0]);
        write_floats(&trajectory.file("controls"), &controls);
        trajectory
    }

    fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Runs a script on the repository's model file. Its positions must be the same, bit by bit.
    fn assert_same(&self, scenario: Scenario, script: &str, options: &[&str]) {
        let model = Path::new(ROOT).join(format!("models/{scenario}.xml"));
        let (start, controls, positions) =
            (self.file("start"), self.file("controls"), self.file("positions"));
        let every = STEPS_PER_SAMPLE.to_string();
        let mut arguments: Vec<&dyn AsRef<OsStr>> = vec![&model, &start, &controls, &every];
        arguments.extend(options.iter().map(|option| option as &dyn AsRef<OsStr>));
        arguments.push(&positions);
        python(script, &arguments);
        let theirs = std::fs::read(&positions).unwrap();
        let ours: Vec<u8> = self.states.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
        assert_eq!(self.states.len(), 100);
        assert!(ours == theirs, "{scenario}: the trajectory of {script} {options:?} differs");
    }
}

#[test]
fn a_trajectory_is_pythons_bit_by_bit() {
    for scenario in Scenario::PAPER {
        Trajectory::of(scenario).assert_same(scenario, "trajectory.py", &[]);
    }
}

#[test]
fn a_trajectory_is_dm_controls_bit_by_bit() {
    for scenario in Scenario::PAPER {
        let trajectory = Trajectory::of(scenario);
        for stepping in ["legacy", "plain"] {
            trajectory.assert_same(scenario, "dm_control_trajectory.py", &[stepping]);
        }
    }
}

#[test]
fn frames_are_those_of_pythons_renderer() {
    for scenario in Scenario::PAPER {
        let (scene, spec) = (scene(scenario), short());
        let states = replay(&scene, &spec, 0).unwrap();
        let episode = simulate(&scene, &spec, 0);
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| folder.path().join(name);
        std::fs::write(file("model.xml"), scene.xml()).unwrap();
        write_floats(&file("positions"), states.iter().flatten());
        let paths = ["model.xml", "positions", "frames"].map(file);
        python("render_frames.py", &[&paths[0], &paths[1], &FRAME_SIDE.to_string(), &paths[2]]);
        let theirs = std::fs::read(&paths[2]).unwrap();
        assert_eq!(episode.image(Modality::VISION).len(), theirs.len());
        let worst = episode.image(Modality::VISION).iter().zip(&theirs).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst <= Some(1), "{scenario}: a pixel differs by {worst:?}");
    }
}

/// 150 sites that nobody sees, and a red one in front of the camera. MuJoCo draws sites in their order.
#[test]
fn images_show_all_sites_of_a_model_with_many() {
    let sites = "<site pos=\"0 0 -9\"/>".repeat(150);
    let xml = format!(
        "<mujoco><visual><quality shadowsize=\"0\"/></visual><worldbody><light pos=\"0 0 3\"/>\
         <camera name=\"c\" pos=\"0 0 1\"/>{sites}\
         <site size=\"0.5\" rgba=\"1 0 0 1\"/><body pos=\"0 0 -5\"><joint name=\"j\"/><geom size=\"0.01\"/></body>\
         </worldbody><actuator><motor name=\"m\" joint=\"j\"/></actuator></mujoco>"
    );
    let world = "model: many.xml\nstep_rate_hz: 500\nmodalities: {view: {camera: c, size: [8, 8]}}\n\
        action: {actuators: {m: {range: [-1, 1]}}}\n";
    let world = World::parse("many.yaml", None, "many", world).unwrap();
    let scene = Scene::from_xml(world.into(), &xml, "many.xml".to_owned()).unwrap();
    let episode =
        simulate(&scene, &scene.world().complete(&Simulation { actuations_per_episode: 1, ..short() }), 0);
    let middle = &episode.image(Modality::new("view").unwrap())[(4 * 8 + 4) * IMAGE_CHANNELS..][..3];
    assert!(middle[0] > 2 * middle[1].max(middle[2]), "{middle:?} is not red");
}

/// The geom that each pixel of the camera `external` shows in these states, or -1, and the distance from the camera's
/// plane, m, by Python's renderer.
fn seen_by_python(scene: &Scene, states: &[Vec<f64>]) -> (Vec<i32>, Vec<f32>) {
    let folder = tempfile::tempdir().unwrap();
    let paths = ["model.xml", "positions", "geoms", "depths"].map(|name| folder.path().join(name));
    std::fs::write(&paths[0], scene.xml()).unwrap();
    write_floats(&paths[1], states.iter().flatten());
    let side = FRAME_SIDE.to_string();
    python("segment_frames.py", &[&paths[0], &paths[1], &side, &paths[2], &paths[3]]);
    let values = |path: &PathBuf| -> Vec<[u8; 4]> {
        let bytes = std::fs::read(path).unwrap();
        bytes.chunks_exact(4).map(|value| value.try_into().unwrap()).collect()
    };
    let geoms = values(&paths[2]).into_iter().map(i32::from_le_bytes).collect();
    (geoms, values(&paths[3]).into_iter().map(f32::from_le_bytes).collect())
}

#[test]
fn colors_tell_the_robots_parts_as_mujocos_segmentation_does() {
    for scenario in Scenario::PAPER.into_iter().chain([crowded()]) {
        let (scene, spec) = (scene(scenario), short());
        let episode = simulate(&scene, &spec, 0);
        // 1 for the arm, 2 for the finger, 0 for anything else.
        let part = |geom: i32| {
            let name = |geom| scene.model().id_to_name(MjtObjBase::mjOBJ_GEOM, geom).unwrap_or_default();
            let name = usize::try_from(geom).map_or("ground", name);
            if name.starts_with("finger_link_") { 2 } else { u8::from(name.starts_with("arm_")) }
        };
        let (geoms, _) = seen_by_python(&scene, &replay(&scene, &spec, 0).unwrap());
        let theirs: Vec<u8> = geoms.into_iter().map(part).collect();
        let ours: Vec<u8> = episode
            .image(Modality::VISION)
            .chunks_exact(IMAGE_CHANNELS)
            // The arm's region is the first, the finger's the second.
            .map(|pixel| {
                region_of(&Layout::finger().regions, pixel.try_into().unwrap()).map_or(0, |region| region + 1)
            })
            .collect();
        assert!((1..=2).all(|part| theirs.contains(&part)), "{scenario}: both parts are seen");
        assert!(ours == theirs, "{scenario}: the parts differ");
    }
}

/// The error of an episode in an edited empty scene, which must fail.
fn failure_of(edit: impl FnOnce(&mut MjSpec)) -> SimulationError {
    let mut spec = MjSpec::from_xml_string(scene(Scenario::EMPTY).xml()).unwrap();
    edit(&mut spec);
    spec.compile().unwrap();
    let xml = spec.save_xml_string(1 << 20).unwrap();
    let world = World::parse("edited.yaml", None, "empty", include_str!("../models/empty.yaml")).unwrap();
    let scene = Scene::from_xml(world.into(), &xml, "edited.xml".to_owned()).unwrap();
    let spec = short().with("lift_range_m", Setting::Range([-1.0, -0.9]));
    Simulator::new(&scene, &spec).unwrap().run(2, &mut || ControlFlow::Continue(())).unwrap_err()
}

#[test]
fn a_diverged_simulation_is_an_error_that_says_when_and_how() {
    let error = failure_of(|spec| spec.option_mut().gravity = [0.0, 0.0, -1e30]);
    let SimulationError::Diverged { episode: 2, time_s, ref what, .. } = error else { panic!("{error}") };
    assert!(what.contains("BADQ"), "{what}");
    assert!((0.0..10.0).contains(&time_s), "{time_s}");
    assert!(error.to_string().contains("edited.xml"), "{error}");
}

fn load_error(xml: &str) -> String {
    Scene::from_xml(World::paper(Scenario::CLUTTERED), xml, "my.xml".to_owned()).unwrap_err().to_string()
}

#[test]
fn models_that_do_not_compile_are_refused_with_mujocos_message() {
    let folder = tempfile::tempdir().unwrap();
    let (path, file) = (folder.path().join("empty.xml"), folder.path().join("own.yaml"));
    std::fs::write(&file, include_str!("../models/empty.yaml")).unwrap();
    let load = || Scene::new(World::load(&file).unwrap()).unwrap_err().to_string();
    assert!(load().contains(path.to_str().unwrap()), "{}", load());
    std::fs::write(&path, "<mujoco>\n<worldbody><geom tpye='box'/></worldbody></mujoco>").unwrap();
    let message = load();
    assert!(message.contains(path.to_str().unwrap()), "{message}");
    assert!(message.contains("tpye") && message.contains("line 2"), "{message}");
    // MuJoCo's advice begins after more than 99 characters.
    let unlimited = "<mujoco><compiler autolimits='false'/><worldbody><body><joint name='a' range='-1 \
                     1'/></body></worldbody></mujoco>";
    let advice = "specify `limited` explicitly (\"true\" or \"false\"), or remove the `range` attribute.; Element name \
                  'a', id 0, line 1";
    std::fs::write(&path, unlimited).unwrap();
    for message in [load(), load_error(unlimited)] {
        assert!(message.ends_with(advice), "{message}");
    }
    std::fs::write(&path, "").unwrap();
    assert!(load().contains("it is no XML"), "{}", load());
}

#[test]
fn models_that_lack_a_name_or_a_property_are_refused() {
    let good = scene(Scenario::CLUTTERED).xml().to_owned();
    assert_eq!(Scene::from_xml(World::paper(Scenario::CLUTTERED), &good, String::new()).unwrap().xml(), good);
    let cases = [
        (
            "finger_joint_",
            "knuckle_",
            "'finger_joint_*' matches nothing among the model's joint names; the model has arm",
        ),
        ("finger_link_", "link_", "'finger_link_*' matches nothing among the model's geom names"),
        ("camera name=\"external\"", "camera name=\"c\"", "no camera 'external'; the model has c"),
        (
            "position name=\"arm_lift\"",
            "position name=\"lift\"",
            "no actuator 'arm_lift'; the model has arm_rotation",
        ),
        (
            "geom name=\"box_7\"",
            "geom name=\"box_7\" contype=\"0\" conaffinity=\"0\"",
            "body 'box_7' has no geom that can touch anything, so it can't stand on the ground",
        ),
        ("<freejoint name=\"box_3\"/>", "", "body 'box_3' must have a free joint"),
    ];
    for (old, new, expected) in cases {
        assert!(good.contains(old), "the model has no {old}");
        let message = load_error(&good.replace(old, new));
        assert!(
            message.starts_with("the built-in models/cluttered.yaml:") && message.contains(expected),
            "{message}"
        );
    }
}

#[test]
fn specs_that_do_not_suit_the_scene_are_refused() {
    let scene = scene(Scenario::EMPTY);
    let error_of = |spec: Simulation| Simulator::new(&scene, &spec).err().unwrap().to_string();
    let message = error_of(Simulation::default().with("lift_range_m", Setting::Range([-1.2, 0.0])));
    assert!(message.contains("simulation.lift_range_m") && message.contains("[-1, 0]"), "{message}");
    let message = error_of(Simulation::default().with("extension_range_m", Setting::Range([1.0, 0.5])));
    assert!(message.contains("simulation.extension_range_m"), "{message}");
    let message = error_of(Simulation { sample_rate_hz: 7.0, ..Default::default() });
    assert!(message.contains("simulation.sample_rate_hz"), "{message}");
}

#[test]
fn an_episode_can_be_cancelled() {
    let scene = scene(Scenario::EMPTY);
    let mut samples = 0;
    let result = Simulator::new(&scene, &short()).unwrap().run(1, &mut || {
        samples += 1;
        if samples == 5 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert!(matches!(result, Err(SimulationError::Cancelled { episode: 1 })));
    assert_eq!(samples, 5);
}

#[test]
fn a_picture_as_recorded_is_the_frame_of_the_dataset() {
    let (scene, spec) = (scene(Scenario::CLUTTERED), Simulation { actuations_per_episode: 3, ..short() });
    let states = replay(&scene, &spec, 0).unwrap();
    let episode = simulate(&scene, &spec, 0);
    // By default the first camera that is recorded; by name of the modality, or of the camera.
    for name in [None, Some("vision"), Some("external")] {
        let mut renderer = SceneRenderer::as_recorded(&scene, name).unwrap();
        for sample in [0, 25] {
            let frame = &episode.image(Modality::VISION)[sample * FRAME_LEN..][..FRAME_LEN];
            assert_eq!(renderer.render(&states[sample]).unwrap().as_raw(), frame, "{name:?} {sample}");
        }
    }
    // The scene's view is its camera `external`, which sees the same at any size.
    let mut by_name = SceneRenderer::from_camera(&scene, "external", 96, 48).unwrap();
    let mut view = SceneRenderer::new(&scene, 96, 48).unwrap();
    assert_eq!(by_name.render(&states[25]).unwrap(), view.render(&states[25]).unwrap());
    let unknown = [
        SceneRenderer::as_recorded(&scene, Some("inside")).err().unwrap(),
        SceneRenderer::from_camera(&scene, "inside", 96, 48).err().unwrap(),
    ];
    for (error, there) in unknown.iter().zip(["vision", "external"]) {
        let said = error.to_string();
        assert!(said.ends_with(&format!("there is no camera 'inside'; available: {there}, wrist")), "{said}");
    }
}

#[test]
fn a_rendered_scene_shows_what_the_camera_saw() {
    let (scene, spec) = (scene(Scenario::CLUTTERED), Simulation { actuations_per_episode: 3, ..short() });
    let states = replay(&scene, &spec, 0).unwrap();
    let episode = simulate(&scene, &spec, 0);
    let side = 4 * FRAME_SIDE as u32;
    let mut renderer = SceneRenderer::new(&scene, side, side).unwrap();
    let picture = renderer.render(&states[25]).unwrap();
    assert_eq!(picture.dimensions(), (side, side));
    // Scaled to the camera's resolution, the image differs only by shadows and smoother edges.
    let small = image::imageops::thumbnail(&picture, FRAME_SIDE as u32, FRAME_SIDE as u32);
    let frame = &episode.image(Modality::VISION)[25 * FRAME_LEN..26 * FRAME_LEN];
    let far = small.as_raw().iter().zip(frame).filter(|(a, b)| a.abs_diff(**b) > 40).count();
    assert!(far < FRAME_LEN / 10, "{far} of {FRAME_LEN} values differ");
    assert_ne!(renderer.render(&states[5]).unwrap(), picture);
    let refused = renderer.render(&[0.0; 3]).unwrap_err();
    assert!(refused.to_string().starts_with("a state of 3 values does not fit "), "{refused}");
    for (width, height) in [(0, 64), (64, 10_000)] {
        let refused = SceneRenderer::new(&scene, width, height).err().unwrap();
        assert!(matches!(refused, SimulationError::Argument(_)), "{refused}");
    }
}

/// EGL keeps the drivers that it has found, so this test runs itself again in a process without drivers.
#[test]
fn without_a_driver_rendering_is_an_error() {
    const DRIVERS: &str = "__EGL_VENDOR_LIBRARY_FILENAMES";
    if std::env::var_os(DRIVERS).is_some_and(|drivers| drivers == "/nonexistent") {
        let error = Simulator::new(&scene(Scenario::EMPTY), &short()).err().unwrap();
        assert!(matches!(error, SimulationError::NoRenderer(_)), "{error}");
        assert!(error.to_string().contains("libegl"), "{error}");
        return;
    }
    let status = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "without_a_driver_rendering_is_an_error"])
        .env(DRIVERS, "/nonexistent")
        .status();
    assert!(status.unwrap().success());
}

#[test]
fn a_projected_place_is_where_the_picture_shows_it() {
    let scene = scene(Scenario::EMPTY);
    let [width, height] = [400, 300];
    let whole = SceneRenderer::new(&scene, width, height).unwrap();
    let near = SceneRenderer::close_up(&scene, width, height, "finger_link_10", 20.0).unwrap();
    for (mut renderer, middle) in [(whole, None), (near, Some("finger_link_10"))] {
        let picture = renderer.render(scene.rest()).unwrap();
        let at = |geom: &str| renderer.project(renderer.place_of(geom).unwrap());
        let color = |geom: &str| {
            let [x, y] = at(geom);
            picture.get_pixel((x * f64::from(width)) as u32, (y * f64::from(height)) as u32).0
        };
        // The finger's first link is yellow and its last crimson; ground, arm and shadows are gray.
        let [red, green, blue] = color("finger_link_00");
        assert!(red > green && green > 2 * blue, "{red} {green} {blue}");
        let [red, green, blue] = color("finger_link_19");
        assert!(red > 2 * blue && blue > green, "{red} {green} {blue}");
        if let Some(body) = middle {
            // The camera points to the body's origin, which is half a link (of 0.05 m) above the middle of its capsule.
            let [x, y] = at(body);
            assert!((x - 0.5).abs() < 0.01 && y > 0.5 && y < 0.53, "{x} {y}");
        }
    }
    let unknown = SceneRenderer::close_up(&scene, width, height, "finger_link_20", 20.0).err().unwrap();
    assert!(unknown.to_string().contains("`finger_link_20`"), "{unknown}");
}
