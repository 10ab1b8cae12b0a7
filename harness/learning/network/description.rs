//! A description of a network, from which other programs can rebuild it. Each network file has one in its metadata.
//!
//! docs/networks.md explains it. Names of tensors are those of the network's file.

use super::Architecture;
use super::head::{GREATEST_LOGARITHM, LEAST_SCALE, heads};
use candle_core::Result;
use harness_metrics::force::THRESHOLD_N;
use harness_samples::{Normalizer, Normalizers};
use harness_spec::{Action, Definition, Element, Family, IMAGE_CHANNELS, Kind, Loss, Modality, Task, Window};
use serde::Serialize;
use std::collections::BTreeMap;

/// Version of the description. Raise it if a reader of the previous version would compute something else.
pub const FORMAT: u32 = 1;
/// Version of the description of a network with memory.
pub const FORMAT_WITH_MEMORY: u32 = 2;
/// Version of the description of a network that predicts changes, with or without memory.
pub const FORMAT_WITH_CHANGES: u32 = 3;
/// Version of the description of a network that predicts distributions, with or without memory and changes.
pub const FORMAT_WITH_DISTRIBUTIONS: u32 = 4;
/// Version of the description of a network that predicts categories, with or without all of these.
pub const FORMAT_WITH_CATEGORIES: u32 = 5;

/// The loss of categories.
pub const CROSS_ENTROPY: &str = "cross_entropy";
/// The loss of unit vectors: 1 minus the cosine of the angle.
pub const COSINE: &str = "cosine";

/// Value that the encoder is given: all normalized vectors of the input side by side, `[batch, width]`.
pub const VECTORS: &str = "vectors";
/// Value that the encoder is given: all normalized images of the input stacked by channel, `[batch, channels, rows,
/// columns]`.
pub const IMAGES: &str = "images";
/// The encoder's last layer: the means of the latent state, followed by the log-variances, `[batch, 2 * latent]`.
pub const POSTERIOR: &str = "posterior";
/// Value that the decoder is given: the latent state, `[batch, latent]`.
pub const LATENT: &str = "latent";
/// Value that the decoder is given: the normalized action, `[batch, elements]`.
pub const ACTION: &str = "action";

/// The memory's layer, `[batch, width]`. It takes `encoded` (the encoder's last layer; zero for a sample that is not
/// seen), `seen` (1 for a sample that is seen, and 0 otherwise), and the normalized action before the sample (zero
/// before the first one). That of a recurrent state-space model takes the last latent state and the action after it.
/// Neither takes an action if the dataset has no setpoint.
pub const MEMORY: &str = "memory";
/// Value that the memory is given: the encoder's last layer.
pub const ENCODED: &str = "encoded";
/// Value that the memory is given: whether the sample is seen, `[batch, 1]`.
pub const SEEN: &str = "seen";
/// The last layer of what a recurrent state-space model expects: the means of the latent state of a sample that is not
/// seen, followed by the log-variances, `[batch, 2 * latent]`.
pub const PRIOR: &str = "prior";

/// A network with everything that is needed to rebuild it from its tensors.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Description {
    /// [`FORMAT`], [`FORMAT_WITH_MEMORY`], [`FORMAT_WITH_CHANGES`], [`FORMAT_WITH_DISTRIBUTIONS`] or
    /// [`FORMAT_WITH_CATEGORIES`].
    pub format: u32,
    /// `prediction`: encoder and decoder. `reconstruction`: only a decoder, which takes the latent state of the
    /// prediction's encoder.
    pub task: &'static str,
    /// Whether the outputs of a prediction are those of the present sample, and not of the next one.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub estimates_present: bool,
    /// Size of the latent state.
    pub latent: usize,
    /// How images are laid out.
    pub images: Images,
    /// The observation that the encoder takes, in the order of the network. Empty without an encoder.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub inputs: Vec<Quantity>,
    /// The action that the decoder or the memory takes; `None` if neither takes one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub action: Option<ActionTaken>,
    /// The observation that the decoder returns, in the order of the network.
    pub outputs: Vec<Output>,
    /// Layers of the encoder in the order in which they are applied. The last one is [`POSTERIOR`]. Empty without an
    /// encoder.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub encoder: Vec<Layer>,
    /// Layers between the encoder and the latent state, which keep a state from sample to sample. The last one is
    /// [`POSTERIOR`], and replaces that of the encoder. Empty without memory.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub memory: Vec<Layer>,
    /// Layers of the decoder in the order in which they are applied.
    pub decoder: Vec<Layer>,
}

