//! What a prediction is worth. Anything that predicts is a [`Predictor`], and [`judge`] turns its predictions into rows
//! of the tables. This crate knows no networks: those that were trained are predictors of the crate `learning`.

mod frames;
mod nearest;
mod persistence;
mod recorded;
mod ridge;
mod rows;
mod training_mean;

pub use frames::{SampledWindow, picture, sample_windows};
pub use nearest::NearestNeighbors;
pub use persistence::Persistence;
pub use recorded::{Asked, Recorded, RecordedError, RecordedValue};
pub use ridge::{Given, Ridge};
pub use rows::{FrameRow, MetricRow, Of, PredictionRow, SumRow, is_usual};
pub use training_mean::TrainingMean;

use harness_metrics::{Ensemble, Evaluation, ForceEvaluation, Forces, MetricsError, Points, Row, parts};
use harness_samples::{Sample, Samples, after, physical};
use harness_spec::{Modality, Task};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;

/// Number of windows that are predicted at once. It limits the memory for frames.
pub const BATCH: usize = 256;

/// The values of the column `model`, besides the names of models of other programs.
pub mod models {
    /// A trained network.
    pub const NETWORK: &str = "network";
    /// The present sample, repeated.
    pub const PERSISTENCE: &str = "persistence";
    /// A linear regression of the model's input and the action.
    pub const RIDGE: &str = "ridge";
    /// The mean of the training samples.
    pub const TRAINING_MEAN: &str = "training_mean";
    /// The mean of the training samples with the nearest input, for estimates of the present sample.
    pub const NEAREST_NEIGHBORS: &str = "nearest_neighbors";
    /// The decoder of the reconstruction with an encoder that is not trained, which estimates the probes.
    pub const UNTRAINED: &str = "untrained";
    /// The baselines.
    pub const BASELINES: [&str; 4] = [PERSISTENCE, RIDGE, TRAINING_MEAN, NEAREST_NEIGHBORS];
    /// All that the harness has. Models of other programs have names of their own.
    pub const ALL: [&str; 6] = [NETWORK, PERSISTENCE, RIDGE, TRAINING_MEAN, NEAREST_NEIGHBORS, UNTRAINED];

    /// The names of the baselines as a list of SQL.
    pub fn baselines_in_sql() -> String {
        BASELINES.map(|name| format!("'{name}'")).join(", ")
    }

    /// Whether the model of this name is a baseline.
    pub fn is_baseline(name: &str) -> bool {
        BASELINES.contains(&name)
    }
}

/// Why predictions can't be judged.
#[derive(Debug, thiserror::Error)]
pub enum JudgeError {
    /// The predictions can't be compared with the reference.
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    /// The predictor failed.
    #[error("{0}")]
    Predictor(#[source] Box<dyn std::error::Error + Send + Sync>),
}

/// The predictions of one modality for a batch of windows, at one distance from the present.
pub struct Predicted {
    /// The predicted modality.
    pub modality: Modality,
    /// Number of samples from the present to the predicted one; 0 for the present one.
    pub horizon: usize,
    /// Predicted values in physical units, `[windows, width]`; images channel by channel. They are the means of the
    /// ensemble if there is one.
    pub values: Vec<f32>,
    /// The predictive distribution of each value of a vector; `None` if only the values are predicted.
    pub ensemble: Option<Ensemble>,
}

/// Receives the predictions of a batch.
pub type Receive<'a> = dyn FnMut(&Predicted) -> Result<(), JudgeError> + 'a;

/// Anything that predicts samples from what came before them.
pub trait Predictor {
    /// Returns the name in the column `model`.
    fn name(&self) -> &str;

    /// Returns the names of the modalities that it got, as in the column `given`; `None` if these are all that its run
    /// lists as input.
    fn given(&self) -> Option<&'static str> {
        None
    }

    /// Predicts each modality of the windows at these present samples, and passes it to `receive`.
    ///
    /// # Errors
    /// When the prediction fails, and errors of `receive`.
    fn predict(&self, at: &[Sample], receive: &mut Receive) -> Result<(), JudgeError>;
}

/// The samples on which predictors are judged.
#[derive(Clone, Copy)]
pub struct Test<'a> {
    /// The dataset.
    pub samples: &'a Samples,
    /// What the rows call the task.
    pub task: Task,
    /// The present samples of the windows that are predicted.
    pub windows: &'a [Sample],
    /// Times since the start of an episode, s. The predicted samples at each of them and later have metrics of their
    /// own.
    pub since_s: &'a [u32],
    /// The windows whose images are stored. `None` if only the metrics are wanted, without predictions and images.
    pub sampled: Option<&'a [SampledWindow]>,
}

/// The rows of a predictor.
#[derive(Clone, Default)]
pub struct Judged {
    /// Rows of the metrics table.
    pub metrics: Vec<MetricRow>,
    /// Rows of the table of sums.
    pub sums: Vec<SumRow>,
    /// Rows of the predictions table.
    pub predictions: Vec<PredictionRow>,
    /// Rows of the frames table.
    pub frames: Vec<FrameRow>,
}

