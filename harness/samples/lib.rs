//! A dataset in memory: its samples, the windows and splits of them, and their normalization.

mod constant;
mod disturb;
mod frames;
mod labels;
mod normalizer;
mod window;

pub use frames::{FramePlace, frame_bytes};
pub use labels::Labels;
pub use normalizer::{Normalizer, Normalizers};
pub use window::{Partition, Sample, after, before, ends, sequences};

use frames::FrameStore;
use harness_spec::{Action, Definition, Episode, Layout, Modality, Split};
use rayon::prelude::*;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Frames can't be stored on disk.
#[derive(Debug, thiserror::Error)]
#[error(
    "the dataset's frames can't be kept in {}: {source}; free disk space there, or keep them in memory \
     (`harness run --memory GB`)",
    folder.display()
)]
pub struct FramesError {
    /// The dataset's folder.
    pub folder: PathBuf,
    /// The error of the file system.
    pub source: std::io::Error,
}

/// Properties that all samples of a dataset share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recording {
    /// Sample rate, Hz.
    pub sample_rate_hz: f64,
    /// Seed of the simulation; 0 for an imported dataset.
    pub seed: u64,
}

/// All samples of a dataset. The samples of an episode follow those of the previous one.
#[derive(Debug, Clone)]
pub struct Samples {
    recording: Recording,
    /// The range of each episode's samples, in the order of the episodes.
    episodes: Vec<Range<usize>>,
    /// The number of episodes before those of a dataset of its own for the test; `None` without such a dataset.
    before_test: Option<usize>,
    layout: Arc<Layout>,
    /// Values of each vector, `[sample, element]`, by the modality's position in the layout. Images have none.
    vectors: Vec<Arc<Vec<f32>>>,
    /// Frames of each stored image, `[sample, channel, row, column]`, by the modality's position in the layout. They
    /// are empty if no frames were loaded.
    images: Vec<Option<Arc<FrameStore>>>,
    /// The dataset's folder, which may contain the frames.
    folder: PathBuf,
    labels: Labels,
}

impl Samples {
    /// Returns the memory that this number of samples takes, in bytes, if the frames are stored where `frames` says.
    pub fn bytes(layout: &Layout, samples: usize, frames: FramePlace) -> u64 {
        let vectors = layout.modalities.iter().filter(|definition| !definition.is_image());
        let numbers: usize = vectors.map(Definition::width).sum();
        let numbers = (samples as u64).saturating_mul((numbers * size_of::<f32>()) as u64);
        numbers.saturating_add(if frames == FramePlace::Memory { frame_bytes(layout, samples) } else { 0 })
    }

    /// Creates an empty dataset with space for `samples`, whose frames are stored where `frames` says. `folder` is the
    /// dataset's folder.
    ///
    /// # Errors
    /// When frames are stored on disk, and no file can be created there.
    pub fn new(
        recording: Recording,
        layout: Arc<Layout>,
        samples: usize,
        frames: FramePlace,
        folder: &Path,
    ) -> Result<Self, FramesError> {
        let vector = |definition: &Definition| match definition.is_image() {
            true => Arc::default(),
            false => Arc::new(Vec::with_capacity(samples * definition.width())),
        };
        let image = |definition: &Definition| {
            let is_stored = definition.is_image() && definition.difference_of.is_none();
            is_stored
                .then(|| FrameStore::new(frames, definition.width(), samples, folder).map(Arc::new))
                .transpose()
        };
        let vectors = layout.modalities.iter().map(vector).collect();
        let images = layout.modalities.iter().map(image).collect::<Result<_, _>>();
        let images = images.map_err(|source| FramesError { folder: folder.to_owned(), source })?;
        let folder = folder.to_owned();
        Ok(Self {
            recording,
            episodes: Vec::new(),
            before_test: None,
            layout,
            vectors,
            images,
            folder,
            labels: Labels::default(),
        })
    }

