//! Parts of models other than hinges, slides and geoms: ball and free joints, flexes, several actuators for a setpoint,
//! keyframes and mocap bodies. What is recorded is compared with the state of MuJoCo and with laws of physics.

use harness_simulation::{Episode, Scene, SceneRenderer, Simulator, replay};
use harness_spec::{Modality, Simulation, World};
use mujoco_rs::prelude::*;
use std::ops::ControlFlow;

pub(super) fn scene(model: &str, world: &str) -> Result<Scene, String> {
    let text = format!("model: robot.xml\nstep_rate_hz: 500\nsample_rate_hz: 10\n{world}");
    let world =
        World::parse("robot.yaml", Some("".into()), "robot", &text).map_err(|error| error.to_string())?;
    Scene::from_xml(world.into(), model, "robot.xml".into()).map_err(|error| error.to_string())
}

pub(super) fn run(scene: &Scene, actuations: u32) -> Episode {
    let spec = Simulation { actuations_per_episode: actuations, ..scene.world().simulation() };
    Simulator::new(scene, &spec).unwrap().run(0, &mut || ControlFlow::Continue(())).unwrap()
}

pub(super) fn vector<'e>(episode: &'e Episode, name: &str) -> &'e [f32] {
    episode.vector(Modality::new(name).unwrap())
}

/// A ball that rolls and falls, on which a pendulum hangs by a ball joint. A motor turns a wheel beside it.
const TUMBLING: &str = r#"<mujoco><worldbody><geom type="plane" size="5 5 1"/>
    <body name="rock" pos="0 0 0.5" euler="200 0 0"><freejoint name="rock"/><geom type="box" size="0.1 0.05 0.03"/>
      <body name="arm" pos="0 0 0.05"><joint name="wrist" type="ball"/>
        <geom type="capsule" fromto="0 0 0 0.1 0 0.1" size="0.02"/></body>
    </body>
    <body pos="1 0 1"><joint name="wheel"/><geom size="0.1"/></body></worldbody>
    <actuator><motor name="turn" joint="wheel"/></actuator></mujoco>"#;

#[test]
fn ball_and_free_joints_are_recorded_as_joints() {
    let world = "modalities:\n  places: {joint_positions: [rock, wrist, wheel]}\n  \
                 speeds: {joint_velocities: [rock, wrist, wheel]}\n\
                 action: {actuators: {turn: {range: [-0.1, 0.1]}}}\n";
    let scene = scene(TUMBLING, world).unwrap();
    let elements = |name: &str| -> Vec<(String, String)> {
        let elements = scene.layout()[Modality::new(name).unwrap()].elements().iter();
        elements.map(|element| (element.name.clone(), element.unit.clone())).collect()
    };
    let named = |names: &[(&str, &str)]| -> Vec<(String, String)> {
        names.iter().map(|(name, unit)| ((*name).to_owned(), (*unit).to_owned())).collect()
    };
    assert_eq!(
        elements("places"),
        named(&[
            ("rock_x", "m"),
            ("rock_y", "m"),
            ("rock_z", "m"),
            ("rock_qw", "1"),
            ("rock_qx", "1"),
            ("rock_qy", "1"),
            ("rock_qz", "1"),
            ("wrist_qw", "1"),
            ("wrist_qx", "1"),
            ("wrist_qy", "1"),
            ("wrist_qz", "1"),
            ("wheel", "rad"),
        ])
    );
    assert_eq!(
        elements("speeds"),
        named(&[
            ("rock_x", "m/s"),
            ("rock_y", "m/s"),
            ("rock_z", "m/s"),
            ("rock_rx", "rad/s"),
            ("rock_ry", "rad/s"),
            ("rock_rz", "rad/s"),
            ("wrist_rx", "rad/s"),
            ("wrist_ry", "rad/s"),
            ("wrist_rz", "rad/s"),
            ("wheel", "rad/s"),
        ])
    );
    let episode = run(&scene, 2);
    let spec = Simulation { actuations_per_episode: 2, ..scene.world().simulation() };
    let states = replay(&scene, &spec, 0).unwrap();
    let mut turned = 0;
    for (state, place) in states.iter().zip(vector(&episode, "places").chunks(12)) {
        let mut expected = state.clone();
        for first in [3, 7] {
            if expected[first] < 0.0 {
                turned += 1;
                expected[first..first + 4].iter_mut().for_each(|value| *value = -*value);
            }
        }
        assert_eq!(place, expected.iter().map(|value| *value as f32).collect::<Vec<_>>());
    }
    // The rock begins upside down: the sign of its quaternion is turned.
    assert!(turned > 0);
    // In free fall, the speed is g times the time.
    let speeds: Vec<&[f32]> = vector(&episode, "speeds").chunks(10).collect();
    assert_eq!(speeds[0], [0.0; 10]);
    assert!((speeds[1][2] + 0.981).abs() < 0.05, "{:?}", speeds[1]);
}

