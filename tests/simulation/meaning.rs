//! Features of MuJoCo that change what a recorded value means. What is recorded is compared with MuJoCo's own state,
//! and with laws of physics.

use super::parts::{run, scene, vector};
use harness_simulation::{
    Episode, EpisodePlan, Knowledge, Scene, SceneRenderer, draft_world, notes, replay, simulate_on,
};
use harness_spec::{Modality, Scenario, Simulation, World};
use mujoco_rs::prelude::*;

const GRAVITY: f64 = 9.81;

/// The notes of `world check`, as one text.
fn said(scene: &Scene) -> String {
    notes(scene).unwrap().notes.join("\n")
}

fn note_of(model: &str, world: &str) -> String {
    said(&scene(model, world).unwrap())
}

/// An orientation servo and a PID servo, which have several controls, before the motor of a hinge.
const SEVERAL: &str = r#"<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
    <body name="a"><joint name="ball" type="ball" damping="1"/><geom size=".1" mass="1"/></body>
    <body name="b" pos="1 0 0"><joint name="slide" type="slide" damping="1"/><geom size=".1" mass="1"/></body>
    <body name="c" pos="2 0 0"><joint name="hinge" damping=".5"/><geom size=".1" pos=".3 0 0" mass="1"/></body>
    </worldbody><actuator><orientation name="turn" joint="ball" input="quat" kp="1"/>
      <pid name="push" joint="slide" kp="50" posrange="-1 1"/><motor name="drive" joint="hinge" ctrlrange="-2 2"/>
    </actuator><keyframe><key name="zero"/><key name="one" qpos="1 0 0 0 .1 .2" ctrl="1 0 0 0 .5 .6 1.5"/></keyframe>
    </mujoco>"#;

const HINGE: &str = "modalities: {joints: {joint_positions: [slide, hinge]}}\n";

#[test]
fn a_setpoint_drives_the_controls_of_its_own_actuator() {
    let action =
        "action: {actuators: {drive: {range: [-2, 2]}, push: {control: pos, range: [-1, 1], start: high}}}\n";
    let moved = scene(SEVERAL, &format!("{HINGE}{action}")).unwrap();
    let (spec, episode) = (moved.world().simulation(), run(&moved, 2));
    let spec = Simulation { actuations_per_episode: 2, ..spec };
    let plan = EpisodePlan::draw(&moved, &spec, 0).unwrap();
    let mut data = MjData::new(moved.model());
    // The position servo starts at its setpoint.
    data.qpos_mut()[4] = 1.0;
    let mut setpoint = [0.0; 2];
    for joints in vector(&episode, "joints").chunks(2) {
        assert_eq!(joints, [data.qpos()[4] as f32, data.qpos()[5] as f32]);
        for _ in 0..50 {
            let step = (data.time() / 0.002).round() as usize;
            plan.setpoint(step, &mut setpoint);
            (data.ctrl_mut()[6], data.ctrl_mut()[4]) = (setpoint[0], setpoint[1]);
            data.step();
        }
    }
    assert!(
        vector(&episode, "joints").chunks(2).any(|joints| joints[1].abs() > 0.1),
        "the motor moves the hinge"
    );
    let said = said(&moved);
    assert!(
        !said.contains("ctrlrange") && said.contains("the controls vel of the actuator 'push', which stay 0"),
        "{said}"
    );
    let keyframe = scene(SEVERAL, &format!("{HINGE}keyframe: one\n{action}")).unwrap();
    assert_eq!(run(&keyframe, 1).vector(Modality::SETPOINT)[..2], [1.5, 0.5]);
}

