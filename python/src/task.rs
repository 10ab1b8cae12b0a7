//! The Python class `Task`: what an experiment asks of a model of another program, and the judgment of its predictions.

use crate::array::{array, finite, read, read_frames, shape};
use crate::dataset::modality_array;
use crate::errors::Raise;
use crate::run::{Listener, warn};
use crate::work::interruptible;
use harness::experiment::{
    self, ExperimentError, External, OpenTask, PredictionTask, Predictions, Runner, provenance,
};
use harness::registry::{Registry, quoted};
use harness::samples::Samples;
use harness::spec::{self, Modality};
use pyo3::exceptions::{PyFileNotFoundError, PyKeyError, PyValueError};
use pyo3::prelude::*;
use serde_json::json;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// The compiled part of `harness.PredictionTask`.
#[pyclass(frozen, subclass, module = "harness._harness")]
pub struct Task {
    open: OpenTask,
    registry: Registry,
    /// Name of the task within its experiment.
    name: String,
}

/// Predictions of one output at one horizon: its name, the horizon, and the array `[windows, ...]`.
type Predicted<'py> = (String, usize, Bound<'py, PyAny>);

#[pymethods]
impl Task {
    /// Opens a task of the experiment in the file `path`, or in `text`, which messages call `path`.
    #[new]
    #[pyo3(signature = (path, text, overrides, quick, cell, results, progress))]
    #[expect(
        clippy::too_many_arguments,
        reason = "they are those of `harness.task`, where each has its name"
    )]
    fn new(
        py: Python,
        path: PathBuf,
        text: Option<String>,
        overrides: Vec<String>,
        quick: bool,
        cell: Option<String>,
        results: PathBuf,
        progress: bool,
    ) -> PyResult<Self> {
        let experiment = match text {
            Some(text) => spec::parse_task(&path.to_string_lossy(), &text),
            None => spec::load_task(&path, &overrides, quick),
        };
        let (experiment, registry) = (experiment.map_err(Raise::raise)?, experiment::results(results));
        let listener = Listener::new(progress);
        let threads = rayon::current_num_threads();
        let provenance = py.detach(|| provenance(threads, String::new()));
        let runner = Runner::new(&registry, threads, &provenance, &listener);
        let tasks = runner.tasks(&experiment).map_err(Raise::raise)?;
        let task = chosen(&experiment.name, tasks, cell)?;
        if task.missing() > 0 {
            let (name, missing) = (task.dataset().name().to_owned(), task.missing());
            return Err(PyFileNotFoundError::new_err(format!(
                "the dataset {name} lacks {missing} of its episodes in {}; `harness.collect`, with the same spec and \
                 results, simulates them",
                registry.datasets().display()
            )));
        }
        let name = task.name();
        let work = || runner.open_task(task);
        let open = interruptible(py, work, || listener.cancel())?;
        let open = open.map_err(|error: ExperimentError| error.raise())?;
        Ok(Self { open, registry, name })
    }

    /// Returns the description of the task, as JSON.
    fn description(&self) -> String {
        let task = self.open.task();
        let (spec, layout) = (task.spec(), task.dataset().layout());
        let modality = |modality: &Modality| {
            let definition = &layout[*modality];
            let of = definition.difference_of.filter(|_| definition.is_image()).map(Modality::name);
            (
                modality.name(),
                json!({ "shape": shape(definition), "unit": definition.unit(), "change_of": of }),
            )
        };
        let modalities: serde_json::Map<String, serde_json::Value> =
            spec.modalities().iter().map(modality).map(|(name, about)| (name.to_owned(), about)).collect();
        let names = |list: &[Modality]| list.iter().map(|modality| modality.name()).collect::<Vec<_>>();
        let description = json!({
            "experiment": task.experiment(),
            "name": self.name,
            "hash": task.hash(),
            "dataset": task.dataset().name(),
            "test_dataset": task.tested().name(),
            "scenario": spec.scenario.name(),
            "input": names(&spec.input),
            "output": names(&spec.output),
            "context": spec.window.context,
            "horizon": spec.window.horizon,
            "horizons": spec.window.horizons(),
            "start": spec.window.start.name(),
            "action": spec.action,
            "has_setpoint": layout.get(Modality::SETPOINT).is_some(),
            "split": spec.split,
            "modalities": modalities,
        });
        description.to_string()
    }

    /// Returns the spec of the task as YAML. Raises ValueError if its world is a file.
    fn yaml(&self) -> PyResult<String> {
        let task = self.open.task();
        if let Some(world) = task.world_file() {
            return Err(PyValueError::new_err(format!(
                "the task uses the world file {}; share its spec together with this file",
                world.display()
            )));
        }
        Ok(task.spec().to_experiment_yaml(task.experiment()))
    }

    /// Returns the samples of each episode, `[episodes, 2]`: index of the first one, of the last one plus 1.
    fn bounds<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let episodes = self.open.samples().episodes();
        let bounds = episodes.iter().flat_map(|range| [range.start as i64, range.end as i64]);
        array(py, bounds.collect(), &[episodes.len(), 2])
    }

    /// Returns the present samples of the windows of a part, `[windows]`, int64.
    fn windows<'py>(&self, py: Python<'py>, part: &str) -> PyResult<Bound<'py, PyAny>> {
        let partition = self.open.windows();
        let windows = match part {
            "training" => &partition.training,
            "validation" => &partition.validation,
            "test" => &partition.test,
            _ => {
                let allowed = "training, validation, test";
                return Err(PyValueError::new_err(format!("part: there is no '{part}'; allowed: {allowed}")));
            }
        };
        array(py, windows.iter().map(|sample| sample.index() as i64).collect(), &[windows.len()])
    }

    /// Returns all samples of a modality, as `Dataset` does.
    fn array<'py>(slf: &Bound<'py, Self>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        let samples: &Samples = slf.get().open.samples();
        let modality = Modality::new(name).filter(|modality| samples.layout().get(*modality).is_some());
        let modality = modality.ok_or_else(|| PyKeyError::new_err(format!("the dataset has no '{name}'")))?;
        modality_array(slf, samples, modality)
    }

    /// Judges predictions of the test windows. Returns the name of the run, and whether it was done before.
    #[pyo3(signature = (predictions, model, seed, notes, network, command, progress))]
    #[expect(clippy::too_many_arguments, reason = "they are those of `harness.PredictionTask.submit`")]
    fn judge(
        &self,
        py: Python,
        predictions: Vec<Predicted>,
        model: String,
        seed: u64,
        notes: BTreeMap<String, String>,
        network: Option<PathBuf>,
        command: Vec<String>,
        progress: bool,
    ) -> PyResult<(String, bool)> {
        let (windows, layout) = (self.open.windows().test.len(), self.open.samples().layout());
        let mut values = BTreeMap::new();
        for (name, horizon, given) in predictions {
            let known = Modality::new(&name).and_then(|modality| layout.get(modality));
            let definition =
                known.ok_or_else(|| PyKeyError::new_err(format!("the dataset has no '{name}'")))?;
            let predicted = match definition.size() {
                Some(_) => read_frames(definition, &given, windows)?,
                None => finite(&name, read(&name, &given, &[windows, definition.width()])?)?,
            };
            values.insert((definition.name, horizon), predicted);
        }
        let listener = Listener::new(progress);
        let threads = rayon::current_num_threads();
        let task = Some(self.open.task().hash());
        let predictions = Predictions::Windows(values);
        let external = External { model, seed, notes, task, network, predictions };
        let work = || {
            let provenance = provenance(threads, quoted(command.iter().map(String::as_str)));
            let runner = Runner::new(&self.registry, threads, &provenance, &listener);
            runner.judge(&self.open, external)
        };
        let judged = interruptible(py, work, || listener.cancel())?;
        warn(py, &self.registry)?;
        let judged = judged.map_err(|error: ExperimentError| error.raise())?;
        Ok((judged.record.name(), judged.was_done))
    }
}

/// Returns the task with a name, or the only one.
fn chosen(experiment: &str, tasks: Vec<PredictionTask>, cell: Option<String>) -> PyResult<PredictionTask> {
    PredictionTask::choose(tasks, cell.as_deref()).map_err(|names| {
        let names = names.join(", ");
        PyValueError::new_err(match cell {
            None => format!("cell: {experiment} has several tasks; choose one: {names}"),
            Some(wanted) => format!("cell: {experiment} has no '{wanted}'; allowed: {names}"),
        })
    })
}
