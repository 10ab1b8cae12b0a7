//! The spec of one run: everything that its result depends on, and nothing else.

use super::disturbance::Disturbances;
use super::origin::Origin;
use super::simulation::Simulation;
use super::split::Split;
use super::stored::stored;
use super::types::{Action, Family, Given, Memory, Network, Task, TestDataset, Training, Window};
use super::validate::{Images, check_images};
use crate::layout::{Layout, Modality, Scale, Scaling, Scalings};
use harness_shared::seal::hex;
use serde::{Deserialize, Serialize, Serializer};
use serde_json::{Value as Json, json};
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};

/// The spec of one run: data, what is given and predicted, and what predicts, with one seed. It holds everything that
/// the result depends on, and nothing else. Runs of different experiments with equal specs are therefore equal.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(try_from = "Fields")]
pub struct RunSpec {
    /// The world that is simulated, or the imported dataset.
    pub scenario: Origin,
    /// Input modalities of the model, in the order of [`Modality`].
    pub input: Vec<Modality>,
    /// Output modalities of the model, in the order of [`Modality`].
    pub output: Vec<Modality>,
    /// The reading, the labels, the varied settings and the trial with its settings: `reading=base,senses=camera`,
    /// `hidden=64,kl_weight=0.001` or `trial=0017,learning_rate=0.00127`. It is empty if the experiment varies nothing.
    /// The seed of the dataset is left out.
    pub variant: String,
    /// Seed of the initial weights, the sampling and the order of batches.
    pub seed: u64,
    /// What is judged, in the order in which it is trained.
    pub tasks: Vec<Task>,
    /// Which quantity the model gets as the action.
    pub action: Action,
    /// How many samples the model sees and predicts.
    pub window: Window,
    /// Settings of the simulation; `None` if the dataset is imported.
    pub simulation: Option<Simulation>,
    /// Division of the dataset into training, validation and test set.
    pub split: Split,
    /// The dataset on which the run is tested; `None` if it is a part of the run's own one.
    pub test: Option<TestDataset>,
    /// What is wrong with the sensors of some inputs, in training and in the test.
    pub inputs: Disturbances,
    /// The tests of a trained network besides that with all inputs. Each has its inputs.
    pub given: Vec<Given>,
    /// What the reconstruction estimates besides the input.
    pub probes: Vec<Modality>,
    /// Scaling of each modality that is used. It is empty if all scalings are those that were in use before scaling
    /// became a setting, so that old runs keep their names. [`RunSpec::scalings`] handles both cases.
    pub scaling: Scalings,
    /// What predicts.
    pub model: Model,
}

/// What predicts in a run.
#[derive(Debug, Clone, PartialEq)]
pub enum Model {
    /// A network that the run trains.
    Trained(Box<Trained>),
    /// A model of another program with this name, whose predictions were recorded.
    External(String),
}

impl Model {
    /// Returns the name in the column `architecture`: the preset of a network, or the name of an external model.
    pub fn name(&self) -> &str {
        match self {
            Self::Trained(trained) => trained.network.preset.name(),
            Self::External(name) => name,
        }
    }
}

/// A network that a run trains.
#[derive(Debug, Clone, PartialEq)]
pub struct Trained {
    /// Size of the latent state.
    pub latent: usize,
    /// Layers of the network.
    pub network: Network,
    /// Settings of the training.
    pub training: Training,
}

/// The spec with all settings. A stored spec lacks most of those that have their default ([`stored`]).
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Fields {
    scenario: Origin,
    input: Vec<Modality>,
    output: Vec<Modality>,
    #[serde(skip_serializing_if = "Option::is_none")]
    latent: Option<usize>,
    #[serde(default)]
    variant: String,
    seed: u64,
    tasks: Vec<Task>,
    action: Action,
    #[serde(default)]
    window: Window,
    #[serde(skip_serializing_if = "Option::is_none")]
    network: Option<Network>,
    #[serde(skip_serializing_if = "Option::is_none")]
    model: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    simulation: Option<Simulation>,
    split: Split,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    test: Option<TestDataset>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    inputs: Disturbances,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    given: Vec<Given>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    probes: Vec<Modality>,
    #[serde(default)]
    scaling: Scalings,
    #[serde(skip_serializing_if = "Option::is_none")]
    training: Option<Training>,
}

