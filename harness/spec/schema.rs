//! The JSON schema of a spec, for editors and for the checks.

use super::hints::HINTS;
use super::origin::{IMPORTED_NAME, Origin};
use super::outputs::stored_key;
use super::simulation::Setting;
use super::types::Experiment;
use super::world::World;
use crate::yaml::{
    Node, Problem, allow_single_values, check_against, check_part, choices, is_like, is_name, join,
    key_pattern, list_single, properties, property, resolve, takes_one_item, types,
};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde_json::{Value as Json, json};
use std::collections::BTreeSet;
use std::sync::LazyLock;

/// Key of the label, or of the spec, on which another one builds.
pub(super) const EXTENDS: &str = "extends";
/// The key and the value of an ablation of each modality of the input.
pub(super) const WITHOUT: [&str; 2] = ["without", "each"];

static SCHEMA: LazyLock<Json> = LazyLock::new(build);

/// Returns the JSON schema of an experiment for editors, with descriptions, defaults and bounds.
///
/// `quick` and `vary` list the settings by dotted key, so that editors complete those as well. A single value is also
/// accepted for a list. Editors do not check the bounds of a search, nor single and repeated values in `vary`.
pub fn schema() -> Json {
    let mut schema = SCHEMA.clone();
    for (_, values) in schemas_of_keys(&mut schema["properties"]["vary"]) {
        *values = json!({ "items": values["items"] });
    }
    let settings = &mut schema["$defs"]["Reading"]["properties"]["settings"];
    *settings = json!({ "description": settings["description"], "$ref": "#/$defs/Settings" });
    for (_, drawn) in schemas_of_keys(&mut schema["$defs"]["Search"]["properties"]["space"]) {
        let kinds: Vec<&str> = properties(drawn).map(|(kind, _)| kind.as_str()).collect();
        *drawn = json!({ "$ref": format!("#/$defs/{}", definition_of(&kinds)) });
    }
    for kinds in KINDS {
        schema["$defs"][definition_of(kinds)] = distributions(&json!({}), kinds, json!({}));
    }
    let modality = &mut schema["$defs"]["Modality"];
    let named = json!({ "enum": choices(modality) });
    if let Some(other) = modality["oneOf"].as_array_mut().and_then(|choices| choices.last_mut()) {
        other["not"] = named; // so that a name fits one choice only
    }
    let horizon = &mut schema["$defs"]["Window"]["properties"]["horizon"];
    let one = json!({ "type": "integer", "minimum": horizon["minimum"], "maximum": horizon["maximum"] });
    *horizon = json!({
        "description": horizon["description"], "default": horizon["default"],
        "anyOf": [one, { "type": "array", "items": one, "minItems": 2, "uniqueItems": true }],
    });
    allow_single_values(&mut schema);
    add_extends(&mut schema);
    schema
}

/// Returns the text of a schema, in which a reference, and a list of what a reference describes, take one line.
pub fn schema_text(schema: &Json) -> String {
    const SHORT: [&str; 2] = ["\"$ref\": ", "\"items\": { \"$ref\": "];
    let mut lines = Vec::<String>::new();
    for line in serde_json::to_string_pretty(schema).expect("a schema is plain data").lines() {
        let end = line.trim_start();
        if let [.., start, only] = &lines[..]
            && end.starts_with('}')
            && start.ends_with('{')
            && SHORT.iter().any(|short| only.trim_start().starts_with(short))
        {
            let joined = format!("{start} {} {end}", only.trim_start());
            lines.truncate(lines.len() - 2);
            lines.push(joined);
        } else {
            lines.push(line.to_owned());
        }
    }
    lines.join("\n") + "\n"
}

/// Adds the keys that a spec no longer has when it is checked. What it extends may have the keys that it needs.
fn add_extends(schema: &mut Json) {
    let text = |description: &str| json!({ "description": description, "type": "string" });
    schema["properties"][EXTENDS] = text(
        "The spec on which this one builds: the path of a file, or a built-in experiment. Sections are merged key by \
         key. Everything else replaces what the other spec has, and `null` leaves out a list or a section.",
    );
    schema["$defs"]["Settings"]["properties"][EXTENDS] =
        text("The label of this axis on which this one builds.");
    let required = schema["required"].take();
    schema["required"] = json!(["name"]);
    schema["anyOf"] = json!([{ "required": [EXTENDS] }, { "required": required }]);
    schema["$defs"]["Network"].as_object_mut().map(|network| network.remove("required"));
    accept_null(schema);
}

