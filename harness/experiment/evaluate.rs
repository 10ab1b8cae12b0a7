//! A trained network, and the baselines, on the test transitions.

use super::ExperimentError;
use crate::dataset::{Partition, Samples, frame_difference};
use crate::learning::network::Decoder;
use crate::learning::objective::View;
use crate::learning::predict::{Predicted, decode};
use crate::metrics::baselines::{GREY_LEN, Ridge, RidgeSums, TrainingMean, downsample_frame, persistence};
use crate::metrics::parts::Part;
use crate::metrics::{Evaluation, MetricsError};
use crate::registry::{MetricRow, PredictionRow};
use crate::spec::{Modality, Task};
use candle_core::Tensor;
use std::collections::BTreeMap;

/// Strength of the ridge regression's penalty, on standardised inputs and thousands of samples.
const RIDGE_ALPHA: f64 = 1.0;
/// Test transitions that are evaluated at once; bounds the memory that frames take.
const BATCH: usize = 256;

/// The values of `modality` at the samples `at`, in physical units, `[at, width]`, frames channel by channel.
pub fn physical(samples: &Samples, modality: Modality, at: &[usize]) -> Vec<f32> {
    let mut values = Vec::with_capacity(at.len() * modality.width());
    for sample in at.iter().copied() {
        match modality {
            Modality::Vision => {
                values.extend(samples.frame_bytes(sample).iter().map(|byte| f32::from(*byte) / 255.0))
            }
            Modality::FrameDifference => values.extend(frame_difference(samples, sample)),
            _ => values.extend_from_slice(samples.vector(modality, sample)),
        }
    }
    values
}

/// The samples that a task predicts from the transitions `at`.
fn predicted_samples(task: Task, at: &[usize]) -> Vec<usize> {
    match task {
        Task::Prediction => at.iter().map(|sample| sample + 1).collect(),
        Task::Reconstruction => at.to_vec(),
    }
}

/// Metrics and predictions of a decoder on the test transitions, given their latent states `[test, latent]`.
pub fn network(
    view: &View,
    task: Task,
    decoder: &Decoder,
    output: &[Modality],
    latent: &Tensor,
    test: &[usize],
) -> Result<(Vec<MetricRow>, Vec<PredictionRow>), ExperimentError> {
    let mut evaluations: BTreeMap<Modality, Evaluation> =
        output.iter().map(|modality| (*modality, Evaluation::new(*modality))).collect();
    let mut predictions = Vec::new();
    let mut failure = None;
    decode(view, decoder, output, task == Task::Prediction, latent, test, |predicted| {
        let reference = physical(&view.samples, predicted.modality, &predicted_samples(task, predicted.at));
        if let Some(evaluation) = evaluations.get_mut(&predicted.modality) {
            let at = predicted_samples(task, predicted.at);
            let added =
                add(evaluation, &view.samples, predicted.modality, &at, &reference, &predicted.values);
            failure = failure.take().or(added.err());
        }
        if is_recorded(predicted.modality) {
            predictions.extend(prediction_rows(&view.samples, task, &predicted, &reference));
        }
    })
    .map_err(crate::learning::LearningError::from)?;
    if let Some(failure) = failure {
        return Err(failure.into());
    }
    let rows = evaluations.values().flat_map(|evaluation| label(task, "network", evaluation));
    Ok((rows.collect(), predictions))
}

/// Adds the predictions of `modality` at the samples `at` to its evaluation.
fn add(
    evaluation: &mut Evaluation,
    samples: &Samples,
    modality: Modality,
    at: &[usize],
    reference: &[f32],
    predicted: &[f32],
) -> Result<(), MetricsError> {
    if modality != Modality::FrameDifference {
        return evaluation.add(reference, predicted);
    }
    let parts =
        |sample: &usize| Part::in_either(samples.previous_frame_bytes(*sample), samples.frame_bytes(*sample));
    let parts: Vec<Option<Part>> = at.iter().flat_map(parts).collect();
    evaluation.add_with_parts(reference, predicted, &parts)
}

/// Whether single predictions are kept: those of the finger are, frames would take too much room.
fn is_recorded(modality: Modality) -> bool {
    !modality.is_frame() && modality != Modality::Arm
}

fn prediction_rows<'a>(
    samples: &'a Samples,
    task: Task,
    predicted: &'a Predicted,
    reference: &'a [f32],
) -> impl Iterator<Item = PredictionRow> + 'a {
    let width = predicted.modality.width();
    let places = predicted_samples(task, predicted.at).into_iter().map(|sample| samples.place(sample));
    places.enumerate().flat_map(move |(row, (episode, sample))| {
        (0..width).map(move |index| PredictionRow {
            task,
            modality: predicted.modality,
            episode: episode as u32,
            sample: sample as u32,
            index: index as u32,
            reference: reference[row * width + index],
            predicted: predicted.values[row * width + index],
        })
    })
}

fn label(task: Task, model: &'static str, evaluation: &Evaluation) -> Vec<MetricRow> {
    evaluation.rows().into_iter().map(|row| MetricRow { task, model, row }).collect()
}

