//! The Python functions `answer`, `claims`, `figures`, `plot`, `report`, `verify` and `collect`.

use crate::errors::Raise;
use crate::run::{Listener, Table, existing, settings_of, warn, writable};
use crate::work::interruptible;
use harness::analysis::{Analysis, AnalysisError, Horizon, Key, Over, Question, name_of_given};
use harness::claims::{ClaimsError, ClaimsFile, Judgment, Readings};
use harness::collection::{collect as collect_episodes, dataset_of};
use harness::dataset::AnyDataset;
use harness::experiment::{dataset_notes, describe};
use harness::figures::{Figure, Format, OfReading, Plot, Shown};
use harness::files::write_bytes;
use harness::progress::Silent;
use harness::registry::{OwnMetric, OwnValue, Registry, RegistryError, SPEC, quoted};
use harness::report::ReportError;
use harness::samples::FramePlace;
use harness::simulation::Scene;
use harness::spec::{self, Modality, Task};
use pyo3::PyErr;
use pyo3::exceptions::{PyKeyError, PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use std::path::PathBuf;

/// Judges claims; see `harness.claims`.
#[pyfunction]
pub fn claims(
    py: Python,
    chosen: Vec<String>,
    file: PathBuf,
    reading: Option<String>,
    quick: bool,
    settings: Vec<String>,
    results: PathBuf,
) -> PyResult<Table> {
    let (settings, registry) = (settings_of(&settings)?, existing(results)?);
    let written = |judgments: &[&Judgment]| {
        let table = harness::claims::table(judgments);
        table.map_err(|error| PyRuntimeError::new_err(error.to_string()))
    };
    let judge = || -> PyResult<_> {
        let all = harness::claims::load(&file).map_err(Raise::raise)?;
        let chosen = harness::claims::choose(&all.claims, &chosen).map_err(refused)?;
        if let Some(reading) = &reading {
            let spec = all.spec_of_readings(&registry, quick).map_err(Raise::raise)?;
            let spec = spec.ok_or_else(|| PyValueError::new_err(no_readings(&all, &registry, quick)))?;
            let readings = Readings::of(&registry, registry.recorded(), &spec, &chosen, &settings);
            let matrix = readings.map_err(Raise::raise)?.judge(&chosen).map_err(refused)?;
            let place = matrix.readings.iter().position(|name| name == reading).ok_or_else(|| {
                let there = matrix.readings.join(", ");
                PyValueError::new_err(format!("no reading is called '{reading}'; the readings are {there}"))
            })?;
            return written(&matrix.column(place).collect::<Vec<_>>());
        }
        let runs = harness::claims::runs(&registry, &chosen, &settings, quick).map_err(Raise::raise)?;
        let mut judgments = Vec::new();
        for claim in chosen {
            judgments.extend(harness::claims::judge(&runs, claim, quick).map_err(refused)?);
        }
        written(&judgments.iter().collect::<Vec<_>>())
    };
    let table = interruptible(py, judge, || ())??;
    warn(py, &registry)?;
    Ok(Table(table))
}

/// The message that the readings of a file of claims have no runs, or that it names none.
fn no_readings(file: &ClaimsFile, registry: &Registry, quick: bool) -> String {
    let Some(path) = &file.readings else {
        return "the file of claims names no readings; add the key `readings` with the name of a spec".into();
    };
    let quick = if quick { " --quick" } else { "" };
    let command = registry.command(&format!("run {}{quick}", quoted([&*path.to_string_lossy()])));
    format!("there are no runs of {}; make them with `{command}`", path.display())
}

fn refused(error: ClaimsError) -> PyErr {
    PyValueError::new_err(describe(&error))
}

/// The figures that were drawn, and the others with the reason.
type Drawn = (Vec<String>, Vec<(String, String)>);

/// Draws figures to a folder; see `harness.figures`.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "they are those of `harness.figures`, where each has its name")]
pub fn figures(
    py: Python,
    names: Vec<String>,
    folder: PathBuf,
    formats: Vec<String>,
    quick: bool,
    single: Option<String>,
    multi: Option<String>,
    reading: Option<String>,
    experiment: Option<String>,
    of: Option<String>,
    settings: Vec<String>,
    results: PathBuf,
) -> PyResult<Drawn> {
    let figures = named("figure", &names, &Figure::ALL, Figure::name)?;
    let formats = named("format", &formats, &Format::ALL, Format::name)?;
    let (settings, registry) = (settings_of(&settings)?, existing(results)?);
    let reading = reading.map(|text| OfReading::load(&text, quick));
    let reading = reading.transpose().map_err(|error| PyValueError::new_err(describe(&error)))?;
    let shown = Shown { quick, single, multi, reading }.or_reproduction(&registry).map_err(Raise::raise)?;
    let draw = || -> Result<Drawn, AnalysisError> {
        let analysis = match &experiment {
            Some(name) => Analysis::finished(&registry, std::slice::from_ref(name), &settings)?,
            None => shown.analysis(&registry, &settings)?,
        };
        let source = shown.source(&analysis).showing(of.clone());
        let (mut drawn, mut missing) = (Vec::new(), Vec::new());
        for figure in figures {
            let drawing = match &experiment {
                Some(name) => figure.render_of(&analysis, name, of.clone()),
                None => figure.render(&source),
            };
            match drawing.and_then(|drawing| drawing.save(&folder, figure.name(), &formats)) {
                Ok(()) => drawn.push(figure.name().to_owned()),
                Err(error) => missing.push((figure.name().to_owned(), describe(&error))),
            }
        }
        Ok((drawn, missing))
    };
    let drawn = interruptible(py, draw, || ())?.map_err(Raise::raise)?;
    warn(py, &registry)?;
    Ok(drawn)
}

/// A value of a user's metric: the modality, the horizon, the modalities that the model got, and the value.
type Valued = (String, usize, Option<String>, Option<f64>);

/// Writes the values of a user's metric to the tables of a run; see `harness.add_metric`.
#[pyfunction]
pub fn add_metric(
    py: Python,
    run: &str,
    name: String,
    unit: String,
    values: Vec<Valued>,
    results: PathBuf,
) -> PyResult<()> {
    let registry = existing(results)?;
    let value = |(modality, horizon, given, value): Valued| {
        let known = Modality::new(&modality);
        let modality = known.ok_or_else(|| PyValueError::new_err(format!("'{modality}' is no modality")))?;
        Ok(OwnValue { modality, horizon, given, value })
    };
    let values = values.into_iter().map(value).collect::<PyResult<Vec<_>>>()?;
    let metric = OwnMetric { name, unit, values };
    let add = || -> Result<(), RegistryError> {
        let (folder, _) = registry.find(run)?;
        registry.add_metric(&folder, &metric)
    };
    interruptible(py, add, || ())?.map_err(Raise::raise)
}

/// The record of a run, as JSON, and its resolved spec in YAML. Raises KeyError if there is no such run.
#[pyfunction]
pub fn recorded(experiment: &str, run: &str, results: PathBuf) -> PyResult<(String, String)> {
    let registry = existing(results)?;
    let folder = registry.runs().join(experiment).join(run);
    let record = registry.read_run(&folder).map_err(Raise::raise)?;
    let record = record.ok_or_else(|| PyKeyError::new_err(format!("there is no run {experiment}/{run}")))?;
    let json = serde_json::to_string(&record).map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
    let spec = record.spec_yaml.map_or_else(|| std::fs::read_to_string(folder.join(SPEC)), Ok);
    Ok((json, spec.map_err(|error| PyOSError::new_err(error.to_string()))?))
}

/// Writes the files of a published run to a folder. Raises KeyError if there is no such run.
#[pyfunction]
pub fn extract(py: Python, run: &str, folder: PathBuf, results: PathBuf) -> PyResult<()> {
    let registry = existing(results)?;
    let extract = || {
        let (own, record) = registry.find(run)?;
        record.extract(own.path(), &folder)
    };
    interruptible(py, extract, || ())?.map_err(Raise::raise)
}

/// A question, as Python gives it.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Asked {
    experiments: Vec<String>,
    of: Vec<String>,
    metrics: Vec<String>,
    models: Vec<String>,
    task: Option<String>,
    horizon: Vec<String>,
    given: Option<String>,
    by: Vec<String>,
    settings: Vec<String>,
    against: Option<String>,
    interval: String,
}

