//! Judges the baselines of a run, and summarizes the forces of its dataset.

use harness_judge::{Given, JudgeError, MetricRow, Persistence, Predictor, Ridge, Test, TrainingMean, judge};
use harness_learning::data::NormalizedData;
use harness_metrics::contact;
use harness_registry::ForceRows;
use harness_samples::{Partition, Samples};
use harness_spec::{Definition, RunSpec, Task};
use std::ops::Range;

/// Judges all baselines on the test windows: persistence, the training mean and, for vectors, ridge regression on the
/// network's input and the actions.
///
/// A reconstruction has only the training mean, because persistence would be its target.
///
/// # Errors
/// When a value of the dataset is not finite.
pub fn baselines(
    data: &NormalizedData,
    partition: &Partition,
    task: Task,
    spec: &RunSpec,
) -> Result<Vec<MetricRow>, JudgeError> {
    let samples = &*data.samples;
    let test = Test { samples, task, windows: &partition.test, sampled: None };
    let mut rows = Vec::new();
    let mut add = |predictor: &dyn Predictor| {
        rows.extend(judge(predictor, &test)?.metrics);
        Ok::<_, JudgeError>(())
    };
    let (output, horizons) = match task {
        Task::Prediction => (&spec.output, spec.window.horizons()),
        Task::Reconstruction => (&spec.input, vec![0]),
    };
    // Each modality has its own predictor, so that the means of few images are in memory.
    for modality in output.iter().copied() {
        for &horizon in &horizons {
            add(&TrainingMean::fit(samples, &partition.training, modality, horizon)?)?;
        }
        if task == Task::Prediction {
            add(&Persistence { samples, modality, horizons: &horizons })?;
        }
    }
    if task == Task::Prediction {
        let given =
            Given { samples, normalizers: &data.normalizers, action: data.action, input: &spec.input };
        for &horizon in &horizons {
            if let Some(ridge) = Ridge::fit(given, &partition.training, output, horizon)? {
                add(&ridge)?;
            }
        }
    }
    Ok(rows)
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
