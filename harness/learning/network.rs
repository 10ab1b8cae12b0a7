//! The conditional variational auto-encoder: encoder, posterior, decoder.
//!
//! Source: the paper's learning architecture (sections II and IV-A). The encoder maps an observation to a
//! diagonal Gaussian over the latent state; the decoder maps a latent state and an action to the next
//! observation. Vectors pass two fully connected layers on each side; frames pass a 4 x 4 convolution of
//! stride 2 before them, and its transpose after them.

use super::ops::{
    self, Dropout, FrameDecoder, TwoLayers, frame_decoder, frame_encoder, frame_loss, linear, squared_errors,
    two_layers,
};
use super::random::Random;
use crate::dataset::frames::Frames;
use crate::spec::{FRAME_SIDE, Modality, Precision};
use candle_core::{DType, Device, Result, Tensor, Var};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Named parameters, in the order of their names.
pub type Parameters = BTreeMap<String, Var>;

/// What decides a network's parameters, and how it is computed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sizes {
    /// What the encoder is given.
    pub input: Vec<Modality>,
    /// What the decoder predicts.
    pub output: Vec<Modality>,
    pub latent: usize,
    /// Units of the hidden layer on each side.
    pub hidden: usize,
    /// Channels of the convolution on each side.
    pub channels: usize,
    /// Width of the condition; 0 for a decoder without one.
    pub action: usize,
    /// Of the products of the two large layers, beside the convolutions.
    pub precision: Precision,
}

impl Sizes {
    fn vector(modalities: &[Modality]) -> usize {
        modalities.iter().filter(|modality| !modality.is_frame()).map(|modality| modality.width()).sum()
    }

    fn frame_channels(modalities: &[Modality]) -> usize {
        modalities.iter().filter(|modality| modality.is_frame()).count() * crate::spec::FRAME_CHANNELS
    }

    /// Values that are trained, of the encoder and the decoder.
    pub fn parameters(&self) -> usize {
        let (hidden, latent) = (self.hidden, self.latent);
        // Weights and biases; a layer without outputs is left out.
        let layer = |inputs: usize, outputs: usize| (inputs + usize::from(outputs > 0)) * outputs;
        let (seen, shown) = (Self::frame_channels(&self.input), Self::frame_channels(&self.output));
        let kernel = |channels: usize, biases: usize| {
            if channels > 0 { self.channels * channels * 16 + biases } else { 0 }
        };
        let coarse = |channels: usize| if channels > 0 { self.coarse() } else { 0 };
        kernel(seen, self.channels)
            + layer(Self::vector(&self.input) + coarse(seen), hidden)
            + layer(hidden, 2 * latent)
            + layer(latent + self.action, hidden)
            + layer(hidden, Self::vector(&self.output))
            + layer(hidden, coarse(shown))
            + kernel(shown, shown)
    }

    /// Values that all layers together make of a sample, what goes in and comes out included.
    pub fn activations(&self) -> usize {
        let observation = |modalities: &[Modality]| {
            let coarse = if Self::frame_channels(modalities) > 0 { self.coarse() } else { 0 };
            modalities.iter().map(|modality| modality.width()).sum::<usize>() + coarse + self.hidden
        };
        observation(&self.input) + 3 * self.latent + self.action + observation(&self.output)
    }

    /// Values that the convolution makes of a frame.
    fn coarse(&self) -> usize {
        self.channels * (FRAME_SIDE / 2) * (FRAME_SIDE / 2)
    }
}

/// An observation of a batch, standardised: vectors side by side `[batch, width]`, frames stacked by channel.
#[derive(Clone)]
pub struct Observation {
    pub vector: Option<Tensor>,
    pub frames: Option<Arc<dyn Frames>>,
}

/// A diagonal Gaussian over the latent state: means beside log-variances, `[batch, 2 * latent]`.
pub struct Posterior(Tensor);

impl Posterior {
    /// `[batch, latent]`.
    pub fn mean(&self) -> Result<Tensor> {
        let latent = self.0.dim(1)? / 2;
        self.0.narrow(1, 0, latent)?.contiguous()
    }

    /// `[batch, latent]`.
    pub fn log_variance(&self) -> Result<Tensor> {
        let latent = self.0.dim(1)? / 2;
        self.0.narrow(1, latent, latent)?.contiguous()
    }