/// How images are laid out outside of a network and in it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Images {
    /// Axes of an image. Row 0 is the top, column 0 the left.
    pub axes: [&'static str; 3],
    /// Axes of an image in the network, and of its mean.
    pub network_axes: [&'static str; 3],
    /// Order of the channels.
    pub channels: [&'static str; IMAGE_CHANNELS],
    /// Bytes are divided by this number, which gives values in [0, 1].
    pub bytes_divided_by: f64,
}

impl Default for Images {
    fn default() -> Self {
        Self {
            axes: ["row", "column", "channel"],
            network_axes: ["channel", "row", "column"],
            channels: ["red", "green", "blue"],
            bytes_divided_by: 255.0,
        }
    }
}

/// A modality, and its place in the network.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Quantity {
    /// Name of the modality.
    pub name: Modality,
    /// What the modality is, in one sentence.
    pub meaning: String,
    /// Shape of one sample: `[width]`, or `[rows, columns, 3]`.
    pub shape: Vec<usize>,
    /// Whether it is a vector or an image, with the names and units of the elements or the size.
    #[serde(flatten)]
    pub kind: Kind,
    /// If it is the change of an image since the sample before: the image.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub difference_of: Option<Modality>,
    /// The value that contains it: what the encoder is given, or the decoder's layer that computes it.
    pub value: &'static str,
    /// Index of its first column or channel in that value.
    pub start: usize,
    /// Names of the tensors that normalize it.
    #[serde(flatten)]
    pub scale: Scale,
}

/// Names of the tensors that normalize a quantity: normalized = (value - mean) / deviation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scale {
    /// One mean for each value; `[channel, row, column]`, flattened, for an image.
    pub mean: String,
    /// One standard deviation for each value, or one for all values.
    pub deviation: String,
}

impl Scale {
    fn of(name: &str) -> Self {
        Self { mean: format!("scale.{name}.mean"), deviation: format!("scale.{name}.deviation") }
    }
}

/// Returns the name of the tensor that normalizes the changes of a modality.
pub(crate) fn change_of(modality: Modality) -> String {
    format!("scale.{modality}.change")
}

/// A modality that the decoder returns.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Output {
    /// The modality. Its value in SI units is normalized * deviation + mean.
    #[serde(flatten)]
    pub quantity: Quantity,
    /// If the decoder predicts the change since the present sample: the name of the tensor with its deviation. The value
    /// in SI units is then that of the present sample + normalized * this deviation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change: Option<String>,
    /// Values below this bound are set to it, after they were converted to SI units.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub minimum: Option<f64>,
    /// The loss that the decoder was trained with, in normalized units: `squared`, `absolute`, `huber`,
    /// `cross_entropy` of categories or `cosine` of unit vectors. It has no effect with a distribution.
    pub loss: &'static str,
    /// Whether the values are the softmax over its columns: the probability of each category.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub softmax: bool,
    /// The distribution of each value; `None` if only the value is predicted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distribution: Option<Predicted>,
}

