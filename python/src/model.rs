//! The Python class `Model`: the trained network of a run; and its files.

use crate::array::{array, as_numbers, finite, pixels_last, read, read_frames, shape_of};
use crate::errors::Raise;
use crate::run::existing;
use crate::work::detached;
use harness::experiment::{self, Values, describe};
use harness::files;
use harness::spec::{IMAGE_CHANNELS, Layout, Modality, Task};
use pyo3::exceptions::{PyKeyError, PyOSError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use std::path::PathBuf;

/// The trained network of a finished run. `load_model` opens it.
///
/// An observation is a dictionary of arrays by modality. It must have exactly the modalities in `input`. Vectors are
/// `[batch, width]` in SI units. Images are `[batch, rows, columns, 3]`, either uint8 or floating-point numbers in
/// [0, 1]. Changes of images, such as `frame_difference`, are floating-point numbers in [-1, 1]. Lists, and arrays of
/// other numeric types, are converted to float32. A single sample can be given without the axis of the batch. Then the
/// answer has no such axis either.
///
/// The network computes on the CPU and never changes. It can be pickled. Only the name of its run and the folder are
/// stored.
///
/// Args:
///     run: the beginning of the run's id, or of `EXPERIMENT/ID`, as in `load_model`.
///     results: the folder of datasets and runs. The default is `results`.
///
/// Example:
///     >>> model = harness.load_model("smoke/empty-z4")
///     >>> model.input, model.latent
///     (['proprioception', 'vision'], 4)
///     >>> observation = {"proprioception": [0.0] * 20, "vision": [[[0.5] * 3] * 64] * 64}      # a single sample
///     >>> mean, log_variance = model.encode(observation)
///     >>> mean.shape
///     (4,)
///     >>> model.predict(observation, [0.1, 0.0, 0.0])["contact_force"].shape
///     (20,)
#[pyclass(frozen, module = "harness")]
pub struct Model {
    model: experiment::Model,
    /// The absolute path of the results folder that contains the run.
    results: PathBuf,
}

#[pymethods]
impl Model {
    #[new]
    #[pyo3(signature = (run, results=PathBuf::from("results")))]
    fn new(py: Python, run: &str, results: PathBuf) -> PyResult<Self> {
        let registry = existing(results.clone())?;
        let model = detached(py, || experiment::Model::load(&registry, run))?.map_err(Raise::raise)?;
        Ok(Self { model, results: std::path::absolute(&results).unwrap_or(results) })
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

    /// Id of the run, which is the name of its folder.
    #[getter]
    fn run(&self) -> &str {
        &self.model.record().run
    }

    /// Name of the run's experiment.
    #[getter]
    fn experiment(&self) -> &str {
        &self.model.record().experiment
    }

    /// Name of the dataset that the network was trained on, a folder in `results/datasets`.
    #[getter]
    fn dataset(&self) -> &str {
        &self.model.record().dataset
    }

    /// Name of the simulated world, or of the imported dataset.
    #[getter]
    fn scenario(&self) -> &str {
        self.model.record().spec.scenario.name()
    }

    /// Names of the modalities that the encoder takes.
    #[getter]
    fn input(&self) -> Vec<&'static str> {
        self.model.record().spec.input.iter().map(|modality| modality.name()).collect()
    }

    /// Names of the modalities that the decoder predicts.
    #[getter]
    fn output(&self) -> Vec<&'static str> {
        self.model.record().spec.output.iter().map(|modality| modality.name()).collect()
    }

    /// Size of the latent state.
    #[getter]
    fn latent(&self) -> usize {
        self.model.latent()
    }

    /// Form of the action: `increment` (the setpoint's change) or `target` (the setpoint at the next sample).
    #[getter]
    fn action(&self) -> &'static str {
        self.model.record().spec.action.name()
    }

    /// Returns the posterior of the latent state for an observation.
    ///
    /// Args:
    ///     observation: the values of the modalities in `input`, by name.
    ///
    /// Returns:
    ///     The mean and the log-variance of the posterior, each `[batch, latent]`, float32.
    ///
    /// Raises:
    ///     KeyError: a modality is missing, or there is one that the network does not take.
    ///     ValueError: an array has the wrong shape, or a value that is not finite or out of range.
    ///     TypeError: an array does not consist of numbers.
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

    /// Predicts the observation one sample later, from the mean of the posterior.
    ///
    /// Args:
    ///     observation: the values of the modalities in `input`, by name.
    ///     action: `[batch, elements]`, in the form that the property `action` names. The elements of the worlds
    ///         `empty` and `cluttered` are rotation (rad), lift and extension (m). None for a network without action.
    ///
    /// Returns:
    ///     The predicted values of the modalities in `output`, by name, float32, in SI units. Predicted images may be
    ///     slightly outside of [0, 1].
    ///
    /// Raises:
    ///     KeyError: a modality is missing, or there is one that the network does not take.
    ///     ValueError: an array has the wrong shape, or a value that is not finite or out of range.
    ///     TypeError: an array does not consist of numbers.
    #[pyo3(signature = (observation, action=None))]
    fn predict<'py>(
        &self,
        py: Python<'py>,
        observation: &Bound<'py, PyDict>,
        action: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (batch, values) = self.read(observation)?;
        let action = match (action, self.model.action_width()) {
            (None, 0) => Vec::new(),
            (None, width) => {
                return Err(PyValueError::new_err(format!(
                    "action: the network takes one with {width} values"
                )));
            }
            (Some(action), width) => batch.vectors("action", action, width)?,
        };
        let predicted = detached(py, || self.model.predict(batch.len, &values, action))?;
        by_modality(py, self.layout(), batch, predicted.map_err(Raise::raise)?)
    }

    /// Reconstructs the present observation from a latent state.
    ///
    /// Args:
    ///     latent: `[batch, latent]`, such as the mean that `encode` returns.
    ///
    /// Returns:
    ///     The reconstructed values of the modalities in `input`, by name, float32, in SI units.
    ///
    /// Raises:
    ///     RuntimeError: the run did not train a reconstruction.
    ///     ValueError: the array has the wrong shape, or a value that is not finite.
    ///     TypeError: the array does not consist of numbers.
    fn reconstruct<'py>(&self, py: Python<'py>, latent: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyDict>> {
        let latent = as_numbers("latent", latent)?;
        let batch = Batch::of("latent", &latent, 1)?;
        let latent = batch.vectors("latent", &latent, self.latent())?;
        let reconstructed = detached(py, || self.model.reconstruct(batch.len, latent))?;
        by_modality(py, self.layout(), batch, reconstructed.map_err(Raise::raise)?)
    }
}

