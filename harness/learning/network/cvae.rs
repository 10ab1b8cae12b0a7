//! The conditional variational auto-encoder as a network. It has no memory: its latent state is that of one sample.

use super::{
    Decoded, Decoder, Draw, Encoder, Network, Observation, Posterior, Seen, State, Targets, Term, Value,
};
use candle_core::{Device, Result, Tensor};
use harness_ops::frames::DenseFrames;
use harness_spec::Modality;
use std::sync::Arc;

/// An encoder, and a decoder of its latent state and the action.
pub struct Cvae {
    /// Maps an observation to a posterior.
    pub encoder: Box<dyn Encoder>,
    /// Maps a latent state and an action to the next observation.
    pub decoder: Box<dyn Decoder>,
    /// Modalities of the encoder's input. A prediction further than one sample needs them among the decoder's outputs.
    pub input: Vec<Modality>,
}

impl Cvae {
    /// Returns the state of the sample that a state predicts: the posterior's mean for the prediction.
    fn imagined(&self, state: &State) -> Result<State> {
        let mut decoded = self.decode(state)?;
        let value = |modality: &Modality| match decoded.remove(modality) {
            Some(frames) if frames.rank() == 4 => {
                Ok((*modality, Value::Frames(Arc::new(DenseFrames::new(&frames)?))))
            }
            Some(vector) => Ok((*modality, Value::Vector(vector))),
            None => candle_core::bail!("the network does not predict its own input '{modality}'"),
        };
        let imagined: Observation = self.input.iter().map(value).collect::<Result<_>>()?;
        Ok(State { latent: self.encoder.encode(&imagined)?.mean()?, action: None, memory: None })
    }
}

impl Network for Cvae {
    fn start(&self, _batch: usize, _device: &Device) -> Result<Option<State>> {
        Ok(None)
    }

    fn encode(&self, seen: &Observation, draw: &mut Draw) -> Result<Tensor> {
        Ok(self.encoder.encode_with_dropout(seen, draw.dropout())?.0)
    }

    fn observe(&self, _state: Option<&State>, encoded: &Tensor, draw: &mut Draw) -> Result<Seen> {
        let posterior = Posterior(encoded.clone());
        let state = State { latent: draw.latent(&posterior)?, action: None, memory: None };
        let divergences = posterior.divergences(None, draw)?;
        Ok(Seen { state, divergence: posterior.kl_divergence()?, divergences })
    }

    fn act(&self, state: &State, action: &Tensor) -> Result<State> {
        let state = if state.action.is_some() { &self.imagined(state)? } else { state };
        Ok(State { action: Some(action.clone()), ..state.clone() })
    }

    fn decode(&self, state: &State) -> Result<Decoded> {
        self.decoder.decode(&state.latent, state.action.as_ref())
    }

    fn losses(&self, state: &State, targets: Targets) -> Result<Vec<Term>> {
        self.decoder.losses(&state.latent, state.action.as_ref(), targets)
    }

    fn detached(&self) -> Box<dyn Network> {
        Box::new(Self {
            encoder: self.encoder.detached(),
            decoder: self.decoder.detached(),
            input: self.input.clone(),
        })
    }
}