/// The distribution of each value of an output.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Predicted {
    /// The family of the distribution.
    pub family: Family,
    /// Index of the first of its other parameters in the output's value: a raw scale for each element, and then the
    /// logit of a contact for a hurdle. The normalized scale is e^raw + `least_scale`,
    /// and `raw` at most `greatest_logarithm`.
    pub start: usize,
    /// The least scale.
    pub least_scale: f64,
    /// The bound of raw scales.
    pub greatest_logarithm: f64,
    /// The force above which a link touches, N; only for a hurdle.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threshold: Option<f32>,
    /// The probabilities of values below the quantiles of the family at 0, 1/n, 2/n, up to 1, given a contact for a
    /// hurdle; `None` if they are these themselves.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub levels: Option<Vec<f32>>,
}

/// The action that a decoder or a memory takes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ActionTaken {
    /// `increment`: the setpoint of the next sample minus that of this one. `target`: the setpoint of the next sample.
    pub form: Action,
    /// Names and units of the elements.
    pub elements: Vec<Element>,
    /// Names of the tensors that normalize it.
    #[serde(flatten)]
    pub scale: Scale,
}

/// One operation of an encoder or a decoder, on a batch.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Layer {
    /// Name of the layer, and of the value that it computes.
    pub name: String,
    /// What it computes.
    #[serde(flatten)]
    pub operation: Operation,
    /// Names of the values that it takes: earlier layers, or what the encoder or the decoder is given.
    pub inputs: Vec<String>,
    /// Shape of one sample's output: `[width]`, `[channels, rows, columns]`, or `[objects, width]` for a set.
    pub output: Vec<usize>,
    /// Number of weights and biases.
    pub parameters: usize,
}

/// The kinds of layers.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Operation {
    /// The inputs side by side.
    Concatenate,
    /// Some columns of the input side by side.
    Columns {
        /// Index of the first column, and number of columns, of each part.
        ranges: Vec<[usize; 2]>,
    },
    /// The objects of a set as rows. The next fully connected layers compute the same for each row.
    Objects {
        /// Index of the set's first column in the input. The columns of an object lie side by side.
        start: usize,
        /// Number of objects.
        objects: usize,
    },
    /// The sum over the objects of a set, followed by the maximum over them.
    SumAndMaximum {
        /// Number of objects.
        objects: usize,
    },
    /// The mean over squares of pixels with this side.
    Average {
        /// Side of a square in pixels.
        size: usize,
    },
    /// An image as a vector, `[channel, row, column]` in row-major order.
    Flatten,
    /// A vector as an image with the shape of the output; the reverse of [`Operation::Flatten`].
    Reshape,
    /// A fully connected layer: the sum of each input times its weight, transposed, and the bias.
    Dense {
        /// Name of each input's weight `[outputs, width of the input]`.
        weights: Vec<String>,
        /// Name of the bias, `[outputs]`.
        bias: String,
        /// What follows.
        activation: Activation,
    },
    /// A convolution (cross-correlation, as in PyTorch).
    Convolution(Convolution),
    /// A transposed convolution.
    TransposedConvolution(Convolution),
    /// A gated recurrent unit (Cho et al., 2014), as PyTorch computes it: its parts are in the order reset, update,
    /// candidate.
    GatedRecurrentUnit {
        /// Name of the inputs' weight, `[3 * width, inputs]`.
        input_weight: String,
        /// Name of the inputs' bias, `[3 * width]`.
        input_bias: String,
        /// Name of the last state's weight, `[3 * width, width]`.
        hidden_weight: String,
        /// Name of the last state's bias, `[3 * width]`.
        hidden_bias: String,
    },
    /// The inputs of the last samples side by side, those of the latest sample first. Samples before the first one are
    /// zero.
    LastSamples {
        /// Number of samples.
        samples: usize,
    },
    /// The product of Gaussian distributions and of the standard normal distribution. Each input has means, followed by
    /// log-variances, and so has the output.
    ProductOfExperts {
        /// Log-variances of the inputs that are less count as this.
        least_log_variance: f64,
    },
    /// Layer normalization over the row: (x - mean) / sqrt(variance + epsilon) * weight + bias.
    LayerNormalization {
        /// Name of the weight, `[width]`.
        weight: String,
        /// Name of the bias, `[width]`.
        bias: String,
        /// Added to the variance.
        epsilon: f64,
    },
}

