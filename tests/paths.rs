//! Every command with folders and files whose names are patterns to other programs, or must be quoted for a shell.

use crate::common::{Answer, copy_folder, finish, harness, succeed};
use crate::suggestions::{shell_in, suggested};
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use tempfile::TempDir;

/// The name of a folder. As a pattern, it matches [`DECOY`] and not itself.
const STRANGE: &str = "it's [a]=*? #1 50% \"ü日\" $HOME";
/// The name of another folder with other results, which no command may read or change.
const DECOY: &str = "it's a=xy #1 50% \"ü日\" $HOME";

const ROBOT: &str = r#"<mujoco><option timestep="0.005"/><visual><quality shadowsize="0" offsamples="0"/></visual>
  <worldbody><light pos="0 -1 2"/><geom name="floor" type="plane" size="2 2 .1"/>
  <camera name="side" pos="0 -1.6 .7" xyaxes="1 0 0 0 0 1"/>
  <body name="cart" pos="0 0 .8"><joint name="slide" type="slide" axis="1 0 0" range="-.5 .5" damping="2"/>
    <geom name="cart" type="box" size=".06 .05 .03" mass="1"/></body></worldbody>
  <actuator><position name="push" joint="slide" kp="200" ctrlrange="-.4 .4"/></actuator></mujoco>"#;

const WORLD: &str = "model: robot.xml\nstep_rate_hz: 200\nsample_rate_hz: 10\nmodalities: {place: {joint_positions: slide}}\n\
                     action: {seconds: 1, actuators: {push: {actuator: push, unit: m, range: [-0.4, 0.4]}}}\n";

const SPEC: &str = "name: NAME\nscenarios: robot.yaml\ninput: place\noutput: place\nlatent: 2\nseeds: [0, 1]\n\
                    network: {preset: multi_to_multi, hidden: [8]}\ntasks: prediction\n\
                    simulation: {episodes: 4, actuations_per_episode: 2}\ntraining: {epochs: 2, batch_size: 16}\n";

/// A folder with a strange name beside its decoy, and everything that the program says about it.
struct Place {
    folder: TempDir,
    said: String,
}

impl Place {
    fn new() -> Self {
        let place = Self { folder: tempfile::tempdir().unwrap(), said: String::new() };
        for (folder, name) in [(STRANGE, "strange"), (DECOY, "decoy")] {
            let folder = place.folder.path().join(folder);
            fs::create_dir(&folder).unwrap();
            let files =
                [("robot.xml", ROBOT), ("robot.yaml", WORLD), ("spec.yaml", &SPEC.replace("NAME", name))];
            files.iter().for_each(|(file, text)| fs::write(folder.join(file), text).unwrap());
        }
        let decoy = place.folder.path().join(DECOY);
        succeed(&decoy.join("results"), &["run", decoy.join("spec.yaml").to_str().unwrap()]);
        place
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(STRANGE).join(name).to_str().unwrap().to_owned()
    }

    fn answer(&mut self, arguments: &[&str]) -> Answer {
        let answer = finish(&mut harness(Path::new(&self.path("results")), arguments));
        self.said += &format!("{}{}\n", answer.stdout, answer.stderr);
        answer
    }

    /// Runs a command that must succeed and say nothing about the decoy, and returns what it printed.
    #[track_caller]
    fn succeed(&mut self, arguments: &[&str]) -> String {
        let Answer { code, stdout, stderr } = self.answer(arguments);
        assert_eq!(code, 0, "{arguments:?}: {stdout}{stderr}");
        assert!(!stdout.contains("decoy") && !stderr.contains("decoy"), "{arguments:?}: {stdout}{stderr}");
        stdout
    }

    /// Runs a command that must write this file or folder.
    #[track_caller]
    fn writes(&mut self, name: &str, arguments: &[&str]) -> String {
        let path = self.path(name);
        self.succeed(&[arguments, &["--output", &path]].concat());
        assert!(Path::new(&path).exists(), "{arguments:?} did not write {path}");
        path
    }
}

/// All files in a folder with their contents.
fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut entries: Vec<PathBuf> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    let of = |path: PathBuf| match path.is_dir() {
        true => contents(&path),
        false => vec![(path.clone(), fs::read(path).unwrap())],
    };
    entries.into_iter().flat_map(of).collect()
}

