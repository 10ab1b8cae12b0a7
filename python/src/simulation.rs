//! The Python class `SimulationBatch`: one live simulation or many.

use crate::array::{Item, array, natural, read, shape};
use crate::errors::Raise;
use crate::work::belongs_here;
use harness::simulation::{Batch, LiveSimulation, Pose, Scene, SimulationError};
use harness::spec::{self, IMAGE_CHANNELS, Layout, Modality, Simulation, World};
use pyo3::exceptions::{PyKeyError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, TryLockError};

/// One simulation of a world, or many that are stepped in parallel.
///
/// Each simulation is at a sample of an episode. A new one is at the start of the first episode. `reset` starts an
/// episode, and `step` and `follow` go on to the next sample. `sense` returns what a dataset records at a sample.
///
/// Any call raises RuntimeError while another thread is in a call, in a forked process, and after a simulation has
/// become unstable, until it is reset. Simulations can't be pickled.
///
/// Args:
///     scenario: a built-in world, such as `empty` or `cluttered`, or the path of a world file.
///     count: number of simulations, 1 to 4096.
///     spec: an experiment, whose simulation settings are used: the path of a YAML file, or the name of a built-in
///         experiment. The default is the world's own settings.
///
/// Raises:
///     ValueError: there is no such world, a world file or its model is wrong, the count is out of range, or the spec
///         is wrong.
///     FileNotFoundError: there is no such experiment.
///
/// Example:
///     >>> batch = harness.SimulationBatch("cluttered", 2)
///     >>> batch.reset(0, seed=0, episode=5)
///     >>> batch.reset(1, seed=0, episode=6)
///     >>> batch.step(batch.setpoint + [0.05, 0.0, 0.0])        # rotates both arms by 0.05 rad
///     >>> batch.sense("contact_force").shape
///     (2, 20)
#[pyclass(frozen, module = "harness")]
pub struct SimulationBatch {
    work: Mutex<Work>,
    spec: Simulation,
    scene: &'static Scene,
    count: usize,
    /// Id of the process that made it. A forked process has neither its threads nor its OpenGL contexts.
    process: u32,
}

/// The simulations, and the threads that step them. A single simulation is stepped on its caller's thread.
struct Work {
    batch: Batch,
    threads: Option<rayon::ThreadPool>,
}

/// Number of values of a box's pose.
const POSE: usize = size_of::<Pose>() / size_of::<f64>();

impl Work {
    fn on_its_threads<T: Send>(&mut self, work: impl FnOnce(&mut Batch) -> T + Send) -> T {
        match &self.threads {
            Some(threads) => threads.install(|| work(&mut self.batch)),
            None => work(&mut self.batch),
        }
    }
}

impl SimulationBatch {
    /// Starts `count` simulations with these settings.
    pub fn start(py: Python, scene: &'static Scene, spec: Simulation, count: usize) -> PyResult<Self> {
        let batch = py.detach(|| Batch::new(scene, &spec, count)).map_err(Raise::raise)?;
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads =
            (count > 1).then(|| rayon::ThreadPoolBuilder::new().num_threads(cores.min(count)).build());
        let threads = threads.transpose().map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
        let work = Mutex::new(Work { batch, threads });
        Ok(Self { work, spec, scene, count, process: std::process::id() })
    }

    fn lock(&self) -> PyResult<MutexGuard<'_, Work>> {
        belongs_here(self.process, "these simulations")?;
        self.work.try_lock().map_err(|error| {
            PyRuntimeError::new_err(match error {
                TryLockError::WouldBlock => {
                    "these simulations are at work in another thread; give each thread its own"
                }
                TryLockError::Poisoned(_) => "an earlier call panicked and left these simulations undefined",
            })
        })
    }

    /// Calls `work` with the simulations, without the interpreter's lock.
    fn work<T: Send>(
        &self,
        py: Python,
        work: impl FnOnce(&mut Batch) -> Result<T, SimulationError> + Send,
    ) -> PyResult<T> {
        let mut held = self.lock()?;
        let held = &mut *held;
        py.detach(|| held.on_its_threads(work)).map_err(Raise::raise)
    }

    /// Returns `width` values of each simulation as an array `[count, width]`.
    fn gather<'py, T: Item>(
        &self,
        py: Python<'py>,
        width: usize,
        of: impl Fn(&LiveSimulation) -> Vec<T>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let values = self.lock()?.batch.simulations().iter().flat_map(of).collect();
        array(py, values, &[self.count, width])
    }

    fn layout(&self) -> &Layout {
        self.scene.layout()
    }

    /// Returns the names of the sensed modalities: stored vectors and images, without the setpoint.
    fn sensed(&self) -> Vec<&'static str> {
        let layout = self.layout();
        let sensed = layout.stored_vectors().chain(layout.stored_images()).map(|definition| definition.name);
        sensed.filter(|name| *name != Modality::SETPOINT).map(Modality::name).collect()
    }
}

