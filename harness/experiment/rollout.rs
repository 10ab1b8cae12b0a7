//! What a run's network predicts along an episode, some samples ahead.

use super::model::{ModelError, applied, finished, load_network, normalizers};
use candle_core::Device;
use harness_judge::{BATCH, JudgeError, Predictor};
use harness_learning::LearningError;
use harness_learning::data::NormalizedData;
use harness_learning::network::Parameters;
use harness_learning::predict::TrainedNetwork;
use harness_learning::random::{Random, Stream};
use harness_registry::dataset::{AnyDataset, DatasetError};
use harness_registry::{Registry, RunRecord};
use harness_samples::{Sample, Samples};
use harness_shared::numbers::counted;
use harness_spec::{Division, Memory, Modality, Part, Task, Window};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Why there are no predictions along an episode.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError {
    /// The network can't be loaded.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The episode can't be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The network can't be applied.
    #[error(transparent)]
    Judge(#[from] JudgeError),
    /// The run has no dataset, or its network predicts no later sample. The text is the message.
    #[error("{0}")]
    Unsuitable(String),
    /// There is no such episode, or the horizon is too long for the episode or the network. The text is the message.
    #[error("{0}")]
    Asked(String),
}

/// An episode, and what a network predicts along it.
pub struct Rollout {
    /// The run's record.
    pub record: RunRecord,
    /// The episode of the dataset.
    pub episode: u32,
    /// Number of samples from the present to the predicted one.
    pub horizon: usize,
    /// The samples of the episode alone.
    pub samples: Arc<Samples>,
    /// The present samples, in their order.
    pub present: Vec<Sample>,
    /// The predicted values of each modality, `[present, width]`, in physical units; images channel by channel.
    pub predicted: BTreeMap<Modality, Vec<f32>>,
}

/// Predicts an episode with the network of the finished run whose id, or `experiment/id`, begins with `wanted`. Each
/// sample is predicted from those until `horizon` samples before it, and from the recorded actions after these.
///
/// # Arguments
/// * `episode`: the episode of the dataset that the run was tested on; `None` for the first one of the test, if the
///   data are split by episode, and the last one otherwise
/// * `horizon`: number of samples, which may be larger than in training; at least 1
///
/// # Errors
/// When there is no such run, network or episode, the episode is too short, or the network can't predict so far.
pub fn rollout(
    registry: &Registry,
    wanted: &str,
    episode: Option<u32>,
    horizon: usize,
) -> Result<Rollout, RolloutError> {
    let (folder, record, trained) = finished(registry, wanted)?;
    let spec = &record.spec;
    if spec.window.horizon == 0 {
        return Err(RolloutError::Unsuitable(format!(
            "the network of {} estimates the present sample (window.horizon: 0), so it predicts no later one",
            record.run
        )));
    }
    let lacks = |modality: &Modality| match spec.output.contains(modality) {
        false => Some(("lack", *modality)),
        true if record.layout[*modality].unit_vectors => Some(("have only the direction of", *modality)),
        true => None,
    };
    let lacking = spec.input.iter().find_map(lacks);
    if let Some((lack, input)) = lacking.filter(|_| horizon > 1 && trained.network.memory == Memory::None) {
        return Err(RolloutError::Asked(format!(
            "the network of {} has no memory, so it predicts further than one sample from its own predictions, and \
             these {lack} its input '{input}'; use --horizon 1, or a run with memory",
            record.run
        )));
    }
    let task = Task::Prediction;
    let mut parameters = Parameters::new();
    let mut random = Random::new(spec.seed, Stream::Parameters(task));
    let path = folder.checkpoint(task);
    let architecture = applied(&record, &trained, task).scaled(&normalizers(&path)?);
    let network = architecture.network(&mut parameters, &mut random, &Device::Cpu);
    let network = network.map_err(|error| ModelError::from(LearningError::from(error)))?;
    let normalizers = load_network(&path, &parameters)?;

    let path = registry.datasets().join(record.tested());
    if !path.is_dir() {
        return Err(RolloutError::Unsuitable(format!(
            "the dataset of {} is not there: {} is missing; run the experiment again to collect it",
            record.run,
            path.display()
        )));
    }
    let dataset = AnyDataset::at(&path)?;
    let simulation = spec.test_simulation().or_else(|| spec.simulation.clone());
    let episodes = simulation.map_or(dataset.episodes(), |simulation| simulation.episodes);
    let parts = match &dataset {
        AnyDataset::Imported(dataset) => dataset.parts(&spec.split).ok(),
        AnyDataset::Simulated(_) => None,
    };
    let tested = parts.and_then(|parts| parts.iter().position(|part| *part == Part::Test));
    let usual = match (&spec.test, spec.split.by, tested) {
        (Some(_), ..) => 0,
        (None, Division::Episode | Division::Label(_), Some(tested)) => tested as u32,
        (None, Division::Episode, None) => {
            let tested = spec.split.counts(episodes as usize, false);
            episodes.saturating_sub(tested.map_or(1, |counts| counts.test as u32))
        }
        (None, ..) => episodes.saturating_sub(1),
    };
    let episode = episode.unwrap_or(usual);
    if episode >= episodes {
        let there = counted(episodes as usize, "episode");
        return Err(RolloutError::Asked(format!(
            "there is no episode {episode}: the dataset of {} has {there}",
            record.run
        )));
    }
    let samples = Arc::new(dataset.load_episode(episode)?);
    let data = NormalizedData::new(samples, Arc::new(normalizers), spec.action, Device::Cpu);
    let window = Window { horizon, ..spec.window.clone() };
    let present = data.samples.windows(&window.judged());
    if present.is_empty() {
        return Err(RolloutError::Asked(format!(
            "episode {episode} has {}, too few for a context of {} and a horizon of {}",
            counted(data.samples.len(), "sample"),
            window.context,
            window.horizon
        )));
    }
    let (network, input, output) = (network.detached(), &spec.input[..], &spec.output[..]);
    let trained = TrainedNetwork { data: &data, network, input, output, window: &window, draws: 0, seed: 0 };
    let mut predicted: BTreeMap<Modality, Vec<f32>> = BTreeMap::new();
    for at in present.chunks(BATCH) {
        trained.predict(at, &mut |found| {
            if found.horizon == horizon {
                predicted.entry(found.modality).or_default().extend(&found.values);
            }
            Ok(())
        })?;
    }
    let samples = data.samples.clone();
    Ok(Rollout { record, episode, horizon, samples, present, predicted })
}
