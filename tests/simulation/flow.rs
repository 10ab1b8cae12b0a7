//! Optical flow and poses of known motions, seen by a camera that looks straight down.

use super::{sample_of, sensed, simulate};
use harness_simulation::{Episode, LiveSimulation, Scene};
use harness_spec::{Modality, Simulation, World};

pub(super) const STAGE: &str = r#"<mujoco model="stage">
  <compiler autolimits="true"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <visual>
    <global offwidth="64" offheight="64"/>
    <quality shadowsize="0" offsamples="0"/>
  </visual>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <light name="sun" type="directional" pos="0 0 4" dir="0 0 -1" specular="0 0 0"/>
    <geom name="ground" type="plane" size="20 20 1" rgba="0.2 0.3 0.2 1"/>
    <body name="tripod" pos="0 0 4" gravcomp="1">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="pan" axis="0 0 1"/>
      <camera name="above" fovy="45"/>
    </body>
    <body name="plate" pos="0 0 1" gravcomp="1">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <joint name="turn" axis="0 0 1"/>
      <geom name="plate" type="box" size="0.3 0.3 0.05" mass="1" rgba="0.9 0.2 0.2 1"/>
      <site name="corner" pos="0.2 0 0.05"/>
    </body>
  </worldbody>
  <actuator>
    <position name="pan" joint="pan" kp="1e4" kv="200"/>
    <position name="slide" joint="slide" kp="1e4" kv="200"/>
    <position name="turn" joint="turn" kp="1e4" kv="200"/>
  </actuator>
  <sensor>
    <framepos name="place" objtype="site" objname="corner"/>
    <framequat name="turned" objtype="site" objname="corner"/>
  </sensor>
</mujoco>
"#;

const SIDE: usize = 64;
/// From the camera to the plate's upper face, m.
const DISTANCE: f64 = 4.0 - 1.05;
/// The largest displacement that the flow can encode, pixels.
const LIMIT: f64 = 8.0;
/// Half a quantization step of the encoding, and a little for rounding, pixels.
const TOLERANCE: f64 = 0.5 * LIMIT / 127.0 + 1e-4;

/// Focal length, pixels.
fn focal() -> f64 {
    0.5 * SIDE as f64 / 22.5f64.to_radians().tan()
}

/// The stage, with the ranges of the camera's angle, and of the plate's place and angle.
fn stage(pan: [f64; 2], slide: [f64; 2], turn: [f64; 2]) -> Scene {
    stage_of(STAGE, pan, slide, turn)
}

fn stage_of(xml: &str, pan: [f64; 2], slide: [f64; 2], turn: [f64; 2]) -> Scene {
    let text = format!(
        "model: stage.xml
step_rate_hz: 1000
modalities:
  joints: {{joint_positions: [pan, slide, turn]}}
  plate: {{body_positions: plate}}
  plate_orientation: {{body_orientations: plate}}
  corner: {{site_positions: corner}}
  corner_orientation: {{site_orientations: corner}}
  place: {{sensor: place, unit: m}}
  turned: {{sensor: turned}}
  vision: {{camera: above, size: [64, 64]}}
  flow: {{optical_flow: above, size: [64, 64]}}
action:
  actuators:
    pan: {{range: {pan:?}}}
    slide: {{range: {slide:?}}}
    turn: {{range: {turn:?}}}
"
    );
    let world = World::parse("stage.yaml", Some("".into()), "stage", &text).unwrap();
    Scene::from_xml(world.into(), xml, "stage.xml".into()).unwrap()
}

fn filmed(pan: [f64; 2], slide: [f64; 2], turn: [f64; 2]) -> Episode {
    let spec = Simulation { actuations_per_episode: 10, ..Simulation::default() };
    simulate(&stage(pan, slide, turn), &spec, 0)
}

fn vector(episode: &Episode, name: &str, sample: usize) -> Vec<f64> {
    let modality = Modality::new(name).unwrap();
    let width = episode.layout[modality].width();
    let values = &episode.vector(modality)[sample * width..][..width];
    values.iter().map(|value| f64::from(*value)).collect()
}

