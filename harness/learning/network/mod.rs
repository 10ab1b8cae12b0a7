//! Networks that see samples and predict later ones, and the conditional variational auto-encoder.
//!
//! Training and prediction use only the trait [`Network`]. [`Architecture`] describes the layers of the auto-encoder,
//! and builds it. Source: sections II and IV-A of the paper. Its encoder maps an observation to a diagonal Gaussian
//! distribution over the latent state. Its decoder maps a latent state and an action to the next observation.

mod calibration;
mod cvae;
mod decoder;
pub mod description;
mod encoder;
mod gru;
mod head;
mod layers;
mod recurrent;
mod rssm;
mod unit;
mod vectors;
mod window;

pub use super::observation::{Keeping, Observation, Value};
pub use cvae::Cvae;
pub use recurrent::Recurrent;

use super::random::Random;
use candle_core::{Device, Result, Tensor, Var};
use description::Layer;
use harness_metrics::force::THRESHOLD_N;
use harness_ops::{self as ops, Arithmetic, Dropout, Values};
use harness_samples::Normalizers;
use harness_spec::{Family, Layout, Loss, Modality, ModalityDropout, RunSpec, Task, Trained, Window};
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
    /// Width of the action that the decoder gets; 0 for a decoder without an action. A memory gets that of the layout.
    pub action: usize,
    /// The kinds of layers and their widths.
    pub network: harness_spec::Network,
    /// How matrix products are computed.
    pub arithmetic: Arithmetic,
    /// For each output that is predicted as a change, the factors between its normalized change and its change in units
    /// of the normalized value, one for each element.
    pub changes: BTreeMap<Modality, Vec<f32>>,
    /// The outputs of which the decoder predicts a distribution.
    pub distributions: BTreeMap<Modality, Family>,
    /// For each output whose distribution is a hurdle, zero and the threshold of a contact as normalized values, one for
    /// each element.
    pub hurdles: BTreeMap<Modality, [Vec<f32>; 2]>,
}

/// Returns the network that a run trains for `task` on a dataset with this layout.
pub fn architecture(spec: &RunSpec, trained: &Trained, layout: &Arc<Layout>, task: Task) -> Architecture {
    let (output, action, distributions) = match task {
        Task::Prediction => {
            (spec.output.clone(), spec.action_width(layout), trained.training.distributions.clone())
        }
        Task::Reconstruction => (spec.reconstructed(), 0, BTreeMap::new()),
    };
    Architecture {
        input: spec.input.clone(),
        output,
        layout: layout.clone(),
        latent: trained.latent,
        action,
        network: trained.network.clone(),
        arithmetic: ops::arithmetic(trained.training.tiles, trained.training.precision),
        changes: BTreeMap::new(),
        distributions,
        hurdles: BTreeMap::new(),
    }
}

impl Architecture {
    /// Returns the network for values that are normalized so, which it must know to predict changes and hurdles.
    pub fn scaled(self, normalizers: &Normalizers) -> Self {
        let hurdles = self.distributions.iter().filter(|(_, family)| **family == Family::Hurdle);
        let normalized = |modality: &Modality, value: f32| {
            let scale = &normalizers.modalities[modality];
            let mut values = vec![value; scale.mean.len()];
            scale.normalize(&mut values);
            values
        };
        let bounds = |modality: &Modality| [0.0, THRESHOLD_N].map(|force| normalized(modality, force));
        let hurdles = hurdles.map(|(modality, _)| (*modality, bounds(modality))).collect();
        Self { hurdles, changes: normalizers.change_ratios(), ..self }
    }

    /// Creates the network that predicts. Its parameters are added to `parameters`, those of the encoder first.
    pub fn network(
        &self,
        parameters: &mut Parameters,
        random: &mut Random,
        device: &Device,
    ) -> Result<Box<dyn Network>> {
        let encoder = self.encoder(parameters, random, device)?;
        let decoder = self.decoder(parameters, random, device)?;
        let made = Made::Variables { parameters, random, device };
        Ok(match recurrent::unit(self, self.builder("memory", made))? {
            None => {
                let factors = |(modality, factors): (&Modality, &Vec<f32>)| {
                    Ok((*modality, Tensor::from_slice(factors, factors.len(), device)?))
                };
                let changes = self.changes.iter().map(factors).collect::<Result<_>>()?;
                Box::new(Cvae { encoder, decoder, input: self.input.clone(), changes, latent: self.latent })
            }
            Some(unit) => Box::new(Recurrent { encoder, unit, decoder, latent: self.latent }),
        })
    }

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