    /// Latent states `[batch, latent]` for standard normal `noise` of that shape.
    pub fn sample(&self, noise: &Tensor) -> Result<Tensor> {
        ops::sample(&self.0, noise)
    }

    /// Divergence from the standard normal distribution, nats, averaged over the batch; a scalar.
    pub fn divergence(&self) -> Result<Tensor> {
        ops::divergence(&self.0)
    }
}

/// Weight and bias of a layer.
struct Layer {
    weight: Tensor,
    bias: Tensor,
}

impl Layer {
    fn detached(&self) -> Self {
        Self { weight: self.weight.detach(), bias: self.bias.detach() }
    }
}

/// Makes a network's parameters.
struct Builder<'a> {
    parameters: &'a mut Parameters,
    random: &'a mut Random,
    device: &'a Device,
    prefix: &'static str,
}

impl Builder<'_> {
    /// A parameter, uniform in ±1/√`fan_in`: PyTorch's default for linear and convolutional layers.
    fn parameter(&mut self, name: &str, shape: &[usize], fan_in: usize) -> Result<Tensor> {
        let values = self.random.uniform(shape.iter().product(), 1.0 / (fan_in as f32).sqrt());
        let var = Var::from_tensor(&Tensor::from_vec(values, shape, self.device)?)?;
        let tensor = var.as_tensor().clone();
        self.parameters.insert(format!("{}.{name}", self.prefix), var);
        Ok(tensor)
    }

    fn layer(&mut self, name: &str, shape: &[usize], bias: usize, fan_in: usize) -> Result<Layer> {
        Ok(Layer {
            weight: self.parameter(&format!("{name}.weight"), shape, fan_in)?,
            bias: self.parameter(&format!("{name}.bias"), &[bias], fan_in)?,
        })
    }

    fn linear(&mut self, name: &str, outputs: usize, inputs: usize) -> Result<Layer> {
        self.layer(name, &[outputs, inputs], outputs, inputs)
    }
}

/// From an observation to a posterior.
pub struct Encoder {
    convolution: Option<Layer>,
    /// The hidden layer's weights for the frames and for the vectors: one fully connected layer in two blocks, each
    /// initialised by its own fan-in. By their joint one, a few joint angles would begin unheard among thousands of
    /// pixels' values.
    hidden_frame: Option<Tensor>,
    hidden_vector: Option<Tensor>,
    hidden_bias: Tensor,
    posterior: Layer,
    precision: Precision,
}

impl Encoder {
    /// A new encoder; its parameters join `parameters` as `encoder.…`.
    pub fn new(
        sizes: &Sizes,
        parameters: &mut Parameters,
        random: &mut Random,
        device: &Device,
    ) -> Result<Self> {
        let mut build = Builder { parameters, random, device, prefix: "encoder" };
        let vector = Sizes::vector(&sizes.input);
        let channels = Sizes::frame_channels(&sizes.input);
        let coarse = if channels > 0 { sizes.coarse() } else { 0 };
        let convolution = (channels > 0)
            .then(|| build.layer("conv", &[sizes.channels, channels, 4, 4], sizes.channels, channels * 16))
            .transpose()?;
        let hidden = sizes.hidden;
        Ok(Self {
            convolution,
            hidden_frame: (channels > 0)
                .then(|| build.parameter("hidden_frame.weight", &[hidden, coarse], coarse))
                .transpose()?,
            hidden_vector: (vector > 0)
                .then(|| build.parameter("hidden_vector.weight", &[hidden, vector], vector))
                .transpose()?,
            hidden_bias: build.parameter("hidden.bias", &[hidden], vector + coarse)?,
            posterior: build.linear("posterior", 2 * sizes.latent, hidden)?,
            precision: sizes.precision,
        })
    }

    /// The same encoder over the same parameters, for which no gradients are computed.
    pub fn detached(&self) -> Self {
        Self {
            convolution: self.convolution.as_ref().map(Layer::detached),
            hidden_frame: self.hidden_frame.as_ref().map(Tensor::detach),
            hidden_vector: self.hidden_vector.as_ref().map(Tensor::detach),
            hidden_bias: self.hidden_bias.detach(),
            posterior: self.posterior.detached(),
            precision: self.precision,
        }
    }

