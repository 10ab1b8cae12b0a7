//! A trained network, applied to observations from any source, in physical units.

use candle_core::{Device, Tensor};
use harness_learning::network::{
    Architecture, Decoder, Encoder, Observation, Parameters, Value, architecture,
};
use harness_learning::random::{Random, Stream};
use harness_learning::{LearningError, checkpoint, predict};
use harness_ops::arithmetic;
use harness_ops::frames::DenseFrames;
use harness_registry::{Registry, RegistryError, RunFolder, RunRecord, Status};
use harness_samples::Normalizers;
use harness_spec::{IMAGE_CHANNELS, Memory, Modality, Precision, Task, Trained};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The values of a batch by modality, `[batch, width]` in physical units. Frames are stored channel by channel, and
/// those of `vision` are in [0, 1].
pub type Values = BTreeMap<Modality, Vec<f32>>;

/// Why a trained network can't be used.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The run can't be found, or its record can't be read.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// The network can't be loaded or applied.
    #[error(transparent)]
    Learning(LearningError),
    /// The run is not done, its network has a memory, or no file of a model of another program was attached to it. The
    /// text is the message.
    #[error("{0}")]
    NotLoaded(String),
    /// The run's model is one of another program.
    #[error("the predictions of {0} come from another program, so the harness has no network of it")]
    External(String),
    /// The run has no checkpoint at this path.
    #[error("there is no network at {}; published results have none unless they were published with --networks; to \
         train it, run its experiment again", .0.display())]
    NoNetwork(PathBuf),
    /// The run has no network for reconstruction.
    #[error(
        "{run} trained no reconstruction; its spec's tasks are {}",
        .tasks.iter().map(|task| task.name()).collect::<Vec<_>>().join(", ")
    )]
    NoReconstruction {
        /// Id of the run.
        run: String,
        /// The tasks that it trained.
        tasks: Vec<Task>,
    },
    /// An observation lacks a modality of the encoder's input. The text is the message.
    #[error("{0}")]
    Lacks(String),
    /// A modality, an action or a latent state has the wrong number of values. The text is the message.
    #[error("{0}")]
    Shape(String),
}

fn names(modalities: &[Modality]) -> String {
    modalities.iter().map(|modality| modality.name()).collect::<Vec<_>>().join(", ")
}

/// A finished run's encoder, the decoder that predicts the next observation, and the decoder that reconstructs the
/// present one.
pub struct Model {
    record: RunRecord,
    latent: usize,
    normalizers: Normalizers,
    encoder: Box<dyn Encoder>,
    decoder: Box<dyn Decoder>,
    /// `None` if the run trained no reconstruction.
    reconstruction: Option<Box<dyn Decoder>>,
}

impl Model {
    /// Loads the run whose id, or `experiment/id`, begins with `wanted`. The network runs on the CPU.
    ///
    /// # Errors
    /// When no run or several runs match, the run isn't done, or its network is missing or damaged.
    pub fn load(registry: &Registry, wanted: &str) -> Result<Self, ModelError> {
        let (folder, record, trained) = finished(registry, wanted)?;
        if trained.network.memory != Memory::None {
            return Err(ModelError::NotLoaded(format!(
                "the network of {} has a memory, so it can't be applied to single observations; use \
                 harness.load_network, or export it as an ONNX model",
                record.run
            )));
        }
        let task = Task::Prediction;
        let architecture = applied(&record, &trained, task).scaled(&normalizers(&folder.checkpoint(task))?);
        let mut parameters = Parameters::new();
        let mut random = Random::new(record.spec.seed, Stream::Parameters(task));
        let encoder = architecture.encoder(&mut parameters, &mut random, &Device::Cpu);
        let encoder = encoder.map_err(LearningError::from)?.detached();
        let decoder = architecture.decoder(&mut parameters, &mut random, &Device::Cpu);
        let decoder = decoder.map_err(LearningError::from)?.detached();
        let normalizers = load_network(&folder.checkpoint(task), &parameters)?;
        let reconstructs = record.spec.tasks.contains(&Task::Reconstruction);
        let reconstruction =
            reconstructs.then(|| load_reconstruction(&folder, &record, &trained)).transpose()?;
        Ok(Self { record, latent: trained.latent, normalizers, encoder, decoder, reconstruction })
    }

