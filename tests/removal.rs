//! `harness rm`, `gc`, `du`, `diff` and the choices of `ls`.

use crate::common::{Disk, SMOKE, finish, fresh, harness, set_in_record, succeed};
use crate::terminal::raw_typed;
use harness::files::FolderLock;
use harness::registry::Registry;
use std::cell::Cell;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

const SHORT: [&str; 2] = ["tasks=[prediction]", "training.epochs=1"];

/// Makes a run of the experiment `name` with `--quick`, whose results have the name `NAME-quick`.
fn quick_run(results: &Path, name: &str) {
    let smoke = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(SMOKE)).unwrap();
    let smoke = smoke.replace("name: smoke", &format!("name: {name}")) + "quick: {training.patience: 2}\n";
    let spec = results.with_extension("yaml");
    fs::write(&spec, smoke).unwrap();
    let run = ["run", spec.to_str().unwrap(), "--quick", "scenarios=[empty]"];
    succeed(results, &[&run[..], &SHORT].concat());
}

/// A done experiment, a quick one, and a dataset that no run uses.
fn results(name: &str) -> PathBuf {
    let results = fresh(name);
    succeed(&results, &[&["run", SMOKE, "scenarios=[empty]", "seeds=[0,1]"][..], &SHORT].concat());
    quick_run(&results, "smoke");
    succeed(&results, &["collect", SMOKE, "scenarios=[cluttered]"]);
    results
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> =
        entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

#[test]
fn garbage_is_listed_with_sizes_and_removed_only_with_consent() {
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
fn what_killed_processes_left_in_the_results_folder_is_garbage() {
    let results = results("garbage_unfinished");
    let place = |name: &str| results.join(format!(".unfinished-{name}"));
    for name in ["import-a1", "import-b2", "removal-c3", "import-held"] {
        fs::create_dir(place(name)).unwrap();
        fs::write(place(name).join("episode_00000.parquet"), "a part").unwrap();
    }
    for name in ["Xy12Za", "held12"] {
        fs::write(place(name), "a part of a file").unwrap();
    }
    let _folder = FolderLock::attempt(&place("import-held")).unwrap().unwrap();
    let file = fs::File::open(place("held12")).unwrap();
    file.lock().unwrap();
    let listed = succeed(&results, &["gc", "--only", "unfinished"]);
    assert_eq!(listed.matches("unfinished  .unfinished-").count(), 4, "{listed}");
    assert!(listed.contains("16 B  unfinished  .unfinished-Xy12Za\n"), "{listed}");
    let removed = succeed(&results, &["gc", "--only", "unfinished", "--yes"]);
    assert!(removed.ends_with("4 folders removed\n"), "{removed}");
    assert_eq!(names(&results), [".unfinished-held12", ".unfinished-import-held", "datasets", "runs"]);
    drop(file);
    assert!(succeed(&results, &["gc", "--only", "unfinished", "--yes"]).ends_with("1 folder removed\n"));
}

#[test]
fn datasets_are_kept_while_a_damaged_run_may_use_them() {
    let results = results("garbage_damaged");
    let run = results.join("runs/smoke-quick");
    fs::write(run.join(&names(&run)[0]).join("run.json"), "{").unwrap();
    let answer = finish(&mut harness(&results, &["gc", "--yes"]));
    assert_eq!((answer.code, answer.stdout.as_str()), (0, "nothing to remove\n"), "{}", answer.stderr);
    let unused = names(&results.join("datasets")).into_iter().find(|name| name.starts_with("cluttered-"));
    let kept = format!("warning: the dataset {} is kept: a run that is left out may use it", unused.unwrap());
    assert!(answer.stderr.contains(&kept), "{}", answer.stderr);
    succeed(&results, &["rm", "smoke", "--yes"]);
    fs::remove_dir_all(run).unwrap();
    assert!(succeed(&results, &["gc", "--yes"]).ends_with("2 folders removed\n"));
}

/// A folder with the world twelve, its model, and the spec of an experiment on it, whose path is returned too.
fn folder_of_twelve() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    for file in ["twelve.yaml", "twelve.xml"] {
        let text =
            fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("models").join(file)).unwrap();
        fs::write(folder.path().join(file), text).unwrap();
    }
    let spec = folder.path().join("spec.yaml");
    let text = "name: twelve\nscenarios: [twelve.yaml]\ninput: proprioception\noutput: proprioception\nlatent: 2\n\
                network: {preset: single_to_multi, hidden: [8]}\ntasks: [prediction]\n\
                simulation: {episodes: 4, actuations_per_episode: 3}\ntraining: {epochs: 1, batch_size: 16}\n";
    fs::write(&spec, text).unwrap();
    (folder, spec)
}

