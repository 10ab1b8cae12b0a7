//! The types of a spec. Their bounds are defined only in the `schemars` attributes. Both the JSON schema for editors
//! and the checks of a spec are generated from these attributes.

mod schemas;

use super::disturbance::{Disturbances, disturbances_schema};
use super::origin::{IMPORTED_NAME, Origin};
use super::search::Search;
use super::simulation::{MAX_SEED, Simulation};
use super::split::Split;
use super::world::World;
use crate::layout::{GivenScalings, Modality, intern, names, scalings_schema};
use schemars::JsonSchema;
use schemas::{
    channels_schema, distributions_schema, factors_schema, loss_weights_schema, losses_schema,
    outputs_schema, predict_schema, rates_schema, search_schema, test_dataset_schema, weight_schema,
};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The action that conditions the decoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Action {
    /// The change of the setpoints from this sample to the next.
    Increment,
    /// The setpoints at the next sample.
    Target,
}
names!(Action { Increment => "increment", Target => "target" });

/// The task that a network is trained for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Task {
    /// Encoder and decoder together predict the next observation from the present one and the action.
    Prediction,
    /// A new decoder reconstructs the present observation from the frozen encoder of the prediction. It gets no action.
    Reconstruction,
}
names!(Task { Prediction => "prediction", Reconstruction => "reconstruction" });

/// The paper's two networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// Two fully connected layers in the encoder, and two in the decoder.
    // Specs of earlier versions have the other names.
    #[serde(alias = "fully_connected")]
    SingleToMulti,
    /// A 4 x 4 convolution of stride 2 on images, then two fully connected layers. The decoder mirrors the encoder.
    #[serde(alias = "convolutional")]
    MultiToMulti,
}
names!(Preset { SingleToMulti => "single_to_multi", MultiToMulti => "multi_to_multi" });

/// Where an encoder joins its inputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Fusion {
    /// The first fully connected layer after the convolutions. Images and vectors share the decoder's hidden layers.
    #[default]
    Early,
    /// One more fully connected layer, after separate hidden layers with layer normalization for images and for
    /// vectors. The decoder has separate hidden layers for each.
    Late,
    /// None: each vector has hidden layers of its own, and so have all images together. Each of these experts estimates
    /// the latent state as a Gaussian distribution. The posterior is the product of these distributions and of the
    /// standard normal distribution, which is the prior (Wu & Goodman, 2018). An input that is lacking is no part of
    /// the product. The decoder is that of `late`.
    Product,
}
names!(Fusion { Early => "early", Late => "late", Product => "product" });

/// What a network knows of earlier samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Memory {
    /// Nothing: it sees one sample.
    #[default]
    None,
    /// The last `memory_samples` encoded samples and the actions before them, side by side. A layer as wide as the last
    /// hidden layer joins them, and the latent state follows from it.
    Window,
    /// A gated recurrent unit between the encoder and the latent state (Cho et al., 2014), as wide as the last hidden
    /// layer. It takes the encoded sample and the action before it. The latent state follows from it.
    Gru,
    /// A recurrent state-space model (Hafner et al., 2025): a gated recurrent unit takes the last latent state and the
    /// action after it. A prior of the next latent state follows from the unit, and a posterior from the unit and the
    /// encoded sample. `kl_weight` weighs the divergence between them.
    Rssm,
}
names!(Memory { None => "none", Window => "window", Gru => "gru", Rssm => "rssm" });

/// What a model has seen when it predicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum WindowStart {
    /// The last `context` samples, anywhere in an episode.
    #[default]
    Random,
    /// All samples since the start of the episode. `context` is then the number of samples in a training sequence.
    Rest,
}
names!(WindowStart { Random => "random", Rest => "rest" });

