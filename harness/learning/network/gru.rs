//! The memory of a gated recurrent unit.

use super::description::{Layer, MEMORY, Operation, POSTERIOR};
use super::layers::{Builder, Dense};
use super::unit::{Inputs, JOINED, Steps, Unit, memory_of};
use super::{Architecture, Draw, Posterior, Seen, State};
use candle_core::{Result, Tensor};
use harness_ops::{self as ops, Arithmetic, Gated};

/// Name of a unit's product with its input.
const INPUT: &str = "input";
/// Name of a unit's product with its last state.
const HIDDEN: &str = "hidden";

/// The products of a gated recurrent unit (Cho et al., 2014).
pub(super) struct Cell {
    /// `[3 * width, inputs]`
    input: Dense,
    /// `[3 * width, width]`
    hidden: Dense,
    /// Width of the state.
    pub width: usize,
    pub arithmetic: Arithmetic,
}

impl Cell {
    /// Creates a unit as wide as the architecture's last hidden layer.
    pub fn new(architecture: &Architecture, inputs: usize, builder: &mut Builder) -> Result<Self> {
        let hidden = &architecture.network.hidden;
        let width = hidden[hidden.len() - 1];
        // All are uniform in ±1/√width, PyTorch's default for this unit.
        let mut product = |name: &str, inputs: usize| {
            Ok::<_, candle_core::Error>(Dense {
                weight: builder.uniform(&format!("{name}.weight"), &[3 * width, inputs], width)?,
                bias: builder.uniform(&format!("{name}.bias"), &[3 * width], width)?,
            })
        };
        let (input, hidden) = (product(INPUT, inputs)?, product(HIDDEN, width)?);
        Ok(Self { input, hidden, width, arithmetic: architecture.arithmetic })
    }

    /// Returns the unit's states, `[times * batch, width]`, for inputs that follow one another. `last` is the state
    /// before the first time, `[batch, width]`.
    pub fn states(&self, inputs: &Tensor, last: &Tensor) -> Result<Tensor> {
        let [input, hidden] = self.products();
        ops::gru(inputs, input, hidden, last, self.arithmetic)
    }

    /// Returns the parameters of the products with the inputs and with the last state.
    pub fn products(&self) -> [Gated<'_>; 2] {
        [&self.input, &self.hidden].map(|dense| Gated { weight: &dense.weight, bias: &dense.bias })
    }

    pub fn detached(&self) -> Self {
        Self { input: self.input.detached(), hidden: self.hidden.detached(), ..*self }
    }

    /// Describes the unit, which takes these values side by side.
    pub fn layer(&self, inputs: &[&str]) -> Layer {
        let parameters =
            [&self.input, &self.hidden].map(|dense| dense.weight.elem_count() + dense.bias.elem_count());
        Layer {
            name: MEMORY.into(),
            operation: Operation::GatedRecurrentUnit {
                input_weight: format!("{INPUT}.weight"),
                input_bias: format!("{INPUT}.bias"),
                hidden_weight: format!("{HIDDEN}.weight"),
                hidden_bias: format!("{HIDDEN}.bias"),
            },
            inputs: inputs.iter().map(|name| (*name).to_owned()).collect(),
            output: vec![self.width],
            parameters: parameters.iter().sum(),
        }
    }
}

/// A gated recurrent unit, and the layer of the posterior, which takes the unit and the encoded sample. The unit bounds
/// its values and mixes them with those before, so precise values of the present sample do not pass through it.
pub(super) struct Gru {
    inputs: Inputs,
    cell: Cell,
    /// `[2 * latent, width + 2 * latent]`
    posterior: Dense,
}

impl Gru {
    pub fn new(architecture: &Architecture, builder: &mut Builder) -> Result<Self> {
        let inputs = Inputs::new(architecture);
        let cell = Cell::new(architecture, inputs.width(), builder)?;
        let posterior = builder.dense(POSTERIOR, cell.width + inputs.encoded, inputs.encoded)?;
        Ok(Self { inputs, cell, posterior })
    }

    fn steps(&self, inputs: &Tensor, state: &State) -> Result<Steps> {
        let memory = self.cell.states(inputs, memory_of(state)?)?;
        let joined = Tensor::cat(&[&memory, &inputs.narrow(1, 0, self.inputs.encoded)?], 1)?;
        let posterior = Posterior(self.posterior.forward(&joined, false, self.cell.arithmetic)?);
        Ok(Steps { memory, posterior })
    }
}

impl Unit for Gru {
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
        self.steps(&self.inputs.of(state, Some(encoded), between)?, state)?.seen(draw)
    }

    fn unseen(&self, state: &State, between: Option<&Tensor>) -> Result<State> {
        self.steps(&self.inputs.of(state, None, between)?, state)?.unseen()
    }

    fn detached(&self) -> Box<dyn Unit> {
        let (cell, posterior) = (self.cell.detached(), self.posterior.detached());
        Box::new(Self { inputs: self.inputs, cell, posterior })
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        let (cell, joined) = (self.cell.layer(&self.inputs.names()), self.inputs.joined(self.cell.width));
        Ok(vec![cell, joined, self.posterior.layer(POSTERIOR, JOINED, false)?])
    }
}
