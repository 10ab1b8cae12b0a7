//! Runs experiments: from a spec to episodes, a dataset, training, metrics and a record.

pub mod collection;
mod evaluate;
mod export;
mod external;
mod model;
mod recorded;
mod rollout;
mod schedule;
mod search;
pub mod shard;
mod simulator;
mod training;
pub mod turns;
mod worlds;

pub use export::{attached, may_have_network, network_files, onnx};
pub use external::{External, JudgedRun, OpenTask, PredictionTask, Predictions, SubmissionError};
pub use model::{Model, ModelError, Values};
pub use recorded::{dataset_notes, recording_notes};
pub use rollout::{Rollout, RolloutError, rollout};
pub use schedule::Summary;
pub use search::{Best, best};
pub use simulator::{FittedTo, Replay, SimulatorError};
pub use worlds::results;

use crate::collection::{collect, collect_together, dataset_of};
use crate::shard::Shard;
use evaluate::References;
use harness_judge::JudgeError;
use harness_learning::data::NormalizedData;
use harness_learning::network::architecture;
use harness_learning::{self as learning, LearningError, open_device};
use harness_registry::dataset::{AnyDataset, Dataset, DatasetError, Imported};
use harness_registry::{Decision, Provenance, Registry, RegistryError, RunFolder, RunRecord, Versions};
use harness_samples::{FramePlace, Normalizers, Partition, Samples, frame_bytes};
use harness_shared::files::free_bytes;
use harness_shared::memory;
use harness_shared::progress::Progress;
use harness_simulation::{Scene, SimulationError, mujoco_version};
use harness_spec::{Device, Experiment, Layout, RunSpec, Task, Trained, World};
use rayon::prelude::*;
use search::{Rungs, Standing};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    /// The world can't be simulated.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    /// The simulator can't predict the samples.
    #[error(transparent)]
    Simulator(#[from] SimulatorError),
    /// The dataset can't be read or written.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The training failed.
    #[error(transparent)]
    Learning(#[from] LearningError),
    /// The evaluation failed.
    #[error(transparent)]
    Judge(#[from] JudgeError),
    /// The results folder can't be read or written.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// The dataset does not fit the spec.
    #[error("{problem} (dataset {dataset})")]
    Unsuitable {
        /// Name of the dataset.
        dataset: String,
        /// What does not fit.
        problem: String,
    },
    /// The split leaves no training samples.
    #[error(
        "the split leaves no samples for training; lower split.validation, split.test, the window or, in a split by \
         time, split.gap_seconds, or use a larger dataset (if it is simulated, raise simulation.episodes or \
         simulation.actuations_per_episode)"
    )]
    NoTraining,
    /// The dataset, its frames or the training do not fit in memory or on the disk, the first of several runs could not
    /// prepare their data, or the run's predictions come from another program. The text is the message.
    #[error("{0}")]
    NotTrained(String),
    /// The threads of a job can't be started.
    #[error("no threads can be started: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// The predictions of an external model can't become a run.
    #[error(transparent)]
    Submission(#[from] SubmissionError),
    /// The caller cancelled the experiment.
    #[error("the experiment was cancelled; the same command continues from here")]
    Cancelled,
}

/// What an experiment needs in addition to its spec.
pub struct Runner<'a> {
    /// The results folder.
    pub registry: &'a Registry,
    /// Number of threads for collection, and for all trainings together.
    pub threads: usize,
    /// Number of runs that are trained at the same time. Each gets its share of the threads.
    pub jobs: usize,
    /// The share of a dataset's missing episodes that this process simulates before it waits for the others.
    pub shard: Option<Shard>,
    /// Whether to wait for runs that other processes are working on.
    pub waits: bool,
    /// Whether to stop after the first run that fails.
    pub fails_fast: bool,
    /// Frames that take more memory than this, in bytes, are stored on disk. `None` means an eighth of the available
    /// memory.
    pub memory: Option<u64>,
    /// The program, machine and command that are recorded with each run.
    pub provenance: &'a Provenance,
    /// Receives the progress, and can cancel the experiment.
    pub progress: &'a dyn Progress,
}

/// One run in the plan of an experiment.
pub struct Planned {
    /// The run's settings.
    pub spec: RunSpec,
    /// The folder of its results.
    pub folder: RunFolder,
    /// Whether to run, resume or skip it, and why.
    pub decision: Decision,
    /// Position of the run's variant among those of the experiment.
    place: usize,
    /// The record that the run had when it was planned.
    record: Option<RunRecord>,
    source: Arc<Source>,
    /// The run's trainings, of which this is one.
    rungs: Rungs,
    standing: Standing,
}