/// The number format in a network's large matrix products.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// 32-bit floats.
    #[default]
    F32,
    /// Factors are rounded to 16 bits, of which 8 are significant. Sums and parameters stay f32. This is several times
    /// as fast on a processor with bf16 tiles (Intel AMX), and not faster on others.
    Bf16,
    /// On a GPU, whose matrix units round factors to TF32, of which 11 bits are significant. Sums and parameters stay
    /// f32.
    Tf32,
}
names!(Precision { F32 => "f32", Bf16 => "bf16", Tf32 => "tf32" });

/// The device on which a network is trained.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Device {
    /// The processor, with as many threads as the run has.
    #[default]
    Cpu,
    /// The first GPU, through CUDA. The harness must be built with `--features cuda`. Numbers differ from those of the
    /// processor, and of another kind of GPU, by rounding.
    Cuda,
}
names!(Device { Cpu => "cpu", Cuda => "cuda" });

/// How the learning rate changes after the warm-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// It is constant.
    #[default]
    Constant,
    /// It falls along half a cosine, which reaches 0 at the end of the last of `epochs` (Loshchilov & Hutter, 2017,
    /// without restarts). Early stopping does not change the curve.
    Cosine,
}
names!(Schedule { Constant => "constant", Cosine => "cosine" });

/// The validation loss that must improve for training to continue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Stop {
    /// The weighted sum of all terms.
    #[default]
    Total,
    /// The error of any output modality. Training continues as long as one of them improves, even if their sum does
    /// not.
    EveryTerm,
}
names!(Stop { Total => "total", EveryTerm => "every_term" });

/// The loss of a predicted value, as a function of its error in normalized units.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// The squared error. The best prediction is the mean of the possible values.
    #[default]
    Squared,
    /// The absolute error. The best prediction is the median of the possible values.
    Absolute,
    /// The squared error up to an error of 1, and twice the absolute error minus 1 above, which has the same slope
    /// there. This is twice the loss of Huber (1964).
    Huber,
}
names!(Loss { Squared => "squared", Absolute => "absolute", Huber => "huber" });

/// What a network predicts of an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Predict {
    /// Its value.
    #[default]
    Value,
    /// Its change since the present sample, which is added to what the network was given of the present sample. A
    /// network whose output is zero then predicts that nothing changes. The output must be a vector of the input.
    Change,
}
names!(Predict { Value => "value", Change => "change" });

/// The family of the distribution that a network predicts of each value of an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// None: it predicts one number.
    #[default]
    None,
    /// A Gaussian, with a mean and a scale. The loss is its CRPS, in normalized units.
    Gaussian,
    /// For a force: 0 unless the link touches, with a probability for it, and a Laplace distribution above the
    /// threshold of a contact if it does. The loss is the cross-entropy of the contact, plus the CRPS of the force given a contact.
    Hurdle,
}
names!(Family { None => "none", Gaussian => "gaussian", Hurdle => "hurdle" });

/// How predicted distributions are recalibrated after the training, on the validation samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Recalibration {
    /// They are not.
    None,
    /// The scales of each output are multiplied by one factor, and the logits of a contact by another.
    #[default]
    Scales,
    /// As `scales`, and the quantiles of each output are then taken at other probabilities, so that as many values lie
    /// below each as should (Kuleshov et al., 2018). Predictions are the means of these distributions.
    Quantiles,
}
names!(Recalibration { None => "none", Scales => "scales", Quantiles => "quantiles" });

/// The settings of an output.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OutputSettings {
    /// What the network predicts. The default is `value`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Predict")]
    pub predict: Option<Predict>,
    /// The loss of a vector, in prediction. The default is `squared`. The loss of images is always squared, and that of
    /// categories is the cross-entropy.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Loss")]
    pub loss: Option<Loss>,
    /// The distribution that the network predicts of each value of a vector. The default is `none`. The loss of an
    /// output with a distribution is the score of the distribution.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Family")]
    pub distribution: Option<Family>,
    /// Weight of the mean loss. The default is 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "weight_schema")]
    pub weight: Option<f64>,
}

