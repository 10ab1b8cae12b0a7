//! Mappings: the files that say which parts of a recording make up which modality. The Python package imports by them.

use super::error::SpecError;
use super::kind::FileKind;
use super::origin::Scenario;
use super::text::read_text;
use super::world::one_line;
use crate::layout::{Definition, Layout, Modality};
use crate::yaml::{
    Entry, Hints, Node, Problem, Value, check_part, choices, is_name, no_name, parse, properties, resolve,
    shorten, unknown,
};
use serde_json::Value as Json;
use std::path::Path;
use std::sync::LazyLock;

/// The schema of a mapping. The file is also for editors.
static SCHEMA: LazyLock<Json> = LazyLock::new(|| {
    serde_json::from_str(include_str!("../../experiments/mapping.schema.json"))
        .expect("a test reads the schema")
});

const HINTS: Hints = Hints {
    accepts: |_, _| false,
    others: |_| "",
    unknown_key: |entry, path| NAMED.contains(&path).then(|| no_name(entry, path)),
};

/// The formats of files of named arrays, in which `episodes` may be a pattern of groups.
const ARRAYS: [&str; 4] = ["hdf5", "zarr", "matlab", "numpy"];

/// The sections whose keys are names.
const NAMED: [&str; 2] = ["streams", "modalities"];

/// Returns the JSON schema of a mapping, for editors.
pub fn mapping_schema() -> Json {
    SCHEMA.clone()
}

/// Reads and checks a mapping. Returns its content, whose keys are in the file's order.
///
/// # Errors
/// When the file can't be read, or returns its first fault, with its line and column.
pub fn read_mapping(path: &Path) -> Result<Json, SpecError> {
    let text = read_text(path)?;
    parse_mapping(&text).map_err(|problem| SpecError::of(problem, &path.display().to_string()))
}

fn parse_mapping(text: &str) -> Result<Json, Problem> {
    let tree = parse(text)?;
    if matches!(tree.value, Value::Null) {
        let message =
            "the file is empty; `harness import --inspect FILE` writes a first mapping of a recording";
        return Err(Problem::new(&tree.place, message));
    }
    FileKind::Mapping.check(&tree)?;
    let format = format(&tree)?;
    if let Some(Node { value: Value::Section(entries), place }) = tree.get("modalities")
        && entries.iter().all(|entry| entry.key != Modality::SETPOINT.name())
    {
        let message = "missing 'modalities.setpoint', what was commanded; for a recording without commands, write \
                       'setpoint: none'";
        return Err(Problem::new(place, message));
    }
    check_part(&SCHEMA, format, &tree, &HINTS)?;
    sources(&tree)?;
    check(&tree)
        .map_err(|(path, message)| Problem::new(tree.place_of(&path), format!("'{path}': {message}")))?;
    Ok(tree.to_json())
}

/// Returns the schema of the mapping's format.
fn format(tree: &Node) -> Result<&'static Json, Problem> {
    let formats =
        || SCHEMA["anyOf"].as_array().into_iter().flatten().map(|format| resolve(&SCHEMA, format).0);
    let names = |format: &'static Json| choices(&format["properties"]["format"]).unwrap_or_default();
    let all: Vec<&str> = formats().flat_map(names).collect();
    match (tree.get("format"), &tree.value) {
        (Some(Node { value: Value::Text(name), place }), _) => {
            let message = || unknown("format", name, "", &unique(all.clone()), str::to_owned);
            // The rows of Parquet files are samples, or those of streams with times.
            let has_streams = tree.get("streams").is_some();
            let mut named: Vec<_> =
                formats().filter(|format| names(format).contains(&name.as_str())).collect();
            named.sort_by_key(|format| format["properties"].get("streams").is_some() != has_streams);
            named.first().copied().ok_or_else(|| Problem::new(place, message()))
        }
        (Some(other), _) => Err(Problem::new(
            &other.place,
            format!("'format': expected one of {}, found {}", unique(all).join(", "), other.value),
        )),
        (None, Value::Section(entries)) => {
            let keys: Vec<&str> = formats().flat_map(properties).map(|(key, _)| key.as_str()).collect();
            // The key may be there with a slip in it.
            let strange = entries.iter().find(|entry| !keys.contains(&entry.key.as_str()));
            Err(match strange {
                Some(entry) => Problem::new(
                    &entry.key_place,
                    unknown("key", &entry.key, "", &unique(keys), str::to_owned),
                ),
                None => {
                    Problem::new(&tree.place, format!("missing 'format': one of {}", unique(all).join(", ")))
                }
            })
        }
        (None, other) => Err(Problem::new(&tree.place, format!("expected a section of keys, found {other}"))),
    }
}