#[test]
fn one_of_several_controls_must_be_named() {
    for (element, expected) in [
        (
            "turn: {range: [-1, 1]}",
            "actuator 'turn' has the controls qw, qx, qy, qz, and a setpoint is one number; name one, such as control: \
             qw",
        ),
        (
            "turn: {control: pos, range: [-1, 1]}",
            "actuator 'turn' has no control 'pos'; it has qw, qx, qy, qz",
        ),
        (
            "drive: {control: pos, range: [-1, 1]}",
            "actuator 'drive' has no control 'pos'; its only control has no name; leave this out",
        ),
        ("push: {control: pos, range: [-1, 2]}", "[-1, 2] must lie within [-1, 1], which the model allows"),
        (
            "p: {actuator: push, control: pos, range: [0, 1]}, q: {actuator: push, control: pos, range: [0, 1]}",
            "another element of the action drives the same actuator",
        ),
    ] {
        let said = scene(SEVERAL, &format!("{HINGE}action:\n  actuators: {{{element}}}\n")).unwrap_err();
        assert!(said.starts_with("robot.yaml:6:") && said.contains(expected), "{said}");
    }
    let both = "action: {actuators: {p: {actuator: push, control: pos, range: [0, 1]}, \
                v: {actuator: push, control: vel, range: [-1, 1]}}}\n";
    assert!(!note_of(SEVERAL, &format!("{HINGE}{both}")).contains("which stay"));
    // A first world file has an element for each control, also of an actuator without a name.
    let unnamed = SEVERAL.replacen("<pid name=\"push\"", "<pid", 1);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("several.xml");
    std::fs::write(&path, &unnamed).unwrap();
    let drafted = draft_world(&path, "several.xml", None).unwrap();
    for line in [
        "turn_qw: {actuator: \"turn\", control: qw, ",
        "actuator_1_vel: {actuator: \"actuator_1\", control: vel, range",
        "    drive: {actuator: \"drive\", range: [-2.0, 2.0]}\n",
    ] {
        assert!(drafted.contains(line), "{line}: {drafted}");
    }
    let world = World::parse("several.yaml", Some("".into()), "several", &drafted).unwrap();
    Scene::from_xml(world.into(), &unnamed, "several.xml".into()).unwrap();
    let reach = "action: {actuators: {reach: {actuator: actuator_1, control: pos, range: [0, 1]}}}\n";
    let said = note_of(&unnamed, &format!("{HINGE}{reach}"));
    assert!(said.contains("the controls vel of the actuator 'actuator_1', which stay 0"), "{said}");
}

/// A ball on a slide that rests on the floor, and a motor that pushes it up.
fn resting(geom: &str, ball: &str, more: &str) -> String {
    format!(
        r#"<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="2 2 .1" {geom}/>
        <body name="ball" pos="0 0 .1"><joint name="z" type="slide" axis="0 0 1"/>
          <geom name="ball" size=".1" mass="1" {ball}/></body></worldbody>
        <actuator><motor name="push" joint="z" ctrlrange="0 12"/>{more}</actuator></mujoco>"#
    )
}

const TOUCHED: &str = "modalities:\n  force:\n    normal_force: [ball, floor]\n    contact_kinds: {ground: floor}\n    \
                       minimum: null\n  mean: {normal_force: ball, average_over: sample, minimum: null}\n  \
                       push: {contact_normal: [ball, floor]}\n\
                       action: {seconds: 2, actuators: {push: {range: [0, 1.0e-9]}}}\n";

fn last(episode: &Episode, name: &str) -> f64 {
    f64::from(*vector(episode, name).last().unwrap())
}

