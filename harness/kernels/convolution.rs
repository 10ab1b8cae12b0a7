//! 4 x 4 convolutions with a stride of 2 and a padding of one pixel, their transposes, and the gradients of their
//! kernels.
//!
//! Sixteen images are processed at once: a vector holds the same pixel of all of them. Every term of a sum is then one
//! multiplication and addition of vectors for any image size, no pixel moves within a vector, and layers can be chained
//! to any depth. Sixteen images with all their layers fit in a core's second-level cache.

// Sums that are indexed by constants stay in registers. With iterators they would not.
#![allow(clippy::needless_range_loop)]

use crate::simd;
use pulp::{Simd, WithSimd};
use std::sync::Mutex;

/// Number of images that are processed at once.
pub const LANES: usize = 16;
/// Side of the kernel in pixels.
const KERNEL: usize = 4;
/// Stride of the convolution in pixels.
const STRIDE: usize = 2;
/// Number of weights for one pair of channels.
const TAPS: usize = KERNEL * KERNEL;
/// A place is the position of a pixel in a row. Rows have room for whole groups of this many coarse places. At most
/// this many are computed at once.
const PLACES: usize = 4;
/// Number of channels that are computed at once.
const BLOCK: usize = 4;
/// Most sets of images that are kept for reuse: enough for a deep network's training step on several threads.
const MAX_IDLE: usize = 256;

/// Sizes of a convolution.
///
/// The fine image has `fine_channels` channels of `size`, and the coarse image `coarse_channels` channels of half as
/// many rows and columns. The convolution computes the coarse image from the fine one, and its transpose computes the
/// fine image from the coarse one. The kernel is `[coarse, fine, 4, 4]`. This is the layout of PyTorch's `Conv2d`, and
/// that of its `ConvTranspose2d` for the opposite direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Convolution {
    /// Channels of the fine image.
    pub fine_channels: usize,
    /// Channels of the coarse image.
    pub coarse_channels: usize,
    /// Rows and columns of the fine image in pixels, even numbers.
    pub size: [usize; 2],
}

impl Convolution {
    /// Returns the rows and columns of the coarse image in pixels.
    pub fn coarse_size(&self) -> [usize; 2] {
        self.size.map(|side| side / STRIDE)
    }

    /// Returns the number of values of a fine image.
    pub fn fine_len(&self) -> usize {
        self.fine_channels * self.size[0] * self.size[1]
    }

    /// Returns the number of values of a coarse image.
    pub fn coarse_len(&self) -> usize {
        let [rows, columns] = self.coarse_size();
        self.coarse_channels * rows * columns
    }

    /// Returns the number of values of the kernel.
    pub fn kernel_len(&self) -> usize {
        self.coarse_channels * self.fine_channels * TAPS
    }

    /// Returns buffers for sixteen fine images, whose values are not set.
    pub fn fine(&self) -> Images {
        Images::new(self.fine_channels, self.size)
    }

    /// Returns buffers for sixteen coarse images, whose values are not set.
    pub fn coarse(&self) -> Images {
        Images::new(self.coarse_channels, self.coarse_size())
    }

    /// Writes the convolution of `fine` to `coarse`, without a bias. `kernel` comes from [`Convolution::convolving`].
    pub fn convolve(&self, fine: &Images, kernel: &Kernel, coarse: &mut Images) {
        self.check(
            fine,
            kernel.0.len(),
            self.coarse_channels.div_ceil(BLOCK) * self.fine_channels * TAPS,
            coarse,
        );
        simd(Convolve { sizes: *self, fine, kernel: &kernel.0, coarse });
    }

    /// Writes the transposed convolution of `coarse` to `fine`, without a bias. `kernel` comes from
    /// [`Convolution::spreading`].
    pub fn spread(&self, coarse: &Images, kernel: &Kernel, fine: &mut Images) {
        self.check(
            fine,
            kernel.0.len(),
            self.fine_channels.div_ceil(BLOCK) * self.coarse_channels * TAPS,
            coarse,
        );
        simd(Spread { sizes: *self, coarse, kernel: &kernel.0, fine });
    }

    /// Packs the weights `[coarse, fine, 4, 4]` for [`Convolution::convolve`].
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

