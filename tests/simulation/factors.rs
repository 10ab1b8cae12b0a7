//! Factors of variation: measures the effect of each factor in a simple scene, and compares it with the laws of
//! physics.

use super::{columns, live, scene, sensed, short, simulate};
use harness_simulation::{Episode, EpisodePlan, LiveSimulation, Scene, SceneRenderer, Simulator};
use harness_spec::{Modality, Scenario, Simulation, World};
use std::ops::ControlFlow;

const SIDE: usize = 64;
/// Height of the camera above the ground, m.
const CAMERA_HEIGHT: f64 = 4.0;
/// Half of the box's height, m, and where it stands.
const BOX_HALF_HEIGHT: f64 = 0.1;
const BOX: [f64; 2] = [0.5, 0.5];

/// A box under a camera, and four things that are each pushed with a constant force along x, out of its sight.
const BENCH: &str = r#"<mujoco model="bench">
  <compiler autolimits="true"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <visual>
    <global offwidth="64" offheight="64"/>
    <headlight active="0"/>
    <quality shadowsize="0" offsamples="0"/>
  </visual>
  <worldbody>
    <light name="sun" type="directional" pos="0 0 4" dir="0 0 -1" diffuse="0.5 0.5 0.5" specular="0 0 0"/>
    <camera name="above" pos="0 0 4" fovy="45"/>
    <geom name="ground" type="plane" size="20 20 1" friction="0.1" rgba="0.2 0.2 0.2 1"/>
    <body name="spring" pos="0 6 2">
      <joint name="spring" type="slide" axis="1 0 0" stiffness="80" damping="20"/>
      <geom name="spring" size="0.1" mass="1" contype="0" conaffinity="0"/>
    </body>
    <body name="damper" pos="0 5 2">
      <joint name="damper" type="slide" axis="1 0 0" damping="5"/>
      <geom name="damper" size="0.1" mass="1" contype="0" conaffinity="0"/>
    </body>
    <body name="load" pos="0 4 2">
      <joint name="load" type="slide" axis="1 0 0"/>
      <geom name="load" size="0.1" mass="2" contype="0" conaffinity="0"/>
    </body>
    <body name="sled" pos="0 -5 0.1">
      <joint name="sled" type="slide" axis="1 0 0"/>
      <joint name="press" type="slide" axis="0 0 1"/>
      <geom name="sled" type="box" size="0.1 0.1 0.1" mass="1" friction="0.3"/>
    </body>
    <body name="box" pos="0.5 0.5 0.1">
      <freejoint name="box"/>
      <geom name="box" type="box" size="0.2 0.2 0.1" mass="1" rgba="0.8 0.2 0.2 1"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="spring" joint="spring"/>
    <motor name="damper" joint="damper"/>
    <motor name="load" joint="load"/>
    <motor name="sled" joint="sled"/>
  </actuator>
</mujoco>
"#;

const BENCH_WORLD: &str = "model: bench.xml
step_rate_hz: 1000
modalities:
  position: {joint_positions: [spring, damper, load, sled]}
  speed: {joint_velocities: [spring, damper, load, sled]}
  force: {normal_force: box}
  vision: {camera: above, size: [64, 64]}
action:
  actuators:
    spring: {range: [8, 8]}
    damper: {range: [2, 2]}
    load: {range: [0.1, 0.1]}
    sled: {range: [4, 4]}
placement:
  box: {bodies: box, clearance_m: 0, rectangle: [[0.5, 0.5], [0.5, 0.5]]}
factors:
  twice_as_stiff: {joint_stiffness: spring, scale_by: {choice: 2}}
  twice_the_damping: {joint_damping: damper, scale_by: {choice: 2}}
  twice_the_mass: {body_mass: load, scale_by: {choice: 2}}
  twice_the_friction: {geom_friction: sled, scale_by: {choice: 2}}
  twice_the_size: {geom_size: box, scale_by: {choice: 2}}
  paler: {geom_colour: box, offset_by: {choice: 0.15}}
  brighter: {light_brightness: sun, scale_by: {choice: 2}}
  moved: {camera_position: above, offset_by: {choice: 0.5}}
  turned: {camera_rotation: above, offset_by: {choice: 0.1}}
  same: {joint_stiffness: spring, scale_by: {choice: 1}}
  twice_as_strong: {actuator_strength: [spring, damper, load, sled], scale_by: {choice: 2}}
  half_the_gravity: {gravity: world, scale_by: {choice: 0.5}}
";