/// An experiment: the settings in one YAML file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Name of the experiment and of the folder of its results: 1 to 64 letters, digits, `_` and `-`.
    #[schemars(regex(pattern = "^[A-Za-z0-9_-]{1,64}$"))]
    pub name: String,
    /// The question of the experiment, in a sentence.
    #[serde(default)]
    pub description: String,
    /// Sources of the samples: names of built-in worlds, paths of world files, or names of imported datasets. Each has
    /// runs of its own.
    #[schemars(length(min = 1), extend("uniqueItems" = true))]
    pub scenarios: Vec<Origin>,
    /// The modalities that the encoder gets. Their order does not matter.
    #[schemars(length(min = 1), extend("uniqueItems" = true))]
    pub input: Vec<Modality>,
    /// The modalities that the decoder predicts. Their order does not matter.
    #[schemars(length(min = 1), extend("uniqueItems" = true))]
    pub output: Vec<Modality>,
    /// Settings of outputs, by their names: what is predicted, the loss and its weight.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schemars(schema_with = "outputs_schema")]
    pub outputs: BTreeMap<Modality, OutputSettings>,
    /// Sizes of the latent state. Each has runs of its own.
    #[schemars(length(min = 1), inner(range(min = 1, max = 4096)), extend("uniqueItems" = true))]
    pub latent: Vec<usize>,
    /// Seeds of the runs, for initial weights, sampling and the order of batches. Each has runs of its own.
    #[serde(default = "default_seeds")]
    #[schemars(length(min = 1), inner(range(min = 0, max = MAX_SEED)), extend("uniqueItems" = true))]
    pub seeds: Vec<u64>,
    /// The tasks of every run, in this order. Reconstruction needs prediction before it.
    #[serde(default = "default_tasks")]
    #[schemars(length(min = 1), extend("uniqueItems" = true))]
    pub tasks: Vec<Task>,
    /// The action that the decoder gets.
    #[serde(default = "default_action")]
    pub action: Action,
    /// How many samples the network sees and predicts.
    #[serde(default)]
    pub window: Window,
    /// Layers of the network.
    pub network: Network,
    /// Settings of the simulation, which determine the dataset.
    #[serde(default)]
    pub simulation: Simulation,
    /// How the dataset is divided into training, validation and test set.
    #[serde(default)]
    pub split: Split,
    /// A dataset of its own for the test. All runs in a world are then tested on the same episodes, whatever they are
    /// trained on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "test_dataset_schema")]
    pub test: Option<TestDataset>,
    /// What is wrong with the sensors of some inputs, in training and in the test: `{arm: {noise: 0.1, delay: 2}}`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schemars(schema_with = "disturbances_schema")]
    pub inputs: Disturbances,
    /// The tests of a trained network besides that with all inputs: `each` input alone, `without_each`, or a list of
    /// those that the network gets (`[[vision], [arm, vision]]`). A vector or an image that it does not get is at its
    /// mean over the training data. A section has what is wrong with their sensors instead of what `inputs` says:
    /// `[{arm: {noise: 0.1}, vision: {}}]`. The column `given` of the tables names what it gets.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("uniqueItems" = true))]
    pub given: Vec<Given>,
    /// What the reconstruction also estimates from the latent state, besides the input: anything that the dataset has,
    /// such as `[arm, boxes]`. The same decoder with an untrained encoder is judged beside it, and regressions from the
    /// input itself.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("uniqueItems" = true))]
    pub probes: Vec<Modality>,
    /// How each modality is scaled for the network, and the lower bound of its predictions in physical units.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schemars(schema_with = "scalings_schema")]
    pub scaling: GivenScalings,
    /// Settings of training.
    #[serde(default)]
    pub training: Training,
    /// The axes in which runs differ; each combination has runs of its own. An axis is a setting with its values, by
    /// dotted key (`training.kl_weight: [0, 0.001]`), or a name with labels, each with the settings in which it differs
    /// from the spec (`senses: {angles: {input: [proprioception]}}`). A label may extend another one of its axis.
    /// `input: {without: each}` stands for the input of the spec, and the input without each of its modalities. The
    /// column `variant` of the tables names the combination.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    pub vary: serde_json::Map<String, serde_json::Value>,
    /// Settings to draw from distributions. Each trial is one combination and has runs of its own. The column `variant`
    /// of the tables names the trial.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "search_schema")]
    pub search: Option<Search>,
    /// Alternative interpretations of choices that a paper leaves open. Each has runs of its own. The spec's own
    /// settings are the reading `base`. The column `reading` of the table `runs` names the reading.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub readings: Vec<Reading>,
    /// Settings that `--quick` replaces, by dotted key as on the command line: `training.epochs: 3`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub quick: Settings,
    /// The contents of the world files among `scenarios`, read together with the spec.
    #[serde(skip)]
    pub worlds: Vec<Arc<World>>,
}