/// Writes the spec as it is stored.
impl Serialize for RunSpec {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let defaults = json!({
            "variant": "",
            "window": Window::default(),
            "network": Network::default(),
            "simulation": Simulation::default(),
            "split": Split::default(),
            "scaling": {},
            "training": Training::default(),
        });
        stored("", self.all(), &defaults).serialize(serializer)
    }
}

impl From<RunSpec> for Fields {
    fn from(spec: RunSpec) -> Self {
        let (trained, model) = match spec.model {
            Model::Trained(trained) => (Some(*trained), None),
            Model::External(name) => (None, Some(name)),
        };
        let (latent, network, training) = match trained {
            Some(Trained { latent, network, training }) => (Some(latent), Some(network), Some(training)),
            None => (None, None, None),
        };
        Self {
            scenario: spec.scenario,
            input: spec.input,
            output: spec.output,
            latent,
            variant: spec.variant,
            seed: spec.seed,
            tasks: spec.tasks,
            action: spec.action,
            window: spec.window,
            network,
            model,
            simulation: spec.simulation,
            split: spec.split,
            test: spec.test,
            inputs: spec.inputs,
            given: spec.given,
            probes: spec.probes,
            scaling: spec.scaling,
            training,
        }
    }
}

impl TryFrom<Fields> for RunSpec {
    type Error = &'static str;

    fn try_from(fields: Fields) -> Result<Self, Self::Error> {
        let model = match (fields.latent, fields.network, fields.training, fields.model) {
            (Some(latent), Some(network), Some(training), None) => {
                Model::Trained(Box::new(Trained { latent, network, training }))
            }
            (None, None, None, Some(name)) => Model::External(name),
            _ => return Err("a run has 'latent', 'network' and 'training', or it has 'model'"),
        };
        Ok(Self {
            scenario: fields.scenario,
            input: fields.input,
            output: fields.output,
            variant: fields.variant,
            seed: fields.seed,
            tasks: fields.tasks,
            action: fields.action,
            window: fields.window,
            simulation: fields.simulation,
            split: fields.split,
            test: fields.test,
            inputs: fields.inputs,
            given: fields.given,
            probes: fields.probes,
            scaling: fields.scaling,
            model,
        })
    }
}

/// Returns modalities without duplicates, in the order of [`Modality`].
fn distinct<'a>(modalities: impl Iterator<Item = &'a Modality>) -> Vec<Modality> {
    modalities.copied().collect::<BTreeSet<_>>().into_iter().collect()
}

impl RunSpec {
    /// Returns the network that the run trains; `None` for an external model.
    pub fn trained(&self) -> Option<&Trained> {
        match &self.model {
            Model::Trained(trained) => Some(trained),
            Model::External(_) => None,
        }
    }

    /// Returns the settings of the simulation of the run's own test dataset; `None` if it has none.
    pub fn test_simulation(&self) -> Option<Simulation> {
        let TestDataset { episodes, seed, factors, .. } = self.test.as_ref()?;
        let own = self.simulation.clone()?;
        let factors = factors.clone().unwrap_or_else(|| own.factors.clone());
        Some(Simulation { seed: *seed, episodes: *episodes, factors, test: true, ..own })
    }

    /// Returns the world of the test, if it is not that of the run.
    pub fn other_world(&self) -> Option<&Origin> {
        self.test.as_ref()?.world.as_ref()
    }

    /// Returns the world of the test, or the imported dataset of the run.
    pub fn tested_in(&self) -> &Origin {
        self.other_world().unwrap_or(&self.scenario)
    }

