//! The Python class `Dataset`: a dataset's samples as NumPy arrays.

use crate::array::{array, natural, pixels_last, view};
use crate::errors::Raise;
use crate::simulation::{SimulationBatch, scene};
use crate::work::interruptible;
use harness::dataset::{AnyDataset, DatasetError};
use harness::progress::Silent;
use harness::samples::{FramePlace, Samples};
use harness::spec::{Division, IMAGE_CHANNELS, Modality, Split, Window, World};
use pyo3::exceptions::{PyFileNotFoundError, PyKeyError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyType;
use std::path::PathBuf;

/// The compiled part of `harness.Dataset`.
#[pyclass(frozen, subclass, module = "harness._harness")]
pub struct Dataset {
    samples: Samples,
    /// The dataset from which the samples were read.
    described: AnyDataset,
    /// The absolute path of the folder.
    folder: PathBuf,
    frames: bool,
}

/// Reads a dataset's samples. Frames are read if `frames` is true and the dataset has any. They stay on disk if they
/// would take more than an eighth of the free memory.
fn load(dataset: &AnyDataset, frames: bool) -> Result<Samples, DatasetError> {
    let layout = dataset.layout();
    let place = match frames && layout.stored_images().next().is_some() {
        true => FramePlace::for_samples(layout, dataset.samples(), None),
        false => FramePlace::Nowhere,
    };
    dataset.load(place, &Silent)
}

#[pymethods]
impl Dataset {
    #[new]
    #[pyo3(signature = (folder, frames=true))]
    fn new(py: Python, folder: PathBuf, frames: bool) -> PyResult<Self> {
        if !folder.join("dataset.json").is_file() {
            let message = format!(
                "there is no dataset at {}: a dataset is a folder with a dataset.json, as in results/datasets; \
                 `harness collect SPEC` makes those of an experiment",
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
        Ok(Self { samples, described, folder: std::path::absolute(&folder).unwrap_or(folder), frames })
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

    /// Name of the folder: the scenario, and a hash of everything that determines the dataset.
    #[getter]
    fn name(&self) -> &str {
        self.described.name()
    }

    /// Name of the world that was simulated, such as `empty`, or name of an imported dataset.
    #[getter]
    fn scenario(&self) -> &str {
        match &self.described {
            AnyDataset::Simulated(dataset) => dataset.scenario().name(),
            AnyDataset::Imported(dataset) => dataset.name(),
        }
    }

    /// Number of samples per second.
    #[getter]
    fn sample_rate_hz(&self) -> f64 {
        self.described.sample_rate_hz()
    }

    /// Seed of the simulation; None for an imported dataset. The seed and an index determine an episode.
    #[getter]
    fn seed(&self) -> Option<u64> {
        match &self.described {
            AnyDataset::Simulated(dataset) => Some(dataset.spec().seed),
            AnyDataset::Imported(_) => None,
        }
    }

    /// The samples of each episode, `[episodes, 2]`: the index of the first one, and of the last one plus 1.
    #[getter]
    fn bounds<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let episodes = self.samples.episodes();
        let bounds = episodes.iter().flat_map(|range| [range.start as i64, range.end as i64]);
        array(py, bounds.collect(), &[episodes.len(), 2])
    }

    /// Creates simulations with the settings of the dataset. With `reset` and `follow` they go through its episodes.
    ///
    /// Args:
    ///     count: number of simulations, 1 to 4096.
    ///
    /// Raises:
    ///     ValueError: the dataset was imported or simulated in a world file, or the count is out of range.
    ///
    /// Example:
    ///     >>> model = harness.load_model("smoke/empty-z4")
    ///     >>> data = harness.Dataset(f"results/datasets/{model.dataset}")
    ///     >>> simulation = data.simulation()
    ///     >>> simulation.reset(0, data.seed, 3)                # the start of episode 3
    ///     >>> simulation.follow()
    ///     >>> bool((simulation.sense("arm")[0] == data.episode(3)["arm"][1]).all())
    ///     True
    #[pyo3(signature = (count=1))]
    fn simulation(&self, py: Python, count: i64) -> PyResult<SimulationBatch> {
        let count = natural("count", count)?;
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

    /// Returns the samples from which the transitions of a part start.
    ///
    /// A transition leads from a sample to the next one of the same episode. The arguments and defaults are those of a
    /// spec's `split`, so the parts are those that a network is trained and tested on.
    ///
    /// Args:
    ///     part: `training`, `validation` or `test`.
    ///     by: what is divided: `episode` (whole episodes), `time` (each episode, with gaps between the parts) or
    ///         `sample` (transitions, at random).
    ///     validation: the share for validation, in (0, 1).
    ///     test: the share for the test, in (0, 1).
    ///     gap_seconds: the time between the parts of a split by time, s, in [0, 3600]. The default is 5.
    ///
    /// Returns:
    ///     The indices of the samples, `[transitions]`, int64.
    ///
    /// Raises:
    ///     ValueError: an argument is wrong, or a part would have no transitions.
    #[pyo3(signature = (part, *, by="episode", validation=0.1, test=0.1, gap_seconds=None))]
    fn split<'py>(
        &self,
        py: Python<'py>,
        part: &str,
        by: &str,
        validation: f64,
        test: f64,
        gap_seconds: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let wrong = |message: String| Err(PyValueError::new_err(message));
        let Some(by) = Division::ALL.iter().copied().find(|division| division.name() == by) else {
            return wrong(format!("by: there is no '{by}'; allowed: episode, time, sample"));
        };
        for (name, share) in [("validation", validation), ("test", test)] {
            if share <= 0.0 || share >= 1.0 || share.is_nan() {
                return wrong(format!("{name}: {share} must be in (0, 1)"));
            }
        }
        if let Some(gap) = gap_seconds.filter(|gap| !(0.0..=3600.0).contains(gap)) {
            return wrong(format!("gap_seconds: {gap} must be in [0, 3600]"));
        }
        let split = Split { by, validation, test: test.into(), gap_seconds, ..Split::default() };
        let Some(partition) = self.samples.partition(&split, &Window::TRANSITION) else {
            let episodes = self.samples.episodes().len();
            return wrong(format!(
                "validation, test, gap_seconds: a part would have no transitions; the dataset has {episodes} episodes"
            ));
        };
        let samples = match part {
            "training" => partition.training,
            "validation" => partition.validation,
            "test" => partition.test,
            _ => return wrong(format!("part: there is no '{part}'; allowed: training, validation, test")),
        };
        array(py, samples.iter().map(|sample| sample.index() as i64).collect(), &[samples.len()])
    }

    /// Returns the names of the modalities that the dataset contains.
    fn keys(&self) -> Vec<&'static str> {
        let layout = self.samples.layout();
        let frames = layout.stored_images().filter(|_| self.samples.has_frames());
        let names = layout.stored_vectors().map(|definition| definition.name);
        let has_setpoint = layout.get(Modality::SETPOINT).is_some();
        let setpoint = has_setpoint.then_some(Modality::SETPOINT);
        let vectors = names.filter(|name| *name != Modality::SETPOINT).chain(setpoint);
        vectors.chain(frames.map(|definition| definition.name)).map(Modality::name).collect()
    }

    fn __getitem__<'py>(slf: &Bound<'py, Self>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        let samples = &slf.get().samples;
        let modality = Modality::new(name).filter(|found| slf.get().keys().contains(&found.name()));
        let Some(modality) = modality else {
            let all = slf.get().keys().join(", ");
            return Err(PyKeyError::new_err(format!("the dataset has no '{name}' in memory; it has {all}")));
        };
        modality_array(slf, samples, modality)
    }
}

/// Returns all samples of a modality that the layout has as a read-only array, `[samples, width]` or
/// `[samples, rows, columns, 3]`. `owner` must own the samples and never change them. The change of an image has the
/// values of the image.
pub fn modality_array<'py, O>(
    owner: &Bound<'py, O>,
    samples: &Samples,
    modality: Modality,
) -> PyResult<Bound<'py, PyAny>> {
    let definition = &samples.layout()[modality];
    match definition.size() {
        Some([rows, columns]) => {
            let shape = [samples.len(), IMAGE_CHANNELS, rows, columns];
            // SAFETY: the owner never changes the samples, and the array owns a reference to it.
            pixels_last(unsafe { view(owner, samples.image(modality), &shape) }?)
        }
        // SAFETY: as above.
        None => unsafe { view(owner, samples.vectors(modality), &[samples.len(), definition.width()]) },
    }
}