/// Values of settings, by dotted key: `training.epochs: 3`.
pub type Settings = BTreeMap<String, serde_json::Value>;

/// An alternative interpretation of a choice that a paper leaves open.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Reading {
    /// Name of the reading in tables: 1 to 64 letters, digits and `_`, starting with a letter.
    pub name: String,
    /// The choice that the paper leaves open.
    pub choice: String,
    /// The choice that the spec's own settings make.
    pub base: String,
    /// The choice that this reading makes.
    pub instead: String,
    /// The sentence of the paper that leaves the choice open, with its place.
    pub paper: String,
    /// The settings that differ from the spec's, by dotted key. They also replace those of labels under `vary`.
    pub settings: Settings,
}

impl Reading {
    /// The name of the reading with the spec's own settings.
    pub const BASE: &str = "base";
}

/// Layers of the encoder and the decoder. A preset is a network of the paper. Every other setting replaces a part of
/// it.
#[derive(Debug, Clone, PartialEq, SmartDefault, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("required" = ["preset"]))]
pub struct Network {
    /// The network of the paper that the other settings modify.
    #[serde(alias = "architecture")]
    #[default(Preset::MultiToMulti)]
    pub preset: Preset,
    /// Units of each fully connected hidden layer. The paper has one such layer and does not give its width.
    #[serde(deserialize_with = "one_or_many")]
    #[schemars(length(min = 1, max = 16), inner(range(min = 1, max = 16384)))]
    #[default(vec![256])]
    pub hidden: Vec<usize>,
    /// Channels of each convolution on images (4 x 4 kernels, stride 2). The decoder mirrors them. The default is the
    /// preset's: `[16]` for multi_to_multi, none for single_to_multi. The setting has no effect without images.
    // A run's spec always has them. The key can't be `null`, so it is left out.
    #[serde(deserialize_with = "maybe_one_or_many", skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "channels_schema")]
    pub channels: Option<Vec<usize>>,
    /// Side of the squares of pixels over which images are averaged before the encoder's first convolution, in pixels.
    #[schemars(range(min = 1, max = 32))]
    #[default(1)]
    pub average: usize,
    /// Where the encoder joins its inputs.
    pub fusion: Fusion,
    /// What the network knows of earlier samples. A network with memory needs a `window` with a context of several
    /// samples.
    pub memory: Memory,
    /// Number of samples that `memory: window` knows, with the present one.
    #[schemars(range(min = 2, max = 1000))]
    #[default(5)]
    pub memory_samples: usize,
    /// Number of latent states that the test draws for each window. What the network predicts from each is its
    /// predictive distribution, and the mean is its prediction. 0 means a prediction from the mean of the latent state.
    #[schemars(range(max = 10_000))]
    pub draws: usize,
}

impl Network {
    /// Returns the channels of each convolution, or those of the preset if none are given.
    pub fn channels(&self) -> &[usize] {
        match (&self.channels, self.preset) {
            (Some(channels), _) => channels,
            (None, Preset::MultiToMulti) => &[16],
            (None, Preset::SingleToMulti) => &[],
        }
    }
}

