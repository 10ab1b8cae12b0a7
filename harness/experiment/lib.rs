//! What running an experiment does: spec, episodes, dataset, training, metrics, record.

mod evaluate;
mod model;
mod schedule;

pub use model::{Model, ModelError, Values};
pub use schedule::Summary;

use evaluate::{Evaluated, SampledTransition};
use harness_collection::{CollectionError, collect, collect_share, dataset_of};
use harness_dataset::{Dataset, DatasetError, FramePlace, Imported, Partition, Samples, frame_bytes};
use harness_learning::network::{Encoder, Parameters, architecture};
use harness_learning::objective::{NormalizedData, Prediction, Reconstruction};
use harness_learning::random::{Random, Stream};
use harness_learning::state::StateFile;
use harness_learning::training::{Epoch, Fit};
use harness_learning::{self as learning, LearningError, Normalizers, checkpoint, open_device, predict};
use harness_metrics::MetricsError;
use harness_registry::{
    Decision, ForceRows, MetricRow, Outcome, Provenance, Registry, RegistryError, RunFolder, RunRecord,
    Timings, Versions,
};
use harness_shared::files::free_bytes;
use harness_shared::memory;
use harness_shared::progress::Progress;
use harness_shared::shard::Shard;
use harness_simulation::{Scene, SimulationError, mujoco_version};
use harness_spec::{Experiment, Layout, Origin, RunSpec, Simulation, Task, World};
use rayon::prelude::*;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

/// Why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    #[error(transparent)]
    Collection(#[from] CollectionError),
    #[error(transparent)]
    Learning(#[from] LearningError),
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    #[error(transparent)]
    Registry(#[from] RegistryError),
    #[error("{problem} (dataset {dataset})")]
    Unsuitable { dataset: String, problem: String },
    #[error(
        "the split leaves nothing for training; give the experiment more or longer episodes, or the split smaller \
         shares or, by time, a smaller gap_seconds"
    )]
    NoTraining,
    #[error(
        "the dataset {dataset} takes {:.1} GB of memory and only {:.1} GB are free; free some, or lower \
         simulation.episodes or simulation.actuations_per_episode",
        *needed as f64 / 1e9, *available as f64 / 1e9
    )]
    Memory { dataset: String, needed: u64, available: u64 },
    #[error(
        "the frames of the dataset {dataset} take {:.1} GB of disk while it is used, and only {:.1} GB are free in {}; \
         make room, or lower simulation.episodes or simulation.actuations_per_episode",
        *needed as f64 / 1e9, *available as f64 / 1e9, folder.display()
    )]
    Disk { dataset: String, needed: u64, available: u64, folder: PathBuf },
    #[error(
        "the network takes up to {:.1} GB of memory to train and only {:.1} GB are free; free some, or lower \
         network.hidden, network.channels or training.batch_size",
        *needed as f64 / 1e9, *available as f64 / 1e9
    )]
    NetworkMemory { needed: u64, available: u64 },
    /// What all runs of a scenario need could not be made; the first of them tried.
    #[error("{0}")]
    Preparation(String),
    #[error("no threads can be started: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    #[error("the experiment was cancelled; the same command goes on from here")]
    Cancelled,
}

/// What an experiment needs besides its spec.
pub struct Runner<'a> {
    pub registry: &'a Registry,
    /// Threads for collection, and for all trainings together.
    pub threads: usize,
    /// Runs that are trained side by side, each with its share of the threads; 1 trains them in the caller's pool.
    pub jobs: usize,
    /// Of datasets that lack episodes, this process makes its share before it waits for the others.
    pub shard: Option<Shard>,
    /// Whether runs that other processes work on are waited for.
    pub waits: bool,
    /// Whether the first run that fails ends the work.
    pub fails_fast: bool,
    /// Frames that take more memory than this, bytes, are kept on disk; `None` is an eighth of what is within reach.
    pub memory: Option<u64>,
    pub provenance: &'a Provenance,
    pub progress: &'a dyn Progress,
}

/// One run of an experiment's plan.
pub struct Planned {
    pub spec: RunSpec,
    pub folder: RunFolder,
    pub decision: Decision,
    /// How far the run was when it was planned.
    record: Option<RunRecord>,
    source: Arc<Source>,
}

/// Where a scenario's samples come from.
enum Source {
    Simulated { scene: Box<Scene>, dataset: Dataset },
    Imported(Imported),
}

impl Source {
    /// The dataset's name.
    fn name(&self) -> &str {
        match self {
            Self::Simulated { dataset, .. } => dataset.name(),
            Self::Imported(dataset) => dataset.name(),
        }
    }

    /// Samples of the whole dataset.
    fn len(&self) -> usize {
        match self {
            Self::Simulated { dataset, .. } => dataset.len(),
            Self::Imported(dataset) => dataset.len(),
        }
    }

