//! The types of a YAML spec, its validation, and the runs that an experiment expands to.
//!
//! The types are strict: unknown keys, wrong types and impossible values are refused with file, line and
//! column. A loaded [`Experiment`] is resolved: overrides are applied, every default is explicit, modalities are in
//! the order of [`Modality`], and `quick` is applied or dropped. Two specs with the same meaning are therefore equal.
//! Derived values are not stored.

mod built_in;
mod cells;
mod disturbance;
mod error;
mod explain;
mod extends;
mod factor;
mod hints;
mod kind;
mod layout;
mod mapping;
mod narrow;
mod origin;
mod outputs;
mod overrides;
mod run;
mod schema;
mod search;
mod simulation;
mod sobol;
mod split;
mod stored;
mod text;
mod types;
mod validate;
mod values;
mod vary;
mod world;
mod yaml;

pub use built_in::{BuiltIn, SPECS, YamlFile, find};
pub use disturbance::{Disturbance, Disturbances};
pub use error::SpecError;
pub use explain::{Explained, Sourced, explain};
pub use factor::{Distribution, Drawing, Factor, Normal, Property};
pub use layout::{
    AXES, CLASS_COLORS, CONTACT_PARTS, Definition, Element, Episode, GivenScaling, GivenScalings, Group,
    IMAGE_CHANNELS, Kind, Label, LabelKind, Layout, Modality, NO_CONTACT, Percentage, Pose, Region, Scale,
    Scaling, Scalings, Segmentation, intern, is_name,
};
pub use mapping::{mapping_schema, read_mapping};
pub use origin::{Origin, Scenario};
pub use run::{Model, RunSpec, Trained, label_in, model_parts, variant_parts};
pub use schema::{is_axis, schema, schema_text, setting_names, varied_setting};
pub use search::{Candidates, Halving, Method, Objective, Search, Trial};
pub use simulation::{MAX_SEED, Setting, Simulation};
pub use sobol::{SOBOL_DIMENSIONS, sobol};
pub use split::{Division, Group as SplitGroup, Part, Split, SplitCounts, Tested};
pub use text::read_text;
pub use types::*;
pub use values::matching;
pub use world::*;

use cells::{Combination, TEST_WORLD};
use kind::FileKind;
use serde_json::Value as Json;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use vary::VARY;
use yaml::{Entry, Node, Problem, Value, parse, shorten};

/// Reads and resolves a spec: a file, or one of [`SPECS`] by its name, as [`find`] does. It applies the spec's `quick`
/// settings if `quick` is true, and then `overrides`.
///
/// An override is `KEY=VALUE`, with a dotted key and a YAML value. With `quick`, the experiment's name ends in
/// `-quick`, so that results of small runs are kept apart from the others. If `quick` or an override sets a setting
/// that the spec varies, only that value is tried.
///
/// # Errors
/// Returns the first fault of the spec in the file, of its `quick` settings (even if they are not applied), or of the
/// overrides.
pub fn load(path: &Path, overrides: &[String], quick: bool) -> Result<Experiment, SpecError> {
    parse_in(&find("experiment", path, SPECS)?, overrides, quick, Purpose::Training)
}

/// Resolves a spec like [`load`], but not for training: to collect its data, or to judge models of other programs. The
/// spec may lack `latent` and `network`, and rules of networks do not apply to it.
pub fn load_task(path: &Path, overrides: &[String], quick: bool) -> Result<Experiment, SpecError> {
    parse_in(&find("experiment", path, SPECS)?, overrides, quick, Purpose::Task)
}

/// Resolves a spec like [`load`], but from its text. Messages call the text `path`, and the paths of world files are
/// relative to the folder of `path`.
pub fn parse_spec(
    path: &str,
    text: &str,
    overrides: &[String],
    quick: bool,
) -> Result<Experiment, SpecError> {
    parse_in(&file_of(path, text), overrides, quick, Purpose::Training)
}

