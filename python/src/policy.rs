//! The Python classes `PolicyDataset` and `Recorder`: a dataset whose setpoints a Python function gives.

use crate::array::{Item, array, natural, read, shape};
use crate::errors::Raise;
use crate::run::{Listener, writable};
use crate::work::{detached, interruptible};
use harness::cli::progress::Bars;
use harness::collection::{claim, dataset_of};
use harness::dataset::Dataset;
use harness::files::FolderLock;
use harness::progress::{Progress, Silent};
use harness::simulation::{Episode, LiveSimulation, Scene, SimulationError};
use harness::spec::{self, Modality, Simulation};
use pyo3::exceptions::{PyKeyError, PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, TryLockError};

/// A dataset whose setpoints a Python function gives; see `harness.collect`.
#[pyclass(frozen, module = "harness._harness")]
pub struct PolicyDataset {
    scene: &'static Scene,
    dataset: Dataset,
    progress: bool,
    /// The bar on the terminal.
    bar: Box<dyn Progress + Send + Sync>,
    /// The lock of the folder, from `claim` to `release`.
    lock: Mutex<Option<FolderLock>>,
}

#[pymethods]
impl PolicyDataset {
    /// Returns the datasets of an experiment with the policy `NAME@VERSION`. These are those in which
    /// `simulation.policy` names this policy, or all datasets if it names none. Writes nothing.
    #[staticmethod]
    fn of(
        path: PathBuf,
        overrides: Vec<String>,
        quick: bool,
        results: PathBuf,
        policy: &str,
        progress: bool,
    ) -> PyResult<Vec<Self>> {
        let experiment = spec::load_task(&path, &overrides, quick).map_err(Raise::raise)?;
        let registry = writable(results)?;
        let mut simulated = experiment.simulated();
        let named: BTreeSet<String> =
            simulated.iter().filter_map(|(_, simulation)| simulation.policy.clone()).collect();
        if !named.is_empty() {
            simulated.retain(|(_, simulation)| simulation.policy.as_deref() == Some(policy));
        }
        if simulated.is_empty() && !named.is_empty() {
            let named: Vec<String> = named.into_iter().collect();
            return Err(PyValueError::new_err(format!(
                "simulation.policy: the experiment names {}, but the given policy is {policy}; give this policy's \
                 `version`, or change simulation.policy",
                named.join(", ")
            )));
        }
        let open = |(world, mut simulation): (_, Simulation)| {
            simulation.policy = Some(policy.to_owned());
            let scene = Scene::shared(world).map_err(Raise::raise)?;
            scene.check(&simulation).map_err(Raise::raise)?;
            let dataset = dataset_of(&registry.datasets(), scene, &simulation);
            let bar: Box<dyn Progress + Send + Sync> =
                if progress { Box::new(Bars::default()) } else { Box::new(Silent) };
            Ok(Self { scene, dataset, progress, bar, lock: Mutex::new(None) })
        };
        simulated.into_iter().map(open).collect()
    }

    /// Name of the folder: the scenario, and a hash of everything that determines the dataset.
    #[getter]
    fn name(&self) -> &str {
        self.dataset.name()
    }

    /// Path of the folder.
    #[getter]
    fn folder(&self) -> PathBuf {
        self.dataset.folder().to_owned()
    }

    /// Locks the folder, for which it may wait, and returns the indices of the missing episodes.
    fn claim(&self, py: Python) -> PyResult<Vec<u32>> {
        let listener = Listener::new(self.progress);
        let wait = || claim(&self.dataset, self.scene, &listener);
        let claimed = interruptible(py, wait, || listener.cancel())?;
        let (lock, missing) = claimed.map_err(Raise::raise)?;
        if !missing.is_empty() {
            let samples = missing.len() * self.dataset.spec().samples_per_episode();
            let stage = format!("collecting {}", self.scene.scenario());
            self.bar.begin(&stage, samples as u64, "samples");
        }
        *self.held()? = Some(lock);
        Ok(missing)
    }

    /// Shows on the terminal that this number of samples has been simulated.
    fn advance(&self, samples: u64) {
        self.bar.advance(samples);
    }

    /// Removes those of these episodes that have a file, and the folder if it has no others. Unlocks the folder.
    fn release(&self, discarded: Vec<u32>) -> PyResult<()> {
        self.bar.end();
        let lock = self.held()?.take();
        let removed = if discarded.is_empty() { Ok(()) } else { self.dataset.discard(&discarded) };
        drop(lock);
        removed.map_err(|error| PyOSError::new_err(format!("{}: {error}", self.dataset.folder().display())))
    }

    /// Returns a recorder of the dataset's episodes.
    fn recorder(&self, py: Python) -> PyResult<Recorder> {
        let (scene, dataset) = (self.scene, self.dataset.clone());
        let start = || {
            let live = LiveSimulation::new(scene, dataset.spec())?;
            let episode = live.new_episode();
            Ok::<_, SimulationError>(Recording { live, episode })
        };
        let recording = detached(py, start)?.map_err(Raise::raise)?;
        Ok(Recorder { scene, dataset, recording: Mutex::new(recording) })
    }
}

impl PolicyDataset {
    fn held(&self) -> PyResult<MutexGuard<'_, Option<FolderLock>>> {
        self.lock.lock().map_err(|_| PyRuntimeError::new_err("an earlier call panicked"))
    }
}