/// The dataset on which runs are tested. Its episodes are simulated like those that a run is trained on, with the same
/// settings except their number, seed, factors and world, but from random streams of their own. Equal seeds therefore give
/// other motions. The test of an imported dataset is another imported dataset. The dataset of the run is divided into training
/// and validation only, and `split.test` has no effect.
#[derive(Debug, Clone, PartialEq, Eq, SmartDefault, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TestDataset {
    /// Number of episodes.
    #[schemars(range(min = 1, max = 1_000_000))]
    #[default(200)]
    pub episodes: u32,
    /// Seed of the episodes.
    #[schemars(range(min = 0, max = MAX_SEED))]
    pub seed: u64,
    /// Factors of variation that the episodes draw; those of `simulation.factors` if the spec does not say. A network
    /// that was trained without a factor can so be tested with it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "factors_schema")]
    pub factors: Option<Vec<String>>,
    /// The world in which the episodes are simulated, if it is not that of the run: the name of a built-in world, or the
    /// path of a world file. Both worlds must define what the run uses in the same way: its modalities and its action.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Origin")]
    pub world: Option<Origin>,
    /// Name of the imported dataset with the test episodes, of which all are used, for runs on imported datasets. It
    /// must have the same modalities and sample rate as these.
    #[schemars(regex(pattern = IMPORTED_NAME))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dataset: Option<String>,
}