fn pixel<'e>(episode: &'e Episode, name: &str, sample: usize, [column, row]: [usize; 2]) -> &'e [u8] {
    let image = episode.image(Modality::new(name).unwrap());
    &image[((sample * SIDE + row) * SIDE + column) * 3..][..3]
}

/// What is told of a pixel: how far it came from the left and from above, pixels, and whether it was seen before.
fn flow(episode: &Episode, sample: usize, at: [usize; 2]) -> ([f64; 2], bool) {
    let [right, down, seen] = *pixel(episode, "flow", sample, at) else { unreachable!() };
    assert!(seen == 0 || seen == 255);
    ([right, down].map(|code| (f64::from(code) - 128.0) * LIMIT / 127.0), seen == 255)
}

#[track_caller]
fn assert_flow(found: [f64; 2], expected: [f64; 2]) {
    for (found, expected) in found.into_iter().zip(expected) {
        assert!((found - expected).abs() < TOLERANCE, "{found} instead of {expected} pixels");
    }
}

/// Returns the change of a joint since the sample before. Joint 0 is the camera's angle, 1 the plate's position, 2 its
/// angle.
fn change(episode: &Episode, sample: usize, joint: usize) -> f64 {
    vector(episode, "joints", sample)[joint] - vector(episode, "joints", sample - 1)[joint]
}

/// How far a place (right, up) of a picture that turned by an angle, counter-clockwise, came: right, down.
fn turned([right, up]: [f64; 2], angle: f64) -> [f64; 2] {
    let (sin, cos) = angle.sin_cos();
    let before = [cos * right + sin * up, cos * up - sin * right];
    [right - before[0], before[1] - up]
}

#[test]
fn what_slides_flows_by_its_projection_and_uncovers_what_it_hid() {
    let episode = filmed([0.0, 0.0], [-0.9, -0.3], [0.0, 0.0]);
    let column = |x: f64| 32.0 + focal() * x / DISTANCE;
    let (mut moved, mut uncovered) = (0, 0);
    for sample in 0..episode.samples {
        for at in [[0, 0], [63, 0], [63, 63]] {
            assert_eq!(flow(&episode, sample, at), ([0.0, 0.0], true), "the ground stays where it is");
        }
        if sample == 0 {
            let still = episode.image(Modality::new("flow").unwrap())[..SIDE * SIDE * 3].chunks_exact(3);
            assert!(still.into_iter().all(|pixel| pixel == [128, 128, 255]), "nothing has moved at first");
            continue;
        }
        let (x, by) = (vector(&episode, "joints", sample)[1], change(&episode, sample, 1));
        let (found, seen) = flow(&episode, sample, [column(x) as usize, 32]);
        assert_flow(found, [focal() * by / DISTANCE, 0.0]);
        assert!(seen);
        moved += usize::from(by.abs() > 0.03);
        // The ground behind its left edge, which looks away from the camera, was hidden as long as the plate was there.
        let [now, before] = [x, x - by].map(|x| column(x - 0.3));
        let first = (before - 0.4).ceil();
        if first + 0.6 < now {
            assert_eq!(flow(&episode, sample, [first as usize, 32]), ([0.0, 0.0], false), "sample {sample}");
            uncovered += 1;
        }
    }
    assert!(moved > 10 && uncovered > 5, "{moved} {uncovered}");
}

#[test]
fn what_turns_flows_around_its_middle() {
    let episode = filmed([0.0, 0.0], [-0.6, -0.6], [-1.0, 1.0]);
    let middle = [32.0 - focal() * 0.6 / DISTANCE, 32.0];
    for sample in 1..episode.samples {
        for (right, down) in [(-5, 0), (3, 4), (0, -6), (4, -3)] {
            let at = [(middle[0] + f64::from(right)) as usize, (middle[1] + f64::from(down)) as usize];
            let place = [at[0] as f64 + 0.5 - middle[0], middle[1] - at[1] as f64 - 0.5];
            let (found, seen) = flow(&episode, sample, at);
            assert_flow(found, turned(place, change(&episode, sample, 2)));
            assert!(seen);
        }
    }
}

