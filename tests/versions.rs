//! Two versions of a world: results of before and after a change of its model are never mixed.

use crate::common::{Answer, ask, finish, fresh, harness, succeed};
use crate::horizons::served;
use crate::report::data;
use crate::suggestions::shell_in;
use harness::registry::Registry;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// A model with a wall and a mesh in a file of its own.
const MODEL: &str = r#"<mujoco><asset><mesh name="tip" file="tip.obj"/></asset>
  <worldbody><light pos="0 0 3"/><geom name="wall" type="box" pos=".3 0 .2" size=".02 .4 .2"/>
  <body name="rod" pos="0 0 .5"><joint name="swing" axis="0 1 0" damping=".1" range="-60 60"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".2"/>
    <geom type="mesh" mesh="tip" pos="0 0 -.3" mass=".05"/></body></worldbody>
  <actuator><motor name="push" joint="swing" ctrlrange="-.5 .5"/></actuator></mujoco>"#;
/// A tetrahedron.
const MESH: &str = "v 0 0 0\nv .03 0 0\nv 0 .03 0\nv 0 0 .03\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
const WORLD: &str = "model: rod.xml\nstep_rate_hz: 500\nsample_rate_hz: 10\n\
                     action: {seconds: 1, actuators: {push: {actuator: push, unit: N m, range: [-0.4, 0.4]}}}\n\
                     modalities: {swing: {joint_positions: swing}}\n";
const SPEC: &str = "name: rod\nscenarios: [rod.yaml]\ninput: swing\noutput: swing\nlatent: 2\nseeds: [0, 1]\n\
                    network: {preset: single_to_multi, hidden: [8]}\ntasks: [prediction]\n\
                    simulation: {episodes: 4, actuations_per_episode: 3}\ntraining: {epochs: 1, batch_size: 16}\n";

#[test]
fn a_dataset_of_an_older_version_cannot_be_collected_and_verify_says_so() {
    let two = Two::new("versions_verify");
    let rows = ask(&two.results, "select dataset from runs order by started limit 1");
    fs::remove_dir_all(two.results.join("datasets").join(rows[0]["dataset"].as_str().unwrap())).unwrap();
    let answer = finish(&mut harness(&two.results, &["verify"]));
    let said = answer.stdout.split_whitespace().collect::<Vec<_>>().join(" ");
    assert_eq!(answer.code, 1, "{said}");
    assert!(said.contains("the world rod or MuJoCo has changed since"), "{said}");
    assert!(!said.contains("repair:"), "{said}");
    // The means of both versions are told apart by the key that the message names.
    let plot = |more: &[&str]| {
        let output = two.world.path().join("plot.svg").display().to_string();
        let asked = ["plot", "--x", "latent", "--metrics", "r2", "--output", &output];
        finish(&mut harness(&two.results, &[&asked[..], more].concat()))
    };
    assert_eq!(plot(&["--by", "world"]).code, 0, "{}", plot(&["--by", "world"]).stderr);
}

#[test]
fn a_plan_makes_runs_of_the_same_world_with_the_same_settings() {
    let two = Two::new("versions_plan");
    let claims = two.world.path().join("claims.yaml");
    let claim = "claims:\n- id: error\n  statement: The error is small.\n  measured: RMSE\n  scenarios: [rod]\n  \
                 experiments: [rod]\n  condition: below 1\n  query: |\n    select seed, scenario, value from metrics where \
                 metric = 'rmse' and model = 'network' and direction is null and index is null\n";
    fs::write(&claims, claim).unwrap();
    let plan = two.say(&["claims", "--file", claims.to_str().unwrap(), "--plan"]).stdout;
    let commands: Vec<&str> = plan.lines().filter_map(|line| line.strip_prefix("  ")).collect();
    assert!(plan.contains(", 1 run, about ") && commands.len() == 1, "{plan}");
    for command in commands {
        assert_eq!(shell_in(two.world.path(), command), 0, "{command}");
    }
    let sql = "select distinct seed, world_version from runs where command like '%simulation.episodes=8%'";
    let versions: Vec<_> =
        ask(&two.results, sql).into_iter().map(|row| row["world_version"].clone()).collect();
    assert!(versions.len() == 2 && versions[0] == versions[1], "{plan} made {versions:?}");
}

#[test]
fn the_page_shows_an_experiment_that_has_only_runs_of_an_older_version() {
    let two = Two::new("versions_page");
    let spec = two.world.path().join("spec.yaml").display().to_string();
    move_wall(two.world.path(), ".25", ".2");
    two.say(&["run", &spec, "name=other", "seeds=[0]"]);
    let page = served(&two.results, &[("GET", "/api/compare?experiment=rod", "")]).remove(0);
    assert!(page["notes"].to_string().contains("which has changed since"), "{page}");
    assert!(page["tables"].as_array().is_some_and(|tables| !tables.is_empty()), "{page}");
}

