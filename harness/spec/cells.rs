//! The runs that an experiment expands to. All that decides one run's result is in its [`RunSpec`].

use super::modality::{Layout, Modality};
use super::scaling::{GivenScaling, Scaling, Scalings};
use super::types::{
    Action, Experiment, Network, Origin, Reading, Settings, Simulation, Split, Task, Training,
};
use super::validate::{Images, check_images};
use super::world::{Known, World};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::sync::Arc;

/// Key of the setting that tells several datasets of one simulation apart.
pub(super) const DATASET_SEED: &str = "simulation.seed";

/// One run: a cell (scenario, modalities, latent size, network) with one seed. It holds everything that
/// decides the result and nothing that does not, so runs of different experiments with equal specs are equal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunSpec {
    pub scenario: Origin,
    /// What the encoder is given, in the order of [`Modality`].
    pub input: Vec<Modality>,
    /// What the decoder predicts, in the order of [`Modality`].
    pub output: Vec<Modality>,
    /// Size of the latent state.
    pub latent: usize,
    /// The reading, the role and the settings that the experiment varies, as `reading=base,role=single_to_multi` or
    /// `kl_weight=0.001,hidden=64`; empty where it varies none. A dataset's seed is not named.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub variant: String,
    /// Seed of the initial weights, the sampling and the order of batches.
    pub seed: u64,
    /// What is trained, in this order.
    pub tasks: Vec<Task>,
    pub action: Action,
    pub network: Network,
    /// How the episodes are simulated; `None` where they are imported.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub simulation: Option<Simulation>,
    pub split: Split,
    /// Of each modality that is used; empty where all are scaled as they were before it was a setting, so that runs
    /// keep the names they had then. [`RunSpec::scalings`] knows both.
    #[serde(default, skip_serializing_if = "Scalings::is_empty")]
    pub scaling: Scalings,
    pub training: Training,
}

impl Experiment {
    /// The runs by scenario, then variant, latent size and seed, each in the spec's order.
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

    /// The world and the simulation of each dataset that the runs need, without those that are imported.
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

    /// The experiment with each combination of what it varies, and what the combination is called.
    fn variants(&self) -> Vec<(String, Experiment)> {
        let tree = serde_json::to_value(self).expect("an experiment is plain data");
        let variants = self.combinations().into_iter().map(|combination| {
            let mut tree = tree.clone();
            for (key, value) in &combination.settings {
                *key.split('.').fold(&mut tree, |section, key| &mut section[key]) = (*value).clone();
            }
            let mut experiment: Experiment =
                serde_json::from_value(tree).expect("every combination is checked when the spec is read");
            experiment.worlds = self.worlds.clone();
            experiment.make_canonical();
            (combination.name(), experiment)
        });
        variants.collect()
    }

