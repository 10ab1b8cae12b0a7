//! The conditional variational auto-encoder as a network. It has no memory: its latent state is that of one sample.

use super::{
    Decoded, Decoder, Draw, Encoder, Network, Observation, Posterior, Seen, Spreads, State, Targets, Term,
    Value,
};
use candle_core::{DType, Device, Result, Tensor};
use harness_ops::frames::DenseFrames;
use harness_spec::Modality;
use std::collections::BTreeMap;
use std::sync::Arc;

/// An encoder, and a decoder of its latent state and the action.
pub struct Cvae {
    /// Maps an observation to a posterior.
    pub encoder: Box<dyn Encoder>,
    /// Maps a latent state and an action to the next observation.
    pub decoder: Box<dyn Decoder>,
    /// Modalities of the encoder's input. A prediction further than one sample needs them among the decoder's outputs.
    pub input: Vec<Modality>,
    /// Size of the latent state.
    pub latent: usize,
    /// The outputs that are predicted as changes of an input, and the factors that turn a normalized change into one of
    /// the normalized input, `[width]`.
    ///
    /// The state's `memory` then holds what they are added to: these inputs side by side. Behind them are the changes
    /// until the sample before, normalized, if that sample is not seen.
    pub changes: BTreeMap<Modality, Tensor>,
}

impl Cvae {
    /// Returns the state of the sample that a state predicts: the posterior's mean for the prediction.
    fn imagined(&self, state: &State) -> Result<State> {
        let mut decoded = self.decode(state)?;
        let (mut memory, mut changed) = (Vec::new(), Vec::new());
        for (modality, factors, first) in self.changed() {
            let (Some(change), Some(present)) = (decoded.get_mut(&modality), &state.memory) else {
                candle_core::bail!("the state has no '{modality}' to which its change could be added");
            };
            let present = present.narrow(1, first, factors.dim(0)?)?;
            let value = (&present + change.broadcast_mul(factors)?)?;
            changed.push(std::mem::replace(change, value));
            memory.push(present);
        }
        memory.extend(changed);
        let value = |modality: &Modality| match decoded.remove(modality) {
            Some(frames) if frames.rank() == 4 => {
                Ok((*modality, Value::Frames(Arc::new(DenseFrames::new(&frames)?))))
            }
            Some(vector) => Ok((*modality, Value::Vector(vector))),
            None => candle_core::bail!("the network does not predict its own input '{modality}'"),
        };
        let imagined: Observation = self.input.iter().map(value).collect::<Result<_>>()?;
        let memory = if memory.is_empty() { None } else { Some(Tensor::cat(&memory, 1)?) };
        Ok(State { latent: self.encoder.encode(&imagined)?.mean()?, action: None, memory })
    }

    /// Returns the outputs that are predicted as changes, with their factors and first columns.
    fn changed(&self) -> impl Iterator<Item = (Modality, &Tensor, usize)> {
        self.changes.iter().scan(0, |next, (modality, factors)| {
            let first = *next;
            *next += factors.elem_count();
            Some((*modality, factors, first))
        })
    }

    /// Returns the changes of an output until the sample before the predicted one, `[batch, width]`; `None` if that
    /// sample is seen.
    fn until_before(&self, state: &State, modality: Modality) -> Result<Option<Tensor>> {
        let Some(memory) = &state.memory else { return Ok(None) };
        let all: usize = self.changes.values().map(Tensor::elem_count).sum();
        let of_it = self.changed().find(|(name, ..)| *name == modality);
        match of_it.filter(|_| memory.dim(1).is_ok_and(|width| width > all)) {
            Some((_, factors, first)) => memory.narrow(1, all + first, factors.elem_count()).map(Some),
            None => Ok(None),
        }
    }
}

impl Network for Cvae {
    fn start(&self, _batch: usize, _device: &Device) -> Result<Option<State>> {
        Ok(None)
    }

    fn encode(&self, seen: &Observation, draw: &mut Draw) -> Result<Tensor> {
        let posterior = self.encoder.encode_with_dropout(seen, draw.dropout())?.0;
        if self.changes.is_empty() {
            return Ok(posterior);
        }
        let present: Vec<Modality> = self.changes.keys().copied().collect();
        Tensor::cat(&[posterior, seen.vectors(&present)?], 1)
    }

    fn observe(&self, _state: Option<&State>, encoded: &Tensor, draw: &mut Draw) -> Result<Seen> {
        let (posterior, memory) = match encoded.dim(1)? - 2 * self.latent {
            0 => (Posterior(encoded.clone()), None),
            width => {
                let posterior = encoded.narrow(1, 0, 2 * self.latent)?.contiguous()?;
                (Posterior(posterior), Some(encoded.narrow(1, 2 * self.latent, width)?.contiguous()?))
            }
        };
        let state = State { latent: draw.latent(&posterior)?, action: None, memory };
        let divergences = posterior.divergences(None, draw)?;
        Ok(Seen { state, divergence: posterior.kl_divergence()?, divergences })
    }

    fn act(&self, state: &State, action: &Tensor) -> Result<State> {
        let state = if state.action.is_some() { &self.imagined(state)? } else { state };
        Ok(State { action: Some(action.clone()), ..state.clone() })
    }

    fn decode(&self, state: &State) -> Result<Decoded> {
        let mut decoded = self.decoder.decode(&state.latent, state.action.as_ref())?;
        for modality in self.changes.keys() {
            if let (Some(change), Some(before)) =
                (decoded.get_mut(modality), self.until_before(state, *modality)?)
            {
                *change = (&*change + before)?;
            }
        }
        Ok(decoded)
    }

    fn spreads(&self, state: &State) -> Result<Spreads> {
        self.decoder.spreads(&state.latent, state.action.as_ref())
    }

    fn losses(&self, state: &State, targets: Targets) -> Result<Vec<Term>> {
        let before = |(modality, width): &(Modality, usize)| match self.until_before(state, *modality)? {
            Some(before) => Ok(before),
            None => Tensor::zeros((state.latent.dim(0)?, *width), DType::F32, state.latent.device()),
        };
        let all: usize = self.changes.values().map(Tensor::elem_count).sum();
        let is_imagined = matches!(&state.memory, Some(memory) if memory.dim(1)? > all);
        let added = is_imagined.then(|| {
            let before = self.decoder.vectors().iter().map(before).collect::<Result<Vec<_>>>()?;
            Tensor::cat(&before, 1)
        });
        let added = added.transpose()?;
        self.decoder.losses(
            &state.latent,
            state.action.as_ref(),
            Targets { added: added.as_ref(), ..targets },
        )
    }

    fn detached(&self) -> Box<dyn Network> {
        Box::new(Self {
            encoder: self.encoder.detached(),
            decoder: self.decoder.detached(),
            input: self.input.clone(),
            latent: self.latent,
            changes: self.changes.clone(),
        })
    }
}
