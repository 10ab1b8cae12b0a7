//! Models of other programs: what a cell of an experiment asks of them, and the runs that their predictions become.

use super::evaluate::{self, References};
use super::simulator::{Replay, simulated};
use super::{ExperimentError, OpenData, Runner, Source, describe, sources};
use harness_judge::{Asked, Predictor, Recorded, RecordedError, RecordedValue, Test, judge, models};
use harness_registry::dataset::AnyDataset;
use harness_registry::{Outcome, Registry, RunFolder, RunRecord, Status, Submission, Timings, quoted};
use harness_samples::{Partition, Sample, Samples, ends};
use harness_shared::files::FolderLock;
use harness_shared::progress::Progress;
use harness_shared::seal::hex;
use harness_simulation::Knowledge;
use harness_spec::{
    Division, Experiment, IMAGE_CHANNELS, Layout, MAX_SEED, Modality, RunSpec, Task, WindowStart,
};
use harness_tables::{PredictedRow, PredictedRows};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::Instant;

/// The endings of files of models: ONNX, TorchScript, and programs of `torch.export`.
const NETWORKS: [&str; 3] = ["onnx", "pt", "pt2"];

/// Largest number of notes, and of characters in one of them.
const MAX_NOTES: usize = 100;
const MAX_NOTE: usize = 10_000;

/// Why predictions can't become a run.
#[derive(Debug, thiserror::Error)]
pub enum SubmissionError {
    /// The predictions, their model, or what is said about it, are wrong. The text is the message.
    #[error("{0}")]
    Refused(String),
    /// Another process writes the run.
    #[error("{holder} is writing {run}; try again when it has ended")]
    Held {
        /// The run.
        run: String,
        /// The other process.
        holder: String,
    },
}

/// Refuses predictions with a message.
fn refused(message: impl Into<String>) -> SubmissionError {
    SubmissionError::Refused(message.into())
}

/// What a cell of an experiment asks of a model: to predict the outputs at the horizons of a window from its inputs, on
/// the test windows of a dataset. It is the same for every seed.
pub struct PredictionTask {
    experiment: String,
    /// The variant of the cell, if the scenario has several tasks.
    variant: String,
    /// The spec of a run of a model without a name.
    spec: RunSpec,
    source: Arc<Source>,
}

impl PredictionTask {
    /// Returns the name of the task, which is unique within its experiment: `empty` or `empty-role=single_to_multi`.
    pub fn name(&self) -> String {
        let spec = RunSpec { variant: self.variant.clone(), ..self.spec.clone() };
        let label = spec.label();
        label.strip_suffix("-seed0").unwrap_or(&label).to_owned()
    }

    /// Returns the task of this name, or that of this scenario if it has only one. Without a name, returns the only
    /// task.
    ///
    /// # Errors
    /// When there is no such task, or there are several. Returns the names of all tasks.
    pub fn choose(tasks: Vec<Self>, wanted: Option<&str>) -> Result<Self, Vec<String>> {
        let names: Vec<String> = tasks.iter().map(Self::name).collect();
        let is_named = |wanted: &str| names.iter().any(|name| name == wanted);
        let is_wanted = |task: &Self| match wanted {
            Some(wanted) if is_named(wanted) => task.name() == wanted,
            Some(wanted) => task.spec.scenario.name() == wanted,
            None => true,
        };
        let mut chosen = tasks.into_iter().filter(is_wanted);
        match (chosen.next(), chosen.next()) {
            (Some(task), None) => Ok(task),
            _ => Err(names),
        }
    }

    /// Returns the name of the experiment.
    pub fn experiment(&self) -> &str {
        &self.experiment
    }

    /// Returns the data, the inputs, the outputs and the window.
    pub fn spec(&self) -> &RunSpec {
        &self.spec
    }

    /// Returns the dataset.
    pub fn dataset(&self) -> &AnyDataset {
        &self.source.dataset
    }

    /// Returns the dataset whose episodes are for the test: one of its own, or the run's.
    pub fn tested(&self) -> AnyDataset {
        self.source.tested()
    }

    /// Returns the path of the world file; `None` for a built-in world and an imported dataset.
    pub fn world_file(&self) -> Option<PathBuf> {
        self.source.world_file()
    }

