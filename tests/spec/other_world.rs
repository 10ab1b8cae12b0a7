//! Tests in another world than that of the run.

use super::{BASE, load, load_with};
use harness_spec::{self as spec, Experiment, RunSpec};
use std::fs;
use std::path::Path;

/// The world file of a built-in world. No test compiles its model.
const EMPTY: &str = include_str!("../../models/empty.yaml");

fn worlds(runs: &[RunSpec]) -> Vec<[String; 2]> {
    let names = |run: &RunSpec| [run.scenario.to_string(), run.tested_in().to_string()];
    runs.iter().map(names).collect()
}

#[test]
fn the_world_of_a_test_is_part_of_what_names_a_run_if_it_is_another_one() {
    let one = "latent=[2]";
    let runs = |text: &str| load_with(format!("{BASE}{text}"), &[one], false).unwrap().runs();
    let (tested, plain) = (runs("test: {world: cluttered}\n"), runs("test: {}\n"));
    assert_eq!(worlds(&tested), [["empty", "cluttered"], ["cluttered", "cluttered"]]);
    // What is trained in the world of the test is the same run without the key.
    assert_eq!(tested[1], plain[1]);
    assert_ne!(tested[0].hash(), plain[0].hash());
    // The dataset of a test in another world does not follow from that of the run.
    assert_eq!(plain[0].data("own", Some("test")), "own");
    assert_eq!(tested[0].data("own", Some("test")), "own test");
    assert_eq!(serde_yaml::from_str::<RunSpec>(&tested[0].to_yaml()).unwrap(), tested[0]);
    assert_eq!(load(&tested[0].to_experiment_yaml("again")).runs(), [tested[0].clone()]);
    // Two datasets for training, and one for the test of both runs.
    let of = |text: &str| load_with(format!("{BASE}{text}"), &[one], false).unwrap().simulated();
    let simulated = of("test: {world: cluttered, episodes: 7}\n");
    let names: Vec<(&str, u32, bool)> =
        simulated.iter().map(|(world, of)| (world.scenario().name(), of.episodes, of.test)).collect();
    assert_eq!(names, [("empty", 200, false), ("cluttered", 7, true), ("cluttered", 200, false)]);
}

/// A folder with the world files `slippery.yaml` and `lab/soft.yaml`.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("lab")).unwrap();
    for name in ["slippery.yaml", "lab/soft.yaml"] {
        fs::write(folder.path().join(name), EMPTY).unwrap();
    }
    folder
}

fn load_in(folder: &Path, name: &str, text: &str) -> Result<Experiment, String> {
    fs::write(folder.join(name), text).unwrap();
    let prefix = format!("{}/", folder.display());
    spec::load(&folder.join(name), &[], false).map_err(|error| error.to_string().replace(&prefix, ""))
}

#[test]
fn the_world_of_a_test_can_vary() {
    let folder = folder();
    let text = format!(
        "{}scenarios: [empty]\nlatent: 2\nvary: {{test.world: [empty, slippery.yaml, lab/soft.yaml]}}\n",
        BASE.replace("scenarios: [empty, cluttered]\n", "").replace("latent: [2, 4]\n", "")
    );
    let experiment = load_in(folder.path(), "spec.yaml", &text).unwrap();
    let runs = experiment.runs();
    let variants: Vec<&str> = runs.iter().map(|run| run.variant.as_str()).collect();
    assert_eq!(variants, ["world=empty", "world=slippery", "world=soft"]);
    assert_eq!(worlds(&runs), [["empty", "empty"], ["empty", "slippery"], ["empty", "soft"]]);
    assert!(runs.iter().all(|run| experiment.world(run.tested_in()).is_some()));
    let given = "vary={test.world: [empty, slippery.yaml, lab/soft.yaml]}";
    assert_eq!(runs[2].own_override(given), r#"vary={"test.world":["lab/soft.yaml"]}"#);
    // Paths are relative to the folder of the spec that has them.
    let labels = "vary: {shift: {none: {}, soft: {test.world: soft.yaml}}}\nquick: {test.world: soft.yaml}\n";
    let base = text
        .lines()
        .filter(|line| !line.starts_with("vary"))
        .fold(String::new(), |all, line| all + line + "\n");
    load_in(folder.path(), "lab/base.yaml", &format!("{base}{labels}")).unwrap();
    let above = load_in(folder.path(), "above.yaml", "extends: lab/base.yaml\nname: above\n").unwrap();
    assert_eq!(worlds(&above.runs()), [["empty", "empty"], ["empty", "soft"]]);
    let one = load_in(folder.path(), "one.yaml", &format!("{base}test: {{world: slippery.yaml}}\n")).unwrap();
    assert_eq!(worlds(&one.runs()), [["empty", "slippery"]]);
}

#[test]
fn a_world_in_which_runs_can_not_be_tested_is_refused_at_its_place() {
    let folder = folder();
    let refused = [
        (
            "test: {world: clutered}\n",
            "spec.yaml:7:15: unknown world 'clutered' in 'test.world'; did you mean 'cluttered'?",
        ),
        (
            "vary: {test.world: [empty, clutered]}\n",
            "spec.yaml:7:28: unknown world 'clutered' in 'test.world'; did you mean 'cluttered'?",
        ),
        ("test: {world: gone.yaml}\n", "spec.yaml:7:15: gone.yaml: there is no such file"),
        (
            "test: {world: lab-0123456789abcdef}\n",
            "spec.yaml:7:15: 'lab-0123456789abcdef' is an imported dataset",
        ),
        (
            "test: {world: crowded}\n",
            "spec.yaml:7:15: the worlds empty and crowded have different defaults for 'simulation.extension_range_m'",
        ),
        (
            "test: {world: wrist, factors: [box_weight]}\n",
            "spec.yaml:7:32: unknown factor 'box_weight' in 'test.factors'. Allowed: finger_stiffness",
        ),
        (
            "test: {world: empty, factors: [box_mass]}\n",
            "spec.yaml:7:32: unknown factor 'box_mass' in 'test.factors'",
        ),
        (
            "test: {world: other/soft.yaml}\nvary: {test.world: [lab/soft.yaml]}\n",
            "spec.yaml:8:21: two world files are called 'soft'; give one another name",
        ),
    ];
    fs::create_dir(folder.path().join("other")).unwrap();
    fs::write(folder.path().join("other/soft.yaml"), EMPTY).unwrap();
    for (addition, expected) in refused {
        let said = load_in(folder.path(), "spec.yaml", &format!("{BASE}{addition}")).unwrap_err();
        assert!(said.starts_with(expected), "{addition}: {said}");
    }
    // The built-in world with boxes has the factor that the world of the run lacks.
    load(&format!("{BASE}test: {{world: cluttered, factors: [box_mass]}}\n"));
    let boxes = ["scenarios=[cluttered]", "input=[proprioception, arm, boxes]", "test.world=empty"];
    let said = load_with(BASE, &boxes, false).unwrap_err();
    assert!(
        said.contains("the world empty has no 'boxes', which the runs use; its modalities are"),
        "{said}"
    );
    let imported =
        ["scenarios=[lab-0123456789abcdef]", "test.dataset=day-0123456789abcdef", "test.world=empty"];
    let said = load_with(BASE, &imported, false).unwrap_err();
    assert!(
        said.contains("the episodes of an imported dataset are in no world; leave out test.world"),
        "{said}"
    );
}