/// The origin of a scenario's samples: a dataset and, if it is simulated, its scene.
struct Source {
    dataset: AnyDataset,
    /// The dataset for the test, if it has one of its own.
    test: Option<AnyDataset>,
    scene: Option<Box<Scene>>,
    /// The scene of the test, if it is in another world.
    test_scene: Option<Box<Scene>>,
    /// The question of the experiment.
    description: String,
}

impl Source {
    /// Returns the dataset whose episodes are for the test.
    fn tested(&self) -> AnyDataset {
        self.test.clone().unwrap_or_else(|| self.dataset.clone())
    }

    /// Returns the number of samples, also of those for the test.
    fn len(&self) -> usize {
        self.dataset.samples() + self.test.as_ref().map_or(0, AnyDataset::samples)
    }

    /// Returns the scene of the test; `None` if it is imported.
    fn tested_scene(&self) -> Option<&Scene> {
        self.test_scene.as_deref().or(self.scene.as_deref())
    }

    /// Returns the simulated datasets with their scenes.
    fn simulated(&self) -> impl Iterator<Item = (&Dataset, &Scene)> {
        let own = Some((&self.dataset, self.scene.as_deref()));
        let test = self.test.as_ref().map(|test| (test, self.tested_scene()));
        own.into_iter().chain(test).filter_map(|of| match of {
            (AnyDataset::Simulated(dataset), Some(scene)) => Some((dataset, scene)),
            _ => None,
        })
    }

    /// Returns an error if a run can't use the samples.
    fn check(&self, spec: &RunSpec) -> Result<(), ExperimentError> {
        for dataset in std::iter::once(&self.dataset).chain(&self.test) {
            if let AnyDataset::Imported(dataset) = dataset {
                dataset.check(spec)?;
            }
        }
        let unsuitable =
            |problem| ExperimentError::Unsuitable { dataset: self.dataset.name().to_owned(), problem };
        let difference = |test| self.dataset.difference(test, &spec.modalities());
        if let Some(difference) = self.test.as_ref().and_then(difference) {
            let remedy = match spec.other_world() {
                Some(world) => format!(
                    "define what the runs use in the same way in the worlds {} and {world}, or change test.world",
                    spec.scenario
                ),
                None => "import both recordings with the same modalities and rate".to_owned(),
            };
            return Err(unsuitable(format!("{difference}, so it can't be the test; {remedy}")));
        }
        spec.check(self.dataset.layout()).map_err(unsuitable)
    }

    /// Returns the path of the world file; `None` for a built-in world and an imported dataset.
    fn world_file(&self) -> Option<PathBuf> {
        path_of(self.scene.as_deref())
    }

    /// Returns the provenance of a run on these samples.
    fn provenance(&self, by: &Provenance) -> Provenance {
        let version = |dataset: &AnyDataset| match dataset {
            AnyDataset::Simulated(dataset) => Some(dataset.world_version()),
            AnyDataset::Imported(_) => None,
        };
        let other = self.test.as_ref().filter(|_| self.test_scene.is_some());
        Provenance {
            world_file: self.world_file(),
            world: version(&self.dataset),
            test_world_file: path_of(self.test_scene.as_deref()),
            test_world: other.and_then(version),
            description: self.description.clone(),
            ..by.clone()
        }
    }

    /// Returns the worlds whose files have changed since they were read.
    fn changed_worlds(&self) -> impl Iterator<Item = &World> {
        let scenes = self.scene.iter().chain(&self.test_scene);
        scenes.filter(|scene| scene.has_changed()).map(|scene| &**scene.world())
    }
}

/// Returns the path of the world file of a scene; `None` for a path that is not UTF-8, because records are texts.
fn path_of(scene: Option<&Scene>) -> Option<PathBuf> {
    scene?.world().path().filter(|path| path.to_str().is_some())
}

impl Planned {
    /// The shorter trainings of the run, the longest first.
    fn earlier(&self) -> impl Iterator<Item = &RunFolder> {
        self.rungs[..self.standing.rung].iter().rev().map(|(folder, _)| folder)
    }

    /// Whether a longer training of the run is done.
    fn is_outdated(&self) -> bool {
        let is_last = self.standing.rung + 1 == self.rungs.len();
        !is_last && search::Record::read(&self.rungs).reached.is_some_and(|rung| rung > self.standing.rung)
    }

