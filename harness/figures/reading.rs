//! A reading of an experiment, whose runs figures can show.

use harness_spec::{Experiment, SpecError, load};
use std::path::Path;

/// A reading of an experiment: `reproduction/recommended`.
#[derive(Debug, Clone)]
pub struct OfReading {
    spec: Experiment,
    reading: String,
}

/// Why a reading can't be shown.
#[derive(Debug, thiserror::Error)]
pub enum ReadingError {
    /// The experiment's spec can't be read.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The text names no reading of an experiment. The text is the message.
    #[error("{0}")]
    Unknown(String),
}

impl OfReading {
    /// Reads the spec of a reading that `text` names as `EXPERIMENT/READING`. With `quick`, it is about the quick runs.
    ///
    /// # Errors
    /// When `text` has another form, the spec can't be read, or it has no such reading.
    pub fn load(text: &str, quick: bool) -> Result<Self, ReadingError> {
        let named =
            text.rsplit_once('/').filter(|(experiment, wanted)| !experiment.is_empty() && !wanted.is_empty());
        let (experiment, wanted) = named.ok_or_else(|| {
            ReadingError::Unknown(format!(
                "'{text}' names no reading; write EXPERIMENT/READING, for example reproduction/recommended"
            ))
        })?;
        let spec = load(Path::new(experiment), &[], quick)?;
        if spec.readings.is_empty() {
            return Err(ReadingError::Unknown(format!(
                "{experiment} has no readings; name an experiment that has, such as reproduction"
            )));
        }
        let there = spec.names_of_readings();
        if !there.contains(&wanted) {
            let there = there.join(", ");
            return Err(ReadingError::Unknown(format!(
                "{experiment} has no reading '{wanted}'; its readings are {there}"
            )));
        }
        Ok(Self { spec, reading: wanted.to_owned() })
    }

    /// The last reading of a spec; `None` if it has no readings.
    pub fn last_of(spec: Experiment) -> Option<Self> {
        let reading = spec.readings.last()?.name.clone();
        Some(Self { spec, reading })
    }

    /// The name of the experiment.
    pub fn experiment(&self) -> &str {
        &self.spec.name
    }

    /// The name of the reading.
    pub fn reading(&self) -> &str {
        &self.reading
    }
}
