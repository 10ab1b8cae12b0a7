//! Writes every axis of `vary` in its full form: a list of values, or labels with all of their settings.

use super::hints::HINTS;
use super::schema::{self, EXTENDS, WITHOUT};
use crate::yaml::{Entry, Node, Problem, Value, unknown};

/// Key of the axes in which runs differ.
pub(super) const VARY: &str = "vary";
/// The setting that distinguishes the folds of a recording, each of which is like a dataset of its own.
pub(super) const FOLD: &str = "split.fold";
/// The setting that makes a run for each fold.
const FOLDS: &str = "split.folds";
/// The setting whose list of values is short for an axis.
const HORIZON: &str = "window.horizon";
/// The key of the modalities that the encoder gets.
const INPUT: &str = "input";

/// Completes the axes of a spec and those under its `quick`.
///
/// - A list of horizons becomes the first axis. That of an override replaces the one that the spec has.
/// - A label gets the settings of the label that it extends. Its own replace them.
/// - `input: {without: each}` becomes a list: the input of the spec, and the input without each of its modalities, in
///   the order of the spec.
///
/// # Errors
/// When an axis is neither a setting nor has labels, when a label extends an unknown one or itself, or when the input
/// of an ablation has a single modality.
pub(super) fn complete(tree: &mut Node, is_overridden: bool) -> Result<(), Problem> {
    move_horizons(tree, is_overridden)?;
    refuse_folds(tree.get(VARY))?;
    refuse_folds(tree.get("quick").and_then(|quick| quick.get(VARY)))?;
    list_folds(tree)?;
    let input = tree.get(INPUT).cloned();
    axes(tree.get_mut(VARY), input.as_ref())?;
    let Some(quick) = tree.get_mut("quick") else { return Ok(()) };
    let input = quick.get(INPUT).cloned().or(input);
    axes(quick.get_mut(VARY), input.as_ref())
}

/// Makes a list of horizons the first axis, `window.horizon`.
fn move_horizons(tree: &mut Node, is_overridden: bool) -> Result<(), Problem> {
    let Some(Node { value: Value::Section(window), .. }) = tree.get_mut("window") else { return Ok(()) };
    let is_list = |entry: &Entry| entry.key == "horizon" && matches!(entry.node.value, Value::List(_));
    let Some(index) = window.iter().position(is_list) else { return Ok(()) };
    let axis = Entry { key: HORIZON.to_owned(), ..window.remove(index) };
    if is_overridden {
        remove_axis(tree, HORIZON);
    }
    let Value::Section(entries) = &mut tree.value else { return Ok(()) };
    make_first_axis(entries, axis, HORIZON)
}

/// Refuses axes and labels with a number of folds, which makes runs by itself.
fn refuse_folds(node: Option<&Node>) -> Result<(), Problem> {
    let Some(Node { value: Value::Section(entries), .. }) = node else { return Ok(()) };
    for entry in entries {
        if entry.key == FOLDS {
            let message = format!(
                "'{FOLDS}' can't vary, because there is a run for each fold; write a spec for each number of folds"
            );
            return Err(Problem::new(&entry.key_place, message));
        }
        refuse_folds(Some(&entry.node))?;
    }
    Ok(())
}

/// Makes a run for each fold, unless the spec names one.
fn list_folds(tree: &mut Node) -> Result<(), Problem> {
    let Some(split) = tree.get("split") else { return Ok(()) };
    let is_one = split.get("fold").is_some_and(|fold| !matches!(fold.value, Value::Null));
    let Some(Node { value: Value::Integer(folds), place }) = split.get("folds").filter(|_| !is_one) else {
        return Ok(());
    };
    // Too many are refused later.
    let values = serde_json::json!((0..(*folds).clamp(0, 1000) as u64).collect::<Vec<_>>());
    let axis = Entry { key: FOLD.to_owned(), key_place: place.clone(), node: Node::of_json(&values, place) };
    remove_axis(tree, FOLD);
    let Value::Section(entries) = &mut tree.value else { return Ok(()) };
    make_first_axis(entries, axis, FOLD)
}

fn remove_axis(tree: &mut Node, key: &str) {
    if let Some(Node { value: Value::Section(axes), .. }) = tree.get_mut(VARY) {
        axes.retain(|axis| axis.key != key);
    }
}

/// Adds the first axis to a spec. `origin` is the key that had its values.
fn make_first_axis(entries: &mut Vec<Entry>, axis: Entry, origin: &str) -> Result<(), Problem> {
    match entries.iter_mut().find(|entry| entry.key == VARY) {
        Some(vary) if vary.node.get(&axis.key).is_some() => {
            let message = format!("'{origin}' is the same as '{VARY}.{}'; leave one of them out", axis.key);
            return Err(Problem::new(&axis.key_place, message));
        }
        Some(Entry { node: Node { value: Value::Section(axes), .. }, .. }) => axes.insert(0, axis),
        Some(_) => {}
        None => {
            let key_place = axis.key_place.clone();
            let node = Node { place: key_place.clone(), value: Value::Section(vec![axis]) };
            entries.push(Entry { key: VARY.into(), key_place, node });
        }
    }
    Ok(())
}

