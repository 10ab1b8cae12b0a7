//! The Python class `Model`: the trained network of a run; and its files.

use crate::array::{array, as_numbers, pixels_last, read, read_frames, shape_of};
use crate::errors::Raise;
use crate::work::detached;
use harness::experiment::{self, Values, describe};
use harness::files;
use harness::registry::Registry;
use harness::spec::{IMAGE_CHANNELS, Layout, Modality, Task};
use pyo3::exceptions::{PyKeyError, PyOSError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use std::path::PathBuf;

/// The network of a finished run. It computes in physical units on the CPU and never changes.
///
/// Observations are dictionaries by the modalities of `input`: vectors `[batch, width]`; vision `[batch, 64, 64, 3]`,
/// uint8 or numbers in [0, 1]; frame_difference `[batch, 64, 64, 3]`, numbers in [-1, 1]. Arrays of other numeric types
/// and lists are converted to float32. A single sample can be given without the axis of the batch. The answer then has
/// no such axis either.
#[pyclass(frozen, module = "harness")]
pub struct Model {
    model: experiment::Model,
    /// The results folder that contains the run.
    results: PathBuf,
}

#[pymethods]
impl Model {
    #[new]
    fn new(py: Python, run: &str, results: PathBuf) -> PyResult<Self> {
        let registry = Registry::new(&results);
        registry.check_there().map_err(Raise::raise)?;
        let model = detached(py, || experiment::Model::load(&registry, run))?.map_err(Raise::raise)?;
        Ok(Self { model, results })
    }

    fn __repr__(&self) -> String {
        let (input, output) = (self.input().join(", "), self.output().join(", "));
        format!("<harness.Model {}: {input} to {output}, latent {}>", self.id(), self.latent())
    }

    /// Pickles the run's name and folder, from which the model is loaded again.
    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> (Bound<'py, PyType>, (String, PathBuf)) {
        let model = slf.get();
        (slf.get_type(), (model.id(), model.results.clone()))
    }

    /// Id of the run, its folder's name.
    #[getter]
    fn run(&self) -> &str {
        &self.model.record().run
    }

    /// Name of the run's experiment.
    #[getter]
    fn experiment(&self) -> &str {
        &self.model.record().experiment
    }

    /// Name of the dataset that it was trained on, a folder of `results/datasets`.
    #[getter]
    fn dataset(&self) -> &str {
        &self.model.record().dataset
    }

    /// Name of the world, or of the imported dataset.
    #[getter]
    fn scenario(&self) -> &str {
        self.model.record().spec.scenario.name()
    }

    /// The modalities that the encoder takes.
    #[getter]
    fn input(&self) -> Vec<&'static str> {
        self.model.record().spec.input.iter().map(|modality| modality.name()).collect()
    }

    /// The modalities that the decoder predicts.
    #[getter]
    fn output(&self) -> Vec<&'static str> {
        self.model.record().spec.output.iter().map(|modality| modality.name()).collect()
    }

    /// Size of the latent state.
    #[getter]
    fn latent(&self) -> usize {
        self.model.record().spec.latent
    }

    /// `increment` (the setpoint's change from this sample to the next) or `target` (the setpoint at the next).
    #[getter]
    fn action(&self) -> &'static str {
        self.model.record().spec.action.name()
    }

    /// Mean and log-variance of the posterior, `[batch, latent]` each.
    ///
    /// Raises KeyError if a modality of `input` is missing or there is another one, ValueError if one has the wrong
    /// shape, and TypeError if one does not consist of numbers.
    fn encode<'py>(
        &self,
        py: Python<'py>,
        observation: &Bound<'py, PyDict>,
    ) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let (batch, values) = self.read(observation)?;
        let encoded = detached(py, || self.model.encode(batch.len, &values))?;
        let (mean, log_variance) = encoded.map_err(Raise::raise)?;
        let shape = [batch.len, self.latent()];
        Ok((batch.returned(array(py, mean, &shape)?)?, batch.returned(array(py, log_variance, &shape)?)?))
    }

    /// Predicts the observation one sample later from the posterior's mean, by modality of `output`.
    ///
    /// action: `[batch, 3]`, rotation (rad), lift and extension (m), in the form that `self.action` names. Frames are
    /// `[batch, 64, 64, 3]`, those of vision in [0, 1]. Raises the same errors as `encode`.
    fn predict<'py>(
        &self,
        py: Python<'py>,
        observation: &Bound<'py, PyDict>,
        action: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (batch, values) = self.read(observation)?;
        let action = batch.vectors("action", action, self.layout().action().len())?;
        let predicted = detached(py, || self.model.predict(batch.len, &values, action))?;
        by_modality(py, self.layout(), batch, predicted.map_err(Raise::raise)?)
    }

    /// Reconstructs the observation from a latent state `[batch, latent]`, by modality of `input`.
    ///
    /// Raises RuntimeError if the run trained no reconstruction, and ValueError if `latent` has the wrong shape.
    fn reconstruct<'py>(&self, py: Python<'py>, latent: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyDict>> {
        let latent = as_numbers("latent", latent)?;
        let batch = Batch::of("latent", &latent, 1)?;
        let latent = batch.vectors("latent", &latent, self.latent())?;
        let reconstructed = detached(py, || self.model.reconstruct(batch.len, latent))?;
        by_modality(py, self.layout(), batch, reconstructed.map_err(Raise::raise)?)
    }
}