    /// Returns the size of the latent state.
    pub fn latent(&self) -> usize {
        self.latent
    }

    /// Returns the run's record, which includes its spec.
    pub fn record(&self) -> &RunRecord {
        &self.record
    }

    /// Returns the number of elements of the action that the network takes; 0 if it takes none.
    pub fn action_width(&self) -> usize {
        self.record.spec.action_width(&self.record.layout)
    }

    /// Returns the mean and the log-variance of the posterior for `batch` observations, `[batch, latent]` each.
    /// Modalities that the encoder does not use are ignored.
    ///
    /// # Errors
    /// When a modality of the encoder's input is missing, or has the wrong number of values.
    pub fn encode(&self, batch: usize, observation: &Values) -> Result<(Vec<f32>, Vec<f32>), ModelError> {
        let observation = self.observation(batch, observation)?;
        let posterior = || -> candle_core::Result<_> {
            let posterior = self.encoder.encode(&observation)?;
            let values = |tensor: Tensor| tensor.flatten_all()?.to_vec1();
            Ok((values(posterior.mean()?)?, values(posterior.log_variance()?)?))
        };
        Ok(posterior().map_err(LearningError::from)?)
    }

    /// Predicts the next observations from the posterior's mean and `action` `[batch, elements]`, in the form and the
    /// units that the run's spec defines. Without a setpoint, the action has no elements.
    ///
    /// # Errors
    /// Those of [`Model::encode`], and when `action` has the wrong number of values.
    pub fn predict(
        &self,
        batch: usize,
        observation: &Values,
        mut action: Vec<f32>,
    ) -> Result<Values, ModelError> {
        let elements = self.action_width();
        check("action", batch, elements, &action)?;
        let present = |modality: Modality| observation[&modality].clone();
        let observation = self.observation(batch, observation)?;
        self.normalizers.action.normalize(&mut action);
        let predicted = || -> candle_core::Result<_> {
            let latent = self.encoder.encode(&observation)?.mean()?;
            let action = Tensor::from_vec(action, (batch, elements), &Device::Cpu)?;
            let decoded = self.decoder.decode(&latent, Some(&action))?;
            predict::predicted(&self.normalizers, &self.record.spec.output, &decoded, present)
        };
        Ok(predicted().map_err(LearningError::from)?.into_iter().collect())
    }

    /// Decodes the observations in latent states `[batch, latent]`, with the modalities of the encoder's input.
    ///
    /// # Errors
    /// When the run trained no reconstruction, or `latent` has the wrong number of values.
    pub fn reconstruct(&self, batch: usize, latent: Vec<f32>) -> Result<Values, ModelError> {
        let spec = &self.record.spec;
        let Some(decoder) = &self.reconstruction else {
            return Err(ModelError::NoReconstruction {
                run: self.record.run.clone(),
                tasks: spec.tasks.clone(),
            });
        };
        check("latent", batch, self.latent, &latent)?;
        let reconstructed = || -> candle_core::Result<_> {
            let latent = Tensor::from_vec(latent, (batch, self.latent), &Device::Cpu)?;
            let decoded = decoder.decode(&latent, None)?;
            predict::denormalized(&self.normalizers, &spec.reconstructed(), &decoded)
        };
        Ok(reconstructed().map_err(LearningError::from)?.into_iter().collect())
    }

