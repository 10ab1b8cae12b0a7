//! The runs that an experiment expands to. A [`RunSpec`] holds everything that a run's result depends on.

use super::error::Origin as Place;
use super::modality::{Layout, Modality, Scale};
use super::origin::Origin;
use super::overrides;
use super::parse::{Entry, Node};
use super::scaling::{GivenScaling, Scaling, Scalings};
use super::search::Trial;
use super::simulation::Simulation;
use super::types::{Action, Experiment, Loss, Network, Reading, Settings, Split, Task, Training, Window};
use super::validate::{Images, check_images};
use super::world::{Known, World};
use serde::{Deserialize, Serialize};
use serde_json::{Value as Json, json};
use sha2::{Digest, Sha256};
use std::borrow::Cow;
use std::collections::hash_map;
use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

/// Key of the setting that distinguishes datasets of the same simulation.
pub(super) const DATASET_SEED: &str = "simulation.seed";

/// The spec of one run: a cell (scenario, modalities, latent size, network) with one seed. It holds everything that the
/// result depends on, and nothing else. Runs of different experiments with equal specs are therefore equal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunSpec {
    /// The world that is simulated, or the imported dataset.
    pub scenario: Origin,
    /// Input modalities of the encoder, in the order of [`Modality`].
    pub input: Vec<Modality>,
    /// Output modalities of the decoder, in the order of [`Modality`].
    pub output: Vec<Modality>,
    /// Size of the latent state.
    pub latent: usize,
    /// The reading, the role, the varied settings and the trial with its settings: `reading=base,role=single_to_multi`,
    /// `kl_weight=0.001,hidden=64` or `trial=0017,learning_rate=0.00127`. It is empty if the experiment varies nothing.
    /// The seed of the dataset is left out.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub variant: String,
    /// Seed of the initial weights, the sampling and the order of batches.
    pub seed: u64,
    /// Trainings in the order in which they are done.
    pub tasks: Vec<Task>,
    /// Condition of the decoder.
    pub action: Action,
    /// How many samples the network sees and predicts.
    #[serde(default, skip_serializing_if = "Window::is_transition")]
    pub window: Window,
    /// Layers of the networks.
    pub network: Network,
    /// Settings of the simulation; `None` if the dataset is imported.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub simulation: Option<Simulation>,
    /// Division of the dataset into training, validation and test set.
    pub split: Split,
    /// Scaling of each modality that is used. It is empty if all scalings are those that were in use before scaling
    /// became a setting, so that old runs keep their names. [`RunSpec::scalings`] handles both cases.
    #[serde(default, skip_serializing_if = "Scalings::is_empty")]
    pub scaling: Scalings,
    /// Settings of the training.
    pub training: Training,
}

impl Experiment {
    /// Returns the runs, ordered by scenario, variant, latent size and seed, each in the spec's order. In a search with
    /// successive halving, only the best trials get as far as these runs; see [`Experiment::rungs`].
    pub fn runs(&self) -> Vec<RunSpec> {
        let variants = self.variants();
        let mut runs = Vec::new();
        for scenario in &self.scenarios {
            for (variant, experiment) in &variants {
                for &latent in &experiment.latent {
                    let of = |&seed| experiment.run(scenario, variant, latent, seed);
                    runs.extend(experiment.seeds.iter().map(of));
                }
            }
        }
        runs
    }

    /// Returns a sentence about the runs that only repeat another one of the experiment under another variant, such as
    /// those with several numbers of channels and without an image. `None` if there are none.
    pub fn repetitions(&self) -> Option<String> {
        let runs = if self.has_variants() { self.runs() } else { Vec::new() };
        let mut first: HashMap<String, &RunSpec> = HashMap::new();
        let mut repeated = Vec::new();
        for run in &runs {
            let unnamed = RunSpec { variant: String::new(), ..run.clone() };
            match first.entry(unnamed.hash()) {
                hash_map::Entry::Vacant(place) => drop(place.insert(run)),
                hash_map::Entry::Occupied(place) => repeated.push((run.label(), place.get().label())),
            }
        }
        let (run, other) = repeated.first()?;
        let (some, all) = (repeated.len(), runs.len());
        Some(format!(
            "{some} of {all} runs only repeat another one, because their settings have the same effect: {run} repeats \
             {other}"
        ))
    }

