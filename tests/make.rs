//! The targets of `make` in a fresh clone, with stand-ins for the programs that they call.

use crate::common::write_script;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// Writes a script that records its name and arguments, and exits with `code`.
fn stand_in(path: &Path, code: i32) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let name = path.file_name().unwrap().to_string_lossy();
    write_script(path, &format!("echo \"{name} $*\" >>\"$CALLS\"\nexit {code}"));
}

/// The calls that a command makes, in order, and its exit code, in a clone where cargo and Python exit with these
/// codes.
fn calls(command: &[&str], cargo: i32, python: i32) -> (Vec<String>, i32) {
    let (calls, output) = calls_in_clone(command, cargo, python);
    (calls, output.status.code().unwrap())
}

/// The calls, and the command's exit code and output.
fn calls_in_clone(command: &[&str], cargo: i32, python: i32) -> (Vec<String>, Output) {
    let (root, folder) = (Path::new(env!("CARGO_MANIFEST_DIR")), tempfile::tempdir().unwrap());
    let path = |name: &str| folder.path().join(name);
    fs::create_dir(path(".ci")).unwrap();
    for file in ["Makefile", ".ci/run", ".ci/check"] {
        fs::copy(root.join(file), path(file)).unwrap();
    }
    stand_in(&path("setup/setup.sh"), 0);
    stand_in(&path(".venv/bin/python"), python);
    stand_in(&path("bin/cargo"), cargo);
    let programs = format!("{}:{}", path("bin").display(), std::env::var("PATH").unwrap());
    let output = Command::new(command[0])
        .args(&command[1..])
        .current_dir(folder.path())
        .env("PATH", programs)
        .env("CALLS", path("calls"))
        // The tests may have been started by `make`.
        .env_remove("MAKEFLAGS")
        .env_remove("MAKELEVEL")
        // They may run in a hook of git, which would make this its own repository.
        .env_remove("GIT_DIR")
        .env_remove("GIT_INDEX_FILE")
        .env_remove("GIT_WORK_TREE")
        .output()
        .unwrap();
    let calls = fs::read_to_string(path("calls")).unwrap().lines().map(str::to_owned).collect();
    (calls, output)
}

#[test]
fn a_failed_test_does_not_keep_the_others_from_running() {
    for (cargo, python, succeeds) in [(0, 0, true), (101, 0, false), (0, 1, false), (101, 1, false)] {
        let (calls, code) = calls(&["make", "test"], cargo, python);
        assert!(calls.contains(&"cargo test --no-fail-fast".into()), "{calls:?}");
        let packaged = calls.iter().any(|call| call.starts_with("python -m pip install "));
        let tested = calls
            .iter()
            .any(|call| call.starts_with("python -m pytest ") && call.ends_with("tests/python_package"));
        assert!(packaged && (tested || python != 0), "{calls:?}");
        assert_eq!(code == 0, succeeds, "{calls:?}");
    }
}

#[test]
fn what_every_change_must_pass_is_tested_also_where_formatting_is_wrong() {
    let (calls, code) = calls(&["bash", ".ci/run"], 1, 0);
    for part in ["cargo fmt ", "cargo test ", "python -m pytest ", "python -m sphinx "] {
        assert!(calls.iter().any(|call| call.starts_with(part)), "no {part}in {calls:?}");
    }
    assert_ne!(code, 0);
    assert_eq!(self::calls(&["bash", ".ci/run"], 0, 0).1, 0);
}

#[test]
fn a_small_change_is_verified_by_the_tests_of_its_layers() {
    let script = r#"
        git init --quiet && mkdir -p harness/{spec,kernels,learning,report,experiment} tests
        for layer in spec kernels learning; do printf '[[test]]\nname = "%s"\n' $layer >harness/$layer/Cargo.toml; done
        touch tests/report.rs harness/learning/a.rs && git add .
        git -c user.name=a -c user.email=a@b commit --quiet --message a
        for file in $1; do echo b >>harness/$file; done
        make check
    "#;
    let check = |changed: &str| calls_in_clone(&["bash", "-c", script, "bash", changed], 0, 0);
    assert_eq!(check("").0, ["setup.sh ", "cargo check --all-targets"]);
    assert_eq!(check("spec/new.rs learning/a.rs").0[2..], ["cargo test --test learning --test spec"]);
    assert_eq!(check("kernels/amx.rs").0[2..], ["cargo test --test kernels --test learning"]);
    let (calls, output) = check("report/page.js experiment/lib.rs");
    assert_eq!(calls[2..], ["cargo test --test all -- report::"]);
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(said.contains("only type-checked: experiment"), "{said}");
}

/// The set-up and the Python package name MuJoCo's version again, since cargo does not know of them.
#[test]
fn every_file_asks_for_the_mujoco_that_the_bindings_are_for() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let lock = fs::read_to_string(root.join("Cargo.lock")).unwrap();
    let (_, rest) = lock.split_once("name = \"mujoco-rs\"\nversion = \"").unwrap();
    let (version, _) = rest.split_once('"').unwrap();
    let (_, wanted) = version.split_once("+mj-").unwrap();
    assert_eq!(wanted, harness::simulation::MUJOCO_VERSION);
    let inputs = fs::read_dir(root.join("setup")).unwrap().map(|entry| entry.unwrap().path());
    let inputs = inputs.filter(|path| path.extension().is_some_and(|ending| ending == "in"));
    let mut named = 0;
    for path in inputs.chain([root.join("pyproject.toml")]) {
        for asked in fs::read_to_string(&path).unwrap().split("mujoco==").skip(1) {
            let asked = asked.split(['"', '\n', ' ']).next().unwrap();
            assert_eq!(asked, wanted, "{}", path.display());
            named += 1;
        }
    }
    assert!(named >= 5, "{named}");
    let loaded = fs::read_to_string(root.join("python/harness/_mujoco.py")).unwrap();
    assert!(loaded.contains(&format!("\nVERSION = \"{wanted}\"\n")), "{loaded}");
    for document in ["README.md", "models/README.md"] {
        for asked in fs::read_to_string(root.join(document)).unwrap().split("MuJoCo 3.").skip(1) {
            let asked = format!("3.{}", asked.split([' ', ':', ',']).next().unwrap());
            assert!(wanted.starts_with(&asked), "{document}: {asked}");
        }
    }
}
