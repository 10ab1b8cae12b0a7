//! Images of depth and classes, compared with Python's renderer and with distances that follow from the scene.

use super::flow::STAGE;
use super::{FRAME_SIDE, ROOT, sample_of, seen_by_python, sensed, simulate};
use harness_simulation::{Episode, LiveSimulation, Scene, replay};
use harness_spec::{CLASS_COLORS, Modality, Simulation, World};

fn scene_of(name: &str, xml: &str, world: &str) -> Result<Scene, String> {
    let world =
        World::parse(&format!("{name}.yaml"), Some("".into()), name, world).map_err(|e| e.to_string())?;
    Scene::from_xml(world.into(), xml, format!("{name}.xml")).map_err(|error| error.to_string())
}

fn pixels<'e>(episode: &'e Episode, name: &str) -> Vec<&'e [u8]> {
    episode.image(Modality::new(name).unwrap()).chunks_exact(3).collect()
}

/// A world that a camera above the stage sees.
fn stage(classes: &str) -> String {
    format!(
        "model: stage.xml
step_rate_hz: 1000
modalities:
  vision: {{camera: above, size: [64, 64]}}
  depth: {{depth: above, size: [64, 64], range_m: [2.9, 3.0]}}
  parts: {{segmentation: above, size: [64, 64], classes: {classes}}}
  small: {{segmentation: above, size: [16, 32], classes: {classes}}}
action:
  actuators:
    pan: {{range: [-0.3, 0.3]}}
    slide: {{range: [-0.9, 0.5]}}
    turn: {{range: [-1, 1]}}
"
    )
}

const PLATE: &str = "{rest: ground, plate: plate}";

fn short() -> Simulation {
    Simulation { actuations_per_episode: 3, ..Simulation::default() }
}

#[test]
fn depths_and_classes_are_those_of_pythons_renderer() {
    let read = |name: &str| std::fs::read_to_string(format!("{ROOT}/models/cluttered.{name}")).unwrap();
    let [low, high] = [1.0, 6.0];
    let more = format!(
        "  depth: {{depth: external, size: [64, 64], range_m: [{low:?}, {high:?}]}}\n  parts:\n    \
         segmentation: external\n    size: [64, 64]\n    \
         classes: {{arm: arm_*, finger: [finger_link_*], box: 'box_[0-9]', ground: ground}}\n"
    );
    let world = read("yaml").replace("\naction:", &format!("{more}\naction:"));
    let scene = scene_of("sight", &read("xml"), &world).unwrap();
    let episode = simulate(&scene, &short(), 0);
    let states = replay(&scene, &short(), 0).unwrap();
    let (geoms, depths) = seen_by_python(&scene, &states);
    assert_eq!(geoms.len(), states.len() * FRAME_SIDE * FRAME_SIDE);
    let classes = ["arm_", "finger_link_", "box_", "ground"];
    let color_of = |geom: i32| {
        let name = usize::try_from(geom).ok().map(|geom| {
            scene.model().id_to_name(mujoco_rs::prelude::MjtObjBase::mjOBJ_GEOM, geom).unwrap_or_default()
        });
        let class = name.and_then(|name| classes.iter().position(|start| name.starts_with(start)));
        class.map_or([0; 3], |class| CLASS_COLORS[class].1)
    };
    let (mut within, mut seen) = (0, [0; 5]);
    for ((part, depth), (geom, theirs)) in
        pixels(&episode, "parts").into_iter().zip(pixels(&episode, "depth")).zip(geoms.iter().zip(&depths))
    {
        assert_eq!(part, color_of(*geom));
        let class = CLASS_COLORS.iter().position(|(_, color)| part == color);
        seen[class.unwrap_or(4)] += 1;
        let theirs = f64::from(*theirs);
        assert_eq!(depth[2], if *geom < 0 { 0 } else { 255 });
        if *geom >= 0 {
            let [red, green] = [depth[0], depth[1]].map(f64::from);
            // Half a step of a byte, and 0.1 mm.
            let decoded = low + red / 255.0 * (high - low);
            let nearest = theirs.clamp(low, high);
            assert!((decoded - nearest).abs() <= 0.5 / 255.0 * (high - low) + 1e-4, "{decoded} {theirs}");
            assert!((green - 255.0 * (low / theirs).min(1.0)).abs() <= 0.5 + 1e-3, "{green} {theirs}");
            within += usize::from(nearest == theirs);
        }
    }
    assert!(within > 10_000 && seen[..4].iter().all(|count| *count > 100), "{within} {seen:?}");
}

