//! A 4 x 4 convolution of stride 2 with a padding of one pixel, its transpose, and the gradient of its kernel.
//!
//! Done directly instead of by patches and a matrix product: with a stride of 2, each of the kernel's columns sees
//! either the even or the odd columns of an image. Laid out so, with a border of zeros, every sum runs over values
//! that lie side by side, and no patches have to be written.

// Sums that are indexed by constants stay in registers; behind an iterator they would not.
#![allow(clippy::needless_range_loop, clippy::manual_memcpy)]

use super::simd;
use pulp::{Simd, WithSimd};

/// Side of the kernel, pixels.
const KERNEL: usize = 4;
/// Step of the convolution, pixels.
const STRIDE: usize = 2;
/// Weights of one pair of channels.
pub const TAPS: usize = KERNEL * KERNEL;
/// Places of a row that lie side by side in every layout: two of the widest vectors.
const LANES: usize = 32;
/// Values of the widest vector.
const SUM_LANES: usize = 16;
/// Coarse channels that are computed at once.
const CHANNELS: usize = 8;

/// Sizes of the convolution.
///
/// The fine side has `fine_channels` x `side` x `side` values, the coarse side `coarse_channels` x `side / 2` x
/// `side / 2`. The convolution leads from fine to coarse, its transpose back. The kernel is `[coarse, fine, 4, 4]`,
/// which is both PyTorch's `Conv2d` layout and its `ConvTranspose2d` layout for the opposite direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Convolution {
    pub fine_channels: usize,
    pub coarse_channels: usize,
    pub side: usize,
}

impl Convolution {
    /// Side of the coarse image, pixels.
    pub fn coarse_side(&self) -> usize {
        self.side / STRIDE
    }

    /// Places of a coarse channel.
    pub fn positions(&self) -> usize {
        self.coarse_side() * self.coarse_side()
    }

    /// Values of a fine image.
    pub fn fine_len(&self) -> usize {
        self.fine_channels * self.side * self.side
    }

    /// Values of a coarse image.
    pub fn coarse_len(&self) -> usize {
        self.coarse_channels * self.positions()
    }

    /// Values of the kernel.
    pub fn kernel_len(&self) -> usize {
        self.coarse_channels * self.fine_channels * TAPS
    }

    /// `coarse` `[coarse, side / 2, side / 2]`: the convolution of `fine`, without a bias.
    pub fn convolve(&self, fine: &Fine, kernel: &[f32], coarse: &mut [f32]) {
        simd(Convolve { sizes: *self, fine, kernel, coarse });
    }

    /// `fine` `[fine, side, side]`: the transposed convolution of `coarse`, on top of `bias` `[fine]`.
    pub fn spread(&self, coarse: &Coarse, kernel: &[f32], bias: &[f32], fine: &mut [f32]) {
        for (channel, image) in fine.chunks_exact_mut(self.side * self.side).enumerate() {
            simd(Spread { sizes: *self, coarse, kernel, channel, bias: bias[channel], image });
        }
    }

    /// Adds to `sums` what `fine` and the gradient `coarse` of its convolution give for the kernel's gradient.
    pub fn add_kernel_gradient(&self, fine: &Fine, coarse: &Coarse, sums: &mut KernelSums) {
        simd(AddKernelGradient { sizes: *self, fine, coarse, sums: &mut sums.0 });
    }
}

/// A fine image, each row as its odd and its even columns, with a border of zeros.
pub struct Fine {
    values: Vec<f32>,
    side: usize,
    /// Values between the beginnings of two lines.
    stride: usize,
}

impl Fine {
    /// Zeros.
    pub fn new(sizes: Convolution) -> Self {
        let stride = padded(sizes.coarse_side());
        Self {
            values: vec![0.0; sizes.fine_channels * (sizes.side + 2) * 2 * stride],
            side: sizes.side,
            stride,
        }
    }

    /// Takes an image `[fine, side, side]`.
    pub fn set(&mut self, image: &[f32]) {
        let (side, stride) = (self.side, self.stride);
        simd(
            #[inline(always)]
            || {
                for (index, row) in image.chunks_exact(side).enumerate() {
                    let line = line_of(index, side) * 2;
                    let (even, odd) = self.values[line * stride..][..2 * stride].split_at_mut(stride);
                    for ((pair, even), odd) in row.as_chunks::<2>().0.iter().zip(even).zip(&mut odd[1..]) {
                        *even = pair[0];
                        *odd = pair[1];
                    }
                }
            },
        );
    }

