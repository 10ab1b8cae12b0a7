//! The arithmetic under the network's own ops, on plain slices: matrix products, patches of a stride-2
//! convolution, and Adam. Row-major matrices throughout.
//!
//! Every reduction runs over a fixed number of parts in a fixed order, so that results depend neither on the
//! number of threads nor on how work happens to be scheduled.

use gemm::Parallelism;
use rayon::prelude::*;

/// Side of the convolution's kernel, pixels.
pub const KERNEL: usize = 4;
/// Step of the convolution, pixels.
pub const STRIDE: usize = 2;
/// Values that one channel contributes to a patch.
pub const TAPS: usize = KERNEL * KERNEL;
/// Parts that a reduction over a batch is cut into; fixed, so that sums are always taken in the same order.
pub const PARTS: usize = 16;

/// How a matrix is read: as it lies, or as its transpose.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum View {
    Plain,
    Transposed,
}

/// A row-major matrix operand: `rows x columns` as it lies in memory, before `view` is applied.
#[derive(Clone, Copy)]
pub struct Matrix<'a> {
    pub values: &'a [f32],
    pub rows: usize,
    pub columns: usize,
    pub view: View,
}

impl<'a> Matrix<'a> {
    /// The matrix as it lies.
    pub fn plain(values: &'a [f32], rows: usize, columns: usize) -> Self {
        assert_eq!(values.len(), rows * columns, "a {rows} x {columns} matrix");
        Self { values, rows, columns, view: View::Plain }
    }

    /// Its transpose, without a copy.
    pub fn transposed(values: &'a [f32], rows: usize, columns: usize) -> Self {
        Self { view: View::Transposed, ..Self::plain(values, rows, columns) }
    }

    fn shape(&self) -> (usize, usize) {
        match self.view {
            View::Plain => (self.rows, self.columns),
            View::Transposed => (self.columns, self.rows),
        }
    }

    /// Column stride and row stride of the view.
    fn strides(&self) -> (isize, isize) {
        match self.view {
            View::Plain => (1, self.columns as isize),
            View::Transposed => (self.columns as isize, 1),
        }
    }
}

/// Whether a product replaces what its destination holds or is added to it.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Into {
    Overwrite,
    Add,
}

/// `out (+)= a b`, by candle's own matrix product (the gemm crate), `threads` wide.
pub fn product(a: Matrix, b: Matrix, out: &mut [f32], into: Into, threads: usize) {
    let ((m, k), (k_b, n)) = (a.shape(), b.shape());
    assert_eq!(k, k_b, "inner sizes of a product");
    assert_eq!(out.len(), m * n, "size of a product's destination");
    let ((a_columns, a_rows), (b_columns, b_rows)) = (a.strides(), b.strides());
    let parallelism = if threads > 1 { Parallelism::Rayon(threads) } else { Parallelism::None };
    // SAFETY: the lengths of all three slices were checked against the sizes that the strides span, and `out`
    // is borrowed mutably, so it overlaps neither operand.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            into == Into::Add,
            a.values.as_ptr(),
            a_columns,
            a_rows,
            b.values.as_ptr(),
            b_columns,
            b_rows,
            1.0,
            1.0,
            false,
            false,
            false,
            parallelism,
        );
    }
}

/// A vector of `len` values that the caller writes before reading any.
pub fn scratch(len: usize) -> Vec<f32> {
    // Zeroed memory comes from the allocator without a pass over it.
    vec![0.0; len]
}

/// Adds `bias` `[width]` to every row of `rows` `[n, width]`, then cuts negative values where `relu` says so.
pub fn add_bias(rows: &mut [f32], bias: &[f32], relu: bool) {
    let floor = if relu { 0.0 } else { f32::NEG_INFINITY };
    let part = rows.len().div_ceil(PARTS).next_multiple_of(bias.len());
    rows.par_chunks_mut(part).for_each(|part| {
        for row in part.chunks_exact_mut(bias.len()) {
            for (value, bias) in row.iter_mut().zip(bias) {
                *value = (*value + bias).max(floor);
            }
        }
    });
}

/// Cuts `grad` to zero where a ReLU's `output` is zero: the gradient before it, given the one after it.
pub fn mask(grad: &mut [f32], output: &[f32]) {
    for (grad, output) in grad.iter_mut().zip(output) {
        *grad = if *output > 0.0 { *grad } else { 0.0 };
    }
}

