//! The Python class `Model`: the trained network of a run.

use crate::array::{array, pixels_last, read, read_frames};
use crate::errors::Raise;
use crate::work::detached;
use harness::experiment::{self, Values};
use harness::registry::Registry;
use harness::spec::{IMAGE_CHANNELS, Layout, Modality};
use pyo3::exceptions::{PyKeyError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;

/// A trained run; see `_harness.pyi`.
#[pyclass(frozen)]
pub struct Model(experiment::Model);

#[pymethods]
impl Model {
    #[new]
    fn new(py: Python, run: &str, results: PathBuf) -> PyResult<Self> {
        let registry = Registry::new(results);
        registry.check_there().map_err(Raise::raise)?;
        detached(py, || experiment::Model::load(&registry, run))?.map(Self).map_err(Raise::raise)
    }

    #[getter]
    fn run(&self) -> &str {
        &self.0.record().run
    }

    #[getter]
    fn experiment(&self) -> &str {
        &self.0.record().experiment
    }

    #[getter]
    fn dataset(&self) -> &str {
        &self.0.record().dataset
    }

    #[getter]
    fn scenario(&self) -> &str {
        self.0.record().spec.scenario.name()
    }

    #[getter]
    fn input(&self) -> Vec<&'static str> {
        self.0.record().spec.input.iter().map(|modality| modality.name()).collect()
    }

    #[getter]
    fn output(&self) -> Vec<&'static str> {
        self.0.record().spec.output.iter().map(|modality| modality.name()).collect()
    }

    #[getter]
    fn latent(&self) -> usize {
        self.0.record().spec.latent
    }

    #[getter]
    fn action(&self) -> &'static str {
        self.0.record().spec.action.name()
    }

    fn encode<'py>(
        &self,
        py: Python<'py>,
        observation: &Bound<'py, PyDict>,
    ) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let (batch, values) = self.read(observation)?;
        let (mean, log_variance) = detached(py, || self.0.encode(batch, &values))?.map_err(Raise::raise)?;
        let shape = [batch, self.latent()];
        Ok((array(py, mean, &shape)?, array(py, log_variance, &shape)?))
    }

    fn predict<'py>(
        &self,
        py: Python<'py>,
        observation: &Bound<'py, PyDict>,
        action: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (batch, values) = self.read(observation)?;
        let action = read("action", action, &[batch, self.layout().action().len()])?;
        let predicted = detached(py, || self.0.predict(batch, &values, action))?;
        by_modality(py, self.layout(), batch, predicted.map_err(Raise::raise)?)
    }

    fn reconstruct<'py>(&self, py: Python<'py>, latent: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyDict>> {
        let batch = batch_of("latent", latent)?;
        let latent = read("latent", latent, &[batch, self.latent()])?;
        let reconstructed = detached(py, || self.0.reconstruct(batch, latent))?;
        by_modality(py, self.layout(), batch, reconstructed.map_err(Raise::raise)?)
    }
}

/// Returns a batch of values as a dictionary of arrays by modality.
fn by_modality<'py>(
    py: Python<'py>,
    layout: &Layout,
    batch: usize,
    values: Values,
) -> PyResult<Bound<'py, PyDict>> {
    let answer = PyDict::new(py);
    for (modality, values) in values {
        let values = match layout[modality].size() {
            Some([rows, columns]) => {
                pixels_last(array(py, values, &[batch, IMAGE_CHANNELS, rows, columns])?)?
            }
            None => array(py, values, &[batch, layout[modality].width()])?,
        };
        answer.set_item(modality.name(), values)?;
    }
    Ok(answer)
}

/// Returns the number of samples of an array. Raises ValueError if there are none.
fn batch_of(name: &str, values: &Bound<PyAny>) -> PyResult<usize> {
    match values.len()? {
        0 => Err(PyValueError::new_err(format!("the {name} has no samples"))),
        batch => Ok(batch),
    }
}

impl Model {
    fn layout(&self) -> &Layout {
        &self.0.record().layout
    }

    /// Returns the batch's size and the values of the encoder's input modalities.
    fn read(&self, observation: &Bound<PyDict>) -> PyResult<(usize, Values)> {
        let input = &self.0.record().spec.input;
        let given = input.iter().map(|&modality| Ok((modality, observation.get_item(modality.name())?)));
        let given: Vec<(Modality, Option<Bound<PyAny>>)> = given.collect::<PyResult<_>>()?;
        let Some(first) = given.iter().find_map(|(_, values)| values.as_ref()) else {
            let message = format!("the observation has none of {}", self.input().join(", "));
            return Err(PyKeyError::new_err(message));
        };
        let batch = batch_of("observation", first)?;
        let mut values = Values::new();
        for (modality, given) in given {
            // The model's error names missing modalities.
            let Some(given) = given else { continue };
            let definition = &self.layout()[modality];
            let read = match definition.is_image() {
                true => read_frames(definition, &given, batch)?,
                false => read(modality.name(), &given, &[batch, definition.width()])?,
            };
            values.insert(modality, read);
        }
        Ok((batch, values))
    }
}
