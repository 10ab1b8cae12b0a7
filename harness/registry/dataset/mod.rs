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
use harness_shared::numbers::counted;
use harness_spec::Modality;
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
    /// No imported dataset has this name.
    #[error(
        "there is no imported dataset {name} in {}; import it with `harness import MAPPING.yaml` of the \
         Python package, or name a dataset that is there",
        root.display()
    )]
    NotImported {
        /// The name in the spec.
        name: String,
        /// The folder of all datasets.
        root: PathBuf,
    },
    /// No dataset, or more than one, has a name that begins so.
    #[error("{} of the datasets in {} has a name that begins with '{name}'; there {}", match is_one_of_several {
        true => "more than one",
        false => "none",
    }, root.display(), match there.as_slice() {
        [] => "are no datasets".to_owned(),
        there => format!("are {}", there.join(", ")),
    })]
    NotNamed {
        /// The asked name.
        name: String,
        /// The folder of all datasets.
        root: PathBuf,
        /// Whether several names begin so.
        is_one_of_several: bool,
        /// The datasets whose names begin so, or all.
        there: Vec<String>,
    },
    /// The dataset lacks a modality that a spec uses.
    #[error("the dataset {dataset} contains no {modality}, which the experiment needs; it contains {held}")]
    Lacks {
        /// Name of the dataset.
        dataset: String,
        /// The missing modality.
        modality: Modality,
        /// The modalities of the dataset, separated by commas.
        held: String,
    },
    /// The episodes can't be divided as a spec asks.
    #[error("the dataset {dataset} can't be divided: {problem}")]
    Split {
        /// Name of the dataset.
        dataset: String,
        /// Why.
        problem: String,
    },
    /// No episode of the dataset is as long as a window.
    #[error(
        "the longest episode of the dataset {dataset} has {}, and a window of {context} that are seen and {horizon} \
         that are predicted needs {}; lower window.context or window.horizon, or import longer episodes",
        counted(*longest, "sample"), context + horizon
    )]
    TooShort {
        /// Name of the dataset.
        dataset: String,
        /// Number of samples in the longest episode.
        longest: usize,
        /// Number of samples that the model sees.
        context: usize,
        /// Number of samples that the model predicts.
        horizon: usize,
    },
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
