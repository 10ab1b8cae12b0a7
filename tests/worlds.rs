//! World files: valid files, error messages with their place, and robots that the harness does not know.

use crate::common::{finish, fresh, harness, succeed};
use harness::collection::dataset_of;
use harness::experiment::{Runner, provenance};
use harness::progress::Progress;
use harness::registry::Registry;
use harness::simulation::{Scene, replay};
use harness::spec::{self, Modality, Simulation, World};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

const EMPTY: &str = include_str!("../models/empty.yaml");
const EMPTY_XML: &str = include_str!("../models/empty.xml");

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The error message, without the folder, for a world file `own.yaml`: the empty world with `old` replaced by `new`.
fn fault(old: &str, new: &str) -> String {
    assert!(EMPTY.contains(old), "{old}");
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("own.xml"), EMPTY_XML).unwrap();
    let path = folder.path().join("own.yaml");
    fs::write(&path, EMPTY.replacen(old, new, 1).replacen("model: empty.xml", "model: own.xml", 1)).unwrap();
    let said = match World::load(&path) {
        Ok(world) => Scene::new(world).unwrap_err().to_string(),
        Err(error) => error.to_string(),
    };
    assert!(!said.contains('\n'), "{said}");
    said.replace(&format!("{}/", folder.path().display()), "")
}

/// The line and column, counted from 1, of the first occurrence of `text` in the empty world's file.
fn place(text: &str) -> String {
    let before = &EMPTY[..EMPTY.find(text).unwrap()];
    let line = before.matches('\n').count() + 1;
    format!("own.yaml:{line}:{}", before.len() - before.rfind('\n').map_or(0, |end| end + 1) + 1)
}

#[test]
fn mistakes_of_a_world_file_are_a_line_with_place_and_choices() {
    let cases = [
        (
            "joint_positions: finger_joint_*",
            "joint_positions: knuckle_*",
            place("finger_joint_*"),
            "'knuckle_*' matches nothing among the model's joint names; the model has arm_rotation, arm_lift",
        ),
        (
            "joint_positions: finger_joint_*",
            "joint_positions: []",
            place("finger_joint_*"),
            "'modalities.proprioception.joint_positions': expected a list of at least one item, each a text",
        ),
        (
            "camera: external",
            "camera: inside",
            place("external"),
            "no camera 'inside'; the model has external",
        ),
        (
            "actuator: arm_lift",
            "actuator: lift",
            place("arm_lift, unit"),
            "no actuator 'lift'; the model has arm_rotation, arm_lift, arm_extension",
        ),
        (
            "camera: external",
            "camra: external",
            place("camera: external"),
            "unknown key 'camra' in 'modalities.vision'; did you mean 'camera'?",
        ),
        (
            "    camera: external\n",
            "",
            place("size: [64, 64]"),
            "exactly one of joint_positions, joint_velocities, body_positions, body_orientations, site_positions, \
             site_orientations, normal_force, contact_normal, sensor, camera, optical_flow, depth, segmentation, \
             difference_of; found none",
        ),
        (
            "unit: m, range: [-1, 0]",
            "unit: m, range: [-2, 0]",
            place("[-1, 0]"),
            "[-2, 0] must lie within [-1, 0], which the model allows",
        ),
        (
            "unit: m, range: [-1, 0]",
            "unit: m, range: [0, -1]",
            place("[-1, 0]"),
            "the range [0, -1] is reversed; write [-1, 0]",
        ),
        (
            "unit: m, range: [-1, 0]",
            "unit: \"m\\n\", range: [-1, 0]",
            place("m, range: [-1, 0]"),
            "a unit has no line breaks or tabs",
        ),
        ("  arm:\n", "  proprioception:\n", place("  arm:\n"), "duplicate"),
        (
            "  contact_force:\n",
            "  contact-force:\n",
            place("  contact_force:\n"),
            "'contact-force' in 'modalities' can't be a name; use 1 to 64 lower-case letters, digits and '_', a letter \
             first",
        ),
        (
            "size: [64, 64]",
            "size: [64, 100000]",
            place("64, 64]"),
            "an integer of at least 1 and at most 1024",
        ),
        (
            "difference_of: vision",
            "difference_of: visoin",
            place("vision\n  wrist_difference"),
            "unknown modality 'visoin'; did you mean 'vision'?",
        ),
        ("average_over: sample", "average_over: minute", place("sample\n"), "unknown interval 'minute'"),
        (
            "    joint_positions: arm_*\n",
            "    joint_positions: arm_*\n    set: true\n",
            "own.yaml:13:10".into(),
            "only a pose of bodies or sites has 'set'",
        ),
        (
            "    joint_positions: arm_*\n",
            "    joint_positions: arm_*\n    relative_to: arm_beam\n",
            "own.yaml:13:18".into(),
            "only a pose of bodies or sites has 'relative_to'",
        ),
        (
            "    joint_positions: arm_*\n",
            "    body_positions: arm_*\n    relative_to: arm_baem\n",
            "own.yaml:13:18".into(),
            "the model has no body 'arm_baem'; the model has world, arm_shaft, arm_carriage, arm_beam, finger_link_00",
        ),
        (
            "    joint_positions: arm_*\n",
            "    joint_positions: arm_*\n    contact_kinds: {ground: ground}\n",
            "own.yaml:13:20".into(),
            "only a normal_force has 'contact_kinds'",
        ),
        (
            "    contact_kinds: {ground: ground}\n",
            "    contact_kinds: {none: ground}\n",
            "own.yaml:15:20".into(),
            "'none' means no contact; give this kind another name",
        ),
        (
            "    contact_kinds: {ground: ground}\n",
            "    contact_kinds: {onset: ground}\n",
            "own.yaml:15:20".into(),
            "metrics call a phase of contacts 'onset'; give this kind another name",
        ),
        (
            "    contact_kinds: {ground: ground}\n",
            "    contact_kinds: {ground: ground, floor: ground}\n",
            "own.yaml:15:44".into(),
            "'ground' belongs to the kind 'ground' as well",
        ),
        (
            "step_rate_hz: 1000",
            "step_rate_hz: 500",
            place("1000"),
            "the model's timestep is 0.001 s; write 1000",
        ),
        ("*[02468]", "*[x]", place("\"*[02468]\""), "'*[x]' matches nothing among finger_joint_00"),
        (
            "rotation: rotation,",
            "rotation: turn,",
            place("rotation, extension:"),
            "unknown element of the action 'turn'",
        ),
        (
            "  contact_force:\n",
            "  total:\n",
            place("  contact_force:\n"),
            "'total' means something else in the tables",
        ),
        (
            "joint_stiffness: finger_joint_*",
            "joint_stiffness: knuckle_*",
            place("finger_joint_*, scale_by"),
            "'knuckle_*' matches nothing among the model's joint names; the model has arm_rotation",
        ),
        (
            "joint_stiffness: finger_joint_*",
            "joint_stiffness: arm_*",
            place("finger_joint_*, scale_by"),
            "joint 'arm_rotation' has no stiffness that a factor could multiply",
        ),
        (
            "joint_stiffness: finger_joint_*",
            "joint_stifness: finger_joint_*",
            place("joint_stiffness: "),
            "unknown key 'joint_stifness' in 'factors.finger_stiffness'; did you mean 'joint_stiffness'?",
        ),
        (
            "joint_stiffness: finger_joint_*, ",
            "",
            place("{joint_stiffness: "),
            "a factor has exactly one of joint_stiffness, joint_damping, body_mass, geom_friction, geom_size, \
             geom_colour, light_brightness, camera_position, camera_rotation, actuator_strength, gravity, joint_start, \
             sensor_noise; found none",
        ),
        (
            "finger_joint_*, scale_by: {log_uniform",
            "finger_joint_*, offset_by: {log_uniform",
            place("{joint_stiffness: "),
            "a factor of joint_stiffness has a distribution of its scale under 'scale_by' and no other",
        ),
        (
            "finger_joint_*, scale_by: {log_uniform: [0.5, 2]}",
            "finger_joint_*, scale_by: {log_uniform: [0, 2]}",
            place("{log_uniform: "),
            "a factor of joint_stiffness draws values from 0.001 to 1000; found 0 to 2",
        ),
        (
            "finger_joint_*, scale_by: {log_uniform: [0.5, 2]}",
            "finger_joint_*, scale_by: {uniform: [2, 0.5]}",
            place("{log_uniform: "),
            "the range [2, 0.5] is reversed; write [0.5, 2]",
        ),
        (
            "finger_joint_*, scale_by: {log_uniform: [0.5, 2]}",
            "finger_joint_*, scale_by: {uniform: [0.5, 2], choice: [1, 2]}",
            place("{log_uniform: "),
            "a distribution has exactly one of uniform, log_uniform, normal, choice; found several",
        ),
        (
            "normal: {mean: 0, deviation: 0.05",
            "normal: {mean: 1, deviation: 0.05",
            place("{normal: {mean: 0, deviation: 0.05"),
            "the mean 1 is outside of the range [-0.15, 0.15]",
        ),
        (
            "normal: {mean: 0, deviation: 0.05",
            "normal: {mean: 0, deviation: 0",
            place("0.05, range"),
            "'factors.camera_position.offset_by.normal.deviation': expected a finite number above 0, found 0",
        ),
        (
            "geom_friction: finger_link_*",
            "geom_size: ground",
            place("finger_link_*, scale_by: {uniform"),
            "geom 'ground' is not a sphere, capsule, ellipsoid, cylinder or box, so its size can't be changed",
        ),
        (
            "joint_positions: arm_*",
            "body_positions: elbow",
            place("arm_*\n"),
            "'elbow' matches nothing among the model's body names; the model has world, arm_shaft",
        ),
        (
            "joint_positions: arm_*",
            "site_positions: tip",
            place("arm_*\n"),
            "'tip' matches nothing among the model's site names; the model has no site with a name",
        ),
        (
            "difference_of: vision",
            "{optical_flow: inside, size: [64, 64]}",
            place("difference_of: vision"),
            "the model has no camera 'inside'; the model has external",
        ),
        (
            "difference_of: vision",
            "{optical_flow: external, size: [64, 64], limit_pixels: 0}",
            place("difference_of: vision"),
            "'modalities.frame_difference.limit_pixels': expected a finite number above 0 and at most 1024, found 0",
        ),
        (
            "camera: external",
            "limit_pixels: 8\n    camera: external",
            place("camera: external"),
            "only an optical_flow has 'limit_pixels'",
        ),
        (
            "camera: external",
            "depth: external",
            place("camera: external"),
            "a depth needs the range_m that it encodes, as [0.1, 2]",
        ),
        (
            "camera: external",
            "{depth: external, size: [64, 64], range_m: [2, 2]}\n  other:\n    camera: external",
            place("camera: external"),
            "the lower end must be below the upper end; found 2 and 2",
        ),
        (
            "camera: external",
            "{depth: external, size: [64, 64], range_m: [0, 2]}\n  other:\n    camera: external",
            place("camera: external"),
            "'modalities.vision.range_m': expected a finite number above 0, found 0",
        ),
        (
            "camera: external",
            "range_m: [1, 2]\n    camera: external",
            place("camera: external"),
            "only a depth has 'range_m'",
        ),
        (
            "camera: external",
            "classes: {a: ground}\n    camera: external",
            place("camera: external"),
            "only a segmentation has 'classes'",
        ),
        (
            "camera: external",
            "segmentation: external",
            place("camera: external"),
            "a segmentation needs classes, as {hand: hand_*, box: box_*}",
        ),
        (
            "camera: external",
            "{segmentation: external, size: [64, 64], classes: {a: x, b: x, c: x, d: x, e: x, f: x, g: x, h: x}}\n  \
             other:\n    camera: external",
            place("camera: external"),
            "an image can encode 7 classes; found 8",
        ),
        ("  finger_damping:", "  finger_stiffness:", place("finger_damping:"), "duplicate"),
        (
            "  contact_force:\n",
            "  factors:\n",
            place("  contact_force:\n"),
            "'factors' means something else in the tables",
        ),
    ];
    for (old, new, at, expected) in cases {
        let said = fault(old, new);
        let line = |place: &str| place.split(':').take(2).collect::<Vec<_>>().join(":");
        // The line must be the same, except for a section that lost its first key. The column may differ.
        let near = said.starts_with(&line(&at))
            || new.is_empty()
            || old.contains("  arm")
            || old.starts_with("  contact");
        assert!(near && said.contains(expected), "{at}, {expected}: {said}");
        assert!(said.starts_with("own.yaml:"), "{said}");
    }
}

