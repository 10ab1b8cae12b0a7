//! The right to write into the folder of a run.

use super::record::IN_ITS_PLACE;
use super::{
    Outcome, Provenance, RECORD, Registry, RegistryError, RunFolder, RunRecord, SPEC, Status, UNCOMMITTED,
    peak_memory_bytes, removed,
};
use harness_shared::files::{FolderLock, write_bytes, write_whole};
use harness_spec::{Layout, RunSpec, Task};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A run whose folder this value has locked. Everything that a run writes is written by this value, or to the paths
/// that it names. No other process or thread works on the run until the value is dropped.
#[derive(Debug)]
pub struct Claimed<'a> {
    registry: &'a Registry,
    folder: &'a RunFolder,
    lock: FolderLock,
}

impl Registry {
    /// Locks a run's folder. Returns `None` if another process or thread holds the lock.
    ///
    /// # Errors
    /// When the lock file can't be created or locked.
    pub fn claim<'a>(&'a self, folder: &'a RunFolder) -> Result<Option<Claimed<'a>>, RegistryError> {
        let lock = FolderLock::attempt(&folder.path)?;
        Ok(lock.map(|lock| Claimed { registry: self, folder, lock }))
    }

    /// Removes the folder of a run that a longer training replaces, unless a process works there. Errors are ignored,
    /// because the next command on the experiment tries it again.
    pub fn supersede(&self, folder: &RunFolder) {
        if folder.path.exists()
            && let Ok(Some(run)) = self.claim(folder)
        {
            run.supersede();
        }
    }

    /// Removes the saved states of a run that is not trained on, unless a process works on it. Errors are ignored,
    /// because a remaining file only costs space.
    pub fn remove_states(&self, folder: &RunFolder) {
        if folder.has_state()
            && let Ok(Some(run)) = self.claim(folder)
        {
            run.remove_states();
        }
    }
}

impl Claimed<'_> {
    /// The run's folder.
    pub fn folder(&self) -> &RunFolder {
        self.folder
    }

    /// Path of the file with the saved state of an unfinished training.
    pub fn state(&self, task: Task) -> PathBuf {
        self.folder.state(task)
    }

    /// Writes the files of a run that starts: its resolved spec, the uncommitted changes of the source tree, and a
    /// record with the status `running`. Returns the record.
    ///
    /// # Errors
    /// When a file can't be written or removed, or a folder is in the place of one that the run would write at its end.
    pub fn begin(
        &self,
        spec: &RunSpec,
        layout: &Arc<Layout>,
        by: &Provenance,
    ) -> Result<RunRecord, RegistryError> {
        let path = &self.folder.path;
        let record = RunRecord::new(self.folder, spec, layout, by);
        let mut results = record.expected_files().into_iter().map(|name| path.join(name));
        if let Some(path) = results.find(|path| path.is_dir()) {
            return Err(RegistryError::File { path, reason: IN_ITS_PLACE.into() });
        }
        write_bytes(&path.join(SPEC), spec.to_yaml().as_bytes())?;
        let patch = path.join(UNCOMMITTED);
        match &by.uncommitted {
            Some(diff) => write_bytes(&patch, diff)?,
            // The run may have been started before, with other changes.
            None => removed(&patch, std::fs::remove_file(&patch))?,
        }
        record.write(&path.join(RECORD))?;
        Ok(record)
    }

    /// Copies the file of a model of another program to this run.
    ///
    /// # Errors
    /// When the file can't be read or written.
    pub fn attach(&self, file: &Path, name: &str) -> Result<(), RegistryError> {
        Ok(write_whole(&self.folder.path.join(name), |copy| std::fs::copy(file, copy).map(drop))?)
    }

    /// Copies the saved state of a shorter training to this run, if it has one and this run has none. Returns whether
    /// this run has a state. Without one its training starts from the beginning, with the same result.
    pub fn take_state(&self, shorter: &RunFolder, task: Task) -> bool {
        let (from, to) = (shorter.state(task), self.state(task));
        to.exists() || from.exists() && write_whole(&to, |file| std::fs::copy(&from, file).map(drop)).is_ok()
    }

    /// Writes the record of a failed run, with the reason.
    ///
    /// # Errors
    /// When the record can't be written.
    pub fn fail(&self, record: RunRecord, reason: &str) -> Result<(), RegistryError> {
        let (reason, peak_memory_bytes) = (Some(reason.to_owned()), peak_memory_bytes());
        let record = RunRecord { status: Status::Failed, reason, peak_memory_bytes, ..record };
        record.write(&self.folder.path.join(RECORD))
    }

    /// Writes a run's tables, then its record with the status `done`, and removes the saved states of its training,
    /// unless successive halving may continue it.
    ///
    /// # Errors
    /// When a file can't be written, or a file that the record lists can't be read.
    pub fn finish(&self, record: RunRecord, outcome: &Outcome) -> Result<(), RegistryError> {
        let record = RunRecord {
            status: Status::Done,
            timings: Some(outcome.timings),
            parameters: record.spec.trained().map(|_| outcome.parameters),
            peak_memory_bytes: peak_memory_bytes(),
            ..record
        };
        let mut files = record.expected_files();
        files.extend(outcome.write_tables(self.folder, &record)?);
        let may_continue = record.spec.may_continue();
        record.with_files(self.folder, files)?.write(&self.folder.path.join(RECORD))?;
        if !may_continue {
            self.remove_states();
        }
        Ok(())
    }

    /// Removes the run's folder, because a longer training replaces it. Errors are ignored, because the next command on
    /// the experiment tries it again.
    pub fn supersede(self) {
        let _ = self.registry.discard(&self.folder.path, self.lock);
    }

    fn remove_states(&self) {
        for task in [Task::Prediction, Task::Reconstruction] {
            let _ = std::fs::remove_file(self.state(task));
        }
    }
}
