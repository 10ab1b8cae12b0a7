//! `harness publish` on real runs: which rows are copied, and that the copy can be read like any results folder.

use crate::common::{SMOKE, finish, fresh, harness, succeed};
use harness::files::FolderLock;
use harness::progress::Silent;
use harness::registry::Registry;
use harness::transfer;
use polars::prelude::{CsvReader, DataFrame, SerReader};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// Runs of two seeds in each scenario, and a sweep of one setting in the empty scenario.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| {
    let results = fresh("published-from");
    succeed(&results, &["run", SMOKE, "seeds=[3,5]"]);
    let sweep = ["scenarios=[empty]", "name=sweep", "vary={training.kl_weight: [0, 0.01]}"];
    succeed(&results, &[&["run", SMOKE][..], &sweep].concat());
    results
});

fn publish(to: &Path) -> String {
    succeed(&RESULTS, &["publish", "smoke", "sweep", "--output", to.to_str().unwrap()])
}

/// The rows of a query's answer, as CSV.
fn csv(results: &Path, sql: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("answer.csv");
    succeed(results, &["query", sql, "--output", path.to_str().unwrap()]);
    std::fs::read_to_string(path).unwrap()
}

/// The rows of a query's answer, without the commands that made the runs.
fn table_without_command(results: &Path, sql: &str) -> DataFrame {
    let csv = std::io::Cursor::new(csv(results, sql));
    CsvReader::new(csv).finish().unwrap().drop_many(["command"])
}

/// The bytes of every file below a folder, by path.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.insert(path.clone(), std::fs::read(&path).unwrap());
        }
    }
    found
}

#[test]
fn predictions_of_the_first_test_episodes_are_copied() {
    let (results, copy) = (fresh("published_many"), fresh("published_few"));
    let vectors =
        ["scenarios=[empty]", "input=[proprioception]", "output=[proprioception]", "tasks=[prediction]"];
    let more = ["network.preset=single_to_multi", "test.episodes=22", "test.seed=0"];
    succeed(&results, &[&["run", SMOKE][..], &vectors, &more].concat());
    succeed(&results, &["publish", "smoke", "--output", copy.to_str().unwrap()]);
    let sql = "select count(distinct episode) as n, max(episode) as last from predictions";
    assert_eq!(csv(&results, sql), "n,last\n22,21\n");
    assert_eq!(csv(&copy, sql), "n,last\n20,19\n");
    let again = fresh("published_few_again");
    succeed(&copy, &["publish", "smoke", "--output", again.to_str().unwrap()]);
    assert_eq!(csv(&again, sql), "n,last\n20,19\n");
}

#[test]
fn a_copy_of_a_copy_is_complete() {
    let (copy, again) = (fresh("published_twice"), fresh("published_again"));
    let of_seed = |seed: &str| {
        let to = ["--output", copy.to_str().unwrap(), "--where", seed];
        succeed(&RESULTS, &[&["publish", "smoke"][..], &to].concat());
    };
    // Each call keeps the single samples of its lowest seed.
    of_seed("seed=5");
    of_seed("seed=3");
    succeed(&copy, &["publish", "smoke", "--output", again.to_str().unwrap()]);
    assert_eq!(files(&copy.join("runs")).len(), files(&again.join("runs")).len());
    let frames = "select count(*) as n, count(distinct run) as runs from frames";
    assert_eq!(csv(&again, frames), csv(&copy, frames));
    assert!(csv(&copy, frames).ends_with(",4\n"), "{}", csv(&copy, frames));
}

