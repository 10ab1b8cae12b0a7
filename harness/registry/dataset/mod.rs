//! Datasets on disk and in memory. Whatever determines a dataset's content also determines its name, so all experiments
//! that need the dataset find it.

mod any;
mod description;
mod episode_file;
mod imported;
mod store;
mod verify;
mod version;

pub use any::AnyDataset;
pub use description::{ImportReport, MODEL, layout_of};
pub use imported::Imported;
pub use store::{CompiledModel, Dataset};
pub use verify::{Inspection, inspect, is_lock};
pub use version::{WorldVersion, is_of_model, world_parts};

use harness_samples::FramesError;
use harness_shared::files::{LockError, WriteError};
use harness_tables::TableError;
use std::path::PathBuf;

/// Why a dataset could not be made or read.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A file can't be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A table can't be read or written.
    #[error(transparent)]
    Table(#[from] TableError),
    /// A file of the dataset is damaged or missing.
    #[error("{} is damaged: {problem}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// The dataset's folder can't be locked.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// No dataset, or more than one, has the name that is asked for; or the dataset lacks a modality, its episodes can't
    /// be divided as a spec asks, or none of them is as long as a window. The text is the message.
    #[error("{0}")]
    Unsuitable(String),
    /// Frames can't be stored on disk.
    #[error(transparent)]
    Frames(#[from] FramesError),
    /// The caller cancelled the collection or the loading.
    #[error("the collection was cancelled; the same command continues with the missing episodes")]
    Cancelled,
}

impl DatasetError {
    /// Whether the caller cancelled the work.
    pub fn is_cancelled(&self) -> bool {
        matches!(self, Self::Cancelled)
    }
}