    /// Packs the weights `[coarse, fine, 4, 4]` for [`Convolution::spread`].
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

    /// Adds the gradient of the kernel to `sums`, given `fine` and the gradient `coarse` of its convolution.
    pub fn add_kernel_gradient(&self, fine: &Images, coarse: &Images, sums: &mut KernelSums) {
        self.check(fine, sums.0.len(), self.kernel_len(), coarse);
        simd(AddKernelGradient { sizes: *self, fine, coarse, sums: &mut sums.0 });
    }

    fn check(&self, fine: &Images, kernel_len: usize, expected: usize, coarse: &Images) {
        assert_eq!((fine.channels, fine.size), (self.fine_channels, self.size), "the fine images");
        assert_eq!(
            (coarse.channels, coarse.size),
            (self.coarse_channels, self.coarse_size()),
            "the coarse images"
        );
        assert_eq!(kernel_len, expected, "the kernel");
    }
}

/// Returns `of` each channel in the block that begins with channel `first`. Channels past the last one get 0.
fn block(first: usize, channels: usize, of: impl Fn(usize) -> f32) -> [f32; BLOCK] {
    std::array::from_fn(|index| if first + index < channels { of(first + index) } else { 0.0 })
}

/// A convolution's weights, in blocks of channels that are computed at once.
pub struct Kernel(Vec<[f32; BLOCK]>);

/// Sixteen images, `[channel, row, column, image]`, with a border of zeros.
pub struct Images {
    values: Vec<[f32; LANES]>,
    channels: usize,
    /// Rows and columns.
    size: [usize; 2],
    /// Columns of a row with its border and room to read whole groups of places from it.
    columns: usize,
}

/// Images that wait for their next use, by channels and size. Their borders are zero. Fresh memory would be cleared by
/// the allocator or the system first.
static IDLE: Mutex<Vec<Idle>> = Mutex::new(Vec::new());

struct Idle {
    channels: usize,
    size: [usize; 2],
    values: Vec<[f32; LANES]>,
}

impl Drop for Images {
    fn drop(&mut self) {
        let mut idle = IDLE.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if idle.len() == MAX_IDLE {
            idle.remove(0);
        }
        let Self { channels, size, .. } = *self;
        idle.push(Idle { channels, size, values: std::mem::take(&mut self.values) });
    }
}

impl Images {
    /// Returns images of arbitrary values. The caller must set them before reading them.
    pub fn new(channels: usize, size: [usize; 2]) -> Self {
        let columns = size[1].next_multiple_of(STRIDE * PLACES) + 2;
        let mut idle = IDLE.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let found = idle.iter().rposition(|idle| (idle.channels, idle.size) == (channels, size));
        let values = match found {
            Some(index) => idle.swap_remove(index).values,
            None => vec![[0.0; LANES]; channels * (size[0] + 2) * columns],
        };
        Self { values, channels, size, columns }
    }

    /// Returns the number of values of one image.
    fn image_len(&self) -> usize {
        self.channels * self.size[0] * self.size[1]
    }

    /// Copies images that are stored one after the other, each `[channel, row, column]`. If there are fewer than
    /// sixteen, the remaining ones are zero.
    pub fn set(&mut self, images: &[f32]) {
        let (width, len) = (self.size[1], self.image_len());
        let mut lines = [[0.0; LANES]; LANES];
        for (index, row) in self.rows_mut().enumerate() {
            // Blocks of a few columns read each cache line of every image once.
            for (block, columns) in row.chunks_mut(LANES).enumerate() {
                let first = index * width + block * LANES;
                for (line, image) in lines.iter_mut().zip(images.chunks_exact(len)) {
                    line[..columns.len()].copy_from_slice(&image[first..first + columns.len()]);
                }
                for (column, values) in columns.iter_mut().enumerate() {
                    *values = std::array::from_fn(|lane| lines[lane][column]);
                }
            }
        }
    }

