//! Specs that build on other specs: `extends: FILE.yaml`.

use super::built_in::{SPECS, YamlFile, beside};
use super::cells::TEST_WORLD;
use super::origin::Origin;
use super::schema::EXTENDS;
use super::vary::VARY;
use crate::yaml::{Node, Place, Problem, Value, join, parse};
use std::path::Path;
use std::sync::Arc;

/// The keys that a spec does not take from the spec on which it builds.
const OWN: [&str; 2] = ["name", "description"];

/// Returns the tree of a spec with everything that it takes from the spec on which it builds.
///
/// # Errors
/// When the text is not valid YAML, or `extends` names no file that can be read, or a spec extends itself.
pub(super) fn read(file: &YamlFile) -> Result<Node, Problem> {
    below(file, &mut vec![file.label.clone()])
}

/// `chain` has the names of the files that build on this one, and its own.
fn below(file: &YamlFile, chain: &mut Vec<String>) -> Result<Node, Problem> {
    let mut own = parse(&file.text)?;
    let Some(extends) = take(&mut own, EXTENDS) else { return Ok(own) };
    let refused = |message: String| Problem::new(&extends.place, message);
    let Value::Text(name) = &extends.value else {
        return Err(refused(format!("'{EXTENDS}': expected the path of a spec, found {}", extends.value)));
    };
    let base = beside(file, name, SPECS).map_err(|error| refused(format!("'{EXTENDS}': {error}")))?;
    if chain.contains(&base.label) {
        return Err(refused(format!(
            "'{EXTENDS}': {} > {}: a spec can't extend itself",
            chain.join(" > "),
            base.label
        )));
    }
    chain.push(base.label.clone());
    let path: Arc<str> = base.label.as_str().into();
    let in_base = |place: &Place| match place {
        Place::File { line, column } => Place::Base { path: path.clone(), line: *line, column: *column },
        other => other.clone(),
    };
    let tree =
        below(&base, chain).map_err(|problem| Problem::new(&in_base(&problem.place), problem.message))?;
    let mut tree = tree.placed(&in_base);
    OWN.iter().for_each(|key| drop(take(&mut tree, key)));
    relocate(&mut tree, "", Path::new(name).parent().unwrap_or(Path::new("")));
    merge(&mut tree, own);
    Ok(tree)
}

/// Takes a key out of a section.
fn take(tree: &mut Node, key: &str) -> Option<Node> {
    let Value::Section(entries) = &mut tree.value else { return None };
    let index = entries.iter().position(|entry| entry.key == key)?;
    Some(entries.remove(index).node)
}

/// Makes the paths of world files in the value of a dotted key, which are relative to `folder`, relative to the folder
/// above. They are in `scenarios` and `test.world`, also in those of an axis or of `quick`.
fn relocate(node: &mut Node, key: &str, folder: &Path) {
    let is_world = ["scenarios", TEST_WORLD].iter().any(|name| key.ends_with(name));
    match &mut node.value {
        Value::Section(entries) => {
            entries.iter_mut().for_each(|entry| relocate(&mut entry.node, &join(key, &entry.key), folder))
        }
        Value::List(items) => items.iter_mut().for_each(|item| relocate(item, key, folder)),
        Value::Text(text) if is_world && matches!(Origin::try_from(text.clone()), Ok(Origin::File(_))) => {
            *text = folder.join(&*text).to_string_lossy().into_owned();
        }
        _ => {}
    }
}

/// Puts `own` over `base`: sections are merged key by key. Everything else, and an axis of `vary`, replaces what the base
/// has. Nothing in the place of a section or a list leaves it out.
fn merge(base: &mut Node, own: Node) {
    match (&mut base.value, own.value) {
        (Value::Section(entries), Value::Section(own_entries)) => {
            for entry in own_entries {
                let Some(index) = entries.iter().position(|other| other.key == entry.key) else {
                    entries.push(entry);
                    continue;
                };
                let is_part = matches!(entries[index].node.value, Value::Section(_) | Value::List(_));
                if is_part && matches!(entry.node.value, Value::Null) {
                    entries.remove(index);
                    continue;
                }
                match entry.key == VARY {
                    true => replace_axes(&mut entries[index].node, entry.node),
                    false => merge(&mut entries[index].node, entry.node),
                }
                entries[index].key_place = entry.key_place;
            }
        }
        (value, own_value) => *value = own_value,
    }
    base.place = own.place;
}

/// Replaces the axes of a base by those of the same name in `own`, and adds the others.
fn replace_axes(base: &mut Node, own: Node) {
    if let (Value::Section(axes), Value::Section(own_axes)) = (&mut base.value, &own.value) {
        axes.retain(|axis| own_axes.iter().all(|own| own.key != axis.key));
    }
    merge(base, own);
    if let Value::Section(axes) = &mut base.value {
        axes.retain(|axis| !matches!(axis.node.value, Value::Null));
    }
}