    /// Whether there is nothing to do for the run.
    pub fn is_settled(&self) -> bool {
        matches!(self.decision, Decision::Skip | Decision::Diverged { .. })
    }

    /// Returns the dataset for training and validation, and that for the test; `None` if the test has none of its own.
    pub fn datasets_with_test(&self) -> Option<(&Dataset, &Dataset)> {
        let mut datasets = self.source.simulated();
        let (dataset, _) = datasets.next()?;
        datasets.next().map(|(test, _)| (dataset, test))
    }

    /// Returns the layout of the dataset's samples.
    pub fn layout(&self) -> &Arc<Layout> {
        self.source.dataset.layout()
    }

    /// Whether two runs train on the same data, in the same form and on the same device.
    fn shares_data(&self, other: &Planned) -> bool {
        fn key(planned: &Planned) -> impl PartialEq {
            let spec = &planned.spec;
            let data = (&spec.scenario, &spec.simulation, &spec.split, &spec.test, &spec.window);
            let output = (&spec.output, &spec.probes);
            let form = (&spec.input, &spec.inputs, output, &spec.tasks, spec.action, &spec.scaling);
            (data, form, device(spec))
        }
        key(self) == key(other)
    }
}

/// Checks that the runs in simulated worlds can use what is recorded there. Recordings are not opened.
///
/// # Errors
/// When a world can't be compiled, or a run does not suit it.
pub fn check_in_worlds(experiment: &Experiment) -> Result<(), ExperimentError> {
    let mut runs = experiment.runs();
    runs.retain(|spec| experiment.world(&spec.scenario).is_some());
    sources(Path::new(""), experiment, runs).map(drop)
}

/// Opens the data of each run, and checks that it can use them. `root` is the folder of all datasets.
fn sources(
    root: &Path,
    experiment: &Experiment,
    runs: Vec<RunSpec>,
) -> Result<Vec<(RunSpec, Arc<Source>)>, ExperimentError> {
    fn data(spec: &RunSpec) -> impl PartialEq {
        (&spec.scenario, &spec.simulation, &spec.test)
    }
    let mut sources: Vec<(RunSpec, Arc<Source>)> = Vec::new();
    // The place of the first run on each data.
    let mut firsts: Vec<usize> = Vec::new();
    for spec in runs {
        let mut known = firsts.iter().map(|place| &sources[*place]);
        let source = match known.find(|(of, _)| data(of) == data(&spec)) {
            Some((_, source)) => source.clone(),
            None => {
                firsts.push(sources.len());
                Arc::new(source(root, experiment, &spec)?)
            }
        };
        source.check(&spec)?;
        sources.push((spec, source));
    }
    Ok(sources)
}

/// Opens the data of a run.
fn source(root: &Path, experiment: &Experiment, spec: &RunSpec) -> Result<Source, ExperimentError> {
    let description = experiment.description.clone();
    let source = match (experiment.world(&spec.scenario), &spec.scenario) {
        (Some(world), _) => {
            let scene = Box::new(Scene::new(world)?);
            let other = spec.other_world().and_then(|other| experiment.world(other));
            let test_scene = other.map(Scene::new).transpose()?.map(Box::new);
            let of_test = test_scene.as_ref().unwrap_or(&scene);
            let simulation = spec.simulation.clone().unwrap_or_default();
            let test = spec.test_simulation();
            scene.check(&simulation)?;
            test.iter().try_for_each(|test| of_test.check(test))?;
            let dataset = AnyDataset::Simulated(dataset_of(root, &scene, &simulation));
            let test = test.map(|simulation| dataset_of(root, of_test, &simulation).into());
            Source { dataset, test, scene: Some(scene), test_scene, description }
        }
        (None, origin) => {
            let open = |name: &str| Imported::open(root, name).map(AnyDataset::Imported);
            let test = spec.test.as_ref().and_then(|test| test.dataset.as_deref());
            let (dataset, test) = (open(origin.name())?, test.map(open).transpose()?);
            Source { dataset, test, scene: None, test_scene: None, description }
        }
    };
    Ok(source)
}

impl<'a> Runner<'a> {
    /// Returns a runner that trains one run at a time, waits for other processes, and continues after a run that fails.
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