impl Asked {
    fn question(self) -> PyResult<Question> {
        let horizon = |text: &String| {
            let refused = |error: String| PyValueError::new_err(format!("horizon: '{text}': {error}"));
            text.parse::<Horizon>().map_err(refused)
        };
        Ok(Question {
            experiments: self.experiments,
            settings: settings_of(&self.settings)?,
            task: self.task.map(|task| one_named("task", &task, Task::ALL, Task::name)).transpose()?,
            of: self.of,
            metrics: self.metrics,
            models: self.models,
            horizons: self.horizon.iter().map(horizon).collect::<PyResult<_>>()?,
            given: self.given.as_deref().map(name_of_given),
            by: self.by.iter().map(|name| key(name)).collect::<PyResult<_>>()?,
            against: self.against,
            over: one_named("interval", &self.interval, &Over::ALL, Over::name)?,
        })
    }
}

/// Computes means of metrics over seeds; see `harness.answer`.
#[pyfunction]
pub fn answer(py: Python, question: Asked, results: PathBuf) -> PyResult<Table> {
    let (question, registry) = (question.question()?, existing(results)?);
    let answer = interruptible(py, || question.ask(&registry), || ())?.map_err(Raise::raise)?;
    warn(py, &registry)?;
    let frame = answer.frame();
    frame.map(Table).map_err(|error| PyRuntimeError::new_err(error.to_string()))
}

