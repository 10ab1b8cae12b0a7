//! The folders of runs: which records are used, and which are left out because they are damaged or in the wrong folder.

use super::mark::Mark;
use super::merged::{Merged, RECORDS, record_in};
use super::record::RunRecord;
use super::{RECORD, Registry, RegistryError, RunFolder, Status};
use harness_shared::files::{FolderLock, folders, sorted};
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError};

/// A run's folder and its record.
pub type Recorded = (PathBuf, RunRecord);

/// Records that were read before. [`Registry::refresh`] reads only those again that may have changed since.
#[derive(Default)]
pub struct Remembered {
    recorded: Arc<Vec<Recorded>>,
    /// What the file system said of each file with records.
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

    /// The folders and records of all runs, like [`records`](Self::records). Published runs that are merged have a folder
    /// only for their networks.
    pub fn recorded(&self) -> Vec<Recorded> {
        self.read(self.record_files())
    }

    /// Reads the records that may have changed since the last call with this memory. Returns whether any did.
    pub fn refresh(&self, memory: &mut Remembered) -> bool {
        let mark = |file: PathBuf| (Mark::of(&file), file);
        let files: Vec<(Option<Mark>, PathBuf)> = self.record_files().into_par_iter().map(mark).collect();
        let is_same = |(mark, file): &&(Option<Mark>, PathBuf)| {
            mark.is_some() && memory.marks.get(file) == mark.as_ref()
        };
        let same: HashSet<&Path> = files.iter().filter(is_same).map(|(_, file)| &**file).collect();
        // The status of a run that has not ended also depends on the lock of its folder.
        let is_known = |(folder, run): &Recorded| {
            matches!(run.status, Status::Done | Status::Failed) && same.contains(&*record_file(folder, run))
        };
        let before = Arc::unwrap_or_clone(std::mem::take(&mut memory.recorded));
        let (mut recorded, before): (Vec<Recorded>, Vec<Recorded>) = before.into_iter().partition(is_known);
        let mut before: HashMap<PathBuf, RunRecord> = before.into_iter().collect();
        let known: HashSet<PathBuf> = recorded.iter().map(|(folder, run)| record_file(folder, run)).collect();
        let unknown = files.iter().map(|(_, file)| file).filter(|file| !known.contains(*file));
        let mut changed = false;
        for (folder, record) in self.read(unknown.cloned().collect()) {
            changed |= before.remove(&folder).as_ref() != Some(&record);
            recorded.push((folder, record));
        }
        memory.recorded = Arc::new(one_each(recorded));
        memory.marks = files
            .into_iter()
            .filter_map(|(mark, file)| Some((file, mark.filter(Mark::is_settled)?)))
            .collect();
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

    /// The files with the records of all runs.
    fn record_files(&self) -> Vec<PathBuf> {
        let merged = folders(&self.runs()).into_iter().map(|experiment| experiment.join(RECORDS));
        let merged: Vec<PathBuf> = merged.filter(|file| file.is_file()).collect();
        let is_own = |file: &PathBuf| {
            // Beside merged runs, a folder without a record has the networks of one of them.
            let experiment = file.parent().and_then(Path::parent).unwrap_or(file);
            !merged.iter().any(|other| other.parent() == Some(experiment)) || file.is_file()
        };
        let own = self.run_folders().into_iter().map(|folder| folder.join(RECORD)).filter(is_own);
        own.chain(merged.iter().cloned()).collect()
    }

    /// The records in these files, sorted by folder. Those that can't be used are left out.
    pub(super) fn read(&self, files: Vec<PathBuf>) -> Vec<Recorded> {
        let read = files.into_par_iter().map(|file| (self.read_file(&file), file));
        let read: Vec<_> = read.collect();
        let kept = read.into_iter().flat_map(|(found, file)| {
            found.unwrap_or_else(|error| {
                self.leave_out(file.parent().unwrap_or(&file), format!("a run is left out: {error}"));
                Vec::new()
            })
        });
        one_each(kept.collect())
    }

    /// The records in a file, with the folders of their runs.
    fn read_file(&self, file: &Path) -> Result<Vec<Recorded>, RegistryError> {
        let folder = file.parent().unwrap_or(file);
        match file.ends_with(RECORDS) {
            true => self.published(folder),
            false => {
                Ok(self.read_run(folder)?.map(|record| (folder.to_owned(), record)).into_iter().collect())
            }
        }
    }

    /// The published runs in the folder of an experiment.
    ///
    /// # Errors
    /// When their records are damaged, or one is of another experiment.
    pub(super) fn published(&self, experiment: &Path) -> Result<Vec<Recorded>, RegistryError> {
        let own = |record: RunRecord| match self.folder_of(&record).path {
            folder if folder.parent() == Some(experiment) => Ok((folder, record)),
            _ => Err(RegistryError::Misplaced { path: experiment.join(RECORDS), of: record.name() }),
        };
        Merged::read(experiment)?.runs(experiment)?.into_iter().map(own).collect()
    }

    /// The record in a run's folder, or `None` if the run has not started. A record that says `running` is returned as
    /// `interrupted` if no process holds the folder's lock.
    ///
    /// # Errors
    /// When the record is damaged, missing next to results, or that of another run.
    pub fn read_run(&self, folder: &Path) -> Result<Option<RunRecord>, RegistryError> {
        let path = folder.join(RECORD);
        let Some(mut record) = record_in(folder)? else {
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

/// The file with the record of a run.
fn record_file(folder: &Path, record: &RunRecord) -> PathBuf {
    match folder.parent() {
        Some(experiment) if record.is_merged() => experiment.join(RECORDS),
        _ => folder.join(RECORD),
    }
}

/// The runs sorted by folder, each once. A run that was done again counts instead of its published copy.
fn one_each(mut recorded: Vec<Recorded>) -> Vec<Recorded> {
    recorded.sort_by(|(a, one), (b, other)| (a, one.is_merged()).cmp(&(b, other.is_merged())));
    recorded.dedup_by(|(next, _), (kept, _)| next == kept);
    recorded
}

/// Whether a folder contains folders, or files that a run writes after its record.
fn holds_results(folder: &Path) -> bool {
    let is_result = |path: &PathBuf| {
        path.is_dir() || path.extension().is_some_and(|ending| ending == "parquet" || ending == "safetensors")
    };
    sorted(folder).iter().any(is_result)
}