/// Returns the scene of a world, given by its name or by its file's path.
pub fn scene(world: &str) -> PyResult<&'static Scene> {
    let world = World::find(world).map_err(|error| PyValueError::new_err(format!("scenario: {error}")))?;
    Scene::shared(world).map_err(Raise::raise)
}

#[pymethods]
impl SimulationBatch {
    #[new]
    #[pyo3(signature = (scenario, count=1, spec=None))]
    fn new(py: Python, scenario: PathBuf, count: i64, spec: Option<PathBuf>) -> PyResult<Self> {
        let scene = scene(&scenario.to_string_lossy())?;
        let settings = match spec {
            Some(path) => {
                scene.world().complete(&spec::load(&path, &[], false).map_err(Raise::raise)?.simulation)
            }
            None => scene.world().simulation(),
        };
        Self::start(py, scene, settings, natural("count", count)?)
    }

    fn __repr__(&self) -> String {
        format!("<harness.SimulationBatch {}: {} simulations>", self.scenario(), self.count)
    }

    /// Sets one simulation to the start of an episode.
    ///
    /// Args:
    ///     index: the simulation, from 0.
    ///     seed: the seed of a dataset, 0 to 2^53 - 1.
    ///     episode: the index of an episode of that dataset.
    ///
    /// Raises:
    ///     ValueError: an argument is out of range.
    fn reset(&self, py: Python, index: i64, seed: i64, episode: i64) -> PyResult<()> {
        let (index, seed, episode) =
            (natural("index", index)?, natural("seed", seed)?, natural("episode", episode)?);
        if seed > spec::MAX_SEED {
            return Err(PyValueError::new_err(format!("seed: {seed} is above {}", spec::MAX_SEED)));
        }
        self.work(py, |batch| batch.reset(index, seed, episode))
    }

    /// Simulates until the next sample. Meanwhile the setpoint moves to the given one at constant speed.
    ///
    /// Args:
    ///     setpoints: `[count, elements]`, clipped to `setpoint_ranges`. The elements of the worlds `empty` and
    ///         `cluttered` are rotation (rad), lift and extension (m).
    ///     active: `[count]`, booleans: which simulations to step. The default is all.
    ///
    /// Raises:
    ///     ValueError: the shape is wrong, or a value is not finite.
    ///     TypeError: the setpoints are not numbers, or `active` has other values than booleans.
    #[pyo3(signature = (setpoints, active=None))]
    fn step(&self, py: Python, setpoints: &Bound<PyAny>, active: Option<Vec<bool>>) -> PyResult<()> {
        let elements = self.layout().action().len();
        let values: Vec<f64> = read("setpoints", setpoints, &[self.count, elements])?;
        let setpoints: Vec<Vec<f64>> = values.chunks_exact(elements).map(<[f64]>::to_vec).collect();
        let active = active.unwrap_or_else(|| vec![true; self.count]);
        self.work(py, |batch| batch.step(&setpoints, &active))
    }

    /// Simulates until the next sample, with the setpoints of the episode, as in a dataset.
    fn follow(&self, py: Python) -> PyResult<()> {
        self.work(py, Batch::follow)
    }

