//! The settings of runs, the settings in which runs differ, and the settings that a selection requests.

use harness_registry::{Recorded, RunRecord, UNKNOWN, leaves, quoted};
use harness_shared::numbers::{by_value, first_few};
use harness_spec::{Layout, RunSpec, is_axis, label_in, setting_value, varied_setting};
use rayon::prelude::*;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::str::FromStr;

/// The key of the dataset's folder, which is not a setting of the spec.
pub(super) const DATASET: &str = "dataset";
/// The key of the version of the world, which is not a setting of the spec.
const WORLD: &str = "world";
/// The key of the method's revision, which is not a setting of the spec.
const REVISION: &str = "revision";
/// What runs can differ in besides the settings of their specs.
pub(super) const OF_RUNS: [&str; 3] = [DATASET, WORLD, REVISION];
/// The key of the scenario.
const SCENARIO: &str = "scenario";
/// The key of the world of the test.
const TEST_WORLD: &str = "test.world";
/// The key of the size of the latent state, which models of other programs lack.
const LATENT: &str = "latent";
/// The keys in which the runs of an experiment may always differ.
const OF_CELLS: [&str; 5] = [SCENARIO, LATENT, "seed", "simulation.seed", "split.fold"];
/// The key of the settings that an experiment varies.
pub(super) const VARIANT: &str = "variant";
/// The name of an external model, which only runs of external models have.
const MODEL: &str = "model";
/// The sections and the list of a spec about what a run trains.
const OF_NETWORKS: [&str; 3] = ["network.", "training.", "tasks"];
/// The section of a spec that only runs on simulated episodes have.
const SIMULATION: &str = "simulation.";
/// The sections of a spec with settings for each modality that a run uses.
const OF_MODALITIES: [&str; 5] = [
    "training.loss_weights.",
    "training.losses.",
    "training.distributions.",
    "training.predict.",
    "scaling.",
];
/// The settings of a spec that have an effect only on images.
const OF_IMAGES: [&str; 2] = ["network.channels", "network.average"];
/// The lists of a spec whose order has no meaning.
const UNORDERED: [&str; 3] = ["input", "output", "simulation.factors"];
/// The value of a setting that a run does not have.
pub(super) const UNSET: &str = "unset";

/// The settings of a run: texts by dotted keys, such as `64` for `training.batch_size`.
pub(super) type Settings = BTreeMap<String, String>;

/// All settings of a run, also the defaults that its record does not store.
pub(super) fn of(record: &RunRecord) -> Settings {
    let mut settings = of_spec(&record.spec, &record.layout);
    settings.insert(DATASET.to_owned(), record.dataset.clone());
    if record.spec.simulation.is_some() {
        settings.insert(WORLD.to_owned(), record.world_version());
    }
    if let Some(revision) = record.revision() {
        settings.insert(REVISION.to_owned(), revision.to_string());
    }
    settings
}

/// All settings of a run's spec. Those that have no effect without images are left out of a run without images.
pub(super) fn of_spec(spec: &RunSpec, layout: &Layout) -> Settings {
    let mut settings: Settings = texts(&spec.complete(layout)).collect();
    let is_image = |modality| layout.get(modality).is_none_or(|definition| definition.is_image());
    if !spec.modalities().into_iter().any(is_image) {
        OF_IMAGES.iter().for_each(|key| drop(settings.remove(*key)));
    }
    settings
}

/// Everything that describes how a run was made, as texts by dotted keys: settings, dataset, code, versions and
/// machine.
pub fn all_settings(record: &RunRecord) -> BTreeMap<String, String> {
    let mut all = of(record);
    all.extend(texts(&serde_json::to_value(&record.provenance).unwrap_or_default()));
    all.remove("command");
    all
}

/// The settings in which some runs differ, with each run's value; `None` where a run does not have the setting.
pub fn varied_settings(runs: &[Recorded]) -> BTreeMap<String, Vec<Option<String>>> {
    let all: Vec<Settings> = runs.par_iter().map(|(_, record)| all_settings(record)).collect();
    let values = |key: &str| all.iter().map(|run| run.get(key).cloned()).collect();
    let varied = varied(&all.iter().collect::<Vec<_>>());
    varied.into_iter().map(|key| (key.to_owned(), values(key))).collect()
}

