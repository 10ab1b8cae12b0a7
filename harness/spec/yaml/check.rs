//! Checks of a file against a JSON schema: keys, types, choices and bounds.

use super::parse::{Entry, Node, Value, shorten};
use super::{Problem, is_name};
use harness_shared::nearest;
use serde_json::{Value as Json, json};
use std::collections::HashSet;

/// How a message calls a string.
const TEXT: &str = "a text";

/// What a schema can't say. A definition is named in lower case.
pub struct Hints {
    /// Whether a text that an enumeration does not list is valid in its place.
    pub accepts: fn(definition: &str, text: &str) -> bool,
    /// What is allowed besides the values of an enumeration; it follows them in a message.
    pub others: fn(definition: &str) -> &'static str,
    /// The message about a key that is not allowed at a dotted path; `None` for the usual one.
    pub unknown_key: fn(entry: &Entry, path: &str) -> Option<String>,
}

/// Changes `schema` so that it also accepts a single value for each list that may have one item.
pub fn allow_single_values(schema: &mut Json) {
    match schema {
        Json::Array(schemas) => schemas.iter_mut().for_each(allow_single_values),
        Json::Object(keywords) => keywords.values_mut().for_each(allow_single_values),
        _ => return,
    }
    if !takes_one_item(schema) {
        return;
    }
    let mut either = json!({ "anyOf": [schema, schema["items"]] });
    for key in ["description", "default"] {
        if let Some(value) = either["anyOf"][0].as_object_mut().and_then(|list| list.remove(key)) {
            either[key] = value;
        }
    }
    *schema = either;
}

/// Makes a list of each single value that stands where the schema wants a list: `latent: 4` becomes `latent: [4]`.
pub fn list_single(root: &Json, tree: &mut Node) {
    list_below(root, root, tree);
}

fn list_below(root: &Json, schema: &Json, node: &mut Node) {
    let (schema, _) = resolve(root, schema);
    let is_list = matches!(node.value, Value::List(_));
    if takes_one_item(schema) && !is_list && fits(root, &schema["items"], &node.value) {
        node.value = Value::List(vec![node.clone()]);
    }
    match &mut node.value {
        Value::List(items) => items.iter_mut().for_each(|item| list_below(root, &schema["items"], item)),
        Value::Section(entries) => {
            entries
                .iter_mut()
                .for_each(|entry| list_below(root, property(schema, &entry.key), &mut entry.node));
        }
        _ => {}
    }
}

/// Returns whether a list may have a single item.
pub fn takes_one_item(schema: &Json) -> bool {
    let items = |bound: &str| schema[bound].as_u64();
    types(schema) == ["array"]
        && items("minItems").is_none_or(|n| n <= 1)
        && items("maxItems").is_none_or(|n| n >= 1)
}

/// Whether a value, or the list that is made of it, has the type that the schema wants.
fn fits(root: &Json, schema: &Json, value: &Value) -> bool {
    let (schema, _) = resolve(root, schema);
    if let Some(either) = schema["anyOf"].as_array() {
        return either.iter().any(|choice| fits(root, choice, value));
    }
    if choices(schema).is_some() {
        return matches!(value, Value::Text(_));
    }
    has_type(schema, value) || takes_one_item(schema) && fits(root, &schema["items"], value)
}

/// The schema of a section's key: its own, that of a pattern ([`key_pattern`]), or the one that all other keys have;
/// null or false where there is none.
pub fn property<'a>(schema: &'a Json, key: &str) -> &'a Json {
    let patterns = || schema["patternProperties"].as_object().into_iter().flatten();
    match schema["properties"].get(key) {
        Some(own) => own,
        None if is_name(key) => &schema["additionalProperties"],
        None => patterns().find(|(pattern, _)| is_like(pattern, key)).map_or(&Json::Null, |(_, own)| own),
    }
}

/// Returns the regular expression of a dotted key in which `*` stands for any characters of a name.
pub fn key_pattern(key: &str) -> String {
    format!("^{}$", key.replace('.', DOT).replace('*', ANY))
}

/// The dot of a key in a regular expression.
const DOT: &str = r"\.";
/// Any characters of a name in a regular expression.
const ANY: &str = "[a-z0-9_]*";

