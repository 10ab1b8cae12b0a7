//! What a memory is, and what it takes of each sample.

use super::description::{ACTION, ENCODED, Layer, MEMORY, SEEN};
use super::{Architecture, Draw, Posterior, Seen, State};
use candle_core::{DType, Result, Tensor};

/// Name of the value that a posterior takes: the memory and the encoded sample.
pub(super) const JOINED: &str = "joined";

/// A memory: what it keeps of encoded samples, and the latent state that follows from it.
pub(super) trait Unit: Send + Sync {
    /// Returns the width of the memory.
    fn width(&self) -> usize;

    /// Returns the states of encoded samples that follow one another, without the actions after them. `encoded` are the
    /// samples of several sequences, `[times * batch, width]`, the rows of one time together, and `between` the
    /// actions between the times. `state` is the one before the first time.
    fn seen(
        &self,
        state: &State,
        encoded: &Tensor,
        between: Option<&Tensor>,
        draw: &mut Draw,
    ) -> Result<Seen>;

    /// Returns the states of the sample that `state` predicts and of those after it, none of which is seen. `between`
    /// are the actions between the times, `[(times - 1) * batch, elements]`; `None` for one time.
    fn unseen(&self, state: &State, between: Option<&Tensor>) -> Result<State>;

    /// Returns the same unit over the same parameters, for which no gradients are computed.
    fn detached(&self) -> Box<dyn Unit>;

    /// Describes the layers in the order in which they are applied.
    fn layers(&self) -> Result<Vec<Layer>>;
}

/// What a memory takes of each sample: the encoded sample, whether there is one, and the action before it, if there are
/// actions. For a sample that is not seen, the encoded sample is zero.
#[derive(Debug, Clone, Copy)]
pub(super) struct Inputs {
    /// Width of an encoded sample.
    pub encoded: usize,
    /// Width of the action; 0 without actions.
    pub action: usize,
}

impl Inputs {
    pub fn new(architecture: &Architecture) -> Self {
        Self { encoded: 2 * architecture.latent, action: architecture.layout.action().len() }
    }

    /// Returns these names, with that of the action if there are actions.
    pub fn named(self, names: &[&'static str]) -> Vec<&'static str> {
        names.iter().copied().chain((self.action > 0).then_some(ACTION)).collect()
    }

    /// Names of the parts.
    pub fn names(self) -> Vec<&'static str> {
        self.named(&[ENCODED, SEEN])
    }

    /// The width of all parts side by side.
    pub fn width(self) -> usize {
        self.encoded + 1 + self.action
    }

    /// Returns the parts side by side, `[times * batch, width]`. `encoded` is `None` for samples that are not seen.
    pub fn of(self, state: &State, encoded: Option<&Tensor>, between: Option<&Tensor>) -> Result<Tensor> {
        let (actions, device) = (self.actions(state, between)?, state.latent.device());
        let rows = actions.dim(0)?;
        let (encoded, seen) = match encoded {
            Some(encoded) => (encoded.clone(), Tensor::ones((rows, 1), DType::F32, device)?),
            None => (
                Tensor::zeros((rows, self.encoded), DType::F32, device)?,
                Tensor::zeros((rows, 1), DType::F32, device)?,
            ),
        };
        let parts = [&encoded, &seen].into_iter().chain((self.action > 0).then_some(&actions));
        Tensor::cat(&parts.collect::<Vec<_>>(), 1)
    }

    /// Describes the value of the memory and the encoded sample side by side.
    pub fn joined(self, memory: usize) -> Layer {
        Layer::concatenate(JOINED, &[MEMORY, ENCODED], memory + self.encoded)
    }

    /// Returns the action before each sample, `[times * batch, action]`; zero before an episode's first sample. Without
    /// actions, it has one column, which is not taken.
    pub fn actions(self, state: &State, between: Option<&Tensor>) -> Result<Tensor> {
        let (batch, device) = (state.latent.dim(0)?, state.latent.device());
        let zeros = || Tensor::zeros((batch, self.action.max(1)), DType::F32, device);
        let first = state.action.clone().map_or_else(zeros, Ok)?;
        match between {
            Some(between) => Tensor::cat(&[&first, between], 0),
            None => Ok(first),
        }
    }
}

/// Returns the memory of a state.
pub(super) fn memory_of(state: &State) -> Result<&Tensor> {
    let Some(memory) = &state.memory else { candle_core::bail!("the state has no memory") };
    Ok(memory)
}

/// The memory after each sample, and the posterior that follows from it.
pub(super) struct Steps {
    /// `[times * batch, width]`
    pub memory: Tensor,
    pub posterior: Posterior,
}

impl Steps {
    /// Returns the states of samples that are seen.
    pub fn seen(self, draw: &mut Draw) -> Result<Seen> {
        let (latent, divergence) = (draw.latent(&self.posterior)?, self.posterior.kl_divergence()?);
        let divergences = self.posterior.divergences(None, draw)?;
        Ok(Seen { state: State { latent, action: None, memory: Some(self.memory) }, divergence, divergences })
    }

    /// Returns the states of samples that are not seen.
    pub fn unseen(self) -> Result<State> {
        Ok(State { latent: self.posterior.mean()?, action: None, memory: Some(self.memory) })
    }
}