/// The results of two runs in a world, and of one run with more episodes after its wall was moved.
struct Two {
    results: PathBuf,
    world: tempfile::TempDir,
    /// The versions of the world: of before and after the change.
    versions: [String; 2],
}

impl Two {
    fn new(name: &str) -> Self {
        let (results, world) = (fresh(name), tempfile::tempdir().unwrap());
        for (name, text) in [("rod.xml", MODEL), ("tip.obj", MESH), ("rod.yaml", WORLD), ("spec.yaml", SPEC)]
        {
            fs::write(world.path().join(name), text).unwrap();
        }
        let run = |more: &[&str]| {
            let spec = world.path().join("spec.yaml");
            succeed(&results, &[&["run", spec.to_str().unwrap()][..], more].concat());
        };
        run(&[]);
        move_wall(world.path(), ".3", ".25");
        run(&["simulation.episodes=8", "seeds=[0]"]);
        let rows = ask(&results, "select world_version from runs order by started");
        let versions: Vec<String> =
            rows.iter().map(|row| row["world_version"].as_str().unwrap().to_owned()).collect();
        assert!(versions[0] == versions[1] && versions[1] != versions[2], "{versions:?}");
        Self { results, world, versions: [versions[0].clone(), versions[2].clone()] }
    }

    fn say(&self, arguments: &[&str]) -> Answer {
        let answer = finish(&mut harness(&self.results, arguments));
        assert_eq!(answer.code, 0, "{}", answer.stderr);
        answer
    }

    /// The numbers of runs and episodes of the means that `compare` writes.
    fn compared(&self, options: &[&str]) -> BTreeSet<(u64, String)> {
        let asked =
            ["compare", "rod", "--models", "network", "--by", "simulation.episodes", "--format", "json"];
        let said = self.say(&[&asked[..], options].concat()).stdout;
        let rows: Vec<serde_json::Value> = serde_json::from_str(&said).unwrap();
        let of = |row: &serde_json::Value| {
            (row["seeds"].as_u64().unwrap(), row["simulation.episodes"].to_string().replace('"', ""))
        };
        rows.iter().map(of).collect()
    }
}

fn move_wall(world: &Path, from: &str, to: &str) {
    let model = world.join("rod.xml");
    let text = fs::read_to_string(&model).unwrap();
    let moved =
        text.replacen(&format!("type=\"box\" pos=\"{from} "), &format!("type=\"box\" pos=\"{to} "), 1);
    assert_ne!(moved, text);
    fs::write(&model, moved).unwrap();
}

fn one_of(seeds: u64, episodes: &str) -> BTreeSet<(u64, String)> {
    BTreeSet::from([(seeds, episodes.to_owned())])
}

#[test]
fn one_version_of_a_world_counts_in_every_reader() {
    let two = Two::new("versions");
    let [old, new] = &two.versions;
    let path = |name: &str| two.results.join(name).display().to_string();
    assert_eq!(two.compared(&[]), one_of(1, "8"));
    let note = two.say(&["compare", "rod"]).stderr;
    assert!(
        note.contains("2 finished runs in other versions of the world rod") && note.contains(old),
        "{note}"
    );
    assert!(note.contains("gc --only world"), "{note}");

    two.say(&[
        "plot",
        "rod",
        "--x",
        "simulation.episodes",
        "--metrics",
        "rmse",
        "--output",
        &path("plot.csv"),
    ]);
    let plotted = fs::read_to_string(path("plot.csv")).unwrap();
    assert_eq!(plotted.lines().count(), 2, "{plotted}");
    two.say(&["publish", "rod", "--output", &path("published")]);
    assert_eq!(Registry::new(path("published")).records().len(), 1);
    two.say(&["report", "--output", &path("page.html")]);
    let page = data(&fs::read_to_string(path("page.html")).unwrap());
    let latest = ask(&two.results, "select run from runs order by started desc limit 1");
    let curves = page["training"].as_array().unwrap();
    assert!(curves.len() == 1 && curves[0]["run"] == latest[0]["run"], "{curves:?}");

    // SQL sees all runs, with a note unless the query tells the versions apart.
    let count = |sql: &str| two.say(&["query", sql, "--format", "csv"]);
    let answer = count("select count(distinct run) as n from metrics");
    assert!(answer.stdout.ends_with("3\n") && answer.stderr.contains("world_version"), "{}", answer.stderr);
    let answer = count(&format!("select count(*) as n from runs where world_version = '{new}'"));
    assert!(answer.stdout.ends_with("1\n") && answer.stderr.is_empty(), "{}", answer.stderr);

    // A version that is asked for counts. Two of them differ in a setting.
    assert_eq!(two.compared(&["--where", &format!("world={old}")]), one_of(2, "4"));
    let both = ["--where", &format!("world={old}"), "--where", &format!("world={new}"), "--format", "csv"];
    let both = two.say(&[&["compare", "rod"][..], &both].concat()).stdout;
    assert!(both.contains(&format!("world={old}")) && both.contains(&format!("world={new}")), "{both}");
}