#[test]
fn a_published_registry_answers_all_but_single_samples_the_same() {
    let copy = fresh("published");
    assert!(publish(&copy).starts_with("6 runs, "));
    for (table, order) in [
        ("runs", "run"),
        ("epochs", "run, task, epoch, split, term"),
        ("metrics", "run, task, model, modality, metric, index, direction"),
    ] {
        let sql = format!("select * from {table} order by {order}");
        let [copied, all] = [&copy, &*RESULTS].map(|results| table_without_command(results, &sql));
        assert!(copied.equals_missing(&all), "{table}: {copied} {all}");
    }
    let commands = "select distinct command from runs";
    assert!(csv(&RESULTS, commands).contains("--results"));
    assert!(!csv(&copy, commands).contains("--results"), "a copy names the folder that it was copied from");
    let of_smoke = "where experiment = 'smoke' and seed = 3";
    let single = format!(
        "select * from predictions {of_smoke} and index >= 18 order by run, task, modality, index, episode, sample"
    );
    let kept = csv(&copy, &single);
    assert!(kept.lines().count() > 100, "{kept}");
    assert_eq!(kept, csv(&RESULTS, &single));
    let others =
        "select count(run) as n from predictions where index < 18 or (experiment = 'smoke' and seed = 5)";
    assert_eq!(csv(&copy, others), "n\n0\n");
    for table in ["predictions", "frames"] {
        let of_the_sweep = format!("select count(run) as n from {table} where experiment = 'sweep'");
        assert_eq!(csv(&copy, &of_the_sweep), "n\n0\n", "{table}");
        assert_ne!(csv(&RESULTS, &of_the_sweep), "n\n0\n", "{table}");
    }
    let pictures =
        "select distinct experiment, scenario, seed from frames order by experiment, scenario, seed";
    assert!(!csv(&copy, pictures).contains(",5\n"), "{}", csv(&copy, pictures));
    let forces = "select distinct experiment, scenario, modality, index, mean from forces where episode is null order \
                  by experiment, scenario, modality, index";
    assert_eq!(csv(&copy, forces), csv(&RESULTS, forces));
    let runs =
        "select experiment, scenario, count(distinct run) as runs from forces group by all order by all";
    assert_eq!(
        csv(&copy, runs),
        "experiment,scenario,runs\nsmoke,cluttered,1\nsmoke,empty,1\nsweep,empty,1\n"
    );

    assert!(succeed(&copy, &["verify"]).contains("6 runs, 0 datasets, 12 files: all files are intact"));
    let networks = files(&copy).keys().filter(|path| path.extension().unwrap() == "safetensors").count();
    assert_eq!(networks, 0);
}

#[test]
fn what_varies_has_cells_of_its_own() {
    let variants =
        csv(&RESULTS, "select distinct experiment, variant from metrics order by experiment, variant");
    assert_eq!(variants, "experiment,variant\nsmoke,\"\"\nsweep,kl_weight=0\nsweep,kl_weight=0.01\n");
    let compared = succeed(&RESULTS, &["compare", "sweep", "--by", "variant", "--models", "network"]);
    assert!(compared.contains("kl_weight=0.01"), "{compared}");
}

/// Unless told otherwise, Polars reads `kl_weight=0` in a path as the value of a partition.
#[test]
fn a_single_run_of_a_sweep_can_be_queried() {
    let results = fresh("published-single");
    succeed(
        &results,
        &["run", SMOKE, "scenarios=[empty]", "vary={training.kl_weight: [0]}", "tasks=[prediction]"],
    );
    assert_eq!(csv(&results, "select count(run) as n from runs"), "n\n1\n");
    assert_eq!(csv(&results, "select distinct variant from metrics"), "variant\nkl_weight=0\n");
}

#[test]
fn each_reading_and_role_keeps_the_forces_of_one_run_a_dataset() {
    let (results, copy) = (fresh("published-readings-from"), fresh("published-readings"));
    let readings = "\nvary: {role: {smoke: {}}}\nreadings:\n  - {name: narrow, choice: the width, base: wide, instead: \
                    narrow, paper: none, settings: {network.hidden: [8]}}\n";
    let folder = tempfile::tempdir().unwrap();
    let spec = folder.path().join("readings.yaml");
    std::fs::write(&spec, std::fs::read_to_string(SMOKE).unwrap() + readings).unwrap();
    let overrides = ["name=readings", "scenarios=[empty]", "tasks=[prediction]", "seeds=[0,1]"];
    succeed(&results, &[&["run", spec.to_str().unwrap()][..], &overrides].concat());
    succeed(&results, &["publish", "readings", "--output", copy.to_str().unwrap()]);
    let forces = "select variant, count(distinct run) as runs from forces group by variant order by variant";
    let of_one_run_each = "variant,runs\n\"reading=base,role=smoke\",1\n\"reading=narrow,role=smoke\",1\n";
    assert_eq!(csv(&copy, forces), of_one_run_each);
}

