//! Evaluates a trained network and the baselines on the test transitions.

use super::ExperimentError;
use candle_core::Tensor;
use harness_dataset::{Partition, Samples, frame_difference, physical};
use harness_learning::network::Decoder;
use harness_learning::objective::NormalizedData;
use harness_learning::predict::{Predicted, decode};
use harness_metrics::baselines::{Ridge, RidgeSums, TrainingMean, downsample_frame, persistence};
use harness_metrics::parts;
use harness_metrics::{Evaluation, MetricsError, contact};
use harness_registry::{ForceRows, FrameRow, MetricRow, PredictionRow};
use harness_spec::{Definition, IMAGE_CHANNELS, Modality, Task};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;

/// Factor of the ridge regression's penalty, for normalized inputs and thousands of samples.
const RIDGE_ALPHA: f64 = 1.0;
/// Number of test transitions that are evaluated at once. It limits the memory for frames.
const BATCH: usize = 256;

/// Returns the samples that a task predicts from the transitions `at`.
fn predicted_samples(task: Task, at: &[usize]) -> Vec<usize> {
    match task {
        Task::Prediction => at.iter().map(|sample| sample + 1).collect(),
        Task::Reconstruction => at.to_vec(),
    }
}

/// The results of a decoder on the test transitions.
pub struct Evaluated {
    /// Rows of the metrics table.
    pub metrics: Vec<MetricRow>,
    /// Rows of the predictions table.
    pub predictions: Vec<PredictionRow>,
    /// Rows of the frames table.
    pub frames: Vec<FrameRow>,
}

/// Evaluates a decoder on the test transitions, given their latent states `[test, latent]`. Returns metrics,
/// predictions, and the images of the `sampled_transitions`.
pub fn network(
    data: &NormalizedData,
    task: Task,
    decoder: &dyn Decoder,
    output: &[Modality],
    latent: &Tensor,
    test: &[usize],
    sampled_transitions: &[SampledTransition],
) -> Result<Evaluated, ExperimentError> {
    let layout = data.samples.layout();
    let evaluation = |modality: &Modality| (*modality, Evaluation::new(&layout[*modality], &layout.regions));
    let mut evaluations: BTreeMap<Modality, Evaluation> = output.iter().map(evaluation).collect();
    let (mut predictions, mut frames) = (Vec::new(), Vec::new());
    let mut failure = None;
    decode(data, decoder, output, task == Task::Prediction, latent, test, |predicted| {
        let reference = physical(&data.samples, predicted.modality, &predicted_samples(task, predicted.at));
        if let Some(evaluation) = evaluations.get_mut(&predicted.modality) {
            let at = predicted_samples(task, predicted.at);
            let added =
                add(evaluation, &data.samples, predicted.modality, &at, &reference, &predicted.values);
            failure = failure.take().or(added.err());
        }
        if layout[predicted.modality].is_image() {
            frames.extend(frame_rows(&data.samples, task, &predicted, &reference, sampled_transitions));
        }
        if is_recorded(&layout[predicted.modality]) {
            predictions.extend(prediction_rows(&data.samples, task, &predicted, &reference));
        }
    })
    .map_err(harness_learning::LearningError::from)?;
    if let Some(failure) = failure {
        return Err(failure.into());
    }
    let metrics = evaluations.values().flat_map(|evaluation| label(task, "network", evaluation)).collect();
    Ok(Evaluated { metrics, predictions, frames })
}

/// Adds the predictions of `modality` at the samples `at` to an evaluation.
fn add(
    evaluation: &mut Evaluation,
    samples: &Samples,
    modality: Modality,
    at: &[usize],
    reference: &[f32],
    predicted: &[f32],
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
            let regions = |sample: &usize| {
                let before = samples.previous_frame_bytes(modality, *sample);
                parts::in_either(&layout.regions, before, samples.frame_bytes(modality, *sample))
            };
            at.par_iter().flat_map_iter(regions).collect()
        }
    };
    evaluation.add_with_regions(reference, predicted, &regions)
}

/// Whether every prediction of a modality is stored. Images would take too much space, and values of different units
/// can't share a column.
fn is_recorded(definition: &Definition) -> bool {
    !definition.is_image() && definition.unit().is_some()
}

fn prediction_rows<'a>(
    samples: &'a Samples,
    task: Task,
    predicted: &'a Predicted,
    reference: &'a [f32],
) -> impl Iterator<Item = PredictionRow> + 'a {
    let width = samples.layout()[predicted.modality].width();
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

/// A test transition whose images are stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SampledTransition {
    /// The transition, given by its first sample.
    pub transition: usize,
    /// Mean absolute change of the first camera's image from this sample to the next, in [0, 1].
    pub motion: f64,
}

/// Quantiles of the test transitions' motion at which the stored transitions are chosen.
const MOTION_QUANTILES: [f64; 5] = [0.02, 0.3, 0.6, 0.85, 0.98];

