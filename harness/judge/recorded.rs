//! Predictions that somebody recorded, such as those of a model of another program.

use super::{JudgeError, Predicted, Predictor, Receive};
use harness_samples::{Sample, Samples};
use harness_spec::Modality;
use std::collections::BTreeMap;

/// A predicted value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedValue {
    /// The predicted modality.
    pub modality: Modality,
    /// The episode of the dataset.
    pub episode: usize,
    /// The predicted sample, counted from 0 within its episode.
    pub sample: usize,
    /// Number of samples from the present to the predicted one.
    pub horizon: usize,
    /// The element of the modality, counted from 0.
    pub index: usize,
    /// The value in the modality's unit.
    pub value: f32,
}

/// Why recorded predictions can't be judged.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum RecordedError {
    /// A value belongs to nothing that is judged.
    #[error(
        "episode {}, sample {}: {problem} ({}, element {}, {} samples ahead)",
        at.episode, at.sample, at.modality, at.index, at.horizon
    )]
    Value {
        /// The value.
        at: RecordedValue,
        /// What is wrong.
        problem: String,
    },
    /// A value is missing.
    #[error(
        "episode {episode}, sample {sample}: element {index} of {modality}, {horizon} samples ahead, is missing"
    )]
    Missing {
        /// The predicted modality.
        modality: Modality,
        /// The episode of the dataset.
        episode: usize,
        /// The predicted sample, counted from 0 within its episode.
        sample: usize,
        /// Number of samples from the present to the predicted one.
        horizon: usize,
        /// The element of the modality.
        index: usize,
    },
    /// There are no values.
    #[error("there are no predictions")]
    Empty,
}

/// Recorded predictions of all windows of a test.
pub struct Recorded<'a> {
    model: String,
    /// The windows, in ascending order.
    windows: &'a [Sample],
    /// The values of each modality at each horizon, `[windows, width]`.
    values: BTreeMap<(Modality, usize), Vec<f32>>,
}

impl<'a> Recorded<'a> {
    /// Sorts the values of a model by window. Each modality and horizon that occurs must have a value for each element
    /// of each window. `windows` are the present samples of the test's windows, in ascending order.
    ///
    /// # Errors
    /// When a value is of no window of the test, is not finite, occurs twice, or is missing.
    pub fn new(
        model: &str,
        samples: &Samples,
        windows: &'a [Sample],
        recorded: impl IntoIterator<Item = RecordedValue>,
    ) -> Result<Self, RecordedError> {
        let mut values: BTreeMap<(Modality, usize), Vec<f32>> = BTreeMap::new();
        for at in recorded {
            let wrong = |problem: &str| RecordedError::Value { at, problem: problem.to_owned() };
            let definition = samples.layout().get(at.modality);
            let width = definition.ok_or_else(|| wrong("the dataset has no such modality"))?.width();
            let window =
                window_of(samples, windows, &at).ok_or_else(|| wrong("no test window predicts it"))?;
            if at.index >= width {
                return Err(wrong("the modality has no such element"));
            }
            if !at.value.is_finite() {
                return Err(wrong("the value is not finite"));
            }
            let all = values.entry((at.modality, at.horizon));
            let value =
                &mut all.or_insert_with(|| vec![f32::NAN; windows.len() * width])[window * width + at.index];
            if !value.is_nan() {
                return Err(wrong("it occurs twice"));
            }
            *value = at.value;
        }
        for (&(modality, horizon), values) in &values {
            if let Some(place) = values.iter().position(|value| value.is_nan()) {
                let width = samples.layout()[modality].width();
                let (episode, sample) = samples.place(windows[place / width].after(horizon));
                return Err(RecordedError::Missing {
                    modality,
                    episode,
                    sample,
                    horizon,
                    index: place % width,
                });
            }
        }
        if values.is_empty() {
            return Err(RecordedError::Empty);
        }
        Ok(Self { model: model.to_owned(), windows, values })
    }
}

/// Returns the position of the window that predicts a value; `None` if it is not of the test.
fn window_of(samples: &Samples, windows: &[Sample], at: &RecordedValue) -> Option<usize> {
    let episode = samples.episodes().get(at.episode)?;
    let present = at.sample.checked_sub(at.horizon)?;
    let is_inside = at.sample < episode.len();
    windows.binary_search(&Sample::at(episode.start + present)).ok().filter(|_| is_inside)
}

impl Predictor for Recorded<'_> {
    fn name(&self) -> &str {
        &self.model
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> Result<(), JudgeError> {
        for (&(modality, horizon), values) in &self.values {
            let width = values.len() / self.windows.len();
            let rows = at.iter().filter_map(|sample| self.windows.binary_search(sample).ok());
            let values = rows.flat_map(|row| &values[row * width..][..width]).copied().collect();
            receive(&Predicted { modality, horizon, values })?;
        }
        Ok(())
    }
}
