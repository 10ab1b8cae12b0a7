//! The Python function that reads the mappings of `harness.importing`.

use crate::errors::Raise;
use harness::dataset::{AnyDataset, Imported};
use harness::progress::Silent;
use harness::samples::FramePlace;
use harness::{experiment, spec};
use pyo3::prelude::*;
use std::path::PathBuf;

/// The names that no modality may have, because they have another meaning.
#[pyfunction]
pub fn reserved_names() -> [&'static str; 11] {
    spec::Modality::RESERVED
}

/// Reads and checks a mapping. Returns its content as JSON, whose keys are in the file's order.
///
/// Raises FileNotFoundError if the file does not exist, and ValueError for its first fault, with its line and column.
#[pyfunction]
pub fn read_mapping(path: PathBuf) -> PyResult<String> {
    spec::read_mapping(&path).map(|mapping| mapping.to_string()).map_err(Raise::raise)
}

/// Returns how runs divide an imported dataset, and what may be wrong with it, in sentences.
///
/// Raises OSError if the dataset can't be read.
#[pyfunction]
pub fn recording_notes(py: Python, datasets: PathBuf, name: &str) -> PyResult<(String, Vec<String>)> {
    py.detach(|| {
        let dataset = Imported::open(&datasets, name).map_err(Raise::raise)?;
        let samples =
            AnyDataset::Imported(dataset).load(FramePlace::Nowhere, &Silent).map_err(Raise::raise)?;
        experiment::recording_notes(&samples).map_err(Raise::raise)
    })
}