    /// Lists all layers with parameters in the order in which they are applied. Creates no parameters.
    pub fn summary(&self) -> Result<Summary> {
        let trained = |mut layers: Vec<Layer>| {
            layers.retain(|layer| layer.parameters > 0);
            layers
        };
        Ok(Summary {
            encoder: trained(self.encoder_layers()?),
            memory: trained(self.memory_layers()?),
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
    pub fn encoder_layers(&self) -> Result<Vec<Layer>> {
        encoder::build(self, &mut self.builder("encoder", Made::Shapes))?.layers()
    }

    /// Describes the memory's layers in the order in which they are applied; none without memory. Creates
    /// no parameters.
    pub fn memory_layers(&self) -> Result<Vec<Layer>> {
        let unit = recurrent::unit(self, self.builder("memory", Made::Shapes))?;
        unit.map_or_else(|| Ok(Vec::new()), |unit| unit.layers())
    }

    /// Describes the decoder's layers in the order in which they are applied. Creates no parameters.
    pub fn decoder_layers(&self) -> Result<Vec<Layer>> {
        decoder::build(self, &mut self.builder("decoder", Made::Shapes))?.layers()
    }

    fn builder<'a>(&self, prefix: &'static str, made: Made<'a>) -> Builder<'a> {
        Builder { made, prefix, arithmetic: self.arithmetic }
    }

    /// Returns the vectors and the images among `modalities`.
    fn parts(&self, modalities: &[Modality]) -> [Vec<Modality>; 2] {
        let (images, vectors) = modalities.iter().partition(|modality| self.layout[**modality].is_image());
        [vectors, images]
    }

    /// Returns the total width of these vectors.
    fn width(&self, vectors: &[Modality]) -> usize {
        vectors.iter().map(|modality| self.layout[*modality].width()).sum()
    }

    /// Returns the common rows and columns of these images in pixels; 0 without images.
    fn size(&self, images: &[Modality]) -> [usize; 2] {
        images.first().and_then(|image| self.layout[*image].size()).unwrap_or_default()
    }
}

/// What a network knows of a batch of episodes at one sample.
#[derive(Clone)]
pub struct State {
    /// The latent state, `[batch, latent]`, from which the sample is predicted.
    pub latent: Tensor,
    /// The action since the last sample, `[batch, elements]`, if the network's decoder takes it. `None` for a sample
    /// that the network has seen.
    pub action: Option<Tensor>,
    /// What the network has stored of earlier samples, `[batch, width]`; `None` without memory. Without memory, it is
    /// what predicted changes are added to, if there are any.
    pub memory: Option<Tensor>,
}

/// Returns the number of samples that a network sees of a training window: only the present one if it has no memory,
/// and thus no state before the first sample.
pub(crate) fn context(network: &dyn Network, window: &Window) -> usize {
    let has_memory = matches!(network.start(1, &Device::Cpu), Ok(Some(_)));
    if has_memory { window.context } else { 1 }
}

impl State {
    /// Returns the states of several batches as one batch, `[states * batch, …]`.
    pub(crate) fn joined(states: &[Self]) -> Result<Self> {
        if let [only] = states {
            return Ok(only.clone());
        }
        let part = |of: fn(&Self) -> Option<&Tensor>| {
            let parts: Vec<&Tensor> = states.iter().filter_map(of).collect();
            match parts.len() {
                0 => Ok(None),
                found if found == states.len() => Tensor::cat(&parts, 0).map(Some),
                _ => candle_core::bail!("some of the states lack a part"),
            }
        };
        let Some(latent) = part(|state| Some(&state.latent))? else {
            candle_core::bail!("there are no states")
        };
        Ok(Self {
            latent,
            action: part(|state| state.action.as_ref())?,
            memory: part(|state| state.memory.as_ref())?,
        })
    }

    /// Returns the states of the last `batch` rows, without gradients.
    pub(crate) fn last(&self, batch: usize) -> Result<Self> {
        let all = self.latent.dim(0)?;
        let Some(first) = all.checked_sub(batch) else { candle_core::bail!("there are {all} states") };
        let last = self.rows(&(first as u32..all as u32).collect::<Vec<_>>())?;
        let detached = |part: Option<Tensor>| part.map(|values| values.detach());
        Ok(Self {
            latent: last.latent.detach(),
            action: detached(last.action),
            memory: detached(last.memory),
        })
    }

    /// Returns the states of these rows of the batch.
    pub(crate) fn rows(&self, rows: &[u32]) -> Result<Self> {
        let rows = Tensor::new(rows, self.latent.device())?;
        let part = |of: &Option<Tensor>| of.as_ref().map(|values| values.index_select(&rows, 0)).transpose();
        Ok(Self {
            latent: self.latent.index_select(&rows, 0)?,
            action: part(&self.action)?,
            memory: part(&self.memory)?,
        })
    }
}

/// A state after an observation.
pub struct Seen {
    /// The state.
    pub state: State,
    /// The divergence of the latent state's distribution from what was expected before the observation, in nats,
    /// averaged over the batch; a scalar.
    pub divergence: Tensor,
    /// The same divergence of each dimension, `[batch, latent]`; `None` if latent states were drawn, and for sequences
    /// that were seen in parts.
    pub divergences: Option<Tensor>,
}

/// Draws which inputs a training window lacks.
fn lacking(dropout: &ModalityDropout, inputs: usize, random: &mut Random) -> Vec<Modality> {
    match dropout {
        ModalityDropout::Every(_) => Vec::new(),
        ModalityDropout::Of(rates) => loop {
            let drawn = rates.iter().filter(|(_, rate)| random.happens(**rate));
            let drawn: Vec<Modality> = drawn.map(|(modality, _)| *modality).collect();
            if drawn.len() < inputs {
                break drawn;
            }
        },
        ModalityDropout::Together(all) => {
            // The probability of an item, given that it is none of those before it.
            let mut left = 1.0;
            let drawn = all.iter().find(|one| {
                let happens = random.happens((one.probability / left).min(1.0));
                left -= one.probability;
                happens
            });
            drawn.map(|one| one.inputs.clone()).unwrap_or_default()
        }
    }
}

/// How latent states are drawn.
pub enum Draw<'a> {
    /// From the posterior, for training.
    Sample {
        /// Supplies the noise and the seeds of the dropout.
        random: &'a mut Random,
        /// Probability with which a training step sets a value of the last convolution's output to zero.
        dropout: f64,
        /// Supplies which inputs a window lacks.
        missing: &'a mut Random,
    },
    /// The posterior's mean, for validation and test.
    Mean,
    /// From the posterior, with this standard normal noise, `[batch, latent]`, for a predictive distribution.
    Noise(Tensor),
}

impl Draw<'_> {
    /// Returns the dropout of a batch; `None` if no value is set to zero.
    pub fn dropout(&mut self) -> Option<Dropout> {
        match self {
            Self::Sample { random, dropout, .. } if *dropout > 0.0 => {
                Some(Dropout::new(*dropout, random.seed()))
            }
            _ => None,
        }
    }

    /// Returns which of `windows` windows have each input that may be lacking. Each keeps at least one input. Nothing is
    /// lacking in validation and test.
    pub fn keeping(&mut self, dropout: &ModalityDropout, input: &[Modality], windows: usize) -> Keeping {
        let Self::Sample { missing, .. } = self else { return Keeping::new() };
        let dropout = dropout.of_inputs(input);
        let may_lack: Vec<Modality> = match &dropout {
            ModalityDropout::Every(_) => return Keeping::new(),
            ModalityDropout::Of(rates) => rates.keys().copied().collect(),
            ModalityDropout::Together(all) => all.iter().flat_map(|one| one.inputs.iter().copied()).collect(),
        };
        let mut keeping: Keeping =
            may_lack.into_iter().map(|modality| (modality, vec![1.0; windows])).collect();
        for window in 0..windows {
            for modality in lacking(&dropout, input.len(), missing) {
                keeping.entry(modality).and_modify(|kept| kept[window] = 0.0);
            }
        }
        keeping
    }

    /// Returns one row of each `stride` rows of a batch, and of those that are left over at its end: a random row for
    /// training, and the middle one for validation. `None` if `stride` is 1, so that all rows count.
    pub fn one_of_each(&mut self, stride: usize, batch: usize) -> Option<Vec<u32>> {
        let row = |first: usize| {
            let rows = stride.min(batch - first);
            let row = match self {
                Self::Sample { random, .. } => random.up_to(rows - 1),
                Self::Mean | Self::Noise(_) => rows / 2,
            };
            (first + row) as u32
        };
        (stride > 1).then(|| (0..batch).step_by(stride).map(row).collect())
    }

    /// Returns latent states of a posterior, `[batch, latent]`.
    pub fn latent(&mut self, posterior: &Posterior) -> Result<Tensor> {
        match self.noise(posterior.0.dim(0)?, posterior.latent()?, posterior.0.device())? {
            Some(noise) => posterior.sample(&noise),
            None => posterior.mean(),
        }
    }

    /// Returns standard normal noise for drawing latent states, `[batch, latent]`; `None` for the mean.
    pub fn noise(&mut self, batch: usize, latent: usize, device: &Device) -> Result<Option<Tensor>> {
        match self {
            Self::Sample { random, .. } => {
                ops::input(Values::F32(random.normal(batch * latent)), (batch, latent), device).map(Some)
            }
            Self::Mean => Ok(None),
            Self::Noise(noise) => Ok(Some(noise.clone())),
        }
    }
}

/// A network that sees the samples of an episode one after the other, and predicts later ones. All its values are
/// normalized.
pub trait Network: Send + Sync {
    /// Returns the state before an episode's first sample; `None` if the network has no memory.
    fn start(&self, batch: usize, device: &Device) -> Result<Option<State>>;