/// What differs between two runs, as (key, value of `a`, value of `b`): settings, dataset, code, versions and machine.
pub fn differing(a: &RunRecord, b: &RunRecord) -> Vec<(String, String, String)> {
    let (a, b) = (all_settings(a), all_settings(b));
    let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    let values =
        keys.into_iter().map(|key| (key.clone(), value(&a, key).to_owned(), value(&b, key).to_owned()));
    values.filter(|(_, a, b)| a != b).collect()
}

/// All values of a tree, except objects, as texts by their dotted keys.
fn texts(tree: &Value) -> impl Iterator<Item = (String, String)> {
    leaves(tree)
        .into_iter()
        .map(|(key, value)| (key, value.as_str().map_or_else(|| value.to_string(), str::to_owned)))
}

/// A setting in which runs of one experiment differ.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The setting's dotted key.
    pub key: String,
    /// The values that runs have, sorted.
    pub values: Vec<String>,
    /// Whether each run's `variant` shows the value.
    pub in_variant: bool,
    /// Whether it is a setting of the simulation, and all runs in the same scenario have the same value.
    pub of_scenario: bool,
}

impl Difference {
    /// The values that runs have for the setting `key`.
    pub(super) fn of<'a>(key: &str, runs: impl Iterator<Item = &'a Settings>) -> Self {
        let values = runs.map(|run| value(run, key)).collect();
        Self { key: key.to_owned(), values: sorted(values), in_variant: false, of_scenario: false }
    }
}

impl fmt::Display for Difference {
    /// Writes the key and the values: `training.batch_size (16, 64)`.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        /// The maximum number of values that are listed. The others are only counted.
        const SHOWN: usize = 6;
        let named = self.values.iter().map(|value| if value.is_empty() { "none" } else { value });
        write!(f, "{} ({})", self.key, first_few(&named.collect::<Vec<_>>(), SHOWN))
    }
}

/// The settings in which the runs of one experiment differ, without scenario, latent size and seeds.
///
/// Some settings are compared only between runs that have them: those of the simulation, which runs on imported data
/// lack, those of a network, which external models lack, the scaling, losses and loss weights of modalities, which runs
/// that do not use the modality lack, and those of convolutions, which runs without images lack. Different worlds and
/// datasets of different scenarios or simulation settings are no difference. Two datasets with the same scenario and
/// simulation settings are one, because then the world, its model or MuJoCo differs. So are two versions of a world.
pub(super) fn differences(runs: &[&Settings]) -> Vec<Difference> {
    let varied = varied(runs);
    let mut values: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    let is_of_spec = |key: &&&str| !OF_CELLS.contains(key) && !OF_RUNS.contains(key);
    for key in varied.iter().filter(is_of_spec) {
        values.insert(key, concerned(runs, key).map(|run| value(run, key)).collect());
    }
    let mut of_dataset = vec![SCENARIO];
    of_dataset.extend(varied.iter().filter(|key| key.starts_with(SIMULATION)));
    for (key, from) in [(DATASET, &of_dataset[..]), (WORLD, &[SCENARIO])] {
        if varied.contains(key) && !values.contains_key(DATASET) && !follows(runs, key, from) {
            values.insert(key, concerned(runs, key).map(|run| value(run, key)).collect());
        }
    }
    let differing = values.into_iter().filter(|(_, values)| values.len() > 1);
    let difference = |(key, values)| {
        let in_variant = key == VARIANT || is_in_variant(runs, key);
        let of_scenario = key.starts_with(SIMULATION) && follows(runs, key, &[SCENARIO]);
        Difference { key: key.to_owned(), values: sorted(values), in_variant, of_scenario }
    };
    differing.map(difference).collect()
}

/// The keys that some run has and another lacks, or whose values differ.
fn varied<'a>(runs: &[&'a Settings]) -> BTreeSet<&'a str> {
    let Some((first, others)) = runs.split_first() else { return BTreeSet::new() };
    let mut varied = BTreeSet::new();
    for run in others {
        if run.keys().eq(first.keys()) {
            let differing = run.iter().zip(first.values()).filter(|((_, value), other)| value != other);
            varied.extend(differing.map(|((key, _), _)| key.as_str()));
        } else {
            let keys = run.keys().chain(first.keys());
            varied.extend(keys.filter(|key| run.get(*key) != first.get(*key)).map(String::as_str));
        }
    }
    varied
}

