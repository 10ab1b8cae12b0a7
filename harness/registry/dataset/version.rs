//! Versions of a world: what determines its episodes besides the settings of the simulation.

use super::description::{Description, MODEL};
use harness_shared::seal::hex;
use roxmltree::{Document, Node};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

/// The parts that only some runs in a world have begin with this word: the factors that their specs turn on.
const FACTOR: &str = "factor";

/// A version of a world, as short texts by part: hashes of its `model`, its `file` and its recorded `course`, the
/// version of `mujoco` and the `format` of recordings, and a hash of each factor that a dataset turns on. Each text
/// changes with the part.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorldVersion(BTreeMap<String, String>);

impl WorldVersion {
    /// Returns the version in the description of a simulated dataset.
    pub(super) fn of(description: &Value) -> Self {
        let mut parts = BTreeMap::new();
        let mut add = |part: String, value: &Value| match value {
            Value::Null => {}
            Value::String(text) => drop(parts.insert(part, text.chars().take(16).collect())),
            Value::Number(number) => drop(parts.insert(part, number.to_string())),
            other => drop(parts.insert(part, digest(other.clone()))),
        };
        for (part, key) in [
            ("format", "format"),
            ("model", "model_sha256"),
            ("mujoco", "mujoco"),
            ("file", "world"),
            ("course", "course_sha256"),
            ("factor_rule", "factor_rule"),
        ] {
            add(part.to_owned(), &description[key]);
        }
        for (name, factor) in description["factors"].as_object().into_iter().flatten() {
            add(format!("{FACTOR}.{name}"), factor);
        }
        Self(parts)
    }

    /// Returns a version of which nothing is known but that it gave the dataset `dataset` for these settings.
    pub fn unknown(settings: &str, dataset: &str) -> Self {
        Self(BTreeMap::from([
            ("model".to_owned(), "unknown".to_owned()),
            (format!("{FACTOR}.{settings}"), dataset.to_owned()),
        ]))
    }

    /// Returns a short name of the version. Datasets that differ only in which factors are on have the same.
    pub fn id(&self) -> String {
        let parts: BTreeMap<&String, &String> = self.0.iter().filter(|(part, _)| !is_factor(part)).collect();
        digest(serde_json::json!(parts))[..8].to_owned()
    }

    /// Whether both can be the same version: they differ at most in which factors are on.
    pub fn agrees_with(&self, other: &Self) -> bool {
        self.differing(other).is_empty()
    }

    /// Returns the parts that differ between two versions. A factor that only one of them has is none of them.
    pub fn differing<'a>(&'a self, other: &'a Self) -> Vec<&'a str> {
        let differs = |part: &&String| match (self.0.get(*part), other.0.get(*part)) {
            (Some(own), Some(others)) => own != others,
            _ => !is_factor(part),
        };
        let mut parts: Vec<&str> =
            self.0.keys().chain(other.0.keys()).filter(differs).map(String::as_str).collect();
        parts.sort_unstable();
        parts.dedup();
        parts
    }

    /// Adds the factors of a version that agrees with this one.
    pub fn extend(&mut self, other: &Self) {
        self.0.extend(other.0.clone());
    }
}

fn is_factor(part: &str) -> bool {
    part.starts_with(FACTOR)
}

/// Returns the first digits of the hash of a value. The order of keys does not matter.
fn digest(mut value: Value) -> String {
    value.sort_all_objects();
    hex(&Sha256::digest(value.to_string()))[..16].to_owned()
}

/// Returns what the world of the simulated dataset in a folder consists of, as texts by name: the model's elements with
/// their attributes, the world file's entries and the definitions of factors. Empty if the folder is gone. Datasets of
/// earlier versions lack the model.
pub fn world_parts(folder: &Path) -> BTreeMap<String, String> {
    let mut parts = BTreeMap::new();
    if let Ok(Description(description)) = Description::read(folder) {
        for key in ["world", "factors"] {
            add_leaves(&mut parts, key, &description[key]);
        }
    }
    if let Ok(xml) = std::fs::read_to_string(folder.join(MODEL))
        && let Ok(model) = Document::parse(&xml)
    {
        add_element(&mut parts, "", model.root_element());
    }
    parts
}

/// Whether a part of a world, one of [`world_parts`], is one of its model.
pub fn is_of_model(part: &str) -> bool {
    !["world.", "factors."].iter().any(|start| part.starts_with(start))
}

fn add_leaves(parts: &mut BTreeMap<String, String>, key: &str, value: &Value) {
    match value {
        Value::Object(entries) => {
            entries.iter().for_each(|(name, value)| add_leaves(parts, &format!("{key}.{name}"), value));
        }
        Value::Null => {}
        Value::String(text) => drop(parts.insert(key.to_owned(), text.clone())),
        other => drop(parts.insert(key.to_owned(), other.to_string())),
    }
}

/// Adds the attributes of an element and of those in it. Its key is its kind and name or, without a name, its place in
/// the element around it. A body's parent is one of its attributes.
fn add_element(parts: &mut BTreeMap<String, String>, key: &str, element: Node) {
    for attribute in element.attributes().filter(|attribute| attribute.name() != "name") {
        parts.insert(
            format!("{key} {}", attribute.name()).trim_start().to_owned(),
            attribute.value().to_owned(),
        );
    }
    let mut unnamed: BTreeMap<&str, usize> = BTreeMap::new();
    for inner in element.children().filter(Node::is_element) {
        let tag = inner.tag_name().name();
        let name = inner.attribute("name").or_else(|| inner.attribute("class").filter(|_| tag == "default"));
        // Names are unique among the parts of bodies, and elsewhere in the section that has them.
        let is_of_body = |node: &Node| ["worldbody", "body", "frame"].contains(&node.tag_name().name());
        let around = if is_of_body(&element) && name.is_some() { "" } else { key };
        let inner_key = match name {
            Some(name) => format!("{around} {tag} '{name}'"),
            None if is_alone(&inner) => format!("{around} {tag}"),
            None => {
                let place = unnamed.entry(tag).or_default();
                *place += 1;
                format!("{around} {tag} {place}")
            }
        };
        let inner_key = inner_key.trim_start();
        if is_of_body(&element) && name.is_some() {
            parts.insert(format!("{inner_key} in"), key.to_owned());
        }
        add_element(parts, inner_key, inner);
    }
}

/// Whether no other element beside this one is of its kind.
fn is_alone(element: &Node) -> bool {
    let beside = element.parent().into_iter().flat_map(|around| around.children());
    beside.filter(|other| other.tag_name() == element.tag_name()).count() == 1
}