    /// Returns the runs of which successive halving makes one: its trainings up to each rung, and last the run itself.
    /// They only train the prediction, by which trials are compared. Without halving, there is only the run itself.
    pub fn rungs(&self, run: &RunSpec) -> Vec<RunSpec> {
        let Some(halving) = self.search.as_ref().and_then(|search| search.halving.as_ref()) else {
            return vec![run.clone()];
        };
        let epochs = halving.rungs(run.training.epochs);
        let until = |epoch: &usize| RunSpec {
            tasks: vec![Task::Prediction],
            training: Training { last_epoch: Some(*epoch), ..run.training.clone() },
            ..run.clone()
        };
        epochs[..epochs.len() - 1].iter().map(until).chain([run.clone()]).collect()
    }

    /// Returns the world and the simulation settings of each dataset that the runs need, except imported datasets.
    pub fn simulated(&self) -> Vec<(Arc<World>, Simulation)> {
        let mut found: Vec<(Origin, Simulation)> = Vec::new();
        for run in self.runs() {
            if let Some(simulation) = run.simulation
                && !found.contains(&(run.scenario.clone(), simulation.clone()))
            {
                found.push((run.scenario, simulation));
            }
        }
        let with_world =
            |(origin, simulation): (Origin, Simulation)| Some((self.world(&origin)?, simulation));
        found.into_iter().filter_map(with_world).collect()
    }

    /// Returns the value that a run has of each setting under `vary` with several values, without the dataset's seed.
    pub fn varied(&self, run: &RunSpec) -> Vec<(&str, &Json)> {
        let names: Vec<&str> = run.variant_parts().0.split(',').collect();
        let several = self.vary.iter().filter(|(key, values)| *key != DATASET_SEED && values.len() > 1);
        let own = several.filter_map(|(key, values)| {
            let value = values.iter().find(|value| names.contains(&named(key, value).as_str()))?;
            Some((key.as_str(), value))
        });
        own.collect()
    }

    /// Returns one experiment for each combination of the varied settings, with the name of the combination.
    fn variants(&self) -> Vec<(String, Experiment)> {
        let tree = serde_json::to_value(self.alone()).expect("an experiment is plain data");
        let tree = Node::of_json(&tree, &Place::START);
        let variants = self.combinations().into_iter().map(|combination| {
            let tree = combination.applied_to(&tree, &[]).to_json();
            let mut experiment: Experiment =
                serde_json::from_value(tree).expect("every combination is checked when the spec is read");
            experiment.worlds = self.worlds.clone();
            (combination.name(), experiment.canonical())
        });
        variants.collect()
    }

    /// Returns the experiment with its own settings alone: without readings, roles, varied settings and trials.
    pub(super) fn alone(&self) -> Experiment {
        let (readings, roles, vary) = (Vec::new(), BTreeMap::new(), BTreeMap::new());
        Self { readings, roles, vary, search: None, ..self.clone() }
    }

    /// Whether the experiment has readings, roles, varied settings or trials, which change its own settings.
    pub(super) fn has_variants(&self) -> bool {
        !(self.readings.is_empty() && self.roles.is_empty() && self.vary.is_empty() && self.search.is_none())
    }

