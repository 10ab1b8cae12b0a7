//! The MJCF files of the repository, the script that composes them, and the version of MuJoCo that all files name.

use harness::simulation::Scene;
use harness::spec::{Layout, Scenario, World};
use std::fs;
use std::path::Path;
use std::process::Command;

#[test]
fn the_script_still_produces_what_is_checked_in() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = root.join(".venv/bin/python");
    let output = Command::new(python).arg(root.join("models/compose.py")).arg("--check").output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "run `.venv/bin/python models/compose.py`:\n{said}");
}

/// The two worlds record all of this layout, so that all results are tables of these columns. They also record kinds of
/// contacts and further modalities.
#[test]
fn the_papers_worlds_record_what_the_fingers_layout_holds() {
    for scenario in Scenario::PAPER {
        let mut layout = Layout::clone(Scene::paper(scenario).unwrap().layout());
        let finger = Layout::finger();
        layout.modalities.retain(|definition| finger.position(definition.name).is_some());
        layout.modalities.iter_mut().for_each(|definition| definition.contact_kinds.clear());
        assert!(
            layout == *finger,
            "models/finger.json must hold {}",
            serde_json::to_string(&layout).unwrap()
        );
    }
}

#[test]
fn every_built_in_world_compiles_and_every_name_of_it_matches() {
    for world in World::built_in() {
        let scene = Scene::new(world.clone()).unwrap();
        assert!(scene.check(&world.simulation()).is_ok(), "{}", world.scenario());
        assert!(!world.description().is_empty());
    }
}

/// The set-up and the Python package name MuJoCo's version again, since cargo does not know of them.
#[test]
fn every_file_asks_for_the_mujoco_that_the_bindings_are_for() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let lock = fs::read_to_string(root.join("Cargo.lock")).unwrap();
    let (_, rest) = lock.split_once("name = \"mujoco-rs\"\nversion = \"").unwrap();
    let (version, _) = rest.split_once('"').unwrap();
    let (_, wanted) = version.split_once("+mj-").unwrap();
    assert_eq!(wanted, harness::simulation::MUJOCO_VERSION);
    let inputs = fs::read_dir(root.join("setup")).unwrap().map(|entry| entry.unwrap().path());
    let inputs = inputs.filter(|path| path.extension().is_some_and(|ending| ending == "in"));
    let mut named = 0;
    for path in inputs.chain([root.join("pyproject.toml")]) {
        for asked in fs::read_to_string(&path).unwrap().split("mujoco==").skip(1) {
            let asked = asked.split(['"', '\n', ' ']).next().unwrap();
            assert_eq!(asked, wanted, "{}", path.display());
            named += 1;
        }
    }
    assert!(named >= 5, "{named}");
    let loaded = fs::read_to_string(root.join("python/harness/_mujoco.py")).unwrap();
    assert!(loaded.contains(&format!("\nVERSION = \"{wanted}\"\n")), "{loaded}");
    for document in ["README.md", "models/README.md"] {
        for asked in fs::read_to_string(root.join(document)).unwrap().split("MuJoCo 3.").skip(1) {
            let asked = format!("3.{}", asked.split([' ', ':', ',']).next().unwrap());
            assert!(wanted.starts_with(&asked), "{document}: {asked}");
        }
    }
}