/// [`mask`] on a copy, in parallel.
pub fn masked(grad: &[f32], output: &[f32]) -> Vec<f32> {
    let mut masked = grad.to_vec();
    let part = grad.len().div_ceil(PARTS).max(1);
    masked.par_chunks_mut(part).zip(output.par_chunks(part)).for_each(|(grad, output)| mask(grad, output));
    masked
}

/// Sums of the columns of `rows` `[n, width]`.
pub fn column_sums(rows: &[f32], width: usize) -> Vec<f32> {
    let part = rows.len().div_ceil(PARTS).next_multiple_of(width).max(width);
    let sums = rows.par_chunks(part).map(|part| {
        let mut sums = vec![0.0; width];
        for row in part.chunks_exact(width) {
            add_to(&mut sums, row);
        }
        sums
    });
    sum_in_order(sums.collect(), width)
}

/// `sum += values`.
pub fn add_to(sum: &mut [f32], values: &[f32]) {
    for (sum, value) in sum.iter_mut().zip(values) {
        *sum += value;
    }
}

/// The sum of equally long vectors, from the first to the last.
pub fn sum_in_order(parts: Vec<Vec<f32>>, len: usize) -> Vec<f32> {
    parts
        .into_iter()
        .reduce(|mut sum, part| {
            add_to(&mut sum, &part);
            sum
        })
        .unwrap_or_else(|| vec![0.0; len])
}

/// Sizes of a stride-2 convolution with a 4 x 4 kernel and a padding of one pixel, or of its transpose.
///
/// The fine side has `fine_channels` x `side` x `side` values, the coarse side `coarse_channels` x `side / 2` x
/// `side / 2`. The convolution leads from fine to coarse, its transpose back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Patches {
    pub fine_channels: usize,
    pub coarse_channels: usize,
    pub side: usize,
}

impl Patches {
    /// Side of the coarse image, pixels.
    pub fn coarse_side(&self) -> usize {
        self.side / STRIDE
    }

    /// Positions of the kernel.
    pub fn positions(&self) -> usize {
        self.coarse_side() * self.coarse_side()
    }

    /// Values of a patch.
    pub fn patch_len(&self) -> usize {
        self.fine_channels * TAPS
    }

    /// Values of a fine image.
    pub fn fine_len(&self) -> usize {
        self.fine_channels * self.side * self.side
    }

    /// Values of a coarse image.
    pub fn coarse_len(&self) -> usize {
        self.coarse_channels * self.positions()
    }

    /// Values of the kernel: `[coarse, fine, 4, 4]`, which is both PyTorch's `Conv2d` layout and its
    /// `ConvTranspose2d` layout for the opposite direction.
    pub fn weight_len(&self) -> usize {
        self.coarse_channels * self.patch_len()
    }

    /// Cuts an image `[fine, side, side]` into `patches` `[fine * 16, positions]`: im2col.
    pub fn cut(&self, image: &[f32], patches: &mut [f32]) {
        let (side, half) = (self.side, self.coarse_side());
        let plane = self.positions();
        let mut lines = Lines::new(half);
        for channel in 0..self.fine_channels {
            let pixels = &image[channel * side * side..][..side * side];
            let patches = &mut patches[channel * TAPS * plane..][..TAPS * plane];
            for row in 0..side {
                lines.split(&pixels[row * side..][..side]);
                for (tap_row, coarse_row) in taps_of(row, half) {
                    for tap_column in 0..KERNEL {
                        let tap = tap_row * KERNEL + tap_column;
                        patches[tap * plane + coarse_row * half..][..half]
                            .copy_from_slice(lines.seen_by(tap_column));
                    }
                }
            }
            // The kernel's first row looks above the image at the top, its last row below it at the bottom.
            for tap_column in 0..KERNEL {
                patches[tap_column * plane..][..half].fill(0.0);
                patches[((KERNEL - 1) * KERNEL + tap_column) * plane + plane - half..][..half].fill(0.0);
            }
        }
    }