/// The settings of a convolution.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Convolution {
    /// Name of the kernel: `[channels out, channels in, rows, columns]`; for a transposed convolution `[channels in,
    /// channels out, rows, columns]`.
    pub weight: String,
    /// Name of the bias, `[channels out]`.
    pub bias: String,
    /// Step in pixels.
    pub stride: usize,
    /// Pixels of zeros around the image. A transposed convolution leaves out as many pixels around its output.
    pub padding: usize,
    /// What follows.
    pub activation: Activation,
}

/// The function after a layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// None.
    None,
    /// Negative values are set to 0.
    Relu,
}

impl Activation {
    /// Returns ReLU if `relu`, and none otherwise.
    pub(crate) fn relu_if(relu: bool) -> Self {
        if relu { Self::Relu } else { Self::None }
    }
}

impl Convolution {
    /// Returns the settings of a network's convolution named `name`.
    pub fn new(name: &str, activation: Activation) -> Self {
        let (weight, bias) = (format!("{name}.weight"), format!("{name}.bias"));
        Self { weight, bias, stride: 2, padding: 1, activation }
    }
}

impl Layer {
    /// Describes the values `inputs` side by side, of `width` in all.
    pub(crate) fn concatenate(name: &str, inputs: &[&str], width: usize) -> Self {
        Self {
            name: name.to_owned(),
            operation: Operation::Concatenate,
            inputs: inputs.iter().map(|input| (*input).to_owned()).collect(),
            output: vec![width],
            parameters: 0,
        }
    }

    /// Describes a layer without parameters, which takes one value.
    pub(crate) fn without_parameters(
        name: &str,
        operation: Operation,
        input: &str,
        output: Vec<usize>,
    ) -> Self {
        Self { name: name.to_owned(), operation, inputs: vec![input.to_owned()], output, parameters: 0 }
    }

    /// Returns the layer with `prefix` before the names of its tensors.
    fn prefixed(mut self, prefix: &str) -> Self {
        let names: Vec<&mut String> = match &mut self.operation {
            Operation::Concatenate
            | Operation::Columns { .. }
            | Operation::Objects { .. }
            | Operation::SumAndMaximum { .. }
            | Operation::Average { .. }
            | Operation::Flatten
            | Operation::Reshape
            | Operation::ProductOfExperts { .. }
            | Operation::LastSamples { .. } => Vec::new(),
            Operation::Dense { weights, bias, .. } => weights.iter_mut().chain([bias]).collect(),
            Operation::GatedRecurrentUnit { input_weight, input_bias, hidden_weight, hidden_bias } => {
                vec![input_weight, input_bias, hidden_weight, hidden_bias]
            }
            Operation::Convolution(Convolution { weight, bias, .. })
            | Operation::TransposedConvolution(Convolution { weight, bias, .. })
            | Operation::LayerNormalization { weight, bias, .. } => vec![weight, bias],
        };
        names.into_iter().for_each(|name| *name = format!("{prefix}.{name}"));
        self
    }
}

impl Description {
    /// Returns the description as JSON.
    pub fn json(&self) -> String {
        serde_json::to_string(self).expect("it has no maps, and its numbers are finite")
    }