#[test]
fn a_force_is_the_net_force_of_an_adhesive_contact() {
    let world = scene(&resting("adhesion=\"5\" gap=\".01\"", "", ""), TOUCHED).unwrap();
    let episode = run(&world, 1);
    assert!((last(&episode, "force") - GRAVITY).abs() < 1e-3, "{}", last(&episode, "force"));
    assert!((last(&episode, "mean") - GRAVITY).abs() < 1e-3, "{}", last(&episode, "mean"));
    let ends = |episode: &Episode| vector(episode, "push").last_chunk::<6>().copied().unwrap();
    assert_eq!(ends(&episode), [0.0, 0.0, -1.0, 0.0, 0.0, 1.0]);
    assert!(said(&world).contains("geoms have adhesion"));
    let force = &world.layout()[Modality::new("force").unwrap()];
    assert_eq!((force.minimum, force.is_force()), (None, true));
    // A bound of 0 would be wrong, so the world says what it is.
    let bounded = TOUCHED.replace(", minimum: null", "");
    let said = scene(&resting("adhesion=\"5\"", "", ""), &bounded).unwrap_err();
    assert!(said.starts_with("robot.yaml:9:") && said.contains("minimum: null, for no bound"), "{said}");
    // Pulled with more than its weight, it hangs on the floor, and the contact is still one with the ground.
    let pulled = TOUCHED.replace("[0, 1.0e-9]", "[11.999, 12]");
    let episode = run(&scene(&resting("adhesion=\"5\" gap=\".01\"", "", ""), &pulled).unwrap(), 1);
    assert!((last(&episode, "force") - (GRAVITY - 12.0)).abs() < 1e-2, "{}", last(&episode, "force"));
    assert_eq!(last(&episode, "force_kind"), 1.0);
    assert_eq!(ends(&episode), [0.0, 0.0, 1.0, 0.0, 0.0, -1.0]);
    let active = resting("", "", "<adhesion name=\"stick\" body=\"ball\" ctrlrange=\"0 1\" gain=\"5\"/>");
    assert!(note_of(&active, TOUCHED).contains("'stick' presses the contacts of a body together"));
}

#[test]
fn forces_at_a_distance_and_unreported_ones_are_noted() {
    let near = resting("margin=\".02\"", "margin=\".1\" gap=\".1\"", "");
    let said = note_of(&near, TOUCHED);
    assert!(
        said.contains(
            "contacts of 'floor', 'ball' have a margin, of up to 0.1 m: normal_force begins at the sum"
        ),
        "{said}"
    );
    // A gap alone makes contacts without forces.
    assert!(!note_of(&resting("", "gap=\".1\"", ""), TOUCHED).contains("margin"));
    let soft = r#"<mujoco><option timestep="0.002" integrator="discrete" solver="CG"/><worldbody>
        <geom name="floor" type="plane" size="3 3 .1"/>
        <body name="press" pos="0 0 .6"><joint name="z" type="slide" axis="0 0 1" damping="5"/>
          <geom name="ball" size=".1" mass="1"/></body>
        <flexcomp name="pad" type="grid" count="3 3 2" spacing=".1 .1 .1" pos="0 0 .25" radius=".02" mass="1" dim="3">
          <elasticity young="5e4" poisson="0.1" damping="0.01"/>
          <contact selfcollide="none" passive="true"/></flexcomp></worldbody>
        <actuator><motor name="push" joint="z" ctrlrange="0 12"/></actuator></mujoco>"#;
    let said = note_of(soft, TOUCHED);
    assert!(said.contains("the flex 'pad' has passive contacts: normal_force leaves out"), "{said}");
}

/// A box that falls asleep on the floor beside an arm, which is commanded to push it after some seconds.
const ASLEEP: &str = r#"<mujoco><option timestep="0.002"><flag sleep="enable"/></option><worldbody>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <body name="arm" pos="-.6 0 .1"><joint name="y" type="slide" axis="1 0 0" damping="5"/>
      <geom name="arm" size=".05" mass="1"/></body>
    <body name="box" pos="0 0 .1"><freejoint name="box"/><geom name="box" type="box" size=".1 .1 .1" mass="1"/>
      <site name="skin" type="box" size=".11 .11 .11"/></body>
    <body name="top" pos="0 0 .3"><freejoint name="top"/><geom name="top" type="box" size=".1 .1 .1" mass="1"/></body>
    </worldbody>
    <actuator><position name="push" joint="y" kp="200" kv="20" ctrlrange="0 1"/></actuator>
    <sensor><touch name="touch" site="skin"/></sensor></mujoco>"#;

