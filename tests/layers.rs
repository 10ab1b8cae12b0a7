//! The table of layers in ARCHITECTURE.md, compared with cargo's dependencies of the crates.

use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;
use std::sync::LazyLock;

/// The libraries that some layers must not contain: their names in ARCHITECTURE.md and in cargo.
const LIBRARIES: [(&str, &str); 3] =
    [("candle", "candle-core"), ("MuJoCo", "mujoco-rs"), ("Polars", "polars")];

/// A row of the table: a crate, the project's crates that it may use, and the libraries that it must not contain.
struct Layer {
    name: &'static str,
    uses: BTreeSet<&'static str>,
    without: BTreeSet<&'static str>,
}

/// The layers from the lowest to the highest, without the root crate and the Python package.
static LAYERS: LazyLock<Vec<Layer>> = LazyLock::new(|| {
    let text = include_str!("../ARCHITECTURE.md");
    let (_, table) = text.split_once("| crate | may use | must not contain |\n|---|---|---|\n").unwrap();
    let rows = table.lines().take_while(|line| line.starts_with("| `") && !line.contains("`harness"));
    let layer = |row: &'static str| {
        let [name, uses, without] = row.trim_matches('|').split('|').collect::<Vec<_>>()[..] else {
            panic!("{row}")
        };
        let words =
            |cell: &'static str| cell.split(',').map(str::trim).filter(|word| !word.is_empty()).collect();
        Layer { name: name.trim().trim_matches('`'), uses: words(uses), without: words(without) }
    };
    rows.map(layer).collect()
});

/// Cargo's metadata of the workspace and all its dependencies on this platform. Cargo downloads no others when it
/// compiles, so this needs no network.
static METADATA: LazyLock<Value> = LazyLock::new(|| {
    let platform = format!("{}-unknown-linux-gnu", std::env::consts::ARCH);
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--locked", "--filter-platform", &platform])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
});

fn array(value: &Value) -> &[Value] {
    value.as_array().unwrap()
}

/// The name of each package, by its id.
static NAMES: LazyLock<BTreeMap<&str, &str>> = LazyLock::new(|| {
    let of = |package: &'static Value| (package["id"].as_str().unwrap(), package["name"].as_str().unwrap());
    array(&METADATA["packages"]).iter().map(of).collect()
});

/// The direct dependencies of each package by name, without those of tests.
static PARTS: LazyLock<BTreeMap<&str, BTreeSet<&str>>> = LazyLock::new(|| {
    let mut parts = BTreeMap::<&str, BTreeSet<&str>>::new();
    for node in array(&METADATA["resolve"]["nodes"]) {
        let is_part =
            |dependency: &&Value| array(&dependency["dep_kinds"]).iter().any(|kind| kind["kind"] != "dev");
        let found =
            array(&node["deps"]).iter().filter(is_part).map(|part| NAMES[part["pkg"].as_str().unwrap()]);
        parts.entry(NAMES[node["id"].as_str().unwrap()]).or_default().extend(found);
    }
    parts
});

/// All direct and indirect dependencies of a package.
fn contents(package: &'static str) -> BTreeSet<&'static str> {
    let (mut seen, mut left) = (BTreeSet::new(), vec![package]);
    while let Some(package) = left.pop() {
        left.extend(PARTS[package].iter().filter(|part| seen.insert(**part)));
    }
    seen
}

/// The project's crates among these names, without their prefix.
fn own<'a>(names: &BTreeSet<&'a str>) -> BTreeSet<&'a str> {
    names.iter().filter_map(|name| name.strip_prefix("harness-")).collect()
}

/// The package of a layer.
fn package(layer: &str) -> &'static str {
    let name = format!("harness-{layer}");
    PARTS.keys().find(|known| **known == name).unwrap_or_else(|| panic!("there is no crate {name}"))
}

#[test]
fn a_crate_uses_only_the_layers_that_it_may() {
    for Layer { name, uses, .. } in &*LAYERS {
        let used = own(&PARTS[package(name)]);
        assert!(used.is_subset(uses), "{name} may use {uses:?}, and uses {used:?}");
    }
}

#[test]
fn layers_use_lower_layers_alone_and_every_crate_is_one() {
    let mut below = BTreeSet::new();
    for Layer { name, uses, .. } in &*LAYERS {
        assert!(uses.iter().all(|used| below.contains(used)), "{name} uses a layer above it");
        below.insert(*name);
    }
    let members = array(&METADATA["workspace_members"]).iter().map(|id| NAMES[id.as_str().unwrap()]);
    let mut members = own(&members.collect());
    assert!(members.remove("python"));
    assert_eq!(members, below);
}

#[test]
fn libraries_stay_in_the_layers_that_are_about_them() {
    for Layer { name, without, .. } in &*LAYERS {
        let contents = contents(package(name));
        for (library, package) in LIBRARIES {
            let allowed = !without.contains(library);
            assert!(allowed || !contents.contains(package), "{name} must not contain {library}");
        }
        assert!(
            without.iter().all(|name| LIBRARIES.iter().any(|(library, _)| name == library)),
            "{without:?}"
        );
    }
    // The libraries exist, and the most important rows exclude them.
    let everything = contents(package("experiment"));
    assert!(LIBRARIES.iter().all(|(_, package)| everything.contains(package)));
    let without = |name: &str| &LAYERS.iter().find(|layer| layer.name == name).unwrap().without;
    assert_eq!(without("spec").len(), 3);
    assert!(without("simulation").is_superset(&["candle", "Polars"].into()));
    assert!(without("learning").contains("MuJoCo"));
}

/// `test = false` avoids an empty test program, but would also disable unit tests.
#[test]
fn every_crate_with_unit_tests_runs_them() {
    fn has_tests(folder: &Path) -> bool {
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).any(|path| {
            if path.is_dir() {
                return has_tests(&path);
            }
            path.extension().is_some_and(|end| end == "rs")
                && std::fs::read_to_string(&path).unwrap().contains("#[cfg(test)]")
        })
    }
    for package in array(&METADATA["packages"]) {
        let name = package["name"].as_str().unwrap();
        if !LAYERS.iter().any(|layer| name == format!("harness-{}", layer.name)) {
            continue;
        }
        let folder = Path::new(package["manifest_path"].as_str().unwrap()).parent().unwrap();
        let library = array(&package["targets"]).iter().find(|target| target["kind"][0] == "lib").unwrap();
        assert!(library["test"] == true || !has_tests(folder), "{name}: set `test` in its Cargo.toml");
    }
}

#[test]
fn a_change_of_any_crate_of_the_report_renders_its_pictures() {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("harness/report/build.rs");
    let script = std::fs::read_to_string(script).unwrap();
    for name in own(&contents(package("report"))) {
        assert!(script.contains(&format!("\"../{name}\"")), "harness/report/build.rs lacks {name}");
    }
}