    /// What column `tap_column` of the kernel sees where its row `tap_row` lies for the coarse row `row`, and all
    /// that follows.
    #[inline(always)]
    fn lines(&self, channel: usize, row: usize, tap_row: usize, tap_column: usize) -> &[f32] {
        // Image column = 2 * place + tap column - 1. Odd columns lie behind one zero, even ones before it.
        let (odd, first) = [(true, 0), (false, 0), (true, 1), (false, 1)][tap_column];
        let line = (channel * (self.side + 2) + STRIDE * row + tap_row) * 2 + usize::from(odd);
        &self.values[line * self.stride + first..]
    }
}

/// A coarse image with a border of zeros.
pub struct Coarse {
    values: Vec<f32>,
    side: usize,
    stride: usize,
}

impl Coarse {
    /// Zeros.
    pub fn new(sizes: Convolution) -> Self {
        let (side, stride) = (sizes.coarse_side(), padded(sizes.coarse_side()));
        Self { values: vec![0.0; sizes.coarse_channels * (side + 2) * stride], side, stride }
    }

    /// Takes `relu(image + bias)`, both `[coarse, side, side]`.
    pub fn set_active(&mut self, image: &[f32], bias: &[f32]) {
        self.set(
            image,
            bias,
            #[inline(always)]
            |value, bias| (value + bias).max(0.0),
        );
    }

    /// Takes the gradient before a ReLU, given the one after it and its output, all `[coarse, side, side]`.
    pub fn set_masked(&mut self, grad: &[f32], output: &[f32]) {
        self.set(
            grad,
            output,
            #[inline(always)]
            |grad, output| if output > 0.0 { grad } else { 0.0 },
        );
    }

    /// Adds the sum of each channel to `sums` `[coarse]`.
    pub fn add_channel_sums(&self, sums: &mut [f32]) {
        // The border adds zeros.
        let channels = self.values.chunks_exact((self.side + 2) * self.stride);
        sums.iter_mut().zip(channels).for_each(|(sum, channel)| *sum += super::sum(channel));
    }

    /// Sets `grad` to zero where this image, the output of a ReLU, is zero.
    pub fn mask(&self, grad: &mut [f32]) {
        let (side, stride) = (self.side, self.stride);
        simd(
            #[inline(always)]
            || {
                for (index, row) in grad.chunks_exact_mut(side).enumerate() {
                    let line = &self.values[line_of(index, side) * stride + 1..][..side];
                    for (grad, output) in row.iter_mut().zip(line) {
                        *grad = if *output > 0.0 { *grad } else { 0.0 };
                    }
                }
            },
        );
    }

    #[inline(always)]
    fn set(&mut self, a: &[f32], b: &[f32], of: impl Fn(f32, f32) -> f32) {
        let (side, stride) = (self.side, self.stride);
        simd(
            #[inline(always)]
            || {
                for (index, (a, b)) in a.chunks_exact(side).zip(b.chunks_exact(side)).enumerate() {
                    let line = &mut self.values[line_of(index, side) * stride + 1..][..side];
                    for ((value, a), b) in line.iter_mut().zip(a).zip(b) {
                        *value = of(*a, *b);
                    }
                }
            },
        );
    }

    /// The line of `row` and all that follow. The row above the first is row 0, the column before the first is at
    /// place 0.
    #[inline(always)]
    fn lines(&self, channel: usize, row: usize) -> &[f32] {
        &self.values[(channel * (self.side + 2) + row) * self.stride..]
    }
}

/// The line of an image with a border above and below that holds row `index`, counted through all channels.
#[inline(always)]
fn line_of(index: usize, side: usize) -> usize {
    index / side * (side + 2) + index % side + 1
}

/// Length of a line of `side` values with a zero on either side, and room to read whole groups of lanes from it.
fn padded(side: usize) -> usize {
    side.next_multiple_of(LANES) + SUM_LANES
}

/// Sums of a kernel's gradient `[coarse, fine, 4, 4]`, kept in several lanes to the end.
pub struct KernelSums(Vec<[f32; SUM_LANES]>);

impl KernelSums {
    /// Zeros.
    pub fn new(sizes: Convolution) -> Self {
        Self(vec![[0.0; SUM_LANES]; sizes.kernel_len()])
    }

    /// The gradient.
    pub fn total(&self) -> Vec<f32> {
        self.0.iter().map(|lanes| lanes.iter().sum()).collect()
    }
}

