//! 4 x 4 convolutions of stride 2 with a padding of one pixel, their transposes, and the gradients of their kernels.
//!
//! Sixteen images are computed side by side: a vector holds the same pixel of all of them. So every sum is one
//! multiplication and addition a vector whatever the image's size, no pixel has to be moved within a vector, and layers
//! chain to any depth. Sixteen images with all their layers fit in a core's second-level cache.

// Sums that are indexed by constants stay in registers; behind an iterator they would not.
#![allow(clippy::needless_range_loop)]

use crate::simd;
use pulp::{Simd, WithSimd};
use std::sync::Mutex;

/// Images side by side.
pub const LANES: usize = 16;
/// Side of the kernel, pixels.
const KERNEL: usize = 4;
/// Step of the convolution, pixels.
const STRIDE: usize = 2;
/// Weights of one pair of channels.
pub const TAPS: usize = KERNEL * KERNEL;
/// Coarse places of a row that rows have room for as a group; as many are computed at once at most.
const PLACES: usize = 4;
/// Channels that are computed at once.
const BLOCK: usize = 4;
/// Images sets that wait for their next use at most: those of a deep network's training step on some threads.
const MAX_IDLE: usize = 256;

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

    /// Images of the fine side, to be set.
    pub fn fine(&self) -> Images {
        Images::new(self.fine_channels, self.side)
    }

    /// Images of the coarse side, to be set.
    pub fn coarse(&self) -> Images {
        Images::new(self.coarse_channels, self.coarse_side())
    }

    /// `coarse`: the convolution of `fine`, without a bias.
    pub fn convolve(&self, fine: &Images, kernel: &Kernel, coarse: &mut Images) {
        self.check(
            fine,
            kernel.0.len(),
            self.coarse_channels.div_ceil(BLOCK) * self.fine_channels * TAPS,
            coarse,
        );
        simd(Convolve { sizes: *self, fine, kernel: &kernel.0, coarse });
    }

    /// `fine`: the transposed convolution of `coarse`, without a bias.
    pub fn spread(&self, coarse: &Images, kernel: &Kernel, fine: &mut Images) {
        self.check(
            fine,
            kernel.0.len(),
            self.fine_channels.div_ceil(BLOCK) * self.coarse_channels * TAPS,
            coarse,
        );
        simd(Spread { sizes: *self, coarse, kernel: &kernel.0, fine });
    }

    /// The weights `[coarse, fine, 4, 4]` as [`Convolution::convolve`] reads them.
    pub fn convolving(&self, weights: &[f32]) -> Kernel {
        let weight = |coarse: usize, fine: usize, tap: usize| {
            weights[(coarse * self.fine_channels + fine) * TAPS + tap]
        };
        let mut packed = Vec::with_capacity(self.kernel_len());
        for first in (0..self.coarse_channels).step_by(BLOCK) {
            for (fine, tap) in (0..self.fine_channels).flat_map(|fine| (0..TAPS).map(move |tap| (fine, tap)))
            {
                packed.push(block(first, self.coarse_channels, |coarse| weight(coarse, fine, tap)));
            }
        }
        Kernel(packed)
    }

    /// The weights `[coarse, fine, 4, 4]` as [`Convolution::spread`] reads them.
    pub fn spreading(&self, weights: &[f32]) -> Kernel {
        let weight = |coarse: usize, fine: usize, tap: usize| {
            weights[(coarse * self.fine_channels + fine) * TAPS + tap]
        };
        let mut packed = Vec::with_capacity(self.kernel_len());
        for first in (0..self.fine_channels).step_by(BLOCK) {
            for (rows, columns) in PARITIES.map(|(row, column)| (REACHED_BY[row], REACHED_BY[column])) {
                for coarse in 0..self.coarse_channels {
                    for (row, _) in rows {
                        for (column, _) in columns {
                            let tap = row * KERNEL + column;
                            packed.push(block(first, self.fine_channels, |fine| weight(coarse, fine, tap)));
                        }
                    }
                }
            }
        }
        Kernel(packed)
    }

    /// Adds to `sums` what `fine` and the gradient `coarse` of its convolution give for the kernel's gradient.
    pub fn add_kernel_gradient(&self, fine: &Images, coarse: &Images, sums: &mut KernelSums) {
        self.check(fine, sums.0.len(), self.kernel_len(), coarse);
        simd(AddKernelGradient { sizes: *self, fine, coarse, sums: &mut sums.0 });
    }

    fn check(&self, fine: &Images, kernel_len: usize, expected: usize, coarse: &Images) {
        assert_eq!((fine.channels, fine.side), (self.fine_channels, self.side), "the fine images");
        assert_eq!(
            (coarse.channels, coarse.side),
            (self.coarse_channels, self.coarse_side()),
            "the coarse images"
        );
        assert_eq!(kernel_len, expected, "the kernel");
    }
}