    /// Returns every combination of a reading, a role, the settings under `vary` and a trial; a single empty
    /// combination if the experiment has none of them.
    pub(super) fn combinations(&self) -> Vec<Combination<'_>> {
        let mut combinations = vec![Combination::default()];
        if !self.readings.is_empty() {
            let mut readings = vec![(Reading::BASE, &NO_SETTINGS)];
            readings.extend(self.readings.iter().map(|one| (one.name.as_str(), &one.settings)));
            combinations = combinations.iter().flat_map(|one| one.each("reading", &readings)).collect();
        }
        if !self.roles.is_empty() {
            let roles: Vec<_> = self.roles.iter().map(|(role, settings)| (role.as_str(), settings)).collect();
            combinations = combinations.iter().flat_map(|one| one.each("role", &roles)).collect();
        }
        for (key, values) in &self.vary {
            combinations = combinations.iter().flat_map(|one| one.each_value(key, values)).collect();
        }
        if let Some(search) = &self.search {
            let trials = search.draw();
            let keys: Vec<&str> = search.space.keys().map(String::as_str).collect();
            combinations = combinations.iter().flat_map(|one| one.each_trial(&keys, &trials)).collect();
        }
        combinations
    }

    fn run(&self, scenario: &Origin, variant: &str, latent: usize, seed: u64) -> RunSpec {
        RunSpec {
            scenario: scenario.scenario().map_or_else(|| scenario.clone(), Origin::Simulated),
            variant: variant.to_owned(),
            input: self.input.clone(),
            output: self.output.clone(),
            latent,
            seed,
            tasks: self.tasks.clone(),
            action: self.action,
            window: self.window,
            network: self.network.clone(),
            simulation: self.world(scenario).map(|world| world.complete(&self.simulation)),
            split: self.split.clone(),
            scaling: self.scaling_of_used(scenario),
            training: self.training.clone(),
        }
    }

    /// Returns the world of a scenario; `None` for an imported dataset.
    pub fn world(&self, origin: &Origin) -> Option<Arc<World>> {
        let scenario = origin.scenario()?;
        let own = self.worlds.iter().find(|world| world.scenario() == scenario).cloned();
        own.or_else(|| World::named(scenario.name()))
    }

    /// Returns what is known about a modality before a model is compiled or a dataset opened; `None` if nothing is.
    pub(super) fn known(&self, origin: &Origin, modality: Modality) -> Option<Known> {
        match self.world(origin) {
            Some(world) => world.known(modality),
            // A modality of an imported dataset is assumed to be like the finger's modality of that name.
            None => {
                let layout = Layout::finger();
                let like = layout.get(modality)?;
                let scaling = Scaling { scale: like.scale, minimum: like.minimum };
                Some(Known { size: like.size(), scaling })
            }
        }
    }

    /// Returns the scaling of the modalities that are used, as stored in a run's spec.
    fn scaling_of_used(&self, origin: &Origin) -> Scalings {
        let used: Vec<Modality> = self.input.iter().chain(&self.output).copied().collect();
        let scaling = |modality: &Modality| {
            let given = self.scaling.get(modality).copied().unwrap_or_default();
            let known = self.known(origin, *modality).map(|known| known.scaling);
            if known.is_none() && given == GivenScaling::default() {
                // The dataset defines the scaling.
                return None;
            }
            Some((*modality, given.or(known.unwrap_or(Scaling::plain(false)))))
        };
        let scaling: Scalings = used.iter().filter_map(scaling).collect();
        let is_plain = |modality: &Modality| {
            let is_image = self.known(origin, *modality).is_some_and(|known| known.size.is_some());
            Modality::BUILT_IN.contains(modality) && scaling.get(modality) == Some(&Scaling::plain(is_image))
        };
        if used.iter().all(is_plain) { Scalings::new() } else { scaling }
    }
}

/// One combination of the readings, roles and varied settings of an experiment.
#[derive(Clone, Default)]
pub(super) struct Combination<'a> {
    /// Parts of the name: `reading=base`, `kl_weight=0.001`.
    names: Vec<String>,
    /// Settings by dotted key. If a key occurs twice, the later value is used.
    settings: Vec<(&'a str, Cow<'a, Json>)>,
}

static NO_SETTINGS: Settings = Settings::new();