    /// Describes the network that `architecture` builds for `task`, which was trained to predict in this window.
    pub fn new(
        architecture: &Architecture,
        task: Task,
        action: Action,
        losses: &BTreeMap<Modality, Loss>,
        normalizers: &Normalizers,
        window: &Window,
    ) -> Result<Self> {
        let named = |layers: Vec<Layer>, prefix: &str| -> Vec<Layer> {
            layers.into_iter().map(|layer| layer.prefixed(prefix)).collect()
        };
        let encodes = task == Task::Prediction;
        let inputs = places(architecture, &architecture.input, [VECTORS, IMAGES]);
        let encoder = architecture.encoder_layers()?;
        let memory = architecture.memory_layers()?;
        let (heads, _) = heads(architecture, &architecture.parts(&architecture.output)[0]);
        let output = |quantity: Quantity| {
            let name = quantity.name;
            let minimum = normalizers
                .modalities
                .get(&name)
                .and_then(|Normalizer { minimum, .. }| minimum.map(f64::from));
            // A reconstruction is trained with the squared error.
            let Definition { category: softmax, unit_vectors, .. } = architecture.layout[name];
            let loss = losses.get(&name).copied().filter(|_| encodes).unwrap_or_default();
            let loss = match (softmax, unit_vectors) {
                (true, _) => CROSS_ENTROPY,
                (_, true) => COSINE,
                _ => loss.name(),
            };
            let change = (encodes && normalizers.changes.contains_key(&name)).then(|| change_of(name));
            let distribution = heads.get(&name).map(|head| Predicted {
                family: head.family,
                start: head.parameters,
                least_scale: LEAST_SCALE,
                greatest_logarithm: GREATEST_LOGARITHM,
                threshold: (head.family == Family::Hurdle).then_some(THRESHOLD_N),
                levels: normalizers.levels.get(&name).cloned(),
            });
            Output { quantity, change, minimum, loss, softmax, distribution }
        };
        // The names of the decoder's last layers.
        let outputs = places(architecture, &architecture.output, ["vector", "conv"]);
        let outputs: Vec<Output> = outputs.into_iter().map(output).collect();
        let format = match encodes {
            _ if outputs.iter().any(|output| output.softmax) => FORMAT_WITH_CATEGORIES,
            true if !heads.is_empty() => FORMAT_WITH_DISTRIBUTIONS,
            true if outputs.iter().any(|output| output.change.is_some()) => FORMAT_WITH_CHANGES,
            true if !memory.is_empty() => FORMAT_WITH_MEMORY,
            _ => FORMAT,
        };
        let remembers_action = encodes && !memory.is_empty() && !architecture.layout.action().is_empty();
        let takes_action = architecture.action > 0 || remembers_action;
        Ok(Self {
            format,
            task: task.name(),
            estimates_present: encodes && window.horizon == 0,
            latent: architecture.latent,
            images: Images::default(),
            inputs: if encodes { inputs } else { Vec::new() },
            action: takes_action.then(|| ActionTaken {
                form: action,
                elements: architecture.layout.action().to_vec(),
                scale: Scale::of(ACTION),
            }),
            outputs,
            encoder: if encodes { named(encoder, "encoder") } else { Vec::new() },
            memory: if encodes { named(memory, "memory") } else { Vec::new() },
            decoder: named(architecture.decoder_layers()?, "decoder"),
        })
    }
}

/// Describes `modalities`. Vectors lie side by side in the first of `values`, and images in the second one.
fn places(
    architecture: &Architecture,
    modalities: &[Modality],
    [vectors, images]: [&'static str; 2],
) -> Vec<Quantity> {
    let (mut column, mut channel) = (0, 0);
    let place = |name: &Modality| {
        let definition = &architecture.layout[*name];
        let (shape, value, next, len) = match definition.size() {
            Some([rows, columns]) => {
                (vec![rows, columns, IMAGE_CHANNELS], images, &mut channel, IMAGE_CHANNELS)
            }
            None => (vec![definition.width()], vectors, &mut column, definition.width()),
        };
        let start = *next;
        *next += len;
        Quantity {
            name: *name,
            meaning: definition.meaning.clone(),
            shape,
            kind: definition.kind.clone(),
            difference_of: definition.difference_of,
            value,
            start,
            scale: Scale::of(name.name()),
        }
    };
    modalities.iter().map(place).collect()
}