/// A hand with two geoms, which a servo moves, and two boxes. Some names have characters of patterns or capitals.
const HAND: &str = r#"<mujoco><option timestep="0.003"/><worldbody>
  <geom name="ground" type="plane" size="5 5 0.1"/>
  <body name="hand" pos="0 0 0.3">
    <joint name="x[0]" type="slide" axis="1 0 0" limited="true" range="-0.3 0.3"/><geom name="g1" size="0.02"/>
    <geom name="g2" size="0.02" pos="0.1 0 0"/>
    <body name="thumb"><joint name="x0" type="ball"/><geom name="g3" size="0.01" pos="0 0 0.1"/></body></body>
  <body name="bare" pos="0 0 1"/>
  <body name="b1" pos="1 0 0.05"><freejoint/><geom name="b1" type="box" size="0.05 0.05 0.05"/></body>
  <body name="b2" pos="2 0 0.05"><freejoint/><geom name="b2" type="box" size="0.05 0.05 0.05"/></body>
</worldbody><actuator>
  <position name="m" joint="x[0]" kp="10"/><general name="M" joint="x[0]"/><general name="actuator_1" joint="x[0]"/>
</actuator><sensor><force name="u" site="s"/><touch name="u_0" site="s"/></sensor></mujoco>"#;

#[test]
fn what_would_be_recorded_under_a_wrong_name_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let model =
        HAND.replace("<body name=\"bare\" pos=\"0 0 1\"/>", "<body name=\"bare\"><site name=\"s\"/></body>");
    fs::write(folder.path().join("hand.xml"), model).unwrap();
    let path = folder.path().join("hand.yaml");
    let said = |modalities: &str, actuators: &str, placement: &str| {
        let text = format!(
            "model: hand.xml\nstep_rate_hz: 333.3333333333333\nsample_rate_hz: 33.33333333333333\n\
             modalities: {{joints: {{joint_positions: [\"x[0]\"]}}, {modalities}}}\n\
             action: {{seconds: 0.3, actuators: {{{actuators}}}}}\nplacement: {{{placement}}}\n"
        );
        fs::write(&path, text).unwrap();
        let scene = World::load(&path).map_err(|error| error.to_string());
        scene.and_then(|world| Scene::new(world).map(|_| ()).map_err(|error| error.to_string()))
    };
    let m = "m: {range: [-0.1, 0.1]}";
    assert_eq!(said("a: {normal_force: [hand]}, b: {normal_force: [g3]}", m, ""), Ok(()));
    assert_eq!(
        said("a: {normal_force: [g1, g2]}, b: {normal_force: [g2], average_over: sample}", m, ""),
        Ok(())
    );
    let boxes = "p: {bodies: [b1], clearance_m: 0, rectangle: [[1, 2], [1, 2]]}";
    assert_eq!(said("a: {sensor: [u]}", m, boxes), Ok(()));
    assert_eq!(said("a: {joint_positions: [x0]}, b: {joint_velocities: ['x*']}", m, ""), Ok(()));
    for (modalities, actuators, placement, expected) in [
        (
            "a: {normal_force: [hand]}, b: {normal_force: [g1]}",
            m,
            "",
            "a geom of 'g1' belongs to another force as well",
        ),
        (
            "a: {normal_force: [g1]}, b: {normal_force: [hand]}",
            m,
            "",
            "a geom of 'hand' belongs to another force",
        ),
        ("a: {normal_force: [bare]}", m, "", "body 'bare' has no geom, so nothing can touch it"),
        (
            "a: {sensor: [u]}",
            "m: {range: [-0.1, 0.1]}, n: {actuator: m, range: [0, 0.1]}",
            "",
            "another element of the action drives the same actuator; leave one of them out",
        ),
        (
            "a: {sensor: [u]}",
            m,
            "p: {bodies: [b1], clearance_m: 0, rectangle: [[1, 2], [1, 2]]}, q: {bodies: ['b1', b2], clearance_m: 0, \
             rectangle: [[2, 3], [2, 3]]}",
            "a body of this placement belongs to another one as well; leave it out of one of them",
        ),
    ] {
        let error = said(modalities, actuators, placement).unwrap_err();
        assert!(error.contains(expected) && error.contains("hand.yaml:"), "{error}");
    }
}

#[test]
fn two_modalities_cannot_have_the_same_column() {
    let folder = tempfile::tempdir().unwrap();
    let model = r#"<mujoco><worldbody>
        <body name="a"><joint name="x"/><geom size="0.1"/><site name="s"/></body></worldbody>
        <actuator><motor name="m" joint="x"/></actuator>
        <sensor><force name="u" site="s"/><touch name="0" site="s"/><touch name="t" site="s"/></sensor></mujoco>"#;
    fs::write(folder.path().join("own.xml"), model).unwrap();
    let path = folder.path().join("own.yaml");
    let modalities = "a: {sensor: [u, t]}, a_u: {sensor: ['0', t]}";
    let text = format!(
        "model: own.xml\nstep_rate_hz: 500\nsample_rate_hz: 10\nmodalities: {{{modalities}}}\n\
         action: {{seconds: 1, actuators: {{m: {{range: [-1, 1]}}}}}}\n"
    );
    fs::write(&path, text).unwrap();
    let error = Scene::new(World::load(&path).unwrap()).unwrap_err().to_string();
    assert!(
        error.contains("'a_u' and 'a' would both have the column 'a_u_0'; rename one of them"),
        "{error}"
    );
}

#[test]
fn a_flex_is_felt_by_the_geoms_that_touch_it() {
    let folder = tempfile::tempdir().unwrap();
    let model = r#"<mujoco><worldbody><geom name="ground" type="plane" size="1 1 .1"/>
      <body name="hand" pos="0 0 1"><joint name="x" type="slide" axis="1 0 0"/><geom size=".05"/></body>
      <flexcomp name="jelly" type="grid" count="3 3 3" spacing=".1 .1 .1" dim="3" radius=".01" mass="1" pos="0 0 .2">
        <contact selfcollide="none"/></flexcomp>
      </worldbody><actuator><motor name="m" joint="x" ctrlrange="-1 1"/></actuator></mujoco>"#;
    fs::write(folder.path().join("own.xml"), model).unwrap();
    let path = folder.path().join("own.yaml");
    let scene = |name: &str| {
        let text = format!(
            "model: own.xml\nstep_rate_hz: 500\nmodalities: {{a: {{normal_force: [{name}]}}}}\n\
             action: {{actuators: {{m: {{range: [-1, 1]}}}}}}\n"
        );
        fs::write(&path, text).unwrap();
        Scene::new(World::load(&path).unwrap())
    };
    let said = scene("jelly_0").unwrap_err().to_string();
    let expected =
        "'jelly_0' is a part of a flex, of which only the force on the whole can be sensed; name the flex";
    assert!(said.ends_with(expected), "{said}");
    let ground = scene("ground").unwrap();
    let spec = spec::Simulation { actuations_per_episode: 1, ..ground.world().simulation() };
    let mut simulator = harness::simulation::Simulator::new(&ground, &spec).unwrap();
    let episode = simulator.run(0, &mut || std::ops::ControlFlow::Continue(())).unwrap();
    assert!(episode.vector(Modality::new("a").unwrap()).iter().any(|force| *force > 1.0));
}