/// How a network is trained.
#[derive(Debug, Clone, PartialEq, SmartDefault, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Training {
    /// Learning rate of Adam.
    #[schemars(range(max = 1.0), extend("exclusiveMinimum" = 0.0))]
    #[default(1e-3)]
    pub learning_rate: f64,
    /// How the learning rate changes after the warm-up.
    pub schedule: Schedule,
    /// Number of epochs in which the learning rate first rises, linearly from 0. Fractions are allowed.
    #[schemars(range(min = 0.0, max = 100_000.0))]
    pub warmup_epochs: f64,
    /// Decoupled weight decay (AdamW; Loshchilov & Hutter, 2019). Each step subtracts this share of each weight, times
    /// the learning rate. Biases do not decay.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub weight_decay: f64,
    /// Largest Euclidean norm of the gradient of all parameters together. A longer gradient is scaled down to it.
    /// `null` means no limit.
    #[schemars(range(max = 1e6), extend("exclusiveMinimum" = 0.0))]
    pub clip_norm: Option<f64>,
    /// Predictions of samples per step. A window has one for each sample that the network sees, and
    /// `window.horizon - 1` more for each sample from which training predicts further.
    #[schemars(range(min = 1, max = 65536))]
    #[default(1024)]
    pub batch_size: usize,
    /// Training predicts further than the next sample from one of this many samples that the network sees, which each
    /// step draws anew. Validation always takes the same ones.
    #[schemars(range(min = 1, max = 10_000))]
    #[default(1)]
    pub rollout_stride: usize,
    /// Weight of the loss of a predicted sample, relative to that of the sample before it. The weights of the samples
    /// of a horizon add up to 1. A discount of 1 weighs all alike.
    #[schemars(range(max = 1.0), extend("exclusiveMinimum" = 0.0))]
    #[default(1.0)]
    pub discount: f64,
    /// Number of samples at the beginning of a training sequence that a network with memory sees, but on which it is
    /// not trained: they have no loss and no gradient.
    #[schemars(range(max = MAX_WINDOW))]
    pub burn_in: usize,
    /// Number of samples over which gradients reach back in a training sequence (truncated backpropagation through
    /// time). The memory goes on from one such part to the next. `null` means the whole sequence.
    #[schemars(range(min = 1, max = MAX_WINDOW))]
    pub truncate: Option<usize>,
    /// Largest number of epochs.
    #[schemars(range(min = 1, max = 100_000))]
    #[default(200)]
    pub epochs: usize,
    /// The epoch after which training ends, if it is before the last of `epochs`. The learning rate still follows
    /// `epochs`. Successive halving sets it.
    #[schemars(range(min = 1, max = 100_000))]
    pub last_epoch: Option<usize>,
    /// Number of epochs without a better validation loss after which training stops. The parameters of the epoch with
    /// the lowest total are kept. With `null`, training does not stop early and the last parameters are kept.
    #[schemars(range(min = 1, max = 100_000))]
    #[default(Some(20))]
    pub patience: Option<usize>,
    /// The validation loss that `patience` refers to. It has no effect if `patience` is `null`.
    pub stop: Stop,
    /// Weight of the Kullback-Leibler divergence in the total loss. The weights of the output modalities are in
    /// `outputs`.
    #[schemars(range(min = 0.0, max = 1e6))]
    #[default(1e-4)]
    pub kl_weight: f64,
    /// What is predicted of each output, as `outputs.NAME.predict` says.
    #[schemars(schema_with = "predict_schema")]
    pub predict: BTreeMap<Modality, Predict>,
    /// Loss of each output, as `outputs.NAME.loss` says.
    #[schemars(schema_with = "losses_schema")]
    pub losses: BTreeMap<Modality, Loss>,
    /// Distribution of each output, as `outputs.NAME.distribution` says.
    #[schemars(schema_with = "distributions_schema")]
    pub distributions: BTreeMap<Modality, Family>,
    /// Weight of the mean loss of each output, as `outputs.NAME.weight` says.
    #[schemars(schema_with = "loss_weights_schema")]
    pub loss_weights: BTreeMap<Modality, f64>,
    /// How predicted distributions are recalibrated after the training, on the validation samples. It has no effect
    /// without distributions or validation samples.
    pub recalibration: Recalibration,
    /// Probability that a step of training drops an output of the last convolution (dropout; Srivastava et al., 2014),
    /// in [0, 1). It has no effect on a fully connected network.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub dropout: f64,
    /// Probability that a training window lacks an input, in [0, 1): one number for all inputs, or one for each that may
    /// be lacking (`{vision: 0.3}`). Each window keeps at least one input. A list has inputs that are lacking together,
    /// at most one item in a window: `[{inputs: [contact_force, contact_force_mean], probability: 0.2}]`. All samples of
    /// a window lack an input, and it is then at its mean over the training data.
    pub modality_dropout: ModalityDropout,
    /// The number format in large matrix products.
    pub precision: Precision,
    /// Whether matrix products use the processor's tile unit (Intel AMX), if it has one. Results with and without it
    /// differ by rounding.
    #[default(true)]
    pub tiles: bool,
    /// The device on which a network is trained.
    pub device: Device,
}

/// Consecutive samples of an episode: what a model has seen, and what it predicts. A window is named by its present
/// sample, the last one that the model has seen.
#[derive(Debug, Clone, PartialEq, Eq, SmartDefault, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Window {
    /// Number of samples that the model sees, with the present one. A network without memory sees only the present one,
    /// whatever the number; it is then judged on the same samples as one with memory.
    #[schemars(range(min = 1, max = MAX_WINDOW))]
    #[default(1)]
    pub context: usize,
    /// What the model has seen when it predicts: the last `context` samples anywhere in an episode (`random`, the
    /// default), or all samples since the episode's start (`rest`).
    pub start: WindowStart,
    /// Number of samples after the present one that the model predicts, one from the other. The tables `metrics` and
    /// `predictions` contain those of the first one, and `all_metrics` and `all_predictions` also those at 2, 5, 10,
    /// 20, 50, 100, 200 and 500 samples, as far as the horizon goes, and at the horizon. With 0, the model estimates the
    /// outputs at the present sample. A list is short for `vary: {window.horizon: [0, 1, 5]}`.
    #[schemars(range(max = MAX_WINDOW))]
    #[default(1)]
    pub horizon: usize,
    /// Times since the start of an episode, in whole seconds. The predicted samples from each of them on have metrics
    /// of their own, such as `r2_from_10s`.
    #[schemars(inner(range(min = 1, max = 100_000)), extend("uniqueItems" = true))]
    pub since_s: Vec<u32>,
}