/// Whether a dotted key matches a regular expression of [`key_pattern`], and each of its steps is a name.
pub fn is_like(pattern: &str, key: &str) -> bool {
    fn step_is_like(pattern: &str, step: &str) -> bool {
        match pattern.split_once(ANY) {
            None => pattern == step,
            Some((start, rest)) => step
                .strip_prefix(start)
                .is_some_and(|end| (0..=end.len()).any(|index| step_is_like(rest, &end[index..]))),
        }
    }
    let patterns: Vec<&str> = pattern.trim_start_matches('^').trim_end_matches('$').split(DOT).collect();
    let steps: Vec<&str> = key.split('.').collect();
    patterns.len() == steps.len()
        && patterns.iter().zip(steps).all(|(pattern, step)| is_name(step) && step_is_like(pattern, step))
}

/// Refuses a tree that its schema does not allow.
///
/// # Errors
/// When a key or a value is not allowed, or a key is missing. The first problem in the order of the schema counts.
pub fn check_against(root: &Json, tree: &Node, hints: &Hints) -> Result<(), Problem> {
    check_part(root, root, tree, hints)
}

/// Like [`check_against`], for a tree that a part of the schema describes. `root` has the definitions.
pub fn check_part(root: &Json, part: &Json, tree: &Node, hints: &Hints) -> Result<(), Problem> {
    Check { root, hints }.node(part, tree, "")
}

/// A schema with its definitions, and what it can't say.
struct Check<'a> {
    root: &'a Json,
    hints: &'a Hints,
}

impl Check<'_> {
    fn node(&self, schema: &Json, node: &Node, path: &str) -> Result<(), Problem> {
        let (schema, definition) = resolve(self.root, schema);
        if let Some(choices) = choices(schema) {
            return self.choice(schema, &choices, &definition.to_lowercase(), node, path);
        }
        let unexpected = || {
            Problem::new(&node.place, unexpected(&expected(self.root, schema, self.hints), &node.value, path))
        };
        if let Some(either) = schema["anyOf"].as_array() {
            if either.iter().any(|choice| self.node(choice, node, path).is_ok()) {
                return Ok(());
            }
            // If one choice alone allows a list, or a section, the problem inside of it is what was meant.
            let has_parts = matches!(node.value, Value::List(_) | Value::Section(_));
            let mut alike =
                either.iter().filter(|choice| has_type(resolve(self.root, choice).0, &node.value));
            return match (alike.next(), alike.next()) {
                (Some(only), None) if has_parts => self.node(only, node, path),
                _ => Err(unexpected()),
            };
        }
        if !has_type(schema, &node.value) || !is_within_bounds(schema, &node.value) {
            return Err(unexpected());
        }
        match &node.value {
            Value::List(items) => self.items(schema, items, path),
            Value::Section(entries) => self.keys(schema, node, entries, path),
            _ => Ok(()),
        }
    }

    fn choice(
        &self,
        schema: &Json,
        choices: &[&str],
        what: &str,
        node: &Node,
        path: &str,
    ) -> Result<(), Problem> {
        let Hints { accepts, others, .. } = self.hints;
        let message = match &node.value {
            Value::Text(text) if choices.contains(&text.as_str()) || accepts(what, text) => return Ok(()),
            Value::Text(text) => unknown(what, text, path, choices, str::to_owned) + others(what),
            other => unexpected(&expected(self.root, schema, self.hints), other, path),
        };
        Err(Problem::new(&node.place, message))
    }

    fn items(&self, schema: &Json, items: &[Node], path: &str) -> Result<(), Problem> {
        let mut earlier = HashSet::new();
        for (index, item) in items.iter().enumerate() {
            let number = (items.len() > 1).then_some(index + 1);
            self.node(&schema["items"], item, path).map_err(|problem| problem.in_items(number.as_slice()))?;
            let value = item.to_json().to_string();
            if schema["uniqueItems"] == true && !earlier.insert(value.clone()) {
                return Err(Problem::new(&item.place, format!("{value} is in '{path}' twice")));
            }
        }
        Ok(())
    }

    fn keys(&self, schema: &Json, section: &Node, entries: &[Entry], path: &str) -> Result<(), Problem> {
        let names: Vec<&str> = properties(schema).map(|(name, _)| name.as_str()).collect();
        for entry in entries {
            let own = property(schema, &entry.key);
            if own.is_null() || own == false {
                let message = (self.hints.unknown_key)(entry, path);
                let message = message.unwrap_or_else(|| unknown_key(entry, path, &names));
                return Err(Problem::new(&entry.key_place, message));
            }
        }
        let required = schema["required"].as_array().into_iter().flatten().filter_map(Json::as_str);
        let missing: Vec<String> = required
            .filter(|key| section.get(key).is_none())
            .map(|key| format!("'{}'", join(path, key)))
            .collect();
        if !missing.is_empty() {
            return Err(Problem::new(&section.place, format!("missing {}", missing.join(", "))));
        }
        entries.iter().try_for_each(|entry| {
            self.node(property(schema, &entry.key), &entry.node, &join(path, &entry.key))
        })
    }
}

