//! Training objectives: the loss terms of a batch of windows.

use super::data::{NormalizedData, indices};
use super::network::{Decoder, Draw, Keeping, Network, Score, Seen, State, Targets, Term, context};
use super::predict::Latents;
use candle_core::{Result, Tensor};
use harness_samples::{Sample, after, before};
use harness_spec::{Modality, Training, Window};
use std::collections::BTreeMap;
use std::ops::Range;

/// The name of the Kullback-Leibler divergence among the terms of a loss.
pub const KL: &str = "kl";

/// A named term of a loss and its weight.
pub struct Weighted {
    /// Name of the output modality, or [`KL`].
    pub name: String,
    /// Factor of the term in the total loss.
    pub weight: f64,
    /// The term before weighting, a scalar.
    pub value: Tensor,
}

/// A loss over windows, which training minimizes.
pub trait Objective {
    /// Returns the terms of the loss over the windows whose present samples are `at`.
    fn terms(&self, at: &[Sample], draw: Draw) -> Result<Vec<Weighted>>;

    /// Returns the lists of rows that the terms over these windows take from data on a GPU, in any order. None if they
    /// are not known before.
    fn indices(&self, _at: &[Sample]) -> Result<Vec<Vec<u32>>> {
        Ok(Vec::new())
    }

    /// Returns the number of consecutive samples that the network sees of each window.
    fn context(&self) -> usize {
        1
    }

    /// Returns the mean number of predictions of samples in each window, rounded up.
    fn predicted(&self) -> usize {
        1
    }

    /// Returns the same objective over detached parameters, so that no gradients are computed.
    fn detached(&self) -> Box<dyn Objective + '_>;

    /// Returns the objective over detached parameters whose terms are the [`Score::Intervals`] of distributions.
    fn intervals(&self) -> Box<dyn Objective + '_> {
        self.detached()
    }
}

/// Predicts the next samples of each that the network has seen, as many as the window's horizon, or estimates the sample
/// itself if the horizon is 0. The terms are the mean loss of each output modality, in which further samples may weigh
/// less, and the weighted KL divergence.
///
/// A network without memory sees only the present sample, however long the context is.
pub struct Prediction<'a> {
    /// The dataset.
    pub data: &'a NormalizedData,
    /// What is trained.
    pub network: Box<dyn Network>,
    /// How many samples the network sees and predicts.
    pub window: &'a Window,
    /// Modalities that the network sees.
    pub input: &'a [Modality],
    /// Modalities that the network predicts.
    pub output: &'a [Modality],
    /// Which samples are predicted further than the next one, and the losses with their weights.
    pub training: &'a Training,
    /// What is computed of predicted distributions.
    pub score: Score,
}