const BESIDE: &str = "modalities:\n  force:\n    normal_force: [floor, box, top]\n    \
                      contact_kinds: {ground: floor, block: [box, top]}\n  \
                      mean: {normal_force: [box], average_over: sample}\n  push: {contact_normal: top}\n  felt: {sensor: touch, unit: N}\n  \
                      places: {joint_positions: [y, box]}\n\
                      action: {seconds: 1, actuators: {push: {range: [0, 0.6], start: low}}}\n";

#[test]
fn a_sleeping_body_keeps_its_forces_until_something_wakes_it() {
    let (beside, awake) = (scene(ASLEEP, BESIDE).unwrap(), scene(&awake(ASLEEP), BESIDE).unwrap());
    let (episode, expected) = (run(&beside, 6), run(&awake, 6));
    let (forces, places) = (vector(&episode, "force"), vector(&episode, "places"));
    let touched = places.chunks(8).position(|places| places[0] > 0.44).unwrap();
    assert!(touched > 8, "{touched}");
    for sample in 3..touched {
        for (name, width) in [("force", 3), ("force_kind", 3), ("mean", 1), ("push", 3)] {
            let [one, other] =
                [&episode, &expected].map(|episode| &vector(episode, name)[sample * width..][..width]);
            let is_same = one.iter().zip(other).all(|(one, other)| (one - other).abs() < 0.02);
            assert!(is_same, "{name} at {sample}: {one:?} {other:?}");
        }
        for (force, weights) in forces[3 * sample..].iter().zip([2.0, 3.0, 1.0]) {
            assert!((f64::from(*force) - weights * GRAVITY).abs() < 0.1, "{sample}: {force} {weights}");
        }
    }
    // Once the box is pushed, the forces of its new contacts replace those that it had, and the floor bears both boxes.
    let pushed = |link: usize| forces.chunks(3).skip(touched).map(move |forces| f64::from(forces[link]));
    assert!(pushed(1).any(|force| (force - 3.0 * GRAVITY).abs() > 0.2), "{forces:?}");
    let mean = pushed(0).sum::<f64>() / pushed(0).count() as f64;
    assert!((mean - 2.0 * GRAVITY).abs() < 0.5 * GRAVITY, "{mean}");
    assert!(said(&beside).contains("bodies can sleep") && !said(&awake).contains("bodies can sleep"));
}

#[test]
fn a_body_sleeps_on_where_a_simulation_goes_on_from_a_sample() {
    let beside = scene(ASLEEP, BESIDE).unwrap();
    let spec = Simulation { actuations_per_episode: 2, ..beside.world().simulation() };
    let episode = run(&beside, 2);
    let at: Vec<usize> = (8..12).collect();
    let found = simulate_on(&beside, &spec, 0, &at, &[1, 5], &Knowledge::default()).unwrap();
    for (ahead, horizon) in found.ahead.iter().zip([1, 5]) {
        let [one, other] = [vector(ahead, "force"), &vector(&episode, "force")[3 * (8 + horizon)..][..12]];
        assert_eq!(one, other);
    }
}

#[test]
fn noise_and_what_is_commanded_are_no_forces_above_0() {
    let noisy = format!(
        "{}factors: {{error: {{sensor_noise: f*, offset_by: {{choice: 1}}}}}}\n",
        TOUCHED
            .replace("    minimum: null\n", "")
            .replace("[0, 1.0e-9]", "[0, 1.0e-9], unit: N")
            .replace("    contact_kinds: {ground: floor}\n", "")
    );
    let world = scene(&resting("", "", ""), &noisy).unwrap();
    let minimum = |factors: Vec<String>| {
        let spec = Simulation { factors, ..world.world().simulation() };
        let layout = world.layout_of(&spec);
        assert_eq!(layout.stored_vectors().filter(|one| one.is_force()).count(), 2);
        let force = Modality::new("force").unwrap();
        assert_eq!(world.world().scaling(force, &spec.factors).unwrap().minimum, layout[force].minimum);
        layout[force].minimum
    };
    assert_eq!((minimum(vec![]), minimum(vec!["error".into()])), (Some(0.0), None));
}