    /// Returns each run of the experiment, with a decision whether to run, resume or skip it.
    ///
    /// # Errors
    /// When the device or a dataset can't be opened, or a run does not suit its dataset.
    pub fn plan(&self, experiment: &Experiment) -> Result<Vec<Planned>, ExperimentError> {
        open_device(experiment.training.device)?;
        if let Some(repetitions) = experiment.repetitions() {
            self.progress.say(&repetitions);
        }
        let mut wanted = Vec::new();
        for (spec, source) in sources(&self.registry.datasets(), experiment, experiment.runs())? {
            let (name, test) = (source.dataset.name(), source.test.as_ref().map(AnyDataset::name));
            let folder =
                |spec: RunSpec| (self.registry.run_with_test(&experiment.name, &spec, name, test), spec);
            let rungs: Rungs = Arc::new(experiment.rungs(&spec).into_iter().map(folder).collect());
            wanted.push((rungs, source));
        }
        Ok(self.planned(experiment, wanted))
    }

    /// Decides about each run, given its trainings and the origin of its samples.
    fn planned(&self, experiment: &Experiment, wanted: Vec<(Rungs, Arc<Source>)>) -> Vec<Planned> {
        let (runs, sources): (Vec<Rungs>, Vec<Arc<Source>>) = wanted.into_iter().unzip();
        let standings = search::standings(experiment, &runs);
        let known = self.registry.known(&experiment.name);
        let decide = |(rungs, standing): (&Rungs, &Standing)| {
            let (folder, spec) = &rungs[standing.rung];
            self.registry.decide(folder, spec, &known)
        };
        let decided: Vec<_> = runs.par_iter().zip(&standings).map(decide).collect();
        known.remember();
        let parts = runs.into_iter().zip(standings).zip(sources).zip(decided);
        let mut places: HashMap<String, usize> = HashMap::new();
        let planned = parts.map(|(((rungs, standing), source), (decision, record))| {
            let (folder, spec) = rungs[standing.rung].clone();
            let next = places.len();
            let place = *places.entry(spec.variant.clone()).or_insert(next);
            Planned { spec, folder, decision, place, record, source, rungs, standing }
        });
        planned.collect()
    }

    /// Returns where a run's frames are stored.
    fn frame_place(&self, spec: &RunSpec, source: &Source) -> FramePlace {
        let layout = source.dataset.layout();
        match spec.modalities().iter().any(|modality| layout[*modality].is_image()) {
            true => FramePlace::for_samples(layout, source.len(), self.memory),
            false => FramePlace::Nowhere,
        }
    }

    /// Collects the missing episodes of a run's dataset, if there is room for it.
    fn collect(&self, source: &Source, frames: FramePlace) -> Result<(), ExperimentError> {
        self.check_room(source, frames)?;
        for (dataset, scene) in source.simulated() {
            match self.shard {
                Some(shard) => collect_together(dataset, scene, shard, self.threads, self.progress)?,
                None => collect(dataset, scene, self.threads, self.progress)?,
            };
        }
        Ok(())
    }

    /// Returns an error if there is no space for a dataset. Reports it if frames are stored on disk.
    fn check_room(&self, source: &Source, frames: FramePlace) -> Result<(), ExperimentError> {
        let (layout, samples) = (source.dataset.layout(), source.len());
        let name = source.dataset.name();
        let (needed, available) = (Samples::bytes(layout, samples, frames), memory::within_reach());
        if needed > available {
            return Err(ExperimentError::NotTrained(format!(
                "the dataset {name} takes {:.1} GB of memory and only {:.1} GB are free; free some, or lower \
                 simulation.episodes or simulation.actuations_per_episode",
                needed as f64 / 1e9,
                available as f64 / 1e9
            )));
        }
        if frames != FramePlace::Disk {
            return Ok(());
        }
        let (needed, folder) = (frame_bytes(layout, samples), self.registry.datasets());
        if let Some(available) = free_bytes(&folder).filter(|available| needed > *available) {
            return Err(ExperimentError::NotTrained(format!(
                "the frames of the dataset {name} take {:.1} GB of disk while it is used, and only {:.1} GB are free \
                 in {}; make room, or lower simulation.episodes or simulation.actuations_per_episode",
                needed as f64 / 1e9,
                available as f64 / 1e9,
                folder.display()
            )));
        }
        self.progress.say(&format!(
            "the frames of {name}, {:.1} GB, are in a temporary file next to it; --memory can keep them in memory",
            needed as f64 / 1e9
        ));
        Ok(())
    }