/// Draws a metric over a key, to a file; see `harness.plot`.
#[pyfunction]
pub fn plot(
    py: Python,
    question: Asked,
    x: &str,
    facet: Option<&str>,
    output: PathBuf,
    results: PathBuf,
) -> PyResult<()> {
    let plot = Plot::new(question.question()?, key(x)?, facet.map(key).transpose()?);
    let format = Format::of(&output).map_err(PyValueError::new_err)?;
    let registry = existing(results)?;
    let draw = || plot.ask(&registry).and_then(|(drawing, _)| drawing.save_as(&output, format));
    interruptible(py, draw, || ())?.map_err(Raise::raise)?;
    warn(py, &registry)
}

/// The key of a plot with this name.
fn key(name: &str) -> PyResult<Key> {
    name.parse().map_err(PyValueError::new_err)
}

/// Writes the page of a results folder, or of some of its experiments; see `harness.report`.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "they are those of `harness.report`, where each has its name")]
pub fn report(
    py: Python,
    experiments: Vec<String>,
    output: PathBuf,
    claims: PathBuf,
    quick: bool,
    settings: Vec<String>,
    results: PathBuf,
    progress: bool,
) -> PyResult<()> {
    let (settings, registry) = (settings_of(&settings)?, existing(results)?);
    let listener = Listener::new(progress);
    let write = || -> PyResult<()> {
        let claims = harness::claims::load(&claims).map_err(Raise::raise)?;
        let asked = harness::report::Asked { experiments, settings, quick };
        let page = harness::report::page(&registry, &claims, &asked, &listener);
        let page = page.map_err(|error| match error {
            ReportError::Analysis(error) => error.raise(),
            ReportError::Claims(error) => refused(error),
            error => PyRuntimeError::new_err(describe(&error)),
        })?;
        write_bytes(&output, page.as_bytes()).map_err(|error| PyOSError::new_err(error.to_string()))
    };
    interruptible(py, write, || listener.cancel())??;
    warn(py, &registry)
}