/// Changes the model of the world twelve in a folder.
fn change_twelve(folder: &Path) {
    let model = folder.join("twelve.xml");
    let changed = fs::read_to_string(&model).unwrap().replacen("damping=\"", "damping=\"1", 1);
    fs::write(&model, changed).unwrap();
}

#[test]
fn a_run_of_before_its_world_changed_is_superseded() {
    let (results, (folder, spec)) = (fresh("superseded"), folder_of_twelve());
    succeed(&results, &["run", spec.to_str().unwrap()]);
    let before = names(&results.join("runs/twelve"));
    assert_eq!(succeed(&results, &["gc", "--only", "superseded"]), "nothing to remove\n");
    change_twelve(folder.path());
    // Runs are compared by the second in which they began.
    std::thread::sleep(std::time::Duration::from_secs(1));
    succeed(&results, &["run", spec.to_str().unwrap()]);
    assert_eq!(names(&results.join("runs/twelve")).len(), 2);
    let listed = succeed(&results, &["gc", "--only", "superseded"]);
    assert!(
        listed.lines().next().unwrap().ends_with(&format!("superseded  twelve/{}", before[0])),
        "{listed}"
    );
}

#[test]
fn a_run_of_another_world_of_the_same_name_is_kept() {
    let results = fresh("two_worlds");
    let ((_one, spec), (other, spec_of_other)) = (folder_of_twelve(), folder_of_twelve());
    change_twelve(other.path());
    succeed(&results, &["run", spec.to_str().unwrap()]);
    std::thread::sleep(std::time::Duration::from_secs(1));
    succeed(&results, &["run", spec_of_other.to_str().unwrap()]);
    let runs = names(&results.join("runs/twelve"));
    assert_eq!(runs.len(), 2);
    assert_eq!(succeed(&results, &["gc", "--yes"]), "nothing to remove\n");
    // Means are computed for each world, and the runs of one world do not replace published runs of the other.
    let compared = succeed(&results, &["compare", "twelve", "--by", "settings", "--format", "markdown"]);
    let published = fresh("two_worlds_published");
    let datasets = names(&results.join("datasets"));
    assert_eq!(datasets.len(), 2);
    for only in datasets.iter().map(|dataset| format!("dataset={dataset}")) {
        assert!(compared.lines().any(|line| line.contains(&only)), "{compared}");
        let output = published.to_str().unwrap();
        succeed(&results, &["publish", "twelve", "--where", &only, "--output", output]);
    }
    let copied: Vec<String> =
        Registry::new(&published).records().into_iter().map(|record| record.run).collect();
    assert_eq!(copied, runs);
    // The run of before a change of the second world is superseded, and that of the first world is not.
    let model = other.path().join("twelve.xml");
    let changed = fs::read_to_string(&model).unwrap().replacen("damping=\"1", "damping=\"2", 1);
    fs::write(&model, changed).unwrap();
    std::thread::sleep(std::time::Duration::from_secs(1));
    succeed(&results, &["run", spec_of_other.to_str().unwrap()]);
    let removed = succeed(&results, &["gc", "--yes", "--only", "superseded"]);
    assert!(removed.ends_with("1 folder removed\n"), "{removed}");
    let left = names(&results.join("runs/twelve"));
    assert_eq!(left.iter().filter(|run| runs.contains(run)).count(), 1, "{left:?}");
    assert!(left.len() == 2 && succeed(&results, &["gc", "--yes"]).contains("unused"), "{left:?}");
}

