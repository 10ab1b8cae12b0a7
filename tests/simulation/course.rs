//! Recorded courses: what an episode follows, and mistakes in the file.

use harness_simulation::{LiveSimulation, Scene, Simulator, replay};
use harness_spec::{Modality, Simulation, World};
use std::fs;
use std::ops::ControlFlow;
use std::path::Path;
use tempfile::TempDir;

const MODEL: &str = r#"<mujoco><option timestep="0.01"/><worldbody>
    <body><joint name="turn" axis="0 0 1" damping="1"/><geom size="0.1"/>
      <body pos="1 0 0"><joint name="slide" type="slide" axis="1 0 0" damping="1"/><geom size="0.1"/></body></body>
    </worldbody><actuator><position name="turn" joint="turn" kp="10"/><motor name="push" joint="slide"/></actuator>
    </mujoco>"#;

const WORLD: &str = "model: robot.xml\nstep_rate_hz: 100\nsample_rate_hz: 10\n\
    modalities: {joints: {joint_positions: [turn, slide]}}\naction:\n  seconds: 0.2\n  course: moves.csv\n  \
    actuators: {turn: {unit: rad, range: [-1, 1]}, push: {range: [-2, 2]}}\n";

/// Two episodes of four samples. The rows of the second one come first, and columns are in another order.
const MOVES: &str = "time,push,episode,turn\n0,0.5,1,0.125\n0.1,0.5,1,0.25\n0.2,-1,1,0.375\n0.3,2,1,0.5\n\
    0,0,0,-0.5\n0.1,1,0,0\n0.2,1,0,0.5\n0.3,-1,0,0.25\n";

fn folder(moves: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, text) in [("robot.xml", MODEL), ("robot.yaml", WORLD), ("moves.csv", moves)] {
        fs::write(folder.path().join(name), text).unwrap();
    }
    folder
}

fn load(folder: &Path) -> Result<Scene, String> {
    let world = World::load(&folder.join("robot.yaml")).map_err(|error| error.to_string())?;
    Scene::new(world).map_err(|error| error.to_string())
}

fn spec(scene: &Scene) -> Simulation {
    Simulation { episodes: 2, actuations_per_episode: 2, ..scene.world().simulation() }
}

#[test]
fn episodes_have_the_setpoints_of_the_course() {
    let folder = folder(MOVES);
    let scene = load(folder.path()).unwrap();
    let spec = spec(&scene);
    scene.check(&spec).unwrap();
    let mut simulator = Simulator::new(&scene, &spec).unwrap();
    let mut run = |index| simulator.run(index, &mut || ControlFlow::Continue(())).unwrap();
    let (first, second) = (run(0), run(1));
    assert_eq!(first.vector(Modality::SETPOINT), [-0.5, 0.0, 0.0, 1.0, 0.5, 1.0, 0.25, -1.0]);
    assert_eq!(second.vector(Modality::SETPOINT), [0.125, 0.5, 0.25, 0.5, 0.375, -1.0, 0.5, 2.0]);
    // The joint of a position servo starts at its setpoint, and others at rest.
    assert_eq!(replay(&scene, &spec, 1).unwrap()[0], [0.125, 0.0]);
    // A live simulation that follows the episode gives the same samples.
    let shared = Scene::shared(scene.world().clone()).unwrap();
    let mut live = LiveSimulation::new(shared, &spec).unwrap();
    live.reset(spec.seed, 1).unwrap();
    let joints = second.layout.modalities[0].name;
    for sample in second.vector(joints).chunks(2) {
        assert_eq!(live.vector(joints).unwrap(), sample);
        live.follow().unwrap();
    }
}

#[test]
fn a_course_without_episodes_is_followed_by_each() {
    let folder = folder("turn,push\n0,0\n0.5,1\n0.25,1\n0,-2\n0,0\n");
    let scene = load(folder.path()).unwrap();
    let spec = Simulation { episodes: 7, ..spec(&scene) };
    scene.check(&spec).unwrap();
    assert_eq!(replay(&scene, &spec, 0).unwrap(), replay(&scene, &spec, 6).unwrap());
    assert!(scene.course_summary().unwrap().ends_with("moves.csv: 5 samples, the same in each episode"));
}

#[test]
fn a_changed_course_is_another_world() {
    let folder = folder(MOVES);
    let scene = load(folder.path()).unwrap();
    let before = scene.course_sha256().unwrap().to_owned();
    assert!(!scene.has_changed());
    fs::write(folder.path().join("moves.csv"), MOVES.replace("0.375", "0.3")).unwrap();
    assert!(scene.has_changed());
    assert_ne!(load(folder.path()).unwrap().course_sha256().unwrap(), before);
}

#[test]
fn mistakes_in_a_course_have_their_line() {
    let cases = [
        (
            "push,episode,turn",
            "pull,episode,turn",
            "moves.csv:1: there is no column 'push', an element of the",
        ),
        ("0.375", "1.5", "moves.csv:4: turn: 1.5 is outside of its range [-1, 1]"),
        ("0.375", "nan", "moves.csv:4: turn: 'nan' must be a finite number"),
        ("0.375", "", "moves.csv:4: turn: '' must be a finite number"),
        ("0.2,-1,1,0.375", "0.2,-1,1", "moves.csv:4: the row has 3 values, and the first line has 4 names"),
        ("0.2,-1,1,", "0.2,-1,x,", "moves.csv:4: episode: 'x' must be the index of an episode, 0 or more"),
        (
            "0.2,-1,1,",
            "0.2,-1,3,",
            "moves.csv:1: there are no rows of episode 2; the episodes are counted from 0",
        ),
    ];
    for (old, new, message) in cases {
        assert!(MOVES.contains(old), "{old}");
        let folder = folder(&MOVES.replace(old, new));
        let said = load(folder.path()).unwrap_err();
        assert!(said.contains(message) && !said.contains('\n'), "{said}");
    }
    let said = load(folder("turn,push\n").path()).unwrap_err();
    assert!(said.contains("moves.csv:1: the course has no rows"), "{said}");
    let missing = folder(MOVES);
    fs::remove_file(missing.path().join("moves.csv")).unwrap();
    let said = load(missing.path()).unwrap_err();
    assert!(said.contains("robot.yaml:7:11: can't read the course "), "{said}");
    fs::write(missing.path().join("robot.yaml"), WORLD.replace("course:", "motion: sinusoids\n  course:"))
        .unwrap();
    let said = load(missing.path()).unwrap_err();
    assert!(said.contains("robot.yaml:7:11: a recorded course replaces the motion"), "{said}");
}

#[test]
fn a_course_must_have_all_samples_of_a_spec() {
    let folder = folder(MOVES);
    let scene = load(folder.path()).unwrap();
    let error = |spec: &Simulation| scene.check(spec).unwrap_err().to_string();
    let said = error(&Simulation { actuations_per_episode: 3, ..spec(&scene) });
    assert!(
        said.contains("moves.csv:9: the episode ends after 4 rows, and its 6 samples need a row each"),
        "{said}"
    );
    let said = error(&Simulation { episodes: 3, ..spec(&scene) });
    assert!(said.contains("moves.csv:1: the course has 2 episodes, and simulation.episodes is 3;"), "{said}");
    let narrow = spec(&scene).with("turn_range_rad", harness_spec::Setting::Range([-1.0, 0.4]));
    assert!(error(&narrow).contains("moves.csv:8: turn: 0.5 is outside of its range [-1, 0.4]"));
}
