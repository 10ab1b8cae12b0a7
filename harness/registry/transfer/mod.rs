//! Copies runs to another folder, completely or fit for version control, and removes runs and datasets.

mod complete;
mod publish;
mod removal;

pub use complete::{Completed, publish_completely};
pub use publish::{Content, PublishError, Published, publish};
pub use removal::{Garbage, Removable, garbage, remove};

use harness_shared::files::FolderLock;
use std::path::{Path, PathBuf};

/// Another process works in a folder.
#[derive(Debug, thiserror::Error)]
#[error("{holder} works in {}; try again when it has ended", folder.display())]
pub struct Busy {
    /// The folder.
    pub folder: PathBuf,
    /// The process.
    pub holder: String,
}

impl Busy {
    /// The error that another process has locked this folder.
    fn at(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), holder: FolderLock::other(folder) }
    }
}