/// Vectors that are computed at once, of places side by side.
const GROUP: usize = 2;

/// The vectors of a line from place `from` on.
///
/// Here and below, SIMD values stay out of closures that the standard library calls: those are compiled for the
/// plainest processor, and would pass them through memory.
#[inline(always)]
fn vectors<S: Simd>(line: &[f32], from: usize) -> &[S::f32s] {
    S::as_simd_f32s(&line[from..]).0
}

struct Convolve<'a> {
    sizes: Convolution,
    fine: &'a Fine,
    kernel: &'a [f32],
    coarse: &'a mut [f32],
}

impl WithSimd for Convolve<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { sizes, fine, kernel, coarse } = self;
        let (side, taps) = (sizes.coarse_side(), sizes.fine_channels * TAPS);
        for first_channel in (0..sizes.coarse_channels).step_by(CHANNELS) {
            let channels = (sizes.coarse_channels - first_channel).min(CHANNELS);
            // Channels past the last repeat it, and are not written.
            let weights: [&[f32]; CHANNELS] = std::array::from_fn(|channel| {
                &kernel[(first_channel + channel.min(channels - 1)) * taps..][..taps]
            });
            for row in 0..side {
                for place in (0..side).step_by(GROUP * S::F32_LANES) {
                    let mut sums = [[simd.splat_f32s(0.0); GROUP]; CHANNELS];
                    for fine_channel in 0..sizes.fine_channels {
                        for tap_row in 0..KERNEL {
                            let tap = (fine_channel * KERNEL + tap_row) * KERNEL;
                            for tap_column in 0..KERNEL {
                                let line = fine.lines(fine_channel, row, tap_row, tap_column);
                                let seen = &vectors::<S>(line, place)[..GROUP];
                                for channel in 0..CHANNELS {
                                    let weight = simd.splat_f32s(weights[channel][tap + tap_column]);
                                    for vector in 0..GROUP {
                                        sums[channel][vector] =
                                            simd.mul_add_f32s(weight, seen[vector], sums[channel][vector]);
                                    }
                                }
                            }
                        }
                    }
                    for channel in 0..channels {
                        let line = &mut coarse[((first_channel + channel) * side + row) * side..][..side];
                        for vector in 0..GROUP {
                            let place = (place + vector * S::F32_LANES).min(side);
                            let places = (side - place).min(S::F32_LANES);
                            simd.partial_store_f32s(&mut line[place..place + places], sums[channel][vector]);
                        }
                    }
                }
            }
        }
    }
}

/// One channel of the fine image, `[side, side]`.
///
/// A fine row or column of even index `2 u` is reached by the kernel's places 1 (from coarse index `u`) and 3 (from
/// `u - 1`), one of odd index `2 u + 1` by 0 (from `u + 1`) and 2 (from `u`).
struct Spread<'a> {
    sizes: Convolution,
    coarse: &'a Coarse,
    kernel: &'a [f32],
    channel: usize,
    bias: f32,
    image: &'a mut [f32],
}

impl WithSimd for Spread<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { sizes, coarse, kernel, channel, bias, image } = self;
        let side = coarse.side;
        // Even and odd columns of an even and an odd row.
        let mut lines = [[[0.0f32; LANES]; 2]; 2];
        for row in 0..side {
            for group in (0..side).step_by(LANES) {
                for place in (group..side.min(group + LANES)).step_by(GROUP * S::F32_LANES) {
                    let mut sums = [[[simd.splat_f32s(bias); GROUP]; 2]; 2];
                    for coarse_channel in 0..sizes.coarse_channels {
                        let kernel =
                            &kernel[(coarse_channel * sizes.fine_channels + channel) * TAPS..][..TAPS];
                        let upper = coarse.lines(coarse_channel, row);
                        let middle = coarse.lines(coarse_channel, row + 1);
                        let lower = coarse.lines(coarse_channel, row + 2);
                        let [even, odd] = &mut sums;
                        add_line(simd, even, middle, place, &kernel[KERNEL..]);
                        add_line(simd, even, upper, place, &kernel[3 * KERNEL..]);
                        add_line(simd, odd, lower, place, kernel);
                        add_line(simd, odd, middle, place, &kernel[2 * KERNEL..]);
                    }
                    // Constant indices keep the sums in registers.
                    for row in 0..2 {
                        for column in 0..2 {
                            let line = &mut lines[row][column][place - group..];
                            let (vectors, _) = S::as_mut_simd_f32s(line);
                            for vector in 0..GROUP {
                                vectors[vector] = sums[row][column][vector];
                            }
                        }
                    }
                }
                let places = (side - group).min(LANES);
                for (parity, [even, odd]) in lines.iter().enumerate() {
                    let start = (2 * row + parity) * sizes.side + 2 * group;
                    let pairs = image[start..start + 2 * places].as_chunks_mut::<2>().0;
                    for ((pair, even), odd) in pairs.iter_mut().zip(even).zip(odd) {
                        *pair = [*even, *odd];
                    }
                }
            }
        }
    }
}

