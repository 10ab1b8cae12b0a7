//! What the schemas of specs and worlds can't say.

use super::origin::Origin;
use super::split::Division;
use crate::layout::Modality;
use crate::yaml::{Entry, Hints, shorten};
use serde_json::Value as Json;

/// Texts that are compared with the existing worlds and datasets later, and messages about them.
pub(super) const HINTS: Hints = Hints { accepts, others, unknown_key };

fn accepts(definition: &str, text: &str) -> bool {
    match definition {
        "scenario" => Origin::try_from(text.to_owned()).is_ok(),
        "modality" => Modality::new(text).is_some(),
        "division" => Division::new(text).is_some(),
        _ => false,
    }
}

fn others(definition: &str) -> &'static str {
    match definition {
        "scenario" => ", the path of a world file, or the name of an imported dataset",
        "modality" => ", or a modality of another world or dataset",
        "division" => ", or a label of an imported dataset",
        "samples" => "; a choice by the test samples would make their errors too small",
        _ => "",
    }
}

/// The message about a version, which other programs' files have, and about a list in `vary` that has its own key at the
/// top of a spec.
fn unknown_key(entry: &Entry, path: &str) -> Option<String> {
    if entry.key == "version" && path.is_empty() {
        return Some(
            "there is no key 'version'; leave it out: each run records the version of the harness that made it".into(),
        );
    }
    /// The lists of a spec of which each value has its own runs.
    const LISTS: [&str; 3] = ["scenarios", "latent", "seeds"];
    if path.rsplit('.').next() != Some("vary") || !LISTS.contains(&entry.key.as_str()) {
        return None;
    }
    let key = &entry.key;
    let value = shorten(&flattened(entry.node.to_json()).to_string());
    Some(format!(
        "'{key}' is a list already; leave it out of '{path}', and write {key}: {value} at the top level of the spec"
    ))
}

/// A list in which each list is replaced by its elements; `vary` may have lists of lists.
fn flattened(value: Json) -> Json {
    let Json::Array(elements) = value else { return value };
    let elements = elements.into_iter().flat_map(|element| match element {
        Json::Array(inner) => inner,
        element => vec![element],
    });
    Json::Array(elements.collect())
}