/// Accepts `null` for each list and section, which leaves out that of the other spec.
fn accept_null(schema: &mut Json) {
    fn in_section(section: &mut Json) {
        for (_, value) in schemas_of_keys(section) {
            of_section(value);
            if let Some(either) = value.get_mut("anyOf").and_then(Json::as_array_mut)
                && either[0]["type"] == "array"
            {
                either.push(json!({ "type": "null" }));
            }
        }
    }
    fn of_section(section: &mut Json) {
        if section["type"] == "object" {
            section["type"] = json!(["object", "null"]);
        }
    }
    in_section(schema);
    for section in schema["$defs"].as_object_mut().into_iter().flat_map(|all| all.values_mut()) {
        in_section(section);
        of_section(section);
    }
}

/// The distributions of numbers, of integers, and of all other settings in a search.
const KINDS: [&[&str]; 3] = [&["uniform", "log_uniform", "choice"], &["integer", "choice"], &["choice"]];

/// Returns the name of the definition of these distributions in the schema for editors.
fn definition_of(kinds: &[&str]) -> &'static str {
    match kinds.first() {
        Some(&"uniform") => "NumberCandidates",
        Some(&"integer") => "IntegerCandidates",
        _ => "Candidates",
    }
}

/// The keys that a section lists, and the patterns of keys, with their schemas.
fn schemas_of_keys(section: &mut Json) -> impl Iterator<Item = (&String, &mut Json)> {
    let section = section.as_object_mut().into_iter().flatten();
    let keys = section.filter(|(keyword, _)| ["properties", "patternProperties"].contains(&keyword.as_str()));
    keys.filter_map(|(_, keys)| keys.as_object_mut()).flatten()
}

/// Returns the dotted keys of all settings that an override or `quick` may change.
pub fn setting_names() -> Vec<String> {
    properties(&SCHEMA["properties"]["quick"]).map(|(name, _)| name.clone()).collect()
}

fn build() -> Json {
    let mut schema = schemars::schema_for!(Experiment).to_value();
    add_settings_of_worlds(&mut schema);
    let mut settings = serde_json::Map::new();
    collect_settings(&schema, &schema, "#", "", &mut settings);
    NOT_OVERRIDDEN.iter().for_each(|key| drop(settings.remove(*key)));
    let of = |takes: &dyn Fn(&str) -> bool| -> Vec<(String, Json)> {
        let own = settings.iter().filter(|(key, _)| takes(key));
        own.map(|(key, setting)| (key.clone(), setting.clone())).collect()
    };
    set_keys(&mut schema["properties"]["vary"], of(&varies).into_iter().map(several));
    let mut of_labels = json!({ "type": "object" });
    set_keys(&mut of_labels, of(&|key| varies(key) || key == "latent"));
    schema["$defs"]["Settings"] = of_labels;
    schema["$defs"]["Labels"] = json!({
        "description": "An axis with a name: each label has the settings in which it differs from the spec.",
        "type": "object", "additionalProperties": { "$ref": "#/$defs/Settings" }, "minProperties": 1,
    });
    schema["properties"]["vary"]["additionalProperties"] = json!({ "$ref": "#/$defs/Labels" });
    set_keys(&mut schema["$defs"]["Reading"]["properties"]["settings"], of(&varies));
    let drawn = of(&|key| varies(key) && draws(key));
    let drawn = drawn.into_iter().map(|(key, setting)| (key, candidates(&schema, &setting)));
    let drawn: Vec<(String, Json)> = drawn.collect();
    set_keys(&mut schema["$defs"]["Search"]["properties"]["space"], drawn);
    for (key, place) in [
        ("search.space", "$defs/Search/properties/space"),
        ("vary", "properties/vary"),
        ("search", "properties/search"),
    ] {
        settings.insert(key.into(), json!({ "$ref": format!("#/{place}") }));
    }
    set_keys(&mut schema["properties"]["quick"], settings);
    schema
}

/// Adds the settings of the built-in worlds, and what those of other worlds may be.
fn add_settings_of_worlds(schema: &mut Json) {
    let range = json!({
        "description": "Lowest and highest setpoint. The default is that of the world.", "type": "array",
        "items": { "type": "number" }, "minItems": 2, "maxItems": 2,
    });
    let clearance = json!({
        "description": "Smallest distance between placed bodies, m. The default is that of the world.",
        "type": "number", "minimum": 0.0, "maximum": 1000.0,
    });
    schema["$defs"]["Range"] = range;
    schema["$defs"]["Clearance"] = clearance;
    let [range, clearance] = ["Range", "Clearance"].map(|name| json!({ "$ref": format!("#/$defs/{name}") }));
    let simulation = &mut schema["$defs"]["Simulation"];
    for world in World::built_in() {
        for (name, setting) in world.settings() {
            let of_setting = match setting {
                Setting::Range(_) => &range,
                Setting::Number(_) => &clearance,
            };
            simulation["properties"][name] = of_setting.clone();
        }
    }
    simulation["additionalProperties"] =
        json!({ "description": "A setting of another world.", "anyOf": [range, clearance] });
}