    /// Appends an episode, with its frames if it has any.
    ///
    /// # Errors
    /// When frames can't be written to disk.
    ///
    /// # Panics
    /// When there are copies of the samples.
    pub fn push(&mut self, episode: &Episode) -> Result<(), FramesError> {
        let first = self.len();
        self.episodes.push(first..first + episode.samples);
        for (index, definition) in self.layout.modalities.iter().enumerate() {
            match (&mut self.images[index], definition.difference_of) {
                (Some(frames), _) => Arc::get_mut(frames)
                    .expect("samples are copied after all episodes are there")
                    .push(&episode.images[index])
                    .map_err(|source| FramesError { folder: self.folder.clone(), source })?,
                (None, None) => {
                    Arc::make_mut(&mut self.vectors[index]).extend_from_slice(&episode.vectors[index])
                }
                (None, Some(_)) if definition.is_image() => {}
                (None, Some(of)) => {
                    let (values, width) = (episode.vector(of), definition.width());
                    let before = values[..width.min(values.len())].iter().chain(values);
                    let changes = values.iter().zip(before).map(|(now, before)| now - before);
                    Arc::make_mut(&mut self.vectors[index]).extend(changes);
                }
            }
        }
        Ok(())
    }

    /// Adds what is known about the episodes of a recording.
    pub fn with_labels(self, labels: Labels) -> Self {
        Self { labels, ..self }
    }

    /// Returns what is known about the episodes of a recording.
    pub fn labels(&self) -> &Labels {
        &self.labels
    }

    /// Returns the split of these samples if a spec has this one: the recording's own if the spec leaves it open, unless
    /// the test has a dataset of its own.
    pub fn split(&self, given: &Split) -> Split {
        if self.has_own_test() { given.clone() } else { self.labels.split(given) }
    }

    /// Declares that all further episodes are those of a dataset of its own for the test.
    pub fn begin_test(&mut self) {
        self.before_test = Some(self.episodes.len());
    }

    /// Whether the test has a dataset of its own.
    pub fn has_own_test(&self) -> bool {
        self.before_test.is_some()
    }

    /// Returns the range of each episode's samples, without the episodes of a dataset of its own for the test.
    pub fn own_episodes(&self) -> &[Range<usize>] {
        &self.episodes[..self.before_test.unwrap_or(self.episodes.len())]
    }

    /// Returns the properties that all samples share.
    pub fn recording(&self) -> Recording {
        self.recording
    }

    /// Returns the layout of the samples.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// Returns the number of samples.
    pub fn len(&self) -> usize {
        self.episodes.last().map_or(0, |episode| episode.end)
    }

    /// Whether frames were loaded.
    pub fn has_frames(&self) -> bool {
        self.images.iter().flatten().any(|frames| !frames.bytes().is_empty())
    }

    /// Whether there are no samples.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the range of each episode's samples, in the order of the episodes.
    pub fn episodes(&self) -> &[Range<usize>] {
        &self.episodes
    }

    /// Returns the index of the episode that contains `sample`, in its own dataset, and the sample's index in that
    /// episode.
    pub fn place(&self, sample: Sample) -> (usize, usize) {
        let (episode, place) = self.place_in_memory(sample);
        let first = self.before_test.filter(|first| *first <= episode).unwrap_or(0);
        (episode - first, place)
    }

    /// Returns the index of the episode that contains `sample`, among all in memory, and the sample's index in it.
    fn place_in_memory(&self, sample: Sample) -> (usize, usize) {
        let episode = self.episodes.partition_point(|range| range.end <= sample.index());
        (episode, sample.index() - self.episodes[episode].start)
    }

    /// Returns a vector modality of all samples in physical units, `[samples, width]`.
    ///
    /// # Panics
    /// When the layout has no such modality.
    pub fn vectors(&self, modality: Modality) -> &[f32] {
        &self.vectors[self.position(modality)]
    }

    fn position(&self, modality: Modality) -> usize {
        let position = self.layout.position(modality);
        position.unwrap_or_else(|| panic!("the dataset's layout holds no {modality}"))
    }

    /// Returns a vector modality of one sample in physical units, `[width]`.
    pub fn vector(&self, modality: Modality, sample: Sample) -> &[f32] {
        let width = self.layout[modality].width();
        &self.vectors(modality)[sample.index() * width..][..width]
    }

    /// Returns the commands to the actuators at all samples, `[samples, elements of the action]`.
    pub fn setpoints(&self) -> &[f32] {
        self.layout.position(Modality::SETPOINT).map_or(&[], |position| self.vectors[position].as_slice())
    }

