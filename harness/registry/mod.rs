//! Runs on disk: a folder each, found by what decides the run, with its tables and a record of how it went.
//!
//! ```text
//! results/datasets/<scenario>-<hash>/episode_00000.parquet …
//! results/runs/<experiment>/<run id>/spec.yaml, run.json, uncommitted.diff,
//!     epochs.parquet, metrics.parquet, predictions.parquet, forces.parquet, frames.parquet,
//!     prediction.safetensors, reconstruction.safetensors
//! ```

mod provenance;
mod publish;
mod query;
mod record;
mod verify;

pub use provenance::{Provenance, peak_memory_bytes};
pub use publish::Published;
pub use query::{QueryError, query, query_latest, rows, save, table};
pub use record::{
    FileRecord, ForceRows, FrameRow, MetricRow, Outcome, PredictionRow, RunRecord, Status, Timings,
};
pub use verify::{Finding, Report};

use crate::files::{FolderLock, LockError, WriteError, write_bytes};
use crate::spec::{RunSpec, Task};
use crate::tables::TableError;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Raised whenever the same spec on the same data would train or be judged differently than before.
const REVISION: u32 = 3;
/// The file that says how a run went; one that says it is done was written after everything else.
const RECORD: &str = "run.json";
/// The file with a run's resolved spec.
const SPEC: &str = "spec.yaml";
/// The file with the changes of the source tree that no commit has.
const UNCOMMITTED: &str = "uncommitted.diff";

/// Why the registry could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum RegistryError {
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(transparent)]
    Lock(#[from] LockError),
    #[error(transparent)]
    Table(#[from] TableError),
    #[error("{} is no record of a run ({reason}); delete the folder and run the experiment again", path.display())]
    Record { path: PathBuf, reason: String },
    #[error("{} is damaged ({reason}); `harness verify` says what mends it", path.display())]
    File { path: PathBuf, reason: String },
    #[error("no run matches '{wanted}'{}; `harness ls` lists them", nearest.as_ref().map(|n| format!(", the nearest is '{n}'")).unwrap_or_default())]
    Unknown { wanted: String, nearest: Option<String> },
    #[error("'{wanted}' has no finished runs; those that have: {}", there.join(", "))]
    NothingFinished { wanted: String, there: Vec<String> },
    #[error("{} can't be published into itself; choose another folder", .0.display())]
    IntoItself(PathBuf),
    #[error("'{wanted}' matches several runs: {}", matches.join(", "))]
    Ambiguous { wanted: String, matches: Vec<String> },
}

/// What will happen to a run, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Decision {
    Run {
        reason: String,
    },
    /// A saved state of its training is there.
    Resume {
        reason: String,
    },
    /// Another process is at it.
    Running {
        holder: String,
    },
    Skip,
}

/// The results folder.
#[derive(Debug, Clone)]
pub struct Registry {
    root: PathBuf,
}

/// The place of one run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunFolder {
    path: PathBuf,
    experiment: String,
    id: String,
    dataset: String,
}

impl Registry {
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The folder of all datasets.
    pub fn datasets(&self) -> PathBuf {
        self.root.join("datasets")
    }

    fn runs(&self) -> PathBuf {
        self.root.join("runs")
    }

    /// The place of a run; two runs share it only if they must have the same result.
    pub fn run(&self, experiment: &str, spec: &RunSpec, dataset: &str) -> RunFolder {
        let identity = format!("{} {dataset} {REVISION}", spec.hash());
        let digest = Sha256::digest(identity);
        let hash: String = digest.iter().take(4).map(|byte| format!("{byte:02x}")).collect();
        let id = format!("{}-{hash}", spec.label());
        let path = self.runs().join(experiment).join(&id);
        RunFolder { path, experiment: experiment.to_owned(), id, dataset: dataset.to_owned() }
    }

    /// Checks that something can be written below the root, and leaves nothing there.
    pub fn check_writable(&self) -> Result<(), WriteError> {
        let attempt = std::fs::create_dir_all(&self.root).and_then(|()| tempfile::tempfile_in(&self.root));
        attempt.map(drop).map_err(|source| WriteError { path: self.root.clone(), source })
    }

    /// What is to be done about a run, by its folder and by `known`, the records of all runs.
    pub fn decide(&self, folder: &RunFolder, spec: &RunSpec, known: &[RunRecord]) -> Decision {
        let record = match folder.record() {
            // Nobody holds a run that is done, but for the moment in which its holder lets go.
            Ok(Some(record)) if record.status == Status::Done => return Decision::Skip,
            record => record,
        };
        if let Some(holder) = FolderLock::holder(&folder.path) {
            return Decision::Running { holder };
        }
        let reason = match record {
            Ok(Some(RunRecord { status: Status::Failed, reason, .. })) => {
                format!("it failed before: {}", reason.unwrap_or_default())
            }
            Ok(Some(_)) => "it was interrupted".into(),
            Ok(None) => why_new(folder, spec, known),
            Err(error) => error.to_string(),
        };
        let resumable =
            [Task::Prediction, Task::Reconstruction].iter().any(|task| folder.state(*task).exists());
        match resumable {
            true => Decision::Resume { reason: format!("{reason}; a saved state of its training is there") },
            false => Decision::Run { reason },
        }
    }

    /// Every run's record, by experiment and id; those that can't be read are left out, see [`Registry::damaged`].
    pub fn records(&self) -> Vec<RunRecord> {
        self.recorded().into_iter().map(|(_, record)| record).collect()
    }

