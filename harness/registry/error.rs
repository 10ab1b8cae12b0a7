//! The errors of this crate.

use super::DEFAULT_ROOT;
use super::command_line::command_in;
use harness_shared::files::{LockError, WriteError};
use harness_tables::TableError;
use polars::prelude::PolarsError;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An error in reading or writing the results folder.
#[derive(Debug, thiserror::Error)]
pub enum RegistryError {
    /// A file can't be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A folder can't be locked.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// A table can't be read or written.
    #[error(transparent)]
    Table(#[from] TableError),
    /// The results folder does not exist, or contains no results.
    #[error("there are no results in {}: {problem}; --results names the folder that runs were written \
             to", root.display())]
    NoResults {
        /// The results folder.
        root: PathBuf,
        /// Whether the folder or its contents are missing, in words.
        problem: &'static str,
    },
    /// A run's record is damaged or missing.
    #[error("{} is not the record of a run ({reason}); `{}` says how to repair \
             it", path.display(), verify_command(path))]
    Record {
        /// The record's path.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A folder contains the record of another run.
    #[error("{} is the record of {of}, which belongs in another folder; `{}` says what to \
             do", path.display(), verify_command(path))]
    Misplaced {
        /// The record's path.
        path: PathBuf,
        /// The run that the record describes, as `experiment/run`.
        of: String,
    },
    /// A file of a run or dataset is damaged or missing.
    #[error("{} is damaged ({reason}); `{}` says how to repair it", path.display(), verify_command(path))]
    File {
        /// The file's path.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A dataset has fewer episodes than its description or a finished run names.
    #[error("{} lacks {missing} of its {episodes} episodes; `{}` says how to repair \
             it", path.display(), verify_command(path))]
    Incomplete {
        /// The dataset's folder.
        path: PathBuf,
        /// Number of missing episodes.
        missing: usize,
        /// Number of episodes that the dataset should have.
        episodes: u32,
    },
    /// No run, or more than one, has a name that begins with the wanted text. The text is the message.
    #[error("{0}")]
    Unknown(String),
    /// A metric can't be added to a run.
    #[error("{} can't get a metric: {problem}", path.display())]
    NoMetric {
        /// The run's folder.
        path: PathBuf,
        /// Why.
        problem: &'static str,
    },
}

/// The command that verifies the results folder that contains `path`.
fn verify_command(path: &Path) -> String {
    // How many levels below `runs` or `datasets` a path can be: a file of a run, a file of a dataset, a file of a
    // misplaced run, and the folder of a dataset.
    let names = [("runs", 3), ("datasets", 2), ("runs", 2), ("datasets", 1)];
    let is_place = |(name, depth): &(&str, usize)| {
        path.ancestors().nth(*depth).and_then(Path::file_name).is_some_and(|found| found == *name)
    };
    let root =
        names.iter().find(|place| is_place(place)).and_then(|(_, depth)| path.ancestors().nth(depth + 1));
    command_in(root.unwrap_or(Path::new(DEFAULT_ROOT)), "verify")
}

impl From<RegistryError> for PolarsError {
    /// Wraps a registry error, so that it can pass through a query. The crate `catalog` unwraps it.
    fn from(error: RegistryError) -> Self {
        Self::IO { error: Arc::new(std::io::Error::other(error)), msg: None }
    }
}