    /// Writes the images one after the other, each `[channel, row, column]`, as many as fit in `images`.
    pub fn write(&self, images: &mut [f32]) {
        let (width, len) = (self.size[1], self.image_len());
        let mut lines = [[0.0; LANES]; LANES];
        for (index, row) in self.rows().enumerate() {
            for (block, columns) in row.chunks(LANES).enumerate() {
                let first = index * width + block * LANES;
                for (column, values) in columns.iter().enumerate() {
                    (0..LANES).for_each(|lane| lines[lane][column] = values[lane]);
                }
                for (line, image) in lines.iter().zip(images.chunks_exact_mut(len)) {
                    image[first..first + columns.len()].copy_from_slice(&line[..columns.len()]);
                }
            }
        }
    }

    /// Adds a bias to each channel. If `relu`, negative sums become zero.
    pub fn add_bias(&mut self, bias: &[f32], relu: bool) {
        simd(AddBias { images: self, bias, floor: if relu { 0.0 } else { f32::NEG_INFINITY } });
    }

    /// Sets values to zero where `output`, a ReLU's output of the same size, is zero. This turns the gradient of the
    /// output into that of the input.
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

    /// Replaces each value by `scale * (value - target)` in the first `images` images, and by zero in the others.
    /// Returns the sum of the squared differences in the first `images` images.
    pub fn become_errors(&mut self, target: &Images, images: usize, scale: f32) -> f64 {
        let scales = std::array::from_fn(|lane| if lane < images { scale } else { 0.0 });
        let sum = simd(BecomeErrors { images: self, target, scales });
        sum[..images].iter().sum()
    }

    /// Adds the sum of each channel over all images to `sums` `[channels]`.
    pub fn add_channel_sums(&self, sums: &mut [f32]) {
        // The border adds only zeros.
        let channels = self.values.chunks_exact((self.size[0] + 2) * self.columns);
        sums.iter_mut().zip(channels).for_each(|(sum, channel)| *sum += super::sum(channel.as_flattened()));
    }

    /// Returns the rows of all channels without their borders.
    fn rows(&self) -> impl Iterator<Item = &[[f32; LANES]]> {
        let ([height, width], columns) = (self.size, self.columns);
        let channels = self.values.chunks_exact((height + 2) * columns);
        channels.flat_map(move |channel| {
            channel.chunks_exact(columns).skip(1).take(height).map(move |row| &row[1..=width])
        })
    }

    fn rows_mut(&mut self) -> impl Iterator<Item = &mut [[f32; LANES]]> {
        let ([height, width], columns) = (self.size, self.columns);
        let channels = self.values.chunks_exact_mut((height + 2) * columns);
        channels.flat_map(move |channel| {
            channel.chunks_exact_mut(columns).skip(1).take(height).map(move |row| &mut row[1..=width])
        })
    }

    /// Returns the index of a row's first column, where rows and columns include the border.
    #[inline(always)]
    fn at(&self, channel: usize, row: usize) -> usize {
        (channel * (self.size[0] + 2) + row) * self.columns
    }

    /// Returns a row from `column` on, where rows and columns include the border.
    #[inline(always)]
    fn row(&self, channel: usize, row: usize, column: usize) -> &[[f32; LANES]] {
        let start = self.at(channel, row);
        &self.values[start + column..start + self.columns]
    }
}

// These are structs instead of closures. A closure that can be called repeatedly is called through a shim, which the
// compiler sometimes does not inline and then compiles for the oldest supported processor.

struct AddBias<'a> {
    images: &'a mut Images,
    bias: &'a [f32],
    floor: f32,
}

