//! Live simulations, one or many, as arrays.

use crate::array::{Item, array, read};
use crate::errors::Raise;
use crate::work::belongs_here;
use harness::simulation::{Batch, LiveSimulation, Pose, SimulationError};
use harness::spec::{
    self, ARM_JOINTS, FRAME_CHANNELS, FRAME_LEN, FRAME_SIDE, Modality, Scenario, Simulation,
};
use pyo3::exceptions::{PyKeyError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, TryLockError};

/// Simulations of one scenario, stepped in parallel; see `_harness.pyi`.
#[pyclass(frozen)]
pub struct SimulationBatch {
    work: Mutex<Work>,
    spec: Simulation,
    scenario: Scenario,
    count: usize,
    /// The process that made it: a fork has neither its threads nor its OpenGL contexts.
    process: u32,
}

/// The simulations, and the threads that step them; one alone is stepped by its caller.
struct Work {
    batch: Batch,
    threads: Option<rayon::ThreadPool>,
}

/// Values of a box's pose.
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
    /// `count` simulations with these settings.
    pub fn start(py: Python, scenario: Scenario, spec: Simulation, count: usize) -> PyResult<Self> {
        let batch = py.detach(|| Batch::new(scenario, &spec, count)).map_err(Raise::raise)?;
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads =
            (count > 1).then(|| rayon::ThreadPoolBuilder::new().num_threads(cores.min(count)).build());
        let threads = threads.transpose().map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
        let work = Mutex::new(Work { batch, threads });
        Ok(Self { work, spec, scenario, count, process: std::process::id() })
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

    /// Works on the simulations without the interpreter's lock.
    fn work<T: Send>(
        &self,
        py: Python,
        work: impl FnOnce(&mut Batch) -> Result<T, SimulationError> + Send,
    ) -> PyResult<T> {
        let mut held = self.lock()?;
        let held = &mut *held;
        py.detach(|| held.on_its_threads(work)).map_err(Raise::raise)
    }

    /// Values of each simulation side by side, `[count, N]`.
    fn gather<'py, T: Item, const N: usize>(
        &self,
        py: Python<'py>,
        of: impl Fn(&LiveSimulation) -> [T; N],
    ) -> PyResult<Bound<'py, PyAny>> {
        let values = self.lock()?.batch.simulations().iter().flat_map(of).collect();
        array(py, values, &[self.count, N])
    }

    fn vision<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let mut frames = vec![0u8; self.count * FRAME_LEN];
        self.work(py, |batch| batch.vision(&mut frames))?;
        array(py, frames, &[self.count, FRAME_SIDE, FRAME_SIDE, FRAME_CHANNELS])
    }
}

/// The scenario of that name.
pub fn scenario(name: &str) -> PyResult<Scenario> {
    Scenario::ALL.iter().copied().find(|scenario| scenario.name() == name).ok_or_else(|| {
        let all = Scenario::ALL.iter().map(|scenario| scenario.name()).collect::<Vec<_>>().join(", ");
        PyValueError::new_err(format!("scenario: there is no '{name}'; allowed: {all}"))
    })
}

#[pymethods]
impl SimulationBatch {
    #[new]
    #[pyo3(signature = (scenario, count=1, spec=None))]
    fn new(py: Python, scenario: &str, count: usize, spec: Option<PathBuf>) -> PyResult<Self> {
        let scenario = self::scenario(scenario)?;
        let settings = match spec {
            Some(path) => spec::load(&path, &[], false).map_err(Raise::raise)?.simulation,
            None => Simulation::default(),
        };
        Self::start(py, scenario, settings, count)
    }

    fn reset(&self, py: Python, index: usize, seed: u64, episode: u32) -> PyResult<()> {
        if seed > spec::MAX_SEED {
            return Err(PyValueError::new_err(format!("seed: {seed} is above {}", spec::MAX_SEED)));
        }
        self.work(py, |batch| batch.reset(index, seed, episode))
    }

    #[pyo3(signature = (setpoints, active=None))]
    fn step(&self, py: Python, setpoints: &Bound<PyAny>, active: Option<Vec<bool>>) -> PyResult<()> {
        let values: Vec<f64> = read("setpoints", setpoints, &[self.count, ARM_JOINTS])?;
        let setpoints: Vec<[f64; ARM_JOINTS]> =
            values.chunks_exact(ARM_JOINTS).map(|row| [row[0], row[1], row[2]]).collect();
        let active = active.unwrap_or_else(|| vec![true; self.count]);
        self.work(py, |batch| batch.step(&setpoints, &active))
    }

    fn follow(&self, py: Python) -> PyResult<()> {
        self.work(py, Batch::follow)
    }

    fn sense<'py>(&self, py: Python<'py>, modality: &str) -> PyResult<Bound<'py, PyAny>> {
        let found = Modality::ALL.iter().copied().find(|other| other.name() == modality);
        match found {
            Some(Modality::Proprioception) => self.gather(py, LiveSimulation::proprioception),
            Some(Modality::Arm) => self.gather(py, LiveSimulation::arm),
            Some(Modality::ContactForce) => self.gather(py, LiveSimulation::contact_force),
            Some(Modality::ContactForceMean) => self.gather(py, LiveSimulation::contact_force_mean),
            Some(Modality::Vision) => self.vision(py),
            Some(Modality::FrameDifference) | None => Err(PyKeyError::new_err(format!(
                "modality: '{modality}' is not sensed; allowed: proprioception, arm, contact_force, \
                 contact_force_mean, vision"
            ))),
        }
    }

    fn portrait<'py>(
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
        // On this thread, which keeps its OpenGL context for the next picture.
        let picture = py.detach(|| simulation.portrait(width, height)).map_err(Raise::raise)?;
        array(py, picture.into_raw(), &[height as usize, width as usize, FRAME_CHANNELS])
    }

    #[getter]
    fn scenario(&self) -> &'static str {
        self.scenario.name()
    }

    #[getter]
    fn count(&self) -> usize {
        self.count
    }

    #[getter]
    fn seed(&self) -> u64 {
        self.spec.seed
    }

    #[getter]
    fn sample_seconds(&self) -> f64 {
        1.0 / self.spec.sample_rate_hz
    }

    #[getter]
    fn actuation_seconds(&self) -> f64 {
        self.spec.actuation_seconds
    }

    #[getter]
    fn setpoint_ranges<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let Simulation { rotation_range_rad, lift_range_m, extension_range_m, .. } = self.spec;
        let ranges = [rotation_range_rad, lift_range_m, extension_range_m];
        array(py, ranges.into_iter().flatten().collect(), &[ARM_JOINTS, 2])
    }

    #[getter]
    fn setpoint<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.gather(py, LiveSimulation::setpoint)
    }

    #[getter]
    fn fingertip<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.gather(py, LiveSimulation::fingertip)
    }

    #[getter]
    fn boxes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let places = |live: &LiveSimulation| live.boxes().flatten().collect::<Vec<f64>>();
        let values: Vec<f64> = self.lock()?.batch.simulations().iter().flat_map(places).collect();
        let boxes = values.len() / POSE / self.count;
        array(py, values, &[self.count, boxes, POSE])
    }
}
