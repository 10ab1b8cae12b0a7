//! The runs that an experiment expands to.

use super::origin::Origin;
use super::overrides;
use super::run::{Model, RunSpec, Trained};
use super::search::Trial;
use super::simulation::Simulation;
use super::types::{Experiment, Reading, Task, Training};
use super::world::{Known, World};
use harness_layout::{GivenScaling, Layout, Modality, Scaling, Scalings};
use harness_yaml::{Entry, Node, Place};
use serde_json::Value as Json;
use std::borrow::Cow;
use std::collections::hash_map;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

/// Key of the setting that distinguishes datasets of the same simulation.
pub(super) const DATASET_SEED: &str = "simulation.seed";

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
        let Some(trained) = run.trained() else { return vec![run.clone()] };
        let epochs = halving.rungs(trained.training.epochs);
        let until = |epoch: &usize| {
            let training = Training { last_epoch: Some(*epoch), ..trained.training.clone() };
            let model = Model::Trained(Box::new(Trained { training, ..trained.clone() }));
            RunSpec { tasks: vec![Task::Prediction], model, ..run.clone() }
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
        let (readings, roles, vary) = (Vec::new(), serde_json::Map::new(), BTreeMap::new());
        Self { readings, roles, vary, search: None, ..self.clone() }
    }

    /// Returns the names of the readings, [`Reading::BASE`] first.
    pub fn names_of_readings(&self) -> Vec<&str> {
        std::iter::once(Reading::BASE)
            .chain(self.readings.iter().map(|reading| reading.name.as_str()))
            .collect()
    }

    /// Returns the names of the experiments whose runs stand for the readings: its own name, then those that the
    /// readings name.
    pub fn experiments_of_readings(&self) -> Vec<String> {
        let others = self.readings.iter().flat_map(|reading| reading.runs.values());
        let others: BTreeSet<&String> = others.map(|runs| &runs.experiment).collect();
        std::iter::once(&self.name).chain(others).cloned().collect()
    }

    /// Whether the experiment has readings, roles, varied settings or trials, which change its own settings.
    pub(super) fn has_variants(&self) -> bool {
        !(self.readings.is_empty() && self.roles.is_empty() && self.vary.is_empty() && self.search.is_none())
    }

    /// Returns every combination of a reading, a role, the settings under `vary` and a trial; a single empty
    /// combination if the experiment has none of them.
    pub(super) fn combinations<'a>(&'a self) -> Vec<Combination<'a>> {
        let mut combinations = vec![Combination::default()];
        if !self.roles.is_empty() {
            let role = |(name, role): (&'a String, &'a Json)| {
                let settings = role.as_object().into_iter().flatten();
                Combination::of("role", name, settings.map(|(key, value)| (key.as_str(), value)))
            };
            combinations = self.roles.iter().map(role).collect();
        }
        if !self.readings.is_empty() {
            let reading = |one: &'a Reading| {
                let settings = one.settings.iter().map(|(key, value)| (key.as_str(), value));
                Combination::of("reading", &one.name, settings)
            };
            let base = Combination::of("reading", Reading::BASE, std::iter::empty());
            let readings = std::iter::once(base).chain(self.readings.iter().map(reading));
            combinations = readings
                .flat_map(|reading| combinations.iter().map(move |role| role.under(&reading)))
                .collect();
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
            seed,
            tasks: self.tasks.clone(),
            action: self.action,
            window: self.window.clone(),
            simulation: self.world(scenario).map(|world| world.complete(&self.simulation)),
            split: self.split.clone(),
            scaling: self.scaling_of_used(scenario),
            model: Model::Trained(Box::new(Trained {
                latent,
                network: self.network.clone(),
                training: self.training.clone(),
            })),
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
            Some(world) => world.known(modality, &self.simulation.factors),
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

impl<'a> Combination<'a> {
    /// Returns the combination of one named group of settings.
    fn of(kind: &str, name: &str, settings: impl Iterator<Item = (&'a str, &'a Json)>) -> Self {
        let settings = settings.map(|(key, value)| (key, Cow::Borrowed(value))).collect();
        Self { names: vec![format!("{kind}={name}")], settings }
    }

    /// Returns this combination with the settings of a reading, which replace its own. The reading is named first.
    fn under(&self, reading: &Self) -> Self {
        Self {
            names: [&*reading.names, &*self.names].concat(),
            settings: [&*self.settings, &*reading.settings].concat(),
        }
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
                let place = tree.place_of(&format!("search.space.{key}"));
                Entry { key: (*key).to_owned(), key_place: place.clone(), node: Node::of_json(value, place) }
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