#[test]
fn a_world_that_diverges_is_refused() {
    let unstable = resting("", "", "")
        .replace("<joint name=\"z\"", "<joint stiffness=\"1e12\" springref=\"1\" name=\"z\"");
    let said = notes(&scene(&unstable, TOUCHED).unwrap()).err().unwrap().to_string();
    assert!(said.contains("diverged") || said.contains("unstable"), "{said}");
}

#[test]
fn names_that_yaml_reads_as_something_else_are_quoted_in_a_first_world_file() {
    let model = r#"<mujoco><worldbody><body name="a"><freejoint/><geom size=".1"/><site name="s"/></body></worldbody>
        <actuator><motor name="null" site="s" gear="1 0 0 0 0 0"/><motor name="True" site="s" gear="0 1 0 0 0 0"/>
          <motor name="1e3" site="s"/><motor name="~" site="s"/></actuator></mujoco>"#;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("free.xml");
    std::fs::write(&path, model).unwrap();
    let drafted = draft_world(&path, "free.xml", None).unwrap();
    assert!(drafted.contains("\n    \"null\": {") && drafted.contains("\n    \"true\": {"), "{drafted}");
    assert!(drafted.contains("\n  body_positions: {body_positions: [\"a\"]}\n"), "{drafted}");
    // The name of an unnamed body's number is taken.
    let taken = model.replace("name=\"a\"", "").replace(
        "</worldbody>",
        "<body name=\"body_1\"><joint name=\"j\"/><geom size=\".1\"/></body></worldbody>",
    );
    std::fs::write(&path, taken).unwrap();
    assert!(!draft_world(&path, "free.xml", None).unwrap().contains("[]"));
}

/// The same model with bodies that never sleep.
fn awake(model: &str) -> String {
    model.replace("<flag sleep=\"enable\"/>", "")
}

#[test]
fn a_body_that_the_model_starts_asleep_has_the_forces_that_it_would_have_awake() {
    let model = ASLEEP.replace("pos=\"0 0 .1\"", "sleep=\"init\" pos=\"0 0 .0999\"");
    let model = model.replace("pos=\"0 0 .3\"", "sleep=\"init\" pos=\"0 0 .2997\"");
    let [episode, expected] = [&model, &awake(&model).replace("sleep=\"init\"", "")]
        .map(|model| vector(&run(&scene(model, BESIDE).unwrap(), 1), "force").to_vec());
    assert!(expected[..3].iter().all(|force| *force > 5.0), "{expected:?}");
    for (one, other) in episode[..3].iter().zip(&expected) {
        assert!((one - other).abs() < 1e-4, "{episode:?} {expected:?}");
    }
    assert_eq!(episode[..3], episode[9..12]);
    // One that only touches the floor would not press on it either at the start.
    let flush = ASLEEP.replace("pos=\"0 0 .1\"", "sleep=\"init\" pos=\"0 0 .1\"");
    let flush = flush.replace("pos=\"0 0 .3\"", "sleep=\"init\" pos=\"0 0 .3\"");
    let forces = vector(&run(&scene(&flush, BESIDE).unwrap(), 1), "force").to_vec();
    assert!(forces.iter().all(|force| *force < 1e-6), "{forces:?}");
}

/// A slide, another joint that depends on it, and an actuator. The first setpoint is 0.5.
fn settled(actuator: &str, more: &str) -> Scene {
    let model = format!(
        r#"<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
        <body name="a"><joint name="j" type="slide" axis="1 0 0" range="-2 2" damping="10" ref="0.1"/>
          <geom size=".1" mass="1" contype="0"/></body>
        <body name="b" pos="0 1 0"><joint name="k" type="slide" axis="1 0 0" damping="10" ref="0.3"/>
          <geom size=".1" mass="1" contype="0"/></body></worldbody>
        <actuator>{actuator}</actuator>{more}</mujoco>"#
    );
    let world = "modalities: {q: {joint_positions: [j, k]}}\n\
                 action: {actuators: {p: {actuator: a*, range: [0.5, 0.500001]}}}\n"
        .replace("actuator: a*", "actuators: a*");
    scene(&model, &world).unwrap()
}