#[test]
fn the_values_of_a_sensor_are_named_after_it() {
    let folder = tempfile::tempdir().unwrap();
    let model = r#"<mujoco><worldbody>
        <body name="a"><joint name="x"/><geom size="0.1"/><site name="s"/></body></worldbody>
        <actuator><motor name="m" joint="x"/></actuator>
        <sensor><accelerometer name="acc" site="s"/><gyro name="imu_gyro" site="s"/><touch name="imu_touch" site="s"/>
        <touch name="acc_0" site="s"/></sensor></mujoco>"#;
    fs::write(folder.path().join("own.xml"), model).unwrap();
    let path = folder.path().join("own.yaml");
    for (sensors, expected) in [
        ("acc", &["acc_0", "acc_1", "acc_2"][..]),
        ("'[a]cc'", &["acc_0", "acc_1", "acc_2"]),
        ("'imu_*'", &["gyro_0", "gyro_1", "gyro_2", "touch"]),
        // The touch sensor has the name of the accelerometer's first value.
        ("[acc, acc_0]", &["0", "1", "2", "3"]),
    ] {
        let text = format!(
            "model: own.xml\nstep_rate_hz: 500\nmodalities: {{com: {{sensor: {sensors}}}}}\n\
             action: {{actuators: {{m: {{range: [-1, 1]}}}}}}\n"
        );
        fs::write(&path, text).unwrap();
        let scene = Scene::new(World::load(&path).unwrap()).unwrap();
        let elements = scene.layout()[Modality::new("com").unwrap()].elements().iter();
        let names: Vec<&str> = elements.map(|element| element.name.as_str()).collect();
        assert_eq!(names, expected, "{sensors}");
    }
}

#[test]
fn the_order_of_actuators_and_regions_decides_the_dataset() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("own.xml"), EMPTY_XML).unwrap();
    let path = folder.path().join("own.yaml");
    let name = |text: &str| {
        fs::write(&path, text.replace("model: empty.xml", "model: own.xml")).unwrap();
        let scene = Scene::new(World::load(&path).unwrap()).unwrap();
        let spec = scene.world().simulation();
        dataset_of(Path::new("datasets"), &scene, &spec).name().to_owned()
    };
    let swapped = |first: &str, second: &str| {
        let line =
            |key: &str| EMPTY.lines().find(|line| line.trim_start().starts_with(key)).unwrap().to_owned();
        let (first, second) = (line(first), line(second));
        EMPTY.replace(&first, "FIRST").replace(&second, &first).replace("FIRST", &second)
    };
    let own = name(EMPTY);
    assert_eq!(name(&EMPTY.replace("The finger, the arm", "The arm, the finger")), own);
    assert_ne!(name(&swapped("lift: {", "extension: {actuator")), own);
    assert_ne!(name(&swapped("arm: {red", "finger: {red")), own);
    let segmented = |classes: &str| {
        let parts = format!("  parts: {{segmentation: external, size: [64, 64], classes: {{{classes}}}}}\n");
        name(&EMPTY.replace("\naction:", &format!("{parts}\naction:")))
    };
    assert_ne!(segmented("arm: arm_*, rest: ground"), segmented("rest: ground, arm: arm_*"));
}

#[test]
fn a_first_world_file_can_be_used_for_any_model() {
    let folder = tempfile::tempdir().unwrap();
    let model =
        HAND.replace("<sensor><force name=\"u\" site=\"s\"/><touch name=\"u_0\" site=\"s\"/></sensor>", "");
    for name in ["hand.xml", "Hand-2.xml", "empty.xml"] {
        fs::write(folder.path().join(name), &model).unwrap();
    }
    let path = |name: &str| folder.path().join(name).display().to_string();
    succeed(folder.path(), &["world", "new", &path("hand.xml")]);
    let said = succeed(folder.path(), &["world", "check", &path("hand.yaml")]);
    let text = fs::read_to_string(folder.path().join("hand.yaml")).unwrap();
    assert!(said.contains("3 values: m, actuator_1, actuator_2"), "{said}");
    // The limits of the servo's joint, a duration of whole samples, and the name of a joint that looks like a pattern.
    assert!(
        text.contains("[-0.3, 0.3]") && text.contains("seconds: 0.99\n") && said.contains("x_0_ (m)"),
        "{text}{said}"
    );
    for (name, other) in [("Hand-2.xml", "hand_2.yaml"), ("empty.xml", "my_empty.yaml")] {
        let refused = finish(&mut harness(folder.path(), &["world", "new", &path(name)]));
        let expected = format!("--output {}", path(other));
        assert!(refused.code == 2 && refused.stderr.contains(&expected), "{}", refused.stderr);
    }
    succeed(folder.path(), &["world", "new", &path("Hand-2.xml"), "--output", &path("second.yaml")]);
    succeed(folder.path(), &["world", "check", &path("second.yaml")]);
}

#[test]
fn a_first_world_file_says_what_it_leaves_out_and_guesses() {
    let folder = tempfile::tempdir().unwrap();
    let sensors = "<sensor><force name=\"u\" site=\"s\"/><touch name=\"u_0\" site=\"s\"/></sensor>";
    fs::write(folder.path().join("hand.xml"), HAND.replace(sensors, "")).unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    succeed(folder.path(), &["world", "new", &path("hand.xml")]);
    let text = fs::read_to_string(folder.path().join("hand.yaml")).unwrap();
    for expected in [
        "several values: the ball joint of body 'thumb', the free joint of body 'b1', the free joint of body 'b2'.\n",
        "\n  #other_joints: {joint_positions: [\"x0\"]}\n",
        "\n  #other_joint_velocities: {joint_velocities: [\"x0\"]}\n",
        "\n  #body_positions: {body_positions: [\"b1\", \"b2\"]}\n",
        "\n  #body_orientations: {body_orientations: [\"thumb\", \"b1\", \"b2\"]}\n",
        "\n  links: {body_positions: [\"thumb\"]}\n",
        "\n  contact_force: {normal_force: [\"g1\", \"g2\", \"g3\"]}\n",
        "\n  #other_contact_force: {normal_force: [\"b1\", \"b2\"]}\n",
        "{actuator: \"m\", range: [-0.3, 0.3]}\n",
        "{actuator: \"M\", range: [-1.0, 1.0]}   # a guess: the model sets no ctrlrange for this actuator\n",
    ] {
        assert!(text.contains(expected), "{expected}{text}");
    }
    let check = || succeed(folder.path(), &["world", "check", &path("hand.yaml")]);
    let unrecorded = [
        "note: no modality records the free joint of body 'b1', the free joint of body 'b2'; body_positions and \
         body_orientations can",
        "note: no modality records the forces on the geoms 'b1', 'b2'",
    ];
    let said = check();
    assert!(unrecorded.iter().all(|note| said.contains(note)), "{said}");
    let guess = "note: the model sets no ctrlrange for the actuator of 'actuator_2', so only the world file limits it: \
                 [-1, 1]";
    assert!(said.contains(guess) && !said.contains("the actuator of 'm'"), "{said}");
    let used = |line: &str| match line.strip_prefix("  #") {
        Some(entry) if !entry.starts_with(' ') => format!("  {entry}\n"),
        _ => format!("{line}\n"),
    };
    fs::write(folder.path().join("hand.yaml"), text.lines().map(used).collect::<String>()).unwrap();
    let said = check();
    assert!(
        said.contains("12 values: thumb_w")
            && said.contains("4 values: x0_qw (1)")
            && said.contains("2 values: b1 (N), b2 (N)"),
        "{said}"
    );
    assert!(!unrecorded.iter().any(|note| said.contains(note)), "{said}");
}

#[test]
fn a_check_of_many_values_is_short() {
    let folder = tempfile::tempdir().unwrap();
    let grid = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/touch_grid.xml");
    fs::copy(grid, folder.path().join("grid.xml")).unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    succeed(folder.path(), &["world", "new", &path("grid.xml")]);
    let check =
        |option: &[&str]| succeed(folder.path(), &[&["world", "check", &path("grid.yaml")], option].concat());
    // 7 x 7 taxels with three values each.
    let (short, all) = (check(&[]), check(&["--all"]));
    assert!(short.contains("147 values: ") && short.contains("(147 names; --all prints them)"), "{short}");
    assert!(!all.contains("--all") && all.len() > short.len() + 1000, "{all}");
}

#[test]
fn a_check_notes_hidden_geoms_slow_rendering_and_rk4() {
    let folder = tempfile::tempdir().unwrap();
    let model = r#"<mujoco><option integrator="RK4"/><visual></visual><worldbody><light pos="0 0 3"/>
      <geom name="floor" type="plane" size="2 2 .1"/>
      <body name="head" pos="0 0 .5"><joint name="neck" axis="0 0 1"/><geom name="skull" size=".1"/>
        <camera name="eye" xyaxes="0 -1 0 0 0 1"/></body>
      </worldbody><actuator><position name="neck" joint="neck" ctrlrange="-1 1"/></actuator></mujoco>"#;
    let (file, path) =
        (folder.path().join("head.xml"), folder.path().join("head.yaml").display().to_string());
    fs::write(&file, model).unwrap();
    succeed(folder.path(), &["world", "new", file.to_str().unwrap()]);
    let said = succeed(folder.path(), &["world", "check", &path]);
    let quality = "<visual><quality shadowsize=\"0\" offsamples=\"0\"/></visual>";
    for expected in [
        "note: the model's integrator is RK4",
        "note: the camera of 'eye' is inside of 'skull', or nearer than the model's near plane",
        "note: rendering a sample takes ",
        quality,
        " ms for the images of a sample",
    ] {
        assert!(said.contains(expected), "{expected}: {said}");
    }
    // The advice of the note, a camera in front of the head, and no force on what touches nothing.
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replacen("  contact_force: {normal_force: [\"skull\"]}\n", "", 1)).unwrap();
    let tuned = model.replace("<visual></visual>", quality).replace(" integrator=\"RK4\"", "");
    fs::write(&file, tuned.replace("name=\"eye\"", "name=\"eye\" pos=\"0.2 0 0\"")).unwrap();
    let said = succeed(folder.path(), &["world", "check", &path]);
    // The servo is weak, which is another matter.
    let (listed, _) = said.split_once("\nFitness for learning").unwrap();
    assert!(listed.contains(" ms for the images of a sample") && !listed.contains("note: "), "{said}");
}