/// Metrics of every baseline on the same test transitions: persistence, the training mean and, for vectors,
/// ridge regression on the encoder's input and the action.
///
/// A reconstruction has the training mean alone: persistence would be the answer itself.
pub fn baselines(
    view: &View,
    partition: &Partition,
    task: Task,
    input: &[Modality],
    output: &[Modality],
) -> Result<Vec<MetricRow>, ExperimentError> {
    let mut rows = Vec::new();
    for modality in output.iter().copied() {
        let mean = training_mean(view, partition, task, modality)?;
        rows.extend(judge(view, partition, task, modality, "training_mean", |at| {
            Ok(mean.predict(at.len())?)
        })?);
        if task == Task::Prediction {
            rows.extend(judge(view, partition, task, modality, "persistence", |at| {
                Ok(persistence(modality, &physical(&view.samples, modality, at)).into_owned())
            })?);
        }
    }
    if task == Task::Prediction {
        rows.extend(ridge(view, partition, input, output)?);
    }
    Ok(rows)
}

/// The metrics of `predict` on the test transitions, batch by batch.
fn judge(
    view: &View,
    partition: &Partition,
    task: Task,
    modality: Modality,
    model: &'static str,
    predict: impl Fn(&[usize]) -> Result<Vec<f32>, ExperimentError>,
) -> Result<Vec<MetricRow>, ExperimentError> {
    let mut evaluation = Evaluation::new(modality);
    for at in partition.test.chunks(BATCH) {
        let samples = predicted_samples(task, at);
        let reference = physical(&view.samples, modality, &samples);
        add(&mut evaluation, &view.samples, modality, &samples, &reference, &predict(at)?)?;
    }
    Ok(label(task, model, &evaluation))
}

fn training_mean(
    view: &View,
    partition: &Partition,
    task: Task,
    modality: Modality,
) -> Result<TrainingMean, ExperimentError> {
    let mut mean = TrainingMean::new(modality.width());
    for at in partition.training.chunks(BATCH) {
        mean.add(&physical(&view.samples, modality, &predicted_samples(task, at)))?;
    }
    Ok(mean)
}

/// Ridge regression from the encoder's input and the action to each vector that is predicted.
fn ridge(
    view: &View,
    partition: &Partition,
    input: &[Modality],
    output: &[Modality],
) -> Result<Vec<MetricRow>, ExperimentError> {
    let vectors: Vec<Modality> = output.iter().copied().filter(|modality| !modality.is_frame()).collect();
    let widths: usize = vectors.iter().map(|modality| modality.width()).sum();
    if vectors.is_empty() {
        return Ok(Vec::new());
    }
    let inputs = ridge_inputs(view, input, &partition.training[..1])?.len();
    let mut sums = RidgeSums::new(inputs, widths);
    for at in partition.training.chunks(BATCH) {
        sums.add(&ridge_inputs(view, input, at)?, &side_by_side(view, &vectors, at))?;
    }
    let ridge: Ridge = sums.solve(RIDGE_ALPHA)?;
    let mut rows = Vec::new();
    let mut first = 0;
    for modality in vectors.iter().copied() {
        rows.extend(judge(view, partition, Task::Prediction, modality, "ridge", |at| {
            let predicted = ridge.predict(&ridge_inputs(view, input, at)?)?;
            let columns =
                predicted.chunks_exact(widths).flat_map(|row| &row[first..first + modality.width()]);
            Ok(columns.copied().collect())
        })?);
        first += modality.width();
    }
    Ok(rows)
}

/// What is to be predicted from the transitions `at`: the next samples' vectors, side by side.
fn side_by_side(view: &View, vectors: &[Modality], at: &[usize]) -> Vec<f32> {
    let of = |sample: &usize| {
        let next = sample + 1;
        vectors.iter().flat_map(move |modality| view.samples.vector(*modality, next).iter().copied())
    };
    at.iter().flat_map(of).collect()
}

/// The encoder's input and the action, standardised, with frames as small grey pictures; `[at, inputs]`.
fn ridge_inputs(view: &View, input: &[Modality], at: &[usize]) -> Result<Vec<f32>, ExperimentError> {
    let learning =
        |error: candle_core::Error| ExperimentError::from(crate::learning::LearningError::from(error));
    let table = |tensor: Tensor| tensor.to_device(&candle_core::Device::Cpu)?.to_vec2::<f32>();
    let vectors =
        view.observation(at, input).map_err(learning)?.vector.map(table).transpose().map_err(learning)?;
    let actions = view.actions(at).and_then(table).map_err(learning)?;
    let mut rows = Vec::with_capacity(at.len() * (actions[0].len() + GREY_LEN));
    for (row, (sample, action)) in at.iter().zip(&actions).enumerate() {
        rows.extend_from_slice(action);
        rows.extend(vectors.iter().flat_map(|vectors| &vectors[row]));
        for modality in input.iter().copied().filter(|modality| modality.is_frame()) {
            let scale = &view.standard.scales[&modality];
            let frame = physical(&view.samples, modality, &[*sample]);
            let centred =
                frame.iter().zip(&scale.mean).map(|(value, mean)| (value - mean) / scale.deviation[0]);
            rows.extend(downsample_frame(&centred.collect::<Vec<_>>())?);
        }
    }
    Ok(rows)
}
