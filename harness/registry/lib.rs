//! The results folder: a folder for each run, with the run's tables and a record of its status.
//!
//! A run's folder is named after a hash of everything that determines its result, so a run is found by its spec.
//!
//! ```text
//! results/datasets/<scenario>-<hash>/dataset.json, model.xml, episode_00000.parquet …
//! results/runs/<experiment>/<run id>/spec.yaml, run.json, uncommitted.diff,
//!     epochs.parquet, metrics.parquet, sums.parquet, predictions.parquet, forces.parquet, frames.parquet,
//!     prediction.safetensors, reconstruction.safetensors
//! results/runs/<experiment>/records.json, <table>.parquet    published runs, which share files, see `merged`
//! results/compacted/<experiment>/<table>-<hash>.parquet      copies of the runs' rows, see the crate `catalog`
//! results/compacted/<experiment>/checks.json                 which runs had intact files, see `checks`
//! ```

mod checks;
mod claimed;
mod columns;
mod command_line;
mod commands;
pub mod dataset;
mod error;
mod folders;
mod live;
mod losses;
mod mark;
mod merged;
mod names;
mod outcome;
mod own_metric;
mod provenance;
mod record;
pub mod transfer;
mod verify;
mod worlds;

pub use claimed::Claimed;
pub use columns::read_columns;
pub use commands::Asked;
pub use error::RegistryError;
pub use folders::{Recorded, Remembered};
pub use harness_shared::{path_word, quoted};
pub use live::{LiveEpochs, live_epochs, live_table};
pub use mark::Mark;
pub use merged::RECORDS;
pub use outcome::{ForceRows, Outcome};
pub use own_metric::{OwnMetric, OwnValue};
pub use provenance::{Provenance, Versions, peak_memory_bytes};
pub use record::{
    FileRecord, ForcesOf, RunRecord, Slice, Status, Submission, Timings, WorldOf, episodes_used, forces_of,
    is_network, runs_table,
};
pub use verify::{Finding, Report};
pub use worlds::{DatasetsNow, Outdated, UNKNOWN};

use checks::Checks;
use harness_shared::files::{FolderLock, LockError, WriteError, check_writable, folders};
use harness_shared::seal::hex;
use harness_spec::{RunSpec, Task};
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// The revision of the method. It is raised when the same spec on the same data would give other results than before.
const REVISION: u32 = 3;
/// The results folder that is used when the command line names none.
const DEFAULT_ROOT: &str = "results";
/// The file with a run's record. The record of a finished run is written after all other files.
pub const RECORD: &str = "run.json";
/// The file with a run's resolved spec.
pub const SPEC: &str = "spec.yaml";
/// The file with the uncommitted changes of the source tree, as a patch.
pub const UNCOMMITTED: &str = "uncommitted.diff";

/// What is wrong with a results folder that is a file.
const IS_FILE: &str = "it is a file, not a folder";

/// What will happen to a run, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Decision {
    /// The run starts from the beginning.
    Run {
        /// Why the run is needed.
        reason: String,
    },
    /// The run continues from a saved state of its training.
    Resume {
        /// Why the run is needed.
        reason: String,
    },
    /// Another process works on the run.
    Running {
        /// The process that holds the lock of the run's folder, such as `process 4711 on host`.
        holder: String,
    },
    /// The run is done, and all of its files are as they were written: they were compared with the record now or by an
    /// earlier plan, and their sizes, times and inodes have not changed since. Later damage that changes none of these,
    /// such as that of a failing disk, is found only by [`Registry::verify`].
    Skip,
    /// The run is a trial of a search, and its loss was no longer finite. Another attempt would end in the same way.
    Diverged {
        /// Why the run failed.
        reason: String,
    },
}

/// The results folder.
#[derive(Debug, Clone)]
pub struct Registry {
    root: PathBuf,
    /// The runs and datasets that have been left out so far, by path, each with the reason.
    left_out: Arc<Mutex<BTreeMap<PathBuf, String>>>,
    datasets_now: Option<DatasetsNow>,
}

/// The runs of an experiment that have a folder, for [`Registry::decide`].
pub struct Known {
    registry: Registry,
    /// The runs' folders, by [`RunSpec::label`]. Their records are read when they are needed.
    folders: HashMap<String, Vec<PathBuf>>,
    checks: Checks,
}

/// The folder of one run, which need not exist.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunFolder {
    path: PathBuf,
    experiment: String,
    id: String,
    dataset: String,
    test_dataset: Option<String>,
}

