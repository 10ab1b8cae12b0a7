//! 4 x 4 convolutions of stride 2 with a padding of one pixel, their transposes, and the gradients of their kernels.
//!
//! Sixteen images are computed side by side: a vector holds the same pixel of all of them. So every sum is one
//! multiplication and addition a vector whatever the image's size, no pixel has to be moved within a vector, and layers
//! chain to any depth. Sixteen images with all their layers fit in a core's second-level cache.

// Sums that are indexed by constants stay in registers; behind an iterator they would not.
#![allow(clippy::needless_range_loop)]

use super::simd;
use pulp::{Simd, WithSimd};

/// Images side by side.
pub const LANES: usize = 16;
/// Side of the kernel, pixels.
const KERNEL: usize = 4;
/// Step of the convolution, pixels.
const STRIDE: usize = 2;
/// Weights of one pair of channels.
pub const TAPS: usize = KERNEL * KERNEL;
/// Coarse places of a row that are computed at once.
const PLACES: usize = 4;
/// Fine columns that the convolution sees from as many coarse places.
const SEEN: usize = STRIDE * PLACES + 2;

/// Sizes of a convolution.
///
/// The fine side has `fine_channels` x `side` x `side` values, the coarse side `coarse_channels` x `side / 2` x
/// `side / 2`. The convolution leads from fine to coarse, its transpose back. The kernel is `[coarse, fine, 4, 4]`,
/// which is both PyTorch's `Conv2d` layout and its `ConvTranspose2d` layout for the opposite direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Convolution {
    pub fine_channels: usize,
    pub coarse_channels: usize,
    /// Of the fine image, pixels; even.
    pub side: usize,
}

impl Convolution {
    /// Side of the coarse image, pixels.
    pub fn coarse_side(&self) -> usize {
        self.side / STRIDE
    }

    /// Values of a fine image.
    pub fn fine_len(&self) -> usize {
        self.fine_channels * self.side * self.side
    }

    /// Values of a coarse image.
    pub fn coarse_len(&self) -> usize {
        self.coarse_channels * self.coarse_side() * self.coarse_side()
    }

    /// Values of the kernel.
    pub fn kernel_len(&self) -> usize {
        self.coarse_channels * self.fine_channels * TAPS
    }

    /// Zeros of the fine side.
    pub fn fine(&self) -> Images {
        Images::new(self.fine_channels, self.side)
    }

    /// Zeros of the coarse side.
    pub fn coarse(&self) -> Images {
        Images::new(self.coarse_channels, self.coarse_side())
    }

    /// `coarse`: the convolution of `fine`, without a bias.
    pub fn convolve(&self, fine: &Images, kernel: &[f32], coarse: &mut Images) {
        self.check(fine, kernel.len(), coarse);
        simd(Convolve { sizes: *self, fine, kernel, coarse });
    }

    /// `fine`: the transposed convolution of `coarse`, without a bias.
    pub fn spread(&self, coarse: &Images, kernel: &[f32], fine: &mut Images) {
        self.check(fine, kernel.len(), coarse);
        simd(Spread { sizes: *self, coarse, kernel, fine });
    }

    /// Adds to `sums` what `fine` and the gradient `coarse` of its convolution give for the kernel's gradient.
    pub fn add_kernel_gradient(&self, fine: &Images, coarse: &Images, sums: &mut KernelSums) {
        self.check(fine, sums.0.len(), coarse);
        simd(AddKernelGradient { sizes: *self, fine, coarse, sums: &mut sums.0 });
    }

    fn check(&self, fine: &Images, kernel_len: usize, coarse: &Images) {
        assert_eq!((fine.channels, fine.side), (self.fine_channels, self.side), "the fine images");
        assert_eq!(
            (coarse.channels, coarse.side),
            (self.coarse_channels, self.coarse_side()),
            "the coarse images"
        );
        assert_eq!(kernel_len, self.kernel_len(), "the kernel");
    }
}

