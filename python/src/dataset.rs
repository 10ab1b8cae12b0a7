//! Datasets as arrays.

use crate::array::{array, pixels_last, view};
use crate::errors::Raise;
use crate::work::interruptible;
use harness::dataset::{self, Samples};
use harness::spec::{ARM_JOINTS, FRAME_CHANNELS, FRAME_SIDE, Modality};
use pyo3::exceptions::{PyFileNotFoundError, PyKeyError};
use pyo3::prelude::*;
use std::path::PathBuf;

/// A dataset in memory; see `_harness.pyi`.
#[pyclass(frozen, subclass)]
pub struct Dataset {
    samples: Samples,
    described: dataset::Dataset,
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
            let described = dataset::Dataset::at(&folder)?;
            Ok(Self { samples: described.load(frames)?, described })
        };
        interruptible(py, read, || ())?.map_err(|error: dataset::DatasetError| error.raise())
    }

    fn __len__(&self) -> usize {
        self.samples.len()
    }

    #[getter]
    fn name(&self) -> &str {
        self.described.name()
    }

    #[getter]
    fn scenario(&self) -> &'static str {
        self.described.scenario().name()
    }

    #[getter]
    fn sample_rate_hz(&self) -> f64 {
        self.described.spec().sample_rate_hz
    }

    #[getter]
    fn seed(&self) -> u64 {
        self.described.spec().seed
    }

    #[getter]
    fn episodes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let episodes = self.samples.episodes();
        let bounds = episodes.iter().flat_map(|range| [range.start as i64, range.end as i64]);
        array(py, bounds.collect(), &[episodes.len(), 2])
    }

    fn keys(&self) -> Vec<&'static str> {
        let frames = self.samples.has_frames().then_some("vision");
        VECTORS.map(|(name, _)| name).into_iter().chain(["setpoint"]).chain(frames).collect()
    }

    fn __getitem__<'py>(slf: &Bound<'py, Self>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        let samples = &slf.get().samples;
        // SAFETY (of both views): a dataset never changes, and the array holds it.
        if name == "vision" && samples.has_frames() {
            let shape = [samples.len(), FRAME_CHANNELS, FRAME_SIDE, FRAME_SIDE];
            return pixels_last(unsafe { view(slf, samples.frames(), &shape) }?);
        }
        let vectors = VECTORS.iter().find(|(other, _)| *other == name);
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
