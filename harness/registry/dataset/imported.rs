//! Imported datasets, which were recorded elsewhere. They are read like simulated datasets, but can't be collected.

use super::DatasetError;
use super::description::{Content, Description, ImportReport};
use super::episode_file::{episode_file, read_episode};
use harness_samples::{Labels, Recording};
use harness_shared::numbers::counted;
use harness_spec::{Division, Episode, Layout, Modality, Part, RunSpec, Split, Window, WindowStart};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An imported dataset on disk.
#[derive(Debug, Clone)]
pub struct Imported {
    folder: PathBuf,
    name: String,
    layout: Arc<Layout>,
    content: Content,
    report: ImportReport,
}

impl Imported {
    /// Opens the imported dataset `name` in the folder `root`.
    pub fn open(root: &Path, name: &str) -> Result<Self, DatasetError> {
        let folder = root.join(name);
        if !folder.join(Description::FILE).exists() {
            return Err(DatasetError::Unsuitable(format!(
                "there is no imported dataset {name} in {}; import it with `harness import MAPPING.yaml` of the Python \
                 package, or name a dataset that is there",
                root.display()
            )));
        }
        let damaged = |problem| DatasetError::Damaged { path: folder.join(Description::FILE), problem };
        let description = Description::read(&folder).map_err(damaged)?;
        let content =
            description.imported(name).ok_or_else(|| damaged("it does not describe this dataset".into()))?;
        let (layout, report) = (Arc::new(content.layout.clone()), description.import_report());
        Ok(Self { folder, name: name.to_owned(), layout, content, report })
    }

    /// Returns what the import says of itself.
    pub fn report(&self) -> &ImportReport {
        &self.report
    }

    /// Returns the dataset's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns the name of the dataset's folder.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the sample rate, Hz.
    pub fn sample_rate_hz(&self) -> f64 {
        self.content.sample_rate_hz
    }

    /// Returns the number of samples in the whole dataset.
    pub fn samples(&self) -> usize {
        self.content.samples().sum()
    }

    /// Returns the layout of the samples.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// Checks that the dataset has the modalities that a run uses, and an episode as long as its window.
    pub fn check(&self, spec: &RunSpec) -> Result<(), DatasetError> {
        let name = &self.name;
        let missing = spec.modalities().into_iter().find(|modality| self.layout.get(*modality).is_none());
        if let Some(modality) = missing {
            let held = self.layout.names().map(Modality::name).collect::<Vec<_>>().join(", ");
            return Err(DatasetError::Unsuitable(format!(
                "the dataset {name} contains no {modality}, which the experiment needs; it contains {held}"
            )));
        }
        let split = self.labels().split(&spec.split);
        if spec.test.is_none() && (split.has_groups() || matches!(split.by, Division::Label(_))) {
            self.parts(&spec.split).map_err(|problem| {
                DatasetError::Unsuitable(format!("the dataset {name} can't be divided: {problem}"))
            })?;
        }
        let longest = self.content.samples().max().unwrap_or_default();
        if longest < spec.window.samples() {
            let Window { context, horizon, .. } = spec.window;
            return Err(DatasetError::Unsuitable(format!(
                "the longest episode of the dataset {name} has {}, and a window of {context} that are seen and {horizon} \
                 that are predicted needs {}; lower window.context or window.horizon, or import longer episodes",
                counted(longest, "sample"),
                context + horizon
            )));
        }
        Ok(())
    }

    /// Says how many episodes are shorter than a run's window, and what they are not used for; `None` if none is.
    pub fn short_episodes(&self, spec: &RunSpec) -> Option<String> {
        let Window { context, horizon, start, .. } = spec.window;
        let short = self.content.samples().filter(|samples| *samples < spec.window.samples()).count();
        let unused = match start {
            _ if context == 1 || spec.split.by == Division::Sample => "they are not used",
            WindowStart::Random => "they are not used for the test, nor to train a network with memory",
            WindowStart::Rest => "they are not used to train a network with memory",
        };
        let all = counted(self.episodes() as usize, "episode");
        (short > 0).then(|| {
            format!(
                "{short} of {all} of {} are shorter than a window of {context} and {horizon} samples; {unused}",
                self.name
            )
        })
    }

    /// Returns what is known about the episodes besides their samples.
    pub fn labels(&self) -> Labels {
        self.content.labels()
    }

    /// Returns the part of each episode in a split that keeps them whole.
    ///
    /// # Errors
    /// When the episodes can't be divided so. Returns the message.
    pub fn parts(&self, split: &Split) -> Result<Vec<Part>, String> {
        let labels = self.labels();
        labels.parts(&labels.split(split), &self.content.samples().collect::<Vec<_>>(), false)
    }

    /// Returns the number of episodes.
    pub fn episodes(&self) -> u32 {
        self.content.samples().len() as u32
    }

    /// Returns the properties that all samples share.
    pub fn recording(&self) -> Recording {
        Recording { sample_rate_hz: self.content.sample_rate_hz, seed: 0 }
    }

    /// Reads one episode, with or without its frames. The whole file is compared with its seal in both cases.
    pub fn read(&self, index: u32, frames: bool) -> Result<Episode, DatasetError> {
        let path = self.folder.join(episode_file(index));
        let samples = self.content.samples().nth(index as usize);
        let missing =
            || DatasetError::Damaged { path: path.clone(), problem: "there is no such episode".into() };
        read_episode(&path, &self.name, index, samples.ok_or_else(missing)?, frames, &self.layout)
    }
}