/// Whether all runs with the same values of the settings `from` have the same value of another one.
fn follows(runs: &[&Settings], key: &str, from: &[&str]) -> bool {
    let mut values: BTreeMap<Vec<&str>, &str> = BTreeMap::new();
    concerned(runs, key).all(|run| {
        let own = value(run, key);
        *values.entry(from.iter().map(|key| value(run, key)).collect()).or_insert(own) == own
    })
}

/// The runs between which a setting is compared.
fn concerned<'a>(runs: &[&'a Settings], key: &str) -> impl Iterator<Item = &'a Settings> {
    runs.iter().copied().filter(move |run| concerns(run, key))
}

/// Whether a run is compared with others by a setting.
pub(super) fn concerns(run: &Settings, key: &str) -> bool {
    match key {
        WORLD => run.get(WORLD).is_some_and(|version| version != UNKNOWN),
        key if key.starts_with(SIMULATION) => is_simulated(run),
        key if key == MODEL
            || OF_IMAGES.contains(&key)
            || OF_MODALITIES.iter().any(|section| key.starts_with(section)) =>
        {
            run.contains_key(key)
        }
        key if OF_NETWORKS.iter().any(|section| key.starts_with(section)) => !run.contains_key(MODEL),
        _ => true,
    }
}

/// Sorts numbers by value, and after them other texts alphabetically.
fn sorted(values: BTreeSet<&str>) -> Vec<String> {
    let mut values: Vec<String> = values.into_iter().map(str::to_owned).collect();
    values.sort_by(|a, b| by_value(a, b));
    values
}

fn is_simulated(run: &Settings) -> bool {
    run.keys().any(|key| key.starts_with(SIMULATION))
}

/// The run's value of the setting `key`, or its label of the axis with this name, or [`UNSET`].
pub(super) fn value<'a>(run: &'a Settings, key: &str) -> &'a str {
    let label = || is_axis(key).then(|| label_in(run.get(VARIANT)?, key)).flatten();
    // A spec has no disturbances of strength 0, and no list of all elements.
    let strength = || if key.ends_with(".only") { "all" } else { "0" };
    let undisturbed = || key.starts_with("inputs.").then(strength);
    // A test names only another world than that of its run.
    let same_world = || run.get(SCENARIO).filter(|_| key == TEST_WORLD && is_simulated(run));
    let own = run.get(key).or_else(same_world).map(String::as_str);
    own.or_else(label).or_else(undisturbed).unwrap_or(UNSET)
}

/// The names of what a variant has values or labels of: settings without their section, and axes.
fn named(variant: &str) -> impl Iterator<Item = &str> {
    variant.split(',').filter_map(|part| part.split_once('=')).map(|(name, _)| name)
}

/// The keys of a run's settings, and the names of the axes of its labels.
pub(super) fn keys(run: &Settings) -> impl Iterator<Item = &str> {
    run.keys().map(String::as_str).chain(axes(run))
}

/// The names of the axes that a run has labels of.
pub(super) fn axes(run: &Settings) -> impl Iterator<Item = &str> {
    run.get(VARIANT).into_iter().flat_map(|variant| named(variant)).filter(|name| is_axis(name))
}

/// Whether every run's variant names the setting, and all runs with the same variant have the same value.
fn is_in_variant(runs: &[&Settings], key: &str) -> bool {
    // A variant names settings without their section: `training.kl_weight` is `kl_weight=0.001`.
    let name = key.split_once('.').map_or(key, |(_section, name)| name);
    let names = |variant: &str| {
        named(variant).any(|named| {
            // A label may set any setting.
            is_axis(named)
                || name == named
                || name.strip_prefix(named).is_some_and(|rest| rest.starts_with('.'))
        })
    };
    let mut values: BTreeMap<&str, &str> = BTreeMap::new();
    concerned(runs, key).all(|run| {
        let (variant, value) = (value(run, VARIANT), value(run, key));
        names(variant) && *values.entry(variant).or_insert(value) == value
    })
}

