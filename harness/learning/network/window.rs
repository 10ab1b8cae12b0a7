//! The memory of the last samples, side by side.

use super::description::{Layer, MEMORY, Operation, POSTERIOR};
use super::layers::{Builder, Perceptron};
use super::unit::{Inputs, Steps, Unit, memory_of};
use super::{Architecture, Draw, Posterior, Seen, State};
use candle_core::{Result, Tensor};

/// Name of the layers between the samples and the posterior.
const HIDDEN: &str = "hidden";

/// The last samples side by side, the latest first, and a perceptron with one hidden layer that gives the posterior.
///
/// The memory has all of them but the oldest, which the next sample replaces. Samples before the first one are zero.
pub(super) struct LastSamples {
    inputs: Inputs,
    /// Number of samples, at least 2.
    samples: usize,
    posterior: Perceptron,
}

impl LastSamples {
    pub fn new(architecture: &Architecture, builder: &mut Builder) -> Result<Self> {
        let (inputs, network) = (Inputs::new(architecture), &architecture.network);
        let samples = network.memory_samples;
        let width = network.hidden[network.hidden.len() - 1];
        let hidden = builder.perceptron(HIDDEN, &[samples * inputs.width(), width])?;
        let posterior = hidden.then(POSTERIOR, builder.dense(POSTERIOR, width, inputs.encoded)?);
        Ok(Self { inputs, samples, posterior })
    }

    fn steps(&self, inputs: &Tensor, state: &State) -> Result<Steps> {
        let (memory, rows, width) = (memory_of(state)?, inputs.dim(0)?, self.inputs.width());
        // All samples in the order of time, the oldest first.
        let earlier = (1..self.samples).rev().map(|ago| memory.narrow(1, (ago - 1) * width, width));
        let all = earlier.chain([Ok(inputs.clone())]).collect::<Result<Vec<_>>>()?;
        let (batch, all) = (memory.dim(0)?, Tensor::cat(&all, 0)?);
        let ago = |ago: usize| all.narrow(0, (self.samples - 1 - ago) * batch, rows);
        let joined = Tensor::cat(&(0..self.samples).map(ago).collect::<Result<Vec<_>>>()?, 1)?;
        let posterior = Posterior(self.posterior.forward(&joined, false)?);
        Ok(Steps { memory: joined.narrow(1, 0, self.width())?.contiguous()?, posterior })
    }
}

impl Unit for LastSamples {
    fn width(&self) -> usize {
        (self.samples - 1) * self.inputs.width()
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
        Box::new(Self { inputs: self.inputs, samples: self.samples, posterior: self.posterior.detached() })
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        let last = Layer {
            name: MEMORY.into(),
            operation: Operation::LastSamples { samples: self.samples },
            inputs: self.inputs.names().into_iter().map(String::from).collect(),
            output: vec![self.samples * self.inputs.width()],
            parameters: 0,
        };
        Ok([vec![last], self.posterior.layers(MEMORY, false)?].concat())
    }
}