    /// Encodes samples, each by itself, `[samples, width]`.
    ///
    /// # Errors
    /// When the observation lacks a modality that the network needs.
    fn encode(&self, seen: &Observation, draw: &mut Draw) -> Result<Tensor>;

    /// Returns the state of an encoded sample. `state` is the one that predicts this sample, or the one before the
    /// first sample.
    ///
    /// # Errors
    /// When a network with memory gets no state.
    fn observe(&self, state: Option<&State>, encoded: &Tensor, draw: &mut Draw) -> Result<Seen>;

    /// Returns the state that predicts the next sample, after an action `[batch, elements]`.
    ///
    /// # Errors
    /// When the network can't predict as far.
    fn act(&self, state: &State, action: &Tensor) -> Result<State>;

    /// Sees whole sequences, and returns the states that predict the sample after each. `encoded` are the samples of
    /// `batch` sequences, `[times * batch, width]`, and `actions` those after each of them. The rows of one time lie
    /// together. `state` is the one before the first time.
    fn unroll(
        &self,
        batch: usize,
        state: Option<&State>,
        encoded: &Tensor,
        actions: &Tensor,
        draw: &mut Draw,
    ) -> Result<Seen> {
        let (mut divergences, mut states) = (Vec::new(), Vec::<State>::new());
        for first in (0..encoded.dim(0)?).step_by(batch) {
            let now = |tensor: &Tensor| tensor.narrow(0, first, batch);
            let seen = self.observe(states.last().or(state), &now(encoded)?, draw)?;
            states.push(self.act(&seen.state, &now(actions)?)?);
            divergences.push(seen.divergence);
        }
        Ok(Seen { state: State::joined(&states)?, divergence: mean(divergences)?, divergences: None })
    }

