//! The memory of a recurrent state-space model.

use super::description::{ACTION, LATENT, Layer, MEMORY, POSTERIOR, PRIOR};
use super::gru::Cell;
use super::layers::{Builder, Perceptron};
use super::unit::{Inputs, JOINED, Unit, memory_of};
use super::{Architecture, Draw, Posterior, Seen, State};
use candle_core::{Result, Tensor};

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

    /// Returns the memory at the sample that follows a latent state and an action.
    fn step(&self, latent: &Tensor, action: &Tensor, memory: &Tensor) -> Result<Tensor> {
        self.cell.states(&Tensor::cat(&[latent, action], 1)?, memory)
    }
}

/// Returns the loss of the divergence of `posterior` from `prior`, averaged over the batch. The prior learns from one
/// part, and the posterior from the other one, which has a smaller weight.
fn balanced(posterior: &Posterior, prior: &Posterior) -> Result<Tensor> {
    let of = |posterior: &Posterior, prior: &Posterior| {
        posterior.divergence_from(prior)?.maximum(FREE_NATS)?.mean_all()
    };
    of(&posterior.detached(), prior)? + (of(posterior, &prior.detached())? * REPRESENTATION)?
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
        let (mut memory, mut latent) = (memory_of(state)?.clone(), state.latent.clone());
        let (batch, actions) = (memory.dim(0)?, self.inputs.actions(state, between)?);
        let (mut memories, mut latents, mut posteriors) = (Vec::new(), Vec::new(), Vec::new());
        for first in (0..encoded.dim(0)?).step_by(batch) {
            let now = |tensor: &Tensor| tensor.narrow(0, first, batch)?.contiguous();
            memory = self.step(&latent, &now(&actions)?, &memory)?;
            let joined = Tensor::cat(&[&memory, &now(encoded)?], 1)?;
            let posterior = Posterior(self.posterior.forward(&joined, false)?);
            latent = draw.latent(&posterior)?;
            memories.push(memory.clone());
            latents.push(latent.clone());
            posteriors.push(posterior.0);
        }
        let memory = Tensor::cat(&memories, 0)?;
        let prior = Posterior(self.prior.forward(&memory, false)?);
        let divergence = balanced(&Posterior(Tensor::cat(&posteriors, 0)?), &prior)?;
        let state = State { latent: Tensor::cat(&latents, 0)?, action: None, memory: Some(memory) };
        Ok(Seen { state, divergence })
    }

    fn unseen(&self, state: &State, between: Option<&Tensor>) -> Result<State> {
        let (mut memory, mut latent) = (memory_of(state)?.clone(), state.latent.clone());
        let (batch, actions) = (memory.dim(0)?, self.inputs.actions(state, between)?);
        let mut states = Vec::new();
        for first in (0..actions.dim(0)?).step_by(batch) {
            memory = self.step(&latent, &actions.narrow(0, first, batch)?.contiguous()?, &memory)?;
            latent = Posterior(self.prior.forward(&memory, false)?).mean()?;
            states.push(State { latent: latent.clone(), action: None, memory: Some(memory.clone()) });
        }
        State::joined(&states)
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
        let mut layers = vec![self.cell.layer(&[LATENT, ACTION])];
        layers.extend(self.prior.layers(MEMORY, false)?);
        layers.push(self.inputs.joined(self.cell.width));
        layers.extend(self.posterior.layers(JOINED, false)?);
        Ok(layers)
    }
}
