//! The story of an experiment: spec, episodes, dataset, training, metrics, record.

mod evaluate;

pub use evaluate::physical;

use evaluate::{Evaluated, Story};

use crate::dataset::{Dataset, DatasetError, Partition, Standard, collect};
use crate::learning::network::{Decoder, Encoder, Parameters, Sizes};
use crate::learning::objective::{Prediction, Reconstruction, View};
use crate::learning::random::{Random, Stream};
use crate::learning::state::StateFile;
use crate::learning::training::{Epoch, Fit};
use crate::learning::{LearningError, checkpoint, predict};
use crate::metrics::MetricsError;
use crate::progress::Progress;
use crate::registry::{
    Decision, ForceRows, MetricRow, Outcome, Provenance, Registry, RegistryError, RunFolder, Timings,
};
use crate::simulation::{Scene, SimulationError};
use crate::spec::{Experiment, Modality, RunSpec, Scenario, Task};
use candle_core::Device;
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
    Learning(#[from] LearningError),
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    #[error(transparent)]
    Registry(#[from] RegistryError),
    #[error("no episode is left for training; give the experiment more episodes or smaller shares in split")]
    NoTraining,
}

/// What an experiment needs besides its spec.
pub struct Laboratory<'a> {
    pub registry: &'a Registry,
    /// A folder of MJCF files to use instead of the built-in ones.
    pub models: Option<PathBuf>,
    /// Threads for collection; training uses those of the pool it runs in.
    pub threads: usize,
    pub provenance: &'a Provenance,
    pub progress: &'a dyn Progress,
}

/// One run of an experiment's plan.
pub struct Planned {
    pub spec: RunSpec,
    pub folder: RunFolder,
    pub decision: Decision,
}

/// What became of an experiment's runs.
#[derive(Debug, Default)]
pub struct Summary {
    pub done: usize,
    pub skipped: usize,
    /// Each was reported when it failed, and has a record that says why.
    pub failed: usize,
}

