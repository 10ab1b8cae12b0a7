//! Robot models that nobody here wrote, from packages of dm_control and MuJoCo. Each goes through the commands that a
//! new user calls. What was recorded is compared with what Python's `mujoco` computes at the recorded states.

use crate::common::recorded::{add_poses, compare, write_comparison};
use crate::common::{fresh, succeed};
use harness::dataset::Dataset;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// A model of a Python package.
struct Robot {
    /// The folder in `.venv` or `.venv-models` of the packages, and the model's path in it; or [`FIXTURES`].
    model: (&'static str, &'static str),
    /// Inputs and outputs of the network.
    input: &'static str,
    output: &'static str,
    /// Samples per second, and duration of a move, s. They make the experiment short.
    sample_rate_hz: f64,
    actuation_seconds: f64,
    /// What is compared beyond [`ALWAYS`], by its source in a world file. Its values vary during the episodes. `bodies`
    /// and `sites` stand for positions and orientations, and `contacts` for forces and normals.
    compared: &'static str,
}

/// What is compared for each robot. `controls` are the recorded setpoints.
const ALWAYS: [&str; 4] = ["time", "controls", "joint_positions", "joint_velocities"];

/// dm_control is installed for the environments, and the others for this test.
const SUITE: &str = ".venv";
const OTHERS: &str = ".venv-models";
/// Models of this repository, which need no package.
const FIXTURES: &str = "tests/fixtures";

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

impl Robot {
    fn name(&self) -> String {
        let path = Path::new(self.model.1).with_extension("");
        path.iter().map(|part| part.to_string_lossy()).collect::<Vec<_>>().join("_").replace('-', "_")
    }

    fn path(&self) -> PathBuf {
        let (environment, model) = self.model;
        if environment == FIXTURES {
            return root().join(environment).join(model);
        }
        let library = root().join(environment).join("lib");
        let mut versions = fs::read_dir(&library)
            .unwrap_or_else(|_| panic!("no {environment}: run `setup/setup.sh --models`"));
        versions.next().unwrap().unwrap().path().join("site-packages").join(model)
    }

    /// Writes a world file, checks it, runs an experiment in it, and reads the results.
    fn assert_recorded_as_python_computes(&self) {
        let folder = fresh(&format!("foreign_{}", self.name()));
        fs::create_dir_all(&folder).unwrap();
        let (results, world) = (folder.join("results"), folder.join("robot.yaml"));
        let file = |name: &str| folder.join(name).display().to_string();
        let model = self.path().display().to_string();
        succeed(&results, &["world", "new", &model, "--output", &file("robot.yaml")]);
        add_poses(&world);
        succeed(&results, &["world", "check", &file("robot.yaml")]);
        let spec = format!(
            "name: foreign\nscenarios: [robot.yaml]\ninput: {}\noutput: {}\nlatent: 2\n\
             network: {{preset: multi_to_multi, hidden: [8], channels: [2]}}\n\
             simulation: {{episodes: 4, actuations_per_episode: 2, sample_rate_hz: {}, actuation_seconds: {}}}\n\
             training: {{epochs: 1, batch_size: 16}}\n",
            self.input, self.output, self.sample_rate_hz, self.actuation_seconds,
        );
        fs::write(folder.join("experiment.yaml"), spec).unwrap();
        let said = succeed(&results, &["run", &file("experiment.yaml")]);
        assert!(said.contains("1 done, 0 done before, 0 failed"), "{said}");
        let said = succeed(&results, &["compare", "foreign", "--metrics", "r2,rmse"]);
        assert!(said.contains("persistence"), "{said}");
        succeed(&results, &["report", "--output", &file("report.html")]);
        let dataset = fs::read_dir(results.join("datasets")).unwrap().next().unwrap().unwrap().path();
        self.assert_equals_python(&world, &Dataset::at(&dataset).unwrap());
    }

