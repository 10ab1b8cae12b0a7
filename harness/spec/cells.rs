//! The runs that an experiment expands to.

use super::origin::Origin;
use super::overrides;
use super::run::{Model, RunSpec, Trained};
use super::search::{Search, Trial};
use super::simulation::Simulation;
use super::types::{Experiment, Reading, Task, TestDataset, Training};
use super::vary::FOLD;
use super::world::{Known, World};
use crate::layout::{GivenScaling, Layout, Modality, Scaling, Scalings};
use crate::yaml::{Entry, Node, Place};
use serde_json::Value as Json;
use std::borrow::Cow;
use std::collections::HashMap;
use std::collections::hash_map;
use std::sync::Arc;

/// Key of the setting that distinguishes datasets of the same simulation.
pub(super) const DATASET_SEED: &str = "simulation.seed";
/// Key of the world of the test.
pub(super) const TEST_WORLD: &str = "test.world";

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

    /// Returns the world and the simulation settings of each dataset that the runs need, also of those for the test,
    /// except imported datasets.
    pub fn simulated(&self) -> Vec<(Arc<World>, Simulation)> {
        let mut found: Vec<(Arc<World>, Simulation)> = Vec::new();
        for run in self.runs() {
            let own = run.simulation.clone().map(|simulation| (&run.scenario, simulation));
            let test = run.test_simulation().map(|simulation| (run.tested_in(), simulation));
            for (origin, simulation) in own.into_iter().chain(test) {
                let Some(world) = self.world(origin) else { continue };
                let simulation = world.complete(&simulation);
                let is_it = |(other, own): &(Arc<World>, Simulation)| {
                    other.scenario() == world.scenario() && *own == simulation
                };
                if !found.iter().any(is_it) {
                    found.push((world, simulation));
                }
            }
        }
        found
    }

    /// Returns the value that a run has of each setting under `vary` with several values, without the dataset's seed.
    pub fn varied(&self, run: &RunSpec) -> Vec<(&str, &Json)> {
        let names: Vec<&str> = run.variant_parts().0.split(',').collect();
        let own =
            self.vary.iter().filter(|(key, _)| ![DATASET_SEED, FOLD].contains(&key.as_str())).filter_map(
                |(key, values)| {
                    let values = values.as_array().filter(|values| values.len() > 1)?;
                    let value = values.iter().find(|value| names.contains(&named(key, value).as_str()))?;
                    Some((key.as_str(), value))
                },
            );
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

    /// Returns the experiment with its own settings alone, without those of its axes.
    pub(super) fn alone(&self) -> Experiment {
        Self { readings: Vec::new(), vary: serde_json::Map::new(), search: None, ..self.clone() }
    }

    /// Returns the names of the readings, [`Reading::BASE`] first.
    pub fn names_of_readings(&self) -> Vec<&str> {
        std::iter::once(Reading::BASE)
            .chain(self.readings.iter().map(|reading| reading.name.as_str()))
            .collect()
    }

    /// Whether the experiment has axes, whose settings change its own.
    pub(super) fn has_variants(&self) -> bool {
        !(self.readings.is_empty() && self.vary.is_empty() && self.search.is_none())
    }

    /// Returns everything in which runs differ besides scenario, latent size and seed: the readings, the axes with
    /// labels and then the settings under `vary`, in the order of the spec, and the trials of the search.
    pub(super) fn axes(&self) -> Vec<Axis<'_>> {
        let mut axes = Vec::new();
        if !self.readings.is_empty() {
            let base = std::iter::once(Point::labeled(Kind::Reading, "reading", Reading::BASE, []));
            let others = self.readings.iter();
            let others = others.map(|one| Point::labeled(Kind::Reading, "reading", &one.name, &one.settings));
            axes.push(base.chain(others).collect());
        }
        axes.extend(self.vary.iter().filter_map(|(axis, labels)| -> Option<Axis<'_>> {
            let points = labels.as_object()?.iter().map(|(label, settings)| {
                let settings = settings.as_object().into_iter().flatten();
                Point::labeled(Kind::Labels, axis, label, settings)
            });
            Some(points.collect())
        }));
        axes.extend(self.vary.iter().filter_map(|(key, values)| -> Option<Axis<'_>> {
            Some(values.as_array()?.iter().map(|value| Point::value(key, value)).collect())
        }));
        if let Some(search) = &self.search {
            let trials = search.draw().into_iter().enumerate();
            axes.push(trials.map(|(number, trial)| Point::trial(search, number, trial)).collect());
        }
        axes
    }

    /// Returns every combination of a point of each axis; a single empty combination if there are no axes.
    pub(super) fn combinations(&self) -> Vec<Combination<'_>> {
        let start = vec![Combination { points: Vec::new() }];
        self.axes().into_iter().fold(start, |all, axis| {
            all.iter().flat_map(|one| axis.iter().map(|point| one.with(point))).collect()
        })
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
            test: self.test_of(scenario),
            inputs: self.inputs.clone(),
            given: self.tests(),
            probes: self.probes.clone(),
            scaling: self.scaling_of_used(scenario),
            model: Model::Trained(Box::new(Trained {
                latent,
                network: self.network.clone(),
                training: self.training.clone(),
            })),
        }
    }

    /// Returns the dataset for the test of the runs in a world. It names no world if this is the same.
    fn test_of(&self, origin: &Origin) -> Option<TestDataset> {
        let test = self.test.clone()?;
        let other = test.world.as_ref().and_then(Origin::scenario);
        let world = other.filter(|other| origin.scenario() != Some(*other)).map(Origin::Simulated);
        Some(TestDataset { world, ..test })
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
        let used: Vec<Modality> =
            self.input.iter().chain(&self.output).chain(&self.probes).copied().collect();
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

/// One way in which runs differ. Each run has one of its points.
type Axis<'a> = Vec<Point<'a>>;

/// What makes an axis, in the order in which settings are applied. If a setting occurs twice, the later value is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    Labels,
    Reading,
    Values,
    Trial,
}