/// The question of the built-in experiment of this name, as its spec says; `None` if there is no such experiment.
pub fn description(name: &str) -> Option<String> {
    let spec = SPECS.iter().find(|spec| spec.name == name)?;
    Some(parse_spec(&spec.label(), spec.text, &[], false).ok()?.description)
}

/// Resolves a spec like [`load_task`], but from its text, as [`parse_spec`] does.
pub fn parse_task(path: &str, text: &str) -> Result<Experiment, SpecError> {
    parse_in(&file_of(path, text), &[], false, Purpose::Task)
}

fn file_of(path: &str, text: &str) -> YamlFile {
    let folder = Path::new(path).parent().unwrap_or(Path::new("")).to_owned();
    YamlFile { label: path.to_owned(), folder, text: text.to_owned().into() }
}

/// What a spec is read for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Purpose {
    /// Networks are trained.
    Training,
    /// Data are collected, or models of other programs are judged. Nothing is trained.
    Task,
}

fn parse_in(
    file: &YamlFile,
    overrides: &[String],
    quick: bool,
    purpose: Purpose,
) -> Result<Experiment, SpecError> {
    let mut worlds = WorldFiles { folder: &file.folder, purpose, read: BTreeMap::new() };
    let read = load_tree(&mut worlds, file, overrides, quick);
    let (_, mut experiment) = read.map_err(|problem| SpecError::of(problem, &file.label))?;
    if quick {
        experiment.name.push_str(QUICK);
    }
    Ok(experiment)
}

/// Suffix of the experiment's name if its `quick` settings are applied.
pub const QUICK: &str = "-quick";

const NOT_QUICK: &str = "there is no 'quick' section, so a quick run would be the full one under another name; add the \
                         section, or leave out --quick";

/// Returns the tree of a spec with its quick settings and overrides, and the experiment that it describes.
fn load_tree(
    worlds: &mut WorldFiles,
    file: &YamlFile,
    overrides: &[String],
    quick: bool,
) -> Result<(Node, Experiment), Problem> {
    let mut tree = extends::read(file)?;
    if matches!(tree.value, Value::Null) {
        return Err(Problem::new(
            &tree.place,
            "the file is empty; see `harness schema` for what a spec holds",
        ));
    }
    FileKind::Experiment.check(&tree)?;
    if worlds.purpose == Purpose::Task {
        add_network(&mut tree);
    }
    schema::list_single_values(&mut tree);
    vary::complete(&mut tree, false)?;
    resolve(worlds, &tree)?;
    let mut quick_tree = tree.clone();
    match tree.get("quick") {
        Some(Node { value: Value::Section(settings), .. }) if !settings.is_empty() => {
            overrides::apply(&mut quick_tree, settings);
            resolve(worlds, &quick_tree).map_err(|problem| problem.after("applying 'quick'"))?;
        }
        _ if quick => return Err(Problem::new(&tree.place, NOT_QUICK)),
        _ => {}
    }
    if quick {
        tree = quick_tree;
    }
    let overrides = overrides::read_all(overrides)?;
    overrides::apply(&mut tree, &overrides);
    schema::list_single_values(&mut tree);
    vary::complete(&mut tree, true)?;
    let experiment = resolve(worlds, &tree).map_err(|problem| problem.after("applying the overrides"))?;
    check_variants(worlds, &tree, &experiment)?;
    Ok((tree, experiment))
}

/// Adds a network to a spec that has none. Nothing uses it.
fn add_network(tree: &mut Node) {
    let network = serde_json::json!({ "latent": [1], "network": { "preset": "multi_to_multi" } });
    let unused = Node::of_json(&network, &tree.place);
    if let (Value::Section(entries), Value::Section(unused)) = (&mut tree.value, unused.value) {
        let lacks = |entry: &Entry| entries.iter().all(|own| own.key != entry.key);
        let lacking: Vec<Entry> = unused.into_iter().filter(lacks).collect();
        entries.extend(lacking);
    }
}