/// What `of` gives for each channel of the block that begins with channel `first`; 0 past the last channel.
fn block(first: usize, channels: usize, of: impl Fn(usize) -> f32) -> [f32; BLOCK] {
    std::array::from_fn(|index| if first + index < channels { of(first + index) } else { 0.0 })
}

/// A convolution's weights, block by block of the channels that are computed at once.
pub struct Kernel(Vec<[f32; BLOCK]>);

/// Sixteen images `[channel, row, column, image]` with a border of zeros.
pub struct Images {
    values: Vec<[f32; LANES]>,
    channels: usize,
    side: usize,
    /// Columns of a row with its border and room to read whole groups of places from it.
    columns: usize,
}

/// Images that wait for their next use, by channels and side. Their borders are zero. Fresh memory would be cleared by
/// the allocator or the system first.
static IDLE: Mutex<Vec<Idle>> = Mutex::new(Vec::new());

struct Idle {
    channels: usize,
    side: usize,
    values: Vec<[f32; LANES]>,
}

impl Drop for Images {
    fn drop(&mut self) {
        let mut idle = IDLE.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if idle.len() == MAX_IDLE {
            idle.remove(0);
        }
        let Self { channels, side, .. } = *self;
        idle.push(Idle { channels, side, values: std::mem::take(&mut self.values) });
    }
}

impl Images {
    /// Images whose values the caller sets before it reads any.
    pub fn new(channels: usize, side: usize) -> Self {
        let columns = side.next_multiple_of(STRIDE * PLACES) + 2;
        let mut idle = IDLE.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let found = idle.iter().rposition(|idle| (idle.channels, idle.side) == (channels, side));
        let values = match found {
            Some(index) => idle.swap_remove(index).values,
            None => vec![[0.0; LANES]; channels * (side + 2) * columns],
        };
        Self { values, channels, side, columns }
    }

    /// Values of one image.
    pub fn image_len(&self) -> usize {
        self.channels * self.side * self.side
    }

    /// Takes images that lie one after the other, each `[channel, row, column]`; those past the last are zero.
    pub fn set(&mut self, images: &[f32]) {
        let (side, len) = (self.side, self.image_len());
        let mut lines = [[0.0; LANES]; LANES];
        for (index, row) in self.rows_mut().enumerate() {
            // Blocks of a few columns read whole cache lines of every image once.
            for (block, columns) in row.chunks_mut(LANES).enumerate() {
                let first = index * side + block * LANES;
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
        let mut lines = [[0.0; LANES]; LANES];
        for (index, row) in self.rows().enumerate() {
            for (block, columns) in row.chunks(LANES).enumerate() {
                let first = index * side + block * LANES;
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
        simd(AddBias { images: self, bias, floor: if relu { 0.0 } else { f32::NEG_INFINITY } });
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
        let scales = std::array::from_fn(|lane| if lane < images { scale } else { 0.0 });
        let sum = simd(BecomeErrors { images: self, target, scales });
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

    /// A row from `column` on, borders counted.
    #[inline(always)]
    fn row(&self, channel: usize, row: usize, column: usize) -> &[[f32; LANES]] {
        let start = self.at(channel, row);
        &self.values[start + column..start + self.columns]
    }
}

// Structs where closures would do: the shim by which a closure that could be called again is called once is sometimes
// not inlined, and then compiled for the plainest processor.

struct AddBias<'a> {
    images: &'a mut Images,
    bias: &'a [f32],
    floor: f32,
}

impl WithSimd for AddBias<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Images { side, columns, .. } = *self.images;
        let channels = self.images.values.chunks_exact_mut((side + 2) * columns);
        for (channel, bias) in channels.zip(self.bias) {
            for row in 1..=side {
                for value in channel[row * columns + 1..][..side].as_flattened_mut() {
                    *value = (*value + bias).max(self.floor);
                }
            }
        }
    }
}

struct BecomeErrors<'a> {
    images: &'a mut Images,
    target: &'a Images,
    scales: [f32; LANES],
}

impl WithSimd for BecomeErrors<'_> {
    type Output = [f64; LANES];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) -> [f64; LANES] {
        let Images { channels, side, .. } = *self.images;
        let mut sum = [0.0f64; LANES];
        for line in 0..channels * side {
            let start = self.images.at(line / side, line % side + 1) + 1;
            let mut squares = [0.0f32; LANES];
            for place in start..start + side {
                let (values, target) = (&mut self.images.values[place], &self.target.values[place]);
                for lane in 0..LANES {
                    let error = values[lane] - target[lane];
                    squares[lane] += error * error;
                    values[lane] = error * self.scales[lane];
                }
            }
            for lane in 0..LANES {
                sum[lane] += f64::from(squares[lane]);
            }
        }
        sum
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

/// The first `N` places of a row.
#[inline(always)]
fn places<const N: usize>(row: &[[f32; LANES]]) -> &[[f32; LANES]; N] {
    match row.first_chunk() {
        Some(places) => places,
        None => unreachable!("rows have room for whole groups of places"),
    }
}

struct Convolve<'a> {
    sizes: Convolution,
    fine: &'a Images,
    kernel: &'a [[f32; BLOCK]],
    coarse: &'a mut Images,
}

