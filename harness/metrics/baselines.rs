//! Baselines: predictions without a network, which a trained network should beat.

use super::COLUMNS_AT_ONCE;
use super::error::{MetricsError, check_finite, check_samples, rows};
use harness_spec::{Definition, IMAGE_CHANNELS};
use rayon::prelude::*;
use std::borrow::Cow;

/// Largest number of rows and columns that [`downsample_frame`] returns.
pub const GRAY_SIDE: usize = 16;

/// Number of rows that ridge regression converts to f64 at a time. That many frames take 25 MB.
const CHUNK_ROWS: usize = 256;

/// Predicts that the next observation equals the present one, `now`. For a difference, predicts that nothing changes.
///
/// `now` is row-major `[samples, width]` and holds the predicted modality at the samples themselves. A difference is
/// predicted as zero, because the image stays the same. Repeating the last difference would mean that the motion
/// continues.
pub fn persistence<'a>(definition: &Definition, now: &'a [f32]) -> Cow<'a, [f32]> {
    match definition.difference_of {
        Some(_) => Cow::Owned(vec![0.0; now.len()]),
        None => Cow::Borrowed(now),
    }
}

/// Predicts the mean of the training samples for each column.
#[derive(Debug, Clone)]
pub struct TrainingMean {
    sums: Vec<f64>,
    samples: usize,
}

impl TrainingMean {
    /// Creates a mean of rows with `width` values.
    pub fn new(width: usize) -> Self {
        Self { sums: vec![0.0; width], samples: 0 }
    }

    /// Adds training samples, row-major `[samples, width]`.
    ///
    /// # Errors
    /// When the values are not a whole number of rows, or not finite. Nothing is added in that case.
    pub fn add(&mut self, values: &[f32]) -> Result<(), MetricsError> {
        let width = self.sums.len();
        let samples = rows("the training mean's batch", values, width)?;
        check_finite("the training mean's batch", values, width)?;
        self.samples += samples.len();
        // Each column adds its values in their order, so the result does not depend on the threads.
        self.sums.par_chunks_mut(COLUMNS_AT_ONCE).enumerate().for_each(|(chunk, sums)| {
            for sample in samples.clone() {
                let values = &sample[chunk * COLUMNS_AT_ONCE..];
                sums.iter_mut().zip(values).for_each(|(sum, &value)| *sum += f64::from(value));
            }
        });
        Ok(())
    }

    /// Returns the mean once for each of `samples`, row-major `[samples, width]`.
    ///
    /// # Errors
    /// When no training sample was added.
    pub fn predict(&self, samples: usize) -> Result<Vec<f32>, MetricsError> {
        if self.samples == 0 {
            return Err(MetricsError::no_samples("the training mean"));
        }
        let mean: Vec<f32> = self.sums.iter().map(|sum| (sum / self.samples as f64) as f32).collect();
        Ok(mean.repeat(samples))
    }
}

/// The normal equations of a ridge regression, summed over training samples. Memory does not grow with their number.
///
/// A column of ones before the inputs represents the intercept.
#[derive(Debug, Clone)]
pub struct RidgeSums {
    inputs: usize,
    outputs: usize,
    /// `[1 X]ᵀ [1 X]`, row-major `[inputs + 1, inputs + 1]`.
    gram: Vec<f64>,
    /// `Yᵀ [1 X]`, row-major `[outputs, inputs + 1]`.
    cross: Vec<f64>,
}

impl RidgeSums {
    /// Creates sums without samples. A sample has `inputs` and `outputs` values.
    pub fn new(inputs: usize, outputs: usize) -> Self {
        let size = inputs + 1;
        Self { inputs, outputs, gram: vec![0.0; size * size], cross: vec![0.0; outputs * size] }
    }

