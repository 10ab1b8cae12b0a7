//! Predictions that somebody recorded, such as those of a model of another program.

use super::{JudgeError, Predicted, Predictor, Receive};
use harness_samples::{Sample, Samples};
use harness_shared::numbers::counted;
use harness_spec::{Given, Modality};
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
    /// The element of the modality, counted from 0; of an image, `[channel, row, column]`.
    pub index: usize,
    /// The value in the modality's unit.
    pub value: f32,
}

impl RecordedValue {
    /// Returns the value at a place in all values of a modality at a horizon, `[windows, width]`.
    fn at(
        samples: &Samples,
        windows: &[Sample],
        (modality, horizon): (Modality, usize),
        values: &[f32],
        place: usize,
    ) -> Self {
        let width = samples.layout()[modality].width();
        let (episode, sample) = samples.place(windows[place / width].after(horizon));
        Self { modality, episode, sample, horizon, index: place % width, value: values[place] }
    }

    /// Refuses the value.
    fn wrong(self, problem: &str) -> RecordedError {
        let Self { modality, episode, sample, horizon, index, .. } = self;
        let ahead = counted(horizon, "sample");
        RecordedError::Wrong(format!(
            "episode {episode}, sample {sample}: {problem} ({modality}, element {index}, {ahead} ahead)"
        ))
    }
}

/// Why recorded predictions can't be judged.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum RecordedError {
    /// A value is missing, wrong, or asked by nothing. The text is the message.
    #[error("{0}")]
    Wrong(String),
    /// There are no values.
    #[error("there are no predictions")]
    Empty,
}

/// What a test asks for: these modalities, each at these horizons.
#[derive(Debug, Clone, Copy)]
pub struct Asked<'a> {
    /// The modalities.
    pub outputs: &'a [Modality],
    /// The horizons in samples.
    pub horizons: &'a [usize],
}

impl Asked<'_> {
    /// Checks that there are values of all these modalities at all these horizons, and no others.
    fn check(&self, values: &Values) -> Result<(), RecordedError> {
        if values.is_empty() {
            return Err(RecordedError::Empty);
        }
        let wrong = |problem: &str, &(modality, horizon): &(Modality, usize)| {
            let names: Vec<&str> = self.outputs.iter().map(|modality| modality.name()).collect();
            let numbers: Vec<String> = self.horizons.iter().map(usize::to_string).collect();
            let each = if names.len() > 1 { "each " } else { "" };
            let samples = if *self.horizons == [1] { "sample" } else { "samples" };
            let asked = format!("{}, {each}{} {samples} ahead", names.join(" and "), numbers.join(", "));
            let ahead = counted(horizon, "sample");
            Err(RecordedError::Wrong(format!(
                "{problem} {modality}, {ahead} ahead; the task asks for {asked}"
            )))
        };
        let asked = self
            .outputs
            .iter()
            .flat_map(|&output| self.horizons.iter().map(move |&horizon| (output, horizon)));
        if let Some(other) = values.keys().find(|key| !asked.clone().any(|asked| asked == **key)) {
            return wrong("nothing asks for predictions of", other);
        }
        match asked.clone().find(|key| !values.contains_key(key)) {
            Some(missing) => wrong("there are no predictions of", &missing),
            None => Ok(()),
        }
    }
}

/// The values of each modality at each horizon, `[windows, width]`.
type Values = BTreeMap<(Modality, usize), Vec<f32>>;

/// Recorded predictions of all windows of a test.
pub struct Recorded<'a> {
    model: String,
    /// The modalities that the model got; `None` if it got all inputs.
    given: Option<Vec<Modality>>,
    /// The windows, in ascending order.
    windows: &'a [Sample],
    values: Values,
}

/// Refuses values of categories that are no probabilities: from 0 to 1, with the sum 1 but for rounding.
fn check_probabilities(samples: &Samples, windows: &[Sample], values: &Values) -> Result<(), RecordedError> {
    const ROUNDING: f32 = 1e-3;
    let categories = values.iter().filter(|((modality, _), _)| samples.layout()[*modality].category);
    for (&of, values) in categories {
        let width = samples.layout()[of.0].width();
        let is_wrong = |values: &[f32]| {
            let is_beyond = |value: &f32| !(-ROUNDING..=1.0 + ROUNDING).contains(value);
            values.iter().any(is_beyond) || (values.iter().sum::<f32>() - 1.0).abs() > ROUNDING
        };
        if let Some(place) = values.chunks_exact(width).position(is_wrong) {
            let problem = "the values of categories are probabilities, from 0 to 1 and with the sum 1";
            return Err(RecordedValue::at(samples, windows, of, values, place * width).wrong(problem));
        }
    }
    Ok(())
}