impl Registry {
    /// The results folder `root`, which need not exist yet.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into(), left_out: Arc::default(), datasets_now: None }
    }

    /// Path of the results folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The folder that contains all datasets.
    pub fn datasets(&self) -> PathBuf {
        self.root.join("datasets")
    }

    /// The file of the compiled model that a simulated dataset has, as MJCF. Datasets of earlier versions lack it.
    pub fn model(&self, dataset: &str) -> PathBuf {
        self.datasets().join(dataset).join(crate::dataset::MODEL)
    }

    /// The folder that contains all runs.
    pub fn runs(&self) -> PathBuf {
        self.root.join("runs")
    }

    /// Whether a run of an experiment has started, finished or not.
    pub fn has_runs(&self, experiment: &str) -> bool {
        self.runs().join(experiment).is_dir()
    }

    /// The folder with the copies of an experiment's tables, and what was checked of its runs. It can be deleted at any
    /// time.
    pub fn compacted(&self, experiment: &str) -> PathBuf {
        self.root.join("compacted").join(experiment)
    }

    /// The folder of the run with this spec on this dataset. Two runs have the same folder only if they have the same
    /// result.
    pub fn run(&self, experiment: &str, spec: &RunSpec, dataset: &str) -> RunFolder {
        self.run_with_test(experiment, spec, dataset, None)
    }

    /// Like [`run`](Self::run), for a run whose test has this dataset of its own.
    pub fn run_with_test(
        &self,
        experiment: &str,
        spec: &RunSpec,
        dataset: &str,
        test: Option<&str>,
    ) -> RunFolder {
        let id = format!("{}-{}", spec.label(), identity(&spec.hash(), &spec.data(dataset, test), REVISION));
        let path = self.runs().join(experiment).join(&id);
        RunFolder {
            path,
            experiment: experiment.to_owned(),
            id,
            dataset: dataset.to_owned(),
            test_dataset: test.map(str::to_owned),
        }
    }

    /// Checks that the folder contains runs or datasets. Commands that only read call this, because a mistyped path
    /// would otherwise look like a folder without runs.
    ///
    /// # Errors
    /// When the folder does not exist, or contains neither runs nor datasets.
    pub fn check_there(&self) -> Result<(), RegistryError> {
        let problem = match self.root.is_dir() {
            _ if self.runs().is_dir() || self.datasets().is_dir() => return Ok(()),
            true => "it holds neither runs nor datasets",
            false if self.root.exists() => IS_FILE,
            false => "there is no such folder",
        };
        Err(RegistryError::NoResults { root: self.root.clone(), problem })
    }

    /// Checks that files can be written to the results folder, with a temporary file. Creates the folder.
    pub fn check_writable(&self) -> Result<(), RegistryError> {
        let unwritable = |source| WriteError { path: self.root.clone(), source };
        if self.root.is_file() {
            return Err(unwritable(io::Error::new(ErrorKind::NotADirectory, IS_FILE)).into());
        }
        check_writable(&self.root).map_err(|error| match error {
            LockError::Unopened { source, .. } => unwritable(source).into(),
            refused => refused.into(),
        })
    }

    /// Decides whether to run, resume or skip a run. Also returns the run's record, if it has a readable one.
    ///
    /// `known` are the other runs of the experiment. The reason for a new run names the settings in which it differs
    /// from the most similar of them.
    pub fn decide(&self, folder: &RunFolder, spec: &RunSpec, known: &Known) -> (Decision, Option<RunRecord>) {
        let record = folder.record();
        let reason = match &record {
            Ok(Some(record)) if record.status == Status::Done => match known.checks.damage(folder, record) {
                // The lock is not checked: a finished run is only locked until its process releases the lock.
                None => return (Decision::Skip, Some(record.clone())),
                Some(damage) => damage,
            },
            Ok(Some(record)) if record.diverged => {
                let reason = record.reason.clone().unwrap_or_default();
                return (Decision::Diverged { reason }, Some(record.clone()));
            }
            Ok(Some(RunRecord { status: Status::Failed, reason, .. })) => {
                format!("it failed before: {}", reason.clone().unwrap_or_default())
            }
            Ok(Some(_)) => "it was interrupted".into(),
            Ok(None) => known.why_new(folder, spec),
            Err(error) => error.to_string(),
        };
        let decision = match FolderLock::holder(&folder.path) {
            Some(holder) => Decision::Running { holder },
            None if folder.has_state() => {
                Decision::Resume { reason: format!("{reason}; a saved state of its training is there") }
            }
            None => Decision::Run { reason },
        };
        (decision, record.ok().flatten())
    }

    /// The runs of an experiment, for [`decide`](Self::decide).
    pub fn known(&self, experiment: &str) -> Known {
        let mut by_label: HashMap<String, Vec<PathBuf>> = HashMap::new();
        let experiment_folder = self.runs().join(experiment);
        let published = self.published(&experiment_folder).unwrap_or_default();
        let published = published.into_iter().map(|(folder, _)| folder);
        for folder in folders(&experiment_folder).into_iter().chain(published) {
            let id = folder.file_name().unwrap_or_default().to_string_lossy();
            let label = id.rsplit_once('-').map_or(&*id, |(label, _)| label).to_owned();
            by_label.entry(label).or_default().push(folder);
        }
        Known { registry: self.clone(), folders: by_label, checks: Checks::of(self, experiment) }
    }
}

