//! The program in a folder that is no clone of the repository: it contains the experiments, the claims and the worlds.

use crate::common::{Answer, finish, harness};
use harness::spec::SPECS;
use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;
use tempfile::TempDir;

/// Runs a command in `folder`, with the results folder `results` in it.
fn answer(folder: &Path, arguments: &[&str]) -> Answer {
    finish(harness(Path::new("results"), arguments).current_dir(folder))
}

#[track_caller]
fn succeed(folder: &Path, arguments: &[&str]) -> String {
    let answer = answer(folder, arguments);
    assert_eq!(answer.code, 0, "{arguments:?}: {}", answer.stderr);
    answer.stdout
}

fn empty_folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

#[test]
fn every_spec_in_experiments_is_built_in() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments");
    let specs = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let specs = specs.filter(|path| path.extension().is_some_and(|extension| extension == "yaml"));
    let mut specs: BTreeMap<String, String> = specs
        .map(|path| {
            (path.file_stem().unwrap().to_str().unwrap().to_owned(), fs::read_to_string(path).unwrap())
        })
        .collect();
    specs.remove("claims").expect("the claims are no spec");
    let built_in: BTreeMap<String, String> =
        SPECS.iter().map(|spec| (spec.name.to_owned(), spec.text.to_owned())).collect();
    assert_eq!(built_in, specs);
}

#[test]
fn built_in_experiments_and_claims_need_no_clone() {
    let folder = empty_folder();
    for spec in SPECS {
        let valid = succeed(folder.path(), &["validate", spec.name]);
        assert!(valid.starts_with(&format!("{} is valid: ", spec.name)), "{valid}");
    }
    succeed(folder.path(), &["run", "smoke", "scenarios=[empty]", "seeds=[0]"]);
    let command = succeed(folder.path(), &["query", "select command from runs"]);
    assert!(command.contains("harness --results results run smoke 'scenarios=[empty]'"), "{command}");
    assert!(succeed(folder.path(), &["verify"]).contains("all files are intact"));
    for arguments in [&["claims"][..], &["claims", "force_is_quasi_static"]] {
        let judged = succeed(folder.path(), arguments);
        assert!(judged.contains("for claims without data   harness run single_to_multi\n"), "{judged}");
    }
    succeed(folder.path(), &["report"]);
}

#[test]
fn files_in_the_folder_come_before_built_in_ones() {
    let folder = empty_folder();
    let smoke = SPECS.iter().find(|spec| spec.name == "smoke").unwrap().text;
    let runs = || succeed(folder.path(), &["validate", "smoke"]).lines().count() - 1;
    let write = |path: &str, latent: &str| {
        fs::write(folder.path().join(path), smoke.replace("latent: [4]", latent)).unwrap();
    };
    let built_in = runs();
    fs::create_dir(folder.path().join("experiments")).unwrap();
    write("experiments/smoke.yaml", "latent: [4, 5]");
    assert_eq!(runs(), 2 * built_in);
    write("smoke.yaml", "latent: [4, 5, 6]");
    assert_eq!(runs(), 3 * built_in);
    // A file that has exactly this name, without an extension, could always be named.
    write("smoke", "latent: [4, 5, 6, 7]");
    assert_eq!(runs(), 4 * built_in);
    // Folders are no specs.
    fs::remove_file(folder.path().join("smoke")).unwrap();
    fs::create_dir(folder.path().join("smoke")).unwrap();
    assert_eq!(runs(), 3 * built_in);

    fs::create_dir_all(folder.path().join("results/runs")).unwrap();
    fs::write(folder.path().join("experiments/claims.yaml"), "[]").unwrap();
    let claims = answer(folder.path(), &["claims"]);
    assert_eq!(
        (claims.code, &*claims.stderr),
        (2, "error: experiments/claims.yaml:1:1: the file contains no claims\n")
    );
}

#[test]
fn unknown_names_and_files_are_refused_with_what_there_is() {
    let folder = empty_folder();
    let refused = |name: &str| {
        let answer = answer(folder.path(), &["run", name]);
        assert_eq!((answer.code, answer.stdout.as_str()), (2, ""));
        answer.stderr
    };
    let unknown = refused("multi_to_mutli");
    assert!(
        unknown.starts_with(
            "error: unknown experiment 'multi_to_mutli'; did you mean 'multi_to_multi'? Allowed: \
                             choose_camera, choose_recommended, "
        ) && unknown.ends_with(", which_touch, or the path of a file\n"),
        "{unknown}"
    );
    let missing =
        "experiments/smoke.yaml: there is no such file; the built-in experiment has the name 'smoke'";
    assert_eq!(refused("experiments/smoke.yaml"), format!("error: {missing}\n"));
    assert_eq!(refused("own/other.yaml"), "error: own/other.yaml: there is no such file\n");
}