    /// Returns the hash of the task; see [`RunSpec::task_hash`].
    pub fn hash(&self) -> String {
        let test = self.source.test.as_ref().map(AnyDataset::name);
        self.spec.task_hash(&self.spec.data(self.source.dataset.name(), test))
    }

    /// Returns the number of episodes that have not been collected.
    pub fn missing(&self) -> usize {
        self.uncollected().map(|(_, missing)| missing).sum()
    }

    /// Returns the names of the datasets that lack episodes, each with their number.
    pub fn uncollected(&self) -> impl Iterator<Item = (&str, usize)> {
        let lacking = self.source.simulated().map(|(dataset, _)| (dataset.name(), dataset.missing().len()));
        lacking.filter(|(_, missing)| *missing > 0)
    }

    /// Returns the spec of a run of a model.
    fn run(&self, model: &str, seed: u64) -> RunSpec {
        self.spec.external(model, &self.variant, seed)
    }
}

/// A task with its dataset.
pub struct OpenTask {
    task: PredictionTask,
    open: OpenData,
    windows: Partition,
    /// The predictions of baselines, and what else all runs on the data share. They are computed for the first run.
    references: OnceLock<References>,
}

impl OpenTask {
    /// Returns the task.
    pub fn task(&self) -> &PredictionTask {
        &self.task
    }

    /// Returns the samples of the dataset.
    pub fn samples(&self) -> &Arc<Samples> {
        &self.open.data.samples
    }

    /// Returns the windows for training, validation and test, each with its whole context in its part.
    pub fn windows(&self) -> &Partition {
        &self.windows
    }

    fn references(&self) -> Result<&References, ExperimentError> {
        if let Some(references) = self.references.get() {
            return Ok(references);
        }
        let references = evaluate::references(&self.open, &self.task.spec)?;
        Ok(self.references.get_or_init(|| references))
    }

    /// Checks the predictions of a model, and makes a predictor of those of each set of inputs.
    fn recorded(
        &self,
        model: &str,
        predictions: Predictions,
        progress: &dyn Progress,
    ) -> Result<Vec<Recorded<'_>>, ExperimentError> {
        let (samples, windows, spec) = (&**self.samples(), &self.open.partition.test, &self.task.spec);
        let horizons = spec.window.horizons();
        let asked = Asked { outputs: &spec.output, horizons: &horizons };
        let wrong = |error: RecordedError| refused(format!("{error} ({})", self.task.source.dataset.name()));
        let of_windows = |values| Recorded::of_windows(model, samples, windows, asked, values).map_err(wrong);
        let recorded = match predictions {
            Predictions::Windows(values) => vec![of_windows(values)?],
            Predictions::Simulated(known) => {
                vec![of_windows(simulated(&self.task.source, spec, samples, windows, &known, progress)?)?]
            }
            Predictions::Replayed(replay) => {
                vec![of_windows(replay.predicted(&self.task.source, spec, samples, windows, progress)?)?]
            }
            Predictions::Rows(rows) => {
                if !rows.is_empty() && !rows.contains_key(&None) {
                    let message = "all predictions are of a model that got only some inputs ('given'); add those with \
                                   all inputs";
                    return Err(refused(message).into());
                }
                rows.keys().flatten().try_for_each(|given| self.check_given(given))?;
                let of = |(given, rows): (Option<Vec<Modality>>, Vec<PredictedRow>)| {
                    let values = rows.into_iter().map(|row| value(samples.layout(), row));
                    let recorded = Recorded::new(model, samples, windows, asked, values).map_err(wrong)?;
                    Ok(recorded.with_given(given))
                };
                rows.into_iter().map(of).collect::<Result<Vec<_>, SubmissionError>>()?
            }
        };
        if recorded.is_empty() {
            return Err(wrong(RecordedError::Empty).into());
        }
        Ok(recorded)
    }

    fn check_given(&self, given: &[Modality]) -> Result<(), SubmissionError> {
        let input = &self.task.spec.input;
        let Some(&modality) = given.iter().find(|modality| !input.contains(modality)) else { return Ok(()) };
        let names: Vec<&str> = input.iter().map(|modality| modality.name()).collect();
        Err(refused(format!(
            "'given' has {modality}, which is no input of the task; its inputs are {}",
            names.join(", ")
        )))
    }
}

