//! The Python functions `run`, `query` and `compare`.

use crate::errors::Raise;
use crate::work::interruptible;
use harness::analysis::Setting;
use harness::catalog;
use harness::cli::progress::Bars;
use harness::experiment::{self, ExperimentError, Runner, provenance};
use harness::progress::{Progress, Silent};
use harness::registry::{Registry, quoted};
use harness::spec;
use polars::prelude::{CompatLevel, DataFrame, SchemaExt};
use polars_arrow::array::StructArray;
use polars_arrow::datatypes::{ArrowDataType, Field};
use polars_arrow::ffi::{ArrowArrayStream, export_iterator};
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyUserWarning, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyCapsule;
use std::ffi::CString;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Parses settings that runs must have.
pub fn settings_of(texts: &[String]) -> PyResult<Vec<Setting>> {
    texts.iter().map(|text| text.parse().map_err(PyValueError::new_err)).collect()
}

/// Opens a results folder that exists.
pub fn existing(results: PathBuf) -> PyResult<Registry> {
    let registry = experiment::results(results);
    registry.check_there().map_err(Raise::raise)?;
    Ok(registry)
}

/// Opens a results folder that can be written.
pub fn writable(results: PathBuf) -> PyResult<Registry> {
    let registry = experiment::results(results);
    registry.check_writable().map_err(|error| PyOSError::new_err(error.to_string()))?;
    Ok(registry)
}

/// Does every run of an experiment that isn't done yet, and returns the numbers of runs done now and before; see
/// `harness.run`.
#[pyfunction]
#[pyo3(signature = (path, overrides, quick, results, progress, jobs, memory))]
#[expect(clippy::too_many_arguments, reason = "they are those of `harness.run`, where each has its name")]
pub fn run(
    py: Python,
    path: PathBuf,
    overrides: Vec<String>,
    quick: bool,
    results: PathBuf,
    progress: bool,
    jobs: usize,
    memory: Option<u64>,
) -> PyResult<(usize, usize)> {
    let experiment = spec::load(&path, &overrides, quick).map_err(Raise::raise)?;
    let registry = writable(results)?;
    let threads = rayon::current_num_threads();
    let command = command(&path, &overrides, quick, &registry);
    let provenance = py.detach(|| provenance(threads, command));
    let listener = Listener::new(progress);
    let runner = Runner { jobs, memory, ..Runner::new(&registry, threads, &provenance, &listener) };
    let work = || runner.run(&experiment, runner.plan(&experiment)?).map(|(summary, _)| summary);
    let summary = interruptible(py, work, || listener.cancel())?;
    warn(py, &registry)?;
    let summary = summary.map_err(|error: ExperimentError| error.raise())?;
    if !summary.failed.is_empty() {
        let (number, failures) = (summary.failed.len(), summary.failed.join("; "));
        return Err(PyRuntimeError::new_err(format!("{number} runs failed: {failures}")));
    }
    Ok((summary.done, summary.skipped))
}

/// Returns the command that does the same as this call of `harness.run`.
fn command(path: &Path, overrides: &[String], quick: bool, registry: &Registry) -> String {
    let path = path.to_string_lossy();
    let quick = quick.then_some("--quick");
    let words = [&*path].into_iter().chain(overrides.iter().map(String::as_str)).chain(quick);
    registry.command(&format!("run {}", quoted(words)))
}

/// Warns of each run and dataset that the registry left out.
pub fn warn(py: Python, registry: &Registry) -> PyResult<()> {
    let category = py.get_type::<PyUserWarning>();
    for left_out in registry.left_out() {
        let text = CString::new(left_out).unwrap_or_default();
        PyErr::warn(py, &category, &text, 2)?;
    }
    Ok(())
}

/// Passes progress on to `shown`, and reports a cancellation by Python.
pub struct Listener<'a> {
    shown: Box<dyn Progress + 'a>,
    cancelled: Arc<AtomicBool>,
}

impl Listener<'_> {
    /// Returns a listener that draws bars on the terminal if `shown`.
    pub fn new(shown: bool) -> Self {
        let shown: Box<dyn Progress> = if shown { Box::new(Bars::default()) } else { Box::new(Silent) };
        Self { shown, cancelled: Arc::default() }
    }

    /// Makes the work end that reports to this listener.
    pub fn cancel(&self) {
        self.cancelled.store(true, Ordering::Relaxed);
    }
}

impl Progress for Listener<'_> {
    fn begin(&self, stage: &str, total: u64, unit: &str) {
        self.shown.begin(stage, total, unit);
    }
    fn advance(&self, steps: u64) {
        self.shown.advance(steps);
    }
    fn part(&self, done: u64, of: u64) {
        self.shown.part(done, of);
    }
    fn resume(&self, steps: u64) {
        self.shown.resume(steps);
    }
    fn note(&self, text: &str) {
        self.shown.note(text);
    }
    fn say(&self, text: &str) {
        self.shown.say(text);
    }
    fn end(&self) {
        self.shown.end();
    }
    fn job(&self, name: &str) -> Option<Box<dyn Progress + '_>> {
        Some(Box::new(Listener { shown: self.shown.job(name)?, cancelled: self.cancelled.clone() }))
    }
    fn cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed)
    }
}

/// Answers a query; see `harness.query`.
#[pyfunction]
pub fn query(py: Python, sql: &str, results: PathBuf) -> PyResult<Table> {
    let registry = existing(results)?;
    let answer = interruptible(py, || catalog::query(&registry, sql), || ())?;
    let answer = answer.map_err(Raise::raise)?;
    warn(py, &registry)?;
    Ok(Table(answer))
}

/// A table that Python can read through Arrow's C stream interface.
#[pyclass(frozen, module = "harness._harness")]
pub struct Table(pub DataFrame);

#[pymethods]
impl Table {
    /// Returns a stream over the table's chunks without copying them. A requested schema is ignored, which the
    /// interface allows.
    #[pyo3(signature = (requested_schema=None))]
    fn __arrow_c_stream__<'py>(
        &self,
        py: Python<'py>,
        requested_schema: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyCapsule>> {
        let _ = requested_schema;
        let mut table = self.0.clone();
        let fields: Vec<Field> =
            table.schema().iter_fields().map(|field| field.to_arrow(CompatLevel::newest())).collect();
        let kind = ArrowDataType::Struct(fields);
        let stream_field = Field::new("".into(), kind.clone(), false);
        table.align_chunks();
        let chunks: Vec<_> = table.iter_chunks(CompatLevel::newest(), false).collect();
        let arrays = chunks.into_iter().map(move |chunk| {
            let height = chunk.height();
            StructArray::try_new(kind.clone(), height, chunk.into_arrays(), None).map(|array| array.boxed())
        });
        let stream: ArrowArrayStream = export_iterator(Box::new(arrays), stream_field);
        PyCapsule::new_with_value(py, stream, c"arrow_array_stream")
    }
}