#[test]
fn the_version_of_the_file_counts_or_else_the_last_start() {
    let two = Two::new("versions_of_files");
    move_wall(two.world.path(), ".25", ".3");
    assert_eq!(two.compared(&[]), one_of(2, "4"));
    // No finished run has this version.
    move_wall(two.world.path(), ".3", ".2");
    assert_eq!(two.compared(&[]), one_of(1, "8"));
    fs::remove_file(two.world.path().join("rod.yaml")).unwrap();
    assert_eq!(two.compared(&[]), one_of(1, "8"));
    let removed = two.say(&["gc", "--only", "world", "--yes"]).stdout;
    assert!(removed.ends_with("2 folders removed\n"), "{removed}");
    assert!(two.say(&["compare", "rod"]).stderr.is_empty());
}

#[test]
fn no_run_that_counts_is_superseded_by_one_of_another_version() {
    let two = Two::new("versions_superseded");
    // The first run again, in the new version.
    two.say(&["run", two.world.path().join("spec.yaml").to_str().unwrap(), "seeds=[0]"]);
    move_wall(two.world.path(), ".25", ".3");
    two.say(&["gc", "--yes"]);
    assert_eq!(two.compared(&[]), one_of(2, "4"));
}

#[test]
fn an_experiment_whose_runs_are_all_of_another_version_says_so() {
    let two = Two::new("versions_of_experiments");
    let spec = two.world.path().join("spec.yaml");
    let text = fs::read_to_string(&spec).unwrap().replace("name: rod\n", "name: bar\n");
    fs::write(&spec, text).unwrap();
    move_wall(two.world.path(), ".25", ".2");
    two.say(&["run", spec.to_str().unwrap()]);
    let answer = finish(&mut harness(&two.results, &["compare", "rod"]));
    assert_eq!(answer.code, 2, "{}", answer.stderr);
    let select = format!("--where rod:world={}", two.versions[1]);
    assert!(answer.stderr.contains(&select), "{}", answer.stderr);
    two.say(&["compare", "rod", "--where", &format!("rod:world={}", two.versions[1])]);
}

#[test]
fn diff_says_what_differs_in_the_world() {
    let two = Two::new("versions_diff");
    let runs = |sql: &str| -> Vec<String> {
        let rows = ask(&two.results, sql);
        rows.iter().map(|row| row["run"].as_str().unwrap().to_owned()).collect()
    };
    let all = runs("select run from runs order by started, seed");
    let [old, new] = [&all[0], &all[2]];
    let said = two.say(&["diff", old, new]).stdout;
    let line = |text: &str| said.lines().find(|line| line.contains(text)).unwrap_or_else(|| panic!("{said}"));
    let words = |text: &str| line(text).split_whitespace().map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(words("geom 'wall' pos"), ["geom", "'wall'", "pos", "0.3", "0", "0.2", "0.25", "0", "0.2"]);
    assert_eq!(words("simulation.episodes"), ["simulation.episodes", "4", "8"]);
    assert!(!said.contains("ridge") && !said.contains("world.") && said.lines().count() < 25, "{said}");
    let full = two.say(&["diff", old, new, "--all"]).stdout;
    assert!(
        full.contains("ridge") && full.contains("world.") && full.lines().count() > said.lines().count(),
        "{full}"
    );

    // Datasets of earlier versions lack the model.
    let model =
        fs::read_dir(two.results.join("datasets")).unwrap().next().unwrap().unwrap().path().join("model.xml");
    let kept = fs::read(&model).unwrap();
    fs::remove_file(&model).unwrap();
    let said = two.say(&["diff", old, new]).stdout;
    assert!(said.contains("lacks its model") && !said.contains("'wall'"), "{said}");
    fs::write(&model, kept).unwrap();

    // The content of a mesh is no text of the MJCF.
    fs::write(two.world.path().join("tip.obj"), MESH.replace("0 0 .03", "0 0 .04")).unwrap();
    let text = fs::read_to_string(two.world.path().join("rod.xml")).unwrap();
    let sites: String = (0..15).map(|number| format!("<site name=\"s{number}\"/>")).collect();
    fs::write(two.world.path().join("rod.xml"), text.replace("<light ", &format!("{sites}<light "))).unwrap();
    two.say(&["run", two.world.path().join("spec.yaml").to_str().unwrap(), "seeds=[5]"]);
    let latest = runs("select run from runs where seed = 5").remove(0);
    let said = two.say(&["diff", new, &latest]).stdout;
    assert!(said.contains("sha256 of mesh tip") && !said.contains("'wall'"), "{said}");
    assert!(said.contains(" parts more differ in the world; --all prints them"), "{said}");
    assert!(!two.say(&["diff", new, &latest, "--all"]).stdout.contains("--all prints"));
    two.say(&["verify"]);
}
