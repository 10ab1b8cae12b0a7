//! The test windows whose images are stored, and the rows of their images.

use super::{BATCH, FrameRow, Predicted, Test};
use harness_samples::{Sample, Samples, frame_difference};
use harness_spec::{Definition, IMAGE_CHANNELS};
use rayon::prelude::*;

/// Quantiles of the test windows' motion at which the stored windows are chosen.
const MOTION_QUANTILES: [f64; 5] = [0.02, 0.3, 0.6, 0.85, 0.98];

/// A test window whose images are stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SampledWindow {
    /// The present sample.
    pub present: Sample,
    /// Mean absolute change of the first camera's image from this sample to the next, in [0, 1]. At the end of an
    /// episode, which is only estimated, it is that from the sample before.
    pub motion: f64,
}

/// Returns the test windows whose images are stored, from the least to the most motion; none without images of a
/// camera. The motion is that in the first camera's image.
///
/// The choice depends only on the dataset, so the images of all networks can be compared.
pub fn sample_windows(samples: &Samples, test: &[Sample]) -> Vec<SampledWindow> {
    let Some(camera) = samples.layout().camera_images().next().map(|image| image.name) else {
        return Vec::new();
    };
    if !samples.has_frames() || test.is_empty() {
        return Vec::new();
    }
    let motion = |present: Sample| {
        let (sum, values) = frame_difference(samples, camera, samples.next(present))
            .fold((0.0, 0), |(sum, values), change| (sum + f64::from(change.abs()), values + 1));
        SampledWindow { present, motion: sum / f64::from(values) }
    };
    let batches = test.par_chunks(BATCH).flat_map_iter(|at| {
        samples.prefetch(camera, at);
        at.iter().map(|&present| motion(present))
    });
    let mut windows: Vec<SampledWindow> = batches.collect();
    windows.sort_by(|a, b| a.motion.total_cmp(&b.motion).then(a.present.cmp(&b.present)));
    MOTION_QUANTILES.map(|share| windows[(share * (windows.len() - 1) as f64).round() as usize]).to_vec()
}

/// Returns the rows of the `sampled` windows' images that are in a batch of windows; none for a vector.
pub(super) fn rows(
    test: &Test,
    sampled: &[SampledWindow],
    at: &[Sample],
    reference: &[f32],
    predicted: &Predicted,
) -> Vec<FrameRow> {
    let definition = &test.samples.layout()[predicted.modality];
    if !definition.is_image() {
        return Vec::new();
    }
    let width = definition.width();
    let row = |sampled: &SampledWindow| {
        let row = at.iter().position(|present| *present == sampled.present)?;
        let (episode, sample) = test.samples.place(sampled.present.after(predicted.horizon));
        let picture = |values: &[f32]| picture(definition, &values[row * width..][..width]);
        Some(FrameRow {
            task: test.task,
            modality: predicted.modality,
            episode: episode as u32,
            sample: sample as u32,
            motion: sampled.motion,
            reference: picture(reference),
            predicted: picture(&predicted.values),
        })
    };
    sampled.iter().filter_map(row).collect()
}

/// Converts a frame `[channel, row, column]` of an image to bytes `[row, column, channel]`. An intensity in [0, 1] is
/// multiplied by 255. A difference in [-1, 1] is multiplied by 127 and added to 128, so that no change is represented
/// exactly.
pub fn picture(definition: &Definition, values: &[f32]) -> Vec<u8> {
    let byte = |value: f32| match definition.difference_of {
        Some(_) => (128.0 + 127.0 * value).round().clamp(1.0, 255.0) as u8,
        None => (255.0 * value).round().clamp(0.0, 255.0) as u8,
    };
    let pixels = values.len() / IMAGE_CHANNELS;
    (0..pixels)
        .flat_map(|pixel| (0..IMAGE_CHANNELS).map(move |channel| byte(values[channel * pixels + pixel])))
        .collect()
}
