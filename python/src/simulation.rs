//! The Python class `SimulationBatch`: one live simulation or many.

use crate::array::{Item, array, read};
use crate::errors::Raise;
use crate::work::belongs_here;
use harness::simulation::{Batch, LiveSimulation, Pose, Scene, SimulationError};
use harness::spec::{self, IMAGE_CHANNELS, Layout, Modality, Simulation, World};
use pyo3::exceptions::{PyKeyError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, TryLockError};

/// `count` independent simulations of a world, stepped in parallel.
///
/// scenario: a built-in world's name (`empty`, `cluttered`) or the path of a world file. spec: an experiment's YAML
/// file, whose simulation settings are used; the world's defaults without one.
///
/// Each simulation is at a sample of an episode. It senses the same values that a dataset records. With a dataset's
/// settings, `follow` gives the samples of the dataset's episode bit for bit; `Dataset.simulation` uses these settings.
///
/// A call raises RuntimeError while a call in another thread is running, and in a forked process. A simulation that has
/// become unstable raises RuntimeError until it is reset.
#[pyclass(frozen)]
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
    fn new(py: Python, scenario: &str, count: usize, spec: Option<PathBuf>) -> PyResult<Self> {
        let scene = scene(scenario)?;
        let settings = match spec {
            Some(path) => {
                scene.world().complete(&spec::load(&path, &[], false).map_err(Raise::raise)?.simulation)
            }
            None => scene.world().simulation(),
        };
        Self::start(py, scene, settings, count)
    }

    fn __repr__(&self) -> String {
        format!("<harness.SimulationBatch {}: {} simulations>", self.scenario(), self.count)
    }

    /// Sets a simulation to the start of the episode with this index in the dataset with this seed.
    fn reset(&self, py: Python, index: usize, seed: u64, episode: u32) -> PyResult<()> {
        if seed > spec::MAX_SEED {
            return Err(PyValueError::new_err(format!("seed: {seed} is above {}", spec::MAX_SEED)));
        }
        self.work(py, |batch| batch.reset(index, seed, episode))
    }

    /// Steps each simulation to its next sample, while the setpoint moves at constant speed to `setpoints[index]`.
    ///
    /// setpoints: `[count, elements]`, clipped to `setpoint_ranges`; for the finger rotation (rad), lift and extension
    /// (m). active: `[count]`, the simulations to step; all by default. Raises ValueError for the wrong shape or a
    /// value that is not finite.
    #[pyo3(signature = (setpoints, active=None))]
    fn step(&self, py: Python, setpoints: &Bound<PyAny>, active: Option<Vec<bool>>) -> PyResult<()> {
        let elements = self.layout().action().len();
        let values: Vec<f64> = read("setpoints", setpoints, &[self.count, elements])?;
        let setpoints: Vec<Vec<f64>> = values.chunks_exact(elements).map(<[f64]>::to_vec).collect();
        let active = active.unwrap_or_else(|| vec![true; self.count]);
        self.work(py, |batch| batch.step(&setpoints, &active))
    }

    /// Steps each simulation to its next sample, with the setpoints of its episode.
    fn follow(&self, py: Python) -> PyResult<()> {
        self.work(py, Batch::follow)
    }

    /// Values of one of `modalities`: a vector `[count, elements]`, float32, or an image
    /// `[count, rows, columns, 3]`, uint8. Raises KeyError for another modality.
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

    /// Renders a simulation in good quality, `[height, width, 3]`, each side 1 to 4096 pixels.
    fn render<'py>(
        &self,
        py: Python<'py>,
        index: usize,
        width: u32,
        height: u32,
    ) -> PyResult<Bound<'py, PyAny>> {
        if index >= self.count {
            let message = format!("index: there are {} simulations, so not {index}", self.count);
            return Err(PyValueError::new_err(message));
        }
        let held = self.lock()?;
        let simulation = &held.batch.simulations()[index];
        // On this thread, because its OpenGL context is used again for the next picture.
        let picture = py.detach(|| simulation.render(width, height)).map_err(Raise::raise)?;
        array(py, picture.into_raw(), &[height as usize, width as usize, IMAGE_CHANNELS])
    }

    /// The world's name.
    #[getter]
    fn scenario(&self) -> &'static str {
        self.scene.scenario().name()
    }

    /// Names of the modalities that are sensed, with the shape of one simulation's values.
    #[getter]
    fn modalities<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let shapes = PyDict::new(py);
        for name in self.sensed() {
            let definition = Modality::new(name).and_then(|modality| self.layout().get(modality));
            let shape = definition.map(|definition| match definition.size() {
                Some([rows, columns]) => vec![rows, columns, IMAGE_CHANNELS],
                None => vec![definition.width()],
            });
            shapes.set_item(name, PyTuple::new(py, shape.unwrap_or_default())?)?;
        }
        Ok(shapes)
    }

    /// Names of the elements of the action.
    #[getter]
    fn action(&self) -> Vec<String> {
        self.layout().action().iter().map(|element| element.name.clone()).collect()
    }

    /// Number of simulations.
    #[getter]
    fn count(&self) -> usize {
        self.count
    }

    /// The seed of the spec's dataset.
    #[getter]
    fn seed(&self) -> u64 {
        self.spec.seed
    }

    /// Time from one sample to the next, s.
    #[getter]
    fn sample_seconds(&self) -> f64 {
        1.0 / self.spec.sample_rate_hz
    }

    /// Duration of a move from one setpoint to the next in a dataset's episode, s.
    #[getter]
    fn actuation_seconds(&self) -> f64 {
        self.spec.actuation_seconds
    }

    /// Lowest and highest setpoint of each element of the action, `[elements, 2]`.
    #[getter]
    fn setpoint_ranges<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let ranges = self.lock()?.batch.simulations()[0].setpoint_ranges();
        let count = ranges.len();
        array(py, ranges.into_iter().flatten().collect(), &[count, 2])
    }

    /// The setpoints at this sample, `[count, elements]`.
    #[getter]
    fn setpoint<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.gather(py, self.layout().action().len(), |live| live.setpoint().to_vec())
    }

    /// Positions of the finger's end, m, `[count, 3]`. Raises ValueError if the world senses no forces of links.
    #[getter]
    fn fingertip<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        if self.lock()?.batch.simulations()[0].fingertip().is_none() {
            return Err(PyValueError::new_err("the world senses no forces of links, so it has no fingertip"));
        }
        self.gather(py, 3, |live| live.fingertip().unwrap_or_default().to_vec())
    }

    /// Positions (m) and orientations (unit quaternions w, x, y, z) of the boxes, `[count, boxes, 7]`.
    #[getter]
    fn boxes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let places = |live: &LiveSimulation| live.boxes().flatten().collect::<Vec<f64>>();
        let values: Vec<f64> = self.lock()?.batch.simulations().iter().flat_map(places).collect();
        let boxes = values.len() / POSE / self.count;
        array(py, values, &[self.count, boxes, POSE])
    }
}