#[test]
fn a_damaged_run_is_not_repaired_by_another_world_of_its_name() {
    let results = fresh("two_worlds_damaged");
    let ((one, spec), (other, spec_of_other)) = (folder_of_twelve(), folder_of_twelve());
    change_twelve(other.path());
    succeed(&results, &["run", spec.to_str().unwrap()]);
    let damaged = only_run(&results, "twelve");
    succeed(&results, &["run", spec_of_other.to_str().unwrap()]);
    fs::write(damaged.join("metrics.parquet"), "damaged").unwrap();
    let verified = || finish(&mut harness(&results, &["verify"])).stdout;
    let by = |spec: &Path| format!("run {}", spec.display());
    assert!(verified().contains(&by(&spec)) && !verified().contains(&by(&spec_of_other)), "{}", verified());
    // Its own spec is gone. The other spec makes a run with the same settings, in another world.
    drop(one);
    assert!(!verified().contains(&format!(
        "repair: harness --results {} {}",
        results.display(),
        by(&spec_of_other)
    )));
    assert!(verified().contains("where it was run before"), "{}", verified());
}

#[test]
fn chosen_runs_are_removed_and_one_in_use_is_kept() {
    let results = results("removed");
    let run = names(&results.join("runs/smoke")).remove(0);
    let file = fs::OpenOptions::new()
        .write(true)
        .open(results.join("runs/smoke").join(&run).join(".unfinished-lock"));
    let lock = file.unwrap();
    lock.lock().unwrap();
    let answer = finish(&mut harness(&results, &["rm", "smoke/", "--yes"]));
    assert_eq!(answer.code, 1);
    assert!(answer.stderr.contains(&format!("smoke/{run} is kept: ")), "{}", answer.stderr);
    assert!(answer.stdout.ends_with("1 folder removed\n"), "{}", answer.stdout);
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
    let shown = succeed(&results, &["diff", &format!("smoke/{}", runs[0]), &format!("smoke/{}", runs[1])]);
    assert!(shown.contains("\nseed ") && shown.contains("b - a") && shown.contains("WMAPE"), "{shown}");
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
}

/// The only line of a refusal.
#[track_caller]
fn refusal(results: &Path, arguments: &[&str], code: i32) -> String {
    let answer = finish(&mut harness(results, arguments));
    assert_eq!((answer.code, answer.stdout.as_str()), (code, ""), "{arguments:?}: {}", answer.stderr);
    let line =
        answer.stderr.trim_end().strip_prefix("error: ").unwrap_or_else(|| panic!("{}", answer.stderr));
    assert!(!line.contains('\n'), "{line}");
    line.to_owned()
}

#[test]
fn what_cannot_be_removed_or_compared_is_refused_in_one_line() {
    let results = results("refused");
    let nowhere = Path::new("nowhere");
    for arguments in [&["rm", "smoke"][..], &["gc"], &["diff", "a", "b"], &["ls"]] {
        assert!(
            refusal(nowhere, arguments, 2).starts_with("there are no results in nowhere"),
            "{arguments:?}"
        );
    }
    assert!(!nowhere.exists());
    let runs = names(&results.join("runs/smoke"));
    let said = refusal(&results, &["rm", &format!("smoke/{}", runs[0]), "smok/", "--yes"], 2);
    assert!(said.starts_with("no run matches 'smok/', the nearest is "), "{said}");
    assert!(refusal(&results, &["diff", &runs[1], "nothing"], 2).starts_with("no run matches 'nothing'"));
    assert!(
        refusal(&results, &["diff", "smoke/", &runs[1]], 2).starts_with("'smoke/' matches several runs: ")
    );
    for arguments in
        [&["gc", "--only", "old"][..], &["ls", "--status", "lost"], &["ls", "--sort", "colour"], &["rm"]]
    {
        let answer = finish(&mut harness(&results, arguments));
        assert_eq!((answer.code, answer.stdout.as_str()), (2, ""), "{arguments:?}");
        assert!(answer.stderr.starts_with("error: "), "{}", answer.stderr);
    }
    assert_eq!(names(&results.join("runs/smoke")), runs);
    assert_eq!(names(&results.join("datasets")).len(), 2);
}