    /// Simulates a dataset's episodes again with Python, under the same controls, and compares each recorded value.
    fn assert_equals_python(&self, world: &Path, dataset: &Dataset) {
        let folder = world.parent().unwrap();
        write_comparison(folder, &self.path(), world, dataset);
        let (agrees, said) = compare([folder]);
        println!("{}:\n{said}", self.name());
        assert!(agrees, "{}: {said}", self.name());
        let varies = |source: &str| {
            let of_source = said.lines().filter(|line| line.contains(&format!(": {source}, ")));
            of_source.filter(|line| !line.contains(", 0 vary")).count() > 0
        };
        let compared = self.compared.split_whitespace().flat_map(|word| match word {
            "bodies" => vec!["body_positions", "body_orientations"],
            "sites" => vec!["site_positions", "site_orientations"],
            "contacts" => vec!["normal_force", "contact_normal"],
            source => vec![source],
        });
        for source in ALWAYS.into_iter().chain(compared) {
            assert!(varies(source), "{}: no {source} was compared, or it was constant: {said}", self.name());
        }
    }
}

/// The timing of most robots.
const TYPICAL: Robot = Robot {
    model: (FIXTURES, ""),
    input: "",
    output: "",
    sample_rate_hz: 10.0,
    actuation_seconds: 0.4,
    compared: "",
};

/// Runge-Kutta of the 4th order, and a cylinder.
const ACROBOT: Robot = Robot {
    model: (SUITE, "dm_control/suite/acrobot.xml"),
    input: "[joints, fixed]",
    output: "[joint_velocities]",
    sample_rate_hz: 10.0,
    actuation_seconds: 0.2,
    compared: "camera bodies sites",
};
/// Elliptic friction cones, cylinders and touch sensors.
const FINGER: Robot = Robot {
    model: (SUITE, "dm_control/suite/finger.xml"),
    input: "[joints, touch]",
    output: "[framepos, touch]",
    sample_rate_hz: 10.0,
    actuation_seconds: 0.2,
    compared: "sensor camera bodies sites",
};
/// A free joint in a fluid, and tendons.
const FISH: Robot = Robot {
    model: (SUITE, "dm_control/suite/fish.xml"),
    input: "[joints, gyro]",
    output: "[joints, velocimeter]",
    compared: "sensor camera bodies sites",
    ..TYPICAL
};
/// Slides, tendons, an equality constraint and elliptic friction cones.
const MANIPULATOR: Robot = Robot {
    model: (SUITE, "dm_control/suite/manipulator.xml"),
    input: "[joints, hand]",
    output: "[joints, contact_force]",
    compared: "contacts camera bodies sites",
    ..TYPICAL
};
/// Two free joints, a flat height field, filtered actuators and rangefinders.
const QUADRUPED: Robot = Robot {
    model: (SUITE, "dm_control/suite/quadruped.xml"),
    input: "[joints, rangefinder]",
    output: "[joint_velocities, contact_force]",
    compared: "contacts sensor camera bodies sites",
    ..TYPICAL
};
/// Force, torque and touch sensors.
const HUMANOID: Robot = Robot {
    model: (SUITE, "dm_control/suite/humanoid.xml"),
    input: "[joints, gyro]",
    output: "[touch, contact_force]",
    compared: "contacts sensor camera bodies sites",
    ..TYPICAL
};
/// Skins, 162 meshes and 38 filtered actuators.
const DOG: Robot = Robot {
    model: (SUITE, "dm_control/suite/dog.xml"),
    input: "[joints, head]",
    output: "[joints, contact_force]",
    compared: "contacts sensor camera bodies sites",
    ..TYPICAL
};
/// Runge-Kutta of the 4th order, and a free joint.
const MUJOCOS_HUMANOID: Robot = Robot {
    model: (SUITE, "dm_control/mujoco/testing/assets/humanoid.xml"),
    input: "[joints, places]",
    output: "[joints, contact_force]",
    sample_rate_hz: 1000.0 / 99.0,
    actuation_seconds: 0.198,
    compared: "contacts camera bodies",
};
/// Ball joints, and 28 kinds of sensors.
const SENSORS: Robot = Robot {
    model: (OTHERS, "mujoco/mjx/test_data/sensor/sensor.xml"),
    input: "[joints, framequat]",
    output: "[gyro, framelinacc]",
    compared: "sensor bodies sites",
    ..TYPICAL
};
/// Six muscles, and tendons that wrap around cylinders.
const MUSCLES: Robot = Robot {
    model: (OTHERS, "mujoco/mjx/test_data/actuator/arm26.xml"),
    input: "[joints]",
    output: "[joints, site_places]",
    compared: "sites",
    ..TYPICAL
};
/// A soft body of 384 vertices on a cylinder.
const FLEX: Robot = Robot {
    model: (OTHERS, "mujoco_warp/test_data/flex/floppy.xml"),
    input: "[joints]",
    output: "[joints, places]",
    sample_rate_hz: 20.0,
    actuation_seconds: 0.2,
    compared: "body_positions",
};
/// 24 servos, tendons and meshes.
const HAND: Robot = Robot {
    model: (OTHERS, "mujoco/mjx/test_data/shadow_hand/scene_right.xml"),
    input: "[joints]",
    output: "[joints, contact_force]",
    compared: "contacts bodies sites",
    ..TYPICAL
};
/// A four-legged robot of meshes above a height field.
const HEIGHT_FIELD: Robot = Robot {
    model: (OTHERS, "mujoco/mjx/test_data/barkour_v0/assets/barkour_v0_mjx.xml"),
    input: "[joints, gyro]",
    output: "[joints, accelerometer]",
    compared: "sensor camera bodies",
    ..TYPICAL
};