#[test]
fn the_force_on_a_resting_flex_is_its_weight() {
    let model = r#"<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
        <geom name="ground" type="plane" size="1 1 .1"/>
        <body name="hand" pos="0 0 1"><joint name="x" type="slide" axis="1 0 0"/><geom size=".05"/></body>
        <flexcomp name="jelly" type="grid" count="3 3 3" spacing=".1 .1 .1" dim="3" radius=".01" mass="0.5"
          pos="0 0 .13">
          <edge equality="true" damping="1"/><contact selfcollide="none"/></flexcomp>
        </worldbody><actuator><motor name="m" joint="x" ctrlrange="-1 1"/></actuator></mujoco>"#;
    let world = "modalities:\n  jelly: {normal_force: jelly, average_over: sample}\n  \
                 ground: {normal_force: ground, average_over: sample}\n\
                 action: {actuators: {m: {range: [-0.01, 0.01]}}}\n";
    let directed = world.replace("normal_force: jelly, average_over: sample", "contact_normal: jelly");
    let said = scene(model, &directed).unwrap_err();
    assert!(said.contains("'jelly' is a flex, which has no frame for a direction"), "{said}");
    let scene = scene(model, world).unwrap();
    let episode = run(&scene, 4);
    let (jelly, ground) = (vector(&episode, "jelly"), vector(&episode, "ground"));
    // Each contact of the flex is one with the ground.
    assert_eq!(jelly, ground);
    let weight = jelly[30..].iter().sum::<f32>() / 10.0;
    assert!((weight - 0.5 * 9.81).abs() < 0.15, "{jelly:?}");
}

/// Two fingers of a gripper, each with its own servo, and a motor of both.
const GRIPPER: &str = r#"<mujoco><option gravity="0 0 0"/><worldbody>
    <body pos="0.1 0 0"><joint name="left" type="slide" axis="1 0 0" range="0 0.05" limited="true"/>
      <geom size="0.01"/></body>
    <body pos="-0.1 0 0"><joint name="right" type="slide" axis="-1 0 0" range="0 0.08" limited="true"/>
      <geom size="0.01"/></body>
    </worldbody><actuator><position name="grip_left" joint="left" kp="50" kv="2"/>
    <position name="grip_right" joint="right" kp="50" kv="2"/></actuator>
    <keyframe><key name="home" qpos="0 0"/>
      <key name="half" qpos="0.02 0.03" qvel="0.1 -0.1" ctrl="0.04 0.01"/></keyframe>
    </mujoco>"#;

const JOINTS: &str = "modalities: {joints: {joint_positions: [left, right]}}\n";

#[test]
fn several_actuators_get_the_same_setpoint() {
    let grip = |actuator: &str| format!("{JOINTS}action: {{actuators: {{grip: {{{actuator}}}}}}}\n");
    let both = scene(GRIPPER, &grip("actuators: 'grip_*', unit: m, range: [0, 0.05]")).unwrap();
    let episode = run(&both, 3);
    let fingers: Vec<&[f32]> = vector(&episode, "joints").chunks(2).collect();
    // Both servos start at the setpoint in the middle, and move alike.
    assert_eq!(fingers[0], [0.025, 0.025]);
    assert!(fingers.iter().all(|pair| (pair[0] - pair[1]).abs() < 1e-6), "{fingers:?}");
    assert!(fingers.iter().any(|pair| (pair[0] - 0.025).abs() > 0.005), "{fingers:?}");
    for (actuator, expected) in [
        ("actuators: 'grip_*', range: [0, 0.06]", "range: [0, 0.06] must lie within [0, 0.05]"),
        (
            "actuators: 'grip_*', actuator: grip_left, range: [0, 0.05]",
            "'actuators' names several, and 'actuator' one",
        ),
        (
            "actuators: 'hand_*', range: [0, 0.05]",
            "'hand_*' matches nothing among the model's actuator names",
        ),
    ] {
        let said = scene(GRIPPER, &grip(actuator)).unwrap_err();
        let expected = expected.trim_start_matches("range: ");
        assert!(said.starts_with("robot.yaml:5:") && said.contains(expected), "{said}");
    }
    let twice = "action: {actuators: {grip: {actuators: 'grip_*', range: [0, 0.05]}, grip_left: {range: [0, 0.05]}}}\n";
    let said = scene(GRIPPER, &format!("{JOINTS}{twice}")).unwrap_err();
    assert!(said.contains("another element of the action drives the same actuator"), "{said}");
}

