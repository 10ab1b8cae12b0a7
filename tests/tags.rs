//! `harness tag`, and the tags that `harness ls` shows.

use crate::common::{SMOKE, finish, fresh, harness, succeed};
use harness::registry::Registry;
use std::fs;
use std::path::{Path, PathBuf};

const SHORT: [&str; 3] = ["tasks=[prediction]", "training.epochs=1", "scenarios=[empty]"];

/// Results with two runs of the smoke experiment.
fn results(name: &str) -> PathBuf {
    let results = fresh(name);
    succeed(&results, &[&["run", SMOKE, "seeds=[0,1]"][..], &SHORT].concat());
    results
}

/// The tags of the runs that `ls` lists with these options.
fn tags(results: &Path, more: &[&str]) -> Vec<String> {
    let said = succeed(results, &[&["ls", "--format", "json"][..], more].concat());
    let rows: Vec<serde_json::Value> = serde_json::from_str(&said).unwrap();
    rows.iter().map(|row| row["tags"].as_str().unwrap_or_default().to_owned()).collect()
}

/// The bytes of the runs' records.
fn records(results: &Path) -> Vec<Vec<u8>> {
    let recorded = Registry::new(results).recorded();
    recorded.iter().map(|(folder, _)| fs::read(folder.join("run.json")).unwrap()).collect()
}

#[test]
fn tags_are_listed_selected_and_taken_away() {
    let results = results("tags");
    let untagged = succeed(&results, &["ls"]);
    let before = records(&results);
    let [first, second] = [0, 1].map(|place| Registry::new(&results).records()[place].name());

    assert_eq!(succeed(&results, &["tag", "smoke", "paper"]), "2 runs with the tag paper\n");
    assert_eq!(succeed(&results, &["tag", &first, "best"]), "1 run with the tag best\n");
    assert_eq!(succeed(&results, &["tag", "smoke", "best"]), "2 runs with the tag best, 1 before\n");
    assert_eq!(succeed(&results, &["tag", &second, "best", "--remove"]), "1 run without the tag best\n");
    assert_eq!(tags(&results, &[]), ["best paper", "paper"]);
    assert_eq!(tags(&results, &["--tag", "best"]), ["best paper"]);
    let page = succeed(&results, &["ls"]);
    assert!(page.contains("tags") && page.contains("best paper"), "{page}");
    let unknown = finish(&mut harness(&results, &["ls", "--tag", "bst"]));
    assert_eq!(
        (unknown.code, &*unknown.stderr),
        (2, "error: no run has the tag 'bst'; the tags are best, paper\n")
    );

    // Tags change no record, and no copy of the results has them.
    assert!(before == records(&results));
    let copy = fresh("tags_published");
    succeed(&results, &["publish", "smoke", "--output", copy.to_str().unwrap()]);
    assert!(!copy.join("tags.json").exists());
    succeed(&results, &["tag", "smoke", "paper", "--remove"]);
    succeed(&results, &["tag", "smoke", "best", "--remove"]);
    assert_eq!(succeed(&results, &["ls"]), untagged);
    let none = finish(&mut harness(&results, &["ls", "--tag", "best"])).stderr;
    assert_eq!(none, "error: no run has the tag 'best'; no run has any\n");
}

#[test]
fn wrong_tags_and_damaged_files_are_named() {
    let results = results("tags_wrong");
    for (arguments, problem) in [
        (
            &["tag", "smoke", "two words"][..],
            "'two words' can't be a tag; a tag consists of letters, digits, ",
        ),
        (&["tag", "smoke/empty", "smoke/cluttered"], "'smoke/cluttered' can't be a tag"),
        (&["tag", "smok/", "best"], "no run matches 'smok/'"),
        (&["tag", "smoke"], "required arguments were not provided"),
    ] {
        let answer = finish(&mut harness(&results, arguments));
        assert!(answer.code == 2 && answer.stderr.contains(problem), "{arguments:?}: {}", answer.stderr);
    }
    let file = results.join("tags.json");
    assert!(!file.exists());
    succeed(&results, &["tag", "smoke", "best"]);
    let whole = fs::read_to_string(&file).unwrap();
    fs::write(&file, whole.replace("best", "rest")).unwrap();
    for arguments in [&["ls"][..], &["tag", "smoke", "more"]] {
        let answer = finish(&mut harness(&results, arguments));
        let said = format!("{} is damaged (", file.display());
        assert!(answer.code == 1 && answer.stderr.contains(&said), "{}", answer.stderr);
        assert!(answer.stderr.contains("remove it, and tag the runs again"), "{}", answer.stderr);
    }
}

#[test]
fn tags_that_many_processes_give_at_once_are_all_there() {
    let results = results("tags_at_once");
    let names: Vec<String> = (0..12).map(|number| format!("tag-{number:02}")).collect();
    std::thread::scope(|scope| {
        for name in &names {
            scope.spawn(|| succeed(&results, &["tag", "smoke", name]));
        }
    });
    for tags in tags(&results, &[]) {
        assert_eq!(tags, names.join(" "));
    }
}