#[test]
fn a_check_finds_a_divergence_after_everything_has_moved() {
    let folder = tempfile::tempdir().unwrap();
    // The actuator pushes along the velocity, which grows by e in a third of a second.
    let model = r#"<mujoco><worldbody><body><joint name="j" type="slide"/><geom name="g" size=".1" mass="1"/></body>
      </worldbody><actuator><general name="a" joint="j" biastype="affine" biasprm="0 0 3" ctrlrange="-1 1"/></actuator>
      </mujoco>"#;
    let file = folder.path().join("grows.xml").display().to_string();
    fs::write(&file, model).unwrap();
    succeed(folder.path(), &["world", "new", &file]);
    let said = succeed(folder.path(), &["world", "check", &file.replace(".xml", ".yaml")]);
    assert!(
        said.contains("note: recording fails: episode 0 of ") && said.contains("a smaller range or"),
        "{said}"
    );
}

#[test]
fn a_motion_changes_the_episodes_and_the_dataset_alone() {
    let load = |motion: &str| {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("own.xml"), EMPTY_XML).unwrap();
        let text = EMPTY.replacen("model: empty.xml", "model: own.xml", 1);
        let path = folder.path().join("own.yaml");
        fs::write(&path, text.replacen("  seconds: 1\n", &format!("  seconds: 1\n{motion}"), 1)).unwrap();
        let world = World::load(&path).unwrap();
        let (identity, simulation) = (world.identity().to_string(), world.simulation());
        let states =
            replay(&Scene::new(world).unwrap(), &Simulation { actuations_per_episode: 2, ..simulation }, 0);
        (identity, states.unwrap())
    };
    let (identity, states) = load("");
    // The default is not written, so that older datasets keep their names.
    assert!(!identity.contains("motion"), "{identity}");
    assert!(load("  motion: random_setpoints\n") == (identity.clone(), states.clone()));
    let (walk, sinusoids) = (load("  motion: random_walk\n"), load("  motion: sinusoids\n"));
    assert!(walk.0 != identity && sinusoids.0 != identity && walk.0 != sinusoids.0);
    assert_eq!((&walk.1[0], &sinusoids.1[0]), (&states[0], &states[0]), "each starts at rest");
    assert!(walk.1[15] != states[15] && sinusoids.1[15] != states[15] && walk.1[15] != sinusoids.1[15]);
    assert!(
        load("  motion: sinusoids\n").1 == sinusoids.1,
        "a motion is drawn from the episode's own stream"
    );
    let said = fault("  seconds: 1\n", "  seconds: 1\n  motion: jumps\n");
    assert!(said.contains("random_setpoints") && said.contains("sinusoids"), "{said}");
}

/// A pendulum with two cameras, of which one has no name and a slash is in the name of the other.
const TWO_CAMERAS: &str = r#"<mujoco><visual><quality shadowsize="0" offsamples="0"/></visual><worldbody>
  <light pos="0 -1 2"/><geom name="floor" type="plane" size="2 2 .1" rgba=".8 .8 .7 1"/>
  <camera name="rig/side" pos="0 -1.5 .5" xyaxes="1 0 0 0 0 1"/><camera pos="0 0 3"/>
  <body name="bob" pos="0 0 .5"><joint name="swing" axis="0 1 0"/><geom name="rod" size=".1" rgba=".9 .2 .1 1"/></body>
  </worldbody><actuator><motor name="push" joint="swing" ctrlrange="-1 1"/></actuator></mujoco>"#;

#[test]
fn a_check_writes_a_picture_of_each_camera() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    fs::write(path("two.xml"), TWO_CAMERAS).unwrap();
    succeed(folder.path(), &["world", "new", &path("two.xml")]);
    let said = succeed(folder.path(), &["world", "check", &path("two.yaml"), "--render", &path("seen")]);
    let mut written = Vec::new();
    for (name, size) in [
        ("camera_rig_side", (640, 480)),
        ("camera_camera_1", (640, 480)),
        ("as_seen_rig_side", (64, 64)),
        ("as_seen_camera_1", (64, 64)),
    ] {
        let file = path(&format!("seen/{name}.png"));
        assert!(said.contains(&file), "{file}: {said}");
        let picture = image::open(&file).unwrap().into_rgb8();
        assert_eq!(picture.dimensions(), size, "{name}");
        written.push(picture);
    }
    assert!(written[0] != written[1], "the cameras stand at different places");
    assert_eq!(fs::read_dir(path("seen")).unwrap().count(), 4);

    // `render` draws the same camera, and what a network gets.
    let arguments =
        ["render", &path("two.yaml"), "--camera", "rig/side", "--width", "640", "--height", "480"];
    succeed(folder.path(), &[&arguments[..], &["--output", &path("side.png")]].concat());
    assert!(image::open(path("side.png")).unwrap().into_rgb8() == written[0]);
    succeed(folder.path(), &["render", &path("two.yaml"), "--as-seen", "--output", &path("small.png")]);
    assert!(image::open(path("small.png")).unwrap().into_rgb8() == written[2]);

    // Depths and classes are drawn as they are recorded.
    let world = fs::read_to_string(path("two.yaml")).unwrap();
    let more = "  far: {depth: rig/side, size: [24, 32], range_m: [0.5, 4]}\n  \
                parts: {segmentation: rig/side, size: [24, 32], classes: {rod: rod}}\n";
    fs::write(path("two.yaml"), world.replacen("\naction:", &format!("{more}\naction:"), 1)).unwrap();
    let said = succeed(folder.path(), &["world", "check", &path("two.yaml"), "--render", &path("coded")]);
    for words in ["depth image of 24 x 32 pixels", "segmentation of 24 x 32 pixels"] {
        assert!(said.contains(words), "{said}");
    }
    let parts = image::open(path("coded/as_seen_parts.png")).unwrap().into_rgb8();
    assert!(parts.pixels().any(|pixel| pixel.0 == [255, 0, 0]) && parts.dimensions() == (32, 24));
    let arguments = ["render", &path("two.yaml"), "--as-seen", "--camera", "far"];
    succeed(folder.path(), &[&arguments[..], &["--output", &path("far.png")]].concat());
    let far = image::open(path("far.png")).unwrap().into_rgb8();
    assert!(far == image::open(path("coded/as_seen_far.png")).unwrap().into_rgb8());
    for (part, far) in parts.pixels().zip(far.pixels()) {
        assert!(part.0 == [0; 3] || far.0[2] == 255, "what belongs to a class is visible");
    }
}

#[test]
fn a_world_file_without_a_model_that_compiles_is_refused() {
    let said = fault("model: empty.xml", "model: none.xml");
    assert!(said.starts_with("own.yaml:3:8: can't read the model none.xml: "), "{said}");
}

#[test]
fn rates_that_no_experiment_can_use_are_refused_at_their_place() {
    let folder = tempfile::tempdir().unwrap();
    let results = folder.path().join("results");
    fs::write(folder.path().join("own.xml"), EMPTY_XML).unwrap();
    let path = folder.path().join("own.yaml");
    let (world, scenarios) = (path.to_str().unwrap(), format!("scenarios=[{}]", path.display()));
    for (old, new, expected, change, other, then) in [
        (
            "sample_rate_hz: 10",
            "sample_rate_hz: 7",
            "own.yaml:5:17: 7 Hz does not divide the simulation's 1000 Hz; use one that does, such as 10, 20, 50, 100, \
             or set step_rate_hz to 1001",
            "simulation.sample_rate_hz=10",
            "simulation.actuation_seconds=1",
            "own.yaml:5:17: 7 Hz does not divide",
        ),
        (
            "  seconds: 1\n",
            "  seconds: 0.05\n",
            "own.yaml:36:12: 0.05 s is not a whole number of samples at 10 Hz; use a multiple of 0.1 s",
            "simulation.actuation_seconds=1",
            "simulation.sample_rate_hz=10",
            "override 'simulation.sample_rate_hz=10': simulation.actuation_seconds: 0.05 s is not a whole number of",
        ),
    ] {
        let text = EMPTY.replacen(old, new, 1).replacen("model: empty.xml", "model: own.xml", 1);
        fs::write(&path, text).unwrap();
        for arguments in [&["world", "check", world][..], &["validate", "smoke", &scenarios]] {
            let answer = finish(&mut harness(&results, arguments));
            assert!(answer.code == 2 && answer.stderr.contains(expected), "{arguments:?}: {}", answer.stderr);
        }
        // A spec can set another rate.
        succeed(&results, &["validate", "smoke", &scenarios, change]);
        // What it does not set is still the world's.
        let answer = finish(&mut harness(&results, &["validate", "smoke", &scenarios, other]));
        assert!(answer.code == 2 && answer.stderr.contains(then), "{other}: {}", answer.stderr);
    }
}

#[test]
fn a_default_in_which_worlds_differ_is_blamed_at_the_second() {
    let folder = tempfile::tempdir().unwrap();
    let text = EMPTY.replacen("model: empty.xml", "model: own.xml", 1);
    let text = text.replacen("sample_rate_hz: 10", "sample_rate_hz: 20", 1);
    fs::write(folder.path().join("own.yaml"), text).unwrap();
    let spec = folder.path().join("spec.yaml");
    let smoke =
        fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments/smoke.yaml")).unwrap();
    let smoke = smoke.split_once("\nname:").unwrap().1;
    let smoke = smoke.replace("scenarios: [empty, cluttered]", "scenarios: [empty, own.yaml]");
    fs::write(&spec, format!("name:{smoke}")).unwrap();
    let answer = finish(&mut harness(folder.path(), &["validate", spec.to_str().unwrap()]));
    let expected = "spec.yaml:3:20: the worlds empty and own have different defaults for \
                    'simulation.sample_rate_hz'; give it a value";
    assert!(answer.code == 2 && answer.stderr.contains(expected), "{}", answer.stderr);
}