/// Returns the value that a text stands for as the value of a setting, as in `KEY=VALUE`; `None` if it is no YAML.
pub fn setting_value(text: &str) -> Option<serde_json::Value> {
    parse(text).ok().map(|node| node.to_json())
}

/// Checks the experiment with each combination of the points of its axes.
fn check_variants(worlds: &mut WorldFiles, tree: &Node, experiment: &Experiment) -> Result<(), Problem> {
    let variant = Variants::of(tree);
    let mut variants = Vec::new();
    for combination in experiment.combinations() {
        let tree = variant.tree(&combination);
        let name = combination.name();
        let what = if name.is_empty() { "'vary'" } else { &name };
        let variant = resolve(worlds, &tree).map_err(|problem| problem.after(&format!("applying {what}")))?;
        if !experiment.vary.is_empty() {
            variants.push((combination, variant.alone().canonical()));
        }
    }
    check_different(tree, experiment, &variants)
}

/// What the trees of an experiment's variants are made of.
struct Variants<'a> {
    tree: &'a Node,
    /// The settings that the tree varies, as written in it.
    written: Vec<Entry>,
    /// The names of all modalities that some variant gets, and of those that some variant predicts.
    inputs: BTreeSet<String>,
    outputs: BTreeSet<String>,
}

impl<'a> Variants<'a> {
    fn of(tree: &'a Node) -> Self {
        let written = varied_settings(tree);
        let [inputs, outputs] = [INPUT, OUTPUT].map(|list| names_of(list, tree, &written));
        Self { tree, inputs, outputs, written }
    }

    /// Returns the tree with the settings of one combination.
    fn tree(&self, combination: &Combination) -> Node {
        let mut tree = combination.applied_to(self.tree, &self.written);
        leave_out_settings_of(&mut tree, OUTPUT, &self.outputs, outputs::sections());
        leave_out_settings_of(&mut tree, INPUT, &self.inputs, ["inputs".to_owned()]);
        tree
    }
}

/// The keys of the modalities that the encoder gets, and of those that are predicted.
const INPUT: &str = "input";
const OUTPUT: &str = "output";

/// Returns the names of all modalities that some combination has in the list with this key.
fn names_of(list: &str, tree: &Node, varied: &[Entry]) -> BTreeSet<String> {
    let own = tree.get(list).into_iter();
    let all = own.chain(varied.iter().filter(|entry| entry.key == list).map(|entry| &entry.node));
    all.flat_map(names_in).collect()
}

/// Returns the texts in a list; none if this is not a list.
fn names_in(node: &Node) -> Vec<String> {
    let Value::List(items) = &node.value else { return Vec::new() };
    items.iter().filter_map(|item| item.to_json().as_str().map(str::to_owned)).collect()
}

/// Removes settings of modalities that other combinations have in the list with this key and this one does not. A
/// reading can then weight the outputs of all labels.
fn leave_out_settings_of(
    tree: &mut Node,
    list: &str,
    all: &BTreeSet<String>,
    sections: impl IntoIterator<Item = String>,
) {
    let own = tree.get(list).map(names_in).unwrap_or_default();
    for key in sections {
        let section = key.split('.').try_fold(&mut *tree, |node, key| node.get_mut(key));
        if let Some(Node { value: Value::Section(entries), .. }) = section {
            entries.retain(|entry| own.contains(&entry.key) || !all.contains(&entry.key));
        }
    }
}