/// Completes the axes under one `vary`, if there is one. `input` is that of the spec.
pub(super) fn axes(vary: Option<&mut Node>, input: Option<&Node>) -> Result<(), Problem> {
    let Some(Node { value: Value::Section(axes), .. }) = vary else { return Ok(()) };
    for axis in axes {
        match &axis.node.value {
            Value::Section(_) if axis.key == INPUT => list_inputs(&mut axis.node, input)?,
            Value::Section(labels) => {
                let settings = |label| -> Result<Entry, Problem> {
                    let node = settings_of(label, labels, &axis.key, &mut Vec::new())?;
                    Ok(Entry { node, ..Entry::clone(label) })
                };
                axis.node.value = Value::Section(labels.iter().map(settings).collect::<Result<_, _>>()?);
            }
            _ if schema::varies(&axis.key) => {}
            _ => return Err(Problem::new(&axis.key_place, no_axis(axis))),
        }
    }
    Ok(())
}

/// The message about an axis that is no setting and has no labels.
fn no_axis(axis: &Entry) -> String {
    (HINTS.unknown_key)(axis, VARY).unwrap_or_else(|| {
        let names = schema::setting_names();
        let names: Vec<&str> = names.iter().map(String::as_str).filter(|name| schema::varies(name)).collect();
        let message = unknown("key", &axis.key, VARY, &names, str::to_owned);
        format!("{message}, or the name of an axis with labels")
    })
}

/// Returns the settings of a label with those of the label that it extends. `chain` has the labels that extend it.
fn settings_of<'a>(
    label: &'a Entry,
    labels: &'a [Entry],
    axis: &str,
    chain: &mut Vec<&'a str>,
) -> Result<Node, Problem> {
    let Some(extends) = label.node.get(EXTENDS) else { return Ok(label.node.clone()) };
    chain.push(&label.key);
    let path = format!("{VARY}.{axis}.{}.{EXTENDS}", label.key);
    let refused = |message: String| Err(Problem::new(&extends.place, message));
    let Value::Text(name) = &extends.value else {
        return refused(format!("'{path}': expected the name of a label, found {}", extends.value));
    };
    let Some(base) = labels.iter().find(|other| other.key == *name) else {
        let names: Vec<&str> = labels.iter().map(|label| label.key.as_str()).collect();
        return refused(unknown("label", name, &path, &names, str::to_owned));
    };
    if chain.contains(&base.key.as_str()) {
        return refused(format!("'{path}': {} extends itself: {} > {name}", base.key, chain.join(" > ")));
    }
    let mut settings = settings_of(base, labels, axis, chain)?;
    settings.place = label.node.place.clone();
    let (Value::Section(settings_of_base), Value::Section(own)) = (&mut settings.value, &label.node.value)
    else {
        return Ok(settings);
    };
    let own = || own.iter().filter(|entry| entry.key != EXTENDS);
    settings_of_base.retain(|entry| own().all(|other| other.key != entry.key));
    settings_of_base.extend(own().cloned());
    Ok(settings)
}

/// Replaces an ablation by the list of its inputs.
fn list_inputs(varied: &mut Node, input: Option<&Node>) -> Result<(), Problem> {
    let Value::Section(entries) = &varied.value else { return Ok(()) };
    let [key, each] = WITHOUT;
    if !matches!(&entries[..], [entry] if entry.key == key && entry.node.to_json() == each) {
        let message = format!(
            "'{VARY}.{INPUT}': expected a list of inputs, or {{{key}: {each}}} for the input and the input without \
             each of its modalities"
        );
        return Err(Problem::new(&varied.place, message));
    }
    // An input that is no list is refused later.
    let Some(Node { value: Value::List(modalities), .. }) = input else { return Ok(()) };
    if modalities.len() < 2 {
        let message = format!(
            "'{VARY}.{INPUT}': the input has a single modality, so none can be left out; use more, or leave \
             '{VARY}.{INPUT}' out"
        );
        return Err(Problem::new(&varied.place, message));
    }
    let list = |modalities| Node { place: varied.place.clone(), value: Value::List(modalities) };
    let without = |left_out: usize| {
        let mut others = modalities.clone();
        others.remove(left_out);
        list(others)
    };
    let inputs =
        std::iter::once(list(modalities.clone())).chain((0..modalities.len()).map(without)).collect();
    varied.value = Value::List(inputs);
    Ok(())
}
