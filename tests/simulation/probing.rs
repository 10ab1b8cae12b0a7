//! Probing: a motion that stops where it touches something.

use super::{columns, sample_of, sensed, simulate};
use harness_simulation::{LiveSimulation, Scene, Simulator, replay};
use harness_spec::{Modality, Simulation, World};
use std::ops::ControlFlow;

/// A hand that a stiff servo moves to and fro, and a pin above its way, which a spring presses on it where it passes.
const PIN: &str = r#"<mujoco><compiler autolimits="true"/>
    <option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/><worldbody>
    <body name="hand" pos="0.3 0 0.22"><joint name="x" type="slide" axis="1 0 0" range="-1 1"/>
      <geom name="hand" size="0.01" mass="0.2"/></body>
    <body name="pin" pos="0 0 0.235"><joint name="pin" type="slide" axis="0 0 1" stiffness="100" damping="2"/>
      <geom name="pin" size="0.01" mass="0.02"/></body>
    </worldbody><actuator><position name="x" joint="x" kp="20000" kv="100"/></actuator></mujoco>"#;

fn scene(action: &str, modality: &str) -> Result<Scene, String> {
    let text = format!(
        "model: pin.xml\nstep_rate_hz: 500\nsample_rate_hz: 50\nmodalities:\n  place: {{joint_positions: x}}\n  \
         {modality}\naction:\n  {action}\n  actuators: {{x: {{range: [-1, 1]}}}}\n"
    );
    let world = World::parse("pin.yaml", Some("".into()), "pin", &text).map_err(|error| error.to_string())?;
    Scene::from_xml(world.into(), PIN, "pin.xml".into()).map_err(|error| error.to_string())
}

const TOUCH: &str = "touch: {normal_force: hand}";
const PROBING: &str = "motion: probing\n  probe_force_n: 0.2";

fn spec(scene: &Scene, moves: u32) -> Simulation {
    Simulation { actuations_per_episode: moves, ..scene.world().simulation() }
}

#[test]
fn a_probe_touches_twice_as_long_as_random_setpoints() {
    let shares = [PROBING, "motion: random_setpoints"].map(|action| {
        let scene = scene(action, TOUCH).unwrap();
        let (mut touched, mut all) = (0, 0);
        for index in 0..4 {
            let episode = simulate(&scene, &spec(&scene, 30), index);
            let force = episode.vector(Modality::new("touch").unwrap());
            touched += force.iter().filter(|force| **force > 0.05).count();
            all += force.len();
            let setpoints = &columns(episode.vector(Modality::SETPOINT), 1)[0];
            assert_eq!(setpoints[0], 0.0);
            let steps: Vec<f32> = setpoints.windows(2).map(|pair| (pair[1] - pair[0]).abs()).collect();
            // A move through the whole range takes 50 samples, and a smoothstep is at most 1.5 times as fast.
            assert!(steps.iter().all(|step| *step <= 1.5 * 2.0 / 50.0 + 1e-6));
            assert!(setpoints.iter().all(|value| (-1.0..=1.0).contains(value)));
            // The setpoint stays where something was touched: 20 % of a move are 10 samples.
            let still = steps.windows(9).filter(|steps| steps.iter().all(|step| *step == 0.0)).count();
            assert_eq!(still > 0, action == PROBING, "{still}");
        }
        touched as f64 / all as f64
    });
    assert!(shares[0] > 2.0 * shares[1] && shares[1] > 0.005, "{shares:?}");
}

#[test]
fn a_probing_episode_is_the_same_live_replayed_and_after_others() {
    let scene: &'static Scene = Box::leak(Box::new(scene(PROBING, TOUCH).unwrap()));
    let spec = spec(scene, 4);
    let mut live = LiveSimulation::new(scene, &spec).unwrap();
    let mut simulator = Simulator::new(scene, &spec).unwrap();
    for index in [2, 0, 1] {
        let episode = simulate(scene, &spec, index);
        assert!(simulator.run(index, &mut || ControlFlow::Continue(())).unwrap() == episode);
        let states = replay(scene, &spec, index).unwrap();
        let places: Vec<f32> = states.iter().map(|state| state[0] as f32).collect();
        assert_eq!(places, episode.vector(Modality::new("place").unwrap()));
        live.reset(spec.seed, index).unwrap();
        for sample in 0..episode.samples {
            assert!(sensed(&mut live) == sample_of(&episode, sample), "{index} {sample}");
            live.follow().unwrap();
        }
    }
    // Setpoints that a caller gives are those that are commanded.
    live.reset(spec.seed, 0).unwrap();
    live.step(&[0.5]).unwrap();
    assert_eq!(live.setpoint(), [0.5]);
}

#[test]
fn a_probe_needs_a_force_to_feel() {
    for (action, modality, expected) in [
        (
            "motion: probing",
            "pin: {joint_positions: pin}",
            "pin.yaml:8:11: a probing motion needs a touch: add a modality with a 'normal_force'",
        ),
        ("probe_force_n: 2", TOUCH, "pin.yaml:8:18: only the motion 'probing' has a 'probe_force_n'"),
        (
            "motion: probing\n  probe_force_n: 0",
            TOUCH,
            "'action.probe_force_n': expected a finite number above 0, found 0",
        ),
    ] {
        let said = scene(action, modality).unwrap_err();
        assert!(said.contains(expected), "{said}");
    }
    // An average over samples is felt as well.
    scene(PROBING, "touch: {normal_force: hand, average_over: sample}").unwrap();
}
