//! The Python class `Replays`: how far a world with other factors is from a recording.

use crate::array::array;
use crate::errors::Raise;
use harness::dataset::AnyDataset;
use harness::experiment::{FittedTo, Replay};
use harness::simulation::Scene;
use harness::spec::World;
use pyo3::prelude::*;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

/// The compiled part of `harness.fitting.fit_world`.
#[pyclass(frozen, module = "harness._harness")]
pub struct Replays {
    scene: Arc<Scene>,
    fitted_to: FittedTo,
}

#[pymethods]
impl Replays {
    /// Opens the training episodes of a dataset, whose setpoints a world repeats.
    #[new]
    fn new(
        py: Python,
        datasets: PathBuf,
        dataset: &str,
        world: &str,
        outputs: Vec<String>,
    ) -> PyResult<Self> {
        let scene = Arc::new(Scene::new(World::find(world).map_err(Raise::raise)?).map_err(Raise::raise)?);
        let dataset = AnyDataset::named(&datasets, dataset).map_err(Raise::raise)?;
        let outputs: Vec<&str> = outputs.iter().map(String::as_str).collect();
        let fitted_to = py.detach(|| FittedTo::open(&dataset, &outputs)).map_err(Raise::raise)?;
        Ok(Self { scene, fitted_to })
    }

    /// Returns the lowest and the highest value of each factor of variation of the world.
    fn ranges(&self) -> BTreeMap<String, [f64; 2]> {
        self.scene.factor_ranges().map(|(name, range)| (name.to_owned(), range)).collect()
    }

    /// Returns the errors of all values of the training episodes with these factors, in standard deviations.
    fn errors<'py>(&self, py: Python<'py>, factors: BTreeMap<String, f64>) -> PyResult<Bound<'py, PyAny>> {
        let replay = Replay { scene: self.scene.clone(), factors };
        let errors = py.detach(|| self.fitted_to.errors(&replay)).map_err(Raise::raise)?;
        let count = errors.len();
        array(py, errors, &[count])
    }
}