impl Laboratory<'_> {
    /// Each run of the experiment with what will happen to it, and why.
    pub fn plan(&self, experiment: &Experiment) -> Result<Vec<Planned>, ExperimentError> {
        let runs = experiment.runs().into_iter().map(|spec| {
            let dataset = self.dataset(&self.scene(spec.scenario)?, &spec);
            let folder = self.registry.run(&experiment.name, &spec, dataset.name());
            let decision = self.registry.decide(&folder, &spec)?;
            Ok(Planned { spec, folder, decision })
        });
        runs.collect()
    }

    fn scene(&self, scenario: Scenario) -> Result<Scene, ExperimentError> {
        Ok(Scene::load(scenario, self.models.as_deref())?)
    }

    fn dataset(&self, scene: &Scene, spec: &RunSpec) -> Dataset {
        Dataset::new(&self.registry.datasets(), scene, &spec.simulation)
    }

    /// Does every run that isn't done yet. A run that fails leaves a record that says why, and the others go on.
    ///
    /// # Errors
    /// When not even a record can be written, or the caller cancels.
    pub fn run(&self, experiment: &Experiment) -> Result<Summary, ExperimentError> {
        let mut summary = Summary::default();
        let mut material: Option<Material> = None;
        for planned in self.plan(experiment)? {
            if planned.decision == Decision::Skip {
                summary.skipped += 1;
                continue;
            }
            if material.as_ref().is_none_or(|material| material.scenario != planned.spec.scenario) {
                // The other scenario's frames make room before this one's are loaded.
                drop(material.take());
            }
            let Planned { spec, folder, .. } = &planned;
            let record = self.registry.begin(folder, spec, self.provenance)?;
            match self.train(spec, folder, &mut material) {
                Ok(outcome) => {
                    self.registry.finish(folder, record, &outcome)?;
                    summary.done += 1;
                }
                Err(error) if error.is_cancelled() => return Err(error),
                Err(error) => {
                    let reason = describe(&error);
                    self.registry.fail(folder, record, &reason)?;
                    self.progress.say(&format!("{} failed: {reason}", folder.id()));
                    summary.failed += 1;
                }
            }
        }
        Ok(summary)
    }

    fn train(
        &self,
        spec: &RunSpec,
        folder: &RunFolder,
        material: &mut Option<Material>,
    ) -> Result<Outcome, ExperimentError> {
        let material = match material {
            Some(material) => material,
            None => material.insert(self.prepare(spec)?),
        };
        Trainee { spec, folder, material, progress: self.progress }.run()
    }

    /// Collects what is missing of the run's dataset and makes it ready for training.
    fn prepare(&self, spec: &RunSpec) -> Result<Material, ExperimentError> {
        let begin = Instant::now();
        let scene = self.scene(spec.scenario)?;
        let dataset = self.dataset(&scene, spec);
        collect(&dataset, &scene, self.threads, self.progress)?;
        let modalities: Vec<Modality> = Modality::ALL
            .iter()
            .copied()
            .filter(|m| spec.input.contains(m) || spec.output.contains(m))
            .collect();
        let frames = modalities.iter().any(|modality| modality.is_frame());
        let samples = match dataset.load(frames) {
            Err(DatasetError::Damaged { path, problem }) => {
                self.progress.say(&format!("{} is damaged ({problem}) and is made again", path.display()));
                dataset.discard_damaged(frames);
                collect(&dataset, &scene, self.threads, self.progress)?;
                dataset.load(frames)?
            }
            loaded => loaded?,
        };
        let partition = samples.partition(&spec.split).ok_or(ExperimentError::NoTraining)?;
        let standard = Standard::fit(&samples, &partition.training, &modalities, spec.action);
        let view = View {
            samples: Arc::new(samples),
            standard: Arc::new(standard),
            action: spec.action,
            device: Device::Cpu,
        };
        let mut baselines = Vec::new();
        for task in &spec.tasks {
            let output = if *task == Task::Prediction { &spec.output } else { &spec.input };
            baselines.extend(evaluate::baselines(&view, &partition, *task, &spec.input, output)?);
        }
        let forces = evaluate::forces(&view.samples);
        let storyboard = evaluate::storyboard(&view.samples, &partition.test);
        let seconds = begin.elapsed().as_secs_f64();
        Ok(Material { scenario: spec.scenario, view, partition, baselines, forces, storyboard, seconds })
    }
}

impl ExperimentError {
    /// Whether this is the caller's own wish to stop.
    pub fn is_cancelled(&self) -> bool {
        matches!(
            self,
            Self::Learning(LearningError::Cancelled)
                | Self::Dataset(DatasetError::Simulation(SimulationError::Cancelled { .. }))
        )
    }
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

/// The sizes of the network that a run trains for a task.
pub fn network_sizes(spec: &RunSpec, task: Task) -> Sizes {
    let (output, action) = match task {
        Task::Prediction => (&spec.output, crate::spec::ARM_JOINTS),
        Task::Reconstruction => (&spec.input, 0),
    };
    Sizes {
        input: spec.input.clone(),
        output: output.clone(),
        latent: spec.latent,
        hidden: spec.network.hidden,
        channels: spec.network.channels,
        action,
    }
}

/// A scenario's data, shared by its runs.
struct Material {
    scenario: Scenario,
    view: View,
    partition: Partition,
    baselines: Vec<MetricRow>,
    forces: Vec<ForceRows>,
    /// The test transitions whose pictures are kept.
    storyboard: Vec<Story>,
    seconds: f64,
}

/// One run in training.
struct Trainee<'a> {
    spec: &'a RunSpec,
    folder: &'a RunFolder,
    material: &'a Material,
    progress: &'a dyn Progress,
}