    /// Returns what names the data of a run on a dataset, whose test has the dataset `test`, in hashes. In the world of
    /// the run, the settings and the run's own dataset determine that of the test.
    pub fn data(&self, dataset: &str, test: Option<&str>) -> String {
        let other = test.filter(|_| self.other_world().is_some());
        other.map_or_else(|| dataset.to_owned(), |test| format!("{dataset} {test}"))
    }

    /// Returns the size of the latent state; `None` for an external model.
    pub fn latent(&self) -> Option<usize> {
        self.trained().map(|trained| trained.latent)
    }

    /// Returns the spec of the run of an external model with this name, on the same data with the same inputs, outputs
    /// and window. `variant` is that of the run's cell.
    pub fn external(&self, name: &str, variant: &str, seed: u64) -> Self {
        let model = format!("model={name}");
        let parts = [variant, &model].into_iter().filter(|part| !part.is_empty());
        let variant = parts.collect::<Vec<_>>().join(",");
        let (model, tasks) = (Model::External(name.to_owned()), vec![Task::Prediction]);
        let (inputs, given, probes) = (Disturbances::new(), Vec::new(), Vec::new());
        Self { model, variant, seed, tasks, inputs, given, probes, ..self.clone() }
    }

    /// Returns the hash of what the run asks of a model, whichever it is: the first 16 hexadecimal digits of the
    /// SHA-256 of the name of the data (see [`RunSpec::data`]), the split, the inputs, the outputs, the action and the
    /// window.
    pub fn task_hash(&self, dataset: &str) -> String {
        let task = Self { scaling: Scalings::new(), ..self.external("", "", 0) };
        digits(&format!("{} {dataset}", task.hash()))
    }

    /// Returns the number of elements of the action that a decoder gets. An estimate of the present sample gets none.
    pub fn action_width(&self, layout: &Layout) -> usize {
        if self.window.horizon == 0 { 0 } else { layout.action().len() }
    }

    /// Returns the modalities of the input, the output and the probes, without duplicates, in the order of [`Modality`].
    pub fn modalities(&self) -> Vec<Modality> {
        distinct(self.input.iter().chain(&self.output).chain(&self.probes))
    }

