//! Datasets that were recorded elsewhere and imported: read like those that are simulated here, and never made.

use super::store::{Description, episode_file, push_all, read_episode};
use super::{DatasetError, FramePlace, Recording, Samples};
use harness_shared::progress::Progress;
use harness_spec::{Layout, Modality, RunSpec};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An imported dataset that is on disk.
#[derive(Debug, Clone)]
pub struct Imported {
    folder: PathBuf,
    name: String,
    layout: Arc<Layout>,
    content: Content,
}

/// What `dataset.json` says of an imported dataset's content, of which its name holds the hash.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct Content {
    sample_rate_hz: f64,
    /// What its episodes hold besides the setpoint, which every one has; names alone where the finger's layout tells the
    /// rest, as in datasets that were imported before layouts.
    modalities: Vec<Modality>,
    #[serde(default)]
    layout: Option<Layout>,
    episodes: Vec<ImportedEpisode>,
}

#[derive(Debug, Clone, Deserialize)]
struct ImportedEpisode {
    samples: u32,
}

impl Content {
    /// What its samples hold.
    pub fn layout(&self) -> Arc<Layout> {
        if let Some(layout) = &self.layout {
            return Arc::new(layout.clone());
        }
        let mut layout = Layout::clone(&Layout::finger());
        let held = |modality: Modality| modality == Modality::SETPOINT || self.modalities.contains(&modality);
        layout.modalities.retain(|definition| held(definition.difference_of.unwrap_or(definition.name)));
        // A real camera's colours do not tell the robot's parts.
        layout.regions.clear();
        Arc::new(layout)
    }

    /// Samples of each episode.
    pub fn samples(&self) -> Vec<usize> {
        self.episodes.iter().map(|episode| episode.samples as usize).collect()
    }
}

impl Imported {
    /// The imported dataset of that name in `root`.
    ///
    /// # Errors
    /// When there is none, or its description is damaged.
    pub fn open(root: &Path, name: &str) -> Result<Self, DatasetError> {
        let folder = root.join(name);
        if !folder.join(Description::FILE).exists() {
            return Err(DatasetError::NotImported { name: name.to_owned(), root: root.to_owned() });
        }
        let damaged = |problem| DatasetError::Damaged { path: folder.join(Description::FILE), problem };
        let description = Description::read(&folder).map_err(damaged)?;
        let content =
            description.imported(name).ok_or_else(|| damaged("it does not describe this dataset".into()))?;
        Ok(Self { folder, name: name.to_owned(), layout: content.layout(), content })
    }

    /// The folder's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Samples recorded a second, Hz.
    pub fn sample_rate_hz(&self) -> f64 {
        self.content.sample_rate_hz
    }

    /// Samples of the whole dataset.
    pub fn len(&self) -> usize {
        self.content.samples().iter().sum()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// What its samples hold.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// Refuses a run that wants modalities which it does not hold.
    pub fn check(&self, spec: &RunSpec) -> Result<(), DatasetError> {
        let missing = spec.modalities().into_iter().find(|modality| self.layout.get(*modality).is_none());
        let Some(modality) = missing else { return Ok(()) };
        let held: Vec<&str> = self.layout.names().map(Modality::name).collect();
        Err(DatasetError::Lacks { dataset: self.name.clone(), modality, held: held.join(", ") })
    }

    /// Reads the whole dataset into memory, and its frames to their place.
    ///
    /// # Errors
    /// When an episode is missing, its file is not as it was written, frames can't be written to disk, or the caller
    /// cancels.
    pub fn load(&self, frames: FramePlace, progress: &dyn Progress) -> Result<Samples, DatasetError> {
        let recording = Recording { sample_rate_hz: self.content.sample_rate_hz, seed: 0 };
        let mut samples = Samples::new(recording, self.layout.clone(), self.len(), frames, &self.folder)?;
        let lengths = self.content.samples();
        let read = |index: u32| {
            let path = self.folder.join(episode_file(index));
            let with_frames = frames != FramePlace::Nowhere;
            read_episode(&path, &self.name, index, lengths[index as usize], with_frames, &self.layout)
        };
        progress.begin(&format!("loading {}", self.name), self.len() as u64, "samples");
        push_all(&mut samples, lengths.len() as u32, read, progress)?;
        progress.end();
        Ok(samples)
    }
}
