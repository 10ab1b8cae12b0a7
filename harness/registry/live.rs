//! The epochs of trainings that are running, so that queries and `harness watch` show them before the run is done.
//!
//! While a run is trained, its folder holds a file with all epochs so far. It is written at the first epoch of each
//! task and then about once a second, and removed at the end of the training for any reason. Its name is that of an
//! unfinished file, so that it is also removed when a process takes the place of one that was killed. Only the rows of
//! runs with the status `running` are read from it.

use super::Claimed;
use super::outcome::epochs_columns;
use super::record::RunRecord;
use harness_metrics::epoch::Epoch;
use harness_shared::files::UNFINISHED;
use harness_shared::seal;
use harness_spec::Task;
use polars::prelude::{DataFrame, PolarsResult};
use serde_json::json;
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The least time between two writes of epochs of the same task.
const INTERVAL: Duration = Duration::from_secs(1);
/// The file's key of the epochs.
const EPOCHS: &str = "epochs";

/// Publishes the epochs of one running training until it is dropped.
pub struct LiveEpochs<'a> {
    run: &'a Claimed<'a>,
    epochs: RefCell<BTreeMap<Task, Vec<Epoch>>>,
    written: Cell<Option<Instant>>,
}

impl<'a> LiveEpochs<'a> {
    /// The epochs of a run.
    pub fn of(run: &'a Claimed) -> Self {
        Self { run, epochs: RefCell::default(), written: Cell::default() }
    }

    /// Sets the epochs of a task so far, which begin with those of the last call for the task.
    pub fn set(&self, task: Task, epochs: &[Epoch]) {
        let mut all = self.epochs.borrow_mut();
        let own = all.entry(task).or_default();
        let begins = own.is_empty();
        own.extend_from_slice(epochs.get(own.len()..).unwrap_or_default());
        if begins || self.written.get().is_none_or(|written| written.elapsed() >= INTERVAL) {
            let text = json!({ (EPOCHS): rows(&all), (seal::KEY): seal::BLANK }).to_string();
            // Without the file, the epochs appear at the end of the run. That is no reason to stop the training.
            let _ = seal::write(&path(self.run.folder().path()), text.into_bytes());
            self.written.set(Some(Instant::now()));
        }
    }
}

impl Drop for LiveEpochs<'_> {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(path(self.run.folder().path()));
    }
}

fn path(folder: &Path) -> PathBuf {
    folder.join(format!("{UNFINISHED}epochs.json"))
}

fn rows(epochs: &BTreeMap<Task, Vec<Epoch>>) -> Vec<(Task, &Epoch)> {
    epochs.iter().flat_map(|(task, epochs)| epochs.iter().map(|epoch| (*task, epoch))).collect()
}

/// The epochs of the run that is being trained in a folder. Empty before the first epoch, and if the training ends
/// while this function reads.
pub fn live_epochs(folder: &Path) -> Vec<(Task, Epoch)> {
    let read = || {
        let bytes = seal::read(&path(folder)).ok()?;
        let mut file: serde_json::Value = serde_json::from_slice(&bytes).ok()?;
        serde_json::from_value(file[EPOCHS].take()).ok()
    };
    read().unwrap_or_default()
}

/// The rows of the table `epochs` of a running run.
pub fn live_table(folder: &Path, record: &RunRecord) -> PolarsResult<DataFrame> {
    record.with_key(epochs_columns(&live_epochs(folder)))
}