/// Returns the windows of a part whose context is in the part. Networks join shorter windows to sequences. A window
/// from the start of an episode has any context.
fn whole_windows(part: &[Sample], spec: &RunSpec) -> Vec<Sample> {
    match (spec.split.by, spec.window.start) {
        (Division::Sample, _) | (_, WindowStart::Rest) => part.to_vec(),
        (Division::Episode | Division::Label(_) | Division::Time, WindowStart::Random) => {
            ends(part, spec.window.context)
        }
    }
}

/// Returns the value of a row. The elements of an image are put in the order of channels.
fn value(layout: &Layout, row: PredictedRow) -> RecordedValue {
    let PredictedRow { episode, sample, horizon, modality, index, value } = row;
    let pixels =
        layout.get(modality).and_then(|definition| definition.size()).map(|[rows, columns]| rows * columns);
    let index = match pixels {
        Some(pixels) if index < pixels * IMAGE_CHANNELS => {
            index % IMAGE_CHANNELS * pixels + index / IMAGE_CHANNELS
        }
        _ => index,
    };
    RecordedValue { modality, episode, sample, horizon, index, value }
}

/// Predictions of the test windows of a task.
pub enum Predictions {
    /// Single values, as a file has them.
    Rows(PredictedRows),
    /// All values of a modality at a horizon, `[windows, width]` in physical units; images channel by channel.
    Windows(BTreeMap<(Modality, usize), Vec<f32>>),
    /// Those of the simulator itself, from the state at each present sample, rounded to f32, as far as it is known.
    Simulated(Knowledge),
    /// Those of a world whose actuators repeat the setpoints of each episode from its start.
    Replayed(Replay),
}

/// A model of another program with its predictions.
pub struct External {
    /// Name of the model.
    pub model: String,
    /// Seed of its training.
    pub seed: u64,
    /// What the user says about it, such as its commit.
    pub notes: BTreeMap<String, String>,
    /// The hash of the task that the predictions are for, if the user knows it.
    pub task: Option<String>,
    /// The file of the model, which is copied to the run.
    pub network: Option<PathBuf>,
    /// Its predictions.
    pub predictions: Predictions,
}

impl External {
    fn check(&self, task: &PredictionTask) -> Result<(), SubmissionError> {
        let Self { model, seed, notes, task: wanted, .. } = self;
        let is_allowed = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
        let begins = model.starts_with(|c: char| c.is_ascii_alphanumeric());
        if model.len() > 64 || !begins || !model.chars().all(is_allowed) {
            let name: String = model.escape_debug().take(80).collect();
            return Err(refused(format!(
                "'{name}' can't name a model; use 1 to 64 ASCII letters, digits, '_', '-' and '.', a letter or digit \
                 first"
            )));
        }
        if models::ALL.contains(&model.as_str()) {
            return Err(refused(format!("'{model}' is a model of the harness; give yours another name")));
        }
        if *seed > MAX_SEED {
            return Err(refused(format!("the seed {seed} is too large; use 0 to {MAX_SEED}")));
        }
        if notes.len() > MAX_NOTES {
            let count = notes.len();
            return Err(refused(format!("notes: there are {count}, at most {MAX_NOTES} are allowed")));
        }
        for (name, note) in notes {
            if name.trim().is_empty() {
                return Err(refused("notes: one has no name; write NAME=TEXT"));
            }
            if name.len() + note.len() > MAX_NOTE {
                let name: String = name.escape_debug().take(80).collect();
                return Err(refused(format!("notes: '{name}' has more than {MAX_NOTE} bytes")));
            }
        }
        self.attached_name()?;
        let found = task.hash();
        match wanted {
            Some(wanted) if *wanted != found => Err(refused(format!(
                "the predictions are for the task {wanted}, and this one is {found}: its dataset, split, inputs, \
                 outputs or window is another; predict the test windows of this task"
            ))),
            _ => Ok(()),
        }
    }