#[test]
fn an_episode_starts_settled() {
    let servo = "<position name=\"a\" joint=\"j\" kp=\"100\" ctrlrange=\"-1 1\"/>";
    let equality = |joints: &str| format!("<equality><joint {joints} polycoef=\"0.1 -2 0 0 0\"/></equality>");
    let cases = [
        (servo, String::new(), [0.5, 0.3], ""),
        (
            "<position name=\"a\" joint=\"j\" kp=\"100\" timeconst=\"0.5\"/>",
            String::new(),
            [0.5, 0.3],
            "'a' has a state of its own",
        ),
        (
            "<position name=\"a\" joint=\"j\" kp=\"100\" delay=\"0.1\" nsample=\"60\"/>",
            String::new(),
            [0.5, 0.3],
            "'a' takes the setpoint with a delay",
        ),
        ("<pid name=\"a\" joint=\"j\" kp=\"100\" kv=\"2\" input=\"pos\"/>", String::new(), [0.5, 0.3], ""),
        (
            "<pid name=\"a\" joint=\"j\" kp=\"100\" ki=\"3\" slewmax=\"0.1\" input=\"pos\"/>",
            String::new(),
            [0.5, 0.3],
            "'a' has a state of its own",
        ),
        (
            "<dcmotor name=\"a\" joint=\"j\" motorconst=\"1\" resistance=\"1\" input=\"pos\" \
             controller=\"9 0 1 0.1\"/>",
            String::new(),
            [0.5, 0.3],
            "'a' has a state of its own",
        ),
        // k - 0.3 = 0.1 - 2 (j - 0.1), and the other way round.
        (servo, equality("joint1=\"k\" joint2=\"j\""), [0.5, -0.4], "'k' is coupled by an equality"),
        (servo, equality("joint1=\"j\" joint2=\"k\""), [0.5, 0.15], "'k' is coupled by an equality"),
        (servo, equality("joint1=\"k\""), [0.5, 0.4], "'k' is coupled by an equality"),
    ];
    for (actuator, more, expected, note) in cases {
        let scene = settled(actuator, &more);
        let episode = run(&scene, 1);
        for joints in vector(&episode, "q").chunks(2) {
            let near = joints
                .iter()
                .zip(expected)
                .all(|(found, expected)| (f64::from(*found) - expected).abs() < 1e-4);
            assert!(near, "{actuator} {more}: {joints:?}");
        }
        let said = said(&scene);
        assert!(said.contains(note) && !said.contains("not start settled"), "{actuator}: {said}");
    }
    // The setpoint of this servo is a velocity, so the joint starts where the model has it, and moves from there.
    let integrated =
        settled("<intvelocity name=\"a\" joint=\"j\" kp=\"1000\" kv=\"50\" actrange=\"-1 1\"/>", "");
    let joints: Vec<f32> = vector(&run(&integrated, 1), "q").iter().copied().step_by(2).collect();
    assert_eq!(joints[0], 0.1);
    assert!((joints[9] - 0.55).abs() < 0.1 && joints.is_sorted(), "{joints:?}");
    let said = said(&integrated);
    assert!(
        said.contains("an episode does not start settled: with the first setpoints, the joints 'j' move"),
        "{said}"
    );
}

#[test]
fn a_joint_that_is_coupled_starts_where_its_equality_says() {
    let model = r#"<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".1"/></body>
        <body pos="1 0 0"><joint name="k" type="slide"/><geom size=".1"/></body></worldbody>
        <equality><joint joint1="k" joint2="j"/></equality>
        <actuator><motor name="p" joint="j"/></actuator></mujoco>"#;
    let world = |joint: &str| {
        format!(
            "modalities: {{q: {{joint_positions: [j, k]}}}}\naction: {{actuators: {{p: {{range: [0, 1]}}}}}}\n\
             factors: {{start: {{joint_start: {joint}, offset_by: {{uniform: [0.1, 0.2]}}}}}}\n"
        )
    };
    let said = scene(model, &world("k")).unwrap_err();
    assert!(
        said.contains("joint 'k' is coupled by an equality, which says where it starts; leave it out"),
        "{said}"
    );
    let offset = scene(model, &world("j")).unwrap();
    let spec = Simulation { factors: vec!["start".into()], ..offset.world().simulation() };
    let state = replay(&offset, &spec, 0).unwrap().swap_remove(0);
    assert!(state[0] >= 0.1 && state[0] == state[1], "{state:?}");
}