    /// A world whose files have changed since it was read.
    fn changed_world(&self) -> Option<&World> {
        match self {
            Self::Simulated { scene, .. } if scene.has_changed() => Some(scene.world()),
            _ => None,
        }
    }

    /// What its samples hold.
    fn layout(&self) -> &Arc<Layout> {
        match self {
            Self::Simulated { dataset, .. } => dataset.layout(),
            Self::Imported(dataset) => dataset.layout(),
        }
    }
}

impl Planned {
    /// What the samples of its dataset hold.
    pub fn layout(&self) -> &Arc<Layout> {
        self.source.layout()
    }

    /// Whether two runs learn from the same data in the same form on the same device.
    fn shares_data(&self, other: &Planned) -> bool {
        fn key(planned: &Planned) -> impl PartialEq {
            let spec = &planned.spec;
            let data = (&spec.scenario, &spec.simulation, &spec.split);
            let form = (&spec.input, &spec.output, &spec.tasks, spec.action, &spec.scaling);
            (data, form, spec.training.device)
        }
        key(self) == key(other)
    }
}

impl<'a> Runner<'a> {
    /// A runner that trains one run at a time, waits for other processes, and goes on after a run that fails.
    pub fn new(
        registry: &'a Registry,
        threads: usize,
        provenance: &'a Provenance,
        progress: &'a dyn Progress,
    ) -> Self {
        Self {
            registry,
            threads,
            jobs: 1,
            shard: None,
            waits: true,
            fails_fast: false,
            memory: None,
            provenance,
            progress,
        }
    }

    /// Each run of the experiment with what will happen to it, and why.
    pub fn plan(&self, experiment: &Experiment) -> Result<Vec<Planned>, ExperimentError> {
        open_device(experiment.training.device)?;
        let mut sources: Vec<(Origin, Option<Simulation>, Arc<Source>)> = Vec::new();
        let mut wanted = Vec::new();
        for spec in experiment.runs() {
            let known = sources
                .iter()
                .find(|(origin, simulation, _)| (origin, simulation) == (&spec.scenario, &spec.simulation));
            let source = match known {
                Some((.., source)) => source.clone(),
                None => {
                    let source = Arc::new(self.source(experiment, &spec)?);
                    sources.push((spec.scenario.clone(), spec.simulation.clone(), source.clone()));
                    source
                }
            };
            wanted.push((self.registry.run(&experiment.name, &spec, source.name()), spec, source));
        }
        let known = self.registry.known(&experiment.name);
        let decide = |(folder, spec, _): &(RunFolder, RunSpec, _)| self.registry.decide(folder, spec, &known);
        let decided: Vec<_> = wanted.par_iter().map(decide).collect();
        let planned = wanted.into_iter().zip(decided).map(|((folder, spec, source), (decision, record))| {
            Planned { spec, folder, decision, record, source }
        });
        Ok(planned.collect())
    }

    fn source(&self, experiment: &Experiment, spec: &RunSpec) -> Result<Source, ExperimentError> {
        let root = self.registry.datasets();
        let source = match (experiment.world(&spec.scenario), &spec.scenario) {
            (Some(world), _) => {
                let scene = Box::new(Scene::new(world)?);
                let simulation = spec.simulation.clone().unwrap_or_default();
                scene.check(&simulation)?;
                let dataset = dataset_of(&root, &scene, &simulation);
                Source::Simulated { scene, dataset }
            }
            (None, origin) => {
                let dataset = Imported::open(&root, origin.name())?;
                dataset.check(spec)?;
                Source::Imported(dataset)
            }
        };
        let check = spec.check(source.layout());
        check
            .map_err(|problem| ExperimentError::Unsuitable { dataset: source.name().to_owned(), problem })?;
        Ok(source)
    }

    /// Where a run's frames are kept.
    fn frame_place(&self, Planned { spec, source, .. }: &Planned) -> FramePlace {
        let layout = source.layout();
        match spec.modalities().iter().any(|modality| layout[*modality].is_image()) {
            true => FramePlace::for_samples(layout, source.len(), self.memory),
            false => FramePlace::Nowhere,
        }
    }

    /// The samples of a run's dataset, of which what is missing is collected first.
    fn samples(&self, source: &Source, frames: FramePlace) -> Result<Samples, ExperimentError> {
        self.check_room(source, frames)?;
        match source {
            Source::Simulated { scene, dataset } => {
                if let Some(shard) = self.shard {
                    collect_share(dataset, scene, shard, 0, self.threads, self.progress)?;
                }
                collect(dataset, scene, self.threads, self.progress)?;
                Ok(dataset.load(frames, self.progress)?)
            }
            Source::Imported(dataset) => Ok(dataset.load(frames, self.progress)?),
        }
    }