/// Returns the task and the path of each network of a run; see `harness.load_network`.
#[pyfunction]
pub fn networks(py: Python, run: &str, results: PathBuf) -> PyResult<Vec<(&'static str, PathBuf)>> {
    let registry = existing(results)?;
    let found = detached(py, || experiment::network_files(&registry, run))?.map_err(Raise::raise)?;
    Ok(found.into_iter().map(|(task, path)| (task.name(), path)).collect())
}

/// Whether a run of a results folder whose id, or `EXPERIMENT/ID`, begins with `run` may have a network. Published
/// copies have one only if it was published with them, and a folder that is missing has no runs.
#[pyfunction]
pub fn may_have_network(py: Python, run: &str, results: PathBuf) -> PyResult<bool> {
    let registry = experiment::results(results);
    detached(py, || experiment::may_have_network(&registry, run))
}

/// Returns the path of the file that was attached to a run of a model of another program; `None` for the run of a
/// network. See `harness.load_network`.
#[pyfunction]
pub fn attached(py: Python, run: &str, results: PathBuf) -> PyResult<Option<PathBuf>> {
    let registry = existing(results)?;
    detached(py, || experiment::attached(&registry, run))?.map_err(Raise::raise)
}

/// Writes an ONNX model of a run; see `harness.export_onnx`.
#[pyfunction]
pub fn export_onnx(py: Python, run: &str, output: PathBuf, task: &str, results: PathBuf) -> PyResult<()> {
    let Some(task) = Task::ALL.iter().copied().find(|known| known.name() == task) else {
        let message = format!("task: there is no '{task}'; allowed: prediction, reconstruction");
        return Err(PyValueError::new_err(message));
    };
    let registry = existing(results)?;
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
            None => {
                Err(PyValueError::new_err(format!("the {name} is a single number, not a sample or a batch")))
            }
            Some(0) => Err(PyValueError::new_err(format!("the {name} has no samples"))),
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
        finite(name, read(name, &self.taken(name, given)?, &[self.len, width])?)
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