/// A mocap plate before the camera of a cart, where the keyframe puts it.
fn posed(pose: &str) -> Scene {
    let model = format!(
        r#"<mujoco><option timestep="0.002"/><visual><quality shadowsize="0" offsamples="0"/></visual><worldbody>
        <light pos="0 0 3"/><geom name="floor" type="plane" size="5 5 .1"/>
        <body name="plate" mocap="true" {pose}><geom type="box" size=".3 .05 .2" contype="0" rgba="1 0 0 1"/></body>
        <body name="cart" pos="0 -1.5 .5"><joint name="j" type="slide" axis="1 0 0" damping="5"/>
          <geom size=".03" mass="1" contype="0"/><camera name="eye" pos="0 .1 0" xyaxes="1 0 0 0 0 1"/></body>
        </worldbody>
        <actuator><position name="p" joint="j" kp="50" ctrlrange="-.5 .5"/></actuator>
        <keyframe><key name="k" qpos="0" ctrl="0" mpos="0.1 0 .5" mquat=".9 0 .3 .1"/></keyframe></mujoco>"#
    );
    let world = "keyframe: k\nmodalities:\n  flow: {optical_flow: eye, size: [16, 16]}\n  \
                 view: {camera: eye, size: [16, 16]}\naction: {actuators: {p: {range: [-0.5, 0.5]}}}\n";
    scene(&model, world).unwrap()
}

#[test]
fn flows_and_pictures_show_mocap_bodies_where_the_keyframe_has_them() {
    let (there, elsewhere) = (posed("pos=\"0.1 0 .5\" quat=\".9 0 .3 .1\""), posed("pos=\"0 3 .5\""));
    let image = |episode: &Episode, name: &str| episode.image(Modality::new(name).unwrap()).to_vec();
    let (one, other) = (run(&there, 1), run(&elsewhere, 1));
    for name in ["view", "flow"] {
        assert_eq!(image(&one, name), image(&other, name), "{name}");
    }
    let spec = Simulation { actuations_per_episode: 1, ..elsewhere.world().simulation() };
    let state = replay(&elsewhere, &spec, 0).unwrap().swap_remove(5);
    let picture = SceneRenderer::as_recorded(&elsewhere, None).unwrap().render(&state).unwrap();
    assert_eq!(picture.as_raw()[..], image(&other, "view")[5 * 16 * 16 * 3..][..16 * 16 * 3]);
}

#[test]
fn a_model_with_none_of_these_features_keeps_its_datasets() {
    for scenario in Scenario::PAPER {
        assert_eq!(Scene::paper(scenario).unwrap().rule(), None);
    }
    for world in World::built_in() {
        assert_eq!(Scene::new(world.clone()).unwrap().rule(), None, "{}", world.scenario());
    }
    assert_eq!(scene(&resting("", "", ""), TOUCHED).unwrap().rule(), None);
    let changed = [
        scene(&resting("adhesion=\"5\" gap=\".01\"", "", ""), TOUCHED).unwrap(),
        scene(ASLEEP, BESIDE).unwrap(),
        posed("pos=\"0 3 .5\""),
        scene(SEVERAL, &format!("{HINGE}action: {{actuators: {{drive: {{range: [-2, 2]}}}}}}\n")).unwrap(),
        settled("<position name=\"a\" joint=\"j\" kp=\"100\" timeconst=\"0.5\"/>", ""),
    ];
    assert!(changed.iter().all(|scene| scene.rule() == Some(2)));
}