    /// Returns the predicted sample. Its images have no gradient.
    fn decode(&self, state: &State) -> Result<Decoded>;

    /// Returns the distributions of the predicted sample, whose means [`decode`](Self::decode) returns.
    ///
    /// # Errors
    /// When a tensor operation fails.
    fn spreads(&self, _state: &State) -> Result<Spreads> {
        Ok(Spreads::new())
    }

    /// Returns the states of samples that are not seen, after the actions that follow them: `actions` `[times * batch,
    /// elements]`, the rows of one time together. The first sample is the one that `state` predicts.
    fn imagine(&self, state: &State, actions: &Tensor) -> Result<State> {
        let (mut states, batch) = (Vec::<State>::new(), state.latent.dim(0)?);
        for first in (0..actions.dim(0)?).step_by(batch) {
            states.push(self.act(states.last().unwrap_or(state), &actions.narrow(0, first, batch)?)?);
        }
        State::joined(&states)
    }

    /// Returns the mean loss of each output modality of the predicted sample.
    fn losses(&self, state: &State, targets: Targets) -> Result<Vec<Term>>;

    /// Returns the same network over the same parameters, for which no gradients are computed.
    fn detached(&self) -> Box<dyn Network>;
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

    /// Returns the normalized distributions of those vectors that have one.
    ///
    /// # Errors
    /// When a tensor has another shape.
    fn spreads(&self, latent: &Tensor, action: Option<&Tensor>) -> Result<Spreads>;