fn bench() -> Scene {
    let world = World::parse("bench.yaml", Some("".into()), "bench", BENCH_WORLD).unwrap();
    Scene::from_xml(world.into(), BENCH, "bench.xml".into()).unwrap()
}

/// Simulates the bench for four seconds with these factors.
fn on_bench(factors: &[&str]) -> Episode {
    let factors = factors.iter().map(|name| (*name).to_owned()).collect();
    simulate(&bench(), &Simulation { actuations_per_episode: 4, factors, ..Simulation::default() }, 0)
}

fn last<const N: usize>(episode: &Episode, modality: &str) -> [f32; N] {
    *episode.vector(Modality::new(modality).unwrap()).last_chunk().unwrap()
}

#[track_caller]
fn assert_near(found: f32, expected: f64, tolerance: f64) {
    assert!((f64::from(found) - expected).abs() < tolerance, "{found} instead of {expected}");
}

#[test]
fn stiffness_damping_mass_and_friction_act_by_mechanical_laws() {
    let (time, gravity) = (3.9f64, 9.81);
    for scale in [1.0, 2.0] {
        let factors = ["twice_as_stiff", "twice_the_damping", "twice_the_mass", "twice_the_friction"];
        let episode = on_bench(if scale == 1.0 { &[] } else { &factors });
        let ([spring, _, load, sled], [_, damper, _, _]): ([f32; 4], [f32; 4]) =
            (last(&episode, "position"), last(&episode, "speed"));
        assert_near(spring, 8.0 / (80.0 * scale), 1e-4);
        assert_near(damper, 2.0 / (5.0 * scale), 1e-4);
        assert_near(load, 0.5 * 0.1 / (2.0 * scale) * time * time, 1e-3);
        // A push of 4 N overcomes the friction of 0.3, but not that of 0.6.
        let pushed = (4.0 - 0.3 * scale * gravity).max(0.0);
        assert_near(sled, 0.5 * pushed * time * time, 0.15);
    }
}

#[test]
fn strength_scales_forces_of_actuators_and_gravity_weights() {
    let (time, gravity) = (3.9f64, 9.81);
    let episode = on_bench(&["twice_as_strong", "half_the_gravity"]);
    let ([spring, _, load, sled], [_, damper, _, _]): ([f32; 4], [f32; 4]) =
        (last(&episode, "position"), last(&episode, "speed"));
    assert_near(spring, 2.0 * 8.0 / 80.0, 1e-4);
    assert_near(damper, 2.0 * 2.0 / 5.0, 1e-4);
    assert_near(load, 0.5 * 2.0 * 0.1 / 2.0 * time * time, 1e-3);
    assert_near(sled, 0.5 * (2.0 * 4.0 - 0.3 * gravity / 2.0) * time * time, 0.3);
    let [force] = last(&episode, "force");
    assert_near(force, gravity / 2.0, 0.02);
}

#[test]
fn only_the_world_has_gravity() {
    let text = BENCH_WORLD.replace("gravity: world", "gravity: load");
    let world = World::parse("bench.yaml", Some("".into()), "bench", &text).unwrap();
    let said = Scene::from_xml(world.into(), BENCH, "bench.xml".into()).unwrap_err().to_string();
    assert!(said.ends_with("body 'load' has no gravity of its own; name the body 'world'"), "{said}");
}

/// The box in the camera's image: its number of pixels, their center (column, row), and their mean color.
fn box_in(episode: &Episode) -> (usize, [f64; 2], [f64; 3]) {
    let pixels = episode.image(Modality::VISION)[..SIDE * SIDE * 3].chunks_exact(3).enumerate();
    let red: Vec<_> = pixels.filter(|(_, pixel)| pixel[0] > pixel[1] + 20).collect();
    let mean = |of: &dyn Fn(usize, &[u8]) -> f64| {
        red.iter().map(|(place, pixel)| of(*place, pixel)).sum::<f64>() / red.len() as f64
    };
    let middle =
        [mean(&|place, _| (place % SIDE) as f64 + 0.5), mean(&|place, _| (place / SIDE) as f64 + 0.5)];
    (red.len(), middle, [0, 1, 2].map(|channel| mean(&|_, pixel| f64::from(pixel[channel]))))
}

/// Where a camera with these axes (right, up, backwards, in its own frame) sees a place that lies so from it: column,
/// row.
fn seen([right, up, back]: [f64; 3]) -> [f64; 2] {
    let focal = 0.5 * SIDE as f64 / 22.5f64.to_radians().tan();
    [0.5 * SIDE as f64 + focal * right / -back, 0.5 * SIDE as f64 - focal * up / -back]
}