fn unique(mut names: Vec<&str>) -> Vec<&str> {
    let mut seen = std::collections::HashSet::new();
    names.retain(|name| seen.insert(*name));
    names
}

/// Checks the rules for a mapping that the schema can't express. An error has the path at fault and the message.
fn check(tree: &Node) -> Result<(), (String, String)> {
    let name = tree.get("name").map_or("", text);
    if !is_name(name) || Scenario::PAPER.iter().any(|scenario| scenario.name() == name) {
        return Err((
            "name".into(),
            format!(
                "'{}' can't name an imported dataset; use 1 to 64 lower-case letters, digits and '_', a letter first, \
                 and not {}",
                shorten(name),
                Scenario::PAPER.map(Scenario::name).join(" or ")
            ),
        ));
    }
    let division = ["episode", "episodes", "episode_ends"];
    let is_rows = tree.get("streams").is_none();
    let is_table = tree.get("episodes").is_some_and(|episodes| text(episodes).ends_with(".csv"));
    let is_of_arrays = tree.get("format").is_some_and(|format| ARRAYS.contains(&text(format)));
    if tree.get("episodes").is_some() && !is_table && !is_of_arrays {
        return Err(("episodes".into(), "expected the path of a .csv file with a row for each trial".into()));
    }
    let divides = |key: &&str| !is_rows && tree.get(key).is_some() && !(is_table && *key == "episodes");
    let mut given = division.into_iter().filter(divides);
    if let (Some(first), Some(second)) = (given.next(), given.next()) {
        return Err((
            second.into(),
            format!("'{first}' divides the recording into episodes already; remove one of them"),
        ));
    }
    for Entry { key, node, .. } in entries(tree, "streams") {
        if node.get("time").is_some() && node.get("rate_hz").is_some() {
            return Err((
                format!("streams.{key}.rate_hz"),
                "the stream has times; remove 'time' or 'rate_hz'".into(),
            ));
        }
    }
    modalities(tree)
}

/// Refuses a modality that says neither which columns nor which label it has.
fn sources(tree: &Node) -> Result<(), Problem> {
    let has_none = |entry: &&Entry| {
        matches!(entry.node.value, Value::Section(_))
            && ["from", "label"].iter().all(|key| entry.node.get(key).is_none())
    };
    entries(tree, "modalities").iter().find(has_none).map_or(Ok(()), |Entry { key, node, .. }| {
        let message = format!("missing 'modalities.{key}.from', or 'label' for the categories of a label");
        Err(Problem::new(&node.place, message))
    })
}

