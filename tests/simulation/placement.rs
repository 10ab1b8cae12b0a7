//! Placement: where bodies stand at the start of an episode, compared with the distances that MuJoCo computes.

use super::{simulate, varies};
use harness_simulation::{EpisodePlan, Scene, SimulationError, Simulator};
use harness_spec::{Modality, Simulation, World};
use mujoco_rs::prelude::*;
use std::ops::ControlFlow;

/// A world with these fixed geoms and bodies. The bodies whose names begin with `p` are placed in a square of 4 m.
fn stage(fixed: &str, bodies: &str, more: &str) -> Scene {
    let model = format!(
        r#"<mujoco><compiler angle="degree"/><option timestep="0.001"/>
        <asset><mesh name="wedge" vertex="0 0 0  0.3 0 0  0 0.2 0  0 0 0.4"/></asset><worldbody>{fixed}
        <body name="arm" pos="0 0 50"><joint name="arm" type="slide" axis="1 0 0"/><geom size="0.01"/></body>{bodies}
        </worldbody><actuator><motor name="arm" joint="arm"/></actuator></mujoco>"#
    );
    let text = format!(
        "model: stage.xml\nstep_rate_hz: 1000\nmodalities: {{force: {{normal_force: [\"p*\"]}}}}\n\
         action: {{actuators: {{arm: {{range: [0, 1]}}}}}}\n\
         placement: {{things: {{bodies: [\"p*\"], clearance_m: 0.01, rectangle: [[-2, 2], [-2, 2]]}}}}\n{more}"
    );
    let world = World::parse("stage.yaml", Some("".into()), "stage", &text).unwrap();
    Scene::from_xml(world.into(), &model, "stage.xml".into()).unwrap()
}

const FLOOR: &str = r#"<geom name="floor" type="plane" size="5 5 1"/>"#;

fn spec() -> Simulation {
    Simulation { actuations_per_episode: 1, ..Simulation::default() }
}

/// MuJoCo's distance of each placed body from the floor and from the other placed bodies, at the start of an episode,
/// m.
fn distances(scene: &Scene, episode: u32) -> (Vec<f64>, Vec<f64>) {
    let plan = EpisodePlan::draw(scene, &spec(), episode).unwrap();
    let model = scene.model();
    let mut data = MjData::new(model);
    let bodies: Vec<usize> = (0..model.nbody() as usize)
        .filter(|body| {
            model.id_to_name(MjtObjBase::mjOBJ_BODY, *body).is_some_and(|name| name.starts_with('p'))
        })
        .collect();
    for (body, pose) in bodies.iter().zip(&plan.boxes) {
        let qpos = model.jnt_qposadr()[model.body_jntadr()[*body] as usize] as usize;
        data.qpos_mut()[qpos..qpos + 7].copy_from_slice(pose);
    }
    data.forward();
    let geoms = |body: usize| {
        let root =
            move |geom: &usize| model.body_rootid()[model.geom_bodyid()[*geom] as usize] as usize == body;
        (0..model.ngeom() as usize).filter(root).collect::<Vec<_>>()
    };
    let floor = model.name_to_id(MjtObjBase::mjOBJ_GEOM, "floor").unwrap();
    let mut least = |one: &[usize], other: &[usize]| {
        let pairs = one.iter().flat_map(|a| other.iter().map(move |b| (*a, *b)));
        pairs.map(|(a, b)| data.geom_distance(a, b, 10.0, None)).fold(f64::INFINITY, f64::min)
    };
    let to_floor = bodies.iter().map(|body| least(&geoms(*body), &[floor])).collect();
    let mut apart = Vec::new();
    for (place, one) in bodies.iter().enumerate() {
        for other in &bodies[..place] {
            apart.push(least(&geoms(*one), &geoms(*other)));
        }
    }
    (to_floor, apart)
}