#[test]
fn a_model_is_refused_with_the_command_for_its_world_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("own.xml");
    fs::write(&path, EMPTY_XML).unwrap();
    let (model, scenarios) = (path.to_str().unwrap(), format!("scenarios=[{}]", path.display()));
    for arguments in [&["world", "check", model][..], &["run", model], &["validate", "smoke", &scenarios]] {
        let answer = finish(&mut harness(folder.path(), arguments));
        let expected = format!("{model}: is a model; `harness world new {model}` writes a world file for it");
        assert!(answer.code == 2 && answer.stderr.contains(&expected), "{arguments:?}: {}", answer.stderr);
    }
}

#[test]
fn names_of_worlds_are_those_of_files_and_no_others() {
    let folder = tempfile::tempdir().unwrap();
    let said = |name: &str| {
        let path = folder.path().join(name);
        fs::write(&path, EMPTY).unwrap();
        World::load(&path).unwrap_err().to_string()
    };
    assert!(said("cluttered.yaml").contains("the name of a built-in world"), "{}", said("cluttered.yaml"));
    assert!(said("My Robot.yaml").contains("lower-case letters"), "{}", said("My Robot.yaml"));
    let spec = |scenarios: &str| {
        let text = format!(
            "name: a\nscenarios: {scenarios}\ninput: arm\noutput: arm\nlatent: 1\nnetwork: {{preset: \
             single_to_multi}}\n"
        );
        spec::parse_spec(folder.path().join("spec.yaml").to_str().unwrap(), &text, &[], false)
    };
    fs::create_dir(folder.path().join("other")).unwrap();
    for path in ["own.yaml", "other/own.yaml"] {
        fs::write(folder.path().join(path), EMPTY).unwrap();
    }
    assert_eq!(spec("[own.yaml]").unwrap().runs()[0].scenario.name(), "own");
    let said = spec("[own.yaml, other/own.yaml]").unwrap_err().to_string();
    assert!(said.contains("spec.yaml:2:") && said.contains("two world files are called 'own'"), "{said}");
    let said = spec("[none.yaml]").unwrap_err().to_string();
    assert!(said.contains("spec.yaml:2:") && said.contains("there is no such file"), "{said}");
}

/// A pendulum whose parts are in three files. The bob is a mesh.
const PENDULUM: &str = r#"<mujoco model="pendulum">
  <include file="parts/bob.xml"/>
  <option timestep="0.01"/>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="side" pos="0 -2 1" xyaxes="1 0 0 0 0 1"/>
    <body name="rod" pos="0 0 1">
      <joint name="swing" axis="0 1 0" damping="0.1"/>
      <geom name="bob" type="mesh" mesh="bob" density="1000"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="swing" ctrlrange="-1 1"/></actuator>
  <sensor><jointvel name="speed" joint="swing"/></sensor>
</mujoco>
"#;
const BOB: &str = r#"<mujoco><asset><mesh name="bob" file="bob.obj"/></asset></mujoco>"#;
const MESH: &str = "v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nv 0 0 -0.5\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";

#[test]
fn what_a_model_includes_and_its_meshes_decide_the_dataset() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    fs::create_dir(folder.path().join("parts")).unwrap();
    write("pendulum.xml", PENDULUM);
    write("parts/bob.xml", BOB);
    write("bob.obj", MESH);
    let results = folder.path().join("results");
    let model = folder.path().join("pendulum.xml");
    succeed(&results, &["world", "new", model.to_str().unwrap()]);
    let world = folder.path().join("pendulum.yaml");
    let said = succeed(&results, &["world", "check", world.to_str().unwrap()]);
    for expected in ["joints ", "swing (rad)", "jointvel", "side_difference", "the action: 1 value: push"] {
        assert!(said.contains(expected), "{expected}: {said}");
    }
    let again = finish(&mut harness(&results, &["world", "new", model.to_str().unwrap()]));
    assert!(again.code != 0 && again.stderr.contains("exists already"), "{}", again.stderr);
    let name = || {
        let scene = Scene::new(World::load(&world).unwrap()).unwrap();
        let spec = scene.world().simulation();
        dataset_of(Path::new("datasets"), &scene, &spec).name().to_owned()
    };
    let first = name();
    assert_eq!(name(), first, "the compiled model is the same each time");
    write("bob.obj", &MESH.replace("-0.5", "-0.6"));
    let second = name();
    write("parts/bob.xml", &BOB.replace("file=", "scale=\"2 2 2\" file="));
    assert!(first != second && name() != second && name() != first);
}

#[test]
fn another_file_counts_however_its_name_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    let mesh = "<asset><mesh name=\"bob\" file = \"bob.obj\"/></asset>";
    write("pendulum.xml", &PENDULUM.replace("<include file=\"parts/bob.xml\"/>", mesh));
    write("bob.obj", MESH);
    let (results, model) = (folder.path().join("results"), folder.path().join("pendulum.xml"));
    succeed(&results, &["world", "new", model.to_str().unwrap()]);
    let sha256 = || {
        let world = World::load(&folder.path().join("pendulum.yaml")).unwrap();
        Scene::new(world).unwrap().model_sha256().to_owned()
    };
    let first = sha256();
    write("bob.obj", &MESH.replace("-0.5", "-0.6"));
    assert_ne!(sha256(), first);
}

/// Edits a file when the collection begins, to test that a runner does not read it again.
struct Editing {
    file: PathBuf,
    text: String,
    said: Mutex<Vec<String>>,
}

impl Progress for Editing {
    fn begin(&self, stage: &str, _total: u64, _unit: &str) {
        if stage.starts_with("collecting") {
            fs::write(&self.file, &self.text).unwrap();
        }
    }
    fn advance(&self, _steps: u64) {}
    fn note(&self, _text: &str) {}
    fn say(&self, text: &str) {
        self.said.lock().unwrap().push(text.to_owned());
    }
    fn end(&self) {}
}

#[test]
fn a_world_changed_during_an_experiment_is_named_without_effect() {
    let edits = [
        ("twelve.yaml", "range: [0, 1.5]", "range: [0, 1.0]"),
        ("twelve.xml", "model=\"twelve\"", "model=\"dozen\""),
    ];
    for (file, old, new) in edits {
        let folder = tempfile::tempdir().unwrap();
        for name in ["twelve.xml", "twelve.yaml"] {
            fs::copy(root().join("models").join(name), folder.path().join(name)).unwrap();
        }
        let spec_file = write_spec(folder.path(), "twelve.yaml", "[proprioception]", "[proprioception]");
        let experiment = spec::load(&spec_file, &[], false).unwrap();
        let (path, registry) = (folder.path().join(file), Registry::new(folder.path().join("results")));
        let text = fs::read_to_string(&path).unwrap();
        let editing = Editing { text: text.replacen(old, new, 1), file: path, said: Mutex::default() };
        assert_ne!(editing.text, text, "{file}");
        let provenance = provenance(1, "harness run".into());
        let runner = Runner::new(&registry, 1, &provenance, &editing);
        let plan = runner.plan(&experiment).unwrap();
        let datasets: Vec<_> = plan.iter().map(|planned| planned.folder.id().to_owned()).collect();
        let (summary, _) = runner.run(&experiment, plan).unwrap();
        assert_eq!((summary.done, summary.failed.len()), (2, 0));
        let said = editing.said.lock().unwrap().clone();
        let about: Vec<_> = said.iter().filter(|text| text.contains("has changed since")).collect();
        assert!(about.len() == 1 && about[0].contains("twelve.yaml"), "{said:?}");
        let again = runner.plan(&spec::load(&spec_file, &[], false).unwrap()).unwrap();
        let again: Vec<_> = again.iter().map(|planned| planned.folder.id().to_owned()).collect();
        assert_ne!(again, datasets, "{file}: the changed world has runs of its own");
    }
}

/// Writes the spec of a small experiment with these modalities as input and output.
fn write_spec(folder: &Path, world: &str, input: &str, output: &str) -> PathBuf {
    let path = folder.join("experiment.yaml");
    let text = format!(
        "name: strange\nscenarios: [{world}]\ninput: {input}\noutput: {output}\nlatent: [2, 4]\n\
         network: {{preset: multi_to_multi, hidden: [16], channels: [4]}}\n\
         simulation: {{episodes: 4, actuations_per_episode: 3}}\ntraining: {{epochs: 2, batch_size: 16}}\n"
    );
    fs::write(&path, text).unwrap();
    path
}

/// Runs an experiment, and reads its results with every command that can.
fn go_through(results: &Path, folder: &Path, spec: &Path, world: &Path, modality: &str) {
    let said = succeed(results, &["run", spec.to_str().unwrap()]);
    assert!(said.contains("2 done, 0 done before, 0 failed"), "{said}");
    let query = format!(
        "select scenario, metric, index, value from metrics where modality = '{modality}' and model = 'network' \
         and value is not null"
    );
    assert!(succeed(results, &["query", &query]).contains("rmse"));
    assert!(
        succeed(results, &["compare", "strange", "--metrics", "r2,rmse", "--format", "markdown"])
            .contains("latent 4")
    );
    // Only the built-in finger has twenty links.
    let described = succeed(results, &["query", "describe episodes"]);
    assert!(described.contains("time since the episode's start"), "{described}");
    assert!(!described.contains("contact_force_19"), "{described}");
    // A table of all columns has those that DESCRIBE lists, and `schema` lists them too.
    let names = succeed(results, &["query", "describe episodes", "--format", "csv"]);
    let names: Vec<&str> = names.lines().skip(1).map(|line| line.split(',').next().unwrap()).collect();
    let rows = succeed(results, &["query", "select * from episodes limit 1", "--format", "csv"]);
    assert_eq!(rows.lines().next().unwrap().split(',').collect::<Vec<_>>(), names);
    let of_folder = succeed(results, &["schema", "--tables"]);
    let of_world = succeed(results, &["schema", "--tables", "--world", world.to_str().unwrap()]);
    for (listed, whose) in [(of_folder, "the datasets in "), (of_world, world.to_str().unwrap())] {
        let (_, listed) = listed.split_once("episodes: ").unwrap();
        let (first, columns) = listed.split_once('\n').unwrap();
        let columns = columns.lines().map(|line| line.split_whitespace().next().unwrap());
        assert_eq!(columns.collect::<Vec<_>>(), names);
        assert!(first.contains(&format!("these are those of {whose}")), "{first}");
    }
    let page = folder.join("report.html");
    succeed(results, &["report", "--output", page.to_str().unwrap()]);
    assert!(fs::metadata(page).unwrap().len() > 10_000);
    let picture = folder.join("robot.png");
    let arguments = [
        "render",
        world.to_str().unwrap(),
        "--episode",
        "1",
        "--sample",
        "3",
        "--output",
        picture.to_str().unwrap(),
    ];
    succeed(results, &arguments);
    assert!(fs::metadata(picture).unwrap().len() > 1000);
    succeed(results, &["verify"]);
    assert!(succeed(results, &["run", spec.to_str().unwrap()]).contains("0 done, 2 done before"));
    let run = format!("strange/{}-z4", world.file_stem().unwrap().to_str().unwrap());
    assert!(succeed(results, &["show", &run, "--all"]).contains("prediction in all"));
}

