//! Changes to single settings: `training.batch_size=512` on the command line, and a spec's own `quick`.

use super::outputs::{stored_key, written_key};
use super::schema;
use super::text::MAX_FILE_BYTES;
use super::vary::VARY;
use crate::yaml::{Entry, Node, Place, Problem, Value, parse, shorten, unknown};

/// Key of the settings that are drawn.
const SEARCH: &str = "search";
/// Key of the other readings.
const READINGS: &str = "readings";

/// Reads settings, each written as `KEY=VALUE`.
pub(super) fn read_all(texts: &[String]) -> Result<Vec<Entry>, Problem> {
    let one = |(index, text): (usize, &String)| {
        read(text).map_err(|problem| match divided(&texts[index..]) {
            Some(whole) => Problem::new(
                &Place::Override(shorten(text)),
                format!("is a part of a list that the shell divided at a space; put the setting in quotes: '{whole}'"),
            ),
            None => problem,
        })
    };
    texts.iter().enumerate().map(one).collect()
}

/// Returns the setting with a list or a section that a shell has divided into the first of these words, if they begin
/// with such a setting.
fn divided(words: &[String]) -> Option<String> {
    let is_whole = |text: &str| {
        let count = |brackets: &[char]| text.matches(brackets).count();
        count(&['[', '{']) == count(&[']', '}'])
    };
    if words.first().is_none_or(|first| is_whole(first) || !first.contains('=')) {
        return None;
    }
    (2..=words.len())
        .map(|count| words[..count].join(" "))
        .find(|joined| is_whole(joined))
        .filter(|whole| read(whole).is_ok() && !whole.contains('\''))
}

/// Reads `KEY=VALUE`: the dotted key of a setting, and its value in YAML.
fn read(text: &str) -> Result<Entry, Problem> {
    let place = Place::Override(shorten(text));
    let Some((key, value)) = text.split_once('=') else {
        return Err(Problem::new(&place, "has no '='; write KEY=VALUE, as in training.epochs=3"));
    };
    let key = key.trim();
    let names = schema::setting_names();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    if !names.contains(&key) && !schema::is_setting(key) {
        return Err(Problem::new(&place, not_a_setting(key, value, &names)));
    }
    if value.len() as u64 > MAX_FILE_BYTES {
        return Err(Problem::new(&place, "is larger than 1 MiB"));
    }
    let node = parse(value).map_err(|problem| Problem::new(&place, problem.message))?;
    Ok(Entry { key: key.to_owned(), key_place: place.clone(), node: node.attributed_to(&place) })
}

fn not_a_setting(key: &str, value: &str, names: &[&str]) -> String {
    if key.starts_with(schema::BELOW_VARY) {
        return format!(
            "'{}' can't be set alone; give a whole axis, as in 'vary={{training.epochs: [5, 10]}}' or \
             'vary={{AXIS: {{LABEL: {{KEY: VALUE}}}}}}', or one value for all runs, as in training.epochs=5",
            shorten(key)
        );
    }
    if key == "inputs" || key.strip_prefix("inputs.").is_some_and(|name| !name.contains('.')) {
        let name = key.strip_prefix("inputs.").unwrap_or("NAME");
        return format!(
            "'{key}' is a section; override its keys one by one, such as inputs.{name}.noise=0.1"
        );
    }
    let prefix = format!("{key}.");
    let section: Vec<&str> = names.iter().filter(|name| name.starts_with(&prefix)).copied().collect();
    if section.is_empty() {
        let suggest = |name: &str| {
            let is_single = schema::is_list(name) && !value.trim_start().starts_with('[');
            let value = if is_single { format!("[{value}]") } else { value.to_owned() };
            let is_allowed = parse(&value).is_ok_and(|node| schema::allows(name, &node));
            if is_allowed && shorten(&value) == value { format!("{name}={value}") } else { name.to_owned() }
        };
        return unknown("key", key, "", names, suggest);
    }
    format!("'{key}' is a section; override its keys one by one: {}", section.join(", "))
}

/// Applies settings to a tree that has passed the checks. If a key is set twice, the later value is used. A setting
/// that the tree varies is tried only with the value given here, or with the values of a list.
pub(super) fn apply(tree: &mut Node, settings: &[Entry]) {
    // `vary` and `search` are applied first, so that the result does not depend on the order of the settings.
    let (varied, others): (Vec<&Entry>, Vec<&Entry>) = settings
        .iter()
        .partition(|setting| setting.key == VARY || setting.key.split('.').next() == Some(SEARCH));
    for setting in varied.into_iter().chain(others) {
        if setting.key == SEARCH && matches!(setting.node.value, Value::Null) {
            remove(tree, SEARCH);
            continue;
        }
        if let Some(values) = axis_values(tree, &setting.key)
            && matches!(setting.node.value, Value::List(_))
            && !schema::allows(&setting.key, &setting.node)
        {
            *values = setting.node.clone();
            continue;
        }
        match setting.key == VARY {
            true => set(tree, VARY, &with_labels(tree, setting)),
            false => set_in_one_place(tree, setting),
        }
        try_alone(tree, setting);
        if let Some(key) = stored_key(&setting.key).or_else(|| written_key(&setting.key)) {
            try_alone(tree, &Entry { key, ..setting.clone() });
        }
    }
}