    /// The name that the file of the model gets in the run's folder: `network` and its ending.
    fn attached_name(&self) -> Result<Option<String>, SubmissionError> {
        let Some(path) = &self.network else { return Ok(None) };
        let refused = |problem: String| refused(format!("{}: {problem}", path.display()));
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
        if !NETWORKS.contains(&ending) {
            let endings = NETWORKS.map(|ending| format!(".{ending}")).join(", ");
            return Err(refused(format!("the name of a model's file must end in one of {endings}")));
        }
        match std::fs::File::open(path).and_then(|file| file.metadata()) {
            Ok(about) if about.is_file() => Ok(Some(format!("network.{ending}"))),
            Ok(_) => Err(refused("it is not a file".into())),
            Err(error) => Err(refused(error.to_string())),
        }
    }
}

/// The run of an external model.
pub struct JudgedRun {
    /// Its record.
    pub record: RunRecord,
    /// Whether the same predictions were judged before, so that nothing was written.
    pub was_done: bool,
}

impl Runner<'_> {
    /// Returns the tasks of an experiment that differ in their data, inputs, outputs or windows. Cells that differ only
    /// in their networks are one task.
    pub fn tasks(&self, experiment: &Experiment) -> Result<Vec<PredictionTask>, ExperimentError> {
        let mut specs: Vec<RunSpec> = Vec::new();
        let mut variants = Vec::new();
        for run in experiment.runs() {
            let spec = run.external("", "", 0);
            if !specs.contains(&spec) {
                specs.push(spec);
                variants.push(run.variant_parts().0.to_owned());
            }
        }
        let of = |((spec, source), variant)| PredictionTask {
            experiment: experiment.name.clone(),
            variant,
            spec,
            source,
        };
        let sources = sources(&self.registry.datasets(), experiment, specs)?;
        let mut tasks: Vec<PredictionTask> = sources.into_iter().zip(variants).map(of).collect();
        // A scenario with one task needs no variant to tell it from others.
        let place = |task: &PredictionTask| (task.spec.scenario.clone(), task.spec.dataset_seed());
        let places: Vec<_> = tasks.iter().map(place).collect();
        for task in &mut tasks {
            let own = place(task);
            if places.iter().filter(|place| **place == own).count() == 1 {
                task.variant.clear();
            }
        }
        Ok(tasks)
    }

    /// Opens the dataset of a task, which must be complete.
    ///
    /// # Errors
    /// When the dataset can't be read, or the split leaves no training samples.
    pub fn open_task(&self, task: PredictionTask) -> Result<OpenTask, ExperimentError> {
        let frames = self.frame_place(&task.spec, &task.source);
        self.check_room(&task.source, frames)?;
        let open = self.open(&task.spec, &task.source, frames)?;
        let Partition { training, validation, test } = &open.partition;
        let whole = |part| whole_windows(part, &task.spec);
        let windows =
            Partition { training: whole(training), validation: whole(validation), test: test.clone() };
        Ok(OpenTask { task, open, windows, references: OnceLock::new() })
    }

    /// Judges the predictions of a model of another program, and writes its run. The same predictions are not judged
    /// twice. Everything is checked before anything is written.
    ///
    /// # Errors
    /// When the predictions are incomplete or wrong, other predictions of the model with the same seed were judged
    /// before, or the run can't be written.
    pub fn judge(&self, task: &OpenTask, external: External) -> Result<JudgedRun, ExperimentError> {
        external.check(&task.task)?;
        let attached = external.attached_name()?;
        let External { model, seed, notes, network, predictions, .. } = external;
        let recorded = task.recorded(&model, predictions, self.progress)?;
        let spec = task.task.run(&model, seed);
        let source = &task.task.source;
        let (experiment, test) = (&task.task.experiment, source.test.as_ref().map(AnyDataset::name));
        let folder = self.registry.run_with_test(experiment, &spec, source.dataset.name(), test);
        let submission = Submission {
            task: task.task.hash(),
            predictions_sha256: digest(&recorded),
            notes,
            network: attached,
        };
        if let Some(record) = judged_before(self.registry, &folder, &submission)? {
            return Ok(JudgedRun { record, was_done: true });
        }
        let outcome = self.outcome(task, &recorded)?;
        if self.progress.cancelled() {
            return Err(ExperimentError::Cancelled);
        }
        let Some(claimed) = self.registry.claim(&folder)? else {
            let holder = FolderLock::holder(folder.path()).unwrap_or_else(|| "another process".into());
            let run = format!("{}/{}", task.task.experiment, folder.id());
            return Err(SubmissionError::Held { run, holder }.into());
        };
        // Another process may have written the run meanwhile.
        if let Some(record) = judged_before(self.registry, &folder, &submission)? {
            return Ok(JudgedRun { record, was_done: true });
        }
        let provenance = task.task.source.provenance(self.provenance);
        let record = claimed.begin(&spec, task.samples().layout(), &provenance)?;
        let record = RunRecord { submission: Some(submission.clone()), ..record };
        let attach = || match (&network, &submission.network) {
            (Some(file), Some(name)) => claimed.attach(file, name),
            _ => Ok(()),
        };
        if let Err(error) = attach().and_then(|()| claimed.finish(record.clone(), &outcome)) {
            // The disk may be full, so this can fail as well. The run is then listed as interrupted.
            let _ = claimed.fail(record, &describe(&error));
            return Err(error.into());
        }
        drop(claimed);
        let record = folder.record()?.unwrap_or(record);
        Ok(JudgedRun { record, was_done: false })
    }

    /// Judges predictions and returns all rows of the run.
    fn outcome(&self, task: &OpenTask, recorded: &[Recorded]) -> Result<Outcome, ExperimentError> {
        let references = task.references()?;
        let begin = Instant::now();
        let mut outcome = Outcome { forces: references.forces.clone(), ..Outcome::default() };
        outcome.extend(references.baselines.clone());
        let windows = &task.open.partition.test;
        self.progress.begin("judging", (windows.len() * recorded.len()) as u64, "windows");
        for predictor in recorded {
            let sampled = Some(&references.sampled[..]);
            let (samples, since_s) = (task.samples(), &task.task.spec.window.since_s);
            let test = Test { samples, task: Task::Prediction, windows, since_s, sampled };
            let judged = judge(predictor as &dyn Predictor, &test)?;
            outcome.extend(judged);
            self.progress.advance(windows.len() as u64);
        }
        self.progress.end();
        outcome.timings = Timings {
            collect: task.open.seconds + references.seconds,
            evaluation: begin.elapsed().as_secs_f64(),
            ..Timings::default()
        };
        Ok(outcome)
    }
}