#[test]
fn a_finger_of_12_links_and_2_cameras_works_in_every_command() {
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("worlds_twelve"));
    for name in ["twelve.xml", "twelve.yaml"] {
        fs::copy(root().join("models").join(name), folder.path().join(name)).unwrap();
    }
    let world = folder.path().join("twelve.yaml");
    let layout = Scene::new(World::load(&world).unwrap()).unwrap().layout().clone();
    assert_eq!(layout[Modality::PROPRIOCEPTION].width(), 12);
    assert_eq!(layout.stored_images().count(), 2);
    let spec = write_spec(
        folder.path(),
        "twelve.yaml",
        "[proprioception, vision, wrist]",
        "[proprioception, contact_force, frame_difference]",
    );
    go_through(&results, folder.path(), &spec, &world, "contact_force");
}

#[test]
fn dm_controls_own_finger_goes_through_every_command() {
    let site = fs::read_dir(root().join(".venv/lib")).unwrap().next().unwrap().unwrap().path();
    let model = site.join("site-packages/dm_control/suite/finger.xml");
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("worlds_dm_control"));
    let world = folder.path().join("suite_finger.yaml");
    succeed(&results, &["world", "new", model.to_str().unwrap(), "--output", world.to_str().unwrap()]);
    let said = succeed(&results, &["world", "check", world.to_str().unwrap()]);
    assert!(said.contains("2 values: touchtop (N), touchbottom (N)"), "{said}");
    let spec =
        write_spec(folder.path(), "suite_finger.yaml", "[joints, touch, cam0]", "[joint_velocities, touch]");
    go_through(&results, folder.path(), &spec, &world, "touch");
}

/// A modality that no Rust file mentions is added to a copy of a world. It is recorded and learned.
#[test]
fn a_modality_is_added_without_compiling_anything() {
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("worlds_modality"));
    fs::write(folder.path().join("own.xml"), EMPTY_XML).unwrap();
    let more = "modalities:\n  finger_speed:\n    joint_velocities: finger_joint_0[0-4]\n  bend:\n    difference_of: \
                proprioception\n";
    let text = EMPTY.replace("model: empty.xml", "model: own.xml").replacen("modalities:\n", more, 1);
    // A modality that is the difference of another must come after it.
    let text = text.replacen("  bend:\n    difference_of: proprioception\n", "", 1).replacen(
        "  vision:\n",
        "  bend:\n    difference_of: proprioception\n  vision:\n",
        1,
    );
    fs::write(folder.path().join("own.yaml"), text).unwrap();
    let spec = write_spec(folder.path(), "own.yaml", "[finger_speed, bend]", "[finger_speed, bend]");
    let said = succeed(&results, &["run", spec.to_str().unwrap(), "latent=2"]);
    assert!(said.contains("1 done"), "{said}");
    let rows = succeed(
        &results,
        &[
            "query",
            "select modality, unit from metrics where metric = 'rmse' and index = 4 and model = 'persistence'",
        ],
    );
    succeed(&results, &["collect", "experiments/smoke.yaml", "scenarios=empty"]);
    let sql = "select scenario, count(arm_lift) as lifts, count(finger_speed_4) as speeds from episodes \
        group by scenario order by scenario";
    let expected = [
        serde_json::json!({ "scenario": "empty", "lifts": 120, "speeds": 0 }),
        serde_json::json!({ "scenario": "own", "lifts": 120, "speeds": 120 }),
    ];
    assert_eq!(crate::common::ask(&results, sql), expected);
    assert!(rows.contains("finger_speed") && rows.contains("rad/s") && rows.contains("bend"), "{rows}");
}

#[test]
fn a_spec_turns_factors_on_and_queries_see_what_was_drawn() {
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("worlds_factors"));
    for name in ["twelve.xml", "twelve.yaml"] {
        fs::copy(root().join("models").join(name), folder.path().join(name)).unwrap();
    }
    let spec = write_spec(folder.path(), "twelve.yaml", "[proprioception]", "[contact_force]");
    let vary = "vary={simulation.factors: [[], [finger_stiffness, light]]}";
    let said = succeed(&results, &["run", spec.to_str().unwrap(), "latent=2", vary]);
    assert!(said.contains("2 done"), "{said}");
    let sql = "select count(distinct dataset) as datasets, count(distinct factors_finger_stiffness) as drawn, \
        min(factors_light) as light from episodes group by factors_light is null order by drawn";
    let answer = folder.path().join("answer.json");
    succeed(&results, &["query", sql, "--output", answer.to_str().unwrap()]);
    let rows: serde_json::Value = serde_json::from_slice(&fs::read(answer).unwrap()).unwrap();
    let of = |row: usize, column: &str| rows[row][column].as_f64();
    assert_eq!([of(0, "drawn"), of(1, "drawn")], [Some(0.0), Some(4.0)], "{rows}");
    assert!(of(0, "light").is_none() && of(1, "light").is_some_and(|light| (0.5..=1.2).contains(&light)));
    succeed(&results, &["verify"]);
    let runs = succeed(&results, &["query", "select variant from runs order by variant"]);
    assert!(runs.contains("factors=finger_stiffness+light"), "{runs}");

    let world = folder.path().join("twelve.yaml");
    let said = succeed(&results, &["world", "check", world.to_str().unwrap()]);
    let expected = "joint_stiffness, log-uniform from 0.5 to 2: finger_stiffness";
    assert!(said.contains(expected), "{said}");
    let refused = |setting: &str| {
        let answer = finish(&mut harness(&results, &["validate", spec.to_str().unwrap(), setting]));
        assert_eq!((answer.code, answer.stderr.lines().count()), (2, 1), "{}", answer.stderr);
        answer.stderr
    };
    let unknown = refused("simulation.factors=finger_stifness");
    let expected =
        "unknown factor 'finger_stifness' in 'simulation.factors'; did you mean 'finger_stiffness'?";
    assert!(unknown.contains(expected) && unknown.contains("finger_mass"), "{unknown}");
    let said = refused("simulation.factors=[light, light]");
    assert!(said.contains("is in 'simulation.factors' twice"), "{said}");
    // In the spec itself, with its place.
    let text = fs::read_to_string(&spec).unwrap();
    fs::write(&spec, text.replace("episodes: 4,", "episodes: 4, factors: [box_mass],")).unwrap();
    let said = refused("latent=2");
    assert!(said.contains("experiment.yaml:7:37: unknown factor 'box_mass'"), "{said}");
}

#[test]
fn images_unfit_for_a_network_are_refused_with_their_place() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("own.xml"), EMPTY_XML).unwrap();
    let said = |size: &str| {
        let text = EMPTY.replace("model: empty.xml", "model: own.xml").replace("size: [64, 64]", size);
        fs::write(folder.path().join("own.yaml"), text).unwrap();
        let spec = write_spec(folder.path(), "own.yaml", "[arm, vision]", "[arm]");
        spec::load(&spec, &[], false).map(|_| ()).map_err(|error| error.to_string())
    };
    assert_eq!(said("size: [20, 20]"), Ok(()));
    let odd = said("size: [21, 21]").unwrap_err();
    assert!(odd.contains("experiment.yaml:3:14: 'vision' has a side of 21 pixels, which is odd"), "{odd}");
    assert_eq!(said("size: [48, 64]"), Ok(()));
    let odd = said("size: [48, 21]").unwrap_err();
    assert!(odd.contains("experiment.yaml:3:14: 'vision' has a side of 21 pixels, which is odd"), "{odd}");
}

#[test]
fn a_network_takes_and_predicts_images_that_are_no_squares() {
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("worlds_rectangular"));
    fs::write(folder.path().join("own.xml"), EMPTY_XML).unwrap();
    let text =
        EMPTY.replace("model: empty.xml", "model: own.xml").replace("size: [64, 64]", "size: [64, 96]");
    fs::write(folder.path().join("own.yaml"), text).unwrap();
    let spec = write_spec(folder.path(), "own.yaml", "[arm, vision]", "[arm, frame_difference]");
    let settings =
        ["latent=2", "network.channels=[4,4]", "network.average=2", "tasks=[prediction,reconstruction]"];
    let said = succeed(&results, &[&["run", spec.to_str().unwrap()][..], &settings].concat());
    assert!(said.contains("1 done, 0 done before, 0 failed"), "{said}");
    let sql = "select count(*) as errors, min(value) as least from metrics where model = 'network' \
        and modality = 'frame_difference' and metric = 'rmse'";
    let answer = folder.path().join("answer.json");
    succeed(&results, &["query", sql, "--output", answer.to_str().unwrap()]);
    let rows: serde_json::Value = serde_json::from_slice(&fs::read(&answer).unwrap()).unwrap();
    assert!(rows[0]["errors"] == 1 && rows[0]["least"].as_f64().unwrap() > 0.0, "{rows}");
    // The first convolution sees 32 x 48 averaged pixels.
    let layers = succeed(&results, &["show", "strange/own-z2", "--all"]);
    assert!(layers.contains("4 x 16 x 24") && layers.contains("4 x 8 x 12"), "{layers}");
    let page = folder.path().join("report.html");
    succeed(&results, &["report", "--output", page.to_str().unwrap()]);
}

