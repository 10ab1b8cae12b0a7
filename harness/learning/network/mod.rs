//! The conditional variational auto-encoder: encoder, posterior, decoder.
//!
//! Source: the paper's learning architecture (sections II and IV-A). The encoder maps an observation to a
//! diagonal Gaussian over the latent state; the decoder maps a latent state and an action to the next
//! observation. [`Architecture`] says of which layers they are made; whoever trains or uses them knows the traits
//! [`Encoder`] and [`Decoder`] alone.

mod decoder;
mod encoder;
mod layers;

use super::ops::{self, Arithmetic, Dropout};
use super::random::Random;
use crate::frames::Frames;
use candle_core::{DType, Device, Result, Tensor, Var};
use harness_spec::{IMAGE_CHANNELS, Layout, Loss, Modality, Network, RunSpec, Task};
use layers::{Builder, Made};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Named parameters, in the order of their names.
pub type Parameters = BTreeMap<String, Var>;

/// What decides a network's parameters, and how it is computed.
#[derive(Debug, Clone, PartialEq)]
pub struct Architecture {
    /// What the encoder is given.
    pub input: Vec<Modality>,
    /// What the decoder predicts.
    pub output: Vec<Modality>,
    /// What is known of both.
    pub layout: Arc<Layout>,
    pub latent: usize,
    /// Width of the condition; 0 for a decoder without one.
    pub action: usize,
    /// Layers and their widths.
    pub network: Network,
    pub arithmetic: Arithmetic,
}

/// The network that a run trains for a task on a dataset of this layout.
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
    /// A new encoder; its parameters join `parameters` as `encoder.…`.
    pub fn encoder(
        &self,
        parameters: &mut Parameters,
        random: &mut Random,
        device: &Device,
    ) -> Result<Box<dyn Encoder>> {
        encoder::build(self, &mut self.builder("encoder", Made::Variables { parameters, random, device }))
    }

    /// A new decoder; its parameters join `parameters` as `decoder.…`.
    pub fn decoder(
        &self,
        parameters: &mut Parameters,
        random: &mut Random,
        device: &Device,
    ) -> Result<Box<dyn Decoder>> {
        decoder::build(self, &mut self.builder("decoder", Made::Variables { parameters, random, device }))
    }

    /// All layers of the encoder and of the decoder, in the order in which they are applied. No parameter is made.
    pub fn summary(&self) -> Result<Summary> {
        Ok(Summary {
            encoder: encoder::build(self, &mut self.builder("encoder", Made::Shapes))?.layers()?,
            decoder: decoder::build(self, &mut self.builder("decoder", Made::Shapes))?.layers()?,
            observed: self
                .input
                .iter()
                .chain(&self.output)
                .map(|modality| self.layout[*modality].width())
                .sum(),
        })
    }

    fn builder<'a>(&self, prefix: &'static str, made: Made<'a>) -> Builder<'a> {
        Builder { made, prefix, arithmetic: self.arithmetic }
    }

    fn is_image(&self, modality: Modality) -> bool {
        self.layout[modality].is_image()
    }

    /// Values of all vectors among `modalities`.
    fn vector_width(&self, modalities: &[Modality]) -> usize {
        let vectors = modalities.iter().filter(|modality| !self.is_image(**modality));
        vectors.map(|modality| self.layout[*modality].width()).sum()
    }

    /// Channels of all images among `modalities`, and the side that they share; 0 where there are none.
    fn images(&self, modalities: &[Modality]) -> (usize, usize) {
        let images = modalities.iter().filter_map(|modality| self.layout[*modality].size());
        images.fold((0, 0), |(channels, _), [side, _]| (channels + IMAGE_CHANNELS, side))
    }
}

/// From an observation to a posterior over the latent state.
pub trait Encoder: Send + Sync {
    /// The posterior of a batch, where `dropout` leaves out some of what the convolutions make of the frames.
    fn encode_with_dropout(&self, observation: &Observation, dropout: Option<Dropout>) -> Result<Posterior>;

    /// The posterior of a batch.
    fn encode(&self, observation: &Observation) -> Result<Posterior> {
        self.encode_with_dropout(observation, None)
    }

    /// The same encoder over the same parameters, for which no gradients are computed.
    fn detached(&self) -> Box<dyn Encoder>;

