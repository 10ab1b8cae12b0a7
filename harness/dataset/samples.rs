//! A dataset in memory, and what a network sees of it.

use super::DatasetError;
use super::frame_store::{FramePlace, FrameStore, frame_bytes};
use harness_spec::{Action, Definition, Division, Episode, Layout, Modality, Split};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What holds for all samples of a dataset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recording {
    /// Samples recorded a second, Hz.
    pub sample_rate_hz: f64,
    /// Seed of a simulation; 0 of what was imported.
    pub seed: u64,
}

/// All samples of a dataset, episode after episode.
#[derive(Debug)]
pub struct Samples {
    recording: Recording,
    /// Where each episode's samples lie, in the order of the episodes.
    episodes: Vec<Range<usize>>,
    layout: Arc<Layout>,
    /// For each of the layout's modalities that is a vector its values, `[sample, element]`.
    vectors: Vec<Vec<f32>>,
    /// For each of the layout's modalities that is a stored image its frames, `[sample, channel, row, column]`; empty where
    /// none were asked for.
    images: Vec<Option<FrameStore>>,
    /// Of the dataset, which may hold its frames.
    folder: PathBuf,
}

impl Samples {
    /// Memory that so many samples take, bytes, with their frames in their place.
    pub fn bytes(layout: &Layout, samples: usize, frames: FramePlace) -> u64 {
        let vectors = layout.modalities.iter().filter(|definition| !definition.is_image());
        let numbers: usize = vectors.map(Definition::width).sum();
        let numbers = (samples as u64).saturating_mul((numbers * size_of::<f32>()) as u64);
        numbers.saturating_add(if frames == FramePlace::Memory { frame_bytes(layout, samples) } else { 0 })
    }

    /// An empty dataset with room for `samples`, whose frames have their place; `folder` is that of the dataset.
    ///
    /// # Errors
    /// When the frames' place is the disk, and no file can be made there.
    pub fn new(
        recording: Recording,
        layout: Arc<Layout>,
        samples: usize,
        frames: FramePlace,
        folder: &Path,
    ) -> Result<Self, DatasetError> {
        let vector = |definition: &Definition| match definition.is_image() {
            true => Vec::new(),
            false => Vec::with_capacity(samples * definition.width()),
        };
        let image = |definition: &Definition| {
            let is_stored = definition.is_image() && definition.difference_of.is_none();
            is_stored.then(|| FrameStore::new(frames, definition.width(), samples, folder)).transpose()
        };
        let vectors = layout.modalities.iter().map(vector).collect();
        let images = layout.modalities.iter().map(image).collect::<Result<_, _>>();
        let images = images.map_err(|source| DatasetError::Frames { folder: folder.to_owned(), source })?;
        let folder = folder.to_owned();
        Ok(Self { recording, episodes: Vec::new(), layout, vectors, images, folder })
    }

    /// Appends an episode, with its frames if it has any.
    ///
    /// # Errors
    /// When frames can't be written to disk.
    pub fn push(&mut self, episode: &Episode) -> Result<(), DatasetError> {
        let first = self.len();
        self.episodes.push(first..first + episode.samples);
        for (index, definition) in self.layout.modalities.iter().enumerate() {
            match (&mut self.images[index], definition.difference_of) {
                (Some(frames), _) => frames
                    .push(&episode.images[index])
                    .map_err(|source| DatasetError::Frames { folder: self.folder.clone(), source })?,
                (None, None) => self.vectors[index].extend_from_slice(&episode.vectors[index]),
                (None, Some(_)) if definition.is_image() => {}
                (None, Some(of)) => {
                    let (values, width) = (episode.vector(of), definition.width());
                    let before = values[..width.min(values.len())].iter().chain(values);
                    self.vectors[index].extend(values.iter().zip(before).map(|(now, before)| now - before));
                }
            }
        }
        Ok(())
    }

    /// What a sample holds.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// Samples in all.
    pub fn len(&self) -> usize {
        self.episodes.last().map_or(0, |episode| episode.end)
    }