/// Sixteen images `[channel, row, column, image]` with a border of zeros.
pub struct Images {
    values: Vec<[f32; LANES]>,
    channels: usize,
    side: usize,
    /// Columns of a row with its border and room to read whole groups of places from it.
    columns: usize,
}

impl Images {
    /// Zeros.
    pub fn new(channels: usize, side: usize) -> Self {
        let columns = side.next_multiple_of(STRIDE * PLACES) + 2;
        Self { values: vec![[0.0; LANES]; channels * (side + 2) * columns], channels, side, columns }
    }

    /// Values of one image.
    pub fn image_len(&self) -> usize {
        self.channels * self.side * self.side
    }

    /// Takes images that lie one after the other, each `[channel, row, column]`; those past the last are zero.
    pub fn set(&mut self, images: &[f32]) {
        let (side, len) = (self.side, self.image_len());
        for (index, row) in self.rows_mut().enumerate() {
            // Blocks of a few columns read whole cache lines of every image once.
            for (block, columns) in row.chunks_mut(LANES).enumerate() {
                let first = index * side + block * LANES;
                let mut lines = [[0.0; LANES]; LANES];
                for (line, image) in lines.iter_mut().zip(images.chunks_exact(len)) {
                    line[..columns.len()].copy_from_slice(&image[first..first + columns.len()]);
                }
                for (column, values) in columns.iter_mut().enumerate() {
                    *values = std::array::from_fn(|lane| lines[lane][column]);
                }
            }
        }
    }

    /// The reverse of [`Images::set`]: writes as many images as there is room for.
    pub fn write(&self, images: &mut [f32]) {
        let (side, len) = (self.side, self.image_len());
        for (index, row) in self.rows().enumerate() {
            for (block, columns) in row.chunks(LANES).enumerate() {
                let first = index * side + block * LANES;
                let mut lines = [[0.0; LANES]; LANES];
                for (column, values) in columns.iter().enumerate() {
                    (0..LANES).for_each(|lane| lines[lane][column] = values[lane]);
                }
                for (line, image) in lines.iter().zip(images.chunks_exact_mut(len)) {
                    image[first..first + columns.len()].copy_from_slice(&line[..columns.len()]);
                }
            }
        }
    }

    /// Adds a bias to each channel, then cuts negative values where `relu` says so.
    pub fn add_bias(&mut self, bias: &[f32], relu: bool) {
        let floor = if relu { 0.0 } else { f32::NEG_INFINITY };
        let side = self.side;
        simd(
            #[inline(always)]
            || {
                for (index, row) in self.rows_mut().enumerate() {
                    let bias = bias[index / side];
                    for value in row.as_flattened_mut() {
                        *value = (*value + bias).max(floor);
                    }
                }
            },
        );
    }

    /// Sets values to zero where those of `output`, a ReLU's output of the same size, are zero: the gradient before
    /// the ReLU, given the one after it.
    pub fn mask(&mut self, output: &Images) {
        simd(
            #[inline(always)]
            || {
                let values = self.values.as_flattened_mut().iter_mut().zip(output.values.as_flattened());
                for (value, output) in values {
                    *value = if *output > 0.0 { *value } else { 0.0 };
                }
            },
        );
    }

    /// Replaces values by `scale * (value - target)`, where `scale` has a factor an image; returns the sum of the
    /// squared differences of the first `images` images.
    pub fn become_errors(&mut self, target: &Images, images: usize, scale: f32) -> f64 {
        let scales: [f32; LANES] = std::array::from_fn(|lane| if lane < images { scale } else { 0.0 });
        let mut sum = [0.0f64; LANES];
        simd(
            #[inline(always)]
            || {
                for (row, target) in self.rows_mut().zip(target.rows()) {
                    let mut squares = [0.0f32; LANES];
                    for (values, target) in row.iter_mut().zip(target) {
                        for lane in 0..LANES {
                            let error = values[lane] - target[lane];
                            squares[lane] += error * error;
                            values[lane] = error * scales[lane];
                        }
                    }
                    (0..LANES).for_each(|lane| sum[lane] += f64::from(squares[lane]));
                }
            },
        );
        sum[..images].iter().sum()
    }

