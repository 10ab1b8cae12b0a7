//! A dataset on disk that was simulated or imported.

use super::description::is_imported;
use super::{Dataset, DatasetError, Imported};
use harness_samples::{FramePlace, Samples};
use harness_shared::progress::Progress;
use harness_spec::Layout;
use std::path::Path;
use std::sync::Arc;

/// A simulated or imported dataset on disk.
#[derive(Debug, Clone)]
pub enum AnyDataset {
    /// A simulated dataset. Its missing episodes can be collected.
    Simulated(Dataset),
    /// A dataset that was recorded elsewhere.
    Imported(Imported),
}

impl AnyDataset {
    /// Opens the dataset in a folder, whose description says whether it was simulated or imported.
    pub fn at(folder: &Path) -> Result<Self, DatasetError> {
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        match folder.parent() {
            Some(root) if is_imported(folder) => Imported::open(root, &name).map(Self::Imported),
            _ => Dataset::at(folder).map(Self::Simulated),
        }
    }

    /// Returns the name of the dataset's folder.
    pub fn name(&self) -> &str {
        match self {
            Self::Simulated(dataset) => dataset.name(),
            Self::Imported(dataset) => dataset.name(),
        }
    }

    /// Returns the number of samples in the whole dataset.
    pub fn len(&self) -> usize {
        match self {
            Self::Simulated(dataset) => dataset.len(),
            Self::Imported(dataset) => dataset.len(),
        }
    }

    /// Whether the dataset has no samples.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the layout of the samples.
    pub fn layout(&self) -> &Arc<Layout> {
        match self {
            Self::Simulated(dataset) => dataset.layout(),
            Self::Imported(dataset) => dataset.layout(),
        }
    }

    /// Returns the sample rate, Hz.
    pub fn sample_rate_hz(&self) -> f64 {
        match self {
            Self::Simulated(dataset) => dataset.spec().sample_rate_hz,
            Self::Imported(dataset) => dataset.sample_rate_hz(),
        }
    }

    /// Reads the whole dataset into memory. The frames are stored where `frames` says.
    ///
    /// # Errors
    /// When an episode is missing or damaged, frames can't be written to disk, or the caller cancels.
    pub fn load(&self, frames: FramePlace, progress: &dyn Progress) -> Result<Samples, DatasetError> {
        match self {
            Self::Simulated(dataset) => dataset.load(frames, progress),
            Self::Imported(dataset) => dataset.load(frames, progress),
        }
    }

    /// Returns the number of episodes.
    pub fn episodes(&self) -> u32 {
        match self {
            Self::Simulated(dataset) => dataset.spec().episodes,
            Self::Imported(dataset) => dataset.episodes(),
        }
    }

    /// Reads one episode into memory, with its frames, as the only one of a dataset.
    pub fn load_episode(&self, index: u32) -> Result<Samples, DatasetError> {
        let (recording, episode) = match self {
            Self::Simulated(dataset) => (dataset.recording(), dataset.read(index, true)?),
            Self::Imported(dataset) => (dataset.recording(), dataset.read(index, true)?),
        };
        let place = FramePlace::Memory;
        let mut samples =
            Samples::new(recording, self.layout().clone(), episode.samples, place, Path::new(""))?;
        samples.push(&episode)?;
        Ok(samples)
    }
}
