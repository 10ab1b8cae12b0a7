use thiserror::Error;

/// Why values can't be compared or a baseline can't be fitted.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MetricsError {
    #[error(
        "{what} has {values} values, not a whole number of rows of {width}; give a row-major [samples, {width}] matrix"
    )]
    Shape { what: &'static str, values: usize, width: usize },
    #[error(
        "{first} has {first_samples} samples and {second} has {second_samples}; both must cover the same samples"
    )]
    Samples { first: &'static str, first_samples: usize, second: &'static str, second_samples: usize },
    #[error(
        "{what} is {value} at row {row}, column {column} of the batch; only finite values can be scored, so check the training for divergence"
    )]
    NotFinite { what: &'static str, value: f32, row: usize, column: usize },
    #[error("{what} has no training samples; add at least one")]
    NoSamples { what: &'static str },
    #[error("ridge regression's alpha is {0}; it must be finite and not negative")]
    Alpha(f64),
    #[error(
        "ridge regression's inputs are linearly dependent at column {column} and alpha is {alpha}; raise alpha or drop that column"
    )]
    Singular { column: usize, alpha: f64 },
}

/// Rows of a row-major `[samples, width]` matrix called `what`.
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

/// Refuses a NaN or an infinity in a matrix of `width` columns called `what`.
pub(super) fn check_finite(what: &'static str, values: &[f32], width: usize) -> Result<(), MetricsError> {
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(at) => {
            Err(MetricsError::NotFinite { what, value: values[at], row: at / width, column: at % width })
        }
    }
}

/// Refuses two matrices with different numbers of samples.
pub(super) fn check_samples(
    first: (&'static str, usize),
    second: (&'static str, usize),
) -> Result<(), MetricsError> {
    if first.1 == second.1 {
        return Ok(());
    }
    Err(MetricsError::Samples {
        first: first.0,
        first_samples: first.1,
        second: second.0,
        second_samples: second.1,
    })
}