    /// Returns the values of a modality at the present samples.
    ///
    /// Args:
    ///     modality: one of `modalities`.
    ///
    /// Returns:
    ///     A vector `[count, elements]`, float32, or an image `[count, rows, columns, 3]`, uint8.
    ///
    /// Raises:
    ///     KeyError: the world does not have the modality.
    fn sense<'py>(&self, py: Python<'py>, modality: &str) -> PyResult<Bound<'py, PyAny>> {
        let found = Modality::new(modality).filter(|found| self.sensed().contains(&found.name()));
        let found = found.ok_or_else(|| {
            let allowed = self.sensed().join(", ");
            PyKeyError::new_err(format!("modality: '{modality}' is not sensed; allowed: {allowed}"))
        })?;
        let definition = &self.layout()[found];
        let width = definition.width();
        match definition.size() {
            None => self.gather(py, width, |live| live.vector(found).unwrap_or_default()),
            Some([rows, columns]) => {
                let mut frames = vec![0u8; self.count * width];
                self.work(py, |batch| batch.image(found, &mut frames))?;
                array(py, frames, &[self.count, rows, columns, IMAGE_CHANNELS])
            }
        }
    }

    /// Renders a picture of one simulation, in better quality than the images of datasets.
    ///
    /// Args:
    ///     index: the simulation, from 0.
    ///     width: number of columns, 1 to 4096 pixels.
    ///     height: number of rows, 1 to 4096 pixels.
    ///
    /// Returns:
    ///     The picture, `[height, width, 3]`, uint8.
    ///
    /// Raises:
    ///     ValueError: an argument is out of range.
    fn render<'py>(
        &self,
        py: Python<'py>,
        index: i64,
        width: i64,
        height: i64,
    ) -> PyResult<Bound<'py, PyAny>> {
        let index: usize = natural("index", index)?;
        let (width, height) = (natural("width", width)?, natural("height", height)?);
        if index >= self.count {
            let message = format!("index: the batch has simulations 0 to {}, not {index}", self.count - 1);
            return Err(PyValueError::new_err(message));
        }
        let held = self.lock()?;
        let simulation = &held.batch.simulations()[index];
        // On this thread, because its OpenGL context is used again for the next picture.
        let picture = py.detach(|| simulation.render(width, height)).map_err(Raise::raise)?;
        let shape = [picture.height() as usize, picture.width() as usize, IMAGE_CHANNELS];
        array(py, picture.into_raw(), &shape)
    }

    /// Name of the world.
    #[getter]
    fn scenario(&self) -> &'static str {
        self.scene.scenario().name()
    }

    /// The modalities that can be sensed: the shape of one simulation's values, by name.
    #[getter]
    fn modalities<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let shapes = PyDict::new(py);
        for name in self.sensed() {
            let definition = Modality::new(name).and_then(|modality| self.layout().get(modality));
            shapes.set_item(name, PyTuple::new(py, definition.map(shape).unwrap_or_default())?)?;
        }
        Ok(shapes)
    }

    /// Names of the elements of a setpoint, such as `rotation`.
    #[getter]
    fn action(&self) -> Vec<String> {
        self.layout().action().iter().map(|element| element.name.clone()).collect()
    }

    /// Number of simulations.
    #[getter]
    fn count(&self) -> usize {
        self.count
    }

    /// Seed of the episodes' random streams. It is that of the dataset or, for the episodes of a test, a larger one.
    #[getter]
    fn seed(&self) -> u64 {
        self.spec.stream()
    }

    /// Time from one sample to the next, s.
    #[getter]
    fn sample_seconds(&self) -> f64 {
        1.0 / self.spec.sample_rate_hz
    }

    /// Duration of one move of the setpoint in the episodes of datasets, s.
    #[getter]
    fn actuation_seconds(&self) -> f64 {
        self.spec.actuation_seconds
    }

    /// Lowest and highest value of each element of a setpoint, `[elements, 2]`, in rad or m.
    #[getter]
    fn setpoint_ranges<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let ranges = self.lock()?.batch.simulations()[0].setpoint_ranges();
        let count = ranges.len();
        array(py, ranges.into_iter().flatten().collect(), &[count, 2])
    }

    /// The setpoints at the present samples, `[count, elements]`, in rad or m.
    #[getter]
    fn setpoint<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.gather(py, self.layout().action().len(), |live| live.setpoint().to_vec())
    }

    /// Positions of the finger's end, `[count, 3]`, m. Raises ValueError for a world without a finger.
    #[getter]
    fn fingertip<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        if self.lock()?.batch.simulations()[0].fingertip().is_none() {
            return Err(PyValueError::new_err("the world senses no forces of links, so it has no fingertip"));
        }
        self.gather(py, 3, |live| live.fingertip().unwrap_or_default().to_vec())
    }

    /// Poses of the boxes, `[count, boxes, 7]`: position (m) and orientation (unit quaternion w, x, y, z).
    #[getter]
    fn boxes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let places = |live: &LiveSimulation| live.boxes().flatten().collect::<Vec<f64>>();
        let values: Vec<f64> = self.lock()?.batch.simulations().iter().flat_map(places).collect();
        let boxes = values.len() / POSE / self.count;
        array(py, values, &[self.count, boxes, POSE])
    }
}