    /// Returns the encoder's input, normalized.
    fn observation(&self, batch: usize, values: &Values) -> Result<Observation, ModelError> {
        let input = &self.record.spec.input;
        let normalized = |&modality: &Modality| {
            let values = values.get(&modality).ok_or_else(|| {
                let (run, needed) = (&self.record.run, names(input));
                ModelError::Lacks(format!(
                    "the observation lacks '{modality}'; the encoder of {run} needs {needed}"
                ))
            })?;
            let definition = &self.record.layout[modality];
            check(modality.name(), batch, definition.width(), values)?;
            let (mut values, scale) = (values.clone(), &self.normalizers.modalities[&modality]);
            let value = match definition.size() {
                Some(size) => {
                    scale.normalize_images(&mut values);
                    Value::Frames(Arc::new(DenseFrames::from_values(values, IMAGE_CHANNELS, size)))
                }
                None => {
                    scale.normalize(&mut values);
                    let vector = Tensor::from_vec(values, (batch, definition.width()), &Device::Cpu);
                    Value::Vector(vector.map_err(LearningError::from)?)
                }
            };
            Ok((modality, value))
        };
        input.iter().map(normalized).collect()
    }
}

/// Returns the finished run whose id, or `experiment/id`, begins with `wanted`, and the network that it trained.
pub(crate) fn finished(
    registry: &Registry,
    wanted: &str,
) -> Result<(RunFolder, RunRecord, Trained), ModelError> {
    let (folder, record) = registry.find(wanted)?;
    match (record.status, record.spec.trained().cloned()) {
        (Status::Done, Some(trained)) => Ok((folder, record, trained)),
        (Status::Done, None) => Err(ModelError::External(record.run)),
        (status, _) => Err(ModelError::NotLoaded(format!(
            "{} is {}, not done; repeat the command that started it, to continue",
            record.run,
            status.name()
        ))),
    }
}

/// Returns the network that a run trained for `task`. It computes in f32, whatever the precision of the training.
pub(crate) fn applied(record: &RunRecord, trained: &Trained, task: Task) -> Architecture {
    Architecture {
        arithmetic: arithmetic(trained.training.tiles, Precision::F32),
        ..architecture(&record.spec, trained, &record.layout, task)
    }
}

impl From<LearningError> for ModelError {
    /// Turns a damaged file into an error of the registry, which names the command that says how to repair it.
    fn from(error: LearningError) -> Self {
        match error {
            LearningError::Damaged { path, reason } => RegistryError::File { path, reason }.into(),
            other => Self::Learning(other),
        }
    }
}

/// Loads the parameters of a network and returns its normalizers. Fails if there is no file at `path`.
pub(crate) fn load_network(path: &Path, parameters: &Parameters) -> Result<Normalizers, ModelError> {
    Ok(checkpoint::load(there(path)?, parameters)?)
}

/// Returns the normalizers of a network. Fails if there is no file at `path`.
pub(crate) fn normalizers(path: &Path) -> Result<Normalizers, ModelError> {
    Ok(checkpoint::open(there(path)?)?.1)
}

/// Refuses the path of a network of which there is no file.
pub(crate) fn there(path: &Path) -> Result<&Path, ModelError> {
    if path.exists() { Ok(path) } else { Err(ModelError::NoNetwork(path.to_owned())) }
}

fn load_reconstruction(
    folder: &RunFolder,
    record: &RunRecord,
    trained: &Trained,
) -> Result<Box<dyn Decoder>, ModelError> {
    let task = Task::Reconstruction;
    let mut parameters = Parameters::new();
    let mut random = Random::new(record.spec.seed, Stream::Parameters(task));
    let decoder = applied(record, trained, task).decoder(&mut parameters, &mut random, &Device::Cpu);
    let decoder = decoder.map_err(LearningError::from)?.detached();
    load_network(&folder.checkpoint(task), &parameters)?;
    Ok(decoder)
}

/// Returns an error unless `values` has `batch` times `width` values.
fn check(name: &'static str, batch: usize, width: usize, values: &[f32]) -> Result<(), ModelError> {
    if values.len() == batch * width {
        return Ok(());
    }
    let found = values.len();
    Err(ModelError::Shape(format!(
        "'{name}' has {found} values for a batch of {batch}, which must be {batch} times {width}"
    )))
}
