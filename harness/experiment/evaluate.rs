//! Judges the baselines of a run, and summarizes the forces of its dataset.

use super::OpenData;
use harness_judge::{
    Given, JudgeError, Judged, NearestNeighbors, Persistence, Predictor, Ridge, SampledWindow, Test,
    TrainingMean, judge, sample_windows,
};
use harness_learning::data::NormalizedData;
use harness_metrics::contact;
use harness_registry::ForceRows;
use harness_samples::{Partition, Samples};
use harness_spec::{Definition, RunSpec, Task};
use std::ops::Range;
use std::time::Instant;

/// What all runs with the same data, inputs and outputs share.
pub struct References {
    /// The metrics and the sums of the baselines.
    pub baselines: Judged,
    /// The forces of the dataset.
    pub forces: Vec<ForceRows>,
    /// The test windows whose images are stored.
    pub sampled: Vec<SampledWindow>,
    /// The time that computing them took, s.
    pub seconds: f64,
}

/// Computes what all runs with the data, inputs and outputs of `spec` share.
///
/// # Errors
/// When a value of the dataset is not finite.
pub fn references(open: &OpenData, spec: &RunSpec) -> Result<References, JudgeError> {
    let begin = Instant::now();
    let OpenData { data, partition, .. } = open;
    let mut judged = Judged::default();
    for task in &spec.tasks {
        baselines(data, partition, *task, spec, &mut judged)?;
    }
    let forces = forces(&data.samples);
    let sampled = sample_windows(&data.samples, &partition.test);
    Ok(References { baselines: judged, forces, sampled, seconds: begin.elapsed().as_secs_f64() })
}

/// Judges all baselines on the test windows: persistence, the training mean and, for vectors, ridge regression on the
/// network's input and the actions. Adds their rows.
///
/// A reconstruction of the input has only the training mean, because persistence would be its target. So it would be of
/// an estimate of the present sample. Its vectors, and those of probes, have the mean of the nearest neighbors instead.
///
/// # Errors
/// When a value of the dataset is not finite.
fn baselines(
    data: &NormalizedData,
    partition: &Partition,
    task: Task,
    spec: &RunSpec,
    judged: &mut Judged,
) -> Result<(), JudgeError> {
    let samples = &*data.samples;
    let test = Test { samples, task, windows: &partition.test, since_s: &spec.window.since_s, sampled: None };
    let mut add = |predictor: &dyn Predictor| {
        let Judged { metrics, sums, .. } = judge(predictor, &test)?;
        judged.metrics.extend(metrics);
        judged.sums.extend(sums);
        Ok::<_, JudgeError>(())
    };
    let reconstructed = spec.reconstructed();
    let (output, horizons) = match task {
        Task::Prediction => (&spec.output, spec.window.horizons()),
        Task::Reconstruction => (&reconstructed, vec![0]),
    };
    // Each modality has its own predictor, so that the means of few images are in memory.
    for modality in output.iter().copied() {
        for &horizon in &horizons {
            add(&TrainingMean::fit(samples, &partition.training, modality, horizon)?)?;
        }
        if task == Task::Prediction && spec.window.horizon > 0 {
            add(&Persistence { samples, modality, horizons: &horizons })?;
        }
    }
    let (sensed, normalizers) = (&**data.sensed(), &*data.normalizers);
    let given = Given { samples, sensed, normalizers, action: data.action, input: &spec.input };
    // What is reconstructed of the input would be its own regression. Probes are no part of it.
    let regressed = match task {
        Task::Prediction => output,
        Task::Reconstruction => &spec.probes,
    };
    for &horizon in &horizons {
        if let Some(ridge) = Ridge::fit(given, &partition.training, regressed, horizon)? {
            add(&ridge)?;
        }
    }
    if horizons == [0]
        && let Some(nearest) = NearestNeighbors::fit(given, &partition.training, regressed)?
    {
        add(&nearest)?;
    }
    Ok(())
}

/// Returns the distribution of the forces on each link, over the whole dataset and in each of its episodes.
fn forces(samples: &Samples) -> Vec<ForceRows> {
    let of = |definition: &Definition, episode, range: Range<usize>| {
        let (modality, width) = (definition.name, definition.width());
        let forces = &samples.vectors(modality)[range.start * width..range.end * width];
        ForceRows { modality, episode, links: contact::by_link(forces, width) }
    };
    let mut rows = Vec::new();
    for modality in samples.layout().stored_vectors().filter(|definition| definition.is_force()) {
        let own = samples.own_episodes();
        rows.push(of(modality, None, 0..own.last().map_or(0, |last| last.end)));
        let episodes = (0..).zip(own);
        rows.extend(episodes.map(|(episode, range)| of(modality, Some(episode), range.clone())));
    }
    rows
}
