//! The conditional variational auto-encoder: encoder, posterior, decoder.
//!
//! Source: sections II and IV-A of the paper. The encoder maps an observation to a diagonal Gaussian distribution over
//! the latent state. The decoder maps a latent state and an action to the next observation. [`Architecture`] describes
//! their layers. Training and prediction use only the traits [`Encoder`] and [`Decoder`].

mod decoder;
pub mod description;
mod encoder;
mod layers;

use super::ops::{self, Arithmetic, Dropout};
use super::random::Random;
use crate::frames::Frames;
use candle_core::{DType, Device, Result, Tensor, Var};
use description::Layer;
use harness_spec::{IMAGE_CHANNELS, Layout, Loss, Modality, Network, RunSpec, Task};
use layers::{Builder, Made};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Parameters by name, sorted by name.
pub type Parameters = BTreeMap<String, Var>;

/// Everything that determines a network's parameters and how it is computed.
#[derive(Debug, Clone, PartialEq)]
pub struct Architecture {
    /// Modalities of the encoder's input.
    pub input: Vec<Modality>,
    /// Modalities that the decoder predicts.
    pub output: Vec<Modality>,
    /// Definitions of the modalities and of the action.
    pub layout: Arc<Layout>,
    /// Size of the latent state.
    pub latent: usize,
    /// Width of the action that the decoder gets; 0 for a decoder without an action.
    pub action: usize,
    /// The kinds of layers and their widths.
    pub network: Network,
    /// How matrix products are computed.
    pub arithmetic: Arithmetic,
}

/// Returns the network that a run trains for `task` on a dataset with this layout.
pub fn architecture(spec: &RunSpec, layout: &Arc<Layout>, task: Task) -> Architecture {
    let (output, action) = match task {
        Task::Prediction => (&spec.output, layout.action().len()),
        Task::Reconstruction => (&spec.input, 0),
    };
    Architecture {
        input: spec.input.clone(),
        output: output.clone(),
        layout: layout.clone(),
        latent: spec.latent,
        action,
        network: spec.network.clone(),
        arithmetic: ops::arithmetic(spec.training.tiles, spec.training.precision),
    }
}

impl Architecture {
    /// Creates an encoder. Its parameters are added to `parameters`, under names that begin with `encoder.`.
    pub fn encoder(
        &self,
        parameters: &mut Parameters,
        random: &mut Random,
        device: &Device,
    ) -> Result<Box<dyn Encoder>> {
        encoder::build(self, &mut self.builder("encoder", Made::Variables { parameters, random, device }))
    }

    /// Creates a decoder. Its parameters are added to `parameters`, under names that begin with `decoder.`.
    pub fn decoder(
        &self,
        parameters: &mut Parameters,
        random: &mut Random,
        device: &Device,
    ) -> Result<Box<dyn Decoder>> {
        decoder::build(self, &mut self.builder("decoder", Made::Variables { parameters, random, device }))
    }

    /// Lists all layers with parameters of the encoder and the decoder in the order in which they are applied. Creates no parameters.
    pub fn summary(&self) -> Result<Summary> {
        let trained = |mut layers: Vec<Layer>| {
            layers.retain(|layer| layer.parameters > 0);
            layers
        };
        Ok(Summary {
            encoder: trained(self.encoder_layers()?),
            decoder: trained(self.decoder_layers()?),
            observed: self
                .input
                .iter()
                .chain(&self.output)
                .map(|modality| self.layout[*modality].width())
                .sum(),
        })
    }

    /// Describes the encoder's layers in the order in which they are applied. Creates no parameters.
    fn encoder_layers(&self) -> Result<Vec<Layer>> {
        encoder::build(self, &mut self.builder("encoder", Made::Shapes))?.layers()
    }

    /// Describes the decoder's layers in the order in which they are applied. Creates no parameters.
    fn decoder_layers(&self) -> Result<Vec<Layer>> {
        decoder::build(self, &mut self.builder("decoder", Made::Shapes))?.layers()
    }

    fn builder<'a>(&self, prefix: &'static str, made: Made<'a>) -> Builder<'a> {
        Builder { made, prefix, arithmetic: self.arithmetic }
    }

    fn is_image(&self, modality: Modality) -> bool {
        self.layout[modality].is_image()
    }

    /// Returns the total width of all vectors among `modalities`.
    fn vector_width(&self, modalities: &[Modality]) -> usize {
        let vectors = modalities.iter().filter(|modality| !self.is_image(**modality));
        vectors.map(|modality| self.layout[*modality].width()).sum()
    }

    /// Returns the number of channels of all images among `modalities`, and their common rows and columns in pixels. All are 0 if
    /// there are no images.
    fn images(&self, modalities: &[Modality]) -> (usize, [usize; 2]) {
        let images = modalities.iter().filter_map(|modality| self.layout[*modality].size());
        images.fold((0, [0, 0]), |(channels, _), size| (channels + IMAGE_CHANNELS, size))
    }
}