    /// Size of the latent state.
    pub fn latent(&self) -> Result<usize> {
        Ok(self.posterior.bias.dim(0)? / 2)
    }

    /// The posterior of a batch.
    pub fn encode(&self, observation: &Observation) -> Result<Posterior> {
        self.encode_with_dropout(observation, None)
    }

    /// The posterior of a batch, where `dropout` leaves out some of what the convolution makes of the frames.
    pub fn encode_with_dropout(
        &self,
        observation: &Observation,
        dropout: Option<Dropout>,
    ) -> Result<Posterior> {
        let vector = observation.vector.as_ref().zip(self.hidden_vector.as_ref());
        let frames =
            observation.frames.as_ref().zip(self.convolution.as_ref()).zip(self.hidden_frame.as_ref());
        if let (Some((vector, weight)), None) = (vector, frames) {
            let layers = TwoLayers {
                hidden_weight: weight.clone(),
                hidden_bias: self.hidden_bias.clone(),
                weight: self.posterior.weight.clone(),
                bias: self.posterior.bias.clone(),
            };
            return Ok(Posterior(two_layers(vector, layers)?));
        }
        let mut hidden =
            vector.map(|(vector, weight)| linear(vector, weight, &self.hidden_bias, false)).transpose()?;
        if let Some(((frames, Layer { weight: kernel, bias }), weight)) = frames {
            let seen = frame_encoder(frames.clone(), kernel, bias, weight, self.precision, dropout)?;
            let sum = match hidden {
                Some(hidden) => (hidden + seen)?,
                None => seen.broadcast_add(&self.hidden_bias)?,
            };
            hidden = Some(sum.relu()?);
        }
        let Some(hidden) = hidden else {
            candle_core::bail!("the observation lacks what the encoder is given")
        };
        Ok(Posterior(linear(&hidden, &self.posterior.weight, &self.posterior.bias, false)?))
    }
}

/// From a latent state, and an action, to an observation.
pub struct Decoder {
    output: Vec<Modality>,
    hidden: Layer,
    vector: Option<Layer>,
    frame: Option<Layer>,
    convolution: Option<Layer>,
    precision: Precision,
}

/// One named term of a loss: the mean squared error of a modality, a scalar.
pub struct Term {
    pub modality: Modality,
    pub value: Tensor,
}

impl Decoder {
    /// A new decoder; its parameters join `parameters` as `decoder.…`.
    pub fn new(
        sizes: &Sizes,
        parameters: &mut Parameters,
        random: &mut Random,
        device: &Device,
    ) -> Result<Self> {
        let mut build = Builder { parameters, random, device, prefix: "decoder" };
        let vector = Sizes::vector(&sizes.output);
        let channels = Sizes::frame_channels(&sizes.output);
        let hidden = build.linear("hidden", sizes.hidden, sizes.latent + sizes.action)?;
        let vector = (vector > 0).then(|| build.linear("vector", vector, sizes.hidden)).transpose()?;
        let frame =
            (channels > 0).then(|| build.linear("frame", sizes.coarse(), sizes.hidden)).transpose()?;
        // A transposed convolution's fan-in, as PyTorch counts it, is taken over its output channels.
        let convolution = (channels > 0)
            .then(|| build.layer("conv", &[sizes.channels, channels, 4, 4], channels, channels * 16))
            .transpose()?;
        Ok(Self {
            output: sizes.output.clone(),
            hidden,
            vector,
            frame,
            convolution,
            precision: sizes.precision,
        })
    }

    /// The same decoder over the same parameters, for which no gradients are computed.
    pub fn detached(&self) -> Self {
        Self {
            output: self.output.clone(),
            hidden: self.hidden.detached(),
            vector: self.vector.as_ref().map(Layer::detached),
            frame: self.frame.as_ref().map(Layer::detached),
            convolution: self.convolution.as_ref().map(Layer::detached),
            precision: self.precision,
        }
    }