    /// Returns the decoded vectors with their widths, in the order of the decoder's last layer.
    fn vectors(&self) -> &[(Modality, usize)];

    /// Returns the mean loss of every output modality against `targets`, on normalized values.
    fn losses(&self, latent: &Tensor, action: Option<&Tensor>, targets: Targets) -> Result<Vec<Term>>;

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
    /// Layers of the memory, in the order in which they are applied; empty without memory.
    pub memory: Vec<Layer>,
    /// Layers of the decoder, in the order in which they are applied.
    pub decoder: Vec<Layer>,
    /// Number of values in one sample's input and output.
    observed: usize,
}

impl Summary {
    fn layers(&self) -> impl Iterator<Item = &Layer> {
        self.encoder.iter().chain(&self.memory).chain(&self.decoder)
    }

    /// Returns the number of trained values.
    pub fn parameters(&self) -> usize {
        self.layers().map(|layer| layer.parameters).sum()
    }

    /// Returns the number of values that all layers produce for one sample, including the input and output.
    pub fn activations(&self) -> usize {
        self.observed + self.layers().map(|layer| layer.output.iter().product::<usize>()).sum::<usize>()
    }
}

/// A decoder's output for a batch, normalized: vectors `[batch, width]`, and images `[batch, channels, rows, columns]`.
pub type Decoded = BTreeMap<Modality, Tensor>;

/// The predicted distributions of a batch, by modality.
pub type Spreads = BTreeMap<Modality, Spread>;

/// The distributions of the values of a vector, normalized, `[batch, width]` each.
pub struct Spread {
    /// The standard deviations of Gaussians, in units of the change if a change is predicted. For a hurdle, the mean
    /// absolute deviations of the whole Laplace distributions.
    pub scale: Tensor,
    /// The rest of a hurdle; `None` for Gaussians around the means.
    pub hurdle: Option<Hurdle>,
}

/// The rest of the parameters of a hurdle: a force is zero, or that of a contact, a Laplace distribution of which only
/// the values above the threshold of a contact are left.
pub struct Hurdle {
    /// The mean of the whole Laplace distribution, which is at least the threshold.
    pub location: Tensor,
    /// The probability of a contact.
    pub touches: Tensor,
}

/// The loss of one output modality.
pub struct Term {
    /// The output modality.
    pub modality: Modality,
    /// Mean loss over each part of the batch, `[parts]`.
    pub value: Tensor,
}

/// What is computed of a predicted distribution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Score {
    /// The loss, which training minimizes.
    Loss,
    /// The score of central 90 % intervals. Values without a distribution still have their loss.
    Intervals,
}

