//! Runs on disk: a folder each, found by what decides the run, with its tables and a record of how it went.
//!
//! ```text
//! results/datasets/<scenario>-<hash>/episode_00000.parquet …
//! results/runs/<experiment>/<run id>/spec.yaml, run.json, uncommitted.diff,
//!     epochs.parquet, metrics.parquet, predictions.parquet, forces.parquet, frames.parquet,
//!     prediction.safetensors, reconstruction.safetensors
//! results/compacted/<experiment>/<table>-<hash>.parquet      derived from the runs, see `compact`
//! ```

mod commands;
mod compact;
mod episodes;
mod folders;
mod provenance;
mod publish;
mod query;
mod record;
mod removal;
mod rows;
mod sql;
mod verify;

pub use commands::quoted;
pub use compact::RunTable;
pub use provenance::{Provenance, Versions, peak_memory_bytes};
pub use publish::Published;
pub use query::{QueryError, answer, query, query_of, rows, save, table};
pub use removal::{Garbage, Removable, Usage};
pub use record::{
    FileRecord, ForceRows, FrameRow, MetricRow, Outcome, PredictionRow, RunRecord, Status, Timings,
};
pub use rows::{Condition, Terms, conditions, implies};
pub use verify::{Finding, Report};

use commands::command_in;
use harness_shared::files::{FolderLock, LockError, WriteError, write_bytes};
use harness_spec::{Layout, RunSpec, Task};
use harness_tables::TableError;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// Raised whenever the same spec on the same data would train or be judged differently than before.
const REVISION: u32 = 3;
/// The results folder where none is named.
const DEFAULT_ROOT: &str = "results";
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
    #[error("there are no results in {}: {problem}; --results names the folder that runs were written to", root.display())]
    NoResults { root: PathBuf, problem: &'static str },
    #[error("{} is no record of a run ({reason}); `{}` says what mends it", path.display(), verify_command(path))]
    Record { path: PathBuf, reason: String },
    #[error("{} is the record of {of}, which belongs in another folder; `{}` says what to do", path.display(), verify_command(path))]
    Misplaced { path: PathBuf, of: String },
    #[error("{} is damaged ({reason}); `{}` says what mends it", path.display(), verify_command(path))]
    File { path: PathBuf, reason: String },
    #[error("{} lacks {missing} of its {episodes} episodes; `{}` says what mends it", path.display(), verify_command(path))]
    Incomplete { path: PathBuf, missing: usize, episodes: u32 },
    #[error("no run matches '{wanted}'{}; `{list}` lists them", nearest.as_ref().map(|n| format!(", the nearest is '{n}'")).unwrap_or_default())]
    Unknown { wanted: String, nearest: Option<String>, list: String },
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
    /// What reading it has left out so far, and why, by path.
    left_out: Arc<Mutex<BTreeMap<PathBuf, String>>>,
}

/// The runs of an experiment that are there, by their labels.
pub struct Known(BTreeMap<String, Vec<RunRecord>>);

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
        Self { root: root.into(), left_out: Arc::default() }
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
        let id = format!("{}-{}", spec.label(), identity(&spec.hash(), dataset, REVISION));
        let path = self.runs().join(experiment).join(&id);
        RunFolder { path, experiment: experiment.to_owned(), id, dataset: dataset.to_owned() }
    }

    /// Checks that there are results: whoever only reads would take a mistyped folder for one without runs.
    pub fn check_there(&self) -> Result<(), RegistryError> {
        let problem = match self.root.is_dir() {
            _ if self.runs().is_dir() || self.datasets().is_dir() => return Ok(()),
            true => "it holds neither runs nor datasets",
            false => "there is no such folder",
        };
        Err(RegistryError::NoResults { root: self.root.clone(), problem })
    }

    /// Checks that something can be written below the root, and leaves nothing there.
    pub fn check_writable(&self) -> Result<(), WriteError> {
        let attempt = std::fs::create_dir_all(&self.root).and_then(|()| tempfile::tempfile_in(&self.root));
        attempt.map(drop).map_err(|source| WriteError { path: self.root.clone(), source })
    }

    /// What is to be done about a run, by its folder and by the runs of its experiment that are known; and its record,
    /// if it has one.
    pub fn decide(&self, folder: &RunFolder, spec: &RunSpec, known: &Known) -> (Decision, Option<RunRecord>) {
        let record = folder.record();
        let reason = match &record {
            Ok(Some(record)) if record.status == Status::Done => match folder.damage(record) {
                // Nobody holds a run that is done, but for the moment in which its holder lets go.
                None => return (Decision::Skip, Some(record.clone())),
                Some(damage) => damage,
            },
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

    /// The runs of an experiment that are there, to say in what a new one differs from them.
    pub fn known(&self, experiment: &str) -> Known {
        let mut by_label: BTreeMap<String, Vec<RunRecord>> = BTreeMap::new();
        for (_, record) in self.recorded_of(experiment) {
            by_label.entry(record.label()).or_default().push(record);
        }
        Known(by_label)
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
                Err(RegistryError::Unknown { wanted: wanted.to_owned(), nearest, list: self.command("ls") })
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

/// The first digits of the hash of all that decides a run's result.
fn identity(spec_hash: &str, dataset: &str, revision: u32) -> String {
    let digest = Sha256::digest(format!("{spec_hash} {dataset} {revision}"));
    digest.iter().take(4).map(|byte| format!("{byte:02x}")).collect()
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
    ///
    /// # Errors
    /// When the record is damaged, or that of another run.
    pub fn record(&self) -> Result<Option<RunRecord>, RegistryError> {
        let path = self.path.join(RECORD);
        match RunRecord::read(&path)? {
            Some(record) if (&record.experiment, &record.run) != (&self.experiment, &self.id) => {
                Err(RegistryError::Misplaced { path, of: record.name() })
            }
            record => Ok(record),
        }
    }

    /// What is wrong with the first of its files that is not as its record says; `None` where all are whole.
    pub fn damage(&self, record: &RunRecord) -> Option<String> {
        record.damage(&self.path)
    }
}

impl Known {
    /// Why a run isn't one of these: what differs from the nearest of those of its label.
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

/// The command that verifies the results folder in which `path` lies.
fn verify_command(path: &Path) -> String {
    // How deep a run's file lies, then a dataset's, a misplaced run's, and a dataset.
    let names = [("runs", 3), ("datasets", 2), ("runs", 2), ("datasets", 1)];
    let is_place = |(name, depth): &(&str, usize)| {
        path.ancestors().nth(*depth).and_then(Path::file_name).is_some_and(|found| found == *name)
    };
    let root =
        names.iter().find(|place| is_place(place)).and_then(|(_, depth)| path.ancestors().nth(depth + 1));
    command_in(root.unwrap_or(Path::new(DEFAULT_ROOT)), "verify")
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