#[test]
fn a_box_of_another_size_stands_on_the_ground_and_is_seen_so() {
    let (own, large) = (on_bench(&[]), on_bench(&["twice_the_size"]));
    assert_eq!(own.boxes[0][2], BOX_HALF_HEIGHT);
    assert_eq!(large.boxes[0][2], 2.0 * BOX_HALF_HEIGHT);
    for episode in [&own, &large] {
        // It rests on the ground with its unchanged weight.
        let [force] = last(episode, "force");
        assert_near(force, 9.81, 0.02);
    }
    // Its upper face has four times the area and is nearer to the camera by the height it gained.
    let nearer = (CAMERA_HEIGHT - 2.0 * BOX_HALF_HEIGHT) / (CAMERA_HEIGHT - 4.0 * BOX_HALF_HEIGHT);
    let ratio = box_in(&large).0 as f64 / box_in(&own).0 as f64;
    // The higher box shows two of its sides as well.
    assert!((4.0 * nearer * nearer - 0.5..4.0 * nearer * nearer + 1.0).contains(&ratio), "{ratio}");
}

#[test]
fn color_and_light_change_pixels_by_as_much_as_was_drawn() {
    let (own, paler, brighter) = (on_bench(&[]), on_bench(&["paler"]), on_bench(&["brighter"]));
    let ((_, _, own_color), (_, _, paler_color)) = (box_in(&own), box_in(&paler));
    for (own, paler) in own_color.into_iter().zip(paler_color) {
        // Half of the light is reflected.
        assert!((paler - own - 0.5 * 0.15 * 255.0).abs() < 2.0, "{own} became {paler}");
    }
    let brightness = |episode: &Episode| -> f64 {
        episode.image(Modality::VISION)[..SIDE * SIDE * 3].iter().map(|value| f64::from(*value)).sum()
    };
    let ratio = brightness(&brighter) / brightness(&own);
    assert!((ratio - 2.0).abs() < 0.05, "{ratio}");
}

#[test]
fn a_camera_moved_or_turned_sees_the_box_where_it_then_is() {
    let assert_seen = |factors: &[&str], place: [f64; 3]| {
        let ([column, row], [x, y]) = (box_in(&on_bench(factors)).1, seen(place));
        assert!(
            (column - x).abs() < 1.0 && (row - y).abs() < 1.0,
            "{factors:?}: ({column}, {row}), ({x}, {y})"
        );
    };
    // The middle of its upper face, from the camera.
    let place = [BOX[0], BOX[1], 2.0 * BOX_HALF_HEIGHT - CAMERA_HEIGHT];
    assert_seen(&[], place);
    assert_seen(&["moved"], place.map(|value| value - 0.5));
    // Rodrigues' formula about (1, 1, 1), backwards, as the camera turns and not the box.
    let (angle, axis) = (-0.1 * 3f64.sqrt(), 1.0 / 3f64.sqrt());
    let [x, y, z] = place;
    let cross = [z - y, x - z, y - x].map(|value| axis * value);
    let along = axis * axis * (x + y + z);
    let turned =
        |index: usize| place[index] * angle.cos() + cross[index] * angle.sin() + along * (1.0 - angle.cos());
    assert_seen(&["turned"], [turned(0), turned(1), turned(2)]);
}

#[test]
fn a_factor_of_one_changes_no_bit_and_is_recorded() {
    let (own, same) = (on_bench(&[]), on_bench(&["same"]));
    let count = own.vectors.len();
    assert!(same.vectors[..count] == own.vectors[..] && same.images[..count] == own.images[..]);
    assert_eq!(own.vector(Modality::FACTORS), [0f32; 0]);
    assert_eq!(same.vector(Modality::FACTORS), [1.0; 40]);
}

/// The cluttered world with some of its factors on.
fn varied(factors: &[&str]) -> Simulation {
    let factors = factors.iter().map(|name| (*name).to_owned()).collect();
    Simulation { actuations_per_episode: 2, factors, ..short() }
}

const SOME: [&str; 6] =
    ["box_size", "camera_rotation", "finger_colour", "finger_damping", "finger_stiffness", "light"];

#[test]
fn factors_off_leave_every_bit_as_in_a_world_that_declares_none() {
    let text = include_str!("../../models/cluttered.yaml");
    let (before, after) = (text.find("factors:").unwrap(), text.find("# The parts are found by").unwrap());
    let without =
        World::parse("plain.yaml", None, "cluttered", &(text[..before].to_owned() + &text[after..]));
    let own = scene(Scenario::CLUTTERED);
    let plain = Scene::from_xml(without.unwrap().into(), own.xml(), "cluttered.xml".into()).unwrap();
    assert!(plain.factors().next().is_none() && own.factors().count() == 12);
    assert!(simulate(&own, &varied(&[]), 1) == simulate(&plain, &varied(&[]), 1));
}