    /// Reads a run's dataset, divides it and normalizes it.
    fn open(&self, spec: &RunSpec, source: &Source, frames: FramePlace) -> Result<OpenData, ExperimentError> {
        let begin = Instant::now();
        let samples = source.dataset.load_with_test(source.test.as_ref(), frames, self.progress)?;
        for dataset in std::iter::once(&source.dataset).chain(&source.test) {
            if let AnyDataset::Imported(dataset) = dataset
                && let Some(note) = dataset.short_episodes(spec)
            {
                self.progress.say(&note);
            }
        }
        let partition = samples.partition(&spec.split, &spec.window).ok_or(ExperimentError::NoTraining)?;
        if matches!(source.dataset, AnyDataset::Imported(_)) {
            let split = samples.split(&spec.split);
            for note in
                recorded::notes(&samples, &spec.modalities(), &spec.output, &partition, &split, &spec.window)?
            {
                self.progress.say(&format!("{}: {note}", spec.scenario));
            }
        }
        for note in samples.constant_outputs(&spec.output, &partition, &spec.window) {
            self.progress.say(&format!("{}: {note}", spec.scenario));
        }
        let normalizers =
            Normalizers::fit(&samples, &partition.training, &spec.scalings(samples.layout()), spec.action);
        let (samples, normalizers) = (Arc::new(samples), Arc::new(normalizers));
        let data = NormalizedData::new(samples, normalizers, spec.action, candle_core::Device::Cpu);
        let data = data.disturbed(&spec.inputs, "training").map_err(DatasetError::from)?;
        let bytes = Samples::bytes(source.dataset.layout(), source.len(), frames);
        Ok(OpenData { data, partition, bytes, seconds: begin.elapsed().as_secs_f64() })
    }

    /// Prepares the run's dataset for training.
    fn prepare(&self, planned: &Planned) -> Result<PreparedData, ExperimentError> {
        let Planned { spec, source, .. } = planned;
        let (begin, frames) = (Instant::now(), self.frame_place(spec, source));
        self.collect(source, frames)?;
        let open = self.open(spec, source, frames)?;
        let references = evaluate::references(&open, spec)?;
        Ok(PreparedData { open, references, seconds: begin.elapsed().as_secs_f64() })
    }
}

impl ExperimentError {
    /// Whether the caller cancelled the work.
    pub fn is_cancelled(&self) -> bool {
        match self {
            Self::Cancelled | Self::Learning(LearningError::Cancelled) => true,
            Self::Dataset(error) => error.is_cancelled(),
            Self::Simulation(error) => matches!(error, SimulationError::Cancelled { .. }),
            _ => false,
        }
    }

    /// Whether the training's loss was no longer finite. Another attempt would end in the same way.
    fn is_divergence(&self) -> bool {
        matches!(self, Self::Learning(LearningError::NotFinite { .. }))
    }
}

/// Returns the provenance of a command, with the versions of MuJoCo and candle.
pub fn provenance(threads: usize, command: String) -> Provenance {
    let versions = Versions { mujoco: mujoco_version(), candle: learning::CANDLE_VERSION };
    Provenance::gather(versions, threads, command)
}

/// Returns an error and its causes in one line.
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

/// Returns the device on which a run computes: that of its training.
fn device(spec: &RunSpec) -> Device {
    spec.trained().map(|trained| trained.training.device).unwrap_or(Device::Cpu)
}

/// Returns an upper estimate of the memory that training a run's networks one after the other takes, in bytes.
fn training_bytes(spec: &RunSpec, trained: &Trained, layout: &Arc<Layout>) -> Result<u64, LearningError> {
    let bytes = |task: &Task| {
        let summary = architecture(spec, trained, layout, *task).summary()?;
        let (parameters, activations) = (summary.parameters(), summary.activations());
        Ok(learning::memory::training_bytes(parameters, activations, trained.training.batch_size))
    };
    let bytes: candle_core::Result<Vec<u64>> = spec.tasks.iter().map(bytes).collect();
    Ok(bytes.map_err(LearningError::from)?.into_iter().max().unwrap_or_default())
}

/// A dataset in memory, divided and normalized.
struct OpenData {
    data: NormalizedData,
    partition: Partition,
    /// Memory of the samples, bytes.
    bytes: u64,
    seconds: f64,
}

/// A scenario's data, shared by runs that use them in the same form.
struct PreparedData {
    open: OpenData,
    references: References,
    seconds: f64,
}