/// Returns the test transitions whose images are stored, from the least to the most motion; none without
/// images of a camera. The motion is that in the first camera's image.
///
/// The choice depends only on the dataset, so the images of all networks can be compared.
pub fn sample_transitions(samples: &Samples, test: &[usize]) -> Vec<SampledTransition> {
    let Some(camera) = samples.layout().camera_images().next().map(|image| image.name) else {
        return Vec::new();
    };
    if !samples.has_frames() || test.is_empty() {
        return Vec::new();
    }
    let motion = |transition: usize| {
        let (sum, values) = frame_difference(samples, camera, transition + 1)
            .fold((0.0, 0), |(sum, values), change| (sum + f64::from(change.abs()), values + 1));
        SampledTransition { transition, motion: sum / f64::from(values) }
    };
    let batches = test.par_chunks(BATCH).flat_map_iter(|at| {
        samples.prefetch(camera, at);
        at.iter().map(|&transition| motion(transition))
    });
    let mut transitions: Vec<SampledTransition> = batches.collect();
    transitions.sort_by(|a, b| a.motion.total_cmp(&b.motion).then(a.transition.cmp(&b.transition)));
    MOTION_QUANTILES
        .map(|share| transitions[(share * (transitions.len() - 1) as f64).round() as usize])
        .to_vec()
}

fn frame_rows<'a>(
    samples: &'a Samples,
    task: Task,
    predicted: &'a Predicted,
    reference: &'a [f32],
    sampled_transitions: &'a [SampledTransition],
) -> impl Iterator<Item = FrameRow> + 'a {
    let definition = &samples.layout()[predicted.modality];
    let width = definition.width();
    sampled_transitions.iter().filter_map(move |sampled| {
        let row = predicted.at.iter().position(|&transition| transition == sampled.transition)?;
        let (episode, sample) = samples.place(predicted_samples(task, &[sampled.transition])[0]);
        let picture = |values: &[f32]| picture(definition, &values[row * width..][..width]);
        Some(FrameRow {
            task,
            modality: predicted.modality,
            episode: episode as u32,
            sample: sample as u32,
            motion: sampled.motion,
            reference: picture(reference),
            predicted: picture(&predicted.values),
        })
    })
}

/// Converts a frame `[channel, row, column]` to bytes `[row, column, channel]`. An intensity in [0, 1] is multiplied by
/// 255. A difference in [-1, 1] is multiplied by 127 and added to 128, so that no change is represented exactly.
fn picture(definition: &Definition, values: &[f32]) -> Vec<u8> {
    let byte = |value: f32| match definition.difference_of {
        Some(_) => (128.0 + 127.0 * value).round().clamp(1.0, 255.0) as u8,
        None => (255.0 * value).round().clamp(0.0, 255.0) as u8,
    };
    let pixels = values.len() / IMAGE_CHANNELS;
    (0..pixels)
        .flat_map(|pixel| (0..IMAGE_CHANNELS).map(move |channel| byte(values[channel * pixels + pixel])))
        .collect()
}

/// Returns the distribution of the forces on each link, over the whole dataset and in each of its episodes.
pub fn forces(samples: &Samples) -> Vec<ForceRows> {
    let of = |definition: &Definition, episode, range: Range<usize>| {
        let (modality, width) = (definition.name, definition.width());
        let forces = &samples.vectors(modality)[range.start * width..range.end * width];
        ForceRows { modality, episode, links: contact::by_link(forces, width) }
    };
    let mut rows = Vec::new();
    for modality in samples.layout().stored_vectors().filter(|definition| definition.is_force()) {
        rows.push(of(modality, None, 0..samples.len()));
        let episodes = (0..).zip(samples.episodes());
        rows.extend(episodes.map(|(episode, range)| of(modality, Some(episode), range.clone())));
    }
    rows
}

fn label(task: Task, model: &'static str, evaluation: &Evaluation) -> Vec<MetricRow> {
    evaluation.rows().into_iter().map(|row| MetricRow { task, model, row }).collect()
}

/// Evaluates all baselines on the same test transitions: persistence, the training mean and, for vectors, ridge
/// regression on the encoder's input and the action.
///
/// A reconstruction has only the training mean, because persistence would be its target.
pub fn baselines(
    data: &NormalizedData,
    partition: &Partition,
    task: Task,
    input: &[Modality],
    output: &[Modality],
) -> Result<Vec<MetricRow>, ExperimentError> {
    let mut rows = Vec::new();
    for modality in output.iter().copied() {
        let mean = training_mean(data, partition, task, modality)?;
        rows.extend(judge(data, partition, task, modality, "training_mean", |at| {
            Ok(mean.predict(at.len())?)
        })?);
        if task == Task::Prediction {
            rows.extend(judge(data, partition, task, modality, "persistence", |at| {
                Ok(persistence(&data.samples.layout()[modality], &physical(&data.samples, modality, at))
                    .into_owned())
            })?);
        }
    }
    if task == Task::Prediction {
        rows.extend(ridge(data, partition, input, output)?);
    }
    Ok(rows)
}