#[test]
fn networks_are_copied_if_they_are_asked_for() {
    let (with, without) = (fresh("published-networks"), fresh("published-no-networks"));
    let to = |copy: &Path| ["publish", "smoke", "--output", copy.to_str().unwrap()].map(str::to_owned);
    let [with_arguments, without_arguments] = [&with, &without].map(|copy| to(copy));
    let arguments: Vec<&str> = with_arguments.iter().map(String::as_str).chain(["--networks"]).collect();
    succeed(&RESULTS, &arguments);
    succeed(&RESULTS, &without_arguments.each_ref().map(String::as_str));
    let folder = tempfile::tempdir().unwrap();
    let onnx = |results: &Path, name: &str| {
        let path = folder.path().join(name);
        let run = "smoke/empty-z4-seed3";
        let export = ["export", "--format", "onnx", run, path.to_str().unwrap()];
        let answer = finish(&mut harness(results, &export));
        (answer.code, answer.stderr, std::fs::read(path).unwrap_or_default())
    };
    let (original, copied) = (onnx(&RESULTS, "original.onnx"), onnx(&with, "copied.onnx"));
    assert_eq!((original.0, copied.0), (0, 0), "{} {}", original.1, copied.1);
    assert!(original.2 == copied.2);
    let (code, said, _) = onnx(&without, "none.onnx");
    assert!(code == 1 && said.contains("unless they were published with --networks"), "{code} {said}");
    succeed(&with, &["verify"]);
}

#[test]
fn a_published_run_is_removed_and_the_others_keep_their_rows() {
    let copy = fresh("published-removed");
    publish(&copy);
    let rows = "select * from metrics where run like 'cluttered%' order by run, task, model, modality, metric, index";
    let before = csv(&copy, rows);
    let said = succeed(&copy, &["rm", "smoke/empty", "--yes"]);
    assert!(said.ends_with("2 folders removed\n"), "{said}");
    assert_eq!(csv(&copy, rows), before);
    assert!(succeed(&copy, &["verify"]).contains("4 runs, 0 datasets, "));
    succeed(&copy, &["rm", "smoke", "sweep", "--yes"]);
    assert_eq!(files(&copy.join("runs")).len(), 0);
    // What is published later is added.
    succeed(&RESULTS, &["publish", "smoke", "--where", "seed=5", "--output", copy.to_str().unwrap()]);
    succeed(&RESULTS, &["publish", "smoke", "--where", "seed=3", "--output", copy.to_str().unwrap()]);
    assert_eq!(csv(&copy, rows), before);
    assert!(succeed(&copy, &["show", "smoke/empty-z4-seed3"]).contains("runs/smoke"));
    let said = succeed(&copy, &["run", SMOKE, "seeds=[3,5]", "--dry-run"]);
    assert!(said.contains("done") && !said.contains("damaged"), "{said}");
}

/// A process may be killed after each of the files that it writes.
#[test]
fn an_interrupted_replacement_leaves_the_old_runs_or_the_new_ones() {
    let (copy, full) = (fresh("published-killed"), fresh("published-killed-full"));
    let to = |copy: &Path| ["publish", "smoke", "--output", copy.to_str().unwrap()].map(str::to_owned);
    succeed(&RESULTS, &to(&full).each_ref().map(String::as_str));
    let some = to(&copy);
    succeed(&RESULTS, &[&some.each_ref().map(String::as_str)[..], &["--where", "seed=3"]].concat());
    let (old, new) = (copy.join("runs/smoke"), full.join("runs/smoke"));
    let sql = "select run, count(*) as n, sum(value) as sum from metrics group by run order by run";
    let [before, after] = [&copy, &full].map(|results| csv(results, sql));
    assert_ne!(before, after);
    for (path, bytes) in files(&new).into_iter().filter(|(path, _)| !path.ends_with("records.json")) {
        let name = path.file_name().unwrap().to_str().unwrap();
        std::fs::write(old.join(format!("{name}.new")), bytes).unwrap();
        assert_eq!(csv(&copy, sql), before);
    }
    std::fs::copy(new.join("records.json"), old.join("records.json")).unwrap();
    assert_eq!(csv(&copy, sql), after);
    succeed(&RESULTS, &some.each_ref().map(String::as_str));
    assert!(files(&old).into_values().eq(files(&new).into_values()));
}

#[test]
fn damage_to_what_published_runs_share_is_found() {
    let copy = fresh("published-damaged");
    publish(&copy);
    for name in ["metrics.parquet", "records.json"] {
        let path = copy.join("runs/smoke").join(name);
        let mut bytes = std::fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        std::fs::write(&path, &bytes).unwrap();
        let answer = finish(&mut harness(&copy, &["verify"]));
        let said = "; restore it from version control, or remove the folder and publish its runs again\n";
        assert!(answer.code == 1 && answer.stdout.contains(name), "{}", answer.stdout);
        assert!(answer.stdout.contains(said), "{}", answer.stdout);
        let answer = finish(&mut harness(&copy, &["query", "select count(value) from metrics"]));
        assert!(answer.stderr.contains(name), "{}", answer.stderr);
        bytes[middle] ^= 1;
        std::fs::write(&path, &bytes).unwrap();
    }
    succeed(&copy, &["verify"]);
    let answer = finish(&mut harness(&copy, &complete(&fresh("published-complete"), "smoke")));
    assert!(answer.code == 1 && answer.stderr.contains("publish it without --complete"), "{}", answer.stderr);
}