/// The keys of a spec that `quick` and overrides can't replace as a whole.
const NOT_OVERRIDDEN: [&str; 2] = ["quick", "readings"];

/// How keys below `vary` begin, which is replaced as a whole.
pub(super) const BELOW_VARY: &str = "vary.";

/// Whether `vary` takes the setting: not what makes cells of its own.
pub(super) fn varies(key: &str) -> bool {
    const SECTIONS: [&str; 15] = [
        "input",
        "inputs",
        "output",
        "given",
        "probes",
        "outputs",
        "tasks",
        "action",
        "window",
        "network",
        "simulation",
        "split",
        "test",
        "scaling",
        "training",
    ];
    SECTIONS.contains(&key.split('.').next().unwrap_or(key))
}

/// Whether a search may draw the setting. Trials with other data, outputs or scales could not be compared by their
/// losses, nor could those with other distributions. Successive halving sets the last epoch, the device changes
/// nothing but rounding, and distributions are recalibrated after the losses are known.
fn draws(key: &str) -> bool {
    const SECTIONS: [&str; 5] = ["input", "outputs", "action", "network", "training"];
    let is_set = ["training.last_epoch", "training.device", "training.recalibration"].contains(&key);
    let is_drawn = !is_set && !key.ends_with(".distribution");
    SECTIONS.contains(&key.split('.').next().unwrap_or(key)) && is_drawn
}

/// The distributions of a setting: one of those that suit its type.
fn candidates(root: &Json, setting: &Json) -> Json {
    let own = resolve(root, setting).0;
    let is = |name: &str| types(own).contains(&name);
    let kinds = KINDS[if is("number") {
        0
    } else if is("integer") {
        1
    } else {
        2
    }];
    distributions(own, kinds, setting.clone())
}

/// One of these distributions of values within the bounds of `own`, or with the schema `value`.
fn distributions(own: &Json, kinds: &[&str], value: Json) -> Json {
    let range = |kind: &str, description: &str| {
        let mut item = json!({ "type": kind });
        for bound in ["minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum"] {
            if let Some(value) = own.get(bound) {
                item[bound] = value.clone();
            }
        }
        json!({ "description": description, "type": "array", "items": item, "minItems": 2, "maxItems": 2 })
    };
    let of = |kind: &str| match kind {
        "uniform" => range("number", "Uniform between the lowest and the highest value."),
        "log_uniform" => {
            range("number", "Uniform in the logarithm, between the lowest and the highest value.")
        }
        "integer" => range("integer", "An integer from the lowest to the highest value."),
        _ => {
            let mut choice = several((String::new(), value.clone())).1;
            choice["description"] = "One of several values.".into();
            choice
        }
    };
    let properties: serde_json::Map<_, _> = kinds.iter().map(|kind| ((*kind).to_owned(), of(kind))).collect();
    json!({
        "type": "object", "properties": properties, "additionalProperties": false, "minProperties": 1,
        "maxProperties": 1,
    })
}

/// A list of different values of a setting.
fn several((key, setting): (String, Json)) -> (String, Json) {
    (key, json!({ "type": "array", "items": setting, "minItems": 1, "uniqueItems": true }))
}

/// Sets the keys of a section and forbids all others. A `*` in a key stands for any name.
fn set_keys(section: &mut Json, keys: impl IntoIterator<Item = (String, Json)>) {
    let (patterns, names): (Vec<_>, Vec<_>) = keys.into_iter().partition(|(key, _)| key.contains('*'));
    let patterns = patterns.into_iter().map(|(key, setting)| (key_pattern(&key), setting));
    section["properties"] = names.into_iter().collect::<serde_json::Map<_, _>>().into();
    section["patternProperties"] = patterns.collect::<serde_json::Map<_, _>>().into();
    section["additionalProperties"] = json!(false);
}

/// The settings of worlds that are not built in.
const OF_OTHER_WORLDS: [&str; 2] = ["*_range*", "*_clearance_m"];

/// Adds references to what `schema`, which is at `place`, describes, down to the values that are no sections, by dotted
/// key. The key of what a world or a modality of any name has contains a `*`.
fn collect_settings(
    root: &Json,
    schema: &Json,
    place: &str,
    prefix: &str,
    settings: &mut serde_json::Map<String, Json>,
) {
    const OTHERS: &str = "additionalProperties";
    let own =
        properties(schema).map(|(name, property)| (name.as_str(), format!("properties/{name}"), property));
    let others = schema.get(OTHERS).filter(|others| others.is_object());
    let names: &[&str] = if prefix == "simulation" { &OF_OTHER_WORLDS } else { &["*"] };
    let others =
        others.into_iter().flat_map(|own| names.iter().map(move |name| (*name, OTHERS.to_owned(), own)));
    for (name, step, property) in own.chain(others) {
        let (path, place) = (join(prefix, name), format!("{place}/{step}"));
        let (definition, named) = resolve(root, property);
        if definition.get("properties").is_some() {
            let place = if named.is_empty() { place } else { format!("#/$defs/{named}") };
            collect_settings(root, definition, &place, &path, settings);
        } else {
            settings.insert(path, json!({ "$ref": place }));
        }
    }
}