    /// Returns the frames of an image modality. For a difference, these are the frames of the image that it is computed
    /// from.
    fn frames(&self, modality: Modality) -> &FrameStore {
        let stored = self.layout[modality].difference_of.unwrap_or(modality);
        let frames = self.images[self.position(stored)].as_ref();
        frames.unwrap_or_else(|| panic!("{modality} is not an image"))
    }

    /// Returns an image of all samples, `[samples, channel, row, column]`. For a difference, this is the image that it
    /// is computed from. It is empty if no frames were loaded.
    ///
    /// # Panics
    /// When the layout has no such image.
    pub fn image(&self, modality: Modality) -> &[u8] {
        self.frames(modality).bytes()
    }

    /// Returns an image of one sample as bytes, `[channel, row, column]`. For a difference, this is the later image.
    pub fn frame_bytes(&self, modality: Modality, sample: Sample) -> &[u8] {
        self.frames(modality).frame(sample.index())
    }

    /// Announces that the frames of these samples, and of the samples before them, are about to be read. For frames on
    /// disk this saves time, and it releases the memory of frames that were read long ago. It has no other effect.
    pub fn prefetch(&self, modality: Modality, samples: &[Sample]) {
        self.frames(modality).prefetch(samples);
    }

    /// Returns the image before `sample` in its episode. For the first sample it is the sample's own image, because
    /// nothing moved before.
    pub fn previous_frame_bytes(&self, modality: Modality, sample: Sample) -> &[u8] {
        self.frame_bytes(modality, self.previous(sample))
    }

    /// Returns the sample before this one in its episode. For the first sample, returns the sample itself.
    pub fn previous(&self, sample: Sample) -> Sample {
        let (_, place) = self.place(sample);
        if place == 0 { sample } else { sample.before(1) }
    }

    /// Returns the sample after this one in its episode. For the last sample, returns the sample itself.
    pub fn next(&self, sample: Sample) -> Sample {
        let (episode, place) = self.place_in_memory(sample);
        if place + 1 < self.episodes[episode].len() { sample.after(1) } else { sample }
    }

    /// Returns the action between `sample` and the next one, in physical units. The setpoint does not change after the
    /// last sample of an episode.
    pub fn action(&self, action: Action, sample: Sample) -> impl Iterator<Item = f32> {
        let width = self.layout.action().len();
        let (now, next) = (sample.index() * width, self.next(sample).index() * width);
        (0..width).map(move |element| match action {
            Action::Target => self.setpoints()[next + element],
            Action::Increment => self.setpoints()[next + element] - self.setpoints()[now + element],
        })
    }
}

/// Returns the values of `modality` at the samples `at` in physical units, `[samples, width]`. Images are stored
/// channel by channel, with intensities in [0, 1] or differences in [-1, 1].
pub fn physical(samples: &Samples, modality: Modality, at: &[Sample]) -> Vec<f32> {
    let definition = &samples.layout()[modality];
    let width = definition.width();
    let mut values = vec![0.0; at.len() * width];
    if definition.is_image() {
        samples.prefetch(modality, at);
    }
    values.par_chunks_exact_mut(width).zip(at).for_each(|(values, &sample)| {
        if !definition.is_image() {
            values.copy_from_slice(samples.vector(modality, sample));
        } else if definition.difference_of.is_some() {
            let changes = frame_difference(samples, modality, sample);
            values.iter_mut().zip(changes).for_each(|(value, change)| *value = change);
        } else {
            let bytes = samples.frame_bytes(modality, sample);
            values.iter_mut().zip(bytes).for_each(|(value, byte)| *value = f32::from(*byte) / 255.0);
        }
    });
    values
}

/// Returns the change of an image since the previous sample, in [-1, 1], `[channel, row, column]`.
pub fn frame_difference(samples: &Samples, modality: Modality, sample: Sample) -> impl Iterator<Item = f32> {
    let before = samples.previous_frame_bytes(modality, sample);
    let frames = samples.frame_bytes(modality, sample).iter().zip(before);
    frames.map(|(now, before)| (f32::from(*now) - f32::from(*before)) / 255.0)
}
