//! The errors of metrics and baselines.

use thiserror::Error;

/// Why values can't be compared, or a baseline can't be fitted.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MetricsError {
    /// Values are not a whole number of rows.
    #[error(
        "{what} has {values} values, not a whole number of rows of {width}; give a row-major [samples, {width}] matrix"
    )]
    Shape {
        /// Name of the matrix.
        what: &'static str,
        /// Number of its values.
        values: usize,
        /// Number of values that a row must have.
        width: usize,
    },
    /// Two matrices have different numbers of samples, or a value is infinite or NaN. The text is the message.
    #[error("{0}")]
    Values(String),
    /// A baseline has no training samples.
    #[error("{what} has no training samples; add at least one")]
    NoSamples {
        /// The baseline.
        what: &'static str,
    },
    /// The penalty of a ridge regression is negative or not finite.
    #[error("ridge regression's alpha is {0}; it must be finite and not negative")]
    Alpha(f64),
    /// The inputs of a ridge regression are linearly dependent.
    #[error(
        "ridge regression's inputs are linearly dependent at column {column} and alpha is {alpha}; raise alpha or drop \
         that column"
    )]
    Singular {
        /// The first input that depends on those before it, counted from 0.
        column: usize,
        /// The penalty, which is too small.
        alpha: f64,
    },
}

/// Returns the rows of a row-major matrix `[samples, width]`. Errors call it `what`.
pub(super) fn rows<'a, T>(
    what: &'static str,
    values: &'a [T],
    width: usize,
) -> Result<std::slice::ChunksExact<'a, T>, MetricsError> {
    if width == 0 || !values.len().is_multiple_of(width) {
        return Err(MetricsError::Shape { what, values: values.len(), width });
    }
    Ok(values.chunks_exact(width))
}

/// Returns an error if a matrix of `width` columns has a value that isn't finite. Errors call it `what`.
pub(super) fn check_finite(what: &'static str, values: &[f32], width: usize) -> Result<(), MetricsError> {
    let Some(at) = values.iter().position(|value| !value.is_finite()) else { return Ok(()) };
    let (value, row, column) = (values[at], at / width, at % width);
    Err(MetricsError::Values(format!(
        "{what} is {value} at row {row}, column {column} of the batch; only finite values can be scored, so check the \
         training for divergence"
    )))
}

/// Returns an error if two matrices have different numbers of samples.
pub(super) fn check_samples(
    (first, first_samples): (&str, usize),
    (second, second_samples): (&str, usize),
) -> Result<(), MetricsError> {
    if first_samples == second_samples {
        return Ok(());
    }
    Err(MetricsError::Values(format!(
        "{first} has {first_samples} samples and {second} has {second_samples}; both must cover the same samples"
    )))
}
