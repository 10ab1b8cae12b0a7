//! Import cycles between the files of a crate.
//!
//! A file imports another if a path that begins with `crate::` or `super::` leads to it. A name that a file re-exports
//! leads to the file that it comes from. Imports between a file and the modules that contain it do not count: a
//! module's own file declares the modules in it, and they use what it defines for all of them.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// The names from the root of a crate to a module or an item.
type Names = Vec<String>;

/// The root files of the crates.
fn roots() -> Vec<PathBuf> {
    let project = Path::new(env!("CARGO_MANIFEST_DIR"));
    let pattern = project.join("harness/*/lib.rs");
    let layers = glob::glob(pattern.to_str().unwrap()).unwrap().map(Result::unwrap);
    let others = ["harness/lib.rs", "harness/main.rs", "python/src/lib.rs"].map(|root| project.join(root));
    layers.chain(others).collect()
}

/// The text without comments and unit tests.
fn code(text: &str) -> String {
    let text = text.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
    text.lines().map(|line| line.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

/// The code of each file of a crate, by its module.
fn modules(root: &Path) -> BTreeMap<Names, String> {
    fn add(file: &Path, folder: &Path, module: Names, found: &mut BTreeMap<Names, String>) {
        let code = code(&fs::read_to_string(file).unwrap());
        for line in code.lines() {
            let name = line.strip_suffix(';').and_then(|line| line.split_once("mod "));
            let Some((_, name)) = name.filter(|(before, _)| before.is_empty() || before.starts_with("pub"))
            else {
                continue;
            };
            let files = [folder.join(format!("{name}.rs")), folder.join(name).join("mod.rs")];
            let file = files.iter().find(|file| file.exists()).unwrap_or_else(|| panic!("no file of {name}"));
            add(file, &folder.join(name), [module.as_slice(), &[name.to_owned()]].concat(), found);
        }
        found.insert(module, code);
    }
    let mut found = BTreeMap::new();
    add(root, root.parent().unwrap(), Vec::new(), &mut found);
    found
}

/// The paths of a use tree such as `a::{b, c::d}`, which may also be a path within an expression.
fn paths(tree: &str) -> Vec<Names> {
    fn parse<'a>(tree: &mut &'a str, before: &[&'a str], found: &mut Vec<Names>) {
        *tree = tree.trim_start();
        if let Some(group) = tree.strip_prefix('{') {
            *tree = group;
            loop {
                *tree = tree.trim_start_matches(|c: char| c.is_whitespace() || c == ',');
                if tree.is_empty() {
                    return;
                }
                if let Some(rest) = tree.strip_prefix('}') {
                    *tree = rest;
                    return;
                }
                parse(tree, before, found);
            }
        }
        let end = tree.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(tree.len());
        let (name, rest) = tree.split_at(end);
        let path = [before, &[name]].concat();
        *tree = rest;
        match rest.strip_prefix("::") {
            Some(rest) => {
                *tree = rest;
                parse(tree, &path, found);
            }
            None => {
                found.push(path.iter().map(|name| (*name).to_owned()).collect());
                // `*`, and the new name in `a as b`
                let end = tree.find([',', '}', ';']).unwrap_or(tree.len());
                *tree = &tree[end..];
            }
        }
    }
    let (mut tree, mut found) = (tree, Vec::new());
    parse(&mut tree, &[], &mut found);
    found
}

/// The modules that each module imports.
fn imports(modules: &BTreeMap<Names, String>) -> BTreeMap<&Names, BTreeSet<&Names>> {
    let place = |path: &[String]| {
        (0..=path.len()).rev().find_map(|len| modules.get_key_value(&path[..len])).unwrap().0
    };
    let mut exported: BTreeMap<Names, &Names> = BTreeMap::new();
    for (module, code) in modules {
        for (at, _) in code.match_indices("\npub use ") {
            for path in paths(&code[at + "\npub use ".len()..]) {
                let from = match path[0].as_str() {
                    "crate" => path[1..].to_vec(),
                    _ => [module.as_slice(), &path].concat(),
                };
                let own = [module.as_slice(), &path[path.len() - 1..]].concat();
                exported.insert(own, place(&from));
            }
        }
    }
    let mut found: BTreeMap<&Names, BTreeSet<&Names>> = BTreeMap::new();
    for (module, code) in modules {
        let parent = &module[..module.len().saturating_sub(1)];
        for (start, base) in [("crate::", &[] as &[String]), ("super::", parent)] {
            for (at, _) in code.match_indices(start) {
                if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == ':' || c == '$') {
                    continue;
                }
                for path in paths(&code[at + start.len()..]) {
                    let above = path.iter().take_while(|name| *name == "super").count();
                    let base = &base[..base.len().saturating_sub(above)];
                    let path = [base, &path[above..]].concat();
                    let mut to = place(&path);
                    if let Some(from) = path
                        .get(to.len())
                        .and_then(|name| exported.get(&[to.as_slice(), std::slice::from_ref(name)].concat()))
                    {
                        to = from;
                    }
                    if !module.starts_with(to) && !to.starts_with(module) {
                        found.entry(module).or_default().insert(to);
                    }
                }
            }
        }
    }
    found
}

/// The groups of modules that import each other, directly or through others.
fn cycles(modules: &BTreeMap<Names, String>) -> BTreeSet<BTreeSet<String>> {
    let imports = imports(modules);
    let reached = imports.keys().map(|module| {
        let (mut seen, mut left) = (BTreeSet::new(), vec![*module]);
        while let Some(module) = left.pop() {
            left.extend(imports.get(module).into_iter().flatten().filter(|to| seen.insert(**to)));
        }
        (*module, seen)
    });
    let reached: BTreeMap<&Names, BTreeSet<&Names>> = reached.collect();
    let in_cycles = reached.iter().filter(|(module, to)| to.contains(*module));
    let group = |(module, to): (&&Names, &BTreeSet<&Names>)| {
        let back = to.iter().filter(|other| reached.get(**other).is_some_and(|to| to.contains(*module)));
        back.map(|other| other.join("::")).collect()
    };
    in_cycles.map(group).collect()
}

#[test]
fn files_do_not_import_each_other() {
    for root in roots() {
        let name = root.strip_prefix(env!("CARGO_MANIFEST_DIR")).unwrap().display().to_string();
        assert_eq!(cycles(&modules(&root)), BTreeSet::new(), "{name}");
    }
}

#[test]
fn cycles_are_found_through_reexports_and_in_expressions() {
    let cycles = |files: &[(&str, &str)]| {
        let name = |path: &str| path.split("::").filter(|name| !name.is_empty()).map(str::to_owned).collect();
        cycles(&files.iter().map(|(path, text)| (name(path), code(text))).collect())
    };
    let group = |names: &[&str]| BTreeSet::from([names.iter().map(|name| (*name).to_owned()).collect()]);
    let root = ("", "\npub use a::{A, f as g};\nmod a;\nmod b;");
    assert_eq!(
        cycles(&[root, ("a", "use super::b::B;"), ("b", "use crate::{A, other::C};")]),
        group(&["a", "b"])
    );
    assert_eq!(
        cycles(&[root, ("a", "fn f() { super::b::f() }"), ("b", "use super::a;")]),
        group(&["a", "b"])
    );
    assert_eq!(cycles(&[root, ("a", "use super::b::B;"), ("b", "// use super::a;")]), BTreeSet::new());
    // A module's own file, and what is defined there.
    assert_eq!(
        cycles(&[root, ("a", "pub use b::B;"), ("a::b", "use super::A;\nuse crate::Root;")]),
        BTreeSet::new()
    );
    let nested =
        [("", ""), ("a", ""), ("a::b", "use super::super::c::C;"), ("c", "use crate::a::b::{self, B};")];
    assert_eq!(cycles(&nested), group(&["a::b", "c"]));
}