#[test]
fn an_episode_with_factors_depends_on_its_seed_and_index_alone() {
    let (scene, spec) = (scene(Scenario::CLUTTERED), varied(&SOME));
    let alone = simulate(&scene, &spec, 2);
    let mut simulator = Simulator::new(&scene, &spec).unwrap();
    let all = [0, 1, 2].map(|index| simulator.run(index, &mut || ControlFlow::Continue(())).unwrap());
    assert!(alone == all[2], "nothing is left of the episodes before");
    let drawn = |episode: &Episode| {
        let layout = &episode.layout[Modality::FACTORS];
        let values = columns(episode.vector(Modality::FACTORS), layout.width());
        assert!(values.iter().all(|column| column.iter().all(|value| *value == column[0])));
        let names = layout.elements().iter().map(|element| element.name.clone());
        names.zip(values.into_iter().map(|column| column[0])).collect::<Vec<_>>()
    };
    let [first, second] = [drawn(&all[0]), drawn(&all[1])];
    // Three colors, a damping and a stiffness, a size of each of eight boxes, a brightness and three angles.
    assert_eq!(first.len(), 3 + 2 + 8 + 1 + 3, "{first:?}");
    for ((name, one), (_, other)) in first.iter().zip(&second) {
        assert_ne!(one, other, "{name} is drawn anew");
        let is_offset = name.starts_with("finger_colour") || name.starts_with("camera");
        let [low, high] = if is_offset { [-0.1, 0.1] } else { [0.5, 2.0] };
        assert!((low..=high).contains(one), "{name}: {one}");
    }
    assert!(drawn(&simulate(&scene, &Simulation { seed: 1, ..spec }, 0)) != first);
    // A factor does not depend on the others. The motion depends on no factor, and the boxes' places only on their
    // size.
    let one = simulate(&scene, &varied(&["finger_stiffness"]), 0);
    let value = first.iter().find(|(name, _)| name == "finger_stiffness").unwrap();
    assert_eq!(drawn(&one), std::slice::from_ref(value));
    let plain = simulate(&scene, &varied(&[]), 0);
    assert!(one.boxes == plain.boxes && one.vector(Modality::SETPOINT) == plain.vector(Modality::SETPOINT));
    assert!(one.vector(Modality::PROPRIOCEPTION) != plain.vector(Modality::PROPRIOCEPTION));
}

#[test]
fn a_live_simulation_draws_its_episodes_factors_at_each_reset() {
    let (scene, spec) = (Scene::shared(World::paper(Scenario::CLUTTERED)).unwrap(), varied(&SOME));
    let mut live = LiveSimulation::new(scene, &spec).unwrap();
    for index in [1, 0] {
        let episode = simulate(scene, &spec, index);
        live.reset(spec.seed, index).unwrap();
        for sample in 0..3 {
            let now = sensed(&mut live);
            for (position, definition) in scene.layout().modalities.iter().enumerate() {
                let (width, name) = (definition.width(), definition.name);
                if definition.difference_of.is_none() {
                    let of = |values: &[f32]| values[sample * width..][..width].to_vec();
                    match definition.is_image() {
                        false => assert_eq!(now.vectors[position], of(&episode.vectors[position]), "{name}"),
                        true => assert!(
                            now.images[position] == episode.images[position][sample * width..][..width],
                            "{name}"
                        ),
                    }
                }
            }
            live.follow().unwrap();
        }
        let (picture, plain) = (live.render(64, 64).unwrap(), {
            let mut other = self::live(Scenario::CLUTTERED);
            other.reset(spec.seed, index).unwrap();
            other.render(64, 64).unwrap()
        });
        assert_ne!(picture, plain, "pictures for people show the episode's colors and light");
    }
}

#[test]
fn a_picture_of_an_episode_shows_its_factors() {
    let (scene, spec) = (scene(Scenario::CLUTTERED), varied(&["box_colour", "light"]));
    let mut renderer = SceneRenderer::new(&scene, 64, 64).unwrap();
    let plain = renderer.render(scene.rest()).unwrap();
    renderer.vary(&EpisodePlan::draw(&scene, &spec, 0).unwrap().factors);
    assert_ne!(renderer.render(scene.rest()).unwrap(), plain);
    renderer.vary(&EpisodePlan::draw(&scene, &varied(&[]), 0).unwrap().factors);
    assert_eq!(renderer.render(scene.rest()).unwrap(), plain);
}