    /// Whether its frames were loaded.
    pub fn has_frames(&self) -> bool {
        self.images.iter().flatten().any(|frames| !frames.bytes().is_empty())
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn episodes(&self) -> &[Range<usize>] {
        &self.episodes
    }

    /// The episode that `sample` belongs to, and its place there.
    pub fn place(&self, sample: usize) -> (usize, usize) {
        let episode = self.episodes.partition_point(|range| range.end <= sample);
        (episode, sample - self.episodes[episode].start)
    }

    /// A vector modality of all samples, in physical units, `[samples, width]`.
    ///
    /// # Panics
    /// The layout holds none of that name.
    pub fn vectors(&self, modality: Modality) -> &[f32] {
        &self.vectors[self.position(modality)]
    }

    fn position(&self, modality: Modality) -> usize {
        let position = self.layout.position(modality);
        position.unwrap_or_else(|| panic!("the dataset's layout holds no {modality}"))
    }

    /// A vector modality of one sample, in physical units.
    pub fn vector(&self, modality: Modality, sample: usize) -> &[f32] {
        let width = self.layout[modality].width();
        &self.vectors(modality)[sample * width..][..width]
    }

    /// What the actuators are commanded at all samples, `[samples, elements of the action]`.
    pub fn setpoints(&self) -> &[f32] {
        self.vectors(Modality::SETPOINT)
    }

    /// The frames of an image modality, or of the one that it is the difference of.
    fn frames(&self, modality: Modality) -> &FrameStore {
        let stored = self.layout[modality].difference_of.unwrap_or(modality);
        let frames = self.images[self.position(stored)].as_ref();
        frames.unwrap_or_else(|| panic!("{modality} is no image"))
    }

    /// An image of all samples, `[samples, channel, row, column]`, or that which it is the difference of; empty if none
    /// were loaded.
    ///
    /// # Panics
    /// The layout holds no image of that name.
    pub fn image(&self, modality: Modality) -> &[u8] {
        self.frames(modality).bytes()
    }

    /// An image of one sample as bytes, `[channel, row, column]`; of a difference, the later one.
    pub fn frame_bytes(&self, modality: Modality, sample: usize) -> &[u8] {
        self.frames(modality).frame(sample)
    }

    /// Says that the frames of these samples, and of those before them, are about to be read. It changes nothing but the
    /// time that frames on disk take, and the memory: those that were read long ago are let go.
    pub fn prefetch(&self, modality: Modality, samples: &[usize]) {
        self.frames(modality).prefetch(samples);
    }

    /// The image before `sample` in its episode; at the start, the image itself, since nothing moved before.
    pub fn previous_frame_bytes(&self, modality: Modality, sample: usize) -> &[u8] {
        self.frame_bytes(modality, self.previous(sample))
    }

    /// The sample before in the same episode; the sample itself at the start.
    fn previous(&self, sample: usize) -> usize {
        let (_, place) = self.place(sample);
        if place == 0 { sample } else { sample - 1 }
    }

    /// What the decoder is told about the step from `sample` to the next.
    pub fn action(&self, action: Action, sample: usize) -> impl Iterator<Item = f32> {
        let width = self.layout.action().len();
        let steps = &self.setpoints()[sample * width..][..2 * width];
        (0..width).map(move |element| match action {
            Action::Target => steps[width + element],
            Action::Increment => steps[width + element] - steps[element],
        })
    }

    /// The transitions for training, for validation and for the test; `None` where one of them would have none.
    pub fn partition(&self, split: &Split) -> Option<Partition> {
        match split.by {
            Division::Episode => self.partition_by_episode(split),
            Division::Time => self.partition_by_time(split),
            Division::Sample => self.partition_by_sample(split),
        }
    }

    /// The last episodes are for the test, those before for validation, the rest for training.
    ///
    /// Episodes are independent and alike, so their order carries nothing; a split of them keeps neighbours of a
    /// test sample out of training.
    fn partition_by_episode(&self, split: &Split) -> Option<Partition> {
        let counts = split.counts(self.episodes.len())?;
        let all = |episodes: &[Range<usize>]| episodes.iter().flat_map(transitions).collect();
        let (training, others) = self.episodes.split_at(counts.training);
        let (validation, test) = others.split_at(counts.validation);
        Some(Partition { training: all(training), validation: all(validation), test: all(test) })
    }

    /// The last part of each episode is for the test, the one before for validation, the first for training; a gap
    /// lies between each two.
    fn partition_by_time(&self, split: &Split) -> Option<Partition> {
        let mut parts = [(); 3].map(|()| Vec::new());
        for episode in &self.episodes {
            let times = split.times(episode.len(), self.recording.sample_rate_hz)?;
            for (part, time) in parts.iter_mut().zip(times) {
                part.extend(transitions(&(episode.start + time.start..episode.start + time.end)));
            }
        }
        let [training, validation, test] = parts;
        Some(Partition { training, validation, test })
    }

    /// Transitions are drawn at random, by the dataset's seed: all runs on it share one split.
    fn partition_by_sample(&self, split: &Split) -> Option<Partition> {
        let mut drawn: Vec<usize> = self.episodes.iter().flat_map(transitions).collect();
        let counts = split.counts(drawn.len())?;
        let identity = format!("harness split by sample: seed {}", self.recording.seed);
        drawn.shuffle(&mut ChaCha8Rng::from_seed(Sha256::digest(identity).into()));
        let mut take = |count: usize| {
            let mut taken = drawn.split_off(drawn.len() - count);
            taken.sort_unstable();
            taken
        };
        let (test, validation, training) =
            (take(counts.test), take(counts.validation), take(counts.training));
        Some(Partition { training, validation, test })
    }
}

/// The samples in a range whose next sample lies there too.
fn transitions(samples: &Range<usize>) -> Range<usize> {
    samples.start..samples.end.saturating_sub(1)
}

/// Transitions by split: each is a sample whose next sample belongs to the same episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Partition {
    pub training: Vec<usize>,
    pub validation: Vec<usize>,
    pub test: Vec<usize>,
}

/// The values of `modality` at the samples `at`, in physical units, `[at, width]`, frames channel by channel.
pub fn physical(samples: &Samples, modality: Modality, at: &[usize]) -> Vec<f32> {
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

/// What changed in an image since the sample before, in [-1, 1], `[channel, row, column]`.
pub fn frame_difference(samples: &Samples, modality: Modality, sample: usize) -> impl Iterator<Item = f32> {
    let before = samples.previous_frame_bytes(modality, sample);
    let frames = samples.frame_bytes(modality, sample).iter().zip(before);
    frames.map(|(now, before)| (f32::from(*now) - f32::from(*before)) / 255.0)
}
