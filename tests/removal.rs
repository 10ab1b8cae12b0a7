//! `harness rm`, `gc`, `du`, `diff` and the choices of `ls`.

use crate::common::{SMOKE, finish, fresh, harness, succeed};
use std::fs;
use std::path::{Path, PathBuf};

const SHORT: [&str; 2] = ["tasks=[prediction]", "training.epochs=1"];

/// A done experiment, a quick one, and a dataset that no run uses.
fn results(name: &str) -> PathBuf {
    let results = fresh(name);
    succeed(&results, &[&["run", SMOKE, "scenarios=[empty]", "seeds=[0,1]"][..], &SHORT].concat());
    succeed(&results, &[&["run", SMOKE, "scenarios=[empty]", "name=smoke-quick"][..], &SHORT].concat());
    succeed(&results, &["collect", SMOKE, "scenarios=[cluttered]"]);
    results
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

#[test]
fn garbage_is_listed_with_its_size_and_removed_only_with_consent() {
    let results = results("garbage");
    let listed = succeed(&results, &["gc"]);
    let lines: Vec<&str> = listed.lines().collect();
    assert!(lines[0].contains("kB  quick       smoke-quick/empty-z4-seed0-"), "{listed}");
    assert!(lines[1].contains("kB  unused      cluttered-"), "{listed}");
    assert!(lines[2].starts_with("2 folders, ") && lines[2].ends_with("; --yes removes them"), "{listed}");
    assert_eq!(names(&results.join("runs")), ["smoke", "smoke-quick"]);
    let removed = succeed(&results, &["gc", "--yes"]);
    assert!(removed.ends_with("2 folders removed\n"), "{removed}");
    assert_eq!(names(&results.join("runs")), ["smoke"]);
    assert_eq!(names(&results.join("datasets")).len(), 1);
    assert_eq!(succeed(&results, &["gc", "--yes"]), "nothing to remove\n");
    assert!(succeed(&results, &["verify"]).contains("all files are intact"));
}

#[test]
fn a_run_of_before_another_one_with_its_settings_is_superseded() {
    let results = results("superseded");
    let (runs, again) = (results.join("runs/smoke"), names(&results.join("runs/smoke")));
    let run = again.iter().find(|name| name.contains("seed0")).unwrap();
    let record = fs::read_to_string(runs.join(run).join("run.json")).unwrap();
    // The same settings on another dataset, a day later.
    let later = run.replace("-seed0-", "-seed0-f");
    let copy = runs.join(&later);
    fs::create_dir(&copy).unwrap();
    for file in names(&runs.join(run)) {
        fs::copy(runs.join(run).join(&file), copy.join(&file)).unwrap();
    }
    let year = record.split("\"started\": \"").nth(1).unwrap()[..4].parse::<u32>().unwrap();
    let record = record.replace(run, &later).replace(
        &format!("\"started\": \"{year}"),
        &format!("\"started\": \"{}", year + 1),
    );
    fs::write(copy.join("run.json"), record).unwrap();
    let listed = succeed(&results, &["gc", "--only", "superseded"]);
    assert!(listed.lines().next().unwrap().ends_with(&format!("superseded  smoke/{run}")), "{listed}");
}

#[test]
fn chosen_runs_are_removed_and_one_in_use_is_kept() {
    let results = results("removed");
    let run = names(&results.join("runs/smoke")).remove(0);
    let file = fs::OpenOptions::new().write(true).open(results.join("runs/smoke").join(&run).join(".unfinished-lock"));
    let lock = file.unwrap();
    lock.lock().unwrap();
    let answer = finish(&mut harness(&results, &["rm", "smoke/", "--yes"]));
    assert_eq!(answer.code, 1);
    assert!(answer.stderr.contains(&format!("smoke/{run} is kept: ")), "{}", answer.stderr);
    assert!(answer.stdout.ends_with("1 folders removed\n"), "{}", answer.stdout);
    assert_eq!(names(&results.join("runs/smoke")), [run]);
    drop(lock);
    succeed(&results, &["rm", "smoke", "--yes"]);
    assert_eq!(names(&results.join("runs")), ["smoke-quick"]);
    let answer = finish(&mut harness(&results, &["rm", "smokeless"]));
    assert_eq!(answer.code, 2);
    assert!(answer.stderr.contains("no run matches 'smokeless'"), "{}", answer.stderr);
}

#[test]
fn two_runs_are_shown_side_by_side() {
    let results = results("diff");
    let runs = names(&results.join("runs/smoke"));
    let shown = succeed(&results, &["diff", &runs[0], &runs[1]]);
    assert!(shown.contains(" seed ") && shown.contains("b - a") && shown.contains("wmape"), "{shown}");
    assert!(!shown.contains("batch_size"), "{shown}");
}

#[test]
fn runs_are_listed_by_experiment_status_and_order() {
    let results = results("listed");
    assert_eq!(succeed(&results, &["ls", "smoke"]).matches("done").count(), 2);
    assert_eq!(succeed(&results, &["ls", "--status", "failed"]).matches("empty-z4").count(), 0);
    let listed = succeed(&results, &["ls", "--sort", "started"]);
    let last = listed.lines().rev().find(|line| line.contains("empty-z4")).unwrap();
    assert!(last.contains("smoke-quick"), "{listed}");
    let used = succeed(&results, &["du"]);
    for part in ["datasets", "runs", "smoke-quick", "in all"] {
        assert!(used.contains(part), "{used}");
    }
}
