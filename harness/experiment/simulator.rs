//! What the simulator itself predicts: an upper bound for any model that knows as much of the state.

use super::{ExperimentError, Source};
use harness_registry::dataset::{AnyDataset, Dataset};
use harness_samples::{Sample, Samples};
use harness_shared::progress::Progress;
use harness_simulation::{Knowledge, Scene, SimulatedOn, simulate_on};
use harness_spec::{Episode, Modality, RunSpec};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Why the simulator can't predict the samples of a task.
#[derive(Debug, thiserror::Error)]
pub enum SimulatorError {
    /// The samples were recorded.
    #[error("{0} was imported, and only a simulated dataset can be simulated again")]
    Imported(String),
    /// An output is not sensed in the simulation, but rendered or computed from samples.
    #[error(
        "the simulator predicts what it senses, and {modality} is an image or a change; ask for other outputs, for \
         example output=[contact_force]"
    )]
    Output {
        /// The output.
        modality: Modality,
    },
    /// The task asks for the present sample.
    #[error(
        "the simulator predicts from the present sample, which the task asks for; use a window.horizon of at least 1"
    )]
    Present,
    /// The simulation does not give the samples of the dataset.
    #[error(
        "episode {episode} of {dataset} is not what the simulation gives, so it can't be simulated on from there"
    )]
    Differs {
        /// The episode.
        episode: u32,
        /// Name of the dataset.
        dataset: String,
    },
}

/// Simulates the outputs of `spec` at each horizon, from the state at each of the present samples `windows`, rounded to
/// f32 and as far as it is `known`. Returns `[windows, width]` in physical units, which are means over the restarts.
/// Episodes are simulated in parallel.
///
/// # Errors
/// When the dataset is not simulated, an output is not sensed, or the simulation differs from the dataset.
pub(super) fn simulated(
    source: &Source,
    spec: &RunSpec,
    samples: &Samples,
    windows: &[Sample],
    known: &Knowledge,
    progress: &dyn Progress,
) -> Result<BTreeMap<(Modality, usize), Vec<f32>>, ExperimentError> {
    let tested = source.tested();
    let (AnyDataset::Simulated(dataset), Some(scene)) = (&tested, source.tested_scene()) else {
        return Err(SimulatorError::Imported(tested.name().to_owned()).into());
    };
    let is_sensed = |modality: &&Modality| {
        dataset.layout().stored_vectors().any(|definition| definition.name == **modality)
    };
    if let Some(&modality) = spec.output.iter().find(|modality| !is_sensed(modality)) {
        return Err(SimulatorError::Output { modality }.into());
    }
    let horizons = spec.window.horizons();
    if spec.window.horizon == 0 {
        return Err(SimulatorError::Present.into());
    }
    let of_episodes: Vec<&[Sample]> =
        windows.chunk_by(|a, b| samples.place(*a).0 == samples.place(*b).0).collect();
    progress.begin("simulating", of_episodes.len() as u64, "episodes");
    let simulated = of_episodes.par_iter().map(|windows| {
        if progress.cancelled() {
            return Err(ExperimentError::Cancelled);
        }
        let episodes = simulate_from(scene, dataset, samples, windows, &horizons, known)?;
        progress.advance(1);
        Ok(episodes)
    });
    let simulated: Vec<Vec<Episode>> = simulated.collect::<Result<_, ExperimentError>>()?;
    progress.end();
    let mut values = BTreeMap::<(Modality, usize), Vec<f32>>::new();
    for episodes in &simulated {
        for (episode, &horizon) in episodes.iter().zip(&horizons) {
            for &modality in &spec.output {
                let width = dataset.layout()[modality].width();
                let values = values.entry((modality, horizon)).or_default();
                let of_samples = episode.vector(modality).chunks_exact(width * known.restarts);
                of_samples.for_each(|restarts| values.extend(mean(restarts, width)));
            }
        }
    }
    Ok(values)
}

/// Simulates on from the samples `at`, which are in one episode. Returns what is simulated at each horizon.
fn simulate_from(
    scene: &Scene,
    dataset: &Dataset,
    samples: &Samples,
    at: &[Sample],
    horizons: &[usize],
    known: &Knowledge,
) -> Result<Vec<Episode>, ExperimentError> {
    let (place, _) = samples.place(at[0]);
    let within: Vec<usize> = at.iter().map(|sample| samples.place(*sample).1).collect();
    let SimulatedOn { present, ahead } =
        simulate_on(scene, dataset.spec(), place as u32, &within, horizons, known)?;
    let is_same = |modality: Modality| {
        let stored = at.iter().flat_map(|sample| samples.vector(modality, *sample));
        present.vector(modality).iter().eq(stored)
    };
    if !samples.layout().stored_vectors().all(|definition| is_same(definition.name)) {
        let (episode, dataset) = (place as u32, dataset.name().to_owned());
        return Err(SimulatorError::Differs { episode, dataset }.into());
    }
    Ok(ahead)
}

/// Returns the mean of rows of `width` values.
fn mean(rows: &[f32], width: usize) -> impl Iterator<Item = f32> {
    let restarts = (rows.len() / width) as f64;
    (0..width).map(move |column| {
        let sum: f64 = rows.iter().skip(column).step_by(width).map(|value| f64::from(*value)).sum();
        (sum / restarts) as f32
    })
}
