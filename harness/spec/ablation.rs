//! An ablation of the input: `vary: {input: {without: each}}` stands for a list of inputs.

use super::overrides::VARY;
use super::schema::WITHOUT;
use harness_yaml::{Node, Problem, Value};

/// The key of the modalities that the encoder gets.
const INPUT: &str = "input";

/// Replaces `{without: each}` under `vary` by a list: the input of the spec, and the input without each of its
/// modalities, in the order of the spec. The same applies to `vary` under `quick`.
///
/// # Errors
/// When `vary.input` is another section, or when the input has a single modality.
pub(super) fn list_inputs(tree: &mut Node) -> Result<(), Problem> {
    let own = tree.get(INPUT).cloned();
    let quick = tree.get("quick").and_then(|quick| quick.get(INPUT)).cloned().or_else(|| own.clone());
    expand(tree, own)?;
    tree.get_mut("quick").map_or(Ok(()), |settings| expand(settings, quick))
}

/// Replaces the ablation of a tree, or of its `quick` settings, by the list of its inputs.
fn expand(tree: &mut Node, input: Option<Node>) -> Result<(), Problem> {
    let Some(varied) = tree.get_mut(VARY).and_then(|vary| vary.get_mut(INPUT)) else { return Ok(()) };
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
    let place = varied.place.clone();
    let list = |modalities: Vec<Node>| Node { place: place.clone(), value: Value::List(modalities) };
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