/// Returns the record of the run if the same predictions were judged before.
///
/// # Errors
/// When these were other predictions.
fn judged_before(
    registry: &Registry,
    folder: &RunFolder,
    submission: &Submission,
) -> Result<Option<RunRecord>, ExperimentError> {
    let Some(record) = folder.record()?.filter(|record| record.status == Status::Done) else {
        return Ok(None);
    };
    if record.damage(Path::new(folder.path())).is_some() {
        return Ok(None);
    }
    let run = record.name();
    let remedy = registry.command(&format!("rm {}", quoted([&*run])));
    match &record.submission {
        Some(before) if before.predictions_sha256 == submission.predictions_sha256 => {
            if submission.network.is_some() && submission.network != before.network {
                let message =
                    format!("{run} was written without a file of its model; to attach one, first `{remedy}`");
                return Err(refused(message).into());
            }
            Ok(Some(record))
        }
        _ => {
            let message = format!(
                "{run} has other predictions of this model with this seed; use another name or seed, or first \
                 `{remedy}`"
            );
            Err(refused(message).into())
        }
    }
}

/// Returns the SHA-256 of all values, by the inputs that were given, modality and horizon.
fn digest(recorded: &[Recorded]) -> String {
    let mut hash = Sha256::new();
    for predictor in recorded {
        for ((modality, horizon), values) in predictor.values() {
            let given: Option<Vec<&str>> =
                predictor.inputs().map(|given| given.iter().map(|modality| modality.name()).collect());
            hash.update(format!("{given:?} {modality} {horizon} {}\n", values.len()));
            values.iter().for_each(|value| hash.update(value.to_le_bytes()));
        }
    }
    hex(&hash.finalize())
}