/// Largest context and horizon.
const MAX_WINDOW: usize = 1000;
/// Numbers of samples after the present one at which predictions are judged.
const HORIZONS: [usize; 9] = [1, 2, 5, 10, 20, 50, 100, 200, 500];

impl Window {
    /// A transition: the present sample and the next one.
    pub const TRANSITION: Self =
        Self { context: 1, start: WindowStart::Random, horizon: 1, since_s: Vec::new() };

    /// Returns the window with a context of one sample.
    pub fn of_one_sample(&self) -> Self {
        Self { context: 1, ..self.clone() }
    }

    /// Returns the shortest window in which a model is judged. From the start of an episode, this is its first sample.
    pub fn judged(&self) -> Self {
        match self.start {
            WindowStart::Random => self.clone(),
            WindowStart::Rest => self.of_one_sample(),
        }
    }

    /// Returns the horizon whose predictions the tables `metrics` and `predictions` have: the next sample, or the present
    /// one if that is estimated.
    pub fn first_horizon(&self) -> usize {
        self.horizon.min(1)
    }

    /// Returns the number of samples in a window.
    pub fn samples(&self) -> usize {
        self.context + self.horizon
    }

    /// Returns the numbers of samples after the present one at which predictions are judged, in ascending order.
    pub fn horizons(&self) -> Vec<usize> {
        let shorter = HORIZONS.into_iter().filter(|horizon| *horizon < self.horizon);
        shorter.chain([self.horizon]).collect()
    }
}

impl Training {
    /// The epoch after which training ends at the latest.
    pub fn final_epoch(&self) -> usize {
        self.last_epoch.unwrap_or(self.epochs)
    }
}

/// Some tests of a trained network with a part of its inputs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Given {
    /// Tests that follow from the inputs.
    Named(Subsets),
    /// A test with these inputs.
    Inputs(#[schemars(length(min = 1), extend("uniqueItems" = true))] Vec<Modality>),
    /// A test with these inputs, whose sensors have this.
    Disturbed(#[schemars(schema_with = "disturbances_schema")] Disturbances),
}

impl Given {
    /// Returns the inputs that the network gets.
    pub fn inputs(&self) -> Vec<Modality> {
        match self {
            Self::Named(_) => Vec::new(),
            Self::Inputs(inputs) => inputs.clone(),
            Self::Disturbed(inputs) => inputs.keys().copied().collect(),
        }
    }

    /// Returns what the column `given` has: `arm,proprioception`, or `arm,proprioception noise=0.1`.
    pub fn name(&self) -> &'static str {
        let mut names: Vec<String> = match self {
            Self::Disturbed(inputs) => inputs.iter().map(|(modality, of)| of.named(*modality)).collect(),
            _ => self.inputs().iter().map(|modality| modality.name().to_owned()).collect(),
        };
        names.sort_unstable();
        intern(&names.join(","))
    }
}

/// Tests that follow from the inputs of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Subsets {
    /// That with all inputs, which is always made.
    All,
    /// One with each input alone.
    Each,
    /// One without each input.
    WithoutEach,
}