/// Writes the page of a dataset; see `harness.report`.
#[pyfunction]
pub fn report_dataset(
    py: Python,
    dataset: &str,
    output: PathBuf,
    results: PathBuf,
    progress: bool,
) -> PyResult<()> {
    let registry = existing(results)?;
    let listener = Listener::new(progress);
    let write = || -> PyResult<()> {
        let dataset = AnyDataset::named(&registry.datasets(), dataset).map_err(Raise::raise)?;
        let samples = dataset.load(FramePlace::Nowhere, &listener).map_err(Raise::raise)?;
        let notes = dataset_notes(&dataset, &samples).map_err(Raise::raise)?;
        let page = harness::report::dataset_page(&dataset, &samples, notes);
        let page = page.map_err(|error| PyRuntimeError::new_err(describe(&error)))?;
        write_bytes(&output, page.as_bytes()).map_err(|error| PyOSError::new_err(error.to_string()))
    };
    interruptible(py, write, || listener.cancel())?
}

/// Returns the items with these names, or all of them without names. Raises ValueError for another name.
fn named<T: Copy>(what: &str, names: &[String], all: &[T], name: fn(T) -> &'static str) -> PyResult<Vec<T>> {
    if names.is_empty() {
        return Ok(all.to_vec());
    }
    names.iter().map(|wanted| one_named(what, wanted, all, name)).collect()
}

/// Returns the item with this name. Raises ValueError if there is none.
fn one_named<T: Copy>(what: &str, wanted: &str, all: &[T], name: fn(T) -> &'static str) -> PyResult<T> {
    all.iter().copied().find(|item| name(*item) == wanted).ok_or_else(|| {
        let allowed: Vec<&str> = all.iter().map(|item| name(*item)).collect();
        PyValueError::new_err(format!("there is no {what} '{wanted}'; allowed: {}", allowed.join(", ")))
    })
}

/// A problem: path, what is wrong, a command that repairs it, and whether data were lost or changed.
type Problem = (PathBuf, String, Option<String>, bool);

/// Checks all files of a results folder. Returns the numbers of runs, datasets and files, and the problems; see
/// `harness.verify`.
#[pyfunction]
pub fn verify(py: Python, results: PathBuf) -> PyResult<(usize, usize, usize, Vec<Problem>)> {
    let registry = existing(results)?;
    let report = interruptible(py, || registry.verify(&Silent), || ())?;
    let problems = report.findings.into_iter();
    let problems = problems.map(|finding| (finding.path, finding.problem, finding.mend, finding.broken));
    Ok((report.runs, report.datasets, report.files, problems.collect()))
}

/// Simulates the missing episodes of an experiment's datasets. Returns each folder with the number of episodes that
/// were simulated; see `harness.collect`.
#[pyfunction]
pub fn collect(
    py: Python,
    path: PathBuf,
    overrides: Vec<String>,
    quick: bool,
    results: PathBuf,
    progress: bool,
    workers: Option<usize>,
) -> PyResult<Vec<(PathBuf, usize)>> {
    let experiment = spec::load_task(&path, &overrides, quick).map_err(Raise::raise)?;
    let registry = writable(results)?;
    let listener = Listener::new(progress);
    let work = || -> PyResult<Vec<(PathBuf, usize)>> {
        let mut collected = Vec::new();
        for (world, simulation) in experiment.simulated() {
            let scene = Scene::new(world).map_err(Raise::raise)?;
            scene.check(&simulation).map_err(Raise::raise)?;
            let dataset = dataset_of(&registry.datasets(), &scene, &simulation);
            let threads = workers.unwrap_or_else(rayon::current_num_threads);
            let made = collect_episodes(&dataset, &scene, threads, &listener);
            let made = made.map_err(|error| PyRuntimeError::new_err(describe(&error)))?;
            collected.push((dataset.folder().to_owned(), made));
        }
        Ok(collected)
    };
    interruptible(py, work, || listener.cancel())?
}
