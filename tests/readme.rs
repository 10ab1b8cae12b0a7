//! The commands of the README, typed in a copy of the repository, and what they print there.

use crate::common::{ask, finish};
use std::path::Path;
use std::process::Command;
use tempfile::TempDir;

/// A copy of all files that git tracks, where `make run` seems to have built the program.
fn copy_of_the_repository() -> TempDir {
    let (root, folder) = (env!("CARGO_MANIFEST_DIR"), tempfile::tempdir().unwrap());
    let copy = "git ls-files -z | tar --create --null --files-from=- | tar --extract --directory \"$0\"";
    let status = Command::new("bash")
        .args(["-o", "pipefail", "-c", copy])
        .arg(folder.path())
        .current_dir(root)
        .status();
    assert!(status.unwrap().success());
    let built = folder.path().join("target/release");
    std::fs::create_dir_all(&built).unwrap();
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_harness"), built.join("harness")).unwrap();
    folder
}

/// A command of a page, and the output that the page prints below it.
struct Step {
    command: String,
    output: Option<String>,
}

/// The commands in a section of a page. They are indented. Those with an output begin with `$`.
fn steps(page: &str, heading: &str) -> Vec<Step> {
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(page)).unwrap();
    let section = text.split("\n## ").find(|section| section.starts_with(heading)).unwrap();
    let mut steps: Vec<Step> = Vec::new();
    let mut is_output = false;
    for line in section.lines() {
        let Some(line) = line.strip_prefix("    ") else {
            is_output = false;
            continue;
        };
        match line.strip_prefix("$ ") {
            Some(command) => {
                steps.push(Step { command: command.into(), output: Some(String::new()) });
                is_output = true;
            }
            None if is_output => {
                let output = steps.last_mut().and_then(|step| step.output.as_mut()).unwrap();
                *output += &format!("{line}\n");
            }
            None => steps.push(Step { command: line.into(), output: None }),
        }
    }
    steps
}

/// A text in which numbers with decimals, times and the folder are replaced, because they depend on the machine.
/// Several spaces are one, because the width of a column depends on its numbers.
fn stable(text: &str, folder: &Path) -> Vec<String> {
    let text = text.replace(&*folder.to_string_lossy(), "/path/to/harness");
    let word = |word: &str| {
        let bare = word.trim_matches(|c: char| !c.is_ascii_alphanumeric());
        let is_time = bare.len() == 20 && bare.ends_with('Z') && bare.contains('T');
        let is_number = bare.contains('.') && bare.parse::<f64>().is_ok();
        if is_time || is_number { "N".to_owned() } else { word.to_owned() }
    };
    let line = |line: &str| line.split_whitespace().map(word).collect::<Vec<_>>().join(" ");
    text.lines().map(line).collect()
}

/// Types every step, in order. All must succeed and print what the page says. A line with `…` stands for any lines.
fn follow(steps: &[Step], folder: &Path) {
    let aliases: Vec<&str> = steps
        .iter()
        .map(|step| step.command.as_str())
        .filter(|command| command.starts_with("alias "))
        .collect();
    for Step { command, output } in steps {
        let mut shell = Command::new("bash");
        shell.args(["-O", "expand_aliases", "-c", &format!("{}\n{command}", aliases.join("\n"))]);
        shell.current_dir(folder).env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
        let answer = finish(&mut assert_cmd::Command::from_std(shell));
        assert_eq!(answer.code, 0, "{command}: {}{}", answer.stdout, answer.stderr);
        let Some(expected) = output else { continue };
        let (printed, expected) = (stable(&answer.stdout, folder), stable(expected, folder));
        let mut rest = printed.as_slice();
        for part in expected.split(|line| line == "…").filter(|part| !part.is_empty()) {
            let place = rest.windows(part.len()).position(|lines| lines == part);
            let place =
                place.unwrap_or_else(|| panic!("{command} does not print\n{part:#?}\nbut\n{printed:#?}"));
            rest = &rest[place + part.len()..];
        }
    }
}

#[test]
fn the_first_five_minutes_work_as_printed() {
    let steps = steps("README.md", "The first five minutes");
    assert!(steps.len() > 10 && steps.iter().any(|step| step.output.is_some()), "{} steps", steps.len());
    let folder = copy_of_the_repository();
    follow(&steps, folder.path());
    for file in ["instant.png", "figures/regression.svg", "report.html"] {
        assert!(folder.path().join(file).is_file(), "{file}");
    }
    // The first result is a success: the network is better than all baselines.
    let r2 = "select model, value from metrics where experiment = 'first' and metric = 'r2' and index is null and \
              direction is null";
    for row in ask(&folder.path().join("results"), r2) {
        let (model, r2) = (row["model"].as_str().unwrap(), row["value"].as_f64().unwrap());
        assert!(if model == "network" { r2 > 0.65 } else { r2 < 0.6 }, "{model}: {r2}");
    }
}

/// Builds the program for release, unless it is built already, and trains for minutes.
#[test]
#[ignore = "minutes: `make soak` runs it"]
fn make_run_trains_the_recommended_network_as_printed() {
    let readme = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md")).unwrap();
    let words: Vec<&str> = readme.split_whitespace().collect();
    let promised =
        words.windows(8).find(|words| words[..7] == ["R2", "of", "the", "mean", "contact", "force", "is"]);
    let promised: f64 = promised.unwrap()[7].trim_end_matches('.').parse().unwrap();
    let folder = copy_of_the_repository();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    std::os::unix::fs::symlink(root.join(".venv"), folder.path().join(".venv")).unwrap();
    let mut make = Command::new("make");
    make.arg("run").current_dir(folder.path()).env("CARGO_TARGET_DIR", root.join("target"));
    make.env_remove("MAKEFLAGS").env_remove("MAKELEVEL");
    let answer = finish(&mut assert_cmd::Command::from_std(make));
    assert_eq!(answer.code, 0, "{}{}", answer.stdout, answer.stderr);
    let force = answer.stdout.lines().find(|line| line.starts_with("contact force mean  R2")).unwrap();
    let r2: f64 = force.split_whitespace().nth(5).unwrap().trim_start_matches('*').parse().unwrap();
    assert!((r2 - promised).abs() < 0.02, "the README promises {promised}: {force}");
}