/// A sled of 1 kg that a force pushes over a plate of the same friction, and a second sled, on a plate that counts
/// more.
const SLEDS: &str = r#"<mujoco><option timestep="0.001" cone="elliptic"/><worldbody>
  <geom name="ground" type="plane" size="20 20 1" friction="0.5"/>
  <geom name="plate" type="plane" size="20 20 1" pos="0 0 -1" friction="0.5" priority="1" contype="2" conaffinity="2"/>
  <body pos="0 0 0.1">
    <joint name="sled" type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <geom name="sled" type="box" size="0.1 0.1 0.1" mass="1" friction="0.5"/></body>
  <body pos="0 2 -0.9">
    <joint name="other" type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <geom name="other" type="box" size="0.1 0.1 0.1" mass="1" friction="0.5" contype="2" conaffinity="2"/></body>
</worldbody><actuator><motor name="sled" joint="sled"/><motor name="other" joint="other"/></actuator></mujoco>"#;

/// How far the two sleds of a model get in 0.9 s under 12 N, with these factors.
fn slide(model: &str, factors: &str) -> [f64; 2] {
    let text = format!(
        "model: sleds.xml\nstep_rate_hz: 1000\nmodalities: {{position: {{joint_positions: [sled, other]}}}}\n\
         action: {{actuators: {{sled: {{range: [12, 12]}}, other: {{range: [12, 12]}}}}}}\nfactors: {{{factors}}}\n"
    );
    let world = World::parse("sleds.yaml", Some("".into()), "sleds", &text).unwrap();
    let factors = world.file().factors.iter().map(|(name, _)| name.to_owned()).collect();
    let spec = Simulation { actuations_per_episode: 1, factors, ..Simulation::default() };
    let scene = Scene::from_xml(world.into(), model, "sleds.xml".into()).unwrap();
    last::<2>(&simulate(&scene, &spec, 0), "position").map(f64::from)
}

/// How far 1 kg gets in 0.9 s if 12 N push it against this friction.
fn slid(friction: f64) -> f64 {
    0.5 * (12.0 - 9.81 * friction) * 0.9 * 0.9
}

#[track_caller]
fn assert_slid(found: f64, friction: f64) {
    assert!((found - slid(friction)).abs() < 0.03, "{found} instead of {}", slid(friction));
}

#[test]
fn friction_scales_below_and_above_one_on_equal_ground() {
    for scale in [0.2, 0.5, 1.0, 1.5] {
        let factor = format!("f: {{geom_friction: [sled, other], scale_by: {{choice: {scale}}}}}");
        let [sled, other] = slide(SLEDS, &factor);
        assert_slid(sled, 0.5 * scale);
        // The model says that the plate's friction counts, whatever lies on it.
        assert_slid(other, 0.5);
    }
    assert_eq!(slide(SLEDS, ""), slide(SLEDS, "f: {geom_friction: sled, scale_by: {choice: 1}}"));
}

#[test]
fn of_two_scaled_frictions_in_a_contact_the_larger_counts() {
    for [sled, ground] in [[0.4f64, 0.8], [0.8, 0.4], [1.5, 0.5]] {
        let factors = format!(
            "s: {{geom_friction: sled, scale_by: {{choice: {sled}}}}}, \
             g: {{geom_friction: ground, scale_by: {{choice: {ground}}}}}"
        );
        assert_slid(slide(SLEDS, &factors)[0], 0.5 * sled.max(ground));
    }
}

#[test]
fn the_friction_of_a_contact_pair_is_scaled_with_its_geoms() {
    let pair = r#"<contact>
        <pair geom1="sled" geom2="ground" condim="3" friction="0.6 0.6 0.005 0.0001 0.0001"/></contact>"#;
    let model = SLEDS.replace("<actuator>", &format!("{pair}<actuator>"));
    for scale in [0.5, 1.0, 1.5] {
        let factor = format!("f: {{geom_friction: sled, scale_by: {{choice: {scale}}}}}");
        assert_slid(slide(&model, &factor)[0], 0.6 * scale);
    }
}

