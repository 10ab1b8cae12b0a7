//! The auto-encoder with a memory: a gated recurrent unit between the encoder and the latent state.

use super::description::{Layer, MEMORY, Operation, POSTERIOR};
use super::layers::{Builder, Dense};
use super::{
    Architecture, Decoded, Decoder, Draw, Encoder, Network, Observation, Posterior, Seen, State, Targets,
    Term,
};
use crate::ops::{self, Arithmetic};
use candle_core::{DType, Device, Result, Tensor};

/// Name of the unit's product with its input.
const INPUT: &str = "input";
/// Name of the unit's product with its last state.
const HIDDEN: &str = "hidden";

/// A gated recurrent unit (Cho et al., 2014), and the layer of the posterior after it.
///
/// Its input is the encoded sample, whether there is one, and the action before it. For a sample that is not seen, the
/// encoded sample is zero.
pub struct Unit {
    /// `[3 * width, inputs]`
    input: Dense,
    /// `[3 * width, width]`
    hidden: Dense,
    /// `[2 * latent, width]`
    posterior: Dense,
    /// Width of an encoded sample.
    encoded: usize,
    /// Width of the action.
    action: usize,
    arithmetic: Arithmetic,
}

impl Unit {
    /// Creates the unit that an architecture describes.
    ///
    /// # Errors
    /// When a tensor can't be created on the device.
    pub(super) fn new(architecture: &Architecture, builder: &mut Builder) -> Result<Self> {
        let hidden = &architecture.network.hidden;
        let width = hidden[hidden.len() - 1];
        let (encoded, action) = (2 * architecture.latent, architecture.action);
        let inputs = encoded + 1 + action;
        // All are uniform in ±1/√width, PyTorch's default for this unit.
        let mut product = |name: &str, inputs: usize| {
            Ok::<_, candle_core::Error>(Dense {
                weight: builder.uniform(&format!("{name}.weight"), &[3 * width, inputs], width)?,
                bias: builder.uniform(&format!("{name}.bias"), &[3 * width], width)?,
            })
        };
        let (input, hidden) = (product(INPUT, inputs)?, product(HIDDEN, width)?);
        let posterior = builder.dense(POSTERIOR, width, encoded)?;
        Ok(Self { input, hidden, posterior, encoded, action, arithmetic: architecture.arithmetic })
    }

    fn width(&self) -> Result<usize> {
        self.hidden.weight.dim(1)
    }

    /// Returns the memory after a sample, `[batch, width]`, and the posterior of the latent state. `encoded` is the
    /// sample; `None` if it was not seen.
    fn step(&self, state: &State, encoded: Option<&Tensor>) -> Result<(Tensor, Posterior)> {
        let Some(memory) = &state.memory else { candle_core::bail!("the state has no memory") };
        let (batch, device) = (memory.dim(0)?, memory.device());
        let zeros = |width: usize| Tensor::zeros((batch, width), DType::F32, device);
        let (encoded, seen) = match encoded {
            Some(encoded) => (encoded.clone(), Tensor::ones((batch, 1), DType::F32, device)?),
            None => (zeros(self.encoded)?, zeros(1)?),
        };
        let action = state.action.clone().map_or_else(|| zeros(self.action), Ok)?;
        let input = Tensor::cat(&[&encoded, &seen, &action], 1)?;
        let input = self.input.forward(&input, false, self.arithmetic)?;
        let hidden = self.hidden.forward(memory, false, self.arithmetic)?;
        let memory = ops::gru(&input, &hidden, memory)?;
        let posterior = Posterior(self.posterior.forward(&memory, false, self.arithmetic)?);
        Ok((memory, posterior))
    }

    fn detached(&self) -> Self {
        Self {
            input: self.input.detached(),
            hidden: self.hidden.detached(),
            posterior: self.posterior.detached(),
            ..*self
        }
    }

    /// Describes the layers in the order in which they are applied.
    ///
    /// # Errors
    /// When the shape of a parameter is not that of its layer.
    pub(super) fn layers(&self) -> Result<Vec<Layer>> {
        let dense = [&self.input, &self.hidden];
        let unit = Layer {
            name: MEMORY.into(),
            operation: Operation::GatedRecurrentUnit {
                input_weight: format!("{INPUT}.weight"),
                input_bias: format!("{INPUT}.bias"),
                hidden_weight: format!("{HIDDEN}.weight"),
                hidden_bias: format!("{HIDDEN}.bias"),
            },
            inputs: super::description::UNIT_INPUTS.map(String::from).to_vec(),
            output: vec![self.width()?],
            parameters: dense.iter().map(|of| of.weight.elem_count() + of.bias.elem_count()).sum(),
        };
        Ok(vec![unit, self.posterior.layer(POSTERIOR, MEMORY, false)?])
    }
}

/// An encoder, a recurrent unit, and a decoder of the latent state and the action.
pub struct Recurrent {
    pub(super) encoder: Box<dyn Encoder>,
    pub(super) unit: Unit,
    pub(super) decoder: Box<dyn Decoder>,
}

impl Network for Recurrent {
    fn start(&self, batch: usize, device: &Device) -> Result<Option<State>> {
        let zeros = |width: usize| Tensor::zeros((batch, width), DType::F32, device);
        let (latent, memory) = (zeros(self.unit.encoded / 2)?, zeros(self.unit.width()?)?);
        Ok(Some(State { latent, action: None, memory: Some(memory) }))
    }

    fn encode(&self, seen: &Observation, draw: &mut Draw) -> Result<Tensor> {
        Ok(self.encoder.encode_with_dropout(seen, draw.dropout())?.0)
    }

    fn observe(&self, state: Option<&State>, encoded: &Tensor, draw: &mut Draw) -> Result<Seen> {
        let Some(state) = state else { candle_core::bail!("a network with memory needs a state") };
        let (memory, posterior) = self.unit.step(state, Some(encoded))?;
        let state = State { latent: draw.latent(&posterior)?, action: None, memory: Some(memory) };
        Ok(Seen { state, divergence: posterior.kl_divergence()? })
    }

    fn act(&self, state: &State, action: &Tensor) -> Result<State> {
        if state.action.is_none() {
            return Ok(State { action: Some(action.clone()), ..state.clone() });
        }
        // The sample that the state predicts is not seen.
        let (memory, posterior) = self.unit.step(state, None)?;
        Ok(State { latent: posterior.mean()?, action: Some(action.clone()), memory: Some(memory) })
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
            unit: self.unit.detached(),
            decoder: self.decoder.detached(),
        })
    }
}
