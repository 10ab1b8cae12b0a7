//! The auto-encoder with a memory between the encoder and the latent state.

use super::gru::Gru;
use super::layers::Builder;
use super::rssm::Rssm;
use super::unit::Unit;
use super::window::LastSamples;
use super::{
    Architecture, Decoded, Decoder, Draw, Encoder, Network, Observation, Seen, Spreads, State, Targets, Term,
};
use candle_core::{DType, Device, Result, Tensor};
use harness_spec::Memory;

/// Creates the memory that an architecture describes; `None` if it has none.
pub(super) fn unit(architecture: &Architecture, mut builder: Builder) -> Result<Option<Box<dyn Unit>>> {
    let builder = &mut builder;
    Ok(match architecture.network.memory {
        Memory::None => None,
        Memory::Window => Some(Box::new(LastSamples::new(architecture, builder)?)),
        Memory::Gru => Some(Box::new(Gru::new(architecture, builder)?)),
        Memory::Rssm => Some(Box::new(Rssm::new(architecture, builder)?)),
    })
}

/// An encoder, a memory, and a decoder of the latent state and the action.
pub struct Recurrent {
    pub(super) encoder: Box<dyn Encoder>,
    pub(super) unit: Box<dyn Unit>,
    pub(super) decoder: Box<dyn Decoder>,
    /// Size of the latent state.
    pub(super) latent: usize,
}

impl Recurrent {
    fn seen(
        &self,
        state: Option<&State>,
        encoded: &Tensor,
        between: Option<&Tensor>,
        draw: &mut Draw,
    ) -> Result<Seen> {
        let Some(state) = state else { candle_core::bail!("a network with memory needs a state") };
        self.unit.seen(state, encoded, between, draw)
    }
}

impl Network for Recurrent {
    fn start(&self, batch: usize, device: &Device) -> Result<Option<State>> {
        let zeros = |width: usize| Tensor::zeros((batch, width), DType::F32, device);
        let (latent, memory) = (zeros(self.latent)?, zeros(self.unit.width())?);
        Ok(Some(State { latent, action: None, memory: Some(memory) }))
    }

    fn encode(&self, seen: &Observation, draw: &mut Draw) -> Result<Tensor> {
        Ok(self.encoder.encode_with_dropout(seen, draw.dropout())?.0)
    }

    fn observe(&self, state: Option<&State>, encoded: &Tensor, draw: &mut Draw) -> Result<Seen> {
        self.seen(state, encoded, None, draw)
    }

    fn unroll(
        &self,
        batch: usize,
        state: Option<&State>,
        encoded: &Tensor,
        actions: &Tensor,
        draw: &mut Draw,
    ) -> Result<Seen> {
        let between = actions.narrow(0, 0, actions.dim(0)? - batch)?;
        let mut seen = self.seen(state, encoded, Some(&between), draw)?;
        seen.state.action = Some(actions.clone());
        Ok(seen)
    }

    fn act(&self, state: &State, action: &Tensor) -> Result<State> {
        // If there is an action already, the sample that the state predicts is not seen.
        let state = if state.action.is_some() { &self.unit.unseen(state, None)? } else { state };
        Ok(State { action: Some(action.clone()), ..state.clone() })
    }

    fn imagine(&self, state: &State, actions: &Tensor) -> Result<State> {
        let between = actions.narrow(0, 0, actions.dim(0)? - state.latent.dim(0)?)?;
        Ok(State { action: Some(actions.clone()), ..self.unit.unseen(state, Some(&between))? })
    }

    fn decode(&self, state: &State) -> Result<Decoded> {
        self.decoder.decode(&state.latent, state.action.as_ref())
    }

    fn spreads(&self, state: &State) -> Result<Spreads> {
        self.decoder.spreads(&state.latent, state.action.as_ref())
    }

    fn losses(&self, state: &State, targets: Targets) -> Result<Vec<Term>> {
        self.decoder.losses(&state.latent, state.action.as_ref(), targets)
    }

    fn detached(&self) -> Box<dyn Network> {
        Box::new(Self {
            encoder: self.encoder.detached(),
            unit: self.unit.detached(),
            decoder: self.decoder.detached(),
            latent: self.latent,
        })
    }
}