/// No repair that `verify` proposes removes what a published run still needs.
#[test]
fn what_published_runs_need_is_never_to_be_removed() {
    let copy = fresh("published-needed");
    let out = copy.to_str().unwrap();
    succeed(&RESULTS, &["publish", "smoke", "--networks", "--output", out]);
    let folder = copy.join("runs/smoke");
    let verify = || finish(&mut harness(&copy, &["verify"]));
    // An interruption after the list was replaced.
    std::fs::rename(folder.join("metrics.parquet"), folder.join("metrics.parquet.new")).unwrap();
    let answer = verify();
    assert!(
        answer.code == 0 && answer.stdout.contains("an interrupted command did not rename"),
        "{}",
        answer.stdout
    );
    assert!(!answer.stdout.contains("rm "), "{}", answer.stdout);
    succeed(&copy, &["compare"]);
    succeed(&RESULTS, &["publish", "smoke", "--networks", "--output", out]);
    assert!(folder.join("metrics.parquet").is_file() && !folder.join("metrics.parquet.new").exists());
    // A list that is damaged, and one that is gone.
    let list = folder.join("records.json");
    let text = std::fs::read(&list).unwrap();
    for damaged in [Some(&text[..text.len() / 2]), None] {
        std::fs::remove_file(&list).unwrap();
        damaged.into_iter().for_each(|bytes| std::fs::write(&list, bytes).unwrap());
        let answer = verify();
        assert!(answer.code == 1 && answer.stdout.contains("records.json: "), "{}", answer.stdout);
        assert!(answer.stdout.contains("1 broken") && !answer.stdout.contains("rm "), "{}", answer.stdout);
        std::fs::write(&list, &text).unwrap();
    }
    assert_eq!(verify().code, 0);
    // The networks of a run.
    let run =
        std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()).find(|path| path.is_dir());
    std::fs::remove_dir_all(run.unwrap()).unwrap();
    let answer = verify();
    assert!(answer.code == 1 && answer.stdout.contains(".safetensors: "), "{}", answer.stdout);
}

#[test]
fn publishing_again_changes_nothing() {
    let copy = fresh("published-twice");
    publish(&copy);
    let before = files(&copy);
    publish(&copy);
    assert!(before == files(&copy), "the same runs were published with other bytes");
}

#[test]
fn a_table_can_be_left_out() {
    let copy = fresh("published-without");
    publish(&copy);
    let without = ["--without", "forces", "--without", "predictions", "--output", copy.to_str().unwrap()];
    succeed(&RESULTS, &[&["publish", "smoke"][..], &without].concat());
    for table in ["forces", "predictions", "all_predictions"] {
        let sql = format!("select count(*) as n from {table} where experiment = 'smoke'");
        assert_eq!(csv(&copy, &sql), "n\n0\n");
    }
    assert_ne!(csv(&copy, "select count(*) as n from frames"), "n\n0\n");
    let metrics =
        "select * from metrics where experiment = 'smoke' order by run, task, model, modality, metric, index";
    assert_eq!(csv(&copy, metrics), csv(&RESULTS, metrics));
    succeed(&copy, &["verify"]);
    let answer = finish(&mut harness(&RESULTS, &["publish", "smoke", "--without", "metrics"]));
    assert!(
        answer.code == 2 && answer.stderr.contains("[possible values: predictions, frames, forces, sums]")
    );
}

#[test]
fn a_copy_that_another_process_works_on_is_not_written() {
    let copy = fresh("published-locked");
    publish(&copy);
    let before = files(&copy);
    let is_hidden = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().starts_with('.');
    assert!(!before.keys().any(is_hidden), "a lock is left among the copies");
    let folder = before.keys().next().unwrap().parent().unwrap();
    let lock = FolderLock::attempt(folder).unwrap().unwrap();
    let arguments = ["publish", "smoke", "sweep", "--output", copy.to_str().unwrap()];
    let answer = finish(&mut harness(&RESULTS, &arguments));
    let said = format!("works in {}; try again when it has ended", folder.display());
    assert!(answer.code == 1 && answer.stderr.contains(&said), "{}", answer.stderr);
    lock.remove(folder);
    assert!(before == files(&copy));
}