/// An elastic cable of 10 links, computed by a plugin.
const CABLE: Robot = Robot {
    model: (FIXTURES, "cable.xml"),
    input: "[joints, side]",
    output: "[joints, contact_force]",
    compared: "contacts bodies",
    ..TYPICAL
};
/// A sensor of a plugin: a grid of 7 x 7 taxels with three values each.
const TOUCH_GRID: Robot = Robot {
    model: (FIXTURES, "touch_grid.xml"),
    input: "[joints, plugin]",
    output: "[joints, plugin]",
    compared: "sensor contacts body_positions",
    ..TYPICAL
};

/// A ball that a mocap body carries by a weld. It has no actuator.
const MOCAP: Robot = Robot {
    model: (FIXTURES, "mocap.xml"),
    input: "[joints, places]",
    output: "[joints, other_joints]",
    compared: "contacts bodies camera",
    ..TYPICAL
};
/// A soft block of 27 vertices that a servo presses.
const JELLY: Robot = Robot {
    model: (FIXTURES, "jelly.xml"),
    input: "[joints, flex_force]",
    output: "[joints, flex_force]",
    compared: "contacts body_positions camera",
    ..TYPICAL
};

#[test]
fn models_with_mujocos_plugins_record_what_python_computes() {
    [CABLE, TOUCH_GRID].iter().for_each(Robot::assert_recorded_as_python_computes);
}

#[test]
fn mocap_and_soft_bodies_record_what_python_computes() {
    [MOCAP, JELLY].iter().for_each(Robot::assert_recorded_as_python_computes);
}

#[test]
#[ignore = "half a minute, and packages of models: make soak"]
fn three_foreign_robots_record_what_python_computes() {
    [ACROBOT, FINGER, MUJOCOS_HUMANOID].iter().for_each(Robot::assert_recorded_as_python_computes);
}

#[test]
#[ignore = "takes minutes: make soak"]
fn ten_more_foreign_robots_record_what_python_computes() {
    let robots = [FISH, MANIPULATOR, QUADRUPED, HUMANOID, DOG, SENSORS, MUSCLES, FLEX, HAND, HEIGHT_FIELD];
    for robot in robots {
        let begin = Instant::now();
        robot.assert_recorded_as_python_computes();
        println!("{} took {:.0} s", robot.name(), begin.elapsed().as_secs_f64());
    }
}