/// Passes on how the removal of a file or folder ended. That it is gone, or never was there, is not an error.
fn removed(path: &Path, result: io::Result<()>) -> Result<(), WriteError> {
    match result {
        Err(source) if source.kind() != ErrorKind::NotFound => {
            Err(WriteError { path: path.to_owned(), source })
        }
        _ => Ok(()),
    }
}

/// The end of a run's id: the first eight digits of a hash of everything that determines the run's result.
fn identity(spec_hash: &str, data: &str, revision: u32) -> String {
    hex(&Sha256::digest(format!("{spec_hash} {data} {revision}"))[..4])
}

impl RunFolder {
    /// The run's id, such as `empty-z4-seed0-5c94f6a8`.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Path of the file with the trained network of a task.
    pub fn checkpoint(&self, task: Task) -> PathBuf {
        self.path.join(format!("{}.safetensors", task.name()))
    }

    /// Path of the file with the saved state of an unfinished training. Only a [`Claimed`] run writes it.
    fn state(&self, task: Task) -> PathBuf {
        self.path.join(format!("{}.state.safetensors", task.name()))
    }

    /// Whether a state of the run's training is saved.
    fn has_state(&self) -> bool {
        [Task::Prediction, Task::Reconstruction].iter().any(|task| self.state(*task).exists())
    }

    /// The run's record, or `None` if the run has not started.
    pub fn record(&self) -> Result<Option<RunRecord>, RegistryError> {
        match merged::record_in(&self.path)? {
            Some(record) if (&record.experiment, &record.run) != (&self.experiment, &self.id) => {
                Err(RegistryError::Misplaced { path: self.path.join(RECORD), of: record.name() })
            }
            record => Ok(record),
        }
    }
}

impl Known {
    /// Remembers which runs had intact files, so that the next plan need not read them.
    pub fn remember(self) {
        self.checks.save();
    }

    /// Explains why a run is new: the settings in which it differs from the most similar run with the same label.
    fn why_new(&self, folder: &RunFolder, spec: &RunSpec) -> String {
        let alike = self.folders.get(&spec.label()).cloned().unwrap_or_default();
        let alike = self.registry.read(alike.into_iter().map(|folder| folder.join(RECORD)).collect());
        let described = alike.iter().map(|(_, record)| {
            let mut differences = differences(&record.spec, spec);
            if record.dataset != folder.dataset && differences.is_empty() {
                differences.push("the world, its model or MuJoCo".into());
            }
            (differences, &record.run)
        });
        match described.min_by_key(|(differences, _)| differences.len()) {
            Some((differences, run)) if differences.is_empty() => {
                format!("new; {run} has the same settings, but an earlier version of the program named it")
            }
            Some((differences, run)) => format!("new; {run} differs in {}", differences.join(", ")),
            None => "new".into(),
        }
    }
}

/// The settings in which two specs differ, such as `training.epochs (5, now 200)`.
fn differences(before: &RunSpec, now: &RunSpec) -> Vec<String> {
    let [before, now] = [before, now].map(|spec| leaves(&serde_json::to_value(spec).unwrap_or_default()));
    let keys: BTreeSet<&String> = before.keys().chain(now.keys()).collect();
    let shown = |value: Option<&Value>| value.map_or("unset".into(), Value::to_string);
    keys.into_iter()
        .filter(|key| before.get(*key) != now.get(*key))
        .map(|key| format!("{key} ({}, now {})", shown(before.get(key)), shown(now.get(key))))
        .collect()
}

/// All values of a tree, except objects, by their dotted keys.
pub fn leaves(tree: &Value) -> BTreeMap<String, Value> {
    let Value::Object(entries) = tree else { return BTreeMap::from([(String::new(), tree.clone())]) };
    let below = |(name, value): (&String, &Value)| {
        let key = |below: String| if below.is_empty() { name.clone() } else { format!("{name}.{below}") };
        leaves(value).into_iter().map(|(below, value)| (key(below), value)).collect::<Vec<_>>()
    };
    entries.iter().flat_map(below).collect()
}