#[test]
fn republishing_keeps_chosen_runs_and_the_copy_of_a_damaged_one() {
    let (results, copy) = (fresh("published-alike-from"), fresh("published-alike"));
    for epochs in ["training.epochs=1", "training.epochs=2"] {
        succeed(&results, &["run", SMOKE, "scenarios=[empty]", "tasks=[prediction]", epochs]);
    }
    let registry = Registry::new(&results);
    let records = registry.records();
    assert!(records.len() == 2 && records[0].spec.label() == records[1].spec.label());
    let folders: Vec<PathBuf> =
        records.iter().map(|record| results.join("runs/smoke").join(&record.run)).collect();
    let publish = || {
        let chosen = folders.iter().map(PathBuf::as_path).zip(&records);
        transfer::publish(&registry, chosen, &Registry::new(&copy), transfer::Content::default(), &Silent)
            .map(|published| published.runs)
    };
    assert_eq!(publish().unwrap(), 2);
    let before = files(&copy);
    assert_eq!(publish().unwrap(), 2);
    assert!(before == files(&copy));
    std::fs::write(folders[1].join("metrics.parquet"), "damaged").unwrap();
    publish().unwrap_err();
    assert!(before == files(&copy));
}

#[test]
fn of_several_settings_only_chosen_ones_are_published() {
    let (results, copy) = (fresh("published-mixed"), fresh("published-chosen"));
    for epochs in ["training.epochs=1", "training.epochs=2"] {
        succeed(&results, &["run", SMOKE, "scenarios=[empty]", "tasks=[prediction]", epochs]);
    }
    let arguments = ["publish", "smoke", "--output", copy.to_str().unwrap()];
    let answer = finish(&mut harness(&results, &arguments));
    assert_eq!(answer.code, 2);
    assert!(
        answer.stderr.contains("the runs of smoke differ in training.epochs (1, 2); "),
        "{}",
        answer.stderr
    );
    assert!(!copy.exists());
    let said = succeed(&results, &[&arguments[..], &["--where", "training.epochs=1"]].concat());
    assert!(said.starts_with("1 run, "), "{said}");
    assert_eq!(csv(&copy, "select max(epoch) as last from epochs"), "last\n1\n");
}

#[test]
fn runs_that_are_not_published_copies_are_not_replaced() {
    let copy = fresh("published-over-runs");
    for changed in [&["training.epochs=1"][..], &[]] {
        succeed(&copy, &[&["run", SMOKE, "scenarios=[empty]", "seeds=[3]"], changed].concat());
        let before = files(&copy);
        let answer =
            finish(&mut harness(&RESULTS, &["publish", "smoke", "--output", copy.to_str().unwrap()]));
        assert_eq!(answer.code, 1);
        let said = format!("publishing would replace {}", copy.join("runs/smoke/empty-z4-seed3-").display());
        assert!(answer.stderr.contains(&said) && answer.stderr.lines().count() == 1, "{}", answer.stderr);
        assert!(files(&copy) == before);
    }
}

#[test]
fn what_cannot_be_published_is_refused() {
    let (results, inside) = (RESULTS.to_str().unwrap(), RESULTS.join("runs/copy"));
    let inside = inside.to_str().unwrap();
    for (arguments, code, message) in [
        (
            ["publish", "smok", "--output", "nowhere"],
            2,
            "error: 'smok' has no finished runs; did you mean 'smoke'? Those that have: smoke, sweep\n",
        ),
        (
            ["publish", "smoke", "--output", inside],
            1,
            "can't be published into itself; choose another folder\n",
        ),
        (
            ["publish", "smoke", "--output", results],
            1,
            "can't be published into itself; choose another folder\n",
        ),
    ] {
        let answer = finish(&mut harness(&RESULTS, &arguments));
        assert_eq!(answer.code, code, "{arguments:?}");
        assert!(answer.stderr.ends_with(message), "{}", answer.stderr);
    }
    assert!(!Path::new("nowhere").exists() && !Path::new(inside).exists());
    let file = fresh("published-to-a-file");
    std::fs::write(&file, "mine").unwrap();
    for more in [&[][..], &["--complete"]] {
        let arguments = [&["publish", "smoke", "--output", file.to_str().unwrap()], more].concat();
        let answer = finish(&mut harness(&RESULTS, &arguments));
        assert!(answer.code != 0 && answer.stderr.lines().count() == 1, "{}", answer.stderr);
        assert!(answer.stderr.contains("it is a file, not a folder"), "{}", answer.stderr);
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "mine");
    }
}