impl Experiment {
    /// Returns the tests besides that with all inputs, each with its inputs.
    pub(super) fn tests(&self) -> Vec<Given> {
        let without = |left_out: &Modality| -> Vec<Modality> {
            self.input.iter().copied().filter(|modality| modality != left_out).collect()
        };
        let of = |given: &Given| match given {
            Given::Inputs(inputs) => vec![inputs.clone()],
            Given::Named(Subsets::All) | Given::Disturbed(_) => Vec::new(),
            Given::Named(Subsets::Each) => self.input.iter().map(|modality| vec![*modality]).collect(),
            Given::Named(Subsets::WithoutEach) => self.input.iter().map(without).collect(),
        };
        let mut subsets: Vec<Vec<Modality>> = self.given.iter().flat_map(of).collect();
        subsets.iter_mut().for_each(|inputs| inputs.sort());
        subsets.sort();
        subsets.retain(|inputs| !inputs.is_empty() && inputs.len() < self.input.len());
        let disturbed = self.given.iter().filter(|given| matches!(given, Given::Disturbed(_))).cloned();
        let mut names = BTreeSet::new();
        let tests = subsets.into_iter().map(Given::Inputs).chain(disturbed);
        tests.filter(|given| names.insert(given.name())).collect()
    }
}

/// The probabilities that a training window lacks an input.
#[derive(Debug, Clone, PartialEq, SmartDefault, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum ModalityDropout {
    /// The same one for all inputs.
    #[default]
    Every(#[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))] f64),
    /// One for each of these inputs; 0 for all others.
    Of(#[schemars(schema_with = "rates_schema")] BTreeMap<Modality, f64>),
    /// Inputs that are lacking together. A window lacks those of at most one item.
    Together(Vec<Together>),
}

/// Inputs that a training window lacks together.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Together {
    /// The inputs.
    #[schemars(length(min = 1), extend("uniqueItems" = true))]
    pub inputs: Vec<Modality>,
    /// The probability that a window lacks them. Those of all items are less than 1 together.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub probability: f64,
}

impl ModalityDropout {
    /// Returns the same probabilities in one form, without those that have no effect. A single input is never lacking.
    pub fn of_inputs(&self, input: &[Modality]) -> Self {
        let effective = match self {
            _ if input.len() < 2 => return Self::default(),
            Self::Every(rate) => Self::Of(input.iter().map(|modality| (*modality, *rate)).collect()),
            other => other.clone(),
        };
        match effective {
            Self::Of(mut rates) => {
                rates.retain(|modality, rate| input.contains(modality) && *rate > 0.0);
                if rates.is_empty() { Self::default() } else { Self::Of(rates) }
            }
            Self::Together(mut all) => {
                all.retain(|one| one.probability > 0.0);
                if all.is_empty() { Self::default() } else { Self::Together(all) }
            }
            every => every,
        }
    }

    /// Returns the probability that all inputs share, if they do.
    pub(super) fn of_all(&self, input: &[Modality]) -> Option<f64> {
        let rates = match self.of_inputs(input) {
            Self::Of(rates) => rates,
            Self::Every(_) => BTreeMap::new(),
            Self::Together(_) => return None,
        };
        let first = rates.values().next().copied().unwrap_or_default();
        let is_same =
            rates.is_empty() || rates.len() == input.len() && rates.values().all(|rate| *rate == first);
        is_same.then_some(first)
    }
}

fn default_seeds() -> Vec<u64> {
    vec![0]
}
fn default_tasks() -> Vec<Task> {
    vec![Task::Prediction, Task::Reconstruction]
}
fn default_action() -> Action {
    Action::Increment
}

/// A list or a single value. Specs of earlier versions have single values.
#[derive(Deserialize)]
#[serde(untagged)]
enum OneOrMany {
    One(usize),
    Many(Vec<usize>),
}

impl From<OneOrMany> for Vec<usize> {
    fn from(values: OneOrMany) -> Self {
        match values {
            OneOrMany::One(value) => vec![value],
            OneOrMany::Many(values) => values,
        }
    }
}

fn one_or_many<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Vec<usize>, D::Error> {
    OneOrMany::deserialize(deserializer).map(Into::into)
}

fn maybe_one_or_many<'de, D: serde::Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<Vec<usize>>, D::Error> {
    Option::<OneOrMany>::deserialize(deserializer).map(|values| values.map(Into::into))
}