    /// Every combination of a reading, a role and the settings under `vary`: one without any where there are none.
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
            network: self.network.clone(),
            simulation: self.world(scenario).map(|world| world.complete(&self.simulation)),
            split: self.split.clone(),
            scaling: self.scaling_of_used(scenario),
            training: self.training.clone(),
        }
    }

    /// The world that a scenario is; `None` of an imported dataset.
    pub fn world(&self, origin: &Origin) -> Option<Arc<World>> {
        let scenario = origin.scenario()?;
        let own = self.worlds.iter().find(|world| world.scenario() == scenario).cloned();
        own.or_else(|| World::named(scenario.name()))
    }

    /// What is known of a modality before a model is compiled or a dataset opened; `None` where nothing is.
    pub(super) fn known(&self, origin: &Origin, modality: Modality) -> Option<Known> {
        match self.world(origin) {
            Some(world) => world.known(modality),
            // Of an imported dataset, what its modality would be if it were the finger's. Sizes are its own.
            None => {
                let layout = Layout::finger();
                let like = layout.get(modality)?;
                let scaling = Scaling { scale: like.scale, minimum: like.minimum };
                Some(Known { size: like.size(), scaling })
            }
        }
    }

    /// The scaling of what is used, as a run's spec states it.
    fn scaling_of_used(&self, origin: &Origin) -> Scalings {
        let used: Vec<Modality> = self.input.iter().chain(&self.output).copied().collect();
        let scaling = |modality: &Modality| {
            let given = self.scaling.get(modality).copied().unwrap_or_default();
            let known = self.known(origin, *modality).map(|known| known.scaling);
            if known.is_none() && given == GivenScaling::default() {
                // Its dataset says how it is scaled.
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

/// One of the combinations of what an experiment varies.
#[derive(Clone, Default)]
pub(super) struct Combination<'a> {
    /// What it is called, in parts: `reading=base`, `kl_weight=0.001`.
    names: Vec<String>,
    /// By dotted key; of two for the same key, the later one stands.
    pub settings: Vec<(&'a str, &'a serde_json::Value)>,
}

static NO_SETTINGS: Settings = Settings::new();

impl<'a> Combination<'a> {
    /// This combination with each of several named groups of settings.
    fn each(&self, kind: &str, groups: &[(&str, &'a Settings)]) -> Vec<Self> {
        let with = |(name, settings): &(&str, &'a Settings)| {
            let mut combination = self.clone();
            combination.names.push(format!("{kind}={name}"));
            combination.settings.extend(settings.iter().map(|(key, value)| (key.as_str(), value)));
            combination
        };
        groups.iter().map(with).collect()
    }

    /// This combination with each value of a setting.
    fn each_value(&self, key: &'a str, values: &'a [serde_json::Value]) -> Vec<Self> {
        let with = |value: &'a serde_json::Value| {
            let mut combination = self.clone();
            // Several datasets are no variants, as several seeds are none.
            if key != DATASET_SEED {
                combination.names.push(named(key, value));
            }
            combination.settings.push((key, value));
            combination
        };
        values.iter().map(with).collect()
    }

    /// `reading=base,role=multi_to_multi` or `kl_weight=0.001,hidden=64`; fit for a folder's name.
    pub fn name(&self) -> String {
        self.names.join(",")
    }
}

/// Names the value of a setting: `kl_weight=0.001`.
pub(super) fn named(key: &str, value: &serde_json::Value) -> String {
    let key = key.split_once('.').map_or(key, |(_section, key)| key);
    let value: String = value.to_string().chars().filter(|c| !"\"[]{} ".contains(*c)).collect();
    format!("{key}={}", value.replace([',', '/'], "+"))
}

impl RunSpec {
    /// What the networks are given or predict, in the order of [`Modality`].
    pub fn modalities(&self) -> Vec<Modality> {
        let mut used: Vec<Modality> = self.input.iter().chain(&self.output).copied().collect();
        used.sort();
        used.dedup();
        used
    }

    /// How each modality that is used is scaled.
    pub fn scalings(&self, layout: &Layout) -> Scalings {
        let of = |modality: Modality| {
            let definition = &layout[modality];
            let unsaid = if Modality::BUILT_IN.contains(&modality) {
                Scaling::plain(definition.is_image())
            } else {
                Scaling { scale: definition.scale, minimum: definition.minimum }
            };
            self.scaling.get(&modality).copied().unwrap_or(unsaid)
        };
        self.modalities().into_iter().map(|modality| (modality, of(modality))).collect()
    }

    /// Refuses what a dataset of this layout can't be used for, in words.
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
                && scaling.scale == super::Scale::PerElement
        });
        match by_element {
            Some((modality, _)) => {
                Err(format!("'{modality}' is an image, whose values have one deviation for all; use shared"))
            }
            None => Ok(()),
        }
    }

    /// Identifies the run: 16 hexadecimal digits of the SHA-256 of its JSON with keys sorted. It does not
    /// depend on how the YAML was laid out, nor on which values were left to their defaults.
    pub fn hash(&self) -> String {
        let mut json = serde_json::to_value(self).expect("a run's spec is plain data");
        json.sort_all_objects();
        let digest = Sha256::digest(json.to_string());
        digest.iter().take(8).map(|byte| format!("{byte:02x}")).collect()
    }

    /// The run's spec as YAML with every value explicit.
    pub fn to_yaml(&self) -> String {
        serde_yaml::to_string(self).expect("a run's spec is plain data, which YAML can hold")
    }

    /// The seed of the dataset; 0 of one that was imported.
    pub fn dataset_seed(&self) -> u64 {
        self.simulation.as_ref().map_or(0, |simulation| simulation.seed)
    }

    /// The reading that the run takes; `None` where its experiment has no readings.
    pub fn reading(&self) -> Option<&str> {
        self.named("reading")
    }

    /// The experiment that the run stands for; `None` where it stands for its own.
    pub fn role(&self) -> Option<&str> {
        self.named("role")
    }

    /// What the variant says of a key.
    fn named(&self, key: &str) -> Option<&str> {
        let parts = self.variant.split(',').filter_map(|part| part.split_once('='));
        parts.filter(|(own, _)| *own == key).map(|(_, value)| value).next()
    }

    /// The cell in short, `cluttered-z64` or `cluttered-z64-kl_weight=0.001`; unique within an experiment.
    pub fn cell(&self) -> String {
        let Self { scenario, latent, variant, .. } = self;
        let separator = if variant.is_empty() { "" } else { "-" };
        format!("{scenario}-z{latent}{separator}{variant}")
    }

    /// The run in short, `cluttered-z64-seed0` or, on another dataset than the first, `cluttered-z64-data1-seed0`;
    /// unique within an experiment.
    pub fn label(&self) -> String {
        let data = match self.dataset_seed() {
            0 => String::new(),
            seed => format!("-data{seed}"),
        };
        format!("{}{data}-seed{}", self.cell(), self.seed)
    }
}