impl WithSimd for AddBias<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Images { size: [height, width], columns, .. } = *self.images;
        let channels = self.images.values.chunks_exact_mut((height + 2) * columns);
        for (channel, bias) in channels.zip(self.bias) {
            for row in 1..=height {
                for value in channel[row * columns + 1..][..width].as_flattened_mut() {
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
        let Images { channels, size: [height, width], .. } = *self.images;
        let mut sum = [0.0f64; LANES];
        for line in 0..channels * height {
            let start = self.images.at(line / height, line % height + 1) + 1;
            let mut squares = [0.0f32; LANES];
            for place in start..start + width {
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

/// Sums of a kernel's gradient `[coarse, fine, 4, 4]`, separate for each image until the end.
pub struct KernelSums(Vec<[f32; LANES]>);

impl KernelSums {
    /// Returns sums of zero.
    pub fn new(sizes: Convolution) -> Self {
        Self(vec![[0.0; LANES]; sizes.kernel_len()])
    }

    /// Returns the gradient, summed over the images.
    pub fn total(&self) -> Vec<f32> {
        self.0.iter().map(|lanes| lanes.iter().sum()).collect()
    }
}

/// Returns vector `part` of a place.
///
/// Here and below, closures that the standard library calls contain no SIMD values. Such closures are compiled for the
/// oldest supported processor, and would pass these values through memory.
#[inline(always)]
fn vector<S: Simd>(place: &[f32; LANES], part: usize) -> S::f32s {
    S::as_simd_f32s(place).0[part]
}

#[inline(always)]
fn vector_mut<S: Simd>(place: &mut [f32; LANES], part: usize) -> &mut S::f32s {
    &mut S::as_mut_simd_f32s(place).0[part]
}

/// Returns the first `N` places of a row.
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
        // The number of places whose sums fit in the registers, and the number of columns that these places read.
        if S::F32_LANES == LANES { self.run::<S, 4, 10>(simd) } else { self.run::<S, 2, 6>(simd) }
    }
}

impl Convolve<'_> {
    #[inline(always)]
    fn run<S: Simd, const N: usize, const SEEN: usize>(self, simd: S) {
        let Self { sizes, fine, kernel, coarse } = self;
        let [height, width] = sizes.coarse_size();
        let blocks = kernel.chunks_exact(sizes.fine_channels * TAPS);
        for row in 0..height {
            for place in (0..width).step_by(N) {
                for (block, kernel) in blocks.clone().enumerate() {
                    for part in 0..LANES / S::F32_LANES {
                        let mut sums = [[simd.splat_f32s(0.0); N]; BLOCK];
                        // Each step takes one row of the kernels of a fine channel.
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
                            for place in 0..N.min(width - place) {
                                *vector_mut::<S>(&mut coarse.values[at + place], part) = sums[channel][place];
                            }
                        }
                    }
                }
            }
        }
    }
}

/// The rows or columns of the kernel that contribute to a fine row or column, for each parity. An even index `2 u` gets
/// contributions from kernel index 1 (coarse index `u`) and 3 (`u - 1`). An odd index `2 u + 1` gets them from 0
/// (`u + 1`) and 2 (`u`). Each entry has the kernel index and the offset of the coarse index plus one, because of the
/// border.
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
        // The number of places whose sums fit in the registers, and the number of columns that these places read.
        if S::F32_LANES == LANES { self.run::<S, 4, 6>(simd) } else { self.run::<S, 2, 4>(simd) }
    }
}

impl Spread<'_> {
    #[inline(always)]
    fn run<S: Simd, const N: usize, const SEEN: usize>(mut self, simd: S) {
        let [height, width] = self.sizes.coarse_size();
        let blocks = self.kernel.chunks_exact(self.sizes.coarse_channels * TAPS);
        for row in 0..height {
            for place in (0..width).step_by(N) {
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

    /// Computes the fine rows of parity `ODD_ROW` and columns of parity `ODD_COLUMN` next to a group of coarse places.
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
                for index in 0..N.min(coarse.size[1] - place) {
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
        // The number of places whose sums fit in the registers, and the number of columns that these places read.
        if S::F32_LANES == LANES { self.run::<S, 4, 10>(simd) } else { self.run::<S, 2, 6>(simd) }
    }
}

impl AddKernelGradient<'_> {
    #[inline(always)]
    fn run<S: Simd, const N: usize, const SEEN: usize>(self, simd: S) {
        let Self { sizes, fine, coarse, sums } = self;
        let [height, _] = sizes.coarse_size();
        for first_channel in (0..sizes.coarse_channels).step_by(BLOCK) {
            let channels = (sizes.coarse_channels - first_channel).min(BLOCK);
            for fine_channel in 0..sizes.fine_channels {
                for tap_row in 0..KERNEL {
                    for part in 0..LANES / S::F32_LANES {
                        let mut block = [[simd.splat_f32s(0.0); KERNEL]; BLOCK];
                        for row in 0..height {
                            let seen = fine.row(fine_channel, STRIDE * row + tap_row, 0);
                            // Channels past the last one repeat it and are not added. Places past the last one are
                            // zero.
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
