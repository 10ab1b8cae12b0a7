//! A trained network, and the baselines, on the test transitions.

use super::ExperimentError;
use crate::dataset::{FRAME_PLANE, Partition, Samples, frame_difference};
use crate::learning::network::Decoder;
use crate::learning::objective::View;
use crate::learning::predict::{Predicted, decode};
use crate::metrics::baselines::{Ridge, RidgeSums, TrainingMean, downsample_frame, persistence};
use crate::metrics::parts::Part;
use crate::metrics::{Evaluation, MetricsError, contact};
use crate::registry::{ForceRows, FrameRow, MetricRow, PredictionRow};
use crate::spec::{FRAME_CHANNELS, Modality, Task};
use candle_core::Tensor;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;

/// Strength of the ridge regression's penalty, on standardised inputs and thousands of samples.
const RIDGE_ALPHA: f64 = 1.0;
/// Test transitions that are evaluated at once; bounds the memory that frames take.
const BATCH: usize = 256;

/// The values of `modality` at the samples `at`, in physical units, `[at, width]`, frames channel by channel.
pub fn physical(samples: &Samples, modality: Modality, at: &[usize]) -> Vec<f32> {
    let mut values = vec![0.0; at.len() * modality.width()];
    if modality.is_frame() {
        samples.prefetch(at);
    }
    values.par_chunks_exact_mut(modality.width()).zip(at).for_each(|(values, &sample)| match modality {
        Modality::Vision => {
            let bytes = samples.frame_bytes(sample);
            values.iter_mut().zip(bytes).for_each(|(value, byte)| *value = f32::from(*byte) / 255.0);
        }
        Modality::FrameDifference => {
            let changes = frame_difference(samples, sample);
            values.iter_mut().zip(changes).for_each(|(value, change)| *value = change);
        }
        _ => values.copy_from_slice(samples.vector(modality, sample)),
    });
    values
}

/// The samples that a task predicts from the transitions `at`.
fn predicted_samples(task: Task, at: &[usize]) -> Vec<usize> {
    match task {
        Task::Prediction => at.iter().map(|sample| sample + 1).collect(),
        Task::Reconstruction => at.to_vec(),
    }
}

/// What a decoder made of the test transitions.
pub struct Evaluated {
    pub metrics: Vec<MetricRow>,
    pub predictions: Vec<PredictionRow>,
    pub frames: Vec<FrameRow>,
}

/// Metrics and predictions of a decoder on the test transitions, given their latent states `[test, latent]`, and
/// pictures of those in `storyboard`.
pub fn network(
    view: &View,
    task: Task,
    decoder: &dyn Decoder,
    output: &[Modality],
    latent: &Tensor,
    test: &[usize],
    storyboard: &[Story],
) -> Result<Evaluated, ExperimentError> {
    let mut evaluations: BTreeMap<Modality, Evaluation> =
        output.iter().map(|modality| (*modality, Evaluation::new(*modality))).collect();
    let (mut predictions, mut frames) = (Vec::new(), Vec::new());
    let mut failure = None;
    decode(view, decoder, output, task == Task::Prediction, latent, test, |predicted| {
        let reference = physical(&view.samples, predicted.modality, &predicted_samples(task, predicted.at));
        if let Some(evaluation) = evaluations.get_mut(&predicted.modality) {
            let at = predicted_samples(task, predicted.at);
            let added =
                add(evaluation, &view.samples, predicted.modality, &at, &reference, &predicted.values);
            failure = failure.take().or(added.err());
        }
        if predicted.modality.is_frame() {
            frames.extend(frame_rows(&view.samples, task, &predicted, &reference, storyboard));
        }
        if is_recorded(predicted.modality) {
            predictions.extend(prediction_rows(&view.samples, task, &predicted, &reference));
        }
    })
    .map_err(crate::learning::LearningError::from)?;
    if let Some(failure) = failure {
        return Err(failure.into());
    }
    let metrics = evaluations.values().flat_map(|evaluation| label(task, "network", evaluation)).collect();
    Ok(Evaluated { metrics, predictions, frames })
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
    // A real camera's colours do not tell the robot's parts.
    if modality != Modality::FrameDifference || !samples.is_simulated() {
        return evaluation.add(reference, predicted);
    }
    let parts =
        |sample: &usize| Part::in_either(samples.previous_frame_bytes(*sample), samples.frame_bytes(*sample));
    let parts: Vec<Option<Part>> = at.par_iter().flat_map_iter(parts).collect();
    evaluation.add_with_parts(reference, predicted, &parts)
}

/// Whether every single prediction is kept: those of the finger are, frames would take too much room.
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