/// What a decoder should predict.
#[derive(Clone, Copy)]
pub struct Targets<'a> {
    /// The values.
    pub values: &'a Observation,
    /// Loss of each vector. Vectors that are not listed, and all images, use the squared error.
    pub losses: &'a BTreeMap<Modality, Loss>,
    /// Number of equal parts of the batch that have losses of their own, one after the other.
    pub parts: usize,
    /// What is computed of predicted distributions.
    pub score: Score,
    /// What is added to all predicted vectors, `[batch, width]`, if something is.
    pub added: Option<&'a Tensor>,
}

/// A diagonal Gaussian distribution over the latent state: the means followed by the log-variances,
/// `[batch, 2 * latent]`.
pub struct Posterior(Tensor);

impl Posterior {
    /// Returns the distribution with these means and log-variances, `[batch, latent]` each.
    pub fn new(mean: &Tensor, log_variance: &Tensor) -> Result<Self> {
        Tensor::cat(&[mean, log_variance], 1).map(Self)
    }

    /// Returns the product of distributions. Its precision is the sum of theirs, and its mean is theirs, weighted by
    /// precision. An expert has no precision in the rows that it is not of. Log-variances below
    /// [`LEAST_LOG_VARIANCE`] count as this, because a rare value far from all others could make a precision infinite.
    ///
    /// # Errors
    /// When there are no experts, or tensors have other shapes.
    pub fn product(experts: &[Expert]) -> Result<Self> {
        let precision = |Expert { posterior, kept }: &Expert| {
            let precision = posterior.log_variance()?.maximum(LEAST_LOG_VARIANCE)?.neg()?.exp()?;
            kept.as_ref().map_or(Ok(precision.clone()), |kept| precision.broadcast_mul(kept))
        };
        let precisions = experts.iter().map(precision).collect::<Result<Vec<_>>>()?;
        let weighted =
            experts.iter().zip(&precisions).map(|(expert, precision)| expert.posterior.mean()? * precision);
        let weighted = sum(weighted.collect::<Result<Vec<_>>>()?)?;
        let precision = sum(precisions)?;
        Self::new(&(weighted / &precision)?, &precision.log()?.neg()?)
    }

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

    /// Returns the divergence from `prior` as a loss of both, averaged over the batch; a scalar, in nats. The posterior
    /// learns with the weight `representation`. Rows below `free` nats count as `free`.
    pub fn balanced_divergence(&self, prior: &Self, free: f64, representation: f64) -> Result<Tensor> {
        ops::balanced_divergence(&self.0, &prior.0, free, representation)
    }

    /// Returns the divergence of each dimension from `prior`, or from the standard normal distribution, in nats,
    /// `[batch, latent]`. `None` if latent states are drawn, because only tests need it.
    fn divergences(&self, prior: Option<&Self>, draw: &Draw) -> Result<Option<Tensor>> {
        let of_mean = matches!(draw, Draw::Mean);
        of_mean.then(|| ops::divergences(&self.0, prior.map(|prior| &prior.0))).transpose()
    }

    /// Returns the divergence from the standard normal distribution in nats, averaged over the batch; a scalar.
    pub fn kl_divergence(&self) -> Result<Tensor> {
        ops::kl_divergence(&self.0)
    }
}

/// The least log-variance of an expert.
pub const LEAST_LOG_VARIANCE: f64 = -20.0;

/// A distribution that is multiplied with others.
pub struct Expert {
    /// The distribution.
    pub posterior: Posterior,
    /// The rows that it is of, `[batch, 1]`: 1 for a row that it is of, and 0 for others. `None` if it is of all.
    pub kept: Option<Tensor>,
}

/// Returns the sum of tensors of one shape.
fn sum(tensors: Vec<Tensor>) -> Result<Tensor> {
    let mut tensors = tensors.into_iter();
    let Some(first) = tensors.next() else { candle_core::bail!("there is nothing to add") };
    tensors.try_fold(first, |sum, tensor| sum + tensor)
}

/// Returns the mean of scalars.
pub(crate) fn mean(mut values: Vec<Tensor>) -> Result<Tensor> {
    if values.len() == 1 { Ok(values.remove(0)) } else { Tensor::stack(&values, 0)?.mean_all() }
}