#[test]
fn runs_are_removed_from_full_disks_but_not_unwritable_ones() {
    let Some(disk) = Disk::new(8000) else {
        println!("skipped: no small disk can be mounted here");
        return;
    };
    let run = [&["run", SMOKE, "scenarios=[empty]", "seeds=[0,1]"][..], &SHORT].concat();
    succeed(disk.path(), &run);
    let runs = names(&disk.path().join("runs/smoke"));
    disk.remount("ro");
    let answer = finish(&mut harness(disk.path(), &["rm", &runs[0], "--yes"]));
    assert_eq!(answer.code, 1);
    let said = answer.stderr.trim_end();
    assert!(
        said.starts_with("error: can't lock ") && said.ends_with("Read-only file system (os error 30)"),
        "{said}"
    );
    assert_eq!(names(&disk.path().join("runs/smoke")), runs);
    disk.remount("rw");
    let fills = "dd if=/dev/zero of=\"$1/rest\" bs=4k 2>/dev/null; ! { echo more >\"$1/more\"; } 2>/dev/null";
    let full = std::process::Command::new("sh").args(["-c", fills, "sh"]).arg(disk.path()).status();
    assert!(full.unwrap().success());
    let removed = succeed(disk.path(), &["rm", &runs[0], "--yes"]);
    assert!(removed.ends_with("1 folder removed\n"), "{removed}");
    assert_eq!(names(&disk.path().join("runs/smoke")), runs[1..]);
    assert!(succeed(disk.path(), &["verify"]).ends_with("all files are intact\n"));
}

/// The folder of the only run of an experiment.
fn only_run(results: &Path, experiment: &str) -> PathBuf {
    let folder = results.join("runs").join(experiment);
    let runs = names(&folder);
    assert_eq!(runs.len(), 1, "{runs:?}");
    folder.join(&runs[0])
}

#[test]
fn the_start_of_an_experiments_name_or_no_text_chooses_no_run() {
    let results = results("beginnings");
    let copy = fresh("beginnings_copy");
    let publish = ["--complete", "--output", copy.to_str().unwrap()];
    for wanted in ["", "smok", "smoke-"] {
        for arguments in [vec!["rm", "--yes", wanted], [&["publish", wanted][..], &publish].concat()] {
            let said = refusal(&results, &arguments, 2);
            assert!(said.starts_with(&format!("no run matches '{wanted}'")), "{said}");
        }
    }
    assert!(!copy.exists());
    assert_eq!(names(&results.join("runs")), ["smoke", "smoke-quick"]);
    succeed(&results, &["rm", "smoke-quick/", "--yes"]);
    assert_eq!(names(&results.join("runs")), ["smoke"]);
}

#[test]
fn the_path_of_a_runs_folder_chooses_the_run() {
    let results = results("paths");
    let runs = names(&results.join("runs/smoke"));
    let path = |name: &str| results.join("runs/smoke").join(name).display().to_string() + "/";
    let shown = succeed(&results, &["diff", &path(&runs[0]), &runs[1]]);
    assert!(shown.starts_with(&format!("a  smoke/{}\nb  smoke/{}\n", runs[0], runs[1])), "{shown}");
    assert!(succeed(&results, &["show", &path(&runs[0])]).contains(&runs[0]));
    succeed(
        &results,
        &["export", "--format", "onnx", &path(&runs[0]), results.join("a.onnx").to_str().unwrap()],
    );
    succeed(&results, &["rm", "--yes", &path(&runs[0])]);
    assert_eq!(names(&results.join("runs/smoke")), runs[1..]);
    let link = fresh("paths_link");
    let _ = fs::remove_file(&link);
    std::os::unix::fs::symlink(&results, &link).unwrap();
    assert!(succeed(&link, &["show", &path(&runs[1])]).contains(&runs[1]));
    let mut inside = harness(Path::new("../.."), &["show", &format!("{}/", runs[1])]);
    let shown = finish(inside.current_dir(results.join("runs/smoke")));
    assert!(shown.stdout.contains(&runs[1]), "{}", shown.stderr);
    succeed(&results, &["rm", "--yes", &path("")]);
    assert_eq!(names(&results.join("runs")), ["smoke-quick"]);
}

#[test]
fn a_run_of_an_experiment_named_as_a_quick_one_is_no_garbage() {
    let results = fresh("garbage_named_quick");
    succeed(&results, &[&["run", SMOKE, "scenarios=[empty]", "name=my-quick"][..], &SHORT].concat());
    assert_eq!(succeed(&results, &["gc", "--yes"]), "nothing to remove\n");
}

#[test]
fn a_running_run_and_its_dataset_are_no_garbage() {
    let results = fresh("garbage_running");
    quick_run(&results, "smoke");
    let run = only_run(&results, "smoke-quick");
    set_in_record(&run, "/status", "running".into());
    let lock = FolderLock::attempt(&run).unwrap().unwrap();
    assert_eq!(succeed(&results, &["gc", "--yes"]), "nothing to remove\n");
    assert_eq!(names(&results.join("datasets")).len(), 1);
    drop(lock);
    assert!(succeed(&results, &["gc", "--yes"]).ends_with("2 folders removed\n"));
}