/// Maps an observation to a posterior over the latent state.
pub trait Encoder: Send + Sync {
    /// Returns the posterior of a batch. `dropout` is applied to the output of the convolutions.
    fn encode_with_dropout(&self, observation: &Observation, dropout: Option<Dropout>) -> Result<Posterior>;

    /// Returns the posterior of a batch, without dropout.
    fn encode(&self, observation: &Observation) -> Result<Posterior> {
        self.encode_with_dropout(observation, None)
    }

    /// Returns the same encoder over the same parameters, for which no gradients are computed.
    fn detached(&self) -> Box<dyn Encoder>;

    /// Describes the layers in the order in which they are applied.
    fn layers(&self) -> Result<Vec<Layer>>;
}

/// Maps a latent state, and an action if the decoder has one, to an observation.
pub trait Decoder: Send + Sync {
    /// Returns the normalized observation. On the CPU its frames have no gradient.
    fn decode(&self, latent: &Tensor, action: Option<&Tensor>) -> Result<Decoded>;

    /// Returns the mean loss of every output modality against `targets`, on normalized values.
    fn losses(&self, latent: &Tensor, action: Option<&Tensor>, targets: &Targets) -> Result<Vec<Term>>;

    /// Returns the same decoder over the same parameters, for which no gradients are computed.
    fn detached(&self) -> Box<dyn Decoder>;

    /// Describes the layers in the order in which they are applied.
    fn layers(&self) -> Result<Vec<Layer>>;
}

/// The layers of a network that have parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// Layers of the encoder, in the order in which they are applied.
    pub encoder: Vec<Layer>,
    /// Layers of the decoder, in the order in which they are applied.
    pub decoder: Vec<Layer>,
    /// Number of values in one sample's input and output.
    observed: usize,
}

impl Summary {
    fn layers(&self) -> impl Iterator<Item = &Layer> {
        self.encoder.iter().chain(&self.decoder)
    }

    /// Returns the number of trained values in the encoder and the decoder.
    pub fn parameters(&self) -> usize {
        self.layers().map(|layer| layer.parameters).sum()
    }

    /// Returns the number of values that all layers produce for one sample, including the input and output.
    pub fn activations(&self) -> usize {
        self.observed + self.layers().map(|layer| layer.output.iter().product::<usize>()).sum::<usize>()
    }
}

/// A decoder's output for a batch, normalized.
pub struct Decoded {
    /// Vectors side by side, `[batch, width]`.
    pub vector: Option<Tensor>,
    /// Frames stacked by channel, `[batch, channels, rows, columns]`.
    pub frames: Option<Tensor>,
}

/// The loss of one output modality.
pub struct Term {
    /// The output modality.
    pub modality: Modality,
    /// Mean loss over the batch, a scalar.
    pub value: Tensor,
}

/// The normalized observation that a decoder should predict. All modalities have the order of the output.
pub struct Targets {
    /// Vectors side by side, `[batch, width]`.
    pub vector: Option<Tensor>,
    /// Loss of each vector modality. Modalities that are not listed, and all frames, use the squared error.
    pub losses: BTreeMap<Modality, Loss>,
    /// The frames of each image modality.
    pub frames: Vec<(Modality, Arc<dyn Frames>)>,
}

/// A normalized observation of a batch.
#[derive(Clone)]
pub struct Observation {
    /// Vectors side by side, `[batch, width]`; `None` if there are none.
    pub vector: Option<Tensor>,
    /// Frames stacked by channel; `None` if there are none.
    pub frames: Option<Arc<dyn Frames>>,
}

/// A diagonal Gaussian distribution over the latent state: the means followed by the log-variances,
/// `[batch, 2 * latent]`.
pub struct Posterior(Tensor);

impl Posterior {
    /// Returns the size of the latent state.
    pub fn latent(&self) -> Result<usize> {
        Ok(self.0.dim(1)? / 2)
    }

    /// Returns the means, `[batch, latent]`.
    pub fn mean(&self) -> Result<Tensor> {
        let latent = self.latent()?;
        self.0.narrow(1, 0, latent)?.contiguous()
    }

    /// Returns the log-variances, `[batch, latent]`.
    pub fn log_variance(&self) -> Result<Tensor> {
        let latent = self.latent()?;
        self.0.narrow(1, latent, latent)?.contiguous()
    }

    /// Draws latent states, `[batch, latent]`. `noise` is standard normal and has the same shape.
    pub fn sample(&self, noise: &Tensor) -> Result<Tensor> {
        ops::sample(&self.0, noise)
    }

    /// Returns the divergence from the standard normal distribution in nats, averaged over the batch; a scalar.
    pub fn kl_divergence(&self) -> Result<Tensor> {
        ops::kl_divergence(&self.0)
    }
}

/// Returns the value of a scalar tensor.
pub fn scalar(tensor: &Tensor) -> Result<f64> {
    tensor.to_dtype(DType::F64)?.to_scalar()
}
