//! What is minimised: the terms of a loss for a batch of transitions.

use super::network::{Decoder, Encoder, Observation, Targets};
use super::ops::Dropout;
use super::random::Random;
use crate::Normalizers;
use candle_core::{Device, Result, Tensor};
use harness_dataset::Samples;
use harness_spec::{Action, Loss, Modality};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The name of the Kullback-Leibler divergence among a loss's terms.
pub const KL: &str = "kl";

/// A dataset as a network sees it.
#[derive(Clone)]
pub struct NormalizedData {
    pub samples: Arc<Samples>,
    pub normalizers: Arc<Normalizers>,
    pub action: Action,
    pub device: Device,
}

impl NormalizedData {
    /// The normalized observation of `modalities` at the samples `at`.
    pub fn observation(&self, at: &[usize], modalities: &[Modality]) -> Result<Observation> {
        let vector = self.normalizers.vectors(&self.samples, at, modalities).transpose()?;
        Ok(Observation {
            vector: vector.map(|vector| vector.to_device(&self.device)).transpose()?,
            frames: self.normalizers.frames(&self.samples, at, modalities),
        })
    }

    /// The same as a decoder's targets: frames one modality at a time.
    fn targets(&self, at: &[usize], modalities: &[Modality]) -> Result<Targets> {
        let frames = modalities.iter().filter_map(|modality| {
            Some((*modality, self.normalizers.frames(&self.samples, at, std::slice::from_ref(modality))?))
        });
        let vector = self.observation(at, modalities)?.vector;
        Ok(Targets { vector, losses: BTreeMap::new(), frames: frames.collect() })
    }

    /// The normalized actions `[batch, elements]` from the samples `at` to the next.
    pub fn actions(&self, at: &[usize]) -> Result<Tensor> {
        self.normalizers.actions(&self.samples, at, self.action)?.to_device(&self.device)
    }
}

/// A named term of a loss and its weight.
pub struct Weighted {
    pub name: String,
    pub weight: f64,
    pub value: Tensor,
}

/// How latent states are drawn.
pub enum Draw<'a> {
    /// From the posterior, with this source of noise and of what dropout leaves out: training.
    Sample(&'a mut Random),
    /// The posterior's mean: validation and test.
    Mean,
}

/// Something to minimise over transitions.
pub trait Objective {
    /// The loss's terms over the transitions that start at the samples `at`.
    fn terms(&self, at: &[usize], draw: Draw) -> Result<Vec<Weighted>>;

    /// The same objective over parameters that no gradient is computed for.
    fn detached(&self) -> Box<dyn Objective + '_>;
}

/// The next observation from this one and the action: the losses of its errors plus the weighted divergence.
pub struct Prediction<'a> {
    pub data: &'a NormalizedData,
    pub encoder: Box<dyn Encoder>,
    pub decoder: Box<dyn Decoder>,
    pub input: &'a [Modality],
    pub output: &'a [Modality],
    pub kl_weight: f64,
    /// What the errors of vectors cost; squared where nothing is said.
    pub losses: &'a BTreeMap<Modality, Loss>,
    pub loss_weights: &'a BTreeMap<Modality, f64>,
    /// Share of what the convolution makes of the frames that a training step leaves out.
    pub dropout: f64,
}

impl Objective for Prediction<'_> {
    fn terms(&self, at: &[usize], mut draw: Draw) -> Result<Vec<Weighted>> {
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
        let next: Vec<usize> = at.iter().map(|sample| sample + 1).collect();
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

/// This observation again, from the frozen encoder's latent state: squared errors alone.
pub struct Reconstruction<'a> {
    pub data: &'a NormalizedData,
    /// The posterior's mean of every sample, `[samples, latent]`: the encoder is frozen, so it runs once.
    pub latent: &'a Tensor,
    pub decoder: Box<dyn Decoder>,
    pub input: &'a [Modality],
}

impl Objective for Reconstruction<'_> {
    fn terms(&self, at: &[usize], _draw: Draw) -> Result<Vec<Weighted>> {
        let targets = self.data.targets(at, self.input)?;
        let latent = rows(self.latent, at)?;
        Ok(weighted(self.decoder.losses(&latent, None, &targets)?, &BTreeMap::new()))
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        Box::new(Reconstruction { decoder: self.decoder.detached(), ..*self })
    }
}

/// The rows `at` of a matrix.
pub fn rows(matrix: &Tensor, at: &[usize]) -> Result<Tensor> {
    let at = at.iter().map(|row| *row as u32).collect::<Vec<_>>();
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
