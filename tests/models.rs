//! The MJCF files of the repository, and the script that composes them.

use harness::simulation::Scene;
use harness::spec::{Layout, Modality, Scenario, World};
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

/// Datasets and runs from before layouts have this layout, so the two worlds must resolve to it, apart from the kinds
/// of contacts, which came later.
#[test]
fn the_fingers_layout_is_that_of_the_papers_worlds() {
    for scenario in Scenario::PAPER {
        let mut layout = Layout::clone(Scene::paper(scenario).unwrap().layout());
        let kinds = layout[Modality::CONTACT_FORCE].contact_kind().unwrap();
        layout.modalities.retain(|definition| definition.name != kinds);
        layout.modalities.iter_mut().for_each(|definition| definition.contact_kinds.clear());
        assert!(
            layout == *Layout::finger(),
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