/// Refuses a value of a varied setting that always makes the same runs as another one, such as 1.0 and 1.
fn check_different(
    tree: &Node,
    experiment: &Experiment,
    variants: &[(Combination, Experiment)],
) -> Result<(), Problem> {
    let values_of = |(key, values)| Some((key, Json::as_array(values)?));
    for (key, values) in experiment.vary.iter().filter_map(values_of) {
        // The variants of two values have the same order.
        let of = |value| variants.iter().filter(move |(combination, _)| combination.has(key, value));
        let of: Vec<Vec<&Experiment>> =
            values.iter().map(|value| of(value).map(|(_, variant)| variant).collect()).collect();
        for (index, variants) in of.iter().enumerate() {
            let Some(same) = of[..index].iter().position(|others| others == variants) else { continue };
            let origin = tree.place_of(&format!("{VARY}.{key}.{index}"));
            let [value, other] = [index, same].map(|place| shorten(&values[place].to_string()));
            return Err(Problem::new(
                origin,
                format!("{value} in '{VARY}.{key}' makes the same runs as {other}; leave one of them out"),
            ));
        }
    }
    Ok(())
}

/// Returns the settings that a tree varies: one entry for each value, as written in the spec.
fn varied_settings(tree: &Node) -> Vec<Entry> {
    let section = |node: Option<&Node>| match node.map(|node| &node.value) {
        Some(Value::Section(entries)) => entries.clone(),
        _ => Vec::new(),
    };
    let list = |node: Option<&Node>| match node.map(|node| &node.value) {
        Some(Value::List(items)) => items.clone(),
        _ => Vec::new(),
    };
    let of_readings = list(tree.get("readings")).into_iter().flat_map(|one| section(one.get("settings")));
    let varied = section(tree.get(VARY)).into_iter().flat_map(|axis| match &axis.node.value {
        Value::Section(labels) => labels.iter().flat_map(|label| section(Some(&label.node))).collect(),
        _ => {
            list(Some(&axis.node)).into_iter().map(|node| Entry { node, ..axis.clone() }).collect::<Vec<_>>()
        }
    });
    of_readings.chain(varied).collect()
}

/// Returns the experiment that a tree describes, checked and with every default explicit.
fn resolve(worlds: &mut WorldFiles, tree: &Node) -> Result<Experiment, Problem> {
    schema::check(tree)?;
    let mut experiment: Experiment = serde_json::from_value(tree.to_json())
        .map_err(|error| Problem::new(&tree.place, error.to_string()))?;
    experiment.worlds = worlds.of(tree, &experiment.scenarios)?;
    let at = |fault: validate::Fault| {
        Problem::new(tree.place_of(&fault.path), fault.message).in_items(&tree.items_on(&fault.path))
    };
    experiment.take_defaults_of_worlds(tree).map_err(at)?;
    outputs::store(&mut experiment).map_err(|(path, message)| at(validate::Fault { path, message }))?;
    check_rates(tree, &experiment)?;
    validate::validate(&experiment).map_err(at)?;
    if worlds.purpose == Purpose::Training {
        validate::validate_network(&experiment).map_err(at)?;
    }
    Ok(experiment.canonical())
}

/// Whether a spec sets this setting of the simulation.
fn sets(tree: &Node, key: &str) -> bool {
    tree.get("simulation").is_some_and(|section| section.get(key).is_some())
}

/// Refuses a sample rate or a duration of a move that can't be used. The place at fault is that of the value that the
/// spec sets, or that of the world whose own values are used.
fn check_rates(tree: &Node, experiment: &Experiment) -> Result<(), Problem> {
    let Simulation { actuation_seconds: seconds, sample_rate_hz: rate, .. } = experiment.simulation;
    let [sets_rate, sets_seconds] = ["sample_rate_hz", "actuation_seconds"].map(|key| sets(tree, key));
    let at = |path: &str, message: String| Problem::new(tree.place_of(path), message);
    for (index, origin) in experiment.scenarios.iter().enumerate() {
        let Some(world) = experiment.world(origin) else { continue };
        let of_world = |error: SpecError| at(&format!("scenarios.{index}"), error.to_string());
        if sets_rate {
            simulation::sample_rate(rate, world.file().step_rate_hz)
                .map_err(|message| at("simulation.sample_rate_hz", message))?;
        } else {
            world.check_sample_rate().map_err(of_world)?;
        }
        if !sets_rate && !sets_seconds {
            world.check_rates().map_err(of_world)?;
        }
    }
    simulation::actuation(seconds, rate).map_err(|message| match sets_seconds {
        true => at("simulation.actuation_seconds", message),
        false => at("simulation.sample_rate_hz", format!("simulation.actuation_seconds: {message}")),
    })
}

