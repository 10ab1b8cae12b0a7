//! Datasets as arrays.

use crate::array::{array, pixels_last, view};
use crate::errors::Raise;
use crate::simulation::SimulationBatch;
use crate::work::interruptible;
use harness::dataset::{self, DatasetError, FramePlace, Imported, Samples};
use harness::progress::Silent;
use harness::spec::{ARM_JOINTS, FRAME_CHANNELS, FRAME_SIDE, Modality, Origin};
use pyo3::exceptions::{PyFileNotFoundError, PyKeyError, PyValueError};
use pyo3::prelude::*;
use std::path::{Path, PathBuf};

/// A dataset in memory; see `_harness.pyi`.
#[pyclass(frozen, subclass)]
pub struct Dataset {
    samples: Samples,
    described: Described,
}

/// Where the samples come from.
enum Described {
    Simulated(dataset::Dataset),
    Imported(Imported),
}

impl Described {
    /// The dataset that a folder holds: its name tells which kind it is.
    fn at(folder: &Path) -> Result<Self, DatasetError> {
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match (Origin::try_from(name), folder.parent()) {
            (Ok(Origin::Imported(name)), Some(root)) => Imported::open(root, &name).map(Self::Imported),
            _ => dataset::Dataset::at(folder).map(Self::Simulated),
        }
    }

    /// Reads it, with the frames if asked and if it has any; they stay on disk if they would take much memory.
    fn load(&self, frames: bool) -> Result<Samples, DatasetError> {
        let place = |samples| match frames && self.holds(Modality::Vision) {
            true => FramePlace::for_samples(samples, None),
            false => FramePlace::Nowhere,
        };
        match self {
            Self::Simulated(dataset) => dataset.load(place(dataset.len()), &Silent),
            Self::Imported(dataset) => dataset.load(place(dataset.len()), &Silent),
        }
    }

    fn holds(&self, modality: Modality) -> bool {
        match self {
            Self::Simulated(_) => true,
            Self::Imported(dataset) => dataset.holds(modality),
        }
    }
}

#[pymethods]
impl Dataset {
    #[new]
    #[pyo3(signature = (folder, frames=true))]
    fn new(py: Python, folder: PathBuf, frames: bool) -> PyResult<Self> {
        if !folder.is_dir() {
            let message = format!(
                "there is no dataset at {}; `harness collect SPEC` makes those of an experiment",
                folder.display()
            );
            return Err(PyFileNotFoundError::new_err(message));
        }
        let read = || {
            let described = Described::at(&folder)?;
            Ok(Self { samples: described.load(frames)?, described })
        };
        interruptible(py, read, || ())?.map_err(|error: DatasetError| error.raise())
    }

    fn __len__(&self) -> usize {
        self.samples.len()
    }

    #[getter]
    fn name(&self) -> &str {
        match &self.described {
            Described::Simulated(dataset) => dataset.name(),
            Described::Imported(dataset) => dataset.name(),
        }
    }

    #[getter]
    fn scenario(&self) -> &str {
        match &self.described {
            Described::Simulated(dataset) => dataset.scenario().name(),
            Described::Imported(dataset) => dataset.name(),
        }
    }

    #[getter]
    fn sample_rate_hz(&self) -> f64 {
        match &self.described {
            Described::Simulated(dataset) => dataset.spec().sample_rate_hz,
            Described::Imported(dataset) => dataset.sample_rate_hz(),
        }
    }

    #[getter]
    fn seed(&self) -> Option<u64> {
        match &self.described {
            Described::Simulated(dataset) => Some(dataset.spec().seed),
            Described::Imported(_) => None,
        }
    }

    #[getter]
    fn episodes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let episodes = self.samples.episodes();
        let bounds = episodes.iter().flat_map(|range| [range.start as i64, range.end as i64]);
        array(py, bounds.collect(), &[episodes.len(), 2])
    }

    #[pyo3(signature = (count=1))]
    fn simulation(&self, py: Python, count: usize) -> PyResult<SimulationBatch> {
        match &self.described {
            Described::Simulated(dataset) => {
                SimulationBatch::start(py, dataset.scenario(), dataset.spec().clone(), count)
            }
            Described::Imported(dataset) => {
                Err(PyValueError::new_err(format!("{} was imported, not simulated", dataset.name())))
            }
        }
    }

    fn keys(&self) -> Vec<&'static str> {
        let frames = self.samples.has_frames().then_some("vision");
        let held = VECTORS.iter().filter(|(_, modality)| self.described.holds(*modality));
        held.map(|(name, _)| *name).chain(["setpoint"]).chain(frames).collect()
    }

    fn __getitem__<'py>(slf: &Bound<'py, Self>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        let samples = &slf.get().samples;
        // SAFETY (of both views): a dataset never changes, and the array holds it.
        if name == "vision" && samples.has_frames() {
            let shape = [samples.len(), FRAME_CHANNELS, FRAME_SIDE, FRAME_SIDE];
            return pixels_last(unsafe { view(slf, samples.frames(), &shape) }?);
        }
        let held = |modality| slf.get().described.holds(modality);
        let vectors = VECTORS.iter().find(|(other, modality)| *other == name && held(*modality));
        let (values, width) = match vectors {
            Some((_, modality)) => (samples.vectors(*modality), modality.width()),
            None if name == "setpoint" => (samples.setpoints(), ARM_JOINTS),
            None => {
                let all = slf.get().keys().join(", ");
                return Err(PyKeyError::new_err(format!(
                    "the dataset has no '{name}' in memory; it has {all}"
                )));
            }
        };
        unsafe { view(slf, values, &[samples.len(), width]) }
    }
}

/// What a dataset records, frames and setpoints apart.
const VECTORS: [(&str, Modality); 4] = [
    ("proprioception", Modality::Proprioception),
    ("arm", Modality::Arm),
    ("contact_force", Modality::ContactForce),
    ("contact_force_mean", Modality::ContactForceMean),
];
