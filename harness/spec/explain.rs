//! Where the values of an experiment's settings come from.

use super::cells::DATASET_SEED;
use super::outputs::written_key;
use super::vary::FOLD;
use super::{Experiment, Purpose, SPECS, SpecError, Variants, WorldFiles, find, load_tree, resolve};
use crate::yaml::{Node, Place, Value, join};
use serde_json::Value as Json;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The settings of one variant of an experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct Explained {
    /// The variant, as in the column `variant`. Empty if the experiment varies nothing.
    pub variant: String,
    /// All settings, in the order of the keys of a spec.
    pub settings: Vec<Sourced>,
}

/// A setting and where its value comes from.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Sourced {
    /// The dotted key.
    pub key: String,
    /// The value in JSON.
    pub value: String,
    /// The point of an axis, the file with line, or the override that sets it; `None` if the value is the default.
    pub source: Option<String>,
}

/// Returns the settings of an experiment for each of its variants. The arguments are those of [`load`](super::load).
pub fn explain(path: &Path, overrides: &[String], quick: bool) -> Result<Vec<Explained>, SpecError> {
    let file = find("experiment", path, SPECS)?;
    let mut worlds = WorldFiles { folder: &file.folder, purpose: Purpose::Training, read: BTreeMap::new() };
    let of_file = |problem| SpecError::of(problem, &file.label);
    let (tree, experiment) = load_tree(&mut worlds, &file, overrides, quick).map_err(of_file)?;
    let trees = Variants::of(&tree);
    let (mut explained, mut done) = (Vec::new(), BTreeSet::new());
    for combination in experiment.combinations() {
        let variant = combination.name();
        // Runs on several datasets belong to the same variant.
        if !done.insert(variant.clone()) {
            continue;
        }
        let tree = trees.tree(&combination);
        let alone = resolve(&mut worlds, &tree).map_err(of_file)?.alone().canonical();
        let source = |key: &str| {
            let place = written(&tree, key).map(|place| name_of(place, &file.label));
            match (combination.origin(key), place) {
                (Some(point), Some(place)) => Some(format!("{point}, {place}")),
                (_, place) => place,
            }
        };
        let all = |key: &str| experiment.vary.get(key).map(Json::to_string);
        let sourced = |(key, value): (String, String)| {
            let value = all(&key).filter(|_| [DATASET_SEED, FOLD].contains(&key.as_str())).unwrap_or(value);
            let key = written_key(&key).filter(|key| written(&tree, key).is_some()).unwrap_or(key);
            Sourced { source: source(&key), key, value }
        };
        explained.push(Explained { variant, settings: settings(&alone).into_iter().map(sourced).collect() });
    }
    Ok(explained)
}

/// The settings of an experiment by dotted key, without what names it.
fn settings(experiment: &Experiment) -> Vec<(String, String)> {
    fn collect(value: &Json, path: &str, found: &mut Vec<(String, String)>) {
        match value {
            Json::Object(entries) => {
                entries.iter().for_each(|(key, value)| collect(value, &join(path, key), found));
            }
            value => found.push((path.to_owned(), value.to_string())),
        }
    }
    let mut found = Vec::new();
    let tree = serde_json::to_value(experiment).expect("an experiment is plain data");
    collect(&tree, "", &mut found);
    found.retain(|(key, _)| !["name", "description"].contains(&key.as_str()));
    found
}

/// Where the value of a dotted key was written; `None` if it was not.
fn written<'a>(tree: &'a Node, path: &str) -> Option<&'a Place> {
    match &tree.value {
        _ if path.is_empty() => Some(&tree.place),
        Value::Section(entries) => entries.iter().find_map(|entry| {
            let rest = path.strip_prefix(entry.key.as_str())?;
            written(&entry.node, if rest.is_empty() { rest } else { rest.strip_prefix('.')? })
        }),
        _ => None,
    }
}

/// The name of a place: a file with the line, or an override. `path` is the spec's own file.
fn name_of(place: &Place, path: &str) -> String {
    match place {
        Place::File { line, .. } => format!("{path}:{line}"),
        Place::Base { path, line, .. } => format!("{path}:{line}"),
        Place::Override(_) => "override".to_owned(),
    }
}