#[test]
fn a_turning_camera_makes_all_it_sees_flow_the_other_way() {
    let episode = filmed([-0.5, 0.5], [-0.6, -0.6], [0.0, 0.0]);
    let (mut inside, mut outside) = (0, 0);
    for sample in 1..episode.samples {
        let angle = change(&episode, sample, 0);
        for at in (0..SIDE * SIDE).map(|place| [place % SIDE, place / SIDE]) {
            let place = [at[0] as f64 + 0.5 - 32.0, 32.0 - at[1] as f64 - 0.5];
            let expected = turned(place, -angle);
            let (found, seen) = flow(&episode, sample, at);
            assert_flow(found, expected.map(|value| value.clamp(-LIMIT, LIMIT)));
            let was = [place[0] - expected[0], place[1] + expected[1]];
            // A point exactly on the border may count as visible or as hidden.
            if was.iter().any(|value| (value.abs() - 32.0).abs() < 1e-3) {
                continue;
            }
            let was_inside = was.iter().all(|value| value.abs() < 32.0);
            assert_eq!(seen, was_inside, "sample {sample} {at:?}");
            (inside, outside) = (inside + usize::from(seen), outside + usize::from(!seen));
        }
    }
    assert!(inside > 50_000 && outside > 1000, "{inside} {outside}");
}

/// The flow is computed with rays, the frames are rendered: what was seen before has the color that it had where it
/// was.
fn assert_colors_flow(episode: &Episode) {
    let (mut alike, mut all) = (0u32, 0u32);
    for sample in 1..episode.samples {
        for at in (0..SIDE * SIDE).map(|place| [place % SIDE, place / SIDE]) {
            let ([right, down], true) = flow(episode, sample, at) else { continue };
            let was = [at[0] as f64 + 0.5 - right, at[1] as f64 + 0.5 - down];
            let was = was.map(|value| (value as usize).min(SIDE - 1));
            let colors = [pixel(episode, "vision", sample, at), pixel(episode, "vision", sample - 1, was)];
            all += 1;
            alike += u32::from(colors[0].iter().zip(colors[1]).all(|(a, b)| a.abs_diff(*b) < 12));
        }
    }
    let share = f64::from(alike) / f64::from(all);
    // What is left are pixels at the plate's edges, 2 % of all, of which a half may round to the other side.
    assert!(all > 90_000 && share > 0.985, "{share} of {all}");
}

#[test]
fn frames_have_the_colors_of_earlier_ones_where_the_flow_says() {
    assert_colors_flow(&filmed([-0.3, 0.3], [-0.9, 0.5], [-1.0, 1.0]));
}

/// Geoms around the camera and geoms nearer than its near plane, at 1 % of the extent of 4 m, are not rendered.
#[test]
fn the_flow_looks_through_what_rendering_looks_through() {
    let plain = STAGE.replace("<default>", "<statistic extent=\"4\"/><default>");
    let with = |parent: &str, geom: &str| {
        let mesh = "<asset><mesh name=\"tent\" vertex=\"-1 -1 -1 1 -1 -1 0 1 -1 0 0 1\"/></asset>";
        let hill = "<asset><hfield name=\"hill\" nrow=\"2\" ncol=\"2\" size=\"1 1 1 1\" elevation=\"1 0 0 \
                    1\"/></asset>";
        let body = format!("<body name=\"{parent}\"");
        let geom = format!("<geom rgba=\"0.9 0.9 0.2 1\" mass=\"0\" {geom}/>");
        let place = plain.find(&body).unwrap() + plain[plain.find(&body).unwrap()..].find('>').unwrap() + 1;
        let text = format!("{}{geom}{}", &plain[..place], &plain[place..]);
        text.replace("<default>", &format!("{mesh}{hill}<default>"))
    };
    let filmed = |xml: &str| {
        let spec = Simulation { actuations_per_episode: 3, ..Simulation::default() };
        simulate(&stage_of(xml, [-0.3, 0.3], [-0.2, 0.2], [-1.0, 1.0]), &spec, 0)
    };
    let [flow, vision] = ["flow", "vision"].map(|name| Modality::new(name).unwrap());
    let free = filmed(&plain);
    for (parent, geom) in [
        ("tripod", "size=\"0.5\""),
        ("tripod", "type=\"capsule\" size=\"0.3 0.3\""),
        ("tripod", "type=\"ellipsoid\" size=\"0.3 0.4 0.5\""),
        ("tripod", "type=\"cylinder\" size=\"0.3 0.3\""),
        ("tripod", "type=\"box\" size=\"0.3 0.3 0.3\""),
        ("tripod", "type=\"mesh\" mesh=\"tent\""),
        ("tripod", "type=\"hfield\" hfield=\"hill\""),
        // Two shells, one in the other.
        ("tripod", "size=\"0.5\"/><geom type=\"box\" size=\"0.9 0.9 0.9\" mass=\"0\""),
        // A lens.
        ("tripod", "type=\"box\" size=\"0.2 0.2 0.01\" pos=\"0 0 -0.02\""),
        // A box that moves around the camera.
        ("plate", "type=\"box\" size=\"0.4 0.4 0.4\" pos=\"0 0 3\""),
    ] {
        let enclosed = filmed(&with(parent, geom));
        assert!(enclosed.image(vision) == free.image(vision), "the image of {geom}");
        assert!(enclosed.image(flow) == free.image(flow), "the flow of {geom}");
    }
}