impl Objective for Prediction<'_> {
    fn terms(&self, at: &[Sample], mut draw: Draw) -> Result<Vec<Weighted>> {
        let Self { data, network, window, training, score, .. } = self;
        let mut keeping = draw.keeping(&training.modality_dropout, self.input, at.len());
        let start = self.burned_in(at, &keeping, &mut draw)?;
        let mut seen = times(at, 0..self.trained());
        let encoded = self.encoded(&*self.network, &seen, &keeping, &mut draw)?;
        let Seen { mut state, divergence, .. } = self.unroll(at.len(), start, &seen, &encoded, &mut draw)?;
        let losses = |state: &State, of: &[Sample], present: &[Sample], keeping: &Keeping, parts: usize| {
            let values = data.targets(of, present, keeping, self.output)?;
            let (losses, score) = (&training.losses, *score);
            network.losses(state, Targets { values: &values, losses, parts, score, added: None })
        };
        let next = losses(&state, &after(&seen, window.first_horizon()), &seen, &keeping, 1)?;
        let further = self.further();
        let terms = if further == 0 {
            next
        } else {
            if let Some(rows) = draw.one_of_each(training.rollout_stride, seen.len()) {
                state = state.rows(&rows)?;
                seen = rows.iter().map(|row| seen[*row as usize]).collect();
                for kept in keeping.values_mut() {
                    *kept = rows.iter().map(|row| kept[*row as usize % at.len()]).collect();
                }
            }
            let state = network.imagine(&state, &data.actions(&later(&seen, 1, further))?)?;
            let present = seen.repeat(further);
            joined(next, losses(&state, &later(&seen, 2, further), &present, &keeping, further)?)?
        };
        let mut terms = weighted(means(terms, training.discount)?, &training.loss_weights);
        terms.push(Weighted { name: KL.into(), weight: training.kl_weight, value: divergence });
        Ok(terms)
    }

    fn indices(&self, at: &[Sample]) -> Result<Vec<Vec<u32>>> {
        let (burned, seen) = (times(at, self.trained()..self.context()), times(at, 0..self.trained()));
        let further = self.further();
        let present =
            if self.data.normalizers.changes.is_empty() { Vec::new() } else { seen.repeat(further) };
        let taken = [
            burned,
            after(&seen, self.window.first_horizon()),
            later(&seen, 1, further),
            later(&seen, 2, further),
            present,
            seen,
        ];
        Ok(taken.iter().map(|at| indices(at)).collect())
    }

    fn context(&self) -> usize {
        context(&*self.network, self.window)
    }

    fn predicted(&self) -> usize {
        let further = (self.trained() * self.further()).div_ceil(self.training.rollout_stride);
        self.trained() + further
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        Box::new(Prediction { network: self.network.detached(), ..*self })
    }

    fn intervals(&self) -> Box<dyn Objective + '_> {
        Box::new(Prediction { network: self.network.detached(), score: Score::Intervals, ..*self })
    }
}

/// Returns the samples of all windows at these distances before their present samples `at`. Those at one time lie
/// together, and the first time comes first.
fn times(at: &[Sample], distances: Range<usize>) -> Vec<Sample> {
    distances.rev().flat_map(|distance| before(at, distance)).collect()
}

/// Returns the samples at `count` distances after those in `at`, the first of which is `first`. Those at one distance
/// lie together.
fn later(at: &[Sample], first: usize, count: usize) -> Vec<Sample> {
    (first..first + count).flat_map(|distance| after(at, distance)).collect()
}

impl Prediction<'_> {
    /// Returns the number of samples of a window on which the network is trained: those after the burn-in.
    fn trained(&self) -> usize {
        match self.context() {
            // A network without memory sees one sample, and needs no burn-in.
            1 => 1,
            context => context - self.training.burn_in,
        }
    }

    /// Returns the number of samples that are predicted after the first one.
    fn further(&self) -> usize {
        self.window.horizon.saturating_sub(1)
    }

    /// Returns the state before the first sample on which the network is trained, without gradients; `None` without
    /// memory.
    fn burned_in(&self, at: &[Sample], keeping: &Keeping, draw: &mut Draw) -> Result<Option<State>> {
        let start = self.network.start(at.len(), &self.data.device)?;
        let seen = times(at, self.trained()..self.context());
        if seen.is_empty() {
            return Ok(start);
        }
        let network = self.network.detached();
        let encoded = self.encoded(&*network, &seen, keeping, draw)?;
        let actions = self.data.actions(&seen)?;
        network.unroll(at.len(), start.as_ref(), &encoded, &actions, draw)?.state.last(at.len()).map(Some)
    }

    /// Encodes the samples `seen` of windows that may lack inputs.
    fn encoded(
        &self,
        network: &dyn Network,
        seen: &[Sample],
        keeping: &Keeping,
        draw: &mut Draw,
    ) -> Result<Tensor> {
        network.encode(&self.data.inputs(seen, self.input)?.keeping(keeping)?, draw)
    }

    /// Returns the states of the encoded samples `seen`, `batch` at each time. Gradients reach back over as many times as
    /// `training.truncate` says.
    fn unroll(
        &self,
        batch: usize,
        mut start: Option<State>,
        seen: &[Sample],
        encoded: &Tensor,
        draw: &mut Draw,
    ) -> Result<Seen> {
        let actions = self.data.actions(seen)?;
        let times = seen.len() / batch;
        let most = self.training.truncate.unwrap_or(times);
        if most >= times {
            return self.network.unroll(batch, start.as_ref(), encoded, &actions, draw);
        }
        let (mut states, mut divergences) = (Vec::new(), Vec::new());
        for first in (0..times).step_by(most) {
            let part = most.min(times - first);
            let rows = |tensor: &Tensor| tensor.narrow(0, first * batch, part * batch);
            let Seen { state, divergence, .. } =
                self.network.unroll(batch, start.as_ref(), &rows(encoded)?, &rows(&actions)?, draw)?;
            start = Some(state.last(batch)?);
            states.push(state);
            divergences.push((divergence * (part as f64 / times as f64))?);
        }
        let divergence = Tensor::stack(&divergences, 0)?.sum_all()?;
        Ok(Seen { state: State::joined(&states)?, divergence, divergences: None })
    }
}