/// Records the episodes of a dataset, one after the other, with the setpoints that its caller gives.
#[pyclass(frozen, module = "harness._harness")]
pub struct Recorder {
    scene: &'static Scene,
    dataset: Dataset,
    recording: Mutex<Recording>,
}

/// A simulation, and what has been recorded of it.
struct Recording {
    live: LiveSimulation,
    episode: Episode,
}

impl Recording {
    fn start(&mut self, seed: u64, index: u32) -> Result<(), SimulationError> {
        self.live.reset(seed, index)?;
        self.episode = self.live.new_episode();
        self.live.record(&mut self.episode)
    }

    fn step(&mut self, setpoint: &[f64]) -> Result<(), SimulationError> {
        self.live.step(setpoint)?;
        self.live.record(&mut self.episode)
    }
}

#[pymethods]
impl Recorder {
    /// Starts an episode, and records its first sample, which is at rest.
    fn start(&self, py: Python, episode: u32) -> PyResult<()> {
        let seed = self.dataset.spec().seed;
        self.work(py, |recording| recording.start(seed, episode))
    }

    /// Records the next sample. Meanwhile the setpoint moves to the given one, `[elements]`, at constant speed.
    fn step(&self, py: Python, setpoint: &Bound<PyAny>) -> PyResult<()> {
        let setpoint: Vec<f64> = read("setpoint", setpoint, &[self.scene.layout().action().len()])?;
        self.work(py, |recording| recording.step(&setpoint))
    }

    /// Returns the recorded values of a modality from the sample `first` on, `[samples, ...]`.
    fn values<'py>(&self, py: Python<'py>, modality: &str, first: i64) -> PyResult<Bound<'py, PyAny>> {
        let first: usize = natural("first", first)?;
        let recording = self.lock()?;
        let layout = &recording.episode.layout;
        let stored = layout.stored_vectors().chain(layout.stored_images());
        let found = stored.into_iter().find(|definition| definition.name.name() == modality);
        let definition = found.ok_or_else(|| PyKeyError::new_err(modality.to_owned()))?;
        let name = definition.name;
        match definition.size() {
            None => rest(py, recording.episode.vector(name), first, &[definition.width()]),
            Some(_) => rest(py, recording.episode.image(name), first, &shape(definition)),
        }
    }

    /// Writes the episode, all of whose samples must be recorded.
    fn save(&self, py: Python) -> PyResult<()> {
        let recording = self.lock()?;
        let episode = &recording.episode;
        detached(py, || self.dataset.save(episode))?.map_err(Raise::raise)
    }

    /// Name of the world.
    #[getter]
    fn scenario(&self) -> &'static str {
        self.scene.scenario().name()
    }

    /// Seed of the dataset.
    #[getter]
    fn seed(&self) -> u64 {
        self.dataset.spec().seed
    }

    /// Number of samples in an episode.
    #[getter]
    fn samples(&self) -> usize {
        self.dataset.spec().samples_per_episode()
    }

    /// Time from one sample to the next, s.
    #[getter]
    fn sample_seconds(&self) -> f64 {
        1.0 / self.dataset.spec().sample_rate_hz
    }

    /// The recorded modalities: the shape of a sample's values, by name.
    #[getter]
    fn modalities<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (shapes, layout) = (PyDict::new(py), self.dataset.layout());
        for definition in layout.stored_vectors().chain(layout.stored_images()) {
            shapes.set_item(Modality::name(definition.name), PyTuple::new(py, shape(definition))?)?;
        }
        Ok(shapes)
    }

    /// Names of the elements of a setpoint.
    #[getter]
    fn action(&self) -> Vec<String> {
        self.scene.layout().action().iter().map(|element| element.name.clone()).collect()
    }

    /// Lowest and highest value of each element of a setpoint, `[elements, 2]`, in rad or m.
    #[getter]
    fn setpoint_ranges<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let ranges = self.lock()?.live.setpoint_ranges();
        let count = ranges.len();
        array(py, ranges.into_iter().flatten().collect(), &[count, 2])
    }
}

impl Recorder {
    fn lock(&self) -> PyResult<MutexGuard<'_, Recording>> {
        self.recording.try_lock().map_err(|error| {
            PyRuntimeError::new_err(match error {
                TryLockError::WouldBlock => "the recorder is at work in another thread",
                TryLockError::Poisoned(_) => "an earlier call panicked and left the recorder undefined",
            })
        })
    }

    /// Calls `work` with the recording, without the interpreter's lock.
    fn work(
        &self,
        py: Python,
        work: impl FnOnce(&mut Recording) -> Result<(), SimulationError> + Send,
    ) -> PyResult<()> {
        let mut held = self.lock()?;
        let held = &mut *held;
        py.detach(|| work(held)).map_err(Raise::raise)
    }
}

/// Returns the values of the samples from `first` on, each of this shape.
fn rest<'py, T: Item>(
    py: Python<'py>,
    values: &[T],
    first: usize,
    shape: &[usize],
) -> PyResult<Bound<'py, PyAny>> {
    let width: usize = shape.iter().product();
    let rest = values.get(first * width..).unwrap_or_default().to_vec();
    let all = [&[rest.len() / width.max(1)], shape].concat();
    array(py, rest, &all)
}