    /// What the decoder is given: `latent` `[batch, latent]`, and beside it the action `[batch, action]` if it has one.
    fn condition(latent: &Tensor, action: Option<&Tensor>) -> Result<Tensor> {
        match action {
            Some(action) => Tensor::cat(&[latent, action], 1),
            None => Ok(latent.clone()),
        }
    }

    /// The hidden layer, where frames share it with the vectors.
    fn shared_hidden(&self, condition: &Tensor) -> Result<Option<Tensor>> {
        let Layer { weight, bias } = &self.hidden;
        self.frame.as_ref().map(|_| linear(condition, weight, bias, true)).transpose()
    }

    /// The vectors side by side `[batch, width]`, `None` where the output has none.
    fn vector(&self, condition: &Tensor, hidden: Option<&Tensor>) -> Result<Option<Tensor>> {
        let Some(Layer { weight, bias }) = &self.vector else { return Ok(None) };
        let vector = match hidden {
            Some(hidden) => linear(hidden, weight, bias, false)?,
            None => {
                let layers = TwoLayers {
                    hidden_weight: self.hidden.weight.clone(),
                    hidden_bias: self.hidden.bias.clone(),
                    weight: weight.clone(),
                    bias: bias.clone(),
                };
                two_layers(condition, layers)?
            }
        };
        Ok(Some(vector))
    }

    /// The standardised observation: vectors `[batch, width]` and frames `[batch, channels, 64, 64]`.
    pub fn decode(
        &self,
        latent: &Tensor,
        action: Option<&Tensor>,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let condition = Self::condition(latent, action)?;
        let hidden = self.shared_hidden(&condition)?;
        let decoder = self.frame_decoder(0, Sizes::frame_channels(&self.output))?;
        let frames =
            hidden.as_ref().zip(decoder).map(|(hidden, decoder)| frame_decoder(hidden, &decoder, FRAME_SIDE));
        Ok((self.vector(&condition, hidden.as_ref())?, frames.transpose()?))
    }

    /// The way from the hidden layer to `channels` channels of the frames, from `first` on.
    fn frame_decoder(&self, first: usize, channels: usize) -> Result<Option<FrameDecoder>> {
        let (Some(frame), Some(convolution)) = (&self.frame, &self.convolution) else { return Ok(None) };
        Ok(Some(FrameDecoder {
            weight: frame.weight.clone(),
            bias: frame.bias.clone(),
            kernel: convolution.weight.narrow(1, first, channels)?.contiguous()?,
            kernel_bias: convolution.bias.narrow(0, first, channels)?,
            precision: self.precision,
        }))
    }

    /// The mean squared error of every output modality against `targets`, on standardised values.
    ///
    /// `targets` holds the vectors side by side, and the frames of each frame modality on their own, all in
    /// the order of the output.
    pub fn losses(&self, latent: &Tensor, action: Option<&Tensor>, targets: &Targets) -> Result<Vec<Term>> {
        let condition = Self::condition(latent, action)?;
        let hidden = self.shared_hidden(&condition)?;
        let mut terms = Vec::with_capacity(self.output.len());
        if let (Some(predicted), Some(target)) = (self.vector(&condition, hidden.as_ref())?, &targets.vector)
        {
            let modalities: Vec<Modality> =
                self.output.iter().copied().filter(|modality| !modality.is_frame()).collect();
            let widths: Vec<usize> = modalities.iter().map(|modality| modality.width()).collect();
            let errors = squared_errors(&predicted, target, &widths)?;
            for (index, modality) in modalities.into_iter().enumerate() {
                terms.push(Term { modality, value: errors.get(index)? });
            }
        }
        let mut first = 0;
        for (modality, target) in &targets.frames {
            let channels = target.channels();
            if let (Some(hidden), Some(decoder)) = (&hidden, self.frame_decoder(first, channels)?) {
                terms.push(Term { modality: *modality, value: frame_loss(hidden, decoder, target.clone())? });
            }
            first += channels;
        }
        Ok(terms)
    }
}

/// What a decoder should have predicted, standardised.
pub struct Targets {
    pub vector: Option<Tensor>,
    pub frames: Vec<(Modality, Arc<dyn Frames>)>,
}

/// The value of a scalar tensor.
pub fn scalar(tensor: &Tensor) -> Result<f64> {
    tensor.to_dtype(DType::F64)?.to_scalar()
}