/// How a spec is read, and its world files. Each is read once, however many combinations of settings use it.
struct WorldFiles<'a> {
    /// The folder to which their paths are relative.
    folder: &'a Path,
    /// What the spec is read for.
    purpose: Purpose,
    /// The worlds by the paths of their files.
    read: BTreeMap<PathBuf, Arc<World>>,
}

impl WorldFiles<'_> {
    /// Returns the worlds of the world files among `scenarios`, and of those that the tests of some variant are in.
    fn of(&mut self, tree: &Node, scenarios: &[Origin]) -> Result<Vec<Arc<World>>, Problem> {
        let of_scenario = |(index, origin): (usize, &Origin)| {
            (origin.clone(), tree.place_of(&format!("scenarios.{index}")).clone())
        };
        let of_test = |node: Node| match node.value {
            Value::Text(name) => Some((Origin::try_from(name).ok()?, node.place)),
            _ => None,
        };
        let own = tree.get("test").and_then(|test| test.get("world")).cloned();
        let varied = varied_settings(tree).into_iter().filter(|entry| entry.key == TEST_WORLD);
        let of_tests = own.into_iter().chain(varied.map(|entry| entry.node)).filter_map(of_test);
        let named = scenarios.iter().enumerate().map(of_scenario).chain(of_tests);
        let mut worlds: Vec<Arc<World>> = Vec::new();
        for (origin, place) in named {
            let Origin::File(path) = origin else { continue };
            let at = |message: String| Problem::new(&place, message);
            let world = self.world(self.folder.join(path)).map_err(|error| at(error.to_string()))?;
            match worlds.iter().find(|other| other.scenario() == world.scenario()) {
                Some(same) if Arc::ptr_eq(same, &world) => {}
                Some(_) => {
                    return Err(at(format!(
                        "two world files are called '{}'; give one another name",
                        world.scenario()
                    )));
                }
                None => worlds.push(world),
            }
        }
        Ok(worlds)
    }

    fn world(&mut self, path: PathBuf) -> Result<Arc<World>, SpecError> {
        if let Some(world) = self.read.get(&path) {
            return Ok(world.clone());
        }
        let world = World::load(&path)?;
        self.read.insert(path, world.clone());
        Ok(world)
    }
}

impl Experiment {
    /// Sets the values that the spec leaves out to those of its worlds: the rates, and the worlds' own settings. The test
    /// has the same values, so its world may not have others.
    fn take_defaults_of_worlds(&mut self, tree: &Node) -> Result<(), validate::Fault> {
        let world = |(index, origin)| Some((index, self.world(origin)?));
        let worlds: Vec<(usize, Arc<World>)> = self.scenarios.iter().enumerate().filter_map(world).collect();
        let Some((_, first)) = worlds.first() else { return Ok(()) };
        for (index, world) in &worlds {
            let is_first = Arc::ptr_eq(world, first);
            let path = format!("scenarios.{index}");
            let differs = |key: &str| validate::Fault::between_worlds(key, first, world, &path);
            let own = world.simulation();
            let rates = [
                ("sample_rate_hz", own.sample_rate_hz, &mut self.simulation.sample_rate_hz),
                ("actuation_seconds", own.actuation_seconds, &mut self.simulation.actuation_seconds),
            ];
            for (key, own, value) in rates.into_iter().filter(|(key, ..)| !sets(tree, key)) {
                if !is_first && *value != own {
                    return Err(differs(key));
                }
                *value = own;
            }
            for (key, own) in own.world {
                if sets(tree, &key) {
                    continue;
                }
                let other = self.simulation.world.insert(key.clone(), own);
                if !is_first && other.is_some_and(|other| other != own) {
                    return Err(differs(&key));
                }
            }
        }
        let Some(test) = self.test.as_ref().and_then(|test| self.world(test.world.as_ref()?)) else {
            return Ok(());
        };
        let (own, used) = (test.simulation(), &self.simulation);
        let rates = [
            ("sample_rate_hz", own.sample_rate_hz != used.sample_rate_hz),
            ("actuation_seconds", own.actuation_seconds != used.actuation_seconds),
        ];
        let has_other =
            |(key, own): &(&String, &Setting)| used.world.get(*key).is_some_and(|used| used != *own);
        let settings = own.world.iter().filter(has_other).map(|(key, _)| key.as_str());
        let others = rates.into_iter().filter(|(_, differs)| *differs).map(|(key, _)| key).chain(settings);
        match others.into_iter().find(|key| !sets(tree, key)) {
            Some(key) => Err(validate::Fault::between_worlds(key, first, &test, TEST_WORLD)),
            None => Ok(()),
        }
    }

