//! All values of a row belong to one instant, whichever integrator the model sets.

use super::{assert_close, sample_of, sensed, simulate};
use harness_simulation::{Camera, Episode, EpisodePlan, LiveSimulation, Scene, replay};
use harness_spec::{Modality, Simulation, World};
use mujoco_rs::prelude::*;

/// A rod that swings on a motor and hits the ground. The touch sensor feels all contacts of the rod.
const ROD: &str = r#"<mujoco>
  <option timestep="0.005" integrator="Euler"/>
  <visual><quality shadowsize="0" offsamples="0"/></visual>
  <worldbody>
    <light pos="0 -1 2" dir="0 0.5 -1"/>
    <camera name="side" pos="0 -1.2 0.2" xyaxes="1 0 0 0 0 1"/>
    <geom name="ground" type="plane" size="2 2 0.1"/>
    <body name="rod" pos="0 0 0.2">
      <joint name="swing" axis="0 1 0" damping="0.02"/>
      <geom name="rod" type="capsule" size="0.03" fromto="0 0 0 0.4 0 0"/>
      <site name="end" pos="0.4 0 0"/>
      <site name="skin" size="1"/>
    </body>
  </worldbody>
  <actuator><motor name="swing" joint="swing" ctrlrange="-4 4"/></actuator>
  <sensor>
    <framepos name="place" objtype="site" objname="end"/>
    <jointpos name="angle" joint="swing"/>
    <touch name="touch" site="skin"/>
  </sensor>
</mujoco>
"#;

const WORLD: &str = "model: rod.xml
step_rate_hz: 200
modalities:
  angle: {joint_positions: swing}
  sensed_angle: {sensor: angle, unit: rad}
  end: {site_positions: end}
  place: {sensor: place, unit: m}
  force: {normal_force: rod}
  mean_force: {normal_force: rod, average_over: sample}
  touch: {sensor: touch, unit: N}
  vision: {camera: side, size: [48, 48]}
action:
  seconds: 0.5
  actuators: {swing: {range: [-4, 4]}}
";

const STEPS_PER_SAMPLE: usize = 20;

fn scene(integrator: &str) -> Scene {
    let world = World::parse("rod.yaml", Some("".into()), "rod", WORLD).unwrap();
    let xml = ROD.replace("integrator=\"Euler\"", &format!("integrator=\"{integrator}\""));
    Scene::from_xml(world.into(), &xml, "rod.xml".into()).unwrap()
}

fn spec() -> Simulation {
    Simulation { actuations_per_episode: 10, actuation_seconds: 0.5, ..Simulation::default() }
}

fn values<'e>(episode: &'e Episode, name: &str) -> &'e [f32] {
    episode.vector(Modality::new(name).unwrap())
}

#[test]
fn all_values_of_a_row_belong_to_the_same_instant() {
    for integrator in ["Euler", "RK4", "implicit", "implicitfast", "discrete"] {
        let (scene, spec) = (scene(integrator), spec());
        let episode = simulate(&scene, &spec, 0);
        let states = replay(&scene, &spec, 0).unwrap();
        // A simulation of its own takes MuJoCo's steps. Sensors have the values at the start of a step.
        let (mut data, mut still) = (MjData::new(scene.model()), MjData::new(scene.model()));
        let plan = EpisodePlan::draw(&scene, &spec, 0).unwrap();
        let mut camera = Camera::new(&scene, 48, 48).unwrap();
        let (mut sum, mut steps, mut felt, mut moved) = (0.0, 0, 0, false);
        for step in 0..=(episode.samples - 1) * STEPS_PER_SAMPLE {
            let qpos = data.qpos().to_vec();
            plan.setpoint(step, data.ctrl_mut());
            data.step();
            let [x, y, z, angle, touch] = data.sensordata() else { panic!("five values") };
            (sum, steps) = (sum + touch, steps + 1);
            if step % STEPS_PER_SAMPLE != 0 {
                continue;
            }
            let sample = step / STEPS_PER_SAMPLE;
            assert_eq!(qpos, states[sample], "{integrator}: the states are those of MuJoCo's steps");
            let row = |name: &str, width: usize| &values(&episode, name)[sample * width..][..width];
            for (name, expected) in [
                ("angle", &[*angle][..]),
                ("sensed_angle", &[*angle]),
                ("end", &[*x, *y, *z]),
                ("place", &[*x, *y, *z]),
                ("touch", &[*touch]),
                ("force", &[*touch]),
                ("mean_force", &[sum / f64::from(steps)]),
            ] {
                assert_close(row(name, expected.len()), expected);
            }
            still.qpos_mut().copy_from_slice(&qpos);
            still.forward();
            let image =
                &episode.image(Modality::new("vision").unwrap())[sample * 48 * 48 * 3..][..48 * 48 * 3];
            assert!(
                camera.capture(&mut still).unwrap() == image,
                "{integrator}: the image of sample {sample}"
            );
            felt += usize::from(*touch > 0.0);
            moved |= (angle - states[0][0]).abs() > 0.2;
            (sum, steps) = (0.0, 0);
        }
        assert!(moved && (5..episode.samples).contains(&felt), "{integrator}: {felt} samples with contact");
    }
}

#[test]
fn a_live_simulation_with_runge_kutta_senses_its_episode() {
    let scene: &'static Scene = Box::leak(Box::new(scene("RK4")));
    let spec = Simulation { actuations_per_episode: 2, ..spec() };
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

/// A puck that falls asleep while it slides, because it is slower than the tolerance for ten steps.
const PUCK: &str = r#"<mujoco>
  <option timestep="0.01" gravity="0.1 0 0" sleep_tolerance="1"><flag sleep="enable"/></option>
  <worldbody>
    <body><joint name="swing" axis="0 1 0"/><geom size="0.1" contype="0" conaffinity="0"/></body>
    <body pos="0 1 0"><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><motor name="swing" joint="swing" ctrlrange="-1 1"/></actuator>
  <sensor><jointvel name="speed" joint="slide"/></sensor>
</mujoco>
"#;

/// The step that lets it fall asleep stops it, and computes all sensors once more.
#[test]
fn values_belong_to_their_instant_when_a_body_falls_asleep() {
    let text = "model: puck.xml\nstep_rate_hz: 100\nmodalities:\n  speed: {joint_velocities: slide}\n  \
                sensed_speed: {sensor: speed, unit: m/s}\naction:\n  seconds: 0.5\n  \
                actuators: {swing: {range: [-1, 1]}}\n";
    let world = World::parse("puck.yaml", Some("".into()), "puck", text).unwrap();
    let scene = Scene::from_xml(world.into(), PUCK, "puck.xml".into()).unwrap();
    let spec = Simulation { sample_rate_hz: 100.0, actuations_per_episode: 1, ..spec() };
    let episode = simulate(&scene, &spec, 0);
    let (speed, sensed) = (values(&episode, "speed"), values(&episode, "sensed_speed"));
    assert_eq!(speed, sensed);
    let moving = speed.iter().filter(|speed| **speed > 0.0).count();
    assert!((5..speed.len() - 5).contains(&moving), "it moves, and then sleeps: {speed:?}");
}
