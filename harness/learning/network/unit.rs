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

/// What a memory takes of each sample: the encoded sample, whether there is one, and the action before it. For a sample
/// that is not seen, the encoded sample is zero.
#[derive(Debug, Clone, Copy)]
pub(super) struct Inputs {
    /// Width of an encoded sample.
    pub encoded: usize,
    /// Width of the action.
    pub action: usize,
}

impl Inputs {
    /// Names of the parts.
    pub const NAMES: [&str; 3] = [ENCODED, SEEN, ACTION];

    pub fn new(architecture: &Architecture) -> Self {
        Self { encoded: 2 * architecture.latent, action: architecture.action }
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
        Tensor::cat(&[&encoded, &seen, &actions], 1)
    }

    /// Describes the value of the memory and the encoded sample side by side.
    pub fn joined(self, memory: usize) -> Layer {
        Layer::concatenate(JOINED, &[MEMORY, ENCODED], memory + self.encoded)
    }

    /// Returns the action before each sample, `[times * batch, action]`; zero before an episode's first sample.
    pub fn actions(self, state: &State, between: Option<&Tensor>) -> Result<Tensor> {
        let (batch, device) = (state.latent.dim(0)?, state.latent.device());
        let zeros = || Tensor::zeros((batch, self.action), DType::F32, device);
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