    /// Adds the sum of each channel over all images to `sums` `[channels]`.
    pub fn add_channel_sums(&self, sums: &mut [f32]) {
        // The border adds zeros.
        let channels = self.values.chunks_exact((self.side + 2) * self.columns);
        sums.iter_mut().zip(channels).for_each(|(sum, channel)| *sum += super::sum(channel.as_flattened()));
    }

    /// The rows without their borders, through all channels.
    fn rows(&self) -> impl Iterator<Item = &[[f32; LANES]]> {
        let (side, columns) = (self.side, self.columns);
        let channels = self.values.chunks_exact((side + 2) * columns);
        channels.flat_map(move |channel| {
            channel.chunks_exact(columns).skip(1).take(side).map(move |row| &row[1..=side])
        })
    }

    fn rows_mut(&mut self) -> impl Iterator<Item = &mut [[f32; LANES]]> {
        let (side, columns) = (self.side, self.columns);
        let channels = self.values.chunks_exact_mut((side + 2) * columns);
        channels.flat_map(move |channel| {
            channel.chunks_exact_mut(columns).skip(1).take(side).map(move |row| &mut row[1..=side])
        })
    }

    /// Place of a row's first column, borders counted.
    #[inline(always)]
    fn at(&self, channel: usize, row: usize) -> usize {
        (channel * (self.side + 2) + row) * self.columns
    }

    /// `N` places from column `first` on, each as its first vector and those that follow.
    #[inline(always)]
    fn places<const N: usize>(&self, channel: usize, row: usize, first: usize) -> &[[f32; LANES]; N] {
        let start = self.at(channel, row) + first;
        match self.values[start..].first_chunk() {
            Some(places) => places,
            None => unreachable!("rows have room for whole groups of places"),
        }
    }
}

/// Sums of a kernel's gradient `[coarse, fine, 4, 4]`, kept for each image lane to the end.
pub struct KernelSums(Vec<[f32; LANES]>);

impl KernelSums {
    /// Zeros.
    pub fn new(sizes: Convolution) -> Self {
        Self(vec![[0.0; LANES]; sizes.kernel_len()])
    }

    /// The gradient.
    pub fn total(&self) -> Vec<f32> {
        self.0.iter().map(|lanes| lanes.iter().sum()).collect()
    }
}

/// Channels that are computed at once: what the registers hold beside their inputs.
const fn block_of(vector_len: usize) -> usize {
    if vector_len == LANES { 4 } else { 2 }
}

/// Vector `part` of a place.
///
/// Here and below, SIMD values stay out of closures that the standard library calls: those are compiled for the
/// plainest processor, and would pass them through memory.
#[inline(always)]
fn vector<S: Simd>(place: &[f32; LANES], part: usize) -> S::f32s {
    S::as_simd_f32s(place).0[part]
}

#[inline(always)]
fn vector_mut<S: Simd>(place: &mut [f32; LANES], part: usize) -> &mut S::f32s {
    &mut S::as_mut_simd_f32s(place).0[part]
}

/// One row of the kernels of a block of channels. Channels past the last repeat it.
#[inline(always)]
fn weights<const BLOCK: usize>(
    kernel: &[f32],
    first: usize,
    stride: usize,
    channels: usize,
) -> [&[f32; KERNEL]; BLOCK] {
    let mut rows = [&[0.0; KERNEL]; BLOCK];
    for channel in 0..BLOCK {
        if let Some(row) = kernel[first + channel.min(channels - 1) * stride..].first_chunk() {
            rows[channel] = row;
        }
    }
    rows
}

struct Convolve<'a> {
    sizes: Convolution,
    fine: &'a Images,
    kernel: &'a [f32],
    coarse: &'a mut Images,
}