/// The camera is 4 m above the ground, and 2.95 m above the plate. A depth is the distance from the camera's plane, so
/// all pixels of the ground have the same.
#[test]
fn depths_are_distances_from_the_cameras_plane() {
    let episode = simulate(&scene_of("stage", STAGE, &stage(PLATE)).unwrap(), &short(), 0);
    let (mut plates, mut sites) = (0, 0);
    for (part, depth) in pixels(&episode, "parts").into_iter().zip(pixels(&episode, "depth")) {
        match part {
            // 2.9 / 4 of 255 is 184.9.
            [255, 0, 0] => assert_eq!(depth, [255, 185, 255]),
            // A step of red is 0.4 mm; 2.9 / 2.95 of 255 is 250.7.
            [0, 255, 0] => {
                assert!((127..=128).contains(&depth[0]) && depth[1..] == [251, 255], "{depth:?}");
                plates += 1;
            }
            // The plate carries a small site, which belongs to no class.
            [0, 0, 0] => sites += 1,
            _ => panic!("{part:?}"),
        }
    }
    assert!(plates > 1000 && sites < 2 * episode.samples, "{plates} {sites}");
    let definition = |name: &str| &episode.layout[Modality::new(name).unwrap()];
    assert_eq!(definition("parts").segmentation.as_ref().unwrap().of, [Modality::VISION]);
    assert!(definition("small").segmentation.as_ref().unwrap().of.is_empty(), "it has another size");
    assert_eq!(episode.layout.regions_of(Modality::VISION), ["rest", "plate"]);
    assert_eq!(pixels(&episode, "small").len(), episode.samples * 16 * 32);
}

/// With smooth edges, colors of a camera's image are mixed. Numbers of objects must not be.
#[test]
fn smooth_edges_mix_no_classes_and_no_depths() {
    let smooth = STAGE.replace("offsamples=\"0\"", "offsamples=\"4\"");
    let episodes =
        [STAGE, &smooth].map(|xml| simulate(&scene_of("stage", xml, &stage(PLATE)).unwrap(), &short(), 0));
    let [plain, smooth] = &episodes;
    assert!(plain.image(Modality::VISION) != smooth.image(Modality::VISION));
    for name in ["parts", "depth", "small"] {
        assert!(pixels(plain, name) == pixels(smooth, name), "{name}");
    }
}

#[test]
fn a_live_simulation_sees_and_records_what_an_episode_does() {
    let scene: &'static Scene = Box::leak(Box::new(scene_of("stage", STAGE, &stage(PLATE)).unwrap()));
    let spec = Simulation { actuations_per_episode: 1, ..Simulation::default() };
    let mut live = LiveSimulation::new(scene, &spec).unwrap();
    for index in [1, 0] {
        let episode = simulate(scene, &spec, index);
        live.reset(spec.seed, index).unwrap();
        let mut recorded = live.new_episode();
        for sample in 0..episode.samples {
            assert!(sensed(&mut live) == sample_of(&episode, sample), "{index} {sample}");
            live.record(&mut recorded).unwrap();
            live.follow().unwrap();
        }
        assert!(recorded == episode, "{index}");
    }
}

/// A soft block, which is no geom, on a table.
const JELLY: &str = r#"<mujoco><option timestep="0.002"/><worldbody>
    <light pos="0 0 2"/><camera name="side" pos="0 -1 0.3" xyaxes="1 0 0 0 0.2 1"/>
    <geom name="ground" type="plane" size="1 1 .1"/>
    <body name="hand" pos="0.3 0 0.2"><joint name="x" type="slide" axis="1 0 0"/><geom name="hand" size=".05"/></body>
    <flexcomp name="jelly" type="grid" count="3 3 3" spacing=".1 .1 .1" dim="3" radius=".01" mass="0.5"
      pos="0 0 .13"><edge equality="true" damping="1"/><contact selfcollide="none"/></flexcomp>
    </worldbody><actuator><motor name="m" joint="x" ctrlrange="-1 1"/></actuator></mujoco>"#;

#[test]
fn a_flex_is_a_class_of_its_own() {
    let world = |classes: &str| {
        format!(
            "model: jelly.xml\nstep_rate_hz: 500\nmodalities:\n  parts: {{segmentation: side, size: [48, 64], \
             classes: {classes}}}\naction: {{actuators: {{m: {{range: [-0.1, 0.1]}}}}}}\n"
        )
    };
    let scene = scene_of("jelly", JELLY, &world("{soft: [jelly, hand], rest: ground}")).unwrap();
    let episode = simulate(&scene, &Simulation { actuations_per_episode: 1, ..Simulation::default() }, 0);
    assert_ne!(episode.renderer, "none");
    let first = &pixels(&episode, "parts")[..48 * 64];
    // The camera points at the middle of the block.
    assert_eq!(first[24 * 64 + 32], [255, 0, 0]);
    let count = |color: [u8; 3]| first.iter().filter(|pixel| **pixel == color).count();
    assert!(count([255, 0, 0]) > 100 && count([0, 255, 0]) > 100 && count([0, 0, 0]) > 100);

    for (classes, expected) in [
        ("{a: ground, b: [hand, ground]}", "'ground' belongs to the class 'a' as well"),
        ("{a: jam}", "'jam' matches nothing among the model's geom names; the model has ground, hand"),
    ] {
        let said = scene_of("jelly", JELLY, &world(classes)).unwrap_err();
        assert!(said.starts_with("jelly.yaml:4:") && said.contains(expected), "{said}");
    }
}