/// A test transition whose pictures are kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Story {
    pub transition: usize,
    /// Mean absolute change of the camera frame from the transition's sample to its next, in [0, 1].
    pub motion: f64,
}

/// Where the kept transitions stand among all test transitions by their motion: from hardly any to the most.
const STORYBOARD: [f64; 5] = [0.02, 0.3, 0.6, 0.85, 0.98];

/// The test transitions whose pictures are kept, from the least motion to the most; none without frames.
///
/// The choice depends on the dataset alone, so that the pictures of all networks can be compared.
pub fn storyboard(samples: &Samples, test: &[usize]) -> Vec<Story> {
    if !samples.has_frames() || test.is_empty() {
        return Vec::new();
    }
    let motion = |transition: usize| {
        let (sum, values) = frame_difference(samples, transition + 1)
            .fold((0.0, 0), |(sum, values), change| (sum + f64::from(change.abs()), values + 1));
        Story { transition, motion: sum / f64::from(values) }
    };
    let batches = test.par_chunks(BATCH).flat_map_iter(|at| {
        samples.prefetch(at);
        at.iter().map(|&transition| motion(transition))
    });
    let mut stories: Vec<Story> = batches.collect();
    stories.sort_by(|a, b| a.motion.total_cmp(&b.motion).then(a.transition.cmp(&b.transition)));
    STORYBOARD.map(|share| stories[(share * (stories.len() - 1) as f64).round() as usize]).to_vec()
}

fn frame_rows<'a>(
    samples: &'a Samples,
    task: Task,
    predicted: &'a Predicted,
    reference: &'a [f32],
    storyboard: &'a [Story],
) -> impl Iterator<Item = FrameRow> + 'a {
    let width = predicted.modality.width();
    storyboard.iter().filter_map(move |story| {
        let row = predicted.at.iter().position(|&transition| transition == story.transition)?;
        let (episode, sample) = samples.place(predicted_samples(task, &[story.transition])[0]);
        let picture = |values: &[f32]| picture(predicted.modality, &values[row * width..][..width]);
        Some(FrameRow {
            task,
            modality: predicted.modality,
            episode: episode as u32,
            sample: sample as u32,
            motion: story.motion,
            reference: picture(reference),
            predicted: picture(&predicted.values),
        })
    })
}

/// A frame `[channel, row, column]` as bytes `[row, column, channel]`: an intensity in [0, 1] times 255, a difference
/// in [-1, 1] times 127 around 128, so that no change is kept exactly.
fn picture(modality: Modality, values: &[f32]) -> Vec<u8> {
    let byte = |value: f32| match modality {
        Modality::FrameDifference => (128.0 + 127.0 * value).round().clamp(1.0, 255.0) as u8,
        _ => (255.0 * value).round().clamp(0.0, 255.0) as u8,
    };
    (0..FRAME_PLANE)
        .flat_map(|pixel| (0..FRAME_CHANNELS).map(move |channel| byte(values[channel * FRAME_PLANE + pixel])))
        .collect()
}

/// How those forces that the dataset holds are distributed, link by link: over the whole of it, and in each of its
/// episodes.
pub fn forces(samples: &Samples, holds: impl Fn(Modality) -> bool) -> Vec<ForceRows> {
    let of = |modality, episode, range: Range<usize>| {
        let forces: Vec<f32> = range.flat_map(|sample| samples.vector(modality, sample)).copied().collect();
        ForceRows { modality, episode, links: contact::by_link(&forces) }
    };
    let mut rows = Vec::new();
    let forces = [Modality::ContactForce, Modality::ContactForceMean];
    for modality in forces.into_iter().filter(|modality| holds(*modality)) {
        rows.push(of(modality, None, 0..samples.len()));
        let episodes = (0..).zip(samples.episodes());
        rows.extend(episodes.map(|(episode, range)| of(modality, Some(episode), range.clone())));
    }
    rows
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
    let frames: Vec<Modality> = input.iter().copied().filter(|modality| modality.is_frame()).collect();
    let rows = at.par_iter().enumerate().map(|(row, &sample)| {
        let mut values = actions[row].clone();
        values.extend(vectors.iter().flat_map(|vectors| &vectors[row]));
        for modality in &frames {
            let mut frame = physical(&view.samples, *modality, &[sample]);
            view.standard.scales[modality].standardise(&mut frame);
            values.extend(downsample_frame(&frame)?);
        }
        Ok(values)
    });
    let rows: Vec<Vec<f32>> = rows.collect::<Result<_, MetricsError>>()?;
    Ok(rows.concat())
}