/// The files of a results folder's runs of smoke and of its datasets, by their path in it, without those of locks.
fn kept(results: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let all =
        [results.join("runs/smoke"), results.join("datasets")].into_iter().flat_map(|part| files(&part));
    let is_lock = |path: &Path| path.file_name().unwrap().to_string_lossy().starts_with('.');
    all.filter(|(path, _)| !is_lock(path))
        .map(|(path, bytes)| (path.strip_prefix(results).unwrap().to_owned(), bytes))
        .collect()
}

fn complete<'a>(to: &'a Path, runs: &'a str) -> [&'a str; 5] {
    ["publish", runs, "--complete", "--output", to.to_str().unwrap()]
}

#[test]
fn a_complete_copy_has_every_file_and_is_continued() {
    let (copy, whole) = (fresh("complete"), kept(&RESULTS));
    assert!(succeed(&RESULTS, &complete(&copy, "smoke")).starts_with("6 folders, "));
    assert!(kept(&copy) == whole);
    let lost: Vec<&PathBuf> = whole.keys().filter(|path| path.ends_with("run.json")).take(1).collect();
    let lost = lost.into_iter().chain(whole.keys().find(|path| path.ends_with("episode_00001.parquet")));
    lost.for_each(|path| std::fs::remove_file(copy.join(path)).unwrap());
    let said = succeed(&RESULTS, &complete(&copy, "smoke"));
    assert!(said.starts_with("2 folders, ") && said.ends_with(", 4 there before\n"), "{said}");
    assert!(kept(&copy) == whole);
    assert!(succeed(&copy, &["verify"]).contains("4 runs, 2 datasets"));

    let again = fresh("complete-again");
    assert!(succeed(&copy, &complete(&again, "smoke/empty-z4-seed3")).starts_with("2 folders, "));
    assert!(kept(&again).iter().all(|(path, bytes)| whole[path] == *bytes));
    succeed(&copy, &complete(&again, "smoke"));
    assert!(kept(&again) == whole);
}

#[test]
fn a_complete_copy_replaces_nothing_and_copies_nothing_damaged() {
    let (results, copy) = (fresh("complete-from"), fresh("complete-over"));
    succeed(&RESULTS, &complete(&results, "smoke"));
    succeed(&results, &complete(&copy, "smoke/empty"));
    let refused = |from: &Path, runs: &str, message: &str| {
        let before = files(&copy);
        let answer = finish(&mut harness(from, &complete(&copy, runs)));
        assert!(answer.code == 1 && answer.stderr.contains(message), "{} {}", answer.code, answer.stderr);
        assert!(answer.stderr.lines().count() == 1 && files(&copy) == before, "{}", answer.stderr);
    };
    let run = |of: &Path, start: &str| {
        let name = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().starts_with(start);
        let mut runs = std::fs::read_dir(of.join("runs/smoke")).unwrap().map(|run| run.unwrap().path());
        runs.find(name).unwrap()
    };
    let changed = run(&copy, "empty-z4-seed5").join("metrics.parquet");
    let metrics = std::fs::read(&changed).unwrap();
    std::fs::write(&changed, "other").unwrap();
    refused(&results, "smoke", "exists already with other content (metrics.parquet); nothing was copied");
    std::fs::write(&changed, metrics).unwrap();

    let to = run(&copy, "empty-z4-seed5");
    std::fs::rename(to.join("run.json"), results.join("run.json")).unwrap();
    let lock = FolderLock::attempt(&to).unwrap().unwrap();
    refused(&results, "smoke/empty", &format!("works in {}; try again when it has ended", to.display()));
    lock.remove(&to);
    std::fs::rename(results.join("run.json"), to.join("run.json")).unwrap();

    std::fs::write(run(&results, "cluttered").join("metrics.parquet"), "damaged").unwrap();
    refused(&results, "smoke", "metrics.parquet is damaged");
    refused(&copy, "smoke", "can't be published into itself; choose another folder");
    let answer = finish(&mut harness(&results, &["publish", "smoke", "--complete"]));
    assert!(answer.code == 2 && answer.stderr.contains("--output <DIR>"), "{}", answer.stderr);
}