/// A label or a value of an axis.
#[derive(Clone)]
pub(super) struct Point<'a> {
    kind: Kind,
    /// Name of the axis: that of its labels, or the dotted key of the setting.
    axis: &'a str,
    /// The part of the variant that names it: `senses=camera`, `kl_weight=0.001`. Runs on several datasets belong to
    /// the same variant, as do runs with several seeds, so the seed of the dataset, or its fold, has no name.
    name: Option<String>,
    /// Settings by dotted key.
    settings: Vec<(&'a str, Cow<'a, Json>)>,
}

impl<'a> Point<'a> {
    fn labeled(
        kind: Kind,
        axis: &'a str,
        label: &str,
        settings: impl IntoIterator<Item = (&'a String, &'a Json)>,
    ) -> Self {
        let settings = settings.into_iter().map(|(key, value)| (key.as_str(), Cow::Borrowed(value)));
        Self { kind, axis, name: Some(format!("{axis}={label}")), settings: settings.collect() }
    }

    fn value(key: &'a str, value: &'a Json) -> Self {
        let name = (![DATASET_SEED, FOLD].contains(&key)).then(|| named(key, value));
        Self { kind: Kind::Values, axis: key, name, settings: vec![(key, Cow::Borrowed(value))] }
    }

    /// The keys are those of the search's space, which are in the same order as those of the trial.
    fn trial(search: &'a Search, number: usize, trial: Trial) -> Self {
        // An experiment has at most 10,000 runs. All numbers have the same length, so that they are sorted as texts.
        let names = std::iter::once(format!("trial={number:04}"));
        let names: Vec<String> = names.chain(trial.iter().map(|(key, value)| named(key, value))).collect();
        let settings =
            search.space.keys().map(String::as_str).zip(trial.into_values().map(Cow::Owned)).collect();
        Self { kind: Kind::Trial, axis: "trial", name: Some(names.join(",")), settings }
    }
}

/// One combination of the points of an experiment's axes, in the order of the axes.
pub(super) struct Combination<'a> {
    points: Vec<Point<'a>>,
}

impl<'a> Combination<'a> {
    fn with(&self, point: &Point<'a>) -> Self {
        Self { points: [&*self.points, std::slice::from_ref(point)].concat() }
    }

    /// The points in the order in which their settings are applied.
    fn applied(&self) -> Vec<&Point<'a>> {
        let mut points: Vec<&Point> = self.points.iter().collect();
        points.sort_by_key(|point| point.kind);
        points
    }

    /// Returns the part of the name for the point whose value of a setting the combination uses, or the axis if it has
    /// none; `None` if no axis has the setting.
    pub fn origin(&self, key: &str) -> Option<&str> {
        let has = |point: &&Point| point.settings.iter().any(|(own, _)| *own == key);
        let point = self.applied().into_iter().rfind(has)?;
        // The names of trials also list their settings.
        point.name.as_deref().map_or(Some(point.axis), |name| name.split(',').next())
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
        let settings = self.applied().into_iter().flat_map(|point| &point.settings);
        overrides::apply(&mut combined, &settings.map(entry).collect::<Vec<_>>());
        combined
    }

    /// Whether the combination has this value of a varied setting. Values are told apart by their place in the spec.
    pub fn has(&self, key: &str, value: &Json) -> bool {
        let is = |given: &Cow<_>| matches!(given, Cow::Borrowed(given) if std::ptr::eq(*given, value));
        let settings = self.points.iter().filter(|point| point.axis == key).flat_map(|point| &point.settings);
        settings.into_iter().any(|(own, given)| *own == key && is(given))
    }

    /// Returns the name: `reading=base,senses=camera` or `hidden=64,kl_weight=0.001`. It is a valid folder name.
    ///
    /// Settings are in alphabetical order, so that the order of the axes does not change the names of runs.
    pub fn name(&self) -> String {
        let mut points: Vec<&Point> = self.points.iter().collect();
        points.sort_by_key(|point| {
            let key = if point.kind == Kind::Values { point.axis } else { "" };
            (point.kind != Kind::Reading, point.kind, key)
        });
        points.iter().filter_map(|point| point.name.as_deref()).collect::<Vec<_>>().join(",")
    }
}

/// Returns the name of a setting with a value: `kl_weight=0.001`.
pub(super) fn named(key: &str, value: &Json) -> String {
    // The name of a world file is short, and the folder in its path says nothing.
    let world = value.as_str().filter(|_| key == TEST_WORLD);
    let world = world.and_then(|path| Origin::try_from(path.to_owned()).ok());
    let value = &world.map_or_else(|| value.clone(), |origin| origin.name().into());
    let key = key.split_once('.').map_or(key, |(_section, key)| key);
    let value: String = value.to_string().chars().filter(|c| !"\"[]{} ".contains(*c)).collect();
    format!("{key}={}", value.replace([',', '/'], "+"))
}