/// Makes a list of each single value that stands where a spec has a list: `latent: 4` becomes `latent: [4]`.
pub(super) fn list_single_values(tree: &mut Node) {
    list_single(&SCHEMA, tree);
}

/// Returns whether a setting is a list that may have a single item.
pub(super) fn is_list(setting: &str) -> bool {
    setting_schema(setting).is_some_and(takes_one_item)
}

/// Returns whether the schema allows a value of a setting.
pub(super) fn allows(setting: &str, value: &Node) -> bool {
    setting_schema(setting).is_some_and(|schema| check_part(&SCHEMA, schema, value, &HINTS).is_ok())
}

/// Whether there is a setting of that dotted key: one of [`setting_names`], or one that a world or a modality of
/// another name makes.
pub(super) fn is_setting(key: &str) -> bool {
    !key.starts_with(BELOW_VARY)
        && setting_schema(key).is_some_and(|schema| schema.get("properties").is_none())
}

/// Whether a name may be that of an axis with labels: no setting has it, and nothing else that tells runs apart.
pub fn is_axis(name: &str) -> bool {
    const OTHERS: [&str; 13] = [
        "scenario",
        "seed",
        "variant",
        "model",
        "trial",
        "dataset",
        "world",
        "revision",
        "experiment",
        "settings",
        "task",
        "modality",
        "metric",
    ];
    static SETTINGS: LazyLock<BTreeSet<String>> = LazyLock::new(|| {
        let sections = properties(&SCHEMA).map(|(name, _)| name.clone());
        let names = setting_names().into_iter().map(|key| match key.split_once('.') {
            Some((_section, name)) => name.to_owned(),
            None => key,
        });
        names.chain(sections).collect()
    });
    let is_of_world = OF_OTHER_WORLDS.iter().any(|pattern| is_like(&key_pattern(pattern), name));
    is_name(name) && !OTHERS.contains(&name) && !SETTINGS.contains(name) && !is_of_world
}

/// Returns the dotted key of the setting that may vary and has this name: its key, or its key without its section, if
/// no other setting has the same. `None` if there is none. The settings of outputs have the keys that runs store, and
/// those of the test and `split.seed` only whole keys, because those of the simulation have the same names.
pub fn varied_setting(name: &str) -> Option<String> {
    if let Some(stored) = stored_key(name) {
        return is_setting(name).then_some(stored);
    }
    if varies(name) && is_setting(name) {
        return Some(name.to_owned());
    }
    let names = setting_names();
    let ending = format!(".{name}");
    let is_whole_only = |key: &str| key.starts_with("test.") || key == "split.seed";
    let is_it = |key: &&String| varies(key) && key.ends_with(&ending) && !is_whole_only(key);
    let mut found = names.iter().filter(is_it);
    found.next().filter(|_| found.next().is_none()).cloned()
}

/// Returns the schema of the value of a dotted key.
fn setting_schema(key: &str) -> Option<&'static Json> {
    let mut schema: &'static Json = &SCHEMA;
    if NOT_OVERRIDDEN.contains(&key.split('.').next().unwrap_or(key)) {
        return None;
    }
    for step in key.split('.') {
        let next = property(schema, step);
        if next.is_null() || next == false {
            return None;
        }
        schema = resolve(&SCHEMA, next).0;
    }
    Some(schema)
}

/// Refuses a tree that the schema does not allow.
pub(super) fn check(tree: &Node) -> Result<(), Problem> {
    check_against(&SCHEMA, tree, &HINTS)
}

/// Accepts the names of the built-in worlds, which editors complete, paths of world files, and names of datasets.
impl JsonSchema for Origin {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Scenario".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let built_in = World::built_in().iter().map(|world| {
            serde_json::json!({
                "description": world.description(), "type": "string", "const": world.scenario().name(),
            })
        });
        let file = serde_json::json!({
            "description": "The path of a world file, relative to the spec's folder.", "type": "string",
            "pattern": "(/|\\.ya?ml$)",
        });
        let imported = serde_json::json!({
            "description": "An imported dataset: the name of its folder in results/datasets.", "type": "string",
            "pattern": IMPORTED_NAME,
        });
        let choices: Vec<_> = built_in.chain([file, imported]).collect();
        json_schema!({ "description": "The source of a cell's samples.", "oneOf": choices })
    }
}