/// A setting that runs must have. It is written as `training.batch_size=64`, or for the runs of one experiment as
/// `smoke:training.batch_size=64`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Setting {
    /// The experiment whose runs must have the setting, or `None` for all experiments.
    pub experiment: Option<String>,
    /// The setting's dotted key, or the name of an axis with labels.
    pub key: String,
    /// The value, as a text, or the label.
    pub value: String,
}

impl FromStr for Setting {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let refused =
            || format!("'{text}' is not a setting; write KEY=VALUE, such as training.batch_size=64");
        let (key, value) = text.split_once('=').ok_or_else(refused)?;
        let (experiment, key) =
            key.split_once(':').map_or((None, key), |(name, key)| (Some(name.to_owned()), key));
        if key.trim().is_empty() {
            return Err(refused());
        }
        let key = key.trim();
        // A run stores the settings of outputs under other keys.
        let stored = key.starts_with("outputs.").then(|| varied_setting(key)).flatten();
        let key = stored.unwrap_or_else(|| key.to_owned());
        Ok(Self { experiment, key, value: value.trim().to_owned() })
    }
}

impl fmt::Display for Setting {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let experiment = self.experiment.as_ref().map(|name| format!("{name}:")).unwrap_or_default();
        write!(f, "{experiment}{}={}", self.key, self.value)
    }
}

impl Setting {
    /// The command-line option that requests the setting: `--where KEY=VALUE`, quoted for a shell.
    pub fn option(&self) -> String {
        format!("--where {}", quoted([self.to_string().as_str()]))
    }

    /// The override that gives runs this setting. `None` if the key has no section, such as `variant`, because no
    /// override changes it.
    pub fn as_override(&self) -> Option<String> {
        self.key.contains('.').then(|| format!("{}={}", self.key, self.value))
    }

    /// Whether the setting applies to the runs of an experiment.
    pub(crate) fn is_about(&self, experiment: &str) -> bool {
        self.experiment.as_ref().is_none_or(|name| name == experiment)
    }

    /// Whether the setting selects a version of a world, or a dataset.
    pub(crate) fn is_of_world(&self) -> bool {
        [WORLD, DATASET].contains(&self.key.as_str())
    }

    /// Whether a run has the setting, or can't have it, because the setting is one of a network and the run's model
    /// comes from another program.
    fn admits(&self, run: &Settings) -> bool {
        let is_of_network =
            self.key == LATENT || OF_NETWORKS.iter().any(|section| self.key.starts_with(section));
        is_of_network && run.contains_key(MODEL) || self.is_met_by(run)
    }

    /// Whether a run has the setting. The value is written as in a spec, and compared by what it means: 0.5 is 5e-1,
    /// and a list with one item is the item.
    pub(super) fn is_met_by(&self, run: &Settings) -> bool {
        let found = value(run, &self.key);
        let meaning = |text: &str| setting_value(text).map(|value| plain(value, &self.key));
        found == self.value || meaning(found).is_some_and(|found| meaning(&self.value) == Some(found))
    }
}

/// A value in the form in which it equals all values with the same meaning: numbers are floats, a list of one item is
/// the item, and lists without an order are sorted.
fn plain(value: Value, key: &str) -> Value {
    match value {
        Value::Number(number) => number.as_f64().into(),
        Value::Array(mut items) if items.len() == 1 => plain(items.remove(0), key),
        Value::Array(items) => {
            let mut items: Vec<Value> = items.into_iter().map(|item| plain(item, key)).collect();
            if UNORDERED.contains(&key) {
                items.sort_by_key(Value::to_string);
            }
            items.into()
        }
        other => other,
    }
}

/// Whether a run has all settings that apply to its experiment. If a setting is listed with several values, one of them
/// is enough.
pub fn has_settings(run: &RunRecord, wanted: &[Setting]) -> bool {
    wanted.is_empty() || meets(wanted, &run.experiment, &of(run))
}

/// Like [`has_settings`], for a run of this experiment with these settings.
pub(super) fn meets(wanted: &[Setting], experiment: &str, run: &Settings) -> bool {
    let about = || wanted.iter().filter(|setting| setting.is_about(experiment));
    about().all(|setting| about().any(|other| other.key == setting.key && other.admits(run)))
}