#[test]
fn the_size_of_boxes_moves_only_those_that_would_be_too_near() {
    let own = scene(Scenario::CLUTTERED);
    let text = include_str!("../../models/cluttered.yaml");
    let sized = |distribution: &str| {
        let text = text.replacen("box_*, scale_by: {uniform: [0.8, 1.2]}", distribution, 1);
        assert!(text.contains(distribution));
        let world = World::parse("sized.yaml", None, "cluttered", &text).unwrap();
        Scene::from_xml(world.into(), own.xml(), "cluttered.xml".into()).unwrap()
    };
    let plans = |scene: &Scene, factors: &[&str]| {
        (0..60).map(|index| EpisodePlan::draw(scene, &varied(factors), index).unwrap()).collect::<Vec<_>>()
    };
    let plain = plans(&own, &[]);
    let place = |pose: &[f64; 7]| [pose[0], pose[1], pose[3], pose[6]];
    let small = plans(&sized("box_*, scale_by: {choice: [0.5, 1]}"), &["box_size"]);
    let (wide, other) =
        (plans(&own, &["box_size"]), plans(&sized("box_*, scale_by: {choice: [0.7, 1.2]}"), &["box_size"]));
    let (mut moved, mut heights) = (0, Vec::new());
    for (index, plan) in plain.iter().enumerate() {
        for (number, pose) in plan.boxes.iter().enumerate() {
            assert_eq!(place(&small[index].boxes[number]), place(pose), "boxes that shrink stay");
            let [wide, other] = [&wide, &other].map(|plans| plans[index].boxes[number]);
            assert_eq!(place(&wide), place(&other), "the drawn size has no influence");
            moved += usize::from(place(&wide) != place(pose));
            heights.push(wide[2]);
        }
        // At the largest size, no two circles are nearer than the clearance.
        let radius = 1.2 * 0.15f64.hypot(0.15);
        for (number, one) in wide[index].boxes.iter().enumerate() {
            for other in &wide[index].boxes[..number] {
                let gap = (one[0] - other[0]).hypot(one[1] - other[1]) - 2.0 * radius;
                assert!(gap >= 0.05 - 1e-9, "{gap}");
            }
        }
    }
    // Eight boxes fill about a third of the sector, so most are not so near to another one.
    assert!((1..240).contains(&moved), "{moved} of 480 boxes moved");
    assert!(heights.iter().any(|height| *height > 0.23) && heights.iter().any(|height| *height < 0.17));
}

/// A pendulum and a cart that nothing drives, a wheel that a servo drives, and a ball joint.
const LOOSE: &str = r#"<mujoco><compiler autolimits="true"/><option gravity="0 0 0"/><worldbody>
    <body pos="0 0 1"><joint name="swing" axis="0 1 0" range="-60 60"/><geom size="0.1"/></body>
    <body pos="1 0 1"><joint name="cart" type="slide" axis="1 0 0"/><geom size="0.1"/></body>
    <body pos="2 0 1"><joint name="wheel" axis="0 0 1"/><geom size="0.1"/></body>
    <body pos="3 0 1"><joint name="ball" type="ball"/><geom size="0.1"/></body>
    </worldbody><actuator><position name="turn" joint="wheel" kp="10"/></actuator>
    <keyframe><key name="tilted" qpos="0.5 1 0.1 1 0 0 0" ctrl="0.1"/></keyframe></mujoco>"#;

fn loose(factor: &str, keyframe: &str) -> Result<Scene, String> {
    let text = format!(
        "model: loose.xml\nstep_rate_hz: 500\nmodalities:\n  joints: {{joint_positions: [swing, cart, wheel]}}\n  \
         speeds: {{joint_velocities: [swing, cart, wheel]}}\naction: {{actuators: {{turn: {{range: [-1, 1]}}}}}}\n\
         {keyframe}factors:\n  start: {{{factor}}}\n"
    );
    let world =
        World::parse("loose.yaml", Some("".into()), "loose", &text).map_err(|error| error.to_string())?;
    Scene::from_xml(world.into(), LOOSE, "loose.xml".into()).map_err(|error| error.to_string())
}