    /// Returns what the reconstruction estimates from the latent state: the input and the probes, in the order of
    /// [`Modality`].
    pub fn reconstructed(&self) -> Vec<Modality> {
        distinct(self.input.iter().chain(&self.probes))
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
        if let Some(Trained { network, training, .. }) = self.trained() {
            check_images(&images, network, training).map_err(|fault| fault.message)?;
            // The modalities of an imported dataset are not known before.
            for (image, _) in images.output {
                if training.predict.contains_key(image) {
                    return Err(format!(
                        "'{image}' is an image, whose change can't be predicted; predict its value"
                    ));
                }
                if training.distributions.contains_key(image) {
                    return Err(format!(
                        "'{image}' is an image, of which no distribution can be predicted; leave it out"
                    ));
                }
            }
        }
        self.check_own_losses(layout)?;
        let of_tests = self.given.iter().filter_map(|given| match given {
            Given::Disturbed(inputs) => Some(inputs),
            _ => None,
        });
        for (modality, disturbance) in of_tests.chain([&self.inputs]).flatten() {
            layout.get(*modality).map_or(Ok(()), |definition| disturbance.check(definition))?;
        }
        let scalings = self.scalings(layout);
        let is_unbounded = |(modality, family): &(&Modality, &Family)| {
            **family == Family::Hurdle
                && scalings.get(*modality).is_some_and(|scaling| scaling.minimum != Some(0.0))
        };
        let distributions = self.trained().map(|trained| &trained.training.distributions);
        if let Some((modality, _)) = distributions.into_iter().flatten().find(is_unbounded) {
            return Err(format!(
                "'{modality}' is not bounded by 0, as a hurdle is; set scaling.{modality}.minimum to 0, or use gaussian"
            ));
        }
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

    /// Refuses settings that categories and unit vectors can't have.
    fn check_own_losses(&self, layout: &Layout) -> Result<(), String> {
        for name in self.modalities() {
            let Some(definition) = layout.get(name).filter(|definition| definition.has_own_loss()) else {
                continue;
            };
            let (has, own, judged) = match definition.category {
                true => ("has categories", "the cross-entropy", "whose probabilities are predicted anyway"),
                false => (
                    "has unit vectors",
                    "1 minus the cosine of the angle",
                    "of which only the direction is predicted",
                ),
            };
            // A run in a simulated world stores the scaling that its world says, if the spec says none.
            let of_world = Scaling { scale: definition.scale, minimum: definition.minimum };
            let is_given = |own: &Scaling| definition.category || *own != of_world;
            if self.scaling.get(&name).is_some_and(is_given) {
                return Err(format!("'{name}' {has}, which are not scaled; leave out scaling.{name}"));
            }
            let Some(Trained { network, training, .. }) = self.trained() else { continue };
            let is_fed_back =
                self.window.horizon > 1 && network.memory == Memory::None && self.input.contains(&name);
            if definition.unit_vectors && is_fed_back {
                return Err(format!(
                    "window.horizon: a network without memory predicts further than one sample from its own \
                     predictions, and of its input '{name}' it predicts only the direction; leave it out of the input, \
                     or use network.memory or horizon: 1"
                ));
            }
            let (setting, why) = if training.predict.contains_key(&name) {
                ("predict", "which have no change; predict their value".to_owned())
            } else if training.losses.contains_key(&name) {
                ("loss", format!("whose loss is {own}; leave it out"))
            } else if training.distributions.contains_key(&name) {
                ("distribution", format!("{judged}; leave it out"))
            } else {
                continue;
            };
            return Err(format!("outputs.{name}.{setting}: '{name}' {has}, {why}"));
        }
        Ok(())
    }

    /// Returns the hash that identifies the run: the first 16 hexadecimal digits of the SHA-256 of its JSON with sorted
    /// keys. It does not depend on the layout of the YAML, nor on whether defaults are written out.
    pub fn hash(&self) -> String {
        let mut json = serde_json::to_value(self).expect("a run's spec is plain data");
        json.sort_all_objects();
        digits(&json.to_string())
    }

    /// Returns the run's spec with every setting, also those that are not stored. `layout` is that of the dataset.
    pub fn complete(&self, layout: &Layout) -> Json {
        let mut all = self.all();
        let mut scalings = self.scalings(layout);
        scalings.retain(|modality, _| !layout[*modality].has_own_loss());
        all["scaling"] = json!(scalings);
        if let Some(Trained { training, .. }) = self.trained() {
            let is_vector = |modality: &&Modality| {
                let own = layout.get(**modality);
                own.is_some_and(|definition| !definition.is_image() && !definition.has_own_loss())
            };
            let vectors: Vec<Modality> = self.output.iter().filter(is_vector).copied().collect();
            fn of<T: Copy + Default>(
                given: &BTreeMap<Modality, T>,
                vectors: &[Modality],
            ) -> BTreeMap<Modality, T> {
                let value =
                    |modality: &Modality| (*modality, given.get(modality).copied().unwrap_or_default());
                vectors.iter().map(value).collect()
            }
            if let Some(rate) = training.modality_dropout.of_all(&self.input) {
                all["training"]["modality_dropout"] = json!(rate);
            }
            all["training"]["losses"] = json!(of(&training.losses, &vectors));
            all["training"]["distributions"] = json!(of(&training.distributions, &vectors));
            all["training"]["predict"] = json!(of(&training.predict, &vectors));
        }
        all
    }

    /// Returns the run's spec with every setting.
    fn all(&self) -> Json {
        serde_json::to_value(Fields::from(self.clone())).expect("a run's spec is plain data")
    }

    /// Returns the run's spec as YAML with every value explicit.
    pub fn to_yaml(&self) -> String {
        serde_yaml::to_string(self).expect("a run's spec is plain data, which YAML can hold")
    }

    /// Returns the YAML of an experiment `name` whose only run is this one. Its variant, which names settings that the
    /// run's own experiment varies, is left out. For an external model it is a task without a network.
    pub fn to_experiment_yaml(&self, name: &str) -> String {
        let mut json = serde_json::to_value(self).expect("a run's spec is plain data");
        let fields = json.as_object_mut().expect("a run's spec is an object");
        fields.remove("variant");
        fields.remove("model");
        for (of_run, of_experiment) in [("scenario", "scenarios"), ("latent", "latent"), ("seed", "seeds")] {
            if let Some(value) = fields.remove(of_run) {
                fields.insert(of_experiment.to_owned(), vec![value].into());
            }
        }
        fields.insert("name".to_owned(), name.into());
        // An experiment without scaling has the defaults, which are not those of a run without scaling.
        if self.scaling.is_empty() && self.simulation.is_some() {
            let scaling = serde_json::to_value(self.scalings(&Layout::finger()));
            fields.insert("scaling".to_owned(), scaling.expect("scalings are plain data"));
        }
        serde_yaml::to_string(&json).expect("a run's spec is plain data, which YAML can hold")
    }

    /// Returns the seed of the dataset; the fold of an imported dataset, or 0 without folds.
    pub fn dataset_seed(&self) -> u64 {
        let fold = self.split.fold.unwrap_or_default() as u64;
        self.simulation.as_ref().map_or(fold, |simulation| simulation.seed)
    }

    /// Returns the name of the run's reading; `None` if its experiment has no readings.
    pub fn reading(&self) -> Option<&str> {
        label_in(&self.variant, "reading")
    }

    /// Returns the label of the axis `role`, by which claims compare readings; `None` if the run's experiment has no such
    /// axis.
    pub fn role(&self) -> Option<&str> {
        label_in(&self.variant, "role")
    }

    /// Returns the number of the run's trial; `None` if its experiment is no search.
    pub fn trial(&self) -> Option<usize> {
        self.variant_parts().1?.parse().ok()
    }

    /// Whether successive halving may train the run on after its last epoch. Its state is kept until then.
    pub fn may_continue(&self) -> bool {
        self.trial().is_some() && self.trained().is_some_and(|trained| trained.training.last_epoch.is_some())
    }

    /// Divides the variant; see [`variant_parts`].
    pub fn variant_parts(&self) -> (&str, Option<&str>, &str) {
        variant_parts(&self.variant)
    }

    /// Returns the name of the cell, which is unique within an experiment: `cluttered-z64`,
    /// `cluttered-z64-kl_weight=0.001` or `cluttered-z64-trial=0017`. A trial's settings are left out, because a
    /// folder's name must be short. The variant of an external model names the model.
    pub fn cell(&self) -> String {
        let (varied, trial, _) = self.variant_parts();
        let trial = trial.map(|number| format!("trial={number}")).unwrap_or_default();
        let names: Vec<&str> = [varied, &trial].into_iter().filter(|name| !name.is_empty()).collect();
        let latent = self.latent().map(|latent| format!("z{latent}"));
        let parts = [Some(self.scenario.name().to_owned()), latent, Some(names.join(","))];
        parts.into_iter().flatten().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-")
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

/// Returns the first 16 hexadecimal digits of the SHA-256 of a text.
fn digits(text: &str) -> String {
    hex(&Sha256::digest(text)[..8])
}

/// Returns the label of an axis in a variant: `camera` of `senses` in `senses=camera,hidden=64`.
pub fn label_in<'a>(variant: &'a str, axis: &str) -> Option<&'a str> {
    let parts = variant.split(',').filter_map(|part| part.split_once('='));
    parts.filter(|(own, _)| *own == axis).map(|(_, label)| label).next()
}

/// Divides a variant into the part that cells of networks have as well, and the name of the external model.
pub fn model_parts(variant: &str) -> (&str, Option<&str>) {
    match variant.rsplit_once("model=") {
        Some((varied, model)) if varied.is_empty() || varied.ends_with(',') => {
            (varied.trim_end_matches(','), Some(model))
        }
        _ => (variant, None),
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