fn modalities(tree: &Node) -> Result<(), (String, String)> {
    let all = entries(tree, "modalities");
    let is_sensed =
        |entry: &Entry| entry.key != Modality::SETPOINT.name() && entry.node.get("label").is_none();
    if !all.iter().any(is_sensed) {
        let alone = if all.len() == 1 { "the setpoint" } else { "labels" };
        let message = format!("there is nothing to learn from {alone} alone; name what was sensed");
        return Err(("modalities".into(), message));
    }
    let finger = Layout::finger();
    let mut images = Vec::new();
    for Entry { key, node, .. } in all {
        let at = |key: &str, (below, message): (&str, String)| (format!("modalities.{key}{below}"), message);
        let known = Modality::new(key).and_then(|modality| finger.get(modality));
        let is_difference = known.is_some_and(|known| known.difference_of.is_some());
        if is_difference || Modality::RESERVED.contains(&key.as_str()) && key != Modality::SETPOINT.name() {
            let message =
                "this name means something else in the tables; give the modality another name".into();
            return Err(at(key, ("", message)));
        }
        if modality(node, known).map_err(|problem| at(key, problem))? {
            images.push(key.as_str());
        }
    }
    for image in &images {
        let change = change_of(image);
        let problem = if all.iter().any(|entry| entry.key == change) {
            "another modality has this name"
        } else if images.iter().any(|other| other != image && change_of(other) == change) {
            "so is that of another image"
        } else if !is_name(&change) {
            "this is longer than 64 characters"
        } else {
            continue;
        };
        let message = format!(
            "the change of this image is called '{change}', and {problem}; give the image another name"
        );
        return Err((format!("modalities.{image}"), message));
    }
    Ok(())
}

/// The name of an image's change since the sample before.
fn change_of(image: &str) -> String {
    let image = if image == Modality::VISION.name() { "frame" } else { image };
    format!("{image}_difference")
}

/// Returns whether a modality is an image. An error has the key at fault, with the dot before it, and the message.
fn modality(node: &Node, known: Option<&Definition>) -> Result<bool, (&'static str, String)> {
    let known_image = known.map(|known| known.size().is_some());
    let is_image = known_image.unwrap_or_default() || node.get("size").is_some();
    if is_image && known_image == Some(false) {
        return Err((".size", "the finger has a vector of this name; give an image another name".into()));
    }
    if known.is_some() && node.get("unit").is_some() {
        return Err((
            ".unit",
            "is that of the finger's; leave it out, or give the modality another name".into(),
        ));
    }
    if let Some(unit) = node.get("unit") {
        one_line(text(unit)).map_err(|message| (".unit", message.into()))?;
    }
    let of_others = match is_image {
        true => [".scale", ".angle", ".quaternion"],
        false => [".order", ".crop", ".range"],
    };
    if let Some(key) = of_others.into_iter().find(|key| node.get(&key[1..]).is_some()) {
        let kind = if is_image { "a vector" } else { "an image, which has a size," };
        return Err((key, format!("only {kind} has this key")));
    }
    categories(node, known)?;
    if node.get("angle").is_some() && node.get("quaternion").is_some() {
        return Err((".quaternion", "a modality is an angle or a quaternion".into()));
    }
    let (key, from) = node.get("from").map_or(("", node), |from| (".from", from));
    if is_image && matches!(&from.value, Value::List(terms) if terms.len() != 1) {
        return Err((key, "an image is from one column".into()));
    }
    Ok(is_image)
}

/// Refuses categories with a key that has no meaning for them.
fn categories(node: &Node, known: Option<&Definition>) -> Result<(), (&'static str, String)> {
    const OTHERS: [&str; 8] =
        [".scale", ".unit", ".angle", ".quaternion", ".size", ".order", ".crop", ".range"];
    let Some(key) = [".label", ".categories"].into_iter().find(|key| node.get(&key[1..]).is_some()) else {
        return Ok(());
    };
    if known.is_some() {
        let message = "the finger has values of this name; give categories another name";
        return Err((key, message.into()));
    }
    if node.get("label").is_some() && node.get("from").is_some() {
        return Err((".from", "categories are from columns or from a label; remove one of them".into()));
    }
    match OTHERS.into_iter().find(|key| node.get(&key[1..]).is_some()) {
        Some(key) => Err((key, "categories have no such key; remove it".into())),
        None => Ok(()),
    }
}

fn entries<'a>(tree: &'a Node, key: &str) -> &'a [Entry] {
    match tree.get(key).map(|node| &node.value) {
        Some(Value::Section(entries)) => entries,
        _ => &[],
    }
}

fn text(node: &Node) -> &str {
    match &node.value {
        Value::Text(text) => text,
        _ => "",
    }
}