    /// Refuses a dataset that has no room, and says so of frames that are kept on disk.
    fn check_room(&self, source: &Source, frames: FramePlace) -> Result<(), ExperimentError> {
        let dataset = source.name().to_owned();
        let (needed, available) =
            (Samples::bytes(source.layout(), source.len(), frames), memory::within_reach());
        if needed > available {
            return Err(ExperimentError::Memory { dataset, needed, available });
        }
        if frames != FramePlace::Disk {
            return Ok(());
        }
        let (needed, folder) = (frame_bytes(source.layout(), source.len()), self.registry.datasets());
        if let Some(available) = free_bytes(&folder).filter(|available| needed > *available) {
            return Err(ExperimentError::Disk { dataset, needed, available, folder });
        }
        self.progress.say(&format!(
            "the frames of {dataset}, {:.1} GB, are kept in a temporary file beside it; --memory can keep them in memory",
            needed as f64 / 1e9
        ));
        Ok(())
    }

    /// Makes the run's dataset ready for training.
    fn prepare(&self, planned: &Planned) -> Result<PreparedData, ExperimentError> {
        let begin = Instant::now();
        let Planned { spec, source, .. } = planned;
        let frames = self.frame_place(planned);
        let samples = self.samples(source, frames)?;
        let partition = samples.partition(&spec.split).ok_or(ExperimentError::NoTraining)?;
        let normalizers =
            Normalizers::fit(&samples, &partition.training, &spec.scalings(samples.layout()), spec.action);
        let data = NormalizedData {
            samples: Arc::new(samples),
            normalizers: Arc::new(normalizers),
            action: spec.action,
            device: open_device(spec.training.device)?,
        };
        let mut baselines = Vec::new();
        for task in &spec.tasks {
            let output = if *task == Task::Prediction { &spec.output } else { &spec.input };
            baselines.extend(evaluate::baselines(&data, &partition, *task, &spec.input, output)?);
        }
        let forces = evaluate::forces(&data.samples);
        let sampled_transitions = evaluate::sample_transitions(&data.samples, &partition.test);
        let bytes = Samples::bytes(source.layout(), source.len(), frames);
        let seconds = begin.elapsed().as_secs_f64();
        Ok(PreparedData { data, partition, baselines, forces, sampled_transitions, bytes, seconds })
    }
}

impl ExperimentError {
    /// Whether this is the caller's own wish to stop.
    pub fn is_cancelled(&self) -> bool {
        match self {
            Self::Cancelled | Self::Learning(LearningError::Cancelled) => true,
            Self::Dataset(error) => error.is_cancelled(),
            Self::Collection(error) => error.is_cancelled(),
            _ => false,
        }
    }
}

/// What stands behind a command, with the versions of what simulates and learns.
pub fn provenance(threads: usize, command: String) -> Provenance {
    let versions = Versions { mujoco: mujoco_version(), candle: learning::CANDLE_VERSION };
    Provenance::gather(versions, threads, command)
}

/// An error and its causes, in one line.
pub fn describe(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let words = error.to_string();
        if !text.contains(&words) {
            text = format!("{text}: {words}");
        }
        cause = error.source();
    }
    text
}

/// Memory that training a run's networks takes, one after the other, bytes: a generous estimate.
fn training_bytes(spec: &RunSpec, layout: &Arc<Layout>) -> Result<u64, LearningError> {
    let bytes = |task: &Task| {
        let summary = architecture(spec, layout, *task).summary()?;
        let (parameters, activations) = (summary.parameters(), summary.activations());
        Ok(learning::memory::training_bytes(parameters, activations, spec.training.batch_size))
    };
    let bytes: candle_core::Result<Vec<u64>> = spec.tasks.iter().map(bytes).collect();
    Ok(bytes.map_err(LearningError::from)?.into_iter().max().unwrap_or_default())
}

/// A scenario's data, shared by runs that want the same of it.
struct PreparedData {
    data: NormalizedData,
    partition: Partition,
    baselines: Vec<MetricRow>,
    forces: Vec<ForceRows>,
    /// The test transitions whose pictures are kept.
    sampled_transitions: Vec<SampledTransition>,
    /// Memory that the samples take, bytes.
    bytes: u64,
    seconds: f64,
}

/// One run in training.
struct TrainingRun<'a> {
    spec: &'a RunSpec,
    folder: &'a RunFolder,
    prepared: &'a PreparedData,
    progress: &'a dyn Progress,
}