#[test]
fn bodies_of_any_shape_stand_on_the_floor_and_apart() {
    let shapes = [
        ("a box", r#"<geom type="box" size="0.1 0.2 0.3"/>"#),
        ("a sphere", r#"<geom size="0.15"/>"#),
        ("a capsule that lies", r#"<geom type="capsule" size="0.05 0.2" euler="90 0 0"/>"#),
        ("a cylinder", r#"<geom type="cylinder" size="0.1 0.2"/>"#),
        ("an ellipsoid", r#"<geom type="ellipsoid" size="0.1 0.2 0.05"/>"#),
        ("a box beside the body's origin", r#"<geom type="box" size="0.1 0.1 0.1" pos="0.4 0.1 0.3"/>"#),
        ("a turned box", r#"<geom type="box" size="0.1 0.2 0.3" euler="30 20 10"/>"#),
        (
            "two geoms",
            r#"<geom size="0.1" pos="-0.2 0 0.1"/><geom type="box" size="0.1 0.1 0.1" pos="0.2 0 -0.3"/>"#,
        ),
        ("a mesh", r#"<geom type="mesh" mesh="wedge"/>"#),
        ("a body on a hinge", r#"<geom size="0.05"/><body pos="0 0 -0.3"><joint/><geom size="0.1"/></body>"#),
        (
            "a geom that only cameras see",
            r#"<geom size="0.1"/><geom size="0.5" contype="0" conaffinity="0"/>"#,
        ),
    ];
    for height in [0.0, 0.6] {
        let floor = FLOOR.replace("size=", &format!("pos=\"0 0 {height}\" size="));
        for (name, geoms) in &shapes {
            let bodies: String = (0..4)
                .map(|number| {
                    format!(r#"<body name="p{number}" pos="0 0 {}"><freejoint/>{geoms}</body>"#, number + 1)
                })
                .collect();
            let scene = stage(&floor, &bodies, "");
            for episode in 0..5 {
                let (to_floor, apart) = distances(&scene, episode);
                let touches = |distance: &f64| distance.abs() < 1e-6;
                let only_seen = name.contains("cameras");
                assert!(only_seen || to_floor.iter().all(touches), "{name} on {height}: {to_floor:?}");
                assert!(only_seen || apart.iter().all(|gap| *gap >= 0.01 - 1e-9), "{name}: {apart:?}");
            }
            scene.check_starts().unwrap();
        }
    }
}

#[test]
fn a_body_below_a_raised_floor_starts_on_it_at_rest() {
    let floor = FLOOR.replace("size=", "pos=\"0 0 0.6\" size=");
    let body = r#"<body name="p" pos="1 0 0.1"><freejoint/>
        <geom name="p" type="box" size="0.1 0.1 0.1" mass="1"/></body>"#;
    let scene = stage(&floor, body, "");
    let episode = simulate(&scene, &spec(), 0);
    assert!((episode.boxes[0][2] - 0.7).abs() < 1e-9, "{:?}", episode.boxes);
    // It was thrown up with 470 N before. Its weight is 9.81 N.
    let forces = episode.vector(Modality::new("force").unwrap());
    assert!(forces.iter().all(|force| (0.0..15.0).contains(force)), "{forces:?}");
    assert!((forces.last().unwrap() - 9.81).abs() < 0.1 && varies(forces), "{forces:?}");
}

#[test]
fn the_height_in_the_model_selects_the_surface_to_stand_on() {
    let table = r#"<body pos="0 0 0.5"><geom name="table" type="box" size="3 3 0.05"/></body>"#;
    let fixed = format!("{FLOOR}{table}");
    let low = r#"<body name="p" pos="0 0 0.1"><freejoint/><geom name="p" size="0.1"/></body>"#;
    let height = |scene: &Scene| EpisodePlan::draw(scene, &spec(), 0).unwrap().boxes[0][2];
    assert!((height(&stage(&fixed, low, "")) - 0.1).abs() < 1e-9);
    assert!(
        (height(&stage(&fixed, &low.replace("0.1\"><freejoint", "2\"><freejoint"), "")) - 0.65).abs() < 1e-9
    );
    // Without a surface, the body keeps its height in the model.
    assert_eq!(height(&stage("", &low.replace("0.1\"><freejoint", "2\"><freejoint"), "")), 2.0);
}

#[test]
fn a_body_tilted_in_the_model_stays_tilted_and_gets_a_yaw() {
    let body = r#"<body name="p" pos="0 0 1" euler="90 0 0"><freejoint/><geom type="cylinder" size="0.1 0.3"/></body>"#;
    let scene = stage(FLOOR, body, "");
    for episode in 0..5 {
        let [.., z, w, x, y, k] = EpisodePlan::draw(&scene, &spec(), episode).unwrap().boxes[0];
        // The cylinder lies: its own z axis is horizontal. The circle is in a polygon of 16 corners.
        assert!((w * w - x * x - y * y + k * k).abs() < 1e-9);
        assert!((0.1..0.1021).contains(&z), "{z}");
    }
}

#[test]
fn an_overlap_at_the_start_is_refused_with_names_and_depth() {
    let wall = format!(r#"{FLOOR}<geom name="wall" type="box" size="1 5 0.5" pos="0 0 0.5"/>"#);
    let body =
        r#"<body name="p" pos="0 0 0.1"><freejoint/><geom name="p" type="box" size="0.1 0.1 0.1"/></body>"#;
    let scene = stage(&wall, body, "");
    let run = |index| Simulator::new(&scene, &spec()).unwrap().run(index, &mut || ControlFlow::Continue(()));
    let errors: Vec<SimulationError> = (0..20).filter_map(|index| run(index).err()).collect();
    assert!((3..18).contains(&errors.len()), "half of the square is inside the wall: {}", errors.len());
    let message = errors[0].to_string();
    assert!(message.contains("would start with an overlap of 'wall' and 'p' by 0."), "{message}");
    let message = scene.check_starts().unwrap_err().to_string();
    assert!(message.starts_with("stage.yaml:5:") && message.contains("'wall' and 'p' by 0."), "{message}");
}
