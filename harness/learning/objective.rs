//! Training objectives: the loss terms of a batch of transitions.

use super::frames::{Frames, SampleFrames};
use super::network::{Decoder, Encoder, Observation, Targets};
use super::ops::Dropout;
use super::random::Random;
use candle_core::{Device, Result, Tensor};
use harness_samples::{Normalizers, Sample, Samples};
use harness_spec::{Action, Loss, Modality};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The name of the Kullback-Leibler divergence among the terms of a loss.
pub const KL: &str = "kl";

/// A dataset, normalized for a network.
#[derive(Clone)]
pub struct NormalizedData {
    /// The samples, in physical units.
    pub samples: Arc<Samples>,
    /// Means and standard deviations of the modalities and of the action.
    pub normalizers: Arc<Normalizers>,
    /// Which quantity is used as the action.
    pub action: Action,
    /// The device on which tensors are created.
    pub device: Device,
}

impl NormalizedData {
    /// Returns the normalized observation of `modalities` at the samples `at`.
    pub fn observation(&self, at: &[Sample], modalities: &[Modality]) -> Result<Observation> {
        let values = self.normalizers.vectors(&self.samples, at, modalities);
        let vector = (!values.is_empty()).then(|| self.table(values, at.len())).transpose()?;
        Ok(Observation { vector, frames: self.frames(at, modalities) })
    }

    /// Returns the normalized images among `modalities` at the samples `at`, stacked by channel.
    fn frames(&self, at: &[Sample], modalities: &[Modality]) -> Option<Arc<dyn Frames>> {
        SampleFrames::new(&self.samples, &self.normalizers, at, modalities)
    }

    /// Returns `values` as a matrix of `rows` rows.
    fn table(&self, values: Vec<f32>, rows: usize) -> Result<Tensor> {
        let columns = values.len() / rows;
        Tensor::from_vec(values, (rows, columns), &Device::Cpu)?.to_device(&self.device)
    }

    /// Returns the same values as a decoder's targets: the vectors side by side, and the frames of each modality
    /// separately.
    fn targets(&self, at: &[Sample], modalities: &[Modality]) -> Result<Targets> {
        let frames = modalities
            .iter()
            .filter_map(|modality| Some((*modality, self.frames(at, std::slice::from_ref(modality))?)));
        let vector = self.observation(at, modalities)?.vector;
        Ok(Targets { vector, losses: BTreeMap::new(), frames: frames.collect() })
    }

    /// Returns the normalized actions, `[batch, elements]`, between each sample in `at` and the next one.
    pub fn actions(&self, at: &[Sample]) -> Result<Tensor> {
        self.table(self.normalizers.actions(&self.samples, at, self.action), at.len())
    }
}

/// A named term of a loss and its weight.
pub struct Weighted {
    /// Name of the output modality, or [`KL`].
    pub name: String,
    /// Factor of the term in the total loss.
    pub weight: f64,
    /// The term before weighting, a scalar.
    pub value: Tensor,
}

/// How latent states are drawn.
pub enum Draw<'a> {
    /// From the posterior, for training. The generator supplies the noise and the seed of the dropout.
    Sample(&'a mut Random),
    /// The posterior's mean, for validation and test.
    Mean,
}

/// A loss over transitions, which training minimizes.
pub trait Objective {
    /// Returns the terms of the loss over the transitions that start at the samples `at`.
    fn terms(&self, at: &[Sample], draw: Draw) -> Result<Vec<Weighted>>;

    /// Returns the same objective over detached parameters, so that no gradients are computed.
    fn detached(&self) -> Box<dyn Objective + '_>;
}

