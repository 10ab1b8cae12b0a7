//! The right to write into the folder of a run.

use super::record::IN_ITS_PLACE;
use super::{
    FileRecord, Outcome, Provenance, RECORD, Registry, RegistryError, RunFolder, RunRecord, SPEC, Status,
    UNCOMMITTED, peak_memory_bytes, removed,
};
use harness_shared::files::{FolderLock, UNFINISHED, WriteError, sorted, write_bytes, write_whole};
use harness_spec::{Layout, RunSpec, Task};
use harness_tables::schema::Table;
use harness_tables::{sealed_table, write_table};
use polars::prelude::DataFrame;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A run whose folder this value has locked. Only this value writes into the folder, or names the paths of files that
/// are written there. No other process or thread works on the run until the value is dropped.
#[derive(Debug)]
pub struct Claimed<'a> {
    registry: &'a Registry,
    folder: &'a RunFolder,
    lock: FolderLock,
}

impl Registry {
    /// Locks a run's folder. Returns `None` if another process or thread holds the lock.
    pub fn claim<'a>(&'a self, folder: &'a RunFolder) -> Result<Option<Claimed<'a>>, RegistryError> {
        let lock = FolderLock::attempt(&folder.path)?;
        Ok(lock.map(|lock| Claimed { registry: self, folder, lock }))
    }

    /// Removes a folder that the caller has locked. It is renamed first, so that an interruption leaves no part of it
    /// under its name.
    pub fn discard(&self, folder: &Path, lock: FolderLock) -> Result<(), WriteError> {
        let aside = tempfile::Builder::new().prefix(&set_aside_prefix()).tempdir_in(&self.root);
        let aside = aside.map_err(|source| WriteError { path: folder.to_owned(), source })?.keep();
        // An empty folder is replaced.
        removed(folder, std::fs::rename(folder, &aside))?;
        drop(lock);
        removed(&aside, std::fs::remove_dir_all(&aside))
    }

    /// Removes what interruptions of [`discard`](Self::discard) have left. Errors are ignored, because it only takes
    /// space.
    pub fn remove_set_aside(&self) {
        let prefix = set_aside_prefix();
        let is_left = |path: &&PathBuf| {
            path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(&prefix))
        };
        for left in sorted(&self.root).iter().filter(is_left) {
            let _ = std::fs::remove_dir_all(left);
        }
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

/// The beginning of the names of folders that are being removed.
fn set_aside_prefix() -> String {
    format!("{UNFINISHED}removal-")
}

impl Claimed<'_> {
    /// The run's folder.
    pub fn folder(&self) -> &RunFolder {
        self.folder
    }

    /// Path of the file with the trained network of a task.
    pub fn checkpoint(&self, task: Task) -> PathBuf {
        self.folder.checkpoint(task)
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
        self.write_record(&record)?;
        Ok(record)
    }

    /// Copies the file of a model of another program to this run.
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
    pub fn fail(&self, record: RunRecord, reason: &str) -> Result<(), RegistryError> {
        let (reason, peak_memory_bytes) = (Some(reason.to_owned()), peak_memory_bytes());
        let record = RunRecord { status: Status::Failed, reason, peak_memory_bytes, ..record };
        self.write_record(&record)
    }

    /// Writes a run's tables, then its record with the status `done`, and removes the saved states of its training,
    /// unless successive halving may continue it.
    pub fn finish(&self, record: RunRecord, outcome: &Outcome) -> Result<(), RegistryError> {
        let record = RunRecord {
            status: Status::Done,
            timings: Some(outcome.timings),
            parameters: record.spec.trained().map(|_| outcome.parameters),
            peak_memory_bytes: peak_memory_bytes(),
            ..record
        };
        let mut files = record.expected_files();
        for (table, rows) in outcome.tables(&record)? {
            self.write_table(table, rows, &record)?;
            files.push(table.file_name());
        }
        let may_continue = record.spec.may_continue();
        self.write_record(&record.with_files(self.folder, files)?)?;
        if !may_continue {
            self.remove_states();
        }
        Ok(())
    }

    /// Replaces tables of a finished run, and lists them in its record. A run whose process is killed meanwhile is
    /// intact, because the record lists both the old file and the new one until all are replaced.
    pub fn replace_tables(
        &self,
        record: RunRecord,
        tables: Vec<(Table, DataFrame)>,
    ) -> Result<(), RegistryError> {
        let mut replaced = Vec::new();
        for (table, rows) in tables {
            let count = rows.height();
            let bytes = sealed_table(rows, &table.columns(), &record.stamp())?;
            replaced.push((table.file_name(), FileRecord::of(&bytes, Some(count)), bytes));
        }
        let mut pending = record.clone();
        for (name, next, _) in &replaced {
            if let Some(listed) = pending.files.get_mut(name) {
                listed.next = Some(Box::new(next.clone()));
            }
        }
        self.write_record(&pending)?;
        for (name, _, bytes) in &replaced {
            write_bytes(&self.folder.path.join(name), bytes)?;
        }
        let mut files = record.files.clone();
        files.extend(replaced.into_iter().map(|(name, file, _)| (name, file)));
        self.write_record(&RunRecord { files, ..record })
    }

    /// Writes a table of the run.
    fn write_table(&self, table: Table, rows: DataFrame, record: &RunRecord) -> Result<(), RegistryError> {
        let path = self.folder.path.join(table.file_name());
        Ok(write_table(&path, rows, &table.columns(), &record.stamp())?)
    }

    /// Writes the run's record.
    fn write_record(&self, record: &RunRecord) -> Result<(), RegistryError> {
        record.write(&self.folder.path.join(RECORD))
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