/// Regions are found by color, so they are those of the camera, wherever the optical flow stands. A segmentation of the
/// same parts gives the same errors, because the colors of this world's parts tell them as well.
#[test]
fn regions_and_motion_are_found_in_the_images_of_cameras() {
    let flow = "  flow:\n    optical_flow: external\n    size: [64, 64]\n";
    let change = "  flow_change:\n    difference_of: flow\n";
    let own = EMPTY.replace("model: empty.xml", "model: own.xml");
    let first = own.replacen("modalities:\n", &format!("modalities:\n{flow}{change}"), 1);
    let last = own.replacen("\naction:", &format!("\n{flow}{change}action:"), 1);
    let parts = "  parts:\n    segmentation: external\n    size: [64, 64]\n    \
                 classes: {arm: arm_*, finger: finger_link_*}\n";
    let (uncolored, _) = first.split_once("\nregions:").unwrap();
    let segmented = uncolored.replacen("\naction:", &format!("\n{parts}\naction:"), 1) + "\n";
    let worlds = [("flow_first", first.clone()), ("flow_last", last), ("parts", segmented)];
    let answers = worlds.map(|(name, world)| {
        let (folder, results) = (tempfile::tempdir().unwrap(), fresh(&format!("worlds_{name}")));
        fs::write(folder.path().join("own.xml"), EMPTY_XML).unwrap();
        fs::write(folder.path().join("own.yaml"), world).unwrap();
        let spec = write_spec(folder.path(), "own.yaml", "arm", "[frame_difference, flow_change]");
        let said = succeed(&results, &["run", spec.to_str().unwrap(), "latent=2", "tasks=prediction"]);
        assert!(said.contains("1 done"), "{said}");
        let sql = |sql: &str| {
            let answer = folder.path().join("answer.json");
            succeed(&results, &["query", sql, "--output", answer.to_str().unwrap()]);
            fs::read_to_string(answer).unwrap()
        };
        let regions = sql("select metric, value from metrics where modality = 'flow_change' and metric like \
                           'relative_error_%'");
        assert_eq!(regions.trim(), "[]");
        [
            sql("select metric, value from metrics where modality = 'frame_difference' order by metric, model"),
            sql("select modality, episode, sample, motion from frames order by modality, episode, sample"),
        ]
    });
    assert!(answers[0][0].contains("relative_error_finger"), "{}", answers[0][0]);
    assert_eq!(answers[0], answers[1]);
    assert_eq!(answers[0], answers[2]);
}

/// The sizes of the finger's modalities are defined by its models alone: 20 joints and links, 3 elements of the action,
/// 64 pixels.
#[test]
fn no_size_of_the_finger_stands_in_the_program() {
    const NAMES: [&str; 5] = ["JOINTS", "ARM_JOINTS", "FRAME_SIDE", "FRAME_LEN", "FRAME_SHAPE"];
    const SIZES: [&str; 9] =
        ["; 20]", "; 64]", "0..20", "0..64", "(20,", "(64, 64", "step_by(20)", "[64, 64", "[20]"];
    let mut folders = vec![root().join("harness"), root().join("python/src"), root().join("python/harness")];
    let (mut files, mut found) = (0, Vec::new());
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let is_source = path.extension().is_some_and(|ending| ending == "rs" || ending == "py");
            if path.is_dir() && !path.ends_with("benches") && !path.ends_with("kernels") {
                folders.push(path);
            } else if is_source {
                files += 1;
                let text = fs::read_to_string(&path).unwrap();
                // Unit tests and Python's docstrings, which have examples, are not part of the program.
                let tested = text.split("#[cfg(test)]").next().unwrap_or_default();
                let is_python = path.extension().is_some_and(|ending| ending == "py");
                let program: String = tested.split("\"\"\"").step_by(1 + usize::from(is_python)).collect();
                let code = program.lines().filter(|line| !line.trim_start().starts_with(['/', '#', '!']));
                let lines = code.filter(|line| NAMES.iter().chain(&SIZES).any(|size| line.contains(size)));
                found.extend(lines.map(|line| format!("{}: {line}", path.display())));
            }
        }
    }
    assert!(files > 100 && found.is_empty(), "{files} files: {found:#?}");
}

/// A box and a slider on the ground, seen by a camera, and things that no factor can change.
const YARD: &str = r#"<mujoco><option timestep="0.002"/><default><geom friction="0.5"/></default><worldbody>
  <light name="sun" pos="0 0 5"/><light name="dark" active="false"/>
  <camera name="eye" pos="0 0 5"/><camera name="other" pos="0 0 6"/>
  <geom name="ground" type="plane" size="5 5 1" friction="0.5"/>
  <geom name="shelf" type="box" size="0.1 0.1 0.1" pos="4 4 1"/>
  <body name="post" pos="4 0 1"><geom name="post" type="box" size="0.1 0.1 0.1" mass="1" rgba="1 1 1 1"/></body>
  <body name="slider" pos="0 0 0.099">
    <joint name="x" type="slide" axis="1 0 0" damping="1"/>
    <geom name="slider" type="box" size="0.1 0.1 0.1" mass="1" friction="0.5"/>
    <geom name="ghost" size="0.05" mass="0.1" contype="0" conaffinity="0" group="4"/></body>
  <body name="still" pos="0 3 1"><joint name="still" type="slide" axis="1 0 0" stiffness="5"/><geom size="0.1"/></body>
  <body name="box" pos="2 0 0.1"><freejoint/><geom name="box" type="box" size="0.1 0.1 0.1" friction="0.3"/></body>
</worldbody><actuator><motor name="x" joint="x"/></actuator></mujoco>"#;

/// The output of `world check` for the yard with these modalities, placement and factors.
fn check_yard(modalities: &str, placement: &str, factors: &str) -> (i32, String, String) {
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("worlds_yard"));
    fs::write(folder.path().join("yard.xml"), YARD).unwrap();
    let path = folder.path().join("yard.yaml");
    let text = format!(
        "model: yard.xml\nstep_rate_hz: 500\nmodalities: {{joints: {{joint_positions: [x]}}{modalities}}}\n\
         action: {{actuators: {{x: {{range: [-20, 20]}}}}}}\nplacement: {{{placement}}}\nfactors:\n  {factors}\n"
    );
    fs::write(&path, text).unwrap();
    let said = finish(&mut harness(&results, &["world", "check", path.to_str().unwrap()]));
    let stderr = said.stderr.replace(&format!("{}/", folder.path().display()), "");
    (said.code, said.stdout, stderr)
}

const EYE: &str = ", vision: {camera: eye, size: [16, 16]}";

#[test]
fn world_check_warns_about_factors_that_change_nothing() {
    for (modalities, factor, expected) in [
        (
            EYE,
            "f: {geom_friction: shelf, scale_by: {choice: [0.5, 2]}}",
            "changed nothing in 40 s of simulation with the value 0.5 or 2",
        ),
        (
            EYE,
            "f: {geom_friction: ghost, scale_by: {choice: [0.5, 2]}}",
            "changes nothing for 'ghost', because nothing can touch it",
        ),
        (
            EYE,
            "f: {body_mass: post, scale_by: {choice: [0.5, 2]}}",
            "changes nothing for 'post', because the model can't move it",
        ),
        (
            EYE,
            "f: {body_mass: slider, scale_by: {choice: 1}}",
            "changes nothing for 'slider': no value that is drawn changes the model",
        ),
        (EYE, "f: {joint_stiffness: still, scale_by: {choice: [0.5, 2]}}", "changed nothing in 40 s"),
        (
            EYE,
            "f: {geom_size: ghost, scale_by: {choice: [0.5, 2]}}",
            "because no camera sees it and nothing can touch it",
        ),
        (EYE, "f: {geom_colour: ghost, offset_by: {choice: 0.5}}", "because no camera sees it"),
        ("", "f: {geom_colour: box, offset_by: {choice: 0.5}}", "because no camera sees it"),
        (
            EYE,
            "f: {geom_colour: post, offset_by: {uniform: [0, 0.5]}}",
            "'post': no value that is drawn changes the model",
        ),
        (EYE, "f: {light_brightness: dark, scale_by: {choice: 2}}", "because it is off"),
        ("", "f: {light_brightness: sun, scale_by: {choice: 2}}", "because no image is recorded"),
        (EYE, "f: {camera_position: other, offset_by: {choice: 1}}", "because no modality records its image"),
        (
            EYE,
            "f: {geom_friction: box, scale_by: {choice: [0.5, 2]}}",
            "also changes the contacts of 'box' and 'ground': while it is on, they have the friction of 'box' alone",
        ),
    ] {
        let (code, _, warned) = check_yard(modalities, "", factor);
        assert_eq!(code, 0, "{warned}");
        assert!(
            warned.lines().any(|line| line.starts_with("warning: yard.yaml:7:") && line.contains(expected)),
            "{factor}: {warned}"
        );
        assert!(warned.contains(": the factor 'f' "), "{warned}");
    }
    for factor in [
        "f: {geom_friction: slider, scale_by: {uniform: [0.5, 1.5]}}",
        "f: {body_mass: slider, scale_by: {uniform: [0.5, 1.5]}}",
        "f: {joint_damping: x, scale_by: {uniform: [0.5, 1.5]}}",
        "f: {geom_size: box, scale_by: {uniform: [0.5, 1.5]}}",
        "f: {geom_colour: box, offset_by: {uniform: [0, 0.5]}}",
        "f: {light_brightness: sun, scale_by: {choice: 2}}",
        "f: {camera_position: eye, offset_by: {choice: 1}}",
    ] {
        assert_eq!(check_yard(EYE, "", factor).2, "", "{factor}");
    }
}

#[test]
fn every_factor_of_a_built_in_world_has_an_effect() {
    let results = fresh("worlds_built_in_factors");
    for world in World::built_in() {
        let said = finish(&mut harness(&results, &["world", "check", world.scenario().name()]));
        assert_eq!(said.code, 0, "{}", said.stderr);
        // The column that carries the arm has MuJoCo's default friction of 1, and the boxes have 0.5.
        let of_column = |line: &str| line.contains("the contacts of 'box_0' and 'arm_column'");
        let others: Vec<&str> = said.stderr.lines().filter(|line| !of_column(line)).collect();
        assert_eq!(others, [""; 0], "{}", world.scenario());
    }
}