    /// Its layers, in the order in which they are applied.
    fn layers(&self) -> Result<Vec<LayerSummary>>;
}

/// From a latent state, and an action where it has one, to an observation.
pub trait Decoder: Send + Sync {
    /// The normalized observation, without gradients for frames.
    fn decode(&self, latent: &Tensor, action: Option<&Tensor>) -> Result<Decoded>;

    /// The mean loss of every output modality against `targets`, on normalized values.
    fn losses(&self, latent: &Tensor, action: Option<&Tensor>, targets: &Targets) -> Result<Vec<Term>>;

    /// The same decoder over the same parameters, for which no gradients are computed.
    fn detached(&self) -> Box<dyn Decoder>;

    /// Its layers, in the order in which they are applied.
    fn layers(&self) -> Result<Vec<LayerSummary>>;
}

/// A layer as people want to know it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LayerSummary {
    /// As its parameters are called, without what all of an encoder's or a decoder's have before it.
    pub name: String,
    /// Shape of one sample's output: `[width]` or `[channels, rows, columns]`.
    pub output: Vec<usize>,
    /// Parameters, weights and biases together.
    pub parameters: usize,
}

/// The layers of a network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Summary {
    pub encoder: Vec<LayerSummary>,
    pub decoder: Vec<LayerSummary>,
    /// Values of one sample's input and output.
    observed: usize,
}

impl Summary {
    fn layers(&self) -> impl Iterator<Item = &LayerSummary> {
        self.encoder.iter().chain(&self.decoder)
    }

    /// Values that are trained, of the encoder and the decoder.
    pub fn parameters(&self) -> usize {
        self.layers().map(|layer| layer.parameters).sum()
    }

    /// Values that all layers together make of one sample, what goes in and comes out included.
    pub fn activations(&self) -> usize {
        self.observed + self.layers().map(|layer| layer.output.iter().product::<usize>()).sum::<usize>()
    }
}

/// What a decoder makes of a batch, normalized.
pub struct Decoded {
    /// Vectors side by side `[batch, width]`.
    pub vector: Option<Tensor>,
    /// Frames stacked by channel `[batch, channels, side, side]`.
    pub frames: Option<Tensor>,
}

/// One named term of a loss: the mean loss of a modality, a scalar.
pub struct Term {
    pub modality: Modality,
    pub value: Tensor,
}

/// What a decoder should have predicted, normalized: the vectors side by side, and the frames of each frame modality on
/// their own, all in the order of the output.
pub struct Targets {
    pub vector: Option<Tensor>,
    /// What the errors of the vectors' modalities cost; squared where nothing is said. Those of frames are squared.
    pub losses: BTreeMap<Modality, Loss>,
    pub frames: Vec<(Modality, Arc<dyn Frames>)>,
}

/// An observation of a batch, normalized: vectors side by side `[batch, width]`, frames stacked by channel.
#[derive(Clone)]
pub struct Observation {
    pub vector: Option<Tensor>,
    pub frames: Option<Arc<dyn Frames>>,
}

/// A diagonal Gaussian over the latent state: means beside log-variances, `[batch, 2 * latent]`.
pub struct Posterior(Tensor);

impl Posterior {
    /// Size of the latent state.
    pub fn latent(&self) -> Result<usize> {
        Ok(self.0.dim(1)? / 2)
    }

    /// `[batch, latent]`.
    pub fn mean(&self) -> Result<Tensor> {
        let latent = self.latent()?;
        self.0.narrow(1, 0, latent)?.contiguous()
    }

    /// `[batch, latent]`.
    pub fn log_variance(&self) -> Result<Tensor> {
        let latent = self.latent()?;
        self.0.narrow(1, latent, latent)?.contiguous()
    }

    /// Latent states `[batch, latent]` for standard normal `noise` of that shape.
    pub fn sample(&self, noise: &Tensor) -> Result<Tensor> {
        ops::sample(&self.0, noise)
    }

    /// Divergence from the standard normal distribution, nats, averaged over the batch; a scalar.
    pub fn kl_divergence(&self) -> Result<Tensor> {
        ops::kl_divergence(&self.0)
    }
}

/// The value of a scalar tensor.
pub fn scalar(tensor: &Tensor) -> Result<f64> {
    tensor.to_dtype(DType::F64)?.to_scalar()
}