impl TrainingRun<'_> {
    fn run(&self) -> Result<Outcome, ExperimentError> {
        let mut outcome = Outcome {
            timings: Timings { collect: self.prepared.seconds, ..Timings::default() },
            ..Outcome::default()
        };
        outcome.metrics.extend(self.prepared.baselines.iter().cloned());
        outcome.forces = self.prepared.forces.clone();
        let (encoder, parameters) = self.predict(&mut outcome)?;
        outcome.parameters = parameters.values().map(|var| var.elem_count()).sum();
        if self.spec.tasks.contains(&Task::Reconstruction) {
            self.reconstruct(&*encoder, &mut outcome)?;
        }
        Ok(outcome)
    }

    fn fit<'a>(&'a self, task: Task, state: &'a StateFile) -> Fit<'a> {
        Fit {
            task,
            training: &self.spec.training,
            seed: self.spec.seed,
            partition: &self.prepared.partition,
            state,
            progress: self.progress,
        }
    }

    /// Trains encoder and decoder, and evaluates them.
    fn predict(&self, outcome: &mut Outcome) -> Result<(Box<dyn Encoder>, Parameters), ExperimentError> {
        let Self { spec, prepared: PreparedData { data, partition, sampled_transitions, .. }, .. } = self;
        let begin = Instant::now();
        let task = Task::Prediction;
        let mut parameters = Parameters::new();
        let mut random = Random::new(spec.seed, Stream::Parameters(task));
        let architecture = architecture(spec, data.samples.layout(), task);
        let objective = Prediction {
            data,
            encoder: architecture
                .encoder(&mut parameters, &mut random, &data.device)
                .map_err(LearningError::from)?,
            decoder: architecture
                .decoder(&mut parameters, &mut random, &data.device)
                .map_err(LearningError::from)?,
            input: &spec.input,
            output: &spec.output,
            kl_weight: spec.training.kl_weight,
            losses: &spec.training.losses,
            loss_weights: &spec.training.loss_weights,
            dropout: spec.training.dropout,
        };
        let state = StateFile::at(self.folder.state(task));
        let epochs = self.fit(task, &state).run(&objective, &parameters)?;
        outcome.timings.prediction = begin.elapsed().as_secs_f64();
        checkpoint::save(&self.folder.checkpoint(task), &parameters, &data.normalizers)?;
        let begin = Instant::now();
        let latent = predict::encode(data, &*objective.encoder, &spec.input, &partition.test);
        let latent = latent.map_err(LearningError::from)?;
        let evaluated = evaluate::network(
            data,
            task,
            &*objective.decoder,
            &spec.output,
            &latent,
            &partition.test,
            sampled_transitions,
        )?;
        add(outcome, task, epochs, evaluated);
        outcome.timings.evaluation += begin.elapsed().as_secs_f64();
        Ok((objective.encoder, parameters))
    }

    /// Trains a new decoder on the frozen encoder's latent states, and evaluates it.
    fn reconstruct(&self, encoder: &dyn Encoder, outcome: &mut Outcome) -> Result<(), ExperimentError> {
        let Self { spec, prepared: PreparedData { data, partition, sampled_transitions, .. }, .. } = self;
        let begin = Instant::now();
        let task = Task::Reconstruction;
        let mut parameters = Parameters::new();
        let mut random = Random::new(spec.seed, Stream::Parameters(task));
        let everything: Vec<usize> = (0..data.samples.len()).collect();
        let latent = predict::encode(data, encoder, &spec.input, &everything).map_err(LearningError::from)?;
        let decoder = architecture(spec, data.samples.layout(), task).decoder(
            &mut parameters,
            &mut random,
            &data.device,
        );
        let objective = Reconstruction {
            data,
            latent: &latent,
            decoder: decoder.map_err(LearningError::from)?,
            input: &spec.input,
        };
        let state = StateFile::at(self.folder.state(task));
        let epochs = self.fit(task, &state).run(&objective, &parameters)?;
        outcome.timings.reconstruction = Some(begin.elapsed().as_secs_f64());
        checkpoint::save(&self.folder.checkpoint(task), &parameters, &data.normalizers)?;
        let begin = Instant::now();
        let test =
            harness_learning::objective::rows(&latent, &partition.test).map_err(LearningError::from)?;
        let evaluated = evaluate::network(
            data,
            task,
            &*objective.decoder,
            &spec.input,
            &test,
            &partition.test,
            sampled_transitions,
        )?;
        add(outcome, task, epochs, evaluated);
        outcome.timings.evaluation += begin.elapsed().as_secs_f64();
        Ok(())
    }
}

/// Adds what the training and the evaluation of one task gave.
fn add(outcome: &mut Outcome, task: Task, epochs: Vec<Epoch>, evaluated: Evaluated) {
    outcome.epochs.extend(epochs.into_iter().map(|epoch| (task, epoch)));
    outcome.metrics.extend(evaluated.metrics);
    outcome.predictions.extend(evaluated.predictions);
    outcome.frames.extend(evaluated.frames);
}