    /// Every run's folder and record, likewise.
    fn recorded(&self) -> Vec<(PathBuf, RunRecord)> {
        let read = |folder: PathBuf| {
            let mut record = RunRecord::read(&folder.join(RECORD)).ok()??;
            if record.status == Status::Running && FolderLock::holder(&folder).is_none() {
                record.status = Status::Interrupted;
            }
            Some((folder, record))
        };
        self.run_folders().into_iter().filter_map(read).collect()
    }

    /// Why records can't be read, one error each.
    pub fn damaged(&self) -> Vec<RegistryError> {
        self.run_folders().iter().filter_map(|folder| RunRecord::read(&folder.join(RECORD)).err()).collect()
    }

    /// The folders of all runs, sorted.
    fn run_folders(&self) -> Vec<PathBuf> {
        let inside = |folder: &Path| -> Vec<PathBuf> {
            let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
            entries.map(|entry| entry.path()).filter(|path| path.is_dir()).collect()
        };
        let mut folders: Vec<PathBuf> =
            inside(&self.runs()).iter().flat_map(|experiment| inside(experiment)).collect();
        folders.sort();
        folders
    }

    /// The runs that count, in the order of their folders: done, and of several of the same cell and seed in an
    /// experiment the one that was started last.
    fn latest(&self) -> Vec<(PathBuf, RunRecord)> {
        let mut latest: BTreeMap<(String, String), (PathBuf, RunRecord)> = BTreeMap::new();
        for (folder, record) in self.recorded() {
            let key = (record.experiment.clone(), record.label());
            let newer = latest.get(&key).is_none_or(|(_, other)| other.started <= record.started);
            if record.status == Status::Done && newer {
                latest.insert(key, (folder, record));
            }
        }
        let mut latest: Vec<_> = latest.into_values().collect();
        latest.sort_by(|(a, _), (b, _)| a.cmp(b));
        latest
    }

    /// The one run whose id, or `experiment/id`, begins with `wanted`.
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
                Err(RegistryError::Unknown { wanted: wanted.to_owned(), nearest })
            }
            several => Err(RegistryError::Ambiguous {
                wanted: wanted.to_owned(),
                matches: several.iter().map(|record| name(record)).collect(),
            }),
        }
    }

    /// Makes this the only process, and the only thread, that works on a run; `None` if another does already.
    pub fn claim(&self, folder: &RunFolder) -> Result<Option<FolderLock>, RegistryError> {
        Ok(FolderLock::attempt(&folder.path)?)
    }

    /// Who works on a run, if anybody does.
    pub fn holder(&self, folder: &RunFolder) -> Option<String> {
        FolderLock::holder(&folder.path)
    }

    /// Writes that a run has begun: its resolved spec, its provenance, and a record without an end.
    pub fn begin(
        &self,
        folder: &RunFolder,
        spec: &RunSpec,
        by: &Provenance,
    ) -> Result<RunRecord, RegistryError> {
        write_bytes(&folder.path.join(SPEC), spec.to_yaml().as_bytes())?;
        if let Some(diff) = &by.uncommitted {
            write_bytes(&folder.path.join(UNCOMMITTED), diff.as_bytes())?;
        }
        let record = RunRecord::new(folder, spec, by);
        record.write(&folder.path.join(RECORD))?;
        Ok(record)
    }

    /// Writes that a run failed, and why.
    pub fn fail(&self, folder: &RunFolder, record: RunRecord, reason: &str) -> Result<(), RegistryError> {
        record.failed(reason).write(&folder.path.join(RECORD))
    }

    /// Writes a run's tables, then that it is done.
    pub fn finish(
        &self,
        folder: &RunFolder,
        record: RunRecord,
        outcome: &Outcome,
    ) -> Result<(), RegistryError> {
        let record = record.done(outcome);
        outcome.write_tables(folder, &record)?;
        let files = record.expected_files();
        record.with_files(folder, files)?.write(&folder.path.join(RECORD))?;
        folder.remove_states();
        Ok(())
    }
}

impl RunFolder {
    pub fn id(&self) -> &str {
        &self.id
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where the trained network of a task goes.
    pub fn checkpoint(&self, task: Task) -> PathBuf {
        self.path.join(format!("{}.safetensors", task.name()))
    }

    /// Where the state of an unfinished training is kept.
    pub fn state(&self, task: Task) -> PathBuf {
        self.path.join(format!("{}.state.safetensors", task.name()))
    }

    /// Removes the states of a run that is done. One that stays behind does no harm but takes room.
    pub fn remove_states(&self) {
        for task in [Task::Prediction, Task::Reconstruction] {
            let _ = std::fs::remove_file(self.state(task));
        }
    }

    /// How far the run is; `None` if it never began.
    pub fn record(&self) -> Result<Option<RunRecord>, RegistryError> {
        RunRecord::read(&self.path.join(RECORD))
    }
}

/// Why a run isn't one of those that are there: what differs from the nearest of them.
fn why_new(folder: &RunFolder, spec: &RunSpec, known: &[RunRecord]) -> String {
    let alike =
        |record: &&RunRecord| record.experiment == folder.experiment && record.label() == spec.label();
    let described = known.iter().filter(alike).map(|record| {
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

/// The settings in which two specs differ, as `training.epochs (5, now 200)`.
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

/// Every value of a tree that is no object, under its dotted key.
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