impl<'a> Combination<'a> {
    /// Returns this combination extended by each of several named groups of settings.
    fn each(&self, kind: &str, groups: &[(&str, &'a Settings)]) -> Vec<Self> {
        let with = |(name, settings): &(&str, &'a Settings)| {
            let mut combination = self.clone();
            combination.names.push(format!("{kind}={name}"));
            combination
                .settings
                .extend(settings.iter().map(|(key, value)| (key.as_str(), Cow::Borrowed(value))));
            combination
        };
        groups.iter().map(with).collect()
    }

    /// Returns this combination extended by each value of a setting.
    fn each_value(&self, key: &'a str, values: &'a [Json]) -> Vec<Self> {
        let with = |value: &'a Json| {
            let mut combination = self.clone();
            // Runs on several datasets belong to the same variant, as do runs with several seeds.
            if key != DATASET_SEED {
                combination.names.push(named(key, value));
            }
            combination.settings.push((key, Cow::Borrowed(value)));
            combination
        };
        values.iter().map(with).collect()
    }

    /// Returns this combination extended by each trial's settings, which have these keys.
    fn each_trial(&self, keys: &[&'a str], trials: &[Trial]) -> Vec<Self> {
        let with = |(number, trial): (usize, &Trial)| {
            let mut combination = self.clone();
            // An experiment has at most 10,000 runs. All numbers have the same length, so that they are sorted as
            // texts.
            combination.names.push(format!("trial={number:04}"));
            combination.names.extend(trial.iter().map(|(key, value)| named(key, value)));
            let settings = keys.iter().zip(trial.values());
            combination.settings.extend(settings.map(|(key, value)| (*key, Cow::Owned(value.clone()))));
            combination
        };
        trials.iter().enumerate().map(with).collect()
    }

    /// Returns the tree of a spec with these settings. Each is `written` in the spec, or else drawn by its search.
    pub fn applied_to(&self, tree: &Node, written: &[Entry]) -> Node {
        let entry = |(key, value): &(&str, Cow<Json>)| {
            let written = written.iter().find(|entry| entry.key == *key && entry.node.to_json() == **value);
            written.cloned().unwrap_or_else(|| {
                let origin = tree.origin_of(&format!("search.space.{key}"));
                Entry {
                    key: (*key).to_owned(),
                    key_origin: origin.clone(),
                    node: Node::of_json(value, origin),
                }
            })
        };
        let mut combined = tree.clone();
        overrides::apply(&mut combined, &self.settings.iter().map(entry).collect::<Vec<_>>());
        combined
    }

    /// Whether the combination has this value of a varied setting. Values are told apart by their place in the spec.
    pub fn has(&self, key: &str, value: &Json) -> bool {
        let is = |given: &Cow<_>| matches!(given, Cow::Borrowed(given) if std::ptr::eq(*given, value));
        self.settings.iter().any(|(own, given)| *own == key && is(given))
    }

    /// Returns the name: `reading=base,role=multi_to_multi` or `kl_weight=0.001,hidden=64`. It is a valid folder name.
    pub fn name(&self) -> String {
        self.names.join(",")
    }
}

/// Returns the name of a setting with a value: `kl_weight=0.001`.
pub(super) fn named(key: &str, value: &Json) -> String {
    let key = key.split_once('.').map_or(key, |(_section, key)| key);
    let value: String = value.to_string().chars().filter(|c| !"\"[]{} ".contains(*c)).collect();
    format!("{key}={}", value.replace([',', '/'], "+"))
}

impl RunSpec {
    /// Returns the input and output modalities, without duplicates, in the order of [`Modality`].
    pub fn modalities(&self) -> Vec<Modality> {
        let mut used: Vec<Modality> = self.input.iter().chain(&self.output).copied().collect();
        used.sort();
        used.dedup();
        used
    }

    /// Returns the scaling of each modality that is used, given the dataset's layout. A modality that the layout lacks
    /// is left out.
    pub fn scalings(&self, layout: &Layout) -> Scalings {
        let of = |modality: Modality| {
            let definition = layout.get(modality)?;
            let unsaid = if Modality::BUILT_IN.contains(&modality) {
                Scaling::plain(definition.is_image())
            } else {
                Scaling { scale: definition.scale, minimum: definition.minimum }
            };
            Some((modality, self.scaling.get(&modality).copied().unwrap_or(unsaid)))
        };
        self.modalities().into_iter().filter_map(of).collect()
    }

    /// Checks that the run can use a dataset with this layout.
    ///
    /// # Errors
    /// When the network can't take the images, or a scaling does not suit a modality. Returns the message.
    pub fn check(&self, layout: &Layout) -> Result<(), String> {
        let images = |modalities: &[Modality]| -> Vec<(Modality, [usize; 2])> {
            let size = |modality: &Modality| Some((*modality, layout.get(*modality)?.size()?));
            modalities.iter().filter_map(size).collect()
        };
        let (input, output) = (images(&self.input), images(&self.output));
        let images = Images { input: &input, output: &output };
        check_images(&images, &self.network, &self.training).map_err(|fault| fault.message)?;
        let by_element = self.scaling.iter().find(|(modality, scaling)| {
            layout.get(**modality).is_some_and(|definition| definition.is_image())
                && scaling.scale == Scale::PerElement
        });
        match by_element {
            Some((modality, _)) => Err(format!(
                "'{modality}' is an image, whose values share one standard deviation; use shared"
            )),
            None => Ok(()),
        }
    }

    /// Returns the hash that identifies the run: the first 16 hexadecimal digits of the SHA-256 of its JSON with sorted
    /// keys. It does not depend on the layout of the YAML, nor on whether defaults are written out.
    pub fn hash(&self) -> String {
        let mut json = serde_json::to_value(self).expect("a run's spec is plain data");
        json.sort_all_objects();
        let digest = Sha256::digest(json.to_string());
        digest.iter().take(8).map(|byte| format!("{byte:02x}")).collect()
    }

    /// Returns the run's spec with the defaults that are not stored, so that older runs keep their names. `layout` is
    /// that of the dataset.
    pub fn complete(&self, layout: &Layout) -> Json {
        let Self { split, network, training, simulation, .. } = self;
        let losses: BTreeMap<Modality, Loss> = self
            .output
            .iter()
            .filter(|modality| layout.get(**modality).is_some_and(|definition| !definition.is_image()))
            .map(|modality| (*modality, training.losses.get(modality).copied().unwrap_or_default()))
            .collect();
        let unsaid = json!({
            "variant": self.variant,
            "window": { "context": self.window.context, "horizon": self.window.horizon },
            "network": { "average": network.average, "fusion": network.fusion },
            "split": { "by": split.by, "gap_seconds": split.gap_seconds },
            "scaling": self.scalings(layout),
            "training": {
                "schedule": training.schedule,
                "warmup_epochs": training.warmup_epochs,
                "weight_decay": training.weight_decay,
                "clip_norm": training.clip_norm,
                "last_epoch": training.last_epoch,
                "stop": training.stop,
                "losses": losses,
                "dropout": training.dropout,
                "tiles": training.tiles,
            },
        });
        let mut all = serde_json::to_value(self).expect("a run's spec is plain data");
        add(&mut all, unsaid);
        if let Some(simulation) = simulation {
            all["simulation"]["factors"] = json!(simulation.factors);
        }
        all
    }

    /// Returns the run's spec as YAML with every value explicit.
    pub fn to_yaml(&self) -> String {
        serde_yaml::to_string(self).expect("a run's spec is plain data, which YAML can hold")
    }

    /// Returns the YAML of an experiment `name` whose only run is this one. Its variant, which names settings that the
    /// run's own experiment varies, is left out.
    pub fn to_experiment_yaml(&self, name: &str) -> String {
        let mut json = serde_json::to_value(self).expect("a run's spec is plain data");
        let fields = json.as_object_mut().expect("a run's spec is an object");
        fields.remove("variant");
        for (of_run, of_experiment) in [("scenario", "scenarios"), ("latent", "latent"), ("seed", "seeds")] {
            let value = fields.remove(of_run).expect("every run's spec has it");
            fields.insert(of_experiment.to_owned(), vec![value].into());
        }
        fields.insert("name".to_owned(), name.into());
        // An experiment without scaling has the defaults, which are not those of a run without scaling.
        if self.scaling.is_empty() && self.simulation.is_some() {
            let scaling = serde_json::to_value(self.scalings(&Layout::finger()));
            fields.insert("scaling".to_owned(), scaling.expect("scalings are plain data"));
        }
        serde_yaml::to_string(&json).expect("a run's spec is plain data, which YAML can hold")
    }

    /// Returns the seed of the dataset; 0 for an imported dataset.
    pub fn dataset_seed(&self) -> u64 {
        self.simulation.as_ref().map_or(0, |simulation| simulation.seed)
    }

    /// Returns the name of the run's reading; `None` if its experiment has no readings.
    pub fn reading(&self) -> Option<&str> {
        self.named("reading")
    }

    /// Returns the name of the run's role; `None` if its experiment has no roles.
    pub fn role(&self) -> Option<&str> {
        self.named("role")
    }

    /// Returns the number of the run's trial; `None` if its experiment is no search.
    pub fn trial(&self) -> Option<usize> {
        self.variant_parts().1?.parse().ok()
    }

    /// Whether successive halving may train the run on after its last epoch. Its state is kept until then.
    pub fn may_continue(&self) -> bool {
        self.trial().is_some() && self.training.last_epoch.is_some()
    }

    /// Divides the variant; see [`variant_parts`].
    pub fn variant_parts(&self) -> (&str, Option<&str>, &str) {
        variant_parts(&self.variant)
    }

    /// Returns the value of a key in the variant.
    fn named(&self, key: &str) -> Option<&str> {
        let parts = self.variant.split(',').filter_map(|part| part.split_once('='));
        parts.filter(|(own, _)| *own == key).map(|(_, value)| value).next()
    }

    /// Returns the name of the cell, which is unique within an experiment: `cluttered-z64`,
    /// `cluttered-z64-kl_weight=0.001` or `cluttered-z64-trial=0017`. A trial's settings are left out, because a
    /// folder's name must be short.
    pub fn cell(&self) -> String {
        let (varied, trial, _) = self.variant_parts();
        let trial = trial.map(|number| format!("trial={number}")).unwrap_or_default();
        let names: Vec<&str> = [varied, &trial].into_iter().filter(|name| !name.is_empty()).collect();
        let separator = if names.is_empty() { "" } else { "-" };
        format!("{}-z{}{separator}{}", self.scenario, self.latent, names.join(","))
    }

    /// Returns the name of the run, which is unique within an experiment: `cluttered-z64-seed0`, or
    /// `cluttered-z64-data1-seed0` if the seed of the dataset is not 0.
    pub fn label(&self) -> String {
        let data = match self.dataset_seed() {
            0 => String::new(),
            seed => format!("-data{seed}"),
        };
        format!("{}{data}-seed{}", self.cell(), self.seed)
    }
}

/// Adds the values of `more` to a tree, section by section.
fn add(tree: &mut Json, more: Json) {
    match more {
        Json::Object(entries) => {
            entries.into_iter().for_each(|(key, value)| add(&mut tree[key], value));
        }
        value => *tree = value,
    }
}

/// Divides a variant into the part before the trial, the trial's number, and the trial's settings. Without a trial, all
/// of it is the first part.
pub fn variant_parts(variant: &str) -> (&str, Option<&str>, &str) {
    let varied = variant.strip_prefix("trial=").map(|trial| ("", trial));
    let Some((varied, trial)) = varied.or_else(|| variant.split_once(",trial=")) else {
        return (variant, None, "");
    };
    let (number, settings) = trial.split_once(',').unwrap_or((trial, ""));
    (varied, Some(number), settings)
}
