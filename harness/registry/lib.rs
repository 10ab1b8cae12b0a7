//! The results folder: a folder for each run, with the run's tables and a record of its status.
//!
//! A run's folder is named after a hash of everything that determines its result, so a run is found by its spec.
//!
//! ```text
//! results/datasets/<scenario>-<hash>/episode_00000.parquet …
//! results/runs/<experiment>/<run id>/spec.yaml, run.json, uncommitted.diff,
//!     epochs.parquet, metrics.parquet, predictions.parquet, forces.parquet, frames.parquet,
//!     prediction.safetensors, reconstruction.safetensors
//! results/compacted/<experiment>/<table>-<hash>.parquet      copies of the runs' rows, see `compact`
//! results/specs/<dataset>.yaml        collects a dataset that unpacked runs used and that was not packed
//! ```

mod command_line;
mod commands;
mod compact;
mod episodes;
mod error;
mod folders;
mod live;
mod losses;
mod mark;
mod pack;
mod provenance;
mod publish;
mod query;
mod record;
mod removal;
mod rows;
mod sql;
mod verify;

pub use command_line::quoted;
pub use compact::RunTable;
pub use error::{QueryError, RegistryError};
pub use folders::{Recorded, Remembered};
pub use live::{LiveEpochs, live_epochs};
pub use pack::{PackError, Packed, Unpacked};
pub use provenance::{Provenance, Versions, peak_memory_bytes};
pub use publish::Published;
pub use query::{answer, query, query_of, rows, save, table};
pub use record::{
    FileRecord, ForceRows, FrameRow, MetricRow, Outcome, PredictionRow, RunRecord, Status, Timings,
};
pub use removal::{Garbage, Removable, Usage};
pub use rows::{Condition, Terms, conditions, implies};
pub use verify::{Finding, Report};

use harness_shared::files::{FolderLock, WriteError, write_bytes, write_whole};
use harness_spec::{Layout, RunSpec, Task};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// The revision of the method. It is raised when the same spec on the same data would give other results than before.
const REVISION: u32 = 3;
/// The results folder that is used when the command line names none.
const DEFAULT_ROOT: &str = "results";
/// The file with a run's record. The record of a finished run is written after all other files.
const RECORD: &str = "run.json";
/// The file with a run's resolved spec.
const SPEC: &str = "spec.yaml";
/// The file with the uncommitted changes of the source tree, as a patch.
const UNCOMMITTED: &str = "uncommitted.diff";

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
    /// The run is done, and all of its files are as they were written.
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
}

/// The recorded runs of an experiment, by [`RunRecord::label`].
pub struct Known(BTreeMap<String, Vec<RunRecord>>);

/// The folder of one run, which need not exist.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunFolder {
    path: PathBuf,
    experiment: String,
    id: String,
    dataset: String,
}