/// Returns the values of a setting that a tree varies.
fn axis_values<'a>(tree: &'a mut Node, key: &str) -> Option<&'a mut Node> {
    let Value::Section(axes) = &mut tree.get_mut(VARY)?.value else { return None };
    let axis = axes.iter_mut().find(|axis| axis.key == key)?;
    matches!(axis.node.value, Value::List(_)).then_some(&mut axis.node)
}

/// Sets a setting. One of an output replaces that of its other key.
fn set_in_one_place(tree: &mut Node, setting: &Entry) {
    let stored = stored_key(&setting.key);
    let written = if stored.is_some() { Some(setting.key.clone()) } else { written_key(&setting.key) };
    if let Some((output, key)) = written.as_deref().and_then(|written| written.rsplit_once('.'))
        && let Some(output) = output.split('.').try_fold(&mut *tree, |node, key| node.get_mut(key))
    {
        remove(output, key);
    }
    set(tree, stored.as_ref().unwrap_or(&setting.key), setting);
}

/// Adds to new axes those of a tree that have labels, so that they replace only the values of settings.
fn with_labels(tree: &Node, vary: &Entry) -> Entry {
    let mut vary = vary.clone();
    let has = |node: &Node, key: &str| node.get(key).is_some();
    if let Some(Node { value: Value::Section(axes), .. }) = tree.get(VARY) {
        let is_kept =
            |axis: &&Entry| matches!(axis.node.value, Value::Section(_)) && !has(&vary.node, &axis.key);
        let kept: Vec<Entry> = axes.iter().filter(is_kept).cloned().collect();
        if let Value::Section(own) = &mut vary.node.value {
            own.splice(0..0, kept);
        }
    }
    vary
}

/// Removes a key of a section.
fn remove(section: &mut Node, key: &str) {
    if let Value::Section(entries) = &mut section.value {
        entries.retain(|entry| entry.key != key);
    }
}

/// Replaces all values of a varied or drawn setting by this one, also in readings and labels.
fn try_alone(tree: &mut Node, setting: &Entry) {
    if let Some(Node { value: Value::Section(axes), .. }) = tree.get_mut(VARY) {
        for axis in axes {
            if let Value::Section(labels) = &mut axis.node.value {
                labels.iter_mut().for_each(|label| replace(&mut label.node, setting));
            } else if axis.key == setting.key {
                let only = setting.node.clone();
                axis.node = Node { place: only.place.clone(), value: Value::List(vec![only]) };
            }
        }
    }
    if let Some(node) = tree.get_mut(SEARCH).and_then(|search| search.get_mut("space")?.get_mut(&setting.key))
    {
        let place = setting.node.place.clone();
        let only = Node { place: place.clone(), value: Value::List(vec![setting.node.clone()]) };
        let choice = Entry { key: "choice".into(), key_place: place.clone(), node: only };
        *node = Node { place, value: Value::Section(vec![choice]) };
    }
    if let Some(Node { value: Value::List(readings), .. }) = tree.get_mut(READINGS) {
        readings
            .iter_mut()
            .filter_map(|reading| reading.get_mut("settings"))
            .for_each(|of| replace(of, setting));
    }
}

/// Replaces the value of a setting if it has one.
fn replace(settings: &mut Node, setting: &Entry) {
    if let Some(node) = settings.get_mut(&setting.key) {
        *node = setting.node.clone();
    }
}

/// Sets the value at `path`, and creates the sections above it.
fn set(section: &mut Node, path: &str, setting: &Entry) {
    let (key, rest) = path.split_once('.').map_or((path, None), |(key, rest)| (key, Some(rest)));
    let Value::Section(entries) = &mut section.value else { return };
    let index = entries.iter().position(|entry| entry.key == key).unwrap_or_else(|| {
        let node = Node { place: setting.key_place.clone(), value: Value::Section(Vec::new()) };
        entries.push(Entry { key: key.to_owned(), key_place: setting.key_place.clone(), node });
        entries.len() - 1
    });
    match rest {
        Some(rest) => set(&mut entries[index].node, rest, setting),
        None => entries[index].node = setting.node.clone(),
    }
}