/// A built-in spec has no folder that the paths of world files could be relative to.
#[test]
fn world_files_of_built_ins_are_relative_to_the_current_folder() {
    let folder = empty_folder();
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    for file in ["twelve.yaml", "twelve.xml"] {
        fs::copy(models.join(file), folder.path().join(file)).unwrap();
    }
    let valid = succeed(folder.path(), &["validate", "smoke", "scenarios=[twelve.yaml]"]);
    assert!(valid.contains("twelve"), "{valid}");
}

/// As after `cargo install` and the removal of the clone: the folder in which cargo has linked MuJoCo does not exist.
#[test]
fn the_program_finds_mujoco_in_its_own_folder() {
    let folder = empty_folder();
    let mujoco = env!("MUJOCO_DYNAMIC_LINK_DIR").as_bytes();
    let mut bytes = fs::read(env!("CARGO_BIN_EXE_harness")).unwrap();
    while let Some(place) = bytes.windows(mujoco.len()).position(|part| part == mujoco) {
        bytes[place..place + mujoco.len()].fill(b'x');
    }
    fs::write(folder.path().join("bytes"), bytes).unwrap();
    let shell = |line: &str| {
        let mut command = Command::new("sh");
        // The loader searches the folders of this variable first.
        let command = command.args(["-c", line]).env_remove("LD_LIBRARY_PATH").current_dir(&folder);
        command.output().unwrap()
    };
    // A child process writes the program; see `common::write_script`.
    shell("cp bytes harness && chmod +x harness");
    let version = || shell("./harness --version");
    let library = format!("libmujoco.so.{}", harness::simulation::MUJOCO_VERSION);

    let said = String::from_utf8(version().stderr).unwrap();
    assert!(said.contains(&format!("error while loading shared libraries: {library}")), "{said}");
    symlink(Path::new(env!("MUJOCO_DYNAMIC_LINK_DIR")).join(&library), folder.path().join(&library)).unwrap();
    assert!(version().stdout.starts_with(b"harness "));
}

#[test]
fn experiments_lists_questions_and_prints_specs() {
    let folder = empty_folder();
    let list = succeed(folder.path(), &["experiments"]);
    for spec in SPECS {
        assert!(list.contains(&format!("\n{} ", spec.name)), "{list}");
        assert_eq!(succeed(folder.path(), &["experiments", spec.name]), spec.text);
    }
    assert!(
        list.contains("What does vision add to proprioception when the next observation is predicted?"),
        "{list}"
    );
    let unknown = answer(folder.path(), &["experiments", "somke"]);
    assert!(unknown.code == 2 && unknown.stderr.contains("'smoke'"), "{}", unknown.stderr);
}

/// Runs git in `folder`, and returns whether it succeeded.
fn git(folder: &Path, arguments: &[&str]) -> bool {
    let user = ["-c", "user.name=a", "-c", "user.email=a@example.org"];
    let mut command = Command::new("git");
    let command = command.current_dir(folder).args(user).args(arguments);
    command.output().is_ok_and(|output| output.status.success())
}

#[test]
fn the_uncommitted_changes_of_a_run_can_be_applied() {
    let folder = empty_folder();
    let folder = folder.path();
    let file = |name: &str| folder.join(name);
    fs::write(file("text"), "one\n\ntwo\n\n").unwrap();
    fs::write(file("latin"), b"caf\xe9\n").unwrap();
    fs::write(file("binary"), [0, 1, 2]).unwrap();
    for arguments in [
        &["init", "--quiet"][..],
        &["config", "color.ui", "always"],
        &["config", "diff.noprefix", "true"],
        &["add", "text", "latin", "binary"],
        &["commit", "--quiet", "--message", "x"],
    ] {
        assert!(git(folder, arguments), "{arguments:?}");
    }
    let changed: [(&str, &[u8]); 3] =
        [("text", b"1\n\ntwo\n\n"), ("latin", b"th\xe9\n"), ("binary", &[0, 3])];
    for (name, bytes) in changed {
        fs::write(file(name), bytes).unwrap();
    }
    let run = ["run", "smoke", "scenarios=[empty]", "tasks=[prediction]", "training.epochs=1"];
    succeed(folder, &run);
    let run_folder = fs::read_dir(file("results/runs/smoke")).unwrap().next().unwrap().unwrap().path();
    let patch = run_folder.join("uncommitted.diff");
    let patch = patch.to_str().unwrap();
    assert!(git(folder, &["checkout", "--quiet", "."]));
    assert!(git(folder, &["apply", patch]), "{}", String::from_utf8_lossy(&fs::read(patch).unwrap()));
    for (name, bytes) in changed {
        assert_eq!(fs::read(file(name)).unwrap(), bytes);
    }

    // A run that is done again has the changes of the second time.
    assert!(git(folder, &["checkout", "--quiet", "."]));
    fs::remove_file(run_folder.join("metrics.parquet")).unwrap();
    succeed(folder, &run);
    assert!(!Path::new(patch).exists());
}