/// Predicts the next observation from the present one and the action. The terms are the loss of each output modality
/// and the weighted KL divergence.
pub struct Prediction<'a> {
    /// The dataset.
    pub data: &'a NormalizedData,
    /// Maps an observation to a posterior.
    pub encoder: Box<dyn Encoder>,
    /// Maps a latent state and an action to the next observation.
    pub decoder: Box<dyn Decoder>,
    /// Modalities of the encoder's input.
    pub input: &'a [Modality],
    /// Modalities that the decoder predicts.
    pub output: &'a [Modality],
    /// Weight of the KL divergence.
    pub kl_weight: f64,
    /// Loss of each vector modality. Modalities that are not listed use the squared error.
    pub losses: &'a BTreeMap<Modality, Loss>,
    /// Weight of each modality's loss; 1 for modalities that are not listed.
    pub loss_weights: &'a BTreeMap<Modality, f64>,
    /// Probability with which a training step sets a value of the last convolution's output to zero.
    pub dropout: f64,
}

impl Objective for Prediction<'_> {
    fn terms(&self, at: &[Sample], mut draw: Draw) -> Result<Vec<Weighted>> {
        let dropout = match &mut draw {
            Draw::Sample(random) if self.dropout > 0.0 => Some(Dropout::new(self.dropout, random.seed())),
            _ => None,
        };
        let observation = self.data.observation(at, self.input)?;
        let posterior = self.encoder.encode_with_dropout(&observation, dropout)?;
        let latent = match draw {
            Draw::Sample(random) => {
                let shape = (at.len(), posterior.latent()?);
                let noise = Tensor::from_vec(random.normal(shape.0 * shape.1), shape, &Device::Cpu)?;
                posterior.sample(&noise.to_device(&self.data.device)?)?
            }
            Draw::Mean => posterior.mean()?,
        };
        let next: Vec<Sample> = at.iter().map(|sample| sample.after(1)).collect();
        let targets = Targets { losses: self.losses.clone(), ..self.data.targets(&next, self.output)? };
        let action = self.data.actions(at)?;
        let mut terms = weighted(self.decoder.losses(&latent, Some(&action), &targets)?, self.loss_weights);
        terms.push(Weighted { name: KL.into(), weight: self.kl_weight, value: posterior.kl_divergence()? });
        Ok(terms)
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        Box::new(Prediction { encoder: self.encoder.detached(), decoder: self.decoder.detached(), ..*self })
    }
}

/// Reconstructs the present observation from the latent state of a frozen encoder. The terms are the squared error of
/// each input modality.
pub struct Reconstruction<'a> {
    /// The dataset.
    pub data: &'a NormalizedData,
    /// The posterior's mean of every sample, `[samples, latent]`. It is computed once, because the encoder is frozen.
    pub latent: &'a Tensor,
    /// Maps a latent state to the present observation.
    pub decoder: Box<dyn Decoder>,
    /// Modalities of the encoder's input, which are reconstructed.
    pub input: &'a [Modality],
}

impl Objective for Reconstruction<'_> {
    fn terms(&self, at: &[Sample], _draw: Draw) -> Result<Vec<Weighted>> {
        let targets = self.data.targets(at, self.input)?;
        let latent = rows(self.latent, at)?;
        Ok(weighted(self.decoder.losses(&latent, None, &targets)?, &BTreeMap::new()))
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        Box::new(Reconstruction { decoder: self.decoder.detached(), ..*self })
    }
}

/// Returns the rows of a matrix that belong to the samples `at`.
pub fn rows(matrix: &Tensor, at: &[Sample]) -> Result<Tensor> {
    let at = at.iter().map(|sample| sample.index() as u32).collect::<Vec<_>>();
    matrix.index_select(&Tensor::new(at, matrix.device())?, 0)
}

fn weighted(terms: Vec<super::network::Term>, weights: &BTreeMap<Modality, f64>) -> Vec<Weighted> {
    let terms = terms.into_iter().map(|term| Weighted {
        name: term.modality.name().into(),
        weight: weights.get(&term.modality).copied().unwrap_or(1.0),
        value: term.value,
    });
    terms.collect()
}