#[test]
fn what_is_no_longer_garbage_at_the_answer_is_kept() {
    let results = fresh("garbage_asked");
    succeed(&results, &[&["run", SMOKE, "scenarios=[empty]", "name=first"][..], &SHORT].concat());
    quick_run(&results, "second");
    succeed(&results, &["collect", SMOKE, "scenarios=[cluttered]"]);
    let (first, dataset) = (only_run(&results, "first"), names(&results.join("datasets")));
    let unused = dataset.iter().find(|name| name.starts_with("cluttered-")).unwrap();
    set_in_record(&first, "/status", "failed".into());
    let answered = Cell::new(false);
    let mut gc = Command::new(env!("CARGO_BIN_EXE_harness"));
    let said = raw_typed(gc.arg("--results").arg(&results).arg("gc"), 120, |said| {
        (said.contains("remove 4 folders") && said.contains("[y/N]") && !answered.replace(true)).then(|| {
            // Another process has done the failed run again, on the other dataset.
            set_in_record(&first, "/status", "done".into());
            set_in_record(&first, "/dataset", unused.as_str().into());
            "y\n"
        })
    });
    assert!(answered.get() && said.contains("2 folders removed"), "{said}");
    for kept in [format!("first/{}", first.file_name().unwrap().display()), unused.clone()] {
        assert!(said.contains(&format!("{kept} is kept: it has been used or changed")), "{said}");
    }
    assert_eq!(names(&results.join("runs")), ["first"]);
    assert!(names(&results.join("datasets")).contains(unused));
}

#[test]
fn processes_can_remove_the_same_runs_at_once() {
    let results = fresh("removed_at_once");
    let experiment = results.join("runs/smoke");
    succeed(&results, &[&["run", SMOKE, "scenarios=[empty]"][..], &SHORT].concat());
    let run = only_run(&results, "smoke");
    for number in 0..60 {
        let id = format!("empty-z4-seed{number}-{number:08x}");
        let copy = experiment.join(&id);
        fs::create_dir(&copy).unwrap();
        fs::copy(run.join("run.json"), copy.join("run.json")).unwrap();
        set_in_record(&copy, "/run", id.into());
        for file in 0..20 {
            fs::write(copy.join(format!("{file}.txt")), "?").unwrap();
        }
    }
    let remove = || finish(&mut harness(&results, &["rm", "smoke", "--yes"]));
    let answers: Vec<_> = std::thread::scope(|scope| {
        let processes: Vec<_> = (0..4).map(|_| scope.spawn(remove)).collect();
        processes.into_iter().map(|process| process.join().unwrap()).collect()
    });
    for answer in answers {
        // A process that begins late finds no run, and one keeps what another is removing.
        let is_good = |line: &str| {
            line.contains(" is kept: ")
                || line.starts_with("error: no run matches 'smoke'")
                || line.starts_with("error: there are no results in ")
        };
        assert!(answer.stderr.lines().all(is_good), "{}", answer.stderr);
    }
    assert_eq!(names(&results), ["datasets", "runs"]);
    assert_eq!(names(&results.join("runs")), [""; 0]);
}

#[test]
fn what_can_be_removed_is_removed_after_an_error() {
    let results = fresh("removed_after_error");
    succeed(&results, &[&["run", SMOKE, "scenarios=[empty]", "seeds=[0,1]"][..], &SHORT].concat());
    let runs = names(&results.join("runs/smoke"));
    let first = results.join("runs/smoke").join(&runs[0]);
    fs::remove_file(first.join(".unfinished-lock")).unwrap();
    fs::create_dir(first.join(".unfinished-lock")).unwrap();
    let answer = finish(&mut harness(&results, &["rm", "smoke", "--yes"]));
    assert_eq!(answer.code, 1);
    assert!(
        answer.stderr.starts_with("error: can't lock ") && answer.stderr.lines().count() == 1,
        "{}",
        answer.stderr
    );
    assert!(answer.stdout.ends_with("1 folder removed\n"), "{}", answer.stdout);
    assert_eq!(names(&results.join("runs/smoke")), runs[..1]);
}