#[test]
fn episodes_start_from_the_keyframe_of_the_world() {
    let action = "action: {actuators: {grip_left: {range: [0, 0.05]}, grip_right: {range: [0.02, 0.05]}}}\n";
    let speeds = JOINTS.replace("}}\n", "}, speeds: {joint_velocities: [left, right]}}\n");
    let half = scene(GRIPPER, &format!("{speeds}keyframe: half\n{action}")).unwrap();
    let episode = run(&half, 1);
    assert_eq!(vector(&episode, "joints")[..2], [0.02, 0.03]);
    assert_eq!(vector(&episode, "speeds")[..2], [0.1, -0.1]);
    // The second control of the keyframe is below its range.
    assert_eq!(episode.vector(Modality::SETPOINT)[..2], [0.04, 0.02]);
    assert_eq!(half.rest(), [0.02, 0.03]);
    // MuJoCo's own state after the keyframe was set, and after a step with the same controls.
    let mut data = MjData::new(half.model());
    data.reset_keyframe(1).unwrap();
    assert_eq!(data.qpos(), half.rest());
    let said = scene(GRIPPER, &format!("{speeds}keyframe: away\n{action}")).unwrap_err();
    assert!(
        said.contains("robot.yaml:5:11: the model has no keyframe 'away'; the model has home, half"),
        "{said}"
    );
    let without = scene(GRIPPER, &format!("{speeds}{action}")).unwrap();
    assert_eq!(vector(&run(&without, 1), "joints")[..2], [0.025, 0.035]);
}

/// A ball that a mocap body carries by a weld, and a table below it. Nothing has an actuator.
const CARRIED: &str = r#"<mujoco><option timestep="0.002"/><worldbody>
    <light pos="0 0 2"/><camera name="side" pos="0 -1 0.5" xyaxes="1 0 0 0 0.2 1"/>
    <geom name="table" type="plane" size="1 1 .1" rgba="0.2 0.2 0.2 1"/>
    <body name="hand" mocap="true" pos="0 0 0.5">
      <geom name="hand" size="0.03" contype="0" conaffinity="0" rgba="1 0 0 1"/></body>
    <body name="ball" pos="0 0 0.5"><freejoint name="ball"/><geom size="0.05" mass="0.1" rgba="0 1 0 1"/></body>
    </worldbody><equality><weld body1="hand" body2="ball"/></equality>
    <keyframe><key name="high" qpos="0 0 0.8 1 0 0 0" mpos="0.1 0 0.8"/></keyframe></mujoco>"#;

const CARRYING: &str = "modalities:\n  hand: {body_positions: hand}\n  ball: {body_positions: ball}\n  \
    table: {normal_force: table}\n  view: {camera: side, size: [32, 32]}\n  \
    flow: {optical_flow: side, size: [32, 32]}\n\
    action:\n  actuators:\n    hand_x: {mocap: hand, axis: x, unit: m, range: [-0.2, 0.2]}\n    \
    hand_z: {mocap: hand, axis: z, unit: m, range: [0.02, 0.6], start: high}\n";

#[test]
fn a_mocap_body_follows_the_setpoints_and_carries_others() {
    let scene = scene(CARRIED, CARRYING).unwrap();
    let spec = Simulation { actuations_per_episode: 4, ..scene.world().simulation() };
    let episode = run(&scene, 4);
    let (hand, ball) = (vector(&episode, "hand"), vector(&episode, "ball"));
    let setpoints = episode.vector(Modality::SETPOINT);
    for ((hand, ball), setpoint) in hand.chunks(3).zip(ball.chunks(3)).zip(setpoints.chunks(2)) {
        assert_eq!([hand[0], hand[1], hand[2]], [setpoint[0], 0.0, setpoint[1]]);
        // The weld is soft, and the table keeps the ball up.
        let off = (hand[0] - ball[0]).hypot(hand[2].max(0.05) - ball[2]);
        assert!(off < 0.12, "{hand:?} {ball:?}");
    }
    assert_eq!(hand[..3], [0.0, 0.0, 0.6]);
    let moved = hand.chunks(3).map(|hand| hand[0]).fold((1.0f32, -1.0f32), |(l, h), x| (l.min(x), h.max(x)));
    assert!(moved.1 - moved.0 > 0.05, "{moved:?}");
    // The pictures of a replayed episode show the mocap body where the recorded images do.
    let states = replay(&scene, &spec, 0).unwrap();
    assert_eq!(states[0].len(), 10);
    let mut renderer = SceneRenderer::as_recorded(&scene, None).unwrap();
    let images = episode.image(Modality::new("view").unwrap());
    for (state, image) in states.iter().zip(images.chunks(32 * 32 * 3)) {
        assert_eq!(renderer.render(state).unwrap().as_raw(), image);
    }
    assert_ne!(images[..32 * 32 * 3], images[images.len() - 32 * 32 * 3..]);
    // Its own color moves with its true flow: some pixel that was hidden or has moved is not 128.
    let flow = episode.image(Modality::new("flow").unwrap());
    assert!(flow[32 * 32 * 3..].chunks(3).any(|pixel| pixel[0] != 128 || pixel[1] != 128));
}