/// Returns the task, the path and the description, as JSON, of each network of a run; see `harness.load_network`.
#[pyfunction]
pub fn networks(py: Python, run: &str, results: PathBuf) -> PyResult<Vec<(&'static str, PathBuf, String)>> {
    let registry = Registry::new(results);
    registry.check_there().map_err(Raise::raise)?;
    let found = detached(py, || experiment::network_files(&registry, run))?.map_err(Raise::raise)?;
    Ok(found.into_iter().map(|file| (file.task.name(), file.path, file.description.json())).collect())
}

/// Writes an ONNX model of a run; see `harness.export_onnx`.
#[pyfunction]
pub fn export_onnx(py: Python, run: &str, output: PathBuf, task: &str, results: PathBuf) -> PyResult<()> {
    let Some(task) = Task::ALL.iter().copied().find(|known| known.name() == task) else {
        let message = format!("task: there is no '{task}'; allowed: prediction, reconstruction");
        return Err(PyValueError::new_err(message));
    };
    let registry = Registry::new(results);
    registry.check_there().map_err(Raise::raise)?;
    let bytes = detached(py, || experiment::onnx(&registry, run, task))?.map_err(Raise::raise)?;
    let written = files::write_whole(&output, |path| std::fs::write(path, &bytes));
    written.map_err(|error| PyOSError::new_err(describe(&error)))
}

/// Returns a batch of values as a dictionary of arrays by modality.
fn by_modality<'py>(
    py: Python<'py>,
    layout: &Layout,
    batch: Batch,
    values: Values,
) -> PyResult<Bound<'py, PyDict>> {
    let answer = PyDict::new(py);
    for (modality, values) in values {
        let values = match layout[modality].size() {
            Some([rows, columns]) => {
                pixels_last(array(py, values, &[batch.len, IMAGE_CHANNELS, rows, columns])?)?
            }
            None => array(py, values, &[batch.len, layout[modality].width()])?,
        };
        answer.set_item(modality.name(), batch.returned(values)?)?;
    }
    Ok(answer)
}

/// The samples that a call gets.
#[derive(Clone, Copy)]
struct Batch {
    /// Number of samples.
    len: usize,
    /// Whether a single sample was given without the axis of the batch. The answer then has no such axis either.
    single: bool,
}

impl Batch {
    /// Returns the batch of an array, of which a single sample has `axes` axes. Raises ValueError if it has no samples.
    fn of(name: &str, values: &Bound<PyAny>, axes: usize) -> PyResult<Self> {
        let shape = shape_of(values)?;
        if shape.len() == axes {
            return Ok(Self { len: 1, single: true });
        }
        match shape.first() {
            None | Some(0) => Err(PyValueError::new_err(format!("the {name} has no samples"))),
            Some(len) => Ok(Self { len: *len, single: false }),
        }
    }

    /// Returns what is given as a NumPy array with the axis of the batch.
    fn taken<'py>(self, name: &str, given: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let numbers = as_numbers(name, given)?;
        if self.single { numbers.call_method1("__getitem__", (given.py().None(),)) } else { Ok(numbers) }
    }

    /// Reads vectors, `[batch, width]`, or one vector of a single sample.
    fn vectors(self, name: &str, given: &Bound<PyAny>, width: usize) -> PyResult<Vec<f32>> {
        read(name, &self.taken(name, given)?, &[self.len, width])
    }

    /// Returns an array for the caller, without the axis of the batch for a single sample.
    fn returned(self, values: Bound<PyAny>) -> PyResult<Bound<PyAny>> {
        if self.single { values.get_item(0) } else { Ok(values) }
    }
}

impl Model {
    fn layout(&self) -> &Layout {
        &self.model.record().layout
    }

    /// The run's experiment and id.
    fn id(&self) -> String {
        let record = self.model.record();
        format!("{}/{}", record.experiment, record.run)
    }

    /// Returns the batch and the values of the encoder's input modalities. Raises KeyError if there are others.
    fn read(&self, observation: &Bound<PyDict>) -> PyResult<(Batch, Values)> {
        let input = &self.model.record().spec.input;
        let mut given: Vec<(Modality, Bound<PyAny>)> = Vec::new();
        for (name, values) in observation {
            let name: String = name.extract()?;
            let Some(modality) = input.iter().find(|modality| modality.name() == name) else {
                let (run, taken) = (self.run(), self.input().join(", "));
                let message = format!("the observation has '{name}'; the encoder of {run} takes {taken}");
                return Err(PyKeyError::new_err(message));
            };
            given.push((*modality, as_numbers(&name, &values)?));
        }
        let Some((first, values)) = given.first() else {
            let message = format!("the observation has none of {}", self.input().join(", "));
            return Err(PyKeyError::new_err(message));
        };
        let axes = if self.layout()[*first].is_image() { 3 } else { 1 };
        let batch = Batch::of("observation", values, axes)?;
        let mut values = Values::new();
        for (modality, given) in given {
            let definition = &self.layout()[modality];
            let read = match definition.is_image() {
                true => read_frames(definition, &batch.taken(modality.name(), &given)?, batch.len)?,
                false => batch.vectors(modality.name(), &given, definition.width())?,
            };
            values.insert(modality, read);
        }
        Ok((batch, values))
    }
}
