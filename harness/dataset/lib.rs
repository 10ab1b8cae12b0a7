//! Datasets: made once, found by what decides their content, and read by every experiment that needs them.

mod frame_store;
mod imported;
mod samples;
mod store;
mod verify;

pub use frame_store::{FramePlace, frame_bytes};
pub use imported::Imported;
pub use samples::{Partition, Recording, Samples, frame_difference, physical};
pub use store::{CompiledModel, Dataset, layout_of};
pub use verify::{Inspection, inspect, is_lock};

use harness_shared::files::{LockError, WriteError};
use harness_spec::Modality;
use harness_tables::TableError;
use std::path::PathBuf;

/// Why a dataset could not be made or read.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(transparent)]
    Table(#[from] TableError),
    #[error("{} is damaged: {problem}", path.display())]
    Damaged { path: PathBuf, problem: String },
    #[error(transparent)]
    Lock(#[from] LockError),
    #[error(
        "there is no imported dataset {name} in {}; import it with `harness import MAPPING.yaml` of the \
         Python package, or name one that is there",
        root.display()
    )]
    NotImported { name: String, root: PathBuf },
    #[error("the dataset {dataset} holds no {modality}, which the experiment asks for; it holds {held}")]
    Lacks { dataset: String, modality: Modality, held: String },
    #[error(
        "the dataset's frames can't be kept in {}: {source}; make room there, or let them stay in memory \
         (`harness run --memory GB`)",
        folder.display()
    )]
    Frames { folder: PathBuf, source: std::io::Error },
    #[error("the collection was cancelled; the same command goes on from the episodes that are there")]
    Cancelled,
}

impl DatasetError {
    /// Whether this is the caller's own wish to stop.
    pub fn is_cancelled(&self) -> bool {
        matches!(self, Self::Cancelled)
    }
}