impl Registry {
    /// The results folder `root`, which need not exist yet.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into(), left_out: Arc::default() }
    }

    /// Path of the results folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The folder that contains all datasets.
    pub fn datasets(&self) -> PathBuf {
        self.root.join("datasets")
    }

    /// The spec that collects a dataset which unpacked runs used, if the dataset was not packed.
    pub fn dataset_spec(&self, dataset: &str) -> PathBuf {
        self.root.join("specs").join(format!("{dataset}.yaml"))
    }

    fn runs(&self) -> PathBuf {
        self.root.join("runs")
    }

    /// The folder of the run with this spec on this dataset. Two runs have the same folder only if they have the same
    /// result.
    pub fn run(&self, experiment: &str, spec: &RunSpec, dataset: &str) -> RunFolder {
        let id = format!("{}-{}", spec.label(), identity(&spec.hash(), dataset, REVISION));
        let path = self.runs().join(experiment).join(&id);
        RunFolder { path, experiment: experiment.to_owned(), id, dataset: dataset.to_owned() }
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
            false => "there is no such folder",
        };
        Err(RegistryError::NoResults { root: self.root.clone(), problem })
    }

    /// Checks that files can be written to the results folder, with a temporary file. Creates the folder.
    ///
    /// # Errors
    /// When the folder or a file in it can't be created.
    pub fn check_writable(&self) -> Result<(), WriteError> {
        let attempt = std::fs::create_dir_all(&self.root).and_then(|()| tempfile::tempfile_in(&self.root));
        attempt.map(drop).map_err(|source| WriteError { path: self.root.clone(), source })
    }

    /// Decides whether to run, resume or skip a run. Also returns the run's record, if it has a readable one.
    ///
    /// `known` are the other runs of the experiment. The reason for a new run names the settings in which it differs
    /// from the most similar of them.
    pub fn decide(&self, folder: &RunFolder, spec: &RunSpec, known: &Known) -> (Decision, Option<RunRecord>) {
        let record = folder.record();
        let reason = match &record {
            Ok(Some(record)) if record.status == Status::Done => match folder.damage(record) {
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
        let resumable =
            [Task::Prediction, Task::Reconstruction].iter().any(|task| folder.state(*task).exists());
        let decision = match FolderLock::holder(&folder.path) {
            Some(holder) => Decision::Running { holder },
            None if resumable => {
                Decision::Resume { reason: format!("{reason}; a saved state of its training is there") }
            }
            None => Decision::Run { reason },
        };
        (decision, record.ok().flatten())
    }

    /// The recorded runs of an experiment, for [`decide`](Self::decide).
    pub fn known(&self, experiment: &str) -> Known {
        let mut by_label: BTreeMap<String, Vec<RunRecord>> = BTreeMap::new();
        for (_, record) in self.recorded_of(experiment) {
            by_label.entry(record.label()).or_default().push(record);
        }
        Known(by_label)
    }

    /// The only run whose id, or `experiment/id`, begins with `wanted`.
    ///
    /// # Errors
    /// When no run matches, or several do.
    pub fn find(&self, wanted: &str) -> Result<(RunFolder, RunRecord), RegistryError> {
        let records = self.records();
        let name = |record: &RunRecord| format!("{}/{}", record.experiment, record.run);
        let matches: Vec<&RunRecord> = records
            .iter()
            .filter(|record| record.run.starts_with(wanted) || name(record).starts_with(wanted))
            .collect();
        match matches.as_slice() {
            [record] => {
                let folder = RunFolder {
                    path: self.runs().join(&record.experiment).join(&record.run),
                    experiment: record.experiment.clone(),
                    id: record.run.clone(),
                    dataset: record.dataset.clone(),
                };
                Ok((folder, (*record).clone()))
            }
            [] => {
                let nearest = records.iter().map(|record| record.run.clone());
                let nearest = nearest.max_by(|a, b| {
                    strsim::jaro_winkler(wanted, a).total_cmp(&strsim::jaro_winkler(wanted, b))
                });
                Err(RegistryError::Unknown { wanted: wanted.to_owned(), nearest, list: self.command("ls") })
            }
            several => Err(RegistryError::Ambiguous {
                wanted: wanted.to_owned(),
                matches: several.iter().map(|record| name(record)).collect(),
            }),
        }
    }

    /// Locks a run's folder, so that only the holder of the lock works on the run. Returns `None` if another process or
    /// thread holds the lock.
    ///
    /// # Errors
    /// When the lock file can't be created or locked.
    pub fn claim(&self, folder: &RunFolder) -> Result<Option<FolderLock>, RegistryError> {
        Ok(FolderLock::attempt(&folder.path)?)
    }

    /// The process that holds the lock of a run's folder, such as `process 4711 on host`, or `None`.
    pub fn holder(&self, folder: &RunFolder) -> Option<String> {
        FolderLock::holder(&folder.path)
    }

    /// Writes the files of a run that starts: its resolved spec, the uncommitted changes of the source tree, and a
    /// record with the status `running`. Returns the record.
    ///
    /// # Errors
    /// When a file can't be written.
    pub fn begin(
        &self,
        folder: &RunFolder,
        spec: &RunSpec,
        layout: &Arc<Layout>,
        by: &Provenance,
    ) -> Result<RunRecord, RegistryError> {
        write_bytes(&folder.path.join(SPEC), spec.to_yaml().as_bytes())?;
        if let Some(diff) = &by.uncommitted {
            write_bytes(&folder.path.join(UNCOMMITTED), diff.as_bytes())?;
        }
        let record = RunRecord::new(folder, spec, layout, by);
        record.write(&folder.path.join(RECORD))?;
        Ok(record)
    }

    /// Writes the record of a failed run, with the reason.
    ///
    /// # Errors
    /// When the record can't be written.
    pub fn fail(&self, folder: &RunFolder, record: RunRecord, reason: &str) -> Result<(), RegistryError> {
        record.failed(reason).write(&folder.path.join(RECORD))
    }

    /// Writes a run's tables, then its record with the status `done`, and removes the saved states of its training, unless
    /// successive halving may continue it.
    ///
    /// # Errors
    /// When a file can't be written, or a file that the record lists can't be read.
    pub fn finish(
        &self,
        folder: &RunFolder,
        record: RunRecord,
        outcome: &Outcome,
    ) -> Result<(), RegistryError> {
        let record = record.done(outcome);
        outcome.write_tables(folder, &record)?;
        let files = record.expected_files();
        let may_continue = record.spec.may_continue();
        record.with_files(folder, files)?.write(&folder.path.join(RECORD))?;
        if !may_continue {
            folder.remove_states();
        }
        Ok(())
    }
}

/// The end of a run's id: the first eight digits of a hash of everything that determines the run's result.
fn identity(spec_hash: &str, dataset: &str, revision: u32) -> String {
    let digest = Sha256::digest(format!("{spec_hash} {dataset} {revision}"));
    digest.iter().take(4).map(|byte| format!("{byte:02x}")).collect()
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

    /// Path of the file with the saved state of an unfinished training.
    pub fn state(&self, task: Task) -> PathBuf {
        self.path.join(format!("{}.state.safetensors", task.name()))
    }

    /// Copies the saved state of a shorter training to this run, if it has one and this run has none. Returns whether this
    /// run has a state. Without one its training starts from the beginning, with the same result.
    pub fn take_state(&self, shorter: &RunFolder, task: Task) -> bool {
        let (from, to) = (shorter.state(task), self.state(task));
        to.exists() || from.exists() && write_whole(&to, |file| std::fs::copy(&from, file).map(drop)).is_ok()
    }

    /// Removes the saved states of a finished run. Errors are ignored, because a remaining file only costs space.
    pub fn remove_states(&self) {
        for task in [Task::Prediction, Task::Reconstruction] {
            let _ = std::fs::remove_file(self.state(task));
        }
    }

    /// The run's record, or `None` if the run has not started.
    ///
    /// # Errors
    /// When the record is damaged, or is that of another run.
    pub fn record(&self) -> Result<Option<RunRecord>, RegistryError> {
        let path = self.path.join(RECORD);
        match RunRecord::read(&path)? {
            Some(record) if (&record.experiment, &record.run) != (&self.experiment, &self.id) => {
                Err(RegistryError::Misplaced { path, of: record.name() })
            }
            record => Ok(record),
        }
    }

    /// Describes the first file that differs from what `record` lists, or returns `None` if all files are intact.
    pub fn damage(&self, record: &RunRecord) -> Option<String> {
        record.damage(&self.path)
    }
}

impl Known {
    /// Explains why a run is new: the settings in which it differs from the most similar run with the same label.
    fn why_new(&self, folder: &RunFolder, spec: &RunSpec) -> String {
        let alike = self.0.get(&spec.label()).into_iter().flatten();
        let described = alike.map(|record| {
            let mut differences = differences(&record.spec, spec);
            if record.dataset != folder.dataset && differences.is_empty() {
                differences.push("the model or MuJoCo".into());
            }
            (differences, &record.run)
        });
        match described.min_by_key(|(differences, _)| differences.len()) {
            Some((differences, run)) => format!("new; {run} differs in {}", differences.join(", ")),
            None => "new".into(),
        }
    }
}

/// The settings in which two specs differ, such as `training.epochs (5, now 200)`.
fn differences(before: &RunSpec, now: &RunSpec) -> Vec<String> {
    let leaves = |spec: &RunSpec| {
        let mut leaves = BTreeMap::new();
        collect_leaves("", &serde_json::to_value(spec).unwrap_or_default(), &mut leaves);
        leaves
    };
    let (before, now) = (leaves(before), leaves(now));
    let keys: std::collections::BTreeSet<&String> = before.keys().chain(now.keys()).collect();
    let shown = |value: Option<&String>| value.cloned().unwrap_or_else(|| "unset".into());
    keys.into_iter()
        .filter(|key| before.get(*key) != now.get(*key))
        .map(|key| format!("{key} ({}, now {})", shown(before.get(key)), shown(now.get(key))))
        .collect()
}

/// Collects all values of a tree, except objects, by their dotted keys.
fn collect_leaves(key: &str, value: &serde_json::Value, leaves: &mut BTreeMap<String, String>) {
    match value {
        serde_json::Value::Object(entries) => {
            for (name, value) in entries {
                let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
                collect_leaves(&key, value, leaves);
            }
        }
        other => {
            leaves.insert(key.to_owned(), other.to_string());
        }
    }
}