    /// Makes specs with the same meaning equal: sorts the modalities, makes the default weights, channels and gap
    /// explicit, removes the other settings of outputs that have their default, and clears `quick`.
    ///
    /// Without images, the settings of convolutions have no effect and are cleared. With variants, the channels and
    /// their default depend on the variant, so this is left to the variants.
    fn canonical(mut self) -> Self {
        self.input.sort();
        self.output.sort();
        self.probes.sort();
        self.simulation.factors.sort();
        self.test.iter_mut().flat_map(|test| &mut test.factors).for_each(|factors| factors.sort());
        self.training.loss_weights.retain(|modality, _| self.output.contains(modality));
        for &modality in &self.output {
            self.training.loss_weights.entry(modality).or_insert(1.0);
        }
        self.training
            .losses
            .retain(|modality, loss| self.output.contains(modality) && *loss != Loss::Squared);
        self.training
            .distributions
            .retain(|modality, family| self.output.contains(modality) && *family != Family::None);
        self.training
            .predict
            .retain(|modality, predict| self.output.contains(modality) && *predict != Predict::Value);
        self.outputs.clear();
        // A modality that no world declares may be an image: only its dataset defines it.
        let may_be_image = |modality: &Modality| {
            self.scenarios
                .iter()
                .any(|origin| self.known(origin, *modality).is_none_or(|known| known.size.is_some()))
        };
        if !self.has_variants() {
            if self.input.iter().chain(&self.output).any(may_be_image) {
                self.network.channels = Some(self.network.channels().to_vec());
            } else {
                (self.network.channels, self.network.average) = (Some(Vec::new()), 1);
            }
            let none = Disturbance::default();
            self.inputs.retain(|modality, own| self.input.contains(modality) && *own != none);
            self.given = self.tests();
            // The input is reconstructed anyway.
            self.probes.retain(|modality| !self.input.contains(modality));
            self.training.modality_dropout = self.training.modality_dropout.of_inputs(&self.input);
            if self.training.distributions.is_empty() {
                self.training.recalibration = Recalibration::default();
            }
            if self.network.memory != Memory::Window {
                self.network.memory_samples = Network::default().memory_samples;
            }
        }
        if self.split.by == Division::Time {
            self.split.gap_seconds.get_or_insert(Split::GAP_SECONDS);
        } else {
            self.split.gap_seconds = None;
        }
        if self.test.is_some() {
            self.split.test = Split::default().test;
        }
        self.quick.clear();
        self
    }

    /// Returns the spec as YAML with every value explicit. Loading it gives an equal experiment.
    pub fn to_yaml(&self) -> String {
        serde_yaml::to_string(self).expect("a spec is plain data, which YAML can hold")
    }
}