#[test]
fn joints_start_where_the_factor_puts_them_within_their_limits() {
    let wide = "joint_start: [swing, cart], offset_by: {uniform: [-3, 3]}, each: true";
    let spec = |factors: &[&str]| Simulation { actuations_per_episode: 1, ..varied(factors) };
    for (keyframe, rest) in [("", [0.0, 0.0, 0.0]), ("keyframe: tilted\n", [0.5, 1.0, 0.1])] {
        let scene: &'static Scene = Box::leak(Box::new(loose(wide, keyframe).unwrap()));
        let mut live = LiveSimulation::new(scene, &spec(&["start"])).unwrap();
        let (mut clamped, limit) = (0, 60f64.to_radians());
        for index in 0..10 {
            let episode = simulate(scene, &spec(&["start"]), index);
            let drawn = &episode.vector(Modality::FACTORS)[..2];
            let joints = &episode.vector(Modality::new("joints").unwrap())[..3];
            let swing = (rest[0] + f64::from(drawn[0])).clamp(-limit, limit);
            clamped += usize::from(swing.abs() == limit);
            assert_near(joints[0], swing, 1e-6);
            assert_near(joints[1], rest[1] + f64::from(drawn[1]), 1e-6);
            assert_near(joints[2], rest[2], 1e-6);
            assert_eq!(episode.vector(Modality::new("speeds").unwrap())[..3], [0.0; 3]);
            live.reset(spec(&[]).seed, index).unwrap();
            assert_eq!(live.vector(Modality::new("joints").unwrap()).unwrap(), joints);
        }
        assert!((1..10).contains(&clamped), "{clamped} of 10 starts are at the limit");
        let elements = simulate(scene, &spec(&["start"]), 0).layout[Modality::FACTORS].elements().to_vec();
        let named: Vec<String> =
            elements.iter().map(|element| format!("{} {}", element.name, element.unit)).collect();
        assert_eq!(named, ["start_swing rad", "start_cart m"]);
        assert!(scene.warnings().is_empty(), "{:?}", scene.warnings());
        // Off, the start is that of a world that declares no factor.
        assert_eq!(
            simulate(scene, &spec(&[]), 0).vector(Modality::new("joints").unwrap())[..2],
            rest.map(|v| v as f32)[..2]
        );
    }
    let uniform = "offset_by: {uniform: [-1, 1]}";
    for (factor, expected) in [
        (
            format!("joint_start: wheel, {uniform}"),
            "joint 'wheel' is moved by a position servo, so it starts at the setpoint",
        ),
        (
            format!("joint_start: ball, {uniform}"),
            "joint 'ball' is a ball or free joint; only hinges and slides",
        ),
        (
            format!("joint_start: [swing, cart], {uniform}"),
            "the values of each joint have different units; set each: true",
        ),
        (
            "joint_start: swing, scale_by: {uniform: [1, 2]}".into(),
            "a factor of joint_start has a distribution of its offset",
        ),
    ] {
        let said = loose(&factor, "").unwrap_err();
        assert!(said.starts_with("loose.yaml:8:") && said.contains(expected), "{said}");
    }
    let said = loose("joint_start: swing, offset_by: {choice: 0}", "").unwrap().warnings();
    assert!(said[0].to_string().contains("changes nothing for 'swing'"), "{said:?}");
}

fn noisy(factor: &str) -> Result<Scene, String> {
    let text = format!(
        "model: loose.xml\nstep_rate_hz: 500\nsample_rate_hz: 500\nmodalities:\n  \
         angles: {{joint_positions: [swing, wheel]}}\n  true_angles: {{joint_positions: [swing, wheel]}}\n  \
         all: {{joint_positions: [swing, cart]}}\n  push: {{normal_force: box, contact_kinds: {{box: box}}}}\n  \
         view: {{camera: eye, size: [8, 8]}}\n  change: {{difference_of: angles}}\n\
         action: {{actuators: {{turn: {{range: [-1, 1]}}}}}}\nfactors:\n  noise: {{{factor}}}\n"
    );
    let world =
        World::parse("loose.yaml", Some("".into()), "loose", &text).map_err(|error| error.to_string())?;
    let more = "<camera name=\"eye\" pos=\"0 -3 1\" xyaxes=\"1 0 0 0 0 1\"/><geom name=\"box\" size=\"0.1\"/>\
                <body pos=\"0 0 1\">";
    let xml = LOOSE.replacen("<body pos=\"0 0 1\">", more, 1);
    Scene::from_xml(world.into(), &xml, "loose.xml".into()).map_err(|error| error.to_string())
}

fn of<'e>(episode: &'e Episode, name: &str) -> &'e [f32] {
    episode.vector(Modality::new(name).unwrap())
}