    /// Adds training samples. `x` are the normalized inputs, row-major `[samples, inputs]`. `y` are the values to
    /// predict, `[samples, outputs]`, in any unit.
    ///
    /// # Errors
    /// When the shapes don't match, or a value isn't finite. Nothing is added in that case.
    pub fn add(&mut self, x: &[f32], y: &[f32]) -> Result<(), MetricsError> {
        let samples = rows("ridge regression's x", x, self.inputs)?.len();
        let targets = rows("ridge regression's y", y, self.outputs)?.len();
        check_samples(("ridge regression's x", samples), ("its y", targets))?;
        check_finite("ridge regression's x", x, self.inputs)?;
        check_finite("ridge regression's y", y, self.outputs)?;
        let size = self.inputs + 1;
        for (x, y) in x.chunks(CHUNK_ROWS * self.inputs).zip(y.chunks(CHUNK_ROWS * self.outputs)) {
            let x = with_ones(x, self.inputs);
            let y: Vec<f64> = y.iter().map(|&value| f64::from(value)).collect();
            let x = Matrix::new(&x, size);
            add_product(&mut self.gram, x.transposed(), x);
            add_product(&mut self.cross, Matrix::new(&y, self.outputs).transposed(), x);
        }
        Ok(())
    }

    /// Minimizes `‖y - x w - b‖² + alpha ‖w‖²` over the samples, like scikit-learn's `Ridge(alpha)`. The intercept `b`
    /// is not penalized.
    ///
    /// # Errors
    /// When `alpha` is negative or not finite, no sample was added, or the inputs are linearly dependent and `alpha` is
    /// too small to make the solution unique.
    pub fn solve(&self, alpha: f64) -> Result<Ridge, MetricsError> {
        if !(alpha.is_finite() && alpha >= 0.0) {
            let problem = "it must be finite and not negative";
            return Err(MetricsError(format!("ridge regression's alpha is {alpha}; {problem}")));
        }
        let size = self.inputs + 1;
        if self.gram[0] == 0.0 {
            return Err(MetricsError::no_samples("ridge regression"));
        }
        let mut factor = self.gram.clone();
        (1..size).for_each(|i| factor[i * size + i] += alpha);
        cholesky(&mut factor, size).map_err(|column| {
            MetricsError(format!(
                "ridge regression's inputs are linearly dependent at column {} and alpha is {alpha}; raise alpha or \
                 drop that column",
                column - 1
            ))
        })?;
        let mut weights = self.cross.clone();
        weights.par_chunks_exact_mut(size).for_each(|output| solve_factored(&factor, output));
        Ok(Ridge { inputs: self.inputs, outputs: self.outputs, weights })
    }
}

/// A fitted ridge regression.
#[derive(Debug, Clone, PartialEq)]
pub struct Ridge {
    inputs: usize,
    outputs: usize,
    /// Row-major `[outputs, inputs + 1]`: the intercept and then the coefficients of each output.
    weights: Vec<f64>,
}

impl Ridge {
    /// Fits a regression from `x`, row-major `[samples, inputs]`, to `y`, `[samples, outputs]`. All samples are in
    /// memory.
    pub fn fit(
        x: &[f32],
        inputs: usize,
        y: &[f32],
        outputs: usize,
        alpha: f64,
    ) -> Result<Self, MetricsError> {
        let mut sums = RidgeSums::new(inputs, outputs);
        sums.add(x, y)?;
        sums.solve(alpha)
    }

    /// Returns the intercept and the coefficients of one output.
    ///
    /// # Panics
    /// When there is no such output.
    pub fn weights(&self, output: usize) -> (f64, &[f64]) {
        let weights = &self.weights[output * (self.inputs + 1)..][..self.inputs + 1];
        (weights[0], &weights[1..])
    }

    /// Predicts `[samples, outputs]` from inputs `[samples, inputs]` that are normalized as in the fit.
    ///
    /// # Errors
    /// When `x` is not a whole number of rows.
    pub fn predict(&self, x: &[f32]) -> Result<Vec<f32>, MetricsError> {
        let samples = rows("ridge regression's x", x, self.inputs)?.len();
        let size = self.inputs + 1;
        let mut predicted = Vec::with_capacity(samples * self.outputs);
        for x in x.chunks(CHUNK_ROWS * self.inputs) {
            let x = with_ones(x, self.inputs);
            let mut y = vec![0.0; x.len() / size * self.outputs];
            add_product(&mut y, Matrix::new(&x, size), Matrix::new(&self.weights, size).transposed());
            predicted.extend(y.iter().map(|&value| value as f32));
        }
        Ok(predicted)
    }
}

