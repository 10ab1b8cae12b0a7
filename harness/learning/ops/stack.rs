//! Chained convolutions over a batch of images: what the encoder's and the decoder's way through frames share.

use harness_kernels::convolution::{Convolution, Images, Kernel, KernelSums, LANES};
use harness_kernels::{self as kernels, PARTS};

/// Convolutions from an image's own size down, each 4 x 4 with a stride of 2, the first one first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stack(Vec<Convolution>);

impl Stack {
    /// The convolutions from `frame_channels` channels of `side` pixels to each of `channels` in turn.
    pub fn new(frame_channels: usize, side: usize, channels: &[usize]) -> Self {
        let mut fine = (frame_channels, side);
        let layers = channels.iter().map(|&coarse_channels| {
            let sizes = Convolution { fine_channels: fine.0, coarse_channels, side: fine.1 };
            fine = (coarse_channels, sizes.coarse_side());
            sizes
        });
        Self(layers.collect())
    }

    /// The same stack for frames with another number of channels.
    pub fn with_frame_channels(&self, channels: usize) -> Self {
        let mut layers = self.0.clone();
        if let Some(first) = layers.first_mut() {
            first.fine_channels = channels;
        }
        Self(layers)
    }

    /// The convolutions, the first one first.
    pub fn layers(&self) -> &[Convolution] {
        &self.0
    }

    /// Values of an image before the first convolution.
    pub fn fine_len(&self) -> usize {
        self.0[0].fine_len()
    }

    /// Values of an image after the last one.
    pub fn coarse_len(&self) -> usize {
        self.0[self.0.len() - 1].coarse_len()
    }

    /// One image set a level: before the first convolution, between each two, after the last.
    pub(super) fn levels(&self) -> Vec<Images> {
        let first = self.0.first().map(Convolution::fine);
        first.into_iter().chain(self.0.iter().map(Convolution::coarse)).collect()
    }

    /// Divides packed parameters into each layer's kernel and the bias of `side`, and what is left.
    pub(super) fn unpack<'a>(&self, side: Side, mut packed: &'a [f32]) -> (Vec<Layer<'a>>, &'a [f32]) {
        let layers = self.0.iter().map(|sizes| {
            let (kernel, rest) = packed.split_at(sizes.kernel_len());
            let (bias, rest) = rest.split_at(side.channels(sizes));
            packed = rest;
            let (convolving, spreading) = (sizes.convolving(kernel), sizes.spreading(kernel));
            Layer { sizes: *sizes, convolving, spreading, bias }
        });
        (layers.collect(), packed)
    }
}

/// Which way the convolutions are gone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    /// From fine to coarse: a bias is added to the coarse image.
    Encoder,
    /// From coarse to fine: a bias is added to the fine image.
    Decoder,
}

impl Side {
    fn channels(self, sizes: &Convolution) -> usize {
        match self {
            Self::Encoder => sizes.coarse_channels,
            Self::Decoder => sizes.fine_channels,
        }
    }
}

/// A convolution's sizes and parameters.
pub(super) struct Layer<'a> {
    pub sizes: Convolution,
    pub convolving: Kernel,
    pub spreading: Kernel,
    pub bias: &'a [f32],
}

/// Images in a part of a batch of so many: whole groups, so that a part depends on the batch alone.
pub(super) fn part_len(batch: usize) -> usize {
    batch.div_ceil(PARTS).next_multiple_of(LANES)
}

/// What a part of the batch adds to the gradients of a stack's kernels and biases.
pub(super) struct StackSums {
    kernels: Vec<KernelSums>,
    biases: Vec<Vec<f32>>,
}

impl StackSums {
    pub fn new(stack: &Stack, side: Side) -> Self {
        Self {
            kernels: stack.0.iter().map(|sizes| KernelSums::new(*sizes)).collect(),
            biases: stack.0.iter().map(|sizes| vec![0.0; side.channels(sizes)]).collect(),
        }
    }

    /// Adds what layer `index` contributes: the gradient of its kernel between two levels, and of its bias by the
    /// gradient on the side where that is added.
    pub fn add(
        &mut self,
        index: usize,
        sizes: &Convolution,
        fine: &Images,
        coarse: &Images,
        biased: &Images,
    ) {
        sizes.add_kernel_gradient(fine, coarse, &mut self.kernels[index]);
        biased.add_channel_sums(&mut self.biases[index]);
    }

    /// The gradients, packed as the parameters are.
    pub fn packed(&self) -> Vec<f32> {
        let layers = self.kernels.iter().zip(&self.biases);
        layers.flat_map(|(kernel, bias)| kernel.total().into_iter().chain(bias.iter().copied())).collect()
    }
}

/// Adds up the packed gradients of parts, in their order.
pub(super) fn sum_packed(parts: Vec<Vec<f32>>) -> Vec<f32> {
    let len = parts.first().map_or(0, Vec::len);
    kernels::sum_in_order(parts, len)
}