    /// Adds `patches` `[fine * 16, positions]` up into an image `[fine, side, side]`, on top of `bias` `[fine]`:
    /// col2im, the transpose of [`Patches::cut`].
    pub fn paste(&self, patches: &[f32], bias: &[f32], image: &mut [f32]) {
        let (side, half) = (self.side, self.coarse_side());
        let plane = self.positions();
        let mut lines = Lines::new(half);
        for channel in 0..self.fine_channels {
            let patches = &patches[channel * TAPS * plane..][..TAPS * plane];
            let pixels = &mut image[channel * side * side..][..side * side];
            for row in 0..side {
                lines.fill(bias[channel]);
                for (tap_row, coarse_row) in taps_of(row, half) {
                    for tap_column in 0..KERNEL {
                        let tap = tap_row * KERNEL + tap_column;
                        lines.add(tap_column, &patches[tap * plane + coarse_row * half..][..half]);
                    }
                }
                lines.join(&mut pixels[row * side..][..side]);
            }
        }
    }
}

/// The kernel rows that see an image row, each with the coarse row it does so for.
fn taps_of(row: usize, half: usize) -> impl Iterator<Item = (usize, usize)> {
    // Image row = 2 * coarse row + kernel row - 1.
    (0..KERNEL).filter_map(move |tap_row| {
        let twice = (row + 1).checked_sub(tap_row)?;
        (twice % STRIDE == 0 && twice / STRIDE < half).then_some((tap_row, twice / STRIDE))
    })
}

/// An image row as the four columns of the kernel see it: the columns at even and at odd places, each with a
/// zero on the side where the kernel reaches past the edge.
struct Lines {
    half: usize,
    /// Even places, then a zero: the kernel's column 1 reads from place 0, column 3 from place 1.
    even: Vec<f32>,
    /// A zero, then odd places: the kernel's column 0 reads from place 0, column 2 from place 1.
    odd: Vec<f32>,
}

impl Lines {
    fn new(half: usize) -> Self {
        Self { half, even: vec![0.0; half + 1], odd: vec![0.0; half + 1] }
    }

    fn split(&mut self, row: &[f32]) {
        for ((pair, even), odd) in row.chunks_exact(2).zip(&mut self.even).zip(&mut self.odd[1..]) {
            *even = pair[0];
            *odd = pair[1];
        }
    }

    fn seen_by(&self, tap_column: usize) -> &[f32] {
        match tap_column {
            0 => &self.odd[..self.half],
            1 => &self.even[..self.half],
            2 => &self.odd[1..],
            _ => &self.even[1..],
        }
    }

    fn fill(&mut self, value: f32) {
        self.even.fill(value);
        self.odd.fill(value);
    }

    fn add(&mut self, tap_column: usize, values: &[f32]) {
        let half = self.half;
        let line = match tap_column {
            0 => &mut self.odd[..half],
            1 => &mut self.even[..half],
            2 => &mut self.odd[1..],
            _ => &mut self.even[1..],
        };
        add_to(line, values);
    }

    fn join(&self, row: &mut [f32]) {
        for ((pair, even), odd) in row.chunks_exact_mut(2).zip(&self.even).zip(&self.odd[1..]) {
            pair[0] = *even;
            pair[1] = *odd;
        }
    }
}

/// Adam's constants for one step (Kingma & Ba, 2015, algorithm 1).
#[derive(Debug, Clone, Copy)]
pub struct AdamStep {
    pub learning_rate: f32,
    pub beta_mean: f32,
    pub beta_square: f32,
    pub epsilon: f32,
    /// `1 / (1 - beta_mean^t)`.
    pub mean_correction: f32,
    /// `1 / (1 - beta_square^t)`.
    pub square_correction: f32,
}

/// One step of Adam over a parameter and its two moments, in place.
pub fn adam(step: AdamStep, parameter: &mut [f32], grad: &[f32], mean: &mut [f32], square: &mut [f32]) {
    const PART: usize = 1 << 16;
    parameter
        .par_chunks_mut(PART)
        .zip(grad.par_chunks(PART))
        .zip(mean.par_chunks_mut(PART).zip(square.par_chunks_mut(PART)))
        .for_each(|((parameter, grad), (mean, square))| {
            for (((parameter, grad), mean), square) in parameter.iter_mut().zip(grad).zip(mean).zip(square) {
                *mean += (1.0 - step.beta_mean) * (grad - *mean);
                *square += (1.0 - step.beta_square) * (grad * grad - *square);
                let scale = (*square * step.square_correction).sqrt() + step.epsilon;
                *parameter -= step.learning_rate * *mean * step.mean_correction / scale;
            }
        });
}
