//! The errors of metrics and baselines.

use thiserror::Error;

/// Why values can't be compared, or a baseline can't be fitted. The text is the message.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{0}")]
pub struct MetricsError(pub(super) String);

impl MetricsError {
    /// The values of a matrix are not a whole number of rows of `width`.
    pub(super) fn shape(what: &str, values: usize, width: usize) -> Self {
        Self(format!(
            "{what} has {values} values, not a whole number of rows of {width}; give a row-major [samples, {width}] \
             matrix"
        ))
    }

    /// A baseline has no training samples.
    pub(super) fn no_samples(what: &str) -> Self {
        Self(format!("{what} has no training samples; add at least one"))
    }
}

/// Returns the rows of a row-major matrix `[samples, width]`. Errors call it `what`.
pub(super) fn rows<'a, T>(
    what: &'static str,
    values: &'a [T],
    width: usize,
) -> Result<std::slice::ChunksExact<'a, T>, MetricsError> {
    if width == 0 || !values.len().is_multiple_of(width) {
        return Err(MetricsError::shape(what, values.len(), width));
    }
    Ok(values.chunks_exact(width))
}

/// Returns an error if a matrix of `width` columns has a value that isn't finite. Errors call it `what`.
pub(super) fn check_finite(what: &'static str, values: &[f32], width: usize) -> Result<(), MetricsError> {
    let Some(at) = values.iter().position(|value| !value.is_finite()) else { return Ok(()) };
    let (value, row, column) = (values[at], at / width, at % width);
    Err(MetricsError(format!(
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
    Err(MetricsError(format!(
        "{first} has {first_samples} samples and {second} has {second_samples}; both must cover the same samples"
    )))
}
