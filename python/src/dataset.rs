//! The Python class `Dataset`: a dataset's samples as NumPy arrays.

use crate::array::{array, pixels_last, view};
use crate::errors::Raise;
use crate::simulation::{SimulationBatch, scene};
use crate::work::interruptible;
use harness::dataset::{AnyDataset, DatasetError, FramePlace, Samples};
use harness::progress::Silent;
use harness::spec::{Division, IMAGE_CHANNELS, Modality, Split, World};
use pyo3::exceptions::{PyFileNotFoundError, PyKeyError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyType;
use std::path::PathBuf;

/// A dataset in memory; see `_harness.pyi`.
#[pyclass(frozen, subclass)]
pub struct Dataset {
    samples: Samples,
    /// The dataset from which the samples were read.
    described: AnyDataset,
    folder: PathBuf,
    frames: bool,
}

/// Reads a dataset's samples. Frames are read if `frames` is true and the dataset has any. They stay on disk if they
/// would take more than an eighth of the free memory.
fn load(dataset: &AnyDataset, frames: bool) -> Result<Samples, DatasetError> {
    let layout = dataset.layout();
    let place = match frames && layout.stored_images().next().is_some() {
        true => FramePlace::for_samples(layout, dataset.len(), None),
        false => FramePlace::Nowhere,
    };
    dataset.load(place, &Silent)
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
            let described = AnyDataset::at(&folder)?;
            Ok((load(&described, frames)?, described))
        };
        let read = interruptible(py, read, || ())?;
        let (samples, described) = read.map_err(|error: DatasetError| error.raise())?;
        Ok(Self { samples, described, folder, frames })
    }

    fn __len__(&self) -> usize {
        self.samples.len()
    }

    fn __repr__(&self) -> String {
        let (samples, episodes) = (self.samples.len(), self.samples.episodes().len());
        format!("<harness.Dataset {}: {samples} samples in {episodes} episodes>", self.name())
    }

    /// Pickles the folder, from which the dataset is read again.
    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> (Bound<'py, PyType>, (PathBuf, bool)) {
        (slf.get_type(), (slf.get().folder.clone(), slf.get().frames))
    }

    /// The folder's name: the scenario, or an imported dataset's own name, and a hash of all that determines it.
    #[getter]
    fn name(&self) -> &str {
        self.described.name()
    }

    /// `empty`, `cluttered`, or the name of an imported dataset.
    #[getter]
    fn scenario(&self) -> &str {
        match &self.described {
            AnyDataset::Simulated(dataset) => dataset.scenario().name(),
            AnyDataset::Imported(dataset) => dataset.name(),
        }
    }

    /// Samples per second.
    #[getter]
    fn sample_rate_hz(&self) -> f64 {
        self.described.sample_rate_hz()
    }

    /// Seed of the dataset. With the scenario and an episode's index it determines the episode. None if imported.
    #[getter]
    fn seed(&self) -> Option<u64> {
        match &self.described {
            AnyDataset::Simulated(dataset) => Some(dataset.spec().seed),
            AnyDataset::Imported(_) => None,
        }
    }

    /// Range of each episode's samples, `[episodes, 2]`: the first, and one past the last.
    #[getter]
    fn episodes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let episodes = self.samples.episodes();
        let bounds = episodes.iter().flat_map(|range| [range.start as i64, range.end as i64]);
        array(py, bounds.collect(), &[episodes.len(), 2])
    }

    /// Simulations of the same scenario with the dataset's settings, so that its episodes can be followed.
    ///
    /// Raises ValueError if the dataset was imported.
    #[pyo3(signature = (count=1))]
    fn simulation(&self, py: Python, count: usize) -> PyResult<SimulationBatch> {
        match &self.described {
            AnyDataset::Simulated(dataset) => {
                let name = dataset.scenario().name();
                if World::named(name).is_none() {
                    return Err(PyValueError::new_err(format!(
                        "{} was simulated in a world file; give harness.SimulationBatch its path, {name}.yaml",
                        dataset.name()
                    )));
                }
                SimulationBatch::start(py, scene(name)?, dataset.spec().clone(), count)
            }
            AnyDataset::Imported(dataset) => {
                Err(PyValueError::new_err(format!("{} was imported, not simulated", dataset.name())))
            }
        }
    }

    /// First samples of the transitions for training, validation and test; see `harness.Dataset.split`.
    fn parts<'py>(
        &self,
        py: Python<'py>,
        by: &str,
        validation: f64,
        test: f64,
        gap_seconds: Option<f64>,
    ) -> PyResult<[Bound<'py, PyAny>; 3]> {
        let Some(by) = Division::ALL.iter().copied().find(|division| division.name() == by) else {
            let message = format!("by: there is no '{by}'; allowed: episode, time, sample");
            return Err(PyValueError::new_err(message));
        };
        let split = Split { by, validation, test, gap_seconds };
        let Some(partition) = self.samples.partition(&split) else {
            return Err(PyValueError::new_err("the split leaves a part without transitions"));
        };
        let indices = |samples: Vec<usize>| {
            let (len, samples) = (samples.len(), samples.into_iter().map(|sample| sample as i64));
            array(py, samples.collect(), &[len])
        };
        Ok([indices(partition.training)?, indices(partition.validation)?, indices(partition.test)?])
    }

    /// Names of the modalities that the dataset contains; an imported one may lack some.
    fn keys(&self) -> Vec<&'static str> {
        let layout = self.samples.layout();
        let frames = layout.stored_images().filter(|_| self.samples.has_frames());
        let names = layout.stored_vectors().map(|definition| definition.name);
        let vectors = names.filter(|name| *name != Modality::SETPOINT).chain([Modality::SETPOINT]);
        vectors.chain(frames.map(|definition| definition.name)).map(Modality::name).collect()
    }

    fn __getitem__<'py>(slf: &Bound<'py, Self>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        let samples = &slf.get().samples;
        let modality = Modality::new(name).filter(|found| slf.get().keys().contains(&found.name()));
        let Some(modality) = modality else {
            let all = slf.get().keys().join(", ");
            return Err(PyKeyError::new_err(format!("the dataset has no '{name}' in memory; it has {all}")));
        };
        let definition = &samples.layout()[modality];
        match definition.size() {
            Some([rows, columns]) => {
                let shape = [samples.len(), IMAGE_CHANNELS, rows, columns];
                // SAFETY: a dataset never changes, and the array owns a reference to it.
                pixels_last(unsafe { view(slf, samples.image(modality), &shape) }?)
            }
            // SAFETY: as above.
            None => unsafe { view(slf, samples.vectors(modality), &[samples.len(), definition.width()]) },
        }
    }
}