#[test]
fn a_keyframe_places_mocap_bodies() {
    let scene = scene(CARRIED, &format!("keyframe: high\n{CARRYING}")).unwrap();
    let episode = run(&scene, 1);
    // The height is clipped to its range.
    assert_eq!(episode.vector(Modality::SETPOINT)[..2], [0.1, 0.6]);
    assert_eq!(vector(&episode, "ball")[..3], [0.0, 0.0, 0.8]);
}

#[test]
fn mistakes_about_mocap_bodies_have_their_line() {
    for (old, new, expected) in [
        ("mocap: hand, axis: x", "mocap: hand", "robot.yaml:12:13: 'mocap' needs an 'axis': x, y or z"),
        ("mocap: hand, axis: x", "axis: x", "robot.yaml:12:13: only a 'mocap' has an 'axis'"),
        (
            "mocap: hand, axis: x",
            "mocap: hand, axis: x, actuator: a",
            "'mocap' moves a body without an actuator",
        ),
        (
            "mocap: hand, axis: x",
            "mocap: ball, axis: x",
            "body 'ball' is no mocap body; write mocap=\"true\"",
        ),
        ("mocap: hand, axis: x", "mocap: foot, axis: x", "the model has no body 'foot'; the model has "),
        (
            "mocap: hand, axis: x",
            "mocap: hand, axis: z",
            "another element of the action moves the same coordinate",
        ),
    ] {
        assert!(CARRYING.contains(old));
        let said = scene(CARRIED, &CARRYING.replace(old, new)).unwrap_err();
        assert!(said.starts_with("robot.yaml:1") && said.contains(expected), "{said}");
    }
}

/// Returns the product of two quaternions w, x, y, z.
fn product(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

#[test]
fn poses_relative_to_a_body_are_those_in_its_frame() {
    let world = "modalities:\n  places: {body_positions: [rock, arm]}\n  turns: {body_orientations: [rock, arm]}\n  \
                 near: {body_positions: [rock, arm], relative_to: arm, set: true}\n  \
                 turned: {body_orientations: [rock, arm], relative_to: arm}\n\
                 action: {actuators: {turn: {range: [-0.1, 0.1]}}}\n";
    let scene = scene(TUMBLING, world).unwrap();
    let definition = |name: &str| &scene.layout()[Modality::new(name).unwrap()];
    assert_eq!(definition("near").meaning, "Position in the frame of arm of");
    assert_eq!((definition("near").objects, definition("turned").objects), (Some(2), None));
    let episode = run(&scene, 2);
    let [places, near] = ["places", "near"].map(|name| vector(&episode, name).chunks(6));
    let [turns, turned] = ["turns", "turned"].map(|name| vector(&episode, name).chunks(8));
    let mut moved = 0.0_f64;
    for (((place, near), turn), turned) in places.zip(near).zip(turns).zip(turned) {
        let quaternion = |values: &[f32]| [0, 1, 2, 3].map(|index| f64::from(values[index]));
        let [w, x, y, z] = quaternion(&turn[4..]);
        let back = [w, -x, -y, -z];
        let [dx, dy, dz] = [0, 1, 2].map(|axis| f64::from(place[axis] - place[3 + axis]));
        let [_, expected @ ..] = product(product(back, [0.0, dx, dy, dz]), [w, x, y, z]);
        let mut relative = product(back, quaternion(turn));
        let sign = if relative[0] < 0.0 { -1.0 } else { 1.0 };
        relative.iter_mut().for_each(|value| *value *= sign);
        let off = |found: &[f32], expected: &[f64]| {
            found
                .iter()
                .zip(expected)
                .map(|(found, expected)| (f64::from(*found) - expected).abs())
                .fold(0.0, f64::max)
        };
        assert!(off(near, &[expected.as_slice(), &[0.0; 3]].concat()) < 1e-5, "{near:?} is not {expected:?}");
        assert!(off(turned, &[relative.as_slice(), &[1.0, 0.0, 0.0, 0.0]].concat()) < 1e-5, "{turned:?}");
        moved = moved.max(off(near, &[dx, dy, dz]));
    }
    // The frame turns: the differences in the world are others.
    assert!(moved > 0.01, "{moved}");
}
