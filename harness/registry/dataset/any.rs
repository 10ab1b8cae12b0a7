//! A dataset on disk that was simulated or imported.

use super::description::is_imported;
use super::episode_file::push_all;
use super::{Dataset, DatasetError, Imported};
use harness_samples::{FramePlace, Recording, Samples};
use harness_shared::files::folders;
use harness_shared::numbers::counted;
use harness_shared::progress::Progress;
use harness_spec::{Definition, Element, Episode, Layout, Modality};
use std::path::{Path, PathBuf};
use std::sync::Arc;

impl From<Dataset> for AnyDataset {
    fn from(dataset: Dataset) -> Self {
        Self::Simulated(dataset)
    }
}

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

    /// Opens the dataset in the folder `root` that has this name, or the only one whose name begins so.
    ///
    /// # Errors
    /// When there is no such dataset, or its description can't be read.
    pub fn named(root: &Path, name: &str) -> Result<Self, DatasetError> {
        let name_of =
            |folder: &PathBuf| folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let all: Vec<String> = folders(root).iter().map(name_of).collect();
        let there: Vec<String> = all.iter().filter(|one| one.starts_with(name)).cloned().collect();
        match there.as_slice() {
            _ if all.iter().any(|one| one == name) => Self::at(&root.join(name)),
            [only] => Self::at(&root.join(only)),
            _ => {
                let (count, there) = if there.is_empty() { ("none", all) } else { ("more than one", there) };
                let there = if there.is_empty() { "no datasets".to_owned() } else { there.join(", ") };
                Err(DatasetError::Unsuitable(format!(
                    "{count} of the datasets in {} has a name that begins with '{name}'; there are {there}",
                    root.display()
                )))
            }
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
    pub fn samples(&self) -> usize {
        match self {
            Self::Simulated(dataset) => dataset.samples(),
            Self::Imported(dataset) => dataset.samples(),
        }
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
        self.load_with_test(None, frames, progress)
    }

    /// Reads the whole dataset into memory, and after it the dataset of its own that the test has, if there is one. Of
    /// simulated datasets, the samples have the modalities that both define in the same way. Imported ones must have
    /// the same modalities.
    ///
    /// # Errors
    /// See [`AnyDataset::load`].
    pub fn load_with_test(
        &self,
        test: Option<&AnyDataset>,
        frames: FramePlace,
        progress: &dyn Progress,
    ) -> Result<Samples, DatasetError> {
        let all = self.samples() + test.map_or(0, Self::samples);
        let layout = match (self, test) {
            (Self::Simulated(own), Some(Self::Simulated(test))) if own.layout() != test.layout() => {
                Arc::new(own.layout().shared_with(test.layout()))
            }
            _ => self.layout().clone(),
        };
        let mut samples = Samples::new(self.recording(), layout.clone(), all, frames, self.folder())?;
        let push = |dataset: &Self, samples: &mut Samples| {
            let dataset = dataset.with_modalities_of(&layout);
            let read = |index: u32| dataset.read(index, frames != FramePlace::Nowhere);
            push_all(samples, dataset.episodes(), read, progress)
        };
        let title = match self {
            Self::Simulated(dataset) => dataset.scenario().name(),
            Self::Imported(dataset) => dataset.name(),
        };
        progress.begin(&format!("loading {title}"), all as u64, "samples");
        push(self, &mut samples)?;
        if let Some(test) = test {
            samples.begin_test();
            push(test, &mut samples)?;
        }
        progress.end();
        Ok(match self {
            Self::Simulated(_) => samples,
            Self::Imported(dataset) => samples.with_labels(dataset.labels()),
        })
    }

    /// The dataset, from which these modalities alone are read if it was simulated.
    fn with_modalities_of(&self, layout: &Arc<Layout>) -> Self {
        match self {
            Self::Simulated(dataset) => Self::Simulated(dataset.with_modalities_of(layout)),
            Self::Imported(_) => self.clone(),
        }
    }

    /// Says in what the samples of another dataset differ from those of this one; `None` if networks that use these
    /// modalities can't tell. All modalities of imported datasets must be alike.
    pub fn difference(&self, other: &Self, used: &[Modality]) -> Option<String> {
        let is_simulated = matches!(self, Self::Simulated(_));
        let is_source = |name| {
            self.layout()
                .modalities
                .iter()
                .any(|of| used.contains(&of.name) && of.difference_of == Some(name))
        };
        let is_used = |name: Modality| {
            !is_simulated || name == Modality::SETPOINT || used.contains(&name) || is_source(name)
        };
        // No network gets the factors.
        let [here, there] = [self, other].map(|dataset| {
            let mut layout = dataset.layout().without_factors();
            layout.modalities.retain(|definition| is_used(definition.name));
            layout
        });
        let name = other.name();
        if let Some(missing) = here.names().find(|modality| there.get(*modality).is_none()) {
            return Some(format!("{name} has no {missing}"));
        }
        if let Some(more) = there.names().find(|modality| here.get(*modality).is_none()) {
            return Some(format!("{name} also has {more}"));
        }
        let [own, others] = [self, other].map(Self::sample_rate_hz);
        if own != others {
            return Some(format!("{name} has {others} samples per second instead of {own}"));
        }
        let plain = |of: &Definition| Definition { meaning: String::new(), ..of.clone() };
        let differs = |definition: &&Definition| {
            there.get(definition.name).is_none_or(|other| match is_simulated {
                true => !definition.is_like(other),
                false => plain(definition) != plain(other),
            })
        };
        let definition = here.modalities.iter().find(differs)?;
        let Some(other) = there.get(definition.name) else {
            return Some(format!("{name} has no action, whose setpoints are {}", definition.name));
        };
        let elements = definition.elements().iter().zip(other.elements());
        let element = elements.enumerate().find(|(_, (own, others))| own != others);
        Some(match (definition.width() == other.width(), element) {
            (false, _) => {
                let (own, others) = (definition.width(), counted(other.width(), "value"));
                format!("{} of {name} has {others} instead of {own}", definition.name)
            }
            (true, Some((index, (own, others)))) => {
                let shown = |of: &Element| format!("'{}' in '{}'", of.name, of.unit);
                let (modality, own, others) = (definition.name, shown(own), shown(others));
                format!("element {index} of {modality} of {name} is {others} instead of {own}")
            }
            (true, None) => format!("{} of {name} has another definition", definition.name),
        })
    }

    /// Returns the dataset's folder.
    pub fn folder(&self) -> &Path {
        match self {
            Self::Simulated(dataset) => dataset.folder(),
            Self::Imported(dataset) => dataset.folder(),
        }
    }

    /// Returns the properties that all samples share.
    pub fn recording(&self) -> Recording {
        match self {
            Self::Simulated(dataset) => dataset.recording(),
            Self::Imported(dataset) => dataset.recording(),
        }
    }

    /// Reads one episode, with or without its frames. The whole file is compared with its seal in both cases.
    ///
    /// # Errors
    /// When the file is missing, damaged, or not this episode.
    pub fn read(&self, index: u32, frames: bool) -> Result<Episode, DatasetError> {
        match self {
            Self::Simulated(dataset) => dataset.read(index, frames),
            Self::Imported(dataset) => dataset.read(index, frames),
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
        let (episode, layout) = (self.read(index, true)?, self.layout().clone());
        let mut samples =
            Samples::new(self.recording(), layout, episode.samples, FramePlace::Memory, Path::new(""))?;
        samples.push(&episode)?;
        Ok(samples)
    }
}
