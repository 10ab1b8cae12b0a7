//! The memory of a recurrent state-space model.

use super::description::{LATENT, Layer, MEMORY, POSTERIOR, PRIOR};
use super::gru::Cell;
use super::layers::{Builder, Perceptron};
use super::unit::{Inputs, JOINED, Unit, memory_of};
use super::{Architecture, Draw, Posterior, Seen, State};
use candle_core::{Result, Tensor, bail};
use harness_ops::{self as ops, Sequences, StateSpace};

/// Divergences below this number of nats are not reduced further.
const FREE_NATS: f64 = 1.0;
/// Weight of the divergence as a loss of the posterior, relative to that as a loss of the prior.
const REPRESENTATION: f64 = 0.1;

/// A recurrent state-space model with a Gaussian latent state (Hafner et al., "Mastering diverse control tasks through
/// world models", 2025, with their free nats and weights of the divergence).
///
/// The memory is the state of a gated recurrent unit that takes the last latent state and the action after it. The
/// prior of the latent state follows from the memory, and the posterior from the memory and the encoded sample. The
/// latent state of a sample that is not seen is the mean of the prior.
pub(super) struct Rssm {
    inputs: Inputs,
    cell: Cell,
    prior: Perceptron,
    posterior: Perceptron,
}

impl Rssm {
    pub fn new(architecture: &Architecture, builder: &mut Builder) -> Result<Self> {
        let inputs = Inputs::new(architecture);
        let cell = Cell::new(architecture, architecture.latent + inputs.action, builder)?;
        let width = cell.width;
        let mut perceptron = |name: &str, from: usize| {
            let hidden = builder.perceptron(&format!("{name}_hidden"), &[from, width])?;
            Ok::<_, candle_core::Error>(hidden.then(name, builder.dense(name, width, inputs.encoded)?))
        };
        let prior = perceptron(PRIOR, width)?;
        let posterior = perceptron(POSTERIOR, width + inputs.encoded)?;
        Ok(Self { inputs, cell, prior, posterior })
    }

    /// Returns the memory and the distribution of the latent state at times that follow one another. The distribution
    /// is the posterior of encoded samples, or the prior.
    fn steps(
        &self,
        state: &State,
        encoded: Option<&Tensor>,
        between: Option<&Tensor>,
        noise: Option<&Tensor>,
    ) -> Result<(Tensor, Posterior)> {
        let distribution = if encoded.is_some() { &self.posterior } else { &self.prior };
        let Some(distribution) = distribution.two_layers() else { bail!("a distribution has two layers") };
        let ([input, hidden], actions) = (self.cell.products(), self.inputs.actions(state, between)?);
        let given = Sequences { actions: &actions, encoded, noise };
        let parameters = StateSpace { input, hidden, distribution };
        let arithmetic = self.cell.arithmetic;
        let (memory, distribution) =
            ops::rssm(&given, &parameters, memory_of(state)?, &state.latent, arithmetic)?;
        Ok((memory, Posterior(distribution)))
    }
}

impl Unit for Rssm {
    fn width(&self) -> usize {
        self.cell.width
    }

    fn seen(
        &self,
        state: &State,
        encoded: &Tensor,
        between: Option<&Tensor>,
        draw: &mut Draw,
    ) -> Result<Seen> {
        let noise = draw.noise(encoded.dim(0)?, state.latent.dim(1)?, encoded.device())?;
        let (memory, posterior) = self.steps(state, Some(encoded), between, noise.as_ref())?;
        let latent = match &noise {
            Some(noise) => posterior.sample(noise)?,
            None => posterior.mean()?,
        };
        let prior = Posterior(self.prior.forward(&memory, false)?);
        let divergence = posterior.balanced_divergence(&prior, FREE_NATS, REPRESENTATION)?;
        let divergences = posterior.divergences(Some(&prior), draw)?;
        Ok(Seen { state: State { latent, action: None, memory: Some(memory) }, divergence, divergences })
    }

    fn unseen(&self, state: &State, between: Option<&Tensor>) -> Result<State> {
        let (memory, prior) = self.steps(state, None, between, None)?;
        Ok(State { latent: prior.mean()?, action: None, memory: Some(memory) })
    }

    fn detached(&self) -> Box<dyn Unit> {
        Box::new(Self {
            inputs: self.inputs,
            cell: self.cell.detached(),
            prior: self.prior.detached(),
            posterior: self.posterior.detached(),
        })
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        let mut layers = vec![self.cell.layer(&self.inputs.named(&[LATENT]))];
        layers.extend(self.prior.layers(MEMORY, false)?);
        layers.push(self.inputs.joined(self.cell.width));
        layers.extend(self.posterior.layers(JOINED, false)?);
        Ok(layers)
    }
}