impl<'a> Recorded<'a> {
    /// Sorts the values of a model by window. Each modality at each horizon that the test asks for must have a value
    /// for each element of each window, and there must be no others. `windows` are the present samples of the test's
    /// windows, in ascending order.
    ///
    /// # Errors
    /// When a value is of no window of the test, is not asked for, is not finite, occurs twice, or is missing.
    pub fn new(
        model: &str,
        samples: &Samples,
        windows: &'a [Sample],
        asked: Asked,
        recorded: impl IntoIterator<Item = RecordedValue>,
    ) -> Result<Self, RecordedError> {
        let mut values = Values::new();
        for at in recorded {
            let wrong = |problem: &str| at.wrong(problem);
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
        asked.check(&values)?;
        for (&of, values) in &values {
            if let Some(place) = values.iter().position(|value| value.is_nan()) {
                let missing = RecordedValue::at(samples, windows, of, values, place);
                let RecordedValue { modality, episode, sample, horizon, index, .. } = missing;
                let ahead = counted(horizon, "sample");
                return Err(RecordedError::Wrong(format!(
                    "episode {episode}, sample {sample}: element {index} of {modality}, {ahead} ahead, is missing"
                )));
            }
        }
        check_probabilities(samples, windows, &values)?;
        Ok(Self { model: model.to_owned(), given: None, windows, values })
    }

    /// Takes the values of whole modalities, `[windows, width]` by modality and horizon, in the order of the windows;
    /// images channel by channel.
    ///
    /// # Errors
    /// When the test asks for others, a number of values is wrong, or a value is not finite.
    pub fn of_windows(
        model: &str,
        samples: &Samples,
        windows: &'a [Sample],
        asked: Asked,
        values: Values,
    ) -> Result<Self, RecordedError> {
        asked.check(&values)?;
        for (&of, values) in &values {
            let (modality, horizon) = of;
            let (count, width, found) = (windows.len(), samples.layout()[modality].width(), values.len());
            if found != count * width {
                let ahead = counted(horizon, "sample");
                return Err(RecordedError::Wrong(format!(
                    "{modality} has {found} values, {ahead} ahead, instead of {count} times {width}"
                )));
            }
            if let Some(place) = values.iter().position(|value| !value.is_finite()) {
                let problem = "the value is not finite";
                return Err(RecordedValue::at(samples, windows, of, values, place).wrong(problem));
            }
        }
        check_probabilities(samples, windows, &values)?;
        Ok(Self { model: model.to_owned(), given: None, windows, values })
    }

    /// Says which modalities the model got, if these were not all inputs.
    pub fn with_given(self, given: Option<Vec<Modality>>) -> Self {
        Self { given, ..self }
    }

    /// Returns the modalities that the model got; `None` if these were all inputs.
    pub fn inputs(&self) -> Option<&[Modality]> {
        self.given.as_deref()
    }

    /// Returns the values by modality and horizon, `[windows, width]`.
    pub fn values(&self) -> &Values {
        &self.values
    }
}

/// Returns the position of the window that predicts a value; `None` if it is not of the test.
fn window_of(samples: &Samples, windows: &[Sample], at: &RecordedValue) -> Option<usize> {
    let episode = samples.episodes().get(at.episode)?;
    let present = at.sample.checked_sub(at.horizon)?;
    if at.sample >= episode.len() {
        return None;
    }
    windows.binary_search(&Sample::at(episode.start + present)).ok()
}

impl Predictor for Recorded<'_> {
    fn name(&self) -> &str {
        &self.model
    }

    fn given(&self) -> Option<&'static str> {
        self.given.clone().map(|inputs| Given::Inputs(inputs).name())
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> Result<(), JudgeError> {
        for (&(modality, horizon), values) in &self.values {
            let width = values.len() / self.windows.len();
            let rows = at.iter().filter_map(|sample| self.windows.binary_search(sample).ok());
            let values = rows.flat_map(|row| &values[row * width..][..width]).copied().collect();
            receive(&Predicted { modality, horizon, values, ensemble: None })?;
        }
        Ok(())
    }
}
