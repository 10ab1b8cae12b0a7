//! Compares recorded values with those that Python's `mujoco` computes: what `tests/python/recorded_values.py` needs.

use harness::dataset::Dataset;
use harness::simulation::{EpisodePlan, Scene};
use harness::spec::World;
use serde_json::json;
use std::fs;
use std::path::Path;
use std::process::Command;

/// Adds to a world file that `world new` wrote: the entries that it leaves out, the poses of all bodies and sites with
/// a name, mean forces, and directions of contacts.
pub fn add_poses(path: &Path) {
    // Entries that the file leaves out, and advises to uncomment.
    let text = fs::read_to_string(path).unwrap();
    let is_entry = |line: &str| line.starts_with("  #") && !line.starts_with("  # ");
    let text: String = text
        .lines()
        .map(|line| if is_entry(line) { line.replacen('#', "", 1) } else { line.to_owned() } + "\n")
        .collect();
    let mut more = String::from("  places: {body_positions: \"*\"}\n  turns: {body_orientations: \"*\"}\n");
    let model = World::load(path).map(|world| Scene::new(world).unwrap()).unwrap();
    if model.model().nsite() > 0 {
        more += "  site_places: {site_positions: \"*\"}\n  site_turns: {site_orientations: \"*\"}\n";
    }
    if let Some(line) = text.lines().find(|line| line.trim_start().starts_with("contact_force:")) {
        let mean = line.replace("contact_force:", "mean_force:").replace("]}", "], average_over: sample}");
        let push = line.replace("contact_force:", "push:").replace("normal_force:", "contact_normal:");
        more += &format!("{mean}\n{push}\n");
    }
    fs::write(path, text.replacen("\naction:", &format!("{more}\naction:"), 1)).unwrap();
}

/// Writes to `folder` what the comparison of a dataset needs, with the setpoints of all steps.
pub fn write_comparison(folder: &Path, model: &Path, world: &Path, dataset: &Dataset) {
    let spec = dataset.spec();
    let scene = Scene::new(World::load(world).unwrap()).unwrap();
    let every = (1.0 / (spec.sample_rate_hz * scene.step_s())).round() as usize;
    let steps = (spec.samples_per_episode() - 1) * every + 1;
    let mut setpoint = vec![0.0; scene.world().file().action.actuators.0.len()];
    let (mut controls, mut drawn) = (Vec::<u8>::new(), Vec::<Vec<f64>>::new());
    for episode in 0..spec.episodes {
        let plan = EpisodePlan::draw(&scene, spec, episode).unwrap();
        drawn.push(plan.factors.values().collect());
        for step in 0..steps {
            plan.setpoint(step, &mut setpoint);
            controls.extend(setpoint.iter().flat_map(|value| value.to_le_bytes()));
        }
    }
    fs::write(folder.join("controls.f64"), controls).unwrap();
    let comparison = json!({
        "model": model, "world": scene.world().file(), "dataset": dataset.folder(), "factors": spec.factors,
        "drawn": drawn, "steps_per_sample": every,
    });
    fs::write(folder.join("comparison.json"), comparison.to_string()).unwrap();
}

/// Compares the datasets of these folders. Returns whether all values agree, and what Python said.
pub fn compare<'a>(folders: impl IntoIterator<Item = &'a Path>) -> (bool, String) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new(root.join(".venv/bin/python"))
        .arg(root.join("tests/python/recorded_values.py"))
        .args(folders)
        .output()
        .unwrap();
    let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    (output.status.success(), said.concat())
}