/// Judges a predictor on the windows of a test.
///
/// # Errors
/// When the predictor fails, or its predictions have the wrong shape or are not finite.
pub fn judge(predictor: &dyn Predictor, test: &Test) -> Result<Judged, JudgeError> {
    let layout = test.samples.layout();
    let mut evaluations = BTreeMap::<(Modality, usize), Evaluation>::new();
    let mut later = BTreeMap::<(Modality, usize, u32), Evaluation>::new();
    let mut forces = BTreeMap::<(Modality, usize), ForceEvaluation>::new();
    let mut judged = Judged::default();
    let given = predictor.given();
    for at in test.windows.chunks(BATCH) {
        predictor.predict(at, &mut |predicted| {
            let Predicted { modality, horizon, values, ensemble } = predicted;
            let definition = &layout[*modality];
            let ahead = after(at, *horizon);
            let reference = physical(test.samples, *modality, &ahead);
            let new = || Evaluation::new(definition, &layout.regions_of(*modality));
            let medians = ensemble.as_ref().map(Ensemble::medians);
            let points = Points { mean: values, median: medians.as_ref().unwrap_or(values) };
            let evaluation = evaluations.entry((*modality, *horizon)).or_insert_with(new);
            for (rows, episode) in divided(&ahead, |sample| test.samples.place(sample).0) {
                let values = rows.start * definition.width()..rows.end * definition.width();
                let (own, points) = (&reference[values.clone()], points.part(values));
                add(evaluation, test.samples, *modality, &ahead[rows], own, points)?;
                evaluation.end_episode(episode as u32);
            }
            if definition.is_force() {
                let of_forces = || ForceEvaluation::new(definition);
                forces.entry((*modality, *horizon)).or_insert_with(of_forces).add(&Forces {
                    present: &physical(test.samples, *modality, at),
                    reference: &reference,
                    predicted: values,
                    ensemble: ensemble.as_ref(),
                    seeds: &ahead.iter().map(|sample| sample.index() as u64).collect::<Vec<_>>(),
                })?;
            }
            for &since_s in test.since_s {
                let evaluation = later.entry((*modality, *horizon, since_s)).or_insert_with(new);
                add_since(since_s, evaluation, test.samples, &ahead, &reference, points)?;
            }
            if let Some(sampled) = test.sampled {
                if is_usual(*horizon, given) {
                    judged.frames.extend(frames::rows(test, sampled, at, &reference, predicted));
                }
                judged.predictions.extend(rows::predictions(test, given, &ahead, &reference, predicted));
            }
            Ok(())
        })?;
    }
    let (task, model) = (test.task, predictor.name());
    let Judged { metrics, sums, .. } = &mut judged;
    let mut list = |horizon: usize, rows: Vec<Row>| {
        let named = |row| MetricRow { task, model: model.to_owned(), horizon, given, row };
        metrics.extend(rows.into_iter().map(named));
    };
    for ((_, horizon), evaluation) in &evaluations {
        list(*horizon, evaluation.rows());
        let named = |row| SumRow { task, model: model.to_owned(), horizon: *horizon, given, row };
        sums.extend(evaluation.sums().into_iter().map(named));
    }
    forces.iter().for_each(|((_, horizon), evaluation)| list(*horizon, evaluation.rows()));
    for ((_, horizon, since_s), evaluation) in &later {
        list(*horizon, evaluation.rows_of_region(&format!("from_{since_s}s")));
    }
    Ok(judged)
}

/// Divides samples where `key` changes. Returns the range of each part, and its key.
fn divided<K: PartialEq>(
    at: &[Sample],
    key: impl Fn(Sample) -> K,
) -> impl Iterator<Item = (Range<usize>, K)> {
    let mut keys = Vec::new();
    for (place, sample) in at.iter().enumerate() {
        let key = key(*sample);
        if keys.last().is_none_or(|(_, last)| *last != key) {
            keys.push((place, key));
        }
    }
    let ends: Vec<usize> = keys.iter().skip(1).map(|(first, _)| *first).chain([at.len()]).collect();
    keys.into_iter().zip(ends).map(|((first, key), end)| (first..end, key))
}

/// Adds the predictions of those samples `at` to an evaluation that are at `since_s` of their episode or later. Values
/// in regions are not told apart.
fn add_since(
    since_s: u32,
    evaluation: &mut Evaluation,
    samples: &Samples,
    at: &[Sample],
    reference: &[f32],
    predicted: Points,
) -> Result<(), MetricsError> {
    let first = f64::from(since_s) * samples.recording().sample_rate_hz;
    let width = reference.len() / at.len();
    for (rows, is_later) in divided(at, |sample| samples.place(sample).1 as f64 >= first) {
        let values = rows.start * width..rows.end * width;
        if is_later {
            evaluation.add(&reference[values.clone()], predicted.part(values))?;
        }
    }
    Ok(())
}

/// Adds the predictions of `modality` at the samples `at` to an evaluation.
fn add(
    evaluation: &mut Evaluation,
    samples: &Samples,
    modality: Modality,
    at: &[Sample],
    reference: &[f32],
    predicted: Points,
) -> Result<(), MetricsError> {
    if !evaluation.has_regions() {
        return evaluation.add(reference, predicted);
    }
    let layout = samples.layout();
    let regions: Vec<Option<u8>> = match layout[modality].contact_kind() {
        Some(kinds) => {
            let last = layout[modality].contact_kinds.len() as u8;
            // A contact of no kind, which has the value after the last kind, belongs to no region.
            let region = |kind: &f32| Some(*kind as u8).filter(|kind| *kind <= last);
            at.iter().flat_map(|sample| samples.vector(kinds, *sample).iter().map(region)).collect()
        }
        None => {
            let segmentation = layout.segmentation_of(modality).map(|(segmentation, _)| segmentation);
            let regions = |sample: &Sample| {
                let shown = segmentation.unwrap_or(modality);
                let [before, after] =
                    [samples.previous_frame_bytes(shown, *sample), samples.frame_bytes(shown, *sample)];
                parts::in_either(before, after, |pixel| match segmentation {
                    Some(_) => parts::class_of(pixel),
                    None => parts::region_of(&layout.regions, pixel),
                })
            };
            at.par_iter().flat_map_iter(regions).collect()
        }
    };
    evaluation.add_with_regions(reference, predicted, &regions)
}