#[test]
fn every_command_takes_paths_as_they_are() {
    let mut place = Place::new();
    let decoy = place.folder.path().join(DECOY);
    let before = contents(&decoy);
    let [spec, world, model] = ["spec.yaml", "robot.yaml", "robot.xml"].map(|name| place.path(name));

    place.writes("drafted.yaml", &["world", "new", &model]);
    place.succeed(&["world", "check", &world]);
    place.succeed(&["world", "check", &world, "--render", &place.path("pictures [*]")]);
    place.succeed(&["schema", "--tables", "--world", &world]);
    place.succeed(&["validate", &spec]);
    place.succeed(&["run", &spec, "--dry-run"]);
    place.succeed(&["submit", &spec, "--dry-run"]);
    let collected = place.succeed(&["collect", &spec]);
    assert!(collected.contains(STRANGE), "{collected}");
    place.succeed(&["task", &spec]);
    for done in ["2 done, 0 done before, 0 failed", "0 done, 2 done before, 0 failed"] {
        let said = place.succeed(&["run", &spec]);
        assert!(said.contains(done), "{said}");
    }
    place.succeed(&["judge", &spec, "simulator", "output=[place]"]);

    for command in [
        &["ls"][..],
        &["ls", "strange"],
        &["watch", "--once"],
        &["doctor"],
        &["verify"],
        &["compare"],
        &["query", "select count(run) from metrics"],
        &["query", "select count(sample) from episodes"],
        &["query", "select command from runs"],
    ] {
        place.succeed(command);
    }
    let [first, second] = ["strange/robot-z2-seed0", "strange/robot-z2-seed1"];
    place.succeed(&["show", first, "--all"]);
    let runs = Path::new(&place.path("results")).join("runs/strange");
    let folder = fs::read_dir(runs).unwrap().map(|entry| entry.unwrap().path()).next().unwrap();
    place.succeed(&["show", folder.to_str().unwrap()]);
    place.succeed(&["diff", first, second]);

    place.writes("answer.csv", &["query", "select run, metric, value from metrics"]);
    place.writes("list.json", &["ls"]);
    place.writes("means.parquet", &["compare", "strange"]);
    place.writes("plot.svg", &["plot", "--x", "simulation.seed", "--metrics", "r2", "--by", "variant"]);
    place.writes("figures", &["figures", "--experiment", "strange"]);
    place.writes("report.html", &["report", "strange"]);
    place.writes("all.html", &["report"]);
    place.writes("scene.png", &["render", &world]);
    place.writes("clip.gif", &["render", &world, "--spec", &spec, "--episode", "1"]);
    place.writes("ahead.png", &["render", first, "--horizon", "1"]);
    let claims = place.path("claims.yaml");
    fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments/claims.yaml"), &claims).unwrap();
    place.writes("verdicts.csv", &["claims", "--file", &claims]);
    place.succeed(&["export", "--format", "onnx", first, &place.path("network.onnx")]);
    let published = place.writes("published", &["publish", "strange"]);
    let moved = place.writes("moved", &["publish", "strange", "--complete"]);
    for results in [published, moved] {
        let answer = finish(&mut harness(Path::new(&results), &["compare", "strange"]));
        assert_eq!(answer.code, 0, "{results}: {}", answer.stderr);
        place.said += &format!("{}{}\n", answer.stdout, answer.stderr);
    }
    assert!(!fs::read(place.path("network.onnx")).unwrap().is_empty());

    // Wrong names and damaged files, for what is suggested then.
    for wrong in [
        &["show", "strange/none"][..],
        &["query", "select nothing from runs"],
        &["compare", "stranger"],
        &["figures", "regression"],
        &["claims"],
    ] {
        place.answer(wrong);
    }
    let damaged = folder.join("metrics.parquet");
    fs::write(&damaged, "damaged").unwrap();
    for command in
        [&["verify"][..], &["query", "select count(run) from metrics"], &["run", &spec, "--dry-run"]]
    {
        place.answer(command);
    }

    // What is suggested is typed in another folder.
    let elsewhere = tempfile::tempdir().unwrap();
    let mut suggested = suggested(&place.said);
    // A text may also name a command alone, such as `harness render`.
    suggested.retain(|command| command.contains("ü日"));
    assert!(suggested.len() >= 7, "{suggested:#?}");
    // The run is repaired first.
    let (repairs, others): (Vec<_>, Vec<_>) =
        suggested.into_iter().partition(|command| command.contains("spec.yaml"));
    for command in repairs.into_iter().chain(others) {
        // Those of other experiments take hours.
        let takes_hours = command.contains(" run ") && !command.contains("spec.yaml");
        let code = shell_in(
            elsewhere.path(),
            &if takes_hours { format!("{command} --dry-run") } else { command.clone() },
        );
        assert!(code == 0 || command.ends_with(" verify") && code == 1, "{command} ends with {code}");
    }
    place.succeed(&["verify"]);
    place.succeed(&["rm", second, "--yes"]);
    place.succeed(&["gc", "--yes"]);
    assert_eq!(contents(&decoy), before);
}

#[test]
fn the_page_of_a_folder_with_a_strange_name_is_served() {
    let place = Place::new();
    let [results, decoy] = [STRANGE, DECOY].map(|name| place.folder.path().join(name).join("results"));
    copy_folder(&decoy, &results);
    let mut server = Command::new(env!("CARGO_BIN_EXE_harness"))
        .args(["--results", results.to_str().unwrap(), "serve", "--port", "0"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(server.stdout.take().unwrap()).read_line(&mut line).unwrap();
    server.kill().unwrap();
    server.wait().unwrap();
    assert!(line.contains("http://127.0.0.1:"), "{line}");
}