#[test]
fn world_check_refuses_bodies_that_would_start_inside_others() {
    let placement = "box: {bodies: box, clearance_m: 0, rectangle: [[-1, 1], [-0.1, 0.1]]}";
    let (code, _, said) = check_yard("", placement, "f: {body_mass: slider, scale_by: {choice: 2}}");
    assert_eq!((code, said.lines().count()), (2, 1), "{said}");
    assert!(said.contains("yard.yaml:5:") && said.contains("overlap of 'slider' and 'box' by 0."), "{said}");
    let away = placement.replace("[-1, 1]", "[2, 3]");
    assert_eq!(check_yard("", &away, "f: {body_mass: slider, scale_by: {choice: 2}}").0, 0);
}

#[test]
fn a_swept_sector_ends_at_the_axis_of_the_arm() {
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("worlds_sector"));
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    for (name, from, to) in [
        ("cluttered.xml", "ctrlrange=\"0 1.5\"", "ctrlrange=\"-1.5 0\""),
        ("cluttered.yaml", "range: [0, 1.5], start: low", "range: [-1.5, 0], start: high"),
    ] {
        let text = fs::read_to_string(models.join(name)).unwrap();
        assert!(text.contains(from), "{name}");
        fs::write(folder.path().join(name.replace("cluttered.yaml", "back.yaml")), text.replace(from, to))
            .unwrap();
    }
    let path = folder.path().join("back.yaml");
    let answer = finish(&mut harness(&results, &["world", "check", path.to_str().unwrap()]));
    let said = "[-1.5, 0] must be at least -";
    assert!(answer.code == 2 && answer.stderr.contains(said), "{}", answer.stderr);
}

#[test]
fn factors_cannot_share_a_column_with_factors_or_modalities() {
    let each = "mass: {body_mass: ['slider', 'box'], scale_by: {choice: 2}, each: true}";
    let slider = "mass_slider: {geom_friction: slider, scale_by: {choice: 2}}";
    let image = ", factors_mass: {camera: eye, size: [8, 8]}";
    for (modalities, factors, place, expected) in [
        (
            "",
            format!("{each}\n  {slider}"),
            "yard.yaml:8:",
            "the factor 'mass_slider' and the factor 'mass' would both have the column 'factors_mass_slider'",
        ),
        (
            image,
            "mass: {body_mass: slider, scale_by: {choice: 2}}".into(),
            "yard.yaml:7:",
            "the factor 'mass' and the modality 'factors_mass' would both have the column 'factors_mass'",
        ),
        (
            ", factors_mass: {joint_positions: [x]}",
            "mass_x: {body_mass: slider, scale_by: {choice: 2}}".into(),
            "yard.yaml:7:",
            "the modality 'factors_mass' would both have the column 'factors_mass_x'",
        ),
        (
            ", setpoint_x: {camera: eye, size: [8, 8]}",
            "mass: {body_mass: slider, scale_by: {choice: 2}}".into(),
            "yard.yaml:3:",
            "'setpoint_x' and the action would both have the column 'setpoint_x'",
        ),
    ] {
        let (code, _, said) = check_yard(modalities, "", &factors);
        assert_eq!((code, said.lines().count()), (2, 1), "{said}");
        assert!(said.contains(place) && said.contains(expected) && said.contains("rename one"), "{said}");
    }
    assert_eq!(check_yard("", "", each).0, 0);
}

/// A gantry: two slides and a hinge.
const GANTRY: &str = r#"<mujoco><option timestep="0.01"/><worldbody>
  <body name="beam"><joint name="beam" type="slide" axis="1 0 0" damping="5"/>
    <geom type="box" size="0.1 1 0.1" mass="1"/>
  <body name="cart"><joint name="cart" type="slide" axis="0 1 0" damping="5"/>
    <geom type="box" size="0.1 0.1 0.1" mass="1"/>
  <body name="gripper"><joint name="gripper" type="hinge" axis="0 0 1" damping="1"/>
    <geom type="box" size="0.2 0.05 0.05" mass="0.5"/></body></body></body>
</worldbody><actuator>
  <position name="beam" joint="beam" kp="50" ctrlrange="-1 1"/>
  <position name="cart" joint="cart" kp="50" ctrlrange="-1 1"/>
  <position name="gripper" joint="gripper" kp="10" ctrlrange="-2 2"/>
</actuator></mujoco>"#;

#[test]
fn a_robot_with_slides_and_hinges_is_judged_by_unit() {
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("worlds_gantry"));
    let model = folder.path().join("gantry.xml");
    fs::write(&model, GANTRY).unwrap();
    succeed(&results, &["world", "new", model.to_str().unwrap()]);
    let said = succeed(&results, &["world", "check", model.with_extension("yaml").to_str().unwrap()]);
    assert!(said.contains("the elements of 'joints' have the units m, rad, so its metrics"), "{said}");
    let spec = write_spec(folder.path(), "gantry.yaml", "[joint_velocities]", "[joints]");
    let said = succeed(&results, &["run", spec.to_str().unwrap(), "latent=2"]);
    let note = "a modality whose elements have different units is judged by unit";
    let has =
        |text: &str, words: &[&str]| text.lines().any(|line| words.iter().all(|word| line.contains(word)));
    for unit in ["in m ", "in rad "] {
        assert!(has(&said, &["joints", unit]), "{said}");
    }
    assert!(said.contains(note), "{said}");
    let line = said.lines().find(|line| line.contains("beats ")).unwrap_or_default();
    assert!(line.contains("persistence in ") && line.contains(" of 2"), "{said}");

    let said = succeed(&results, &["compare", "--metrics", "r2,rmse"]);
    for (unit, sign) in [("m", "(m)"), ("rad", "(rad)")] {
        let joints = format!("joints in {unit}");
        assert!(has(&said, &[&joints, "R2"]) && has(&said, &[&joints, "RMSE", sign]), "{said}");
    }
    assert!(said.contains(note), "{said}");

    let plot = |more: &[&str]| {
        let output = folder.path().join("plot.csv");
        let args = ["plot", "--x", "latent", "--metrics", "rmse", "--output", output.to_str().unwrap()];
        let answer = finish(&mut harness(&results, &[&args[..], more].concat()));
        (answer.code, answer.stderr, fs::read_to_string(output).unwrap_or_default())
    };
    let (code, said, _) = plot(&[]);
    assert_eq!(code, 2, "{said}");
    assert!(said.contains("the means differ in modality: joints in m; joints in rad"), "{said}");
    let (code, said, means) = plot(&["--facet", "modality"]);
    assert_eq!((code, means.lines().count()), (0, 3), "{said}{means}");
    let (code, said, means) = plot(&["--of", "joints in rad"]);
    assert_eq!((code, means.lines().count()), (0, 2), "{said}{means}");
    assert!(means.contains("in rad"), "{means}");

    // The RMSE of the slides is the root of the mean of their squares, and that of the hinge is its own.
    let answer = folder.path().join("answer.json");
    let sql = "select direction, index, unit, value from metrics where metric = 'rmse' and model = 'network' \
        and task = 'prediction' order by index nulls first, direction";
    succeed(&results, &["query", sql, "--output", answer.to_str().unwrap()]);
    let rows: serde_json::Value = serde_json::from_slice(&fs::read(answer).unwrap()).unwrap();
    let value = |row: usize| rows[row]["value"].as_f64().unwrap();
    assert_eq!(rows.as_array().unwrap().len(), 5, "{rows}");
    assert_eq!([&rows[0]["direction"], &rows[1]["direction"]], ["in m", "in rad"], "{rows}");
    assert_eq!([&rows[0]["unit"], &rows[1]["unit"]], ["m", "rad"], "{rows}");
    let slides = (0.5 * (value(2).powi(2) + value(3).powi(2))).sqrt();
    assert!((value(0) - slides).abs() < 1e-9 && (value(1) - value(4)).abs() < 1e-9, "{rows}");
}

#[test]
fn a_check_says_whether_a_world_is_fit_for_learning_and_what_changes_it() {
    let folder = tempfile::tempdir().unwrap();
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    let soft = folder.path().join("twelve.yaml");
    fs::copy(models.join("twelve.yaml"), &soft).unwrap();
    let model = fs::read_to_string(models.join("twelve.xml")).unwrap();
    let model = model.replace(" forcerange=\"-60 60\"", "").replace(" solref=\"0.003 1.5\"", "");
    fs::write(soft.with_extension("xml"), model).unwrap();
    let (soft, own) = (soft.display().to_string(), models.join("twelve.yaml").display().to_string());
    let check = |more: &[&str]| succeed(folder.path(), &[&["world", "check"], more].concat());
    let said = check(&[&soft]);
    let row = |name: &str| said.lines().find(|line| line.starts_with(name)).unwrap().to_owned();
    assert!(row("penetration, 99 %, in half the thickness").contains("<= 0.067   !"), "{said}");
    assert!(said.contains("note: penetration, 99 %, in half the thickness is "), "{said}");
    assert!(
        said.contains(", above 0.22: make the contacts stiffer (a smaller first value of solref"),
        "{said}"
    );
    // A table of several worlds marks what is beyond its limit, and prints each world's limit.
    let both = check(&[&soft, &own, "cluttered", "--episodes", "1", "--format", "markdown"]);
    let line = both.lines().find(|line| line.contains("penetration, most, in half")).unwrap();
    assert!(line.contains("<= 0.22 or 0.33") && line.matches("**").count() == 2, "{both}");
    let table = folder.path().join("found.csv").display().to_string();
    assert!(check(&[&own, "--episodes", "1", "--output", &table]).starts_with("17 findings in "));
    let refused = finish(&mut harness(folder.path(), &["world", "check", &soft, "cluttered", "--all"]));
    assert!(refused.code == 2 && refused.stderr.contains("check each world alone"), "{}", refused.stderr);
}