#[test]
fn noise_has_the_deviation_that_the_episode_drew() {
    let scene: &'static Scene =
        Box::leak(Box::new(noisy("sensor_noise: angles, offset_by: {uniform: [0.1, 0.2]}").unwrap()));
    let spec = |factors: &[&str], moves: u32| {
        let factors = factors.iter().map(|name| (*name).to_owned()).collect();
        Simulation { actuations_per_episode: moves, factors, ..scene.world().simulation() }
    };
    assert!(scene.warnings().is_empty(), "{:?}", scene.warnings());
    let mut deviations = Vec::new();
    for index in 0..2 {
        let episode = simulate(scene, &spec(&["noise"], 20), index);
        let deviation = episode.vector(Modality::FACTORS)[0];
        let element = &episode.layout[Modality::FACTORS].elements()[0];
        assert_eq!((element.name.as_str(), element.unit.as_str()), ("noise", "rad"));
        assert!((0.1..=0.2).contains(&deviation));
        let noise: Vec<f64> = of(&episode, "angles")
            .iter()
            .zip(of(&episode, "true_angles"))
            .map(|(noisy, own)| f64::from(noisy - own) / f64::from(deviation))
            .collect();
        assert_eq!(noise.len(), 20_000);
        let mean = |of: &dyn Fn(f64) -> f64| noise.iter().map(|value| of(*value)).sum::<f64>() / 20_000.0;
        // A standard normal distribution has the deviation 1, and 68.3 % within it.
        assert!(mean(&|value| value).abs() < 0.03);
        assert!((mean(&|value| value * value).sqrt() - 1.0).abs() < 0.03);
        assert!((mean(&|value| f64::from(u8::from(value.abs() < 1.0))) - 0.683).abs() < 0.015);
        // Neither the next sample nor the next element has the same noise.
        for lag in [1, 2] {
            let product = noise.windows(lag + 1).map(|pair| pair[0] * pair[lag]).sum::<f64>() / 20_000.0;
            assert!(product.abs() < 0.03, "{product}");
        }
        // Everything else is as without noise.
        let plain = simulate(scene, &spec(&[], 20), index);
        for name in ["true_angles", "all", "push", "push_kind", "setpoint"] {
            let modality = if name == "setpoint" { Modality::SETPOINT } else { Modality::new(name).unwrap() };
            assert_eq!(episode.vector(modality), plain.vector(modality), "{name}");
        }
        assert_eq!(of(&plain, "angles"), of(&plain, "true_angles"));
        deviations.push(deviation);
    }
    assert_ne!(deviations[0], deviations[1]);

    let mut live = LiveSimulation::new(scene, &spec(&["noise"], 1)).unwrap();
    for index in [1, 0] {
        let episode = simulate(scene, &spec(&["noise"], 1), index);
        live.reset(0, index).unwrap();
        let mut recorded = live.new_episode();
        for _ in 0..episode.samples {
            live.record(&mut recorded).unwrap();
            live.follow().unwrap();
        }
        assert!(recorded == episode, "{index}");
    }
}

#[test]
fn no_noise_changes_no_bit_and_only_vectors_have_some() {
    let spec = Simulation { actuations_per_episode: 1, ..varied(&["noise"]) };
    let zero = noisy("sensor_noise: [angles, push], offset_by: {choice: 0}, each: true").unwrap();
    let (with, without) =
        (simulate(&zero, &spec, 0), simulate(&zero, &Simulation { factors: vec![], ..spec.clone() }, 0));
    let count = without.vectors.len();
    assert!(with.vectors[..count] == without.vectors[..] && with.images[..count] == without.images[..]);
    let elements = with.layout[Modality::FACTORS].elements();
    let named: Vec<String> =
        elements.iter().map(|element| format!("{} {}", element.name, element.unit)).collect();
    assert_eq!(named, ["noise_angles rad", "noise_push N"]);
    let said = zero.warnings();
    assert!(said[0].to_string().contains("changes nothing for 'angles', 'push'"), "{said:?}");
    for (modality, expected) in [
        ("view", "modality 'view' is an image; only vectors can have noise"),
        ("change", "modality 'change' is computed from another modality; name that one instead"),
        ("push_kind", "modality 'push_kind' tells kinds of contact, which are no measured values"),
        ("setpoint", "modality 'setpoint' is the action, which is not measured"),
        ("all", "modality 'all' has values of different units; record those of each unit as a modality"),
        ("touch", "'touch' matches nothing among the modalities angles, true_angles, all, push, push_kind"),
        ("[angles, push]", "the values of each modality have different units; set each: true"),
    ] {
        let said = noisy(&format!("sensor_noise: {modality}, offset_by: {{uniform: [0, 1]}}")).unwrap_err();
        assert!(said.starts_with("loose.yaml:13:") && said.contains(expected), "{said}");
    }
    let said = noisy("sensor_noise: push, offset_by: {uniform: [-1, 1]}").unwrap_err();
    assert!(
        said.contains("a factor of sensor_noise draws values from 0 to 1000000; found -1 to 1"),
        "{said}"
    );
}