/// The message about a key that a section can't have. `names` are the keys that the schema lists.
fn unknown_key(entry: &Entry, path: &str, names: &[&str]) -> String {
    match names {
        [] => no_name(entry, path),
        _ => unknown("key", &entry.key, path, names, str::to_owned),
    }
}

/// The message about a key that is no name, where every name is allowed.
pub fn no_name(entry: &Entry, path: &str) -> String {
    let key = shorten(&entry.key);
    format!(
        "'{key}' in '{path}' can't be a name; use 1 to 64 lower-case letters, digits and '_', a letter first"
    )
}

fn unexpected(expected: &str, found: &Value, path: &str) -> String {
    let place = if path.is_empty() { String::new() } else { format!("'{path}': ") };
    let hint = if expected == TEXT { "; put a text that looks like something else in quotes" } else { "" };
    format!("{place}expected {expected}, found {found}{hint}")
}

/// Says that a name is not known, which one may have been meant, as `suggest` writes it, and which there are.
pub fn unknown(
    what: &str,
    found: &str,
    path: &str,
    names: &[&str],
    suggest: impl Fn(&str) -> String,
) -> String {
    /// The largest number of names that are listed after a suggestion.
    const MOST: usize = 30;
    let message = not_known(what, found, path, names, suggest);
    // Of dotted keys only those of the section that was named, if it exists.
    let section = found.rfind('.').map_or("", |dot| &found[..=dot]);
    let is_near = |name: &&&str| name.starts_with(section);
    let near: Vec<&str> = names.iter().filter(is_near).copied().collect();
    let allowed = if near.is_empty() { names } else { &near };
    if allowed.len() > MOST && nearest(found, names).is_some() {
        return message;
    }
    let shown = if allowed.len() > MOST {
        by_section(allowed)
    } else {
        allowed.iter().map(ToString::to_string).collect()
    };
    message + &format!(" Allowed: {}", shown.join(", "))
}

/// Says that a name is not known, and which of `names` may have been meant, as `suggest` writes it.
pub fn not_known(
    what: &str,
    found: &str,
    path: &str,
    names: &[&str],
    suggest: impl Fn(&str) -> String,
) -> String {
    let place = if path.is_empty() { String::new() } else { format!(" in '{path}'") };
    let meant = nearest(found, names).map(|name| format!("; did you mean '{}'?", suggest(name)));
    format!("unknown {what} '{}'{place}{}", shorten(found), meant.as_deref().unwrap_or("."))
}

/// The names, with one entry for all dotted names of a section, such as `training.…`.
fn by_section(names: &[&str]) -> Vec<String> {
    let entry =
        |name: &&str| name.split_once('.').map_or((*name).to_owned(), |(section, _)| format!("{section}.…"));
    let mut entries: Vec<String> = names.iter().map(entry).collect();
    entries.dedup();
    entries
}

/// Follows references into the same schema. Returns what they lead to, and its name if it is a definition.
pub fn resolve<'a>(root: &'a Json, mut schema: &'a Json) -> (&'a Json, &'a str) {
    let mut definition = "";
    while let Some(pointer) = schema["$ref"].as_str().and_then(|reference| reference.strip_prefix('#')) {
        definition = pointer.strip_prefix("/$defs/").filter(|name| !name.contains('/')).unwrap_or_default();
        schema = root.pointer(pointer).unwrap_or(&Json::Null);
    }
    (schema, definition)
}

/// The properties that a schema lists, with their names.
pub fn properties(schema: &Json) -> impl Iterator<Item = (&String, &Json)> {
    schema["properties"].as_object().into_iter().flatten()
}

/// The values of an enumeration, which the schema gives one by one with their descriptions; `None` for other schemas.
pub fn choices(schema: &Json) -> Option<Vec<&str>> {
    Some(schema["oneOf"].as_array()?.iter().filter_map(|choice| choice["const"].as_str()).collect())
}

/// The types that a schema allows.
pub fn types(schema: &Json) -> Vec<&str> {
    match &schema["type"] {
        Json::Array(types) => types.iter().filter_map(Json::as_str).collect(),
        other => other.as_str().into_iter().collect(),
    }
}