/// Adds to the even and the odd columns of a fine row what a coarse `line` gives, by one row of the kernel.
#[inline(always)]
fn add_line<S: Simd>(simd: S, sums: &mut [[S::f32s; GROUP]; 2], line: &[f32], place: usize, kernel: &[f32]) {
    let (before, at, after) =
        (vectors::<S>(line, place), vectors::<S>(line, place + 1), vectors::<S>(line, place + 2));
    let kernel = &kernel[..KERNEL];
    let (left, middle_left) = (simd.splat_f32s(kernel[0]), simd.splat_f32s(kernel[1]));
    let (middle_right, right) = (simd.splat_f32s(kernel[2]), simd.splat_f32s(kernel[3]));
    let [even, odd] = sums;
    for vector in 0..GROUP {
        even[vector] = simd.mul_add_f32s(right, before[vector], even[vector]);
        even[vector] = simd.mul_add_f32s(middle_left, at[vector], even[vector]);
        odd[vector] = simd.mul_add_f32s(left, after[vector], odd[vector]);
        odd[vector] = simd.mul_add_f32s(middle_right, at[vector], odd[vector]);
    }
}

struct AddKernelGradient<'a> {
    sizes: Convolution,
    fine: &'a Fine,
    coarse: &'a Coarse,
    sums: &'a mut [[f32; SUM_LANES]],
}

impl WithSimd for AddKernelGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        /// Coarse channels at once.
        const BLOCK: usize = 4;
        let Self { sizes, fine, coarse, sums } = self;
        let side = coarse.side;
        let (count, stride) = (side.div_ceil(S::F32_LANES), coarse.stride / S::F32_LANES);
        for first_channel in (0..sizes.coarse_channels).step_by(BLOCK) {
            let channels: [usize; BLOCK] =
                std::array::from_fn(|channel| (first_channel + channel).min(sizes.coarse_channels - 1));
            for fine_channel in 0..sizes.fine_channels {
                for tap_row in 0..KERNEL {
                    let mut block = [[simd.splat_f32s(0.0); KERNEL]; BLOCK];
                    // Lines are whole vectors long, so that one index leads through all of them.
                    let grads: [&[S::f32s]; BLOCK] =
                        std::array::from_fn(|channel| vectors::<S>(coarse.lines(channels[channel], 1), 1));
                    let seen: [&[S::f32s]; KERNEL] = std::array::from_fn(|tap_column| {
                        vectors::<S>(fine.lines(fine_channel, 0, tap_row, tap_column), 0)
                    });
                    for row in 0..side {
                        for place in 0..count {
                            let (at, seen_at) = (row * stride + place, row * 2 * STRIDE * stride + place);
                            let (grads_0, grads_1) = (grads[0][at], grads[1][at]);
                            let (grads_2, grads_3) = (grads[2][at], grads[3][at]);
                            for tap in 0..KERNEL {
                                let seen = seen[tap][seen_at];
                                block[0][tap] = simd.mul_add_f32s(grads_0, seen, block[0][tap]);
                                block[1][tap] = simd.mul_add_f32s(grads_1, seen, block[1][tap]);
                                block[2][tap] = simd.mul_add_f32s(grads_2, seen, block[2][tap]);
                                block[3][tap] = simd.mul_add_f32s(grads_3, seen, block[3][tap]);
                            }
                        }
                    }
                    for channel in 0..BLOCK.min(sizes.coarse_channels - first_channel) {
                        let first_tap = ((first_channel + channel) * sizes.fine_channels + fine_channel)
                            * TAPS
                            + tap_row * KERNEL;
                        for tap in 0..KERNEL {
                            let sum = &mut S::as_mut_simd_f32s(&mut sums[first_tap + tap]).0[0];
                            *sum = simd.add_f32s(*sum, block[channel][tap]);
                        }
                    }
                }
            }
        }
    }
}
