//! Arguments of ops that have several parts.

use crate::{Arithmetic, Stack};
use candle_core::Tensor;
use harness_spec::Loss;

/// The parameters between the decoder's hidden layer and a frame.
#[derive(Clone)]
pub struct FrameDecoder {
    /// The convolutions. They are applied transposed, so the last one of the stack comes first.
    pub stack: Stack,
    /// Weight of the fully connected layer, `[values of the stack's last layer, hidden]`.
    pub weight: Tensor,
    /// The kernel `[channels, channels before, 4, 4]` of each convolution and the bias `[channels before]` of its
    /// transpose, in the stack's order. The bias of the fully connected layer follows them.
    pub packed: Tensor,
    /// How matrix products are computed.
    pub arithmetic: Arithmetic,
}

/// Weights and biases of both layers.
pub struct TwoLayers<'a> {
    /// Weight of the hidden layer, `[hidden, in]`.
    pub hidden_weight: &'a Tensor,
    /// Bias of the hidden layer, `[hidden]`.
    pub hidden_bias: &'a Tensor,
    /// Weight of the output layer, `[out, hidden]`.
    pub weight: &'a Tensor,
    /// Bias of the output layer, `[out]`.
    pub bias: &'a Tensor,
}

/// The weight `[3 * width, columns]` and the bias `[3 * width]` of one of a unit's products. The rows of the gates r, z
/// and n follow one another.
pub struct Gated<'a> {
    /// The weight.
    pub weight: &'a Tensor,
    /// The bias.
    pub bias: &'a Tensor,
}

/// The parameters of a recurrent state-space model whose memory has `width` values.
pub struct StateSpace<'a> {
    /// The unit's product with the last latent state and the action after it, `[3 * width, latent + action]`.
    pub input: Gated<'a>,
    /// The unit's product with the last memory, `[3 * width, width]`.
    pub hidden: Gated<'a>,
    /// The distribution of the latent state, `[2 * latent]`, from the memory and the encoded sample.
    pub distribution: TwoLayers<'a>,
}

/// What a model is given at each time. The rows of one time lie together.
pub struct Sequences<'a> {
    /// The action before each time, `[times * batch, action]`.
    pub actions: &'a Tensor,
    /// The encoded samples, `[times * batch, columns]`; `None` if the distribution follows from the memory alone.
    pub encoded: Option<&'a Tensor>,
    /// Standard normal noise, `[times * batch, latent]`; `None` if the latent state is the mean of its distribution.
    pub noise: Option<&'a Tensor>,
}

/// The number of columns of a quantity, and its loss.
#[derive(Debug, Clone, Copy)]
pub struct Quantity {
    /// Number of columns.
    pub width: usize,
    /// Loss of each value's error.
    pub loss: Loss,
}

/// Sizes of the matrices of a recurrent state-space model.
#[derive(Clone, Copy)]
pub(crate) struct Sizes {
    /// Number of sequences.
    pub batch: usize,
    pub times: usize,
    /// Width of the memory.
    pub width: usize,
    /// Width of the hidden layer.
    pub units: usize,
    /// Size of the latent state.
    pub latent: usize,
    pub arithmetic: Arithmetic,
}

impl Sizes {
    pub fn rows(self) -> usize {
        self.times * self.batch
    }

    pub fn gates(self) -> usize {
        3 * self.width
    }

    /// Lengths of the parameters of the products at each time, and of the memory and the latent state before the first
    /// time: the weight of the latent state `[3 * width, latent]`, the unit's weight `[3 * width, width]` and bias, the
    /// weight of the memory in the hidden layer `[units, width]`, and the distribution's weight `[2 * latent, units]`
    /// and bias.
    pub fn packed(self) -> [usize; 8] {
        let Self { batch, width, units, latent, .. } = self;
        let gates = self.gates();
        [
            gates * latent,
            gates * width,
            gates,
            units * width,
            2 * latent * units,
            2 * latent,
            batch * width,
            batch * latent,
        ]
    }

    /// Lengths of the memories and of the distributions.
    pub fn results(self) -> [usize; 2] {
        [self.rows() * self.width, self.rows() * 2 * self.latent]
    }
}
