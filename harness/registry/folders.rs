//! The folders of runs: which records are used, and which are left out because they are damaged or in the wrong folder.

use super::mark::Mark;
use super::record::RunRecord;
use super::{RECORD, Registry, RegistryError, RunFolder, Status};
use crate::dataset::WorldVersion;
use harness_shared::files::{FolderLock, folders, sorted};
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// The versions of the worlds of datasets that were read so far.
type Versions = Mutex<HashMap<String, Option<WorldVersion>>>;

/// A run's folder and its record.
pub type Recorded = (PathBuf, RunRecord);

/// Records that were read before. [`Registry::refresh`] reads only those again that may have changed since.
#[derive(Default)]
pub struct Remembered {
    recorded: Arc<Vec<Recorded>>,
    /// What the file system said of each record's file, by the run's folder.
    marks: HashMap<PathBuf, Mark>,
}

impl Remembered {
    /// The folders and records of all runs, sorted by experiment and id.
    pub fn recorded(&self) -> &Arc<Vec<Recorded>> {
        &self.recorded
    }
}

impl Registry {
    /// The records of all runs, sorted by experiment and id. A record that can't be read, or that is in the folder of
    /// another run, is left out; see [`Registry::left_out`].
    pub fn records(&self) -> Vec<RunRecord> {
        self.recorded().into_iter().map(|(_, record)| record).collect()
    }

    /// The folders and records of all runs, like [`records`](Self::records).
    pub fn recorded(&self) -> Vec<Recorded> {
        self.read(self.run_folders())
    }

    /// Reads the records that may have changed since the last call with this memory. Returns whether any did.
    pub fn refresh(&self, memory: &mut Remembered) -> bool {
        let mut recorded = Arc::unwrap_or_clone(std::mem::take(&mut memory.recorded));
        let mut before: HashMap<PathBuf, RunRecord> = recorded.drain(..).collect();
        let folders: Vec<(PathBuf, Option<Mark>)> = self
            .run_folders()
            .into_par_iter()
            .map(|folder| {
                let mark = Mark::of(&folder.join(RECORD));
                (folder, mark)
            })
            .collect();
        let is_known = |folder: &PathBuf, mark: &Option<Mark>| {
            // The status of a run that has not ended also depends on the lock of its folder.
            let has_ended = |run: &RunRecord| matches!(run.status, Status::Done | Status::Failed);
            mark.is_some()
                && memory.marks.get(folder) == mark.as_ref()
                && before.get(folder).is_some_and(has_ended)
        };
        let (known, unknown): (Vec<_>, Vec<_>) =
            folders.into_iter().partition(|(folder, mark)| is_known(folder, mark));
        let read = self.read(unknown.iter().map(|(folder, _)| folder.clone()).collect());
        let mut changed = false;
        for (folder, _) in &known {
            recorded.extend(before.remove_entry(folder));
        }
        for (folder, record) in read {
            changed |= before.remove(&folder).as_ref() != Some(&record);
            recorded.push((folder, record));
        }
        recorded.sort_by(|(a, _), (b, _)| a.cmp(b));
        memory.recorded = Arc::new(recorded);
        let settled = known.into_iter().chain(unknown);
        memory.marks =
            settled.filter_map(|(folder, mark)| Some((folder, mark.filter(Mark::is_settled)?))).collect();
        changed || !before.is_empty()
    }

    /// The runs and datasets that all reads so far have left out: a sentence for each, with the reason.
    pub fn left_out(&self) -> Vec<String> {
        let left_out = self.left_out.lock().unwrap_or_else(PoisonError::into_inner);
        left_out.values().cloned().collect()
    }

    /// Whether the reads so far have left out a run.
    pub fn leaves_out_runs(&self) -> bool {
        let left_out = self.left_out.lock().unwrap_or_else(PoisonError::into_inner);
        left_out.keys().any(|path| path.starts_with(self.runs()))
    }

    /// Remembers that the run or dataset in a folder is left out. `why` is the whole message.
    pub fn leave_out(&self, path: &Path, why: String) {
        let mut left_out = self.left_out.lock().unwrap_or_else(PoisonError::into_inner);
        left_out.insert(path.to_owned(), why);
    }

    /// The folders of all runs, sorted. A run's folder in the place of an experiment's folder is included, and comes
    /// first.
    pub(super) fn run_folders(&self) -> Vec<PathBuf> {
        let experiments = folders(&self.runs());
        let (misplaced, experiments): (Vec<PathBuf>, Vec<PathBuf>) =
            experiments.into_iter().partition(|folder| folder.join(RECORD).is_file());
        misplaced.into_iter().chain(experiments.iter().flat_map(|experiment| folders(experiment))).collect()
    }

    /// The records in these folders. Those that can't be used are left out.
    pub(super) fn read(&self, folders: Vec<PathBuf>) -> Vec<Recorded> {
        let versions = Mutex::default();
        let read = folders.into_par_iter().map(|folder| (self.read_versioned(&folder, &versions), folder));
        let read: Vec<_> = read.collect();
        let kept = read.into_iter().filter_map(|(record, folder)| match record {
            Ok(record) => Some((folder, record?)),
            Err(error) => {
                self.leave_out(&folder, format!("a run is left out: {error}"));
                None
            }
        });
        kept.collect()
    }

    /// The record in a run's folder. The version of its world, which earlier versions of the program did not record, is
    /// that of its dataset.
    fn read_versioned(&self, folder: &Path, known: &Versions) -> Result<Option<RunRecord>, RegistryError> {
        let Some(mut record) = self.read_run(folder)? else { return Ok(None) };
        if record.provenance.world.is_none() && record.spec.simulation.is_some() {
            let mut known = known.lock().unwrap_or_else(PoisonError::into_inner);
            let version = known.entry(record.dataset.clone());
            let read = || WorldVersion::in_folder(&self.datasets().join(&record.dataset));
            record.provenance.world = version.or_insert_with(read).clone();
        }
        Ok(Some(record))
    }

    /// The record in a run's folder, or `None` if the run has not started. A record that says `running` is returned as
    /// `interrupted` if no process holds the folder's lock.
    ///
    /// # Errors
    /// When the record is damaged, missing next to results, or that of another run.
    pub fn read_run(&self, folder: &Path) -> Result<Option<RunRecord>, RegistryError> {
        let path = folder.join(RECORD);
        let Some(mut record) = RunRecord::read(&path)? else {
            return match holds_results(folder) {
                true => Err(RegistryError::Record { path, reason: "there is no such file".into() }),
                false => Ok(None),
            };
        };
        if self.folder_of(&record).path != folder {
            return Err(RegistryError::Misplaced { path, of: record.name() });
        }
        if record.status == Status::Running && FolderLock::holder(folder).is_none() {
            record.status = Status::Interrupted;
        }
        Ok(Some(record))
    }

    /// The folder in which a run's record belongs.
    pub fn folder_of(&self, record: &RunRecord) -> RunFolder {
        RunFolder {
            path: self.runs().join(&record.experiment).join(&record.run),
            experiment: record.experiment.clone(),
            id: record.run.clone(),
            dataset: record.dataset.clone(),
            test_dataset: record.test_dataset.clone(),
        }
    }
}

/// Whether a folder contains folders, or files that a run writes after its record.
fn holds_results(folder: &Path) -> bool {
    let is_result = |path: &PathBuf| {
        path.is_dir() || path.extension().is_some_and(|ending| ending == "parquet" || ending == "safetensors")
    };
    sorted(folder).iter().any(is_result)
}