impl WithSimd for Convolve<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if block_of(S::F32_LANES) == 4 { self.run::<S, 4>(simd) } else { self.run::<S, 2>(simd) }
    }
}

impl Convolve<'_> {
    #[inline(always)]
    fn run<S: Simd, const BLOCK: usize>(self, simd: S) {
        let Self { sizes, fine, kernel, coarse } = self;
        let (side, taps) = (sizes.coarse_side(), sizes.fine_channels * TAPS);
        for row in 0..side {
            for place in (0..side).step_by(PLACES) {
                for first_channel in (0..sizes.coarse_channels).step_by(BLOCK) {
                    let channels = (sizes.coarse_channels - first_channel).min(BLOCK);
                    for part in 0..LANES / S::F32_LANES {
                        let mut sums = [[simd.splat_f32s(0.0); PLACES]; BLOCK];
                        for fine_channel in 0..sizes.fine_channels {
                            for tap_row in 0..KERNEL {
                                let seen: &[_; SEEN] =
                                    fine.places(fine_channel, STRIDE * row + tap_row, STRIDE * place);
                                let first = first_channel * taps + (fine_channel * KERNEL + tap_row) * KERNEL;
                                let weights = weights::<BLOCK>(kernel, first, taps, channels);
                                for tap in 0..KERNEL {
                                    for channel in 0..BLOCK {
                                        let weight = simd.splat_f32s(weights[channel][tap]);
                                        for place in 0..PLACES {
                                            let seen = vector::<S>(&seen[STRIDE * place + tap], part);
                                            sums[channel][place] =
                                                simd.mul_add_f32s(weight, seen, sums[channel][place]);
                                        }
                                    }
                                }
                            }
                        }
                        for channel in 0..channels {
                            let at = coarse.at(first_channel + channel, row + 1) + 1 + place;
                            for place in 0..PLACES.min(side - place) {
                                *vector_mut::<S>(&mut coarse.values[at + place], part) = sums[channel][place];
                            }
                        }
                    }
                }
            }
        }
    }
}

/// A fine row or column of even index `2 u` is reached by the kernel's places 1 (from coarse index `u`) and 3 (from
/// `u - 1`), one of odd index `2 u + 1` by 0 (from `u + 1`) and 2 (from `u`). For each parity: the kernel's place, and
/// the coarse index's offset plus one, which counts the border.
const REACHED_BY: [[(usize, usize); 2]; 2] = [[(1, 1), (3, 0)], [(0, 2), (2, 1)]];

struct Spread<'a> {
    sizes: Convolution,
    coarse: &'a Images,
    kernel: &'a [f32],
    fine: &'a mut Images,
}

impl WithSimd for Spread<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if block_of(S::F32_LANES) == 4 { self.run::<S, 4>(simd) } else { self.run::<S, 2>(simd) }
    }
}