/// The box moves with the plate, so that the camera is inside it and outside of it in turn.
#[test]
fn a_camera_that_enters_and_leaves_a_geom_has_its_flow() {
    let cover = "<geom type=\"box\" size=\"0.3 0.3 0.3\" pos=\"0 0 3\" rgba=\"0.9 0.9 0.2 1\" mass=\"0\"/>";
    let xml = STAGE.replace("<site name=\"corner\"", &format!("{cover}<site name=\"corner\""));
    let spec = Simulation { actuations_per_episode: 10, ..Simulation::default() };
    assert_colors_flow(&simulate(&stage_of(&xml, [-0.3, 0.3], [-0.9, 0.5], [-1.0, 1.0]), &spec, 0));
}

#[test]
fn poses_are_those_of_kinematics_and_sensors_at_one_instant() {
    let episode = filmed([0.0, 0.0], [-0.9, 0.5], [-1.0, 1.0]);
    let names = |name: &str| -> Vec<String> {
        let elements = episode.layout[Modality::new(name).unwrap()].elements().iter();
        elements.map(|element| format!("{} {}", element.name, element.unit)).collect()
    };
    assert_eq!(names("plate"), ["plate_x m", "plate_y m", "plate_z m"]);
    assert_eq!(names("corner_orientation"), ["corner_w 1", "corner_x 1", "corner_y 1", "corner_z 1"]);
    for sample in 0..episode.samples {
        let [_, x, angle] = vector(&episode, "joints", sample)[..] else { unreachable!() };
        let assert_all = |name: &str, expected: &[f64]| {
            let found = vector(&episode, name, sample);
            assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().zip(expected) {
                assert!((found - expected).abs() < 1e-6, "{name}: {found} instead of {expected}");
            }
        };
        let (sin, cos) = (0.5 * angle).sin_cos();
        assert_all("plate", &[x, 0.0, 1.0]);
        assert_all("plate_orientation", &[cos, 0.0, 0.0, sin]);
        assert_all("corner", &[x + 0.2 * angle.cos(), 0.2 * angle.sin(), 1.05]);
        assert_all("corner", &vector(&episode, "place", sample));
        assert_all("corner_orientation", &vector(&episode, "turned", sample));
    }
}

#[test]
fn a_live_simulation_has_the_flow_and_the_poses_of_its_episode() {
    let scene: &'static Scene = Box::leak(Box::new(stage([-0.3, 0.3], [-0.9, 0.5], [-1.0, 1.0])));
    let spec = Simulation { actuations_per_episode: 1, ..Simulation::default() };
    let mut live = LiveSimulation::new(scene, &spec).unwrap();
    for index in [1, 0] {
        let episode = simulate(scene, &spec, index);
        live.reset(spec.seed, index).unwrap();
        for sample in 0..episode.samples {
            assert!(sensed(&mut live) == sample_of(&episode, sample), "{index} {sample}");
            live.follow().unwrap();
        }
    }
}