impl WithSimd for Convolve<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // As many places as the registers hold the sums of, and the columns that those see.
        if S::F32_LANES == LANES { self.run::<S, 4, 10>(simd) } else { self.run::<S, 2, 6>(simd) }
    }
}

impl Convolve<'_> {
    #[inline(always)]
    fn run<S: Simd, const N: usize, const SEEN: usize>(self, simd: S) {
        let Self { sizes, fine, kernel, coarse } = self;
        let side = sizes.coarse_side();
        let blocks = kernel.chunks_exact(sizes.fine_channels * TAPS);
        for row in 0..side {
            for place in (0..side).step_by(N) {
                for (block, kernel) in blocks.clone().enumerate() {
                    for part in 0..LANES / S::F32_LANES {
                        let mut sums = [[simd.splat_f32s(0.0); N]; BLOCK];
                        // One row of the kernels of a fine channel after the other.
                        for (index, weights) in kernel.as_chunks::<KERNEL>().0.iter().enumerate() {
                            let (fine_channel, tap_row) = (index / KERNEL, index % KERNEL);
                            let seen: &[_; SEEN] =
                                places(fine.row(fine_channel, STRIDE * row + tap_row, STRIDE * place));
                            for tap in 0..KERNEL {
                                for channel in 0..BLOCK {
                                    let weight = simd.splat_f32s(weights[tap][channel]);
                                    for place in 0..N {
                                        let seen = vector::<S>(&seen[STRIDE * place + tap], part);
                                        sums[channel][place] =
                                            simd.mul_add_f32s(weight, seen, sums[channel][place]);
                                    }
                                }
                            }
                        }
                        let first_channel = block * BLOCK;
                        for channel in 0..BLOCK.min(sizes.coarse_channels - first_channel) {
                            let at = coarse.at(first_channel + channel, row + 1) + 1 + place;
                            for place in 0..N.min(side - place) {
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

/// Parities of a fine row and a fine column.
const PARITIES: [(usize, usize); 4] = [(0, 0), (0, 1), (1, 0), (1, 1)];

struct Spread<'a> {
    sizes: Convolution,
    coarse: &'a Images,
    kernel: &'a [[f32; BLOCK]],
    fine: &'a mut Images,
}

impl WithSimd for Spread<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // As many places as the registers hold the sums of, and the columns that those see.
        if S::F32_LANES == LANES { self.run::<S, 4, 6>(simd) } else { self.run::<S, 2, 4>(simd) }
    }
}

impl Spread<'_> {
    #[inline(always)]
    fn run<S: Simd, const N: usize, const SEEN: usize>(mut self, simd: S) {
        let side = self.sizes.coarse_side();
        let blocks = self.kernel.chunks_exact(self.sizes.coarse_channels * TAPS);
        for row in 0..side {
            for place in (0..side).step_by(N) {
                for (block, kernel) in blocks.clone().enumerate() {
                    let (parities, _) = kernel.as_chunks::<KERNEL>();
                    let mut parities = parities.chunks_exact(self.sizes.coarse_channels);
                    // Constant parities keep the sums in registers.
                    let mut next = || parities.next().unwrap_or_default();
                    let at = [row, place, block * BLOCK];
                    self.parity::<S, N, SEEN, 0, 0>(simd, next(), at);
                    self.parity::<S, N, SEEN, 0, 1>(simd, next(), at);
                    self.parity::<S, N, SEEN, 1, 0>(simd, next(), at);
                    self.parity::<S, N, SEEN, 1, 1>(simd, next(), at);
                }
            }
        }
    }

    /// The fine rows of parity `ODD_ROW` and columns of parity `ODD_COLUMN` that lie beside a group of coarse places.
    #[inline(always)]
    fn parity<S: Simd, const N: usize, const SEEN: usize, const ODD_ROW: usize, const ODD_COLUMN: usize>(
        &mut self,
        simd: S,
        kernel: &[[[f32; BLOCK]; KERNEL]],
        [row, place, first_channel]: [usize; 3],
    ) {
        let Self { sizes, coarse, fine, .. } = self;
        let [(_, first_row), (_, second_row)] = REACHED_BY[ODD_ROW];
        for part in 0..LANES / S::F32_LANES {
            let mut sums = [[simd.splat_f32s(0.0); N]; BLOCK];
            for (coarse_channel, weights) in kernel.iter().enumerate() {
                let rows: [&[_; SEEN]; 2] = [
                    places(coarse.row(coarse_channel, row + first_row, place)),
                    places(coarse.row(coarse_channel, row + second_row, place)),
                ];
                for tap_row in 0..2 {
                    for tap_column in 0..2 {
                        let (_, offset) = REACHED_BY[ODD_COLUMN][tap_column];
                        for channel in 0..BLOCK {
                            let weight = simd.splat_f32s(weights[2 * tap_row + tap_column][channel]);
                            for place in 0..N {
                                let seen = vector::<S>(&rows[tap_row][place + offset], part);
                                sums[channel][place] = simd.mul_add_f32s(weight, seen, sums[channel][place]);
                            }
                        }
                    }
                }
            }
            for channel in 0..BLOCK.min(sizes.fine_channels - first_channel) {
                let start = fine.at(first_channel + channel, STRIDE * row + ODD_ROW + 1);
                let at = start + STRIDE * place + ODD_COLUMN + 1;
                for index in 0..N.min(coarse.side - place) {
                    *vector_mut::<S>(&mut fine.values[at + STRIDE * index], part) = sums[channel][index];
                }
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
        // As many places as the registers hold the sums of, and the columns that those see.
        if S::F32_LANES == LANES { self.run::<S, 4, 10>(simd) } else { self.run::<S, 2, 6>(simd) }
    }
}

impl AddKernelGradient<'_> {
    #[inline(always)]
    fn run<S: Simd, const N: usize, const SEEN: usize>(self, simd: S) {
        let Self { sizes, fine, coarse, sums } = self;
        let side = sizes.coarse_side();
        for first_channel in (0..sizes.coarse_channels).step_by(BLOCK) {
            let channels = (sizes.coarse_channels - first_channel).min(BLOCK);
            for fine_channel in 0..sizes.fine_channels {
                for tap_row in 0..KERNEL {
                    for part in 0..LANES / S::F32_LANES {
                        let mut block = [[simd.splat_f32s(0.0); KERNEL]; BLOCK];
                        for row in 0..side {
                            let seen = fine.row(fine_channel, STRIDE * row + tap_row, 0);
                            // Channels past the last repeat it, and are not added. Places past the last are zero.
                            let grad = |channel: usize| {
                                let channel = first_channel + channel.min(channels - 1);
                                coarse.row(channel, row + 1, 1).chunks_exact(N)
                            };
                            let grads = grad(0).zip(grad(1)).zip(grad(2).zip(grad(3)));
                            let places_seen = seen.windows(SEEN).step_by(STRIDE * N);
                            for (seen, ((grad_0, grad_1), (grad_2, grad_3))) in places_seen.zip(grads) {
                                let seen: &[_; SEEN] = places(seen);
                                let grads: [&[_; N]; BLOCK] =
                                    [places(grad_0), places(grad_1), places(grad_2), places(grad_3)];
                                for channel in 0..BLOCK {
                                    for place in 0..N {
                                        let grad = vector::<S>(&grads[channel][place], part);
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