impl Spread<'_> {
    #[inline(always)]
    fn run<S: Simd, const BLOCK: usize>(mut self, simd: S) {
        let side = self.sizes.coarse_side();
        for row in 0..side {
            for place in (0..side).step_by(PLACES) {
                for first_channel in (0..self.sizes.fine_channels).step_by(BLOCK) {
                    for part in 0..LANES / S::F32_LANES {
                        // Constant parities keep the sums in registers.
                        self.parity::<S, BLOCK, 0, 0>(simd, [row, place, first_channel, part]);
                        self.parity::<S, BLOCK, 0, 1>(simd, [row, place, first_channel, part]);
                        self.parity::<S, BLOCK, 1, 0>(simd, [row, place, first_channel, part]);
                        self.parity::<S, BLOCK, 1, 1>(simd, [row, place, first_channel, part]);
                    }
                }
            }
        }
    }

    /// The fine rows of parity `ODD_ROW` and columns of parity `ODD_COLUMN` that a group of coarse places is the first
    /// to reach.
    #[inline(always)]
    fn parity<S: Simd, const BLOCK: usize, const ODD_ROW: usize, const ODD_COLUMN: usize>(
        &mut self,
        simd: S,
        [row, place, first_channel, part]: [usize; 4],
    ) {
        let Self { sizes, coarse, kernel, fine } = self;
        let channels = (sizes.fine_channels - first_channel).min(BLOCK);
        let mut sums = [[simd.splat_f32s(0.0); PLACES]; BLOCK];
        for coarse_channel in 0..sizes.coarse_channels {
            for (tap_row, row_offset) in REACHED_BY[ODD_ROW] {
                let seen: &[_; PLACES + 2] = coarse.places(coarse_channel, row + row_offset, place);
                let first = (coarse_channel * sizes.fine_channels + first_channel) * TAPS + tap_row * KERNEL;
                let weights = weights::<BLOCK>(kernel, first, TAPS, channels);
                for (tap, column_offset) in REACHED_BY[ODD_COLUMN] {
                    for channel in 0..BLOCK {
                        let weight = simd.splat_f32s(weights[channel][tap]);
                        for place in 0..PLACES {
                            let seen = vector::<S>(&seen[place + column_offset], part);
                            sums[channel][place] = simd.mul_add_f32s(weight, seen, sums[channel][place]);
                        }
                    }
                }
            }
        }
        for channel in 0..channels {
            let at = fine.at(first_channel + channel, STRIDE * row + ODD_ROW + 1)
                + STRIDE * place
                + ODD_COLUMN
                + 1;
            for index in 0..PLACES.min(coarse.side - place) {
                *vector_mut::<S>(&mut fine.values[at + STRIDE * index], part) = sums[channel][index];
            }
        }
    }
}

struct AddKernelGradient<'a> {
    sizes: Convolution,
    fine: &'a Images,
    coarse: &'a Images,
    sums: &'a mut [[f32; LANES]],
}

impl WithSimd for AddKernelGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if block_of(S::F32_LANES) == 4 { self.run::<S, 4>(simd) } else { self.run::<S, 2>(simd) }
    }
}

impl AddKernelGradient<'_> {
    #[inline(always)]
    fn run<S: Simd, const BLOCK: usize>(self, simd: S) {
        let Self { sizes, fine, coarse, sums } = self;
        let side = sizes.coarse_side();
        for first_channel in (0..sizes.coarse_channels).step_by(BLOCK) {
            let channels = (sizes.coarse_channels - first_channel).min(BLOCK);
            for fine_channel in 0..sizes.fine_channels {
                for tap_row in 0..KERNEL {
                    for part in 0..LANES / S::F32_LANES {
                        let mut block = [[simd.splat_f32s(0.0); KERNEL]; BLOCK];
                        for row in 0..side {
                            for place in (0..side).step_by(PLACES) {
                                let seen: &[_; SEEN] =
                                    fine.places(fine_channel, STRIDE * row + tap_row, STRIDE * place);
                                for channel in 0..BLOCK {
                                    let channel_at = first_channel + channel.min(channels - 1);
                                    // Places past the last are zero.
                                    let grads: &[_; PLACES] = coarse.places(channel_at, row + 1, place + 1);
                                    for place in 0..PLACES {
                                        let grad = vector::<S>(&grads[place], part);
                                        for tap in 0..KERNEL {
                                            let seen = vector::<S>(&seen[STRIDE * place + tap], part);
                                            block[channel][tap] =
                                                simd.mul_add_f32s(grad, seen, block[channel][tap]);
                                        }
                                    }
                                }
                            }
                        }
                        for channel in 0..channels {
                            let first = ((first_channel + channel) * sizes.fine_channels + fine_channel)
                                * TAPS
                                + tap_row * KERNEL;
                            for tap in 0..KERNEL {
                                let sum = vector_mut::<S>(&mut sums[first + tap], part);
                                *sum = simd.add_f32s(*sum, block[channel][tap]);
                            }
                        }
                    }
                }
            }
        }
    }
}