/// Joins the losses of the next sample with those at further distances.
fn joined(next: Vec<Term>, further: Vec<Term>) -> Result<Vec<Term>> {
    let join = |(next, further): (Term, Term)| {
        Ok(Term { modality: next.modality, value: Tensor::cat(&[next.value, further.value], 0)? })
    };
    next.into_iter().zip(further).map(join).collect()
}

/// Returns the mean loss of each modality over the distances 1, 2, …, a scalar. The weight of a distance is that of the
/// one before it, times `discount`.
fn means(losses: Vec<Term>, discount: f64) -> Result<Vec<Term>> {
    let mean = |Term { modality, value }| Ok(Term { modality, value: discounted(&value, discount)? });
    losses.into_iter().map(mean).collect()
}

fn discounted(losses: &Tensor, discount: f64) -> Result<Tensor> {
    let distances = losses.dim(0)?;
    if distances == 1 {
        return losses.get(0);
    }
    if discount == 1.0 {
        return losses.mean_all();
    }
    let weights: Vec<f64> = (0..distances as i32).map(|further| discount.powi(further)).collect();
    let sum: f64 = weights.iter().sum();
    let weights: Vec<f32> = weights.into_iter().map(|weight| (weight / sum) as f32).collect();
    (losses * Tensor::new(weights, losses.device())?)?.sum_all()
}

/// Reconstructs the present observation from the latent state of a frozen encoder. The terms are the squared error of
/// each modality.
pub struct Reconstruction<'a> {
    /// The dataset.
    pub data: &'a NormalizedData,
    /// The latent states of the frozen network, which are computed once.
    pub latents: &'a Latents,
    /// Maps a latent state to the present observation.
    pub decoder: Box<dyn Decoder>,
    /// Modalities that are reconstructed: those of the encoder's input, and others.
    pub output: &'a [Modality],
}

impl Objective for Reconstruction<'_> {
    fn terms(&self, at: &[Sample], _draw: Draw) -> Result<Vec<Weighted>> {
        let values = self.data.observation(at, self.output)?;
        let targets =
            Targets { values: &values, losses: &BTreeMap::new(), parts: 1, score: Score::Loss, added: None };
        let terms = means(self.decoder.losses(&self.latents.rows(at)?, None, targets)?, 1.0)?;
        Ok(weighted(terms, &BTreeMap::new()))
    }

    fn indices(&self, at: &[Sample]) -> Result<Vec<Vec<u32>>> {
        Ok(vec![indices(at), self.latents.indices(at)?])
    }

    fn detached(&self) -> Box<dyn Objective + '_> {
        Box::new(Reconstruction { decoder: self.decoder.detached(), ..*self })
    }
}

fn weighted(terms: Vec<Term>, weights: &BTreeMap<Modality, f64>) -> Vec<Weighted> {
    let terms = terms.into_iter().map(|term| Weighted {
        name: term.modality.name().into(),
        weight: weights.get(&term.modality).copied().unwrap_or(1.0),
        value: term.value,
    });
    terms.collect()
}
