//! A chain of convolutions over a batch of images, which the encoder applies, and the decoder applies transposed.

use harness_kernels::convolution::{Convolution, Images, Kernel, KernelSums, LANES};
use harness_kernels::{self as kernels, PARTS};

/// Convolutions of 4 x 4 with a stride of 2. The first one reads the frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stack(Vec<Convolution>);

impl Stack {
    /// Creates the convolutions for frames with `frame_channels` channels of `size` rows and columns. `channels` are
    /// the output channels of each convolution.
    pub fn new(frame_channels: usize, size: [usize; 2], channels: &[usize]) -> Self {
        let mut fine = (frame_channels, size);
        let layers = channels.iter().map(|&coarse_channels| {
            let sizes = Convolution { fine_channels: fine.0, coarse_channels, size: fine.1 };
            fine = (coarse_channels, sizes.coarse_size());
            sizes
        });
        Self(layers.collect())
    }

    /// Returns the same stack for frames with another number of channels.
    pub fn with_frame_channels(&self, channels: usize) -> Self {
        let mut layers = self.0.clone();
        if let Some(first) = layers.first_mut() {
            first.fine_channels = channels;
        }
        Self(layers)
    }

    /// Returns the convolutions. The first one reads the frame.
    pub fn layers(&self) -> &[Convolution] {
        &self.0
    }

    /// Returns the number of values of an image before the first convolution.
    pub fn fine_len(&self) -> usize {
        self.0[0].fine_len()
    }

    /// Returns the number of values of an image after the last convolution.
    pub fn coarse_len(&self) -> usize {
        self.0[self.0.len() - 1].coarse_len()
    }

    /// Creates buffers for the images at all levels: before the first convolution, between each two, and after the
    /// last.
    pub(super) fn levels(&self) -> Vec<Images> {
        let first = self.0.first().map(Convolution::fine);
        first.into_iter().chain(self.0.iter().map(Convolution::coarse)).collect()
    }

    /// Splits packed parameters into each layer's kernel and bias, and returns the remaining values too. `side` says
    /// whether the biases belong to an encoder or a decoder.
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

/// The direction in which the convolutions are applied.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    /// From fine to coarse. The bias is added to the coarse image.
    Encoder,
    /// From coarse to fine. The bias is added to the fine image.
    Decoder,
}

impl Side {
    /// Returns the number of channels of the image that the bias is added to.
    pub fn channels(self, sizes: &Convolution) -> usize {
        match self {
            Self::Encoder => sizes.coarse_channels,
            Self::Decoder => sizes.fine_channels,
        }
    }
}

/// A convolution's sizes and parameters.
pub(super) struct Layer<'a> {
    pub sizes: Convolution,
    /// The kernel, packed for the convolution.
    pub convolving: Kernel,
    /// The kernel, packed for the transposed convolution.
    pub spreading: Kernel,
    /// One value for each channel of the image that the bias is added to.
    pub bias: &'a [f32],
}

/// Returns the number of images in a part of a batch. A part has whole groups of [`LANES`] images, and its size depends
/// on the batch alone.
pub(super) fn part_len(batch: usize) -> usize {
    batch.div_ceil(PARTS).next_multiple_of(LANES)
}

/// Sums of the gradients of a stack's kernels and biases over one part of the batch.
pub(super) struct StackSums {
    kernels: Vec<KernelSums>,
    biases: Vec<Vec<f32>>,
}

impl StackSums {
    /// Creates sums of zero.
    pub fn new(stack: &Stack, side: Side) -> Self {
        Self {
            kernels: stack.0.iter().map(|sizes| KernelSums::new(*sizes)).collect(),
            biases: stack.0.iter().map(|sizes| vec![0.0; side.channels(sizes)]).collect(),
        }
    }

    /// Adds the gradients of layer `index`. One of `fine` and `coarse` is the layer's input, and the other one is the
    /// gradient of its output. `biased` is the gradient of the image that the bias was added to.
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

    /// Returns the gradients in the order of the packed parameters.
    pub fn packed(&self) -> Vec<f32> {
        let layers = self.kernels.iter().zip(&self.biases);
        layers.flat_map(|(kernel, bias)| kernel.total().into_iter().chain(bias.iter().copied())).collect()
    }
}

/// Sums the packed gradients of the parts, in their order.
pub(super) fn sum_packed(parts: Vec<Vec<f32>>) -> Vec<f32> {
    let len = parts.first().map_or(0, Vec::len);
    kernels::sum_in_order(parts, len)
}
