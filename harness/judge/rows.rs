//! The rows of tables that predictions become.

use super::{Predicted, Test};
use harness_metrics::{EpisodeSums, Row};
use harness_samples::Sample;
use harness_spec::{Modality, Task};

/// A value that a predictor got in a test, with the columns that say which test. Those that identify the run are left
/// out.
#[derive(Debug, Clone)]
pub struct Of<R> {
    /// The task that is evaluated.
    pub task: Task,
    /// The predictor's name: `network`, or that of a baseline or a model of another program.
    pub model: String,
    /// Number of samples from the present to the predicted one; 0 for the present one.
    pub horizon: usize,
    /// The modalities that the predictor got, as `arm,proprioception`; `None` if it got all of its run's input.
    pub given: Option<&'static str>,
    /// The value, and what it is computed over.
    pub row: R,
}

/// A row of the metrics table.
pub type MetricRow = Of<Row>;
/// A row of the table of sums.
pub type SumRow = Of<EpisodeSums>;

/// A row of the predictions table, without the columns that identify the run.
#[derive(Debug, Clone, Copy)]
pub struct PredictionRow {
    /// The task that is evaluated.
    pub task: Task,
    /// Number of samples from the present to the predicted one; 0 for the present one.
    pub horizon: u32,
    /// The modalities that the predictor got, as `arm,proprioception`; `None` if it got all of its run's input.
    pub given: Option<&'static str>,
    /// The vector that contains the element.
    pub modality: Modality,
    /// The episode of the dataset.
    pub episode: u32,
    /// The predicted sample, counted from 0 within its episode.
    pub sample: u32,
    /// The element of the vector, counted from 0.
    pub index: u32,
    /// The simulated or recorded value, in the modality's unit.
    pub reference: f32,
    /// The predicted value, in the modality's unit.
    pub predicted: f32,
}

/// A row of the frames table, without the columns that identify the run.
#[derive(Debug, Clone)]
pub struct FrameRow {
    /// The task that is evaluated.
    pub task: Task,
    /// The image that is predicted.
    pub modality: Modality,
    /// The episode of the dataset.
    pub episode: u32,
    /// The predicted sample, counted from 0 within its episode.
    pub sample: u32,
    /// The mean absolute change of the camera image from the present sample to the next, in [0, 1].
    pub motion: f64,
    /// The simulated or recorded image, `[rows, columns, 3]`, encoded as the table's schema says.
    pub reference: Vec<u8>,
    /// The predicted image, likewise.
    pub predicted: Vec<u8>,
}

/// Whether a row is of the nearest sample that its task predicts, by a predictor that got all inputs. The tables
/// `metrics` and `predictions` have only such rows.
pub fn is_usual(horizon: usize, given: Option<&str>) -> bool {
    horizon <= 1 && given.is_none()
}

/// Returns a row for each element of the predicted samples `ahead`. There are none for images, which would take too
/// much space, and for values of different units, which can't share a column.
pub(super) fn predictions(
    test: &Test,
    given: Option<&'static str>,
    ahead: &[Sample],
    reference: &[f32],
    predicted: &Predicted,
) -> Vec<PredictionRow> {
    let definition = &test.samples.layout()[predicted.modality];
    if definition.is_image() || definition.unit().is_none() {
        return Vec::new();
    }
    let width = definition.width();
    let mut rows = Vec::with_capacity(ahead.len() * width);
    for (row, sample) in ahead.iter().enumerate() {
        let (episode, sample) = test.samples.place(*sample);
        rows.extend((0..width).map(|index| PredictionRow {
            task: test.task,
            horizon: predicted.horizon as u32,
            given,
            modality: predicted.modality,
            episode: episode as u32,
            sample: sample as u32,
            index: index as u32,
            reference: reference[row * width + index],
            predicted: predicted.values[row * width + index],
        }));
    }
    rows
}