impl Trainee<'_> {
    fn run(&self) -> Result<Outcome, ExperimentError> {
        let mut outcome = Outcome {
            timings: Timings { collect: self.material.seconds, ..Timings::default() },
            ..Outcome::default()
        };
        outcome.metrics.extend(self.material.baselines.iter().cloned());
        outcome.forces = self.material.forces.clone();
        let (encoder, parameters) = self.predict(&mut outcome)?;
        outcome.parameters = parameters.values().map(|var| var.elem_count()).sum();
        if self.spec.tasks.contains(&Task::Reconstruction) {
            self.reconstruct(&encoder, &mut outcome)?;
        }
        Ok(outcome)
    }

    fn fit<'a>(&'a self, task: Task, state: &'a StateFile) -> Fit<'a> {
        Fit {
            task,
            training: &self.spec.training,
            seed: self.spec.seed,
            partition: &self.material.partition,
            state,
            progress: self.progress,
        }
    }

    /// Trains encoder and decoder, and evaluates them.
    fn predict(&self, outcome: &mut Outcome) -> Result<(Encoder, Parameters), ExperimentError> {
        let Self { spec, material: Material { view, partition, storyboard, .. }, .. } = self;
        let begin = Instant::now();
        let task = Task::Prediction;
        let mut parameters = Parameters::new();
        let mut random = Random::new(spec.seed, Stream::Parameters(task));
        let sizes = network_sizes(spec, task);
        let objective = Prediction {
            view,
            encoder: Encoder::new(&sizes, &mut parameters, &mut random, &view.device)
                .map_err(LearningError::from)?,
            decoder: Decoder::new(&sizes, &mut parameters, &mut random, &view.device)
                .map_err(LearningError::from)?,
            input: &spec.input,
            output: &spec.output,
            kl_weight: spec.training.kl_weight,
            loss_weights: &spec.training.loss_weights,
        };
        let state = StateFile::at(self.folder.state(task));
        let epochs = self.fit(task, &state).run(&objective, &parameters)?;
        outcome.timings.prediction = begin.elapsed().as_secs_f64();
        checkpoint::save(&self.folder.checkpoint(task), &parameters, &view.standard)?;
        let begin = Instant::now();
        let latent = predict::encode(view, &objective.encoder, &spec.input, &partition.test);
        let latent = latent.map_err(LearningError::from)?;
        let evaluated = evaluate::network(
            view,
            task,
            &objective.decoder,
            &spec.output,
            &latent,
            &partition.test,
            storyboard,
        )?;
        outcome.add(task, epochs, evaluated);
        outcome.timings.evaluation += begin.elapsed().as_secs_f64();
        Ok((objective.encoder, parameters))
    }

    /// Trains a new decoder on the frozen encoder's latent states, and evaluates it.
    fn reconstruct(&self, encoder: &Encoder, outcome: &mut Outcome) -> Result<(), ExperimentError> {
        let Self { spec, material: Material { view, partition, storyboard, .. }, .. } = self;
        let begin = Instant::now();
        let task = Task::Reconstruction;
        let mut parameters = Parameters::new();
        let mut random = Random::new(spec.seed, Stream::Parameters(task));
        let everything: Vec<usize> = (0..view.samples.len()).collect();
        let latent = predict::encode(view, encoder, &spec.input, &everything).map_err(LearningError::from)?;
        let decoder = Decoder::new(&network_sizes(spec, task), &mut parameters, &mut random, &view.device);
        let objective = Reconstruction {
            view,
            latent: &latent,
            decoder: decoder.map_err(LearningError::from)?,
            input: &spec.input,
        };
        let state = StateFile::at(self.folder.state(task));
        let epochs = self.fit(task, &state).run(&objective, &parameters)?;
        outcome.timings.reconstruction = Some(begin.elapsed().as_secs_f64());
        checkpoint::save(&self.folder.checkpoint(task), &parameters, &view.standard)?;
        let begin = Instant::now();
        let test = crate::learning::objective::rows(&latent, &partition.test).map_err(LearningError::from)?;
        let evaluated = evaluate::network(
            view,
            task,
            &objective.decoder,
            &spec.input,
            &test,
            &partition.test,
            storyboard,
        )?;
        outcome.add(task, epochs, evaluated);
        outcome.timings.evaluation += begin.elapsed().as_secs_f64();
        Ok(())
    }
}

impl Outcome {
    fn add(&mut self, task: Task, epochs: Vec<Epoch>, evaluated: Evaluated) {
        self.epochs.extend(epochs.into_iter().map(|epoch| (task, epoch)));
        self.metrics.extend(evaluated.metrics);
        self.predictions.extend(evaluated.predictions);
        self.frames.extend(evaluated.frames);
    }
}