/// Evaluates `predict` on the test transitions, batch by batch.
fn judge(
    data: &NormalizedData,
    partition: &Partition,
    task: Task,
    modality: Modality,
    model: &'static str,
    predict: impl Fn(&[usize]) -> Result<Vec<f32>, ExperimentError>,
) -> Result<Vec<MetricRow>, ExperimentError> {
    let layout = data.samples.layout();
    let mut evaluation = Evaluation::new(&layout[modality], &layout.regions);
    for at in partition.test.chunks(BATCH) {
        let samples = predicted_samples(task, at);
        let reference = physical(&data.samples, modality, &samples);
        add(&mut evaluation, &data.samples, modality, &samples, &reference, &predict(at)?)?;
    }
    Ok(label(task, model, &evaluation))
}

fn training_mean(
    data: &NormalizedData,
    partition: &Partition,
    task: Task,
    modality: Modality,
) -> Result<TrainingMean, ExperimentError> {
    let mut mean = TrainingMean::new(data.samples.layout()[modality].width());
    for at in partition.training.chunks(BATCH) {
        mean.add(&physical(&data.samples, modality, &predicted_samples(task, at)))?;
    }
    Ok(mean)
}

/// Evaluates a ridge regression from the encoder's input and the action to each predicted vector.
fn ridge(
    data: &NormalizedData,
    partition: &Partition,
    input: &[Modality],
    output: &[Modality],
) -> Result<Vec<MetricRow>, ExperimentError> {
    let layout = data.samples.layout();
    let vectors: Vec<Modality> =
        output.iter().copied().filter(|modality| !layout[*modality].is_image()).collect();
    let widths: usize = vectors.iter().map(|modality| layout[*modality].width()).sum();
    if vectors.is_empty() {
        return Ok(Vec::new());
    }
    let inputs = ridge_inputs(data, input, &partition.training[..1])?.len();
    let mut sums = RidgeSums::new(inputs, widths);
    for at in partition.training.chunks(BATCH) {
        sums.add(&ridge_inputs(data, input, at)?, &side_by_side(data, &vectors, at))?;
    }
    let ridge: Ridge = sums.solve(RIDGE_ALPHA)?;
    let mut rows = Vec::new();
    let mut first = 0;
    for modality in vectors.iter().copied() {
        let width = layout[modality].width();
        rows.extend(judge(data, partition, Task::Prediction, modality, "ridge", |at| {
            let predicted = ridge.predict(&ridge_inputs(data, input, at)?)?;
            let columns = predicted.chunks_exact(widths).flat_map(|row| &row[first..first + width]);
            Ok(columns.copied().collect())
        })?);
        first += width;
    }
    Ok(rows)
}

/// Returns the targets of the transitions `at`: the next samples' vectors, side by side.
fn side_by_side(data: &NormalizedData, vectors: &[Modality], at: &[usize]) -> Vec<f32> {
    let of = |sample: &usize| {
        let next = sample + 1;
        vectors.iter().flat_map(move |modality| data.samples.vector(*modality, next).iter().copied())
    };
    at.iter().flat_map(of).collect()
}

/// Returns the normalized inputs of ridge regression, `[at, inputs]`: the action, the encoder's vectors, and its frames
/// reduced to small gray images.
fn ridge_inputs(
    data: &NormalizedData,
    input: &[Modality],
    at: &[usize],
) -> Result<Vec<f32>, ExperimentError> {
    let learning =
        |error: candle_core::Error| ExperimentError::from(harness_learning::LearningError::from(error));
    let table = |tensor: Tensor| tensor.to_device(&candle_core::Device::Cpu)?.to_vec2::<f32>();
    let vectors =
        data.observation(at, input).map_err(learning)?.vector.map(table).transpose().map_err(learning)?;
    let actions = data.actions(at).and_then(table).map_err(learning)?;
    let layout = data.samples.layout();
    let size = |modality: &Modality| Some((*modality, layout[*modality].size()?));
    let frames: Vec<(Modality, [usize; 2])> = input.iter().filter_map(size).collect();
    let rows = at.par_iter().enumerate().map(|(row, &sample)| {
        let mut values = actions[row].clone();
        values.extend(vectors.iter().flat_map(|vectors| &vectors[row]));
        for (modality, size) in &frames {
            let mut frame = physical(&data.samples, *modality, &[sample]);
            data.normalizers.modalities[modality].normalize(&mut frame);
            values.extend(downsample_frame(&frame, *size)?);
        }
        Ok(values)
    });
    let rows: Vec<Vec<f32>> = rows.collect::<Result<_, MetricsError>>()?;
    Ok(rows.concat())
}
