//! Whether a world is fit for learning. What is found is compared with a loop over MuJoCo's steps.

use super::parts::scene;
use harness_simulation::{EpisodePlan, Limit, fitness};
use mujoco_rs::prelude::*;

/// A ball that a servo with a limit of force presses on a floor, and a pendulum that hangs beyond its limit.
const PRESS: &str = r#"<mujoco><compiler autolimits="true"/><option timestep="0.002"/><worldbody>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <body name="ball" pos="0 0 .3"><joint name="z" type="slide" axis="0 0 1" damping="20"/>
      <geom name="ball" size=".05" mass="1"/></body>
    <body pos="1 0 1"><joint name="swing" axis="0 1 0" range="-90 -10" damping=".5"/>
      <geom size=".05" pos="0 0 -.3" mass="1"/></body></worldbody>
    <actuator><position name="push" joint="z" kp="2000" ctrlrange="-.4 .1" forcerange="-60 60"/></actuator></mujoco>"#;

const TOUCHED: &str = "modalities: {force: {normal_force: ball}}\n\
                       action: {seconds: 1, actuators: {push: {range: [-0.4, 0.1], start: high}}}\n";

#[test]
fn findings_are_those_of_mujocos_steps() {
    let scene = scene(PRESS, TOUCHED).unwrap();
    let spec = scene.world().simulation();
    let (mut deepest, mut beyond, mut samples): (f64, f64, f64) = (0.0, 0.0, 0.0);
    let (mut touched, mut at_limit) = (0.0, 0.0);
    for episode in 0..3 {
        let plan = EpisodePlan::draw(&scene, &spec, episode).unwrap();
        let (mut data, mut setpoint) = (MjData::new(scene.model()), [0.0]);
        data.qpos_mut()[0] = 0.1;
        for step in 0..=(spec.samples_per_episode() - 1) * 50 {
            plan.setpoint(step, &mut setpoint);
            data.ctrl_mut()[0] = setpoint[0];
            beyond = beyond.max(data.qpos()[1] - scene.model().jnt_range()[1][1]);
            data.step();
            let depth = data.contact().first().map_or(0.0, |contact| -contact.dist);
            let force = data.contact().first().map_or(0.0, |_| data.contact_force(0)[0]);
            deepest = deepest.max(depth);
            if step.is_multiple_of(50) {
                samples += 1.0;
                touched += f64::from(force != 0.0);
                at_limit += f64::from(data.actuator_force()[0].abs() >= 60.0);
            }
        }
    }
    let found = fitness(&scene, 3).unwrap();
    let of = |name: &str| found.iter().find(|finding| finding.name == name).unwrap();
    for (name, expected, holds) in [
        ("samples with contact", touched / samples, touched / samples >= 0.3),
        ("penetration, most", 1e3 * deepest, true),
        ("penetration, most, in half the thickness", deepest / 0.05, deepest / 0.05 <= 10.0 / 45.0),
        ("hinge beyond its limit", beyond.to_degrees(), beyond.to_degrees() <= 0.5),
        ("samples with an actuator at its limit", at_limit / samples, at_limit / samples <= 0.5),
    ] {
        let (value, own) = (of(name).value.unwrap(), of(name));
        assert!((value - expected).abs() < 1e-9 && expected > 0.0, "{name}: {value} {expected}");
        assert_eq!(own.holds(), holds, "{name}: {value} {:?}", own.limit);
    }
    assert_eq!(of("hinge beyond its limit").of, "'swing'");
    assert_eq!(of("samples with contact").limit, Some(Limit::AtLeast(0.3)));
    // Nothing is placed, and no body can sleep.
    assert_eq!(
        [of("pairs of link and placed body in a sample"), of("bodies asleep")].map(|one| one.value),
        [None; 2]
    );
}
