//! A trained network at work on observations from anywhere, in physical units.

use candle_core::{Device, Tensor};
use harness_learning::Normalizers;
use harness_learning::frames::{DenseFrames, Frames};
use harness_learning::network::{Decoder, Encoder, Observation, Parameters, architecture};
use harness_learning::random::{Random, Stream};
use harness_learning::{LearningError, checkpoint, predict};
use harness_registry::{Registry, RegistryError, RunFolder, RunRecord, Status};
use harness_spec::{IMAGE_CHANNELS, Modality, Task};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A batch by modality, `[batch, width]` in physical units; frames channel by channel, those of `vision` in [0, 1].
pub type Values = BTreeMap<Modality, Vec<f32>>;

/// Why a trained network can't be used as asked.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    #[error(transparent)]
    Registry(#[from] RegistryError),
    #[error(transparent)]
    Learning(#[from] LearningError),
    #[error("{run} is {}, not done; the command that made it goes on with it", status.name())]
    Unfinished { run: String, status: Status },
    #[error("there is no network at {}; published results leave networks out, so do the run again", .0.display())]
    NoNetwork(PathBuf),
    #[error("{run} trained no reconstruction; its spec's tasks are {}", .tasks.iter().map(|task| task.name()).collect::<Vec<_>>().join(", "))]
    NoReconstruction { run: String, tasks: Vec<Task> },
    #[error("the observation lacks '{modality}'; the encoder of {run} is given {}", names(given))]
    Lacks { run: String, modality: Modality, given: Vec<Modality> },
    #[error("'{name}' has {found} values for a batch of {batch}, which must be {batch} times {width}")]
    Shape { name: &'static str, batch: usize, width: usize, found: usize },
}

fn names(modalities: &[Modality]) -> String {
    modalities.iter().map(|modality| modality.name()).collect::<Vec<_>>().join(", ")
}

/// A finished run's encoder, the decoder that predicts the next observation, and the one that reconstructs the present.
pub struct Model {
    record: RunRecord,
    normalizers: Normalizers,
    encoder: Box<dyn Encoder>,
    decoder: Box<dyn Decoder>,
    /// `None` where the run trained none.
    reconstruction: Option<Box<dyn Decoder>>,
}

impl Model {
    /// Loads the one run whose id, or `experiment/id`, begins with `wanted`; it works on the CPU.
    ///
    /// # Errors
    /// When there is no such run or several, it isn't done, or its network is not there or damaged.
    pub fn load(registry: &Registry, wanted: &str) -> Result<Self, ModelError> {
        let (folder, record) = registry.find(wanted)?;
        if record.status != Status::Done {
            return Err(ModelError::Unfinished { run: record.run, status: record.status });
        }
        let task = Task::Prediction;
        let architecture = architecture(&record.spec, &record.layout, task);
        let mut parameters = Parameters::new();
        let mut random = Random::new(record.spec.seed, Stream::Parameters(task));
        let encoder = architecture.encoder(&mut parameters, &mut random, &Device::Cpu);
        let encoder = encoder.map_err(LearningError::from)?.detached();
        let decoder = architecture.decoder(&mut parameters, &mut random, &Device::Cpu);
        let decoder = decoder.map_err(LearningError::from)?.detached();
        let normalizers = load_network(&folder.checkpoint(task), &parameters)?;
        let reconstructs = record.spec.tasks.contains(&Task::Reconstruction);
        let reconstruction = reconstructs.then(|| load_reconstruction(&folder, &record)).transpose()?;
        Ok(Self { record, normalizers, encoder, decoder, reconstruction })
    }

    /// The run's record, with its spec.
    pub fn record(&self) -> &RunRecord {
        &self.record
    }

    /// Mean and log-variance of the posterior for `batch` observations, `[batch, latent]` each. What the encoder is not
    /// given is ignored.
    ///
    /// # Errors
    /// When a modality that the encoder is given lacks, or has another number of values.
    pub fn encode(&self, batch: usize, observation: &Values) -> Result<(Vec<f32>, Vec<f32>), ModelError> {
        let observation = self.observation(batch, observation)?;
        let posterior = || -> candle_core::Result<_> {
            let posterior = self.encoder.encode(&observation)?;
            let values = |tensor: Tensor| tensor.flatten_all()?.to_vec1();
            Ok((values(posterior.mean()?)?, values(posterior.log_variance()?)?))
        };
        Ok(posterior().map_err(LearningError::from)?)
    }

    /// The next observations, from the posterior's mean and `action` `[batch, elements]` in the form and units that the run's
    /// spec says.
    ///
    /// # Errors
    /// As [`Model::encode`].
    pub fn predict(
        &self,
        batch: usize,
        observation: &Values,
        mut action: Vec<f32>,
    ) -> Result<Values, ModelError> {
        let elements = self.record.layout.action().len();
        check("action", batch, elements, &action)?;
        let observation = self.observation(batch, observation)?;
        self.normalizers.action.normalize(&mut action);
        let predicted = || -> candle_core::Result<_> {
            let latent = self.encoder.encode(&observation)?.mean()?;
            let action = Tensor::from_vec(action, (batch, elements), &Device::Cpu)?;
            let decoded = self.decoder.decode(&latent, Some(&action))?;
            predict::denormalized(&self.normalizers, &self.record.layout, &self.record.spec.output, decoded)
        };
        Ok(predicted().map_err(LearningError::from)?.into_iter().collect())
    }

    /// The observations that latent states `[batch, latent]` hold, by the encoder's own modalities.
    ///
    /// # Errors
    /// When the run trained no reconstruction, or `latent` has another number of values.
    pub fn reconstruct(&self, batch: usize, latent: Vec<f32>) -> Result<Values, ModelError> {
        let spec = &self.record.spec;
        let Some(decoder) = &self.reconstruction else {
            return Err(ModelError::NoReconstruction {
                run: self.record.run.clone(),
                tasks: spec.tasks.clone(),
            });
        };
        check("latent", batch, spec.latent, &latent)?;
        let reconstructed = || -> candle_core::Result<_> {
            let latent = Tensor::from_vec(latent, (batch, spec.latent), &Device::Cpu)?;
            let decoded = decoder.decode(&latent, None)?;
            predict::denormalized(&self.normalizers, &self.record.layout, &spec.input, decoded)
        };
        Ok(reconstructed().map_err(LearningError::from)?.into_iter().collect())
    }

    /// What the encoder is given, normalized and side by side.
    fn observation(&self, batch: usize, values: &Values) -> Result<Observation, ModelError> {
        let input = &self.record.spec.input;
        let mut vectors = Vec::new();
        let mut frames = Vec::new();
        let mut side = 0;
        for &modality in input {
            let values = values.get(&modality).ok_or_else(|| ModelError::Lacks {
                run: self.record.run.clone(),
                modality,
                given: input.clone(),
            })?;
            let definition = &self.record.layout[modality];
            check(modality.name(), batch, definition.width(), values)?;
            let mut values = values.clone();
            self.normalizers.modalities[&modality].normalize(&mut values);
            let list = if definition.is_image() { &mut frames } else { &mut vectors };
            list.push((definition.width(), values));
            side = definition.size().map_or(side, |[side, _]| side);
        }
        let joined = || -> candle_core::Result<_> {
            let vector = side_by_side(batch, &vectors)?;
            let frames = side_by_side(batch, &frames)?.map(|frames| {
                let channels =
                    IMAGE_CHANNELS * input.iter().filter(|m| self.record.layout[**m].is_image()).count();
                DenseFrames::new(&frames.reshape((batch, channels, side, side))?)
            });
            let frames = frames.transpose()?.map(|frames| Arc::new(frames) as Arc<dyn Frames>);
            Ok(Observation { vector, frames })
        };
        Ok(joined().map_err(LearningError::from)?)
    }
}

/// Loads the parameters of a network that must be there, and returns the scales saved with them.
fn load_network(path: &Path, parameters: &Parameters) -> Result<Normalizers, ModelError> {
    if !path.exists() {
        return Err(ModelError::NoNetwork(path.to_owned()));
    }
    Ok(checkpoint::load(path, parameters)?)
}

fn load_reconstruction(folder: &RunFolder, record: &RunRecord) -> Result<Box<dyn Decoder>, ModelError> {
    let task = Task::Reconstruction;
    let mut parameters = Parameters::new();
    let mut random = Random::new(record.spec.seed, Stream::Parameters(task));
    let decoder =
        architecture(&record.spec, &record.layout, task).decoder(&mut parameters, &mut random, &Device::Cpu);
    let decoder = decoder.map_err(LearningError::from)?.detached();
    load_network(&folder.checkpoint(task), &parameters)?;
    Ok(decoder)
}

/// Whether `values` are those of a batch.
fn check(name: &'static str, batch: usize, width: usize, values: &[f32]) -> Result<(), ModelError> {
    if values.len() == batch * width {
        return Ok(());
    }
    Err(ModelError::Shape { name, batch, width, found: values.len() })
}

/// Several `[batch, width]` as one, `[batch, all widths]`; `None` of none.
fn side_by_side(batch: usize, parts: &[(usize, Vec<f32>)]) -> candle_core::Result<Option<Tensor>> {
    if parts.is_empty() {
        return Ok(None);
    }
    let parts = parts.iter().map(|(width, values)| Tensor::from_slice(values, (batch, *width), &Device::Cpu));
    Tensor::cat(&parts.collect::<candle_core::Result<Vec<_>>>()?, 1).map(Some)
}