fn has_type(schema: &Json, value: &Value) -> bool {
    let types = types(schema);
    let is = |name| types.contains(&name);
    match value {
        Value::Null => is("null"),
        Value::Bool(_) => is("boolean"),
        Value::Integer(_) => is("integer") || is("number"),
        Value::Float(_) => is("number"),
        Value::Text(_) => is("string"),
        Value::List(_) => is("array"),
        Value::Section(_) => is("object"),
    }
}

fn is_within_bounds(schema: &Json, value: &Value) -> bool {
    let bound = |keyword: &str| schema[keyword].as_f64();
    let is_number_within = |number: f64| {
        number.is_finite()
            && bound("minimum").is_none_or(|minimum| number >= minimum)
            && bound("maximum").is_none_or(|maximum| number <= maximum)
            && bound("exclusiveMinimum").is_none_or(|minimum| number > minimum)
            && bound("exclusiveMaximum").is_none_or(|maximum| number < maximum)
    };
    match value {
        // Every integer bound is below 2^53, so the rounding of larger values does not matter.
        Value::Integer(integer) => is_number_within(*integer as f64),
        Value::Float(float) => is_number_within(*float),
        Value::Section(keys) => {
            bound("minProperties").is_none_or(|minimum| keys.len() as f64 >= minimum)
                && bound("maxProperties").is_none_or(|maximum| keys.len() as f64 <= maximum)
        }
        Value::List(items) => {
            bound("minItems").is_none_or(|minimum| items.len() as f64 >= minimum)
                && bound("maxItems").is_none_or(|maximum| items.len() as f64 <= maximum)
        }
        _ => true,
    }
}

/// Describes in words what a schema allows.
pub fn expected(root: &Json, schema: &Json, hints: &Hints) -> String {
    let (schema, definition) = resolve(root, schema);
    if let Some(choices) = choices(schema) {
        let all = match choices[..] {
            [only] => format!("{TEXT} '{only}'"),
            _ => format!("one of {}", choices.join(", ")),
        };
        return all + (hints.others)(&definition.to_lowercase());
    }
    if let Some(either) = schema["anyOf"].as_array() {
        return either.iter().map(|choice| expected(root, choice, hints)).collect::<Vec<_>>().join(" or ");
    }
    let name = |name: &str| match name {
        "integer" => format!("an integer{}", expected_bounds(schema)),
        "number" => format!("a finite number{}", expected_bounds(schema)),
        "string" => TEXT.into(),
        "boolean" => "true or false".into(),
        "array" => {
            format!("a list of {}, each {}", expected_length(schema), expected(root, &schema["items"], hints))
        }
        "object" if schema["maxProperties"] == 1 => {
            let names: Vec<&str> = properties(schema).map(|(name, _)| name.as_str()).collect();
            format!("a section with exactly one of {}", names.join(", "))
        }
        "object" if schema["minProperties"] == 1 => "a section with at least one key".into(),
        "object" => "a section of keys".into(),
        other => other.into(),
    };
    types(schema).into_iter().map(name).collect::<Vec<_>>().join(" or ")
}

fn expected_bounds(schema: &Json) -> String {
    let words = [
        ("minimum", "of at least"),
        ("exclusiveMinimum", "above"),
        ("maximum", "at most"),
        ("exclusiveMaximum", "below"),
    ];
    let bounds: Vec<String> = words
        .iter()
        .filter_map(|(key, word)| schema[key].as_f64().map(|bound| format!("{word} {bound}")))
        .collect();
    if bounds.is_empty() { String::new() } else { format!(" {}", bounds.join(" and ")) }
}

fn expected_length(schema: &Json) -> String {
    match (schema["minItems"].as_u64(), schema["maxItems"].as_u64()) {
        (Some(minimum), Some(maximum)) if minimum == maximum => format!("{minimum} items"),
        (Some(1), None) => "at least one item".into(),
        (Some(minimum), None) => format!("at least {minimum} items"),
        (Some(1), Some(maximum)) => format!("one to {maximum} items"),
        (None, Some(maximum)) => format!("at most {maximum} items"),
        (None, None) => "items".into(),
        (minimum, maximum) => unreachable!("no list of the spec has {minimum:?} to {maximum:?} items"),
    }
}

/// A dotted path with one more name at its end.
pub fn join(prefix: &str, name: &str) -> String {
    if prefix.is_empty() { name.to_owned() } else { format!("{prefix}.{name}") }
}