/// Reduces an image, or a difference of two images, to at most 16 x 16 gray values, as inputs of ridge regression.
///
/// `frame` is `[channel, row, column]`, and `size` is its number of rows and columns. Each value of the result is the
/// mean over a block of pixels and their three channels, in the frame's unit.
///
/// # Errors
/// When the length of `frame` is not that of one frame.
pub fn downsample_frame(frame: &[f32], size: [usize; 2]) -> Result<Vec<f32>, MetricsError> {
    let [rows, columns] = size;
    let width = rows * columns * IMAGE_CHANNELS;
    if frame.len() != width {
        return Err(MetricsError::shape("the camera frame", frame.len(), width));
    }
    let [gray_rows, gray_columns] = size.map(|side| side.min(GRAY_SIDE));
    let mut gray = vec![(0.0, 0); gray_rows * gray_columns];
    for channel in frame.chunks_exact(rows * columns) {
        for (pixel, value) in channel.iter().enumerate() {
            let (row, column) = (pixel / columns, pixel % columns);
            let (sum, count) =
                &mut gray[row * gray_rows / rows * gray_columns + column * gray_columns / columns];
            *sum += value;
            *count += 1;
        }
    }
    Ok(gray.into_iter().map(|(sum, count)| sum / count as f32).collect())
}

/// Returns `[samples, inputs]` in f64, with a column of ones before the first column.
fn with_ones(x: &[f32], inputs: usize) -> Vec<f64> {
    x.chunks_exact(inputs)
        .flat_map(|row| [1.0].into_iter().chain(row.iter().map(|&v| f64::from(v))))
        .collect()
}

/// A view of a row-major matrix, or of its transpose.
#[derive(Clone, Copy)]
struct Matrix<'a> {
    values: &'a [f64],
    shape: [usize; 2],
    strides: [isize; 2],
}

impl<'a> Matrix<'a> {
    fn new(values: &'a [f64], columns: usize) -> Self {
        assert!(values.len().is_multiple_of(columns), "{} values in rows of {columns}", values.len());
        Self { values, shape: [values.len() / columns, columns], strides: [columns as isize, 1] }
    }

    fn transposed(self) -> Self {
        let ([rows, columns], [down, right]) = (self.shape, self.strides);
        Self { values: self.values, shape: [columns, rows], strides: [right, down] }
    }
}

/// Adds the matrix product `left right` to the row-major `sum`.
fn add_product(sum: &mut [f64], left: Matrix, right: Matrix) {
    let ([rows, inner], [right_rows, columns]) = (left.shape, right.shape);
    assert!(inner == right_rows && sum.len() == rows * columns, "shapes of a product don't match");
    // SAFETY: the shapes match, and each view's shape and strides stay within its slice.
    unsafe {
        gemm::gemm(
            rows,
            columns,
            inner,
            sum.as_mut_ptr(),
            1,
            columns as isize,
            true,
            left.values.as_ptr(),
            left.strides[1],
            left.strides[0],
            right.values.as_ptr(),
            right.strides[1],
            right.strides[0],
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::Rayon(0),
        );
    }
}

/// Replaces a symmetric positive definite matrix `[size, size]` by its Cholesky factor L, and Lᵀ above the diagonal.
/// Returns an error with the first column that depends on the columns before it, within rounding.
fn cholesky(matrix: &mut [f64], size: usize) -> Result<(), usize> {
    for j in 0..size {
        let (above, below) = matrix.split_at_mut(j * size);
        let original = below[j];
        for k in 0..j {
            let upper = &above[k * size..][j..size];
            let scale = upper[0];
            below[j..size].iter_mut().zip(upper).for_each(|(value, factor)| *value -= scale * factor);
        }
        if below[j] <= original * size as f64 * f64::EPSILON {
            return Err(j);
        }
        let pivot = below[j].sqrt();
        below[j..size].iter_mut().for_each(|value| *value /= pivot);
        for i in j + 1..size {
            matrix[i * size + j] = matrix[j * size + i];
        }
    }
    Ok(())
}

/// Solves `L Lᵀ w = b` in place. `factor` has both factors as [`cholesky`] stores them.
fn solve_factored(factor: &[f64], b: &mut [f64]) {
    let size = b.len();
    for i in 0..size {
        let row = &factor[i * size..][..size];
        b[i] /= row[i];
        let solved = b[i];
        b[i + 1..].iter_mut().zip(&row[i + 1..]).for_each(|(value, factor)| *value -= solved * factor);
    }
    for i in (0..size).rev() {
        let row = &factor[i * size..][..size];
        b[i] /= row[i];
        let solved = b[i];
        b[..i].iter_mut().zip(&row[..i]).for_each(|(value, factor)| *value -= solved * factor);
    }
}
