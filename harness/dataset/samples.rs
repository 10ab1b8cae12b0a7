//! A dataset in memory, and what a network sees of it.

use super::DatasetError;
use super::frame_store::{FramePlace, FrameStore, frame_bytes};
use crate::simulation::Episode;
use crate::spec::{ARM_JOINTS, Action, Division, FRAME_LEN, FRAME_SIDE, JOINTS, Modality, Split};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Values of one channel of a frame.
pub const FRAME_PLANE: usize = FRAME_SIDE * FRAME_SIDE;

/// What holds for all samples of a dataset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recording {
    /// Whether the frames show the simulated robot, whose parts are told by their colours.
    pub is_simulated: bool,
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
    proprioception: Vec<f32>,
    arm: Vec<f32>,
    setpoint: Vec<f32>,
    contact_force: Vec<f32>,
    contact_force_mean: Vec<f32>,
    /// `[sample, channel, row, column]`; empty where no frames were asked for.
    vision: FrameStore,
    /// Of the dataset, which may hold its frames.
    folder: PathBuf,
}

impl Samples {
    /// Memory that so many samples take, bytes, with their frames in their place.
    pub fn bytes(samples: usize, frames: FramePlace) -> u64 {
        let numbers = 3 * JOINTS + 2 * ARM_JOINTS;
        let numbers = (samples as u64).saturating_mul((numbers * size_of::<f32>()) as u64);
        numbers.saturating_add(if frames == FramePlace::Memory { frame_bytes(samples) } else { 0 })
    }

    /// An empty dataset with room for `samples`, whose frames have their place; `folder` is that of the dataset.
    ///
    /// # Errors
    /// When the frames' place is the disk, and no file can be made there.
    pub fn new(
        recording: Recording,
        samples: usize,
        frames: FramePlace,
        folder: &Path,
    ) -> Result<Self, DatasetError> {
        let vision = FrameStore::new(frames, samples, folder);
        Ok(Self {
            recording,
            episodes: Vec::new(),
            proprioception: Vec::with_capacity(samples * JOINTS),
            arm: Vec::with_capacity(samples * ARM_JOINTS),
            setpoint: Vec::with_capacity(samples * ARM_JOINTS),
            contact_force: Vec::with_capacity(samples * JOINTS),
            contact_force_mean: Vec::with_capacity(samples * JOINTS),
            vision: vision.map_err(|source| DatasetError::Frames { folder: folder.to_owned(), source })?,
            folder: folder.to_owned(),
        })
    }

    /// Appends an episode, with its frames if it has any.
    ///
    /// # Errors
    /// When frames can't be written to disk.
    pub fn push(&mut self, episode: &Episode) -> Result<(), DatasetError> {
        let first = self.len();
        self.episodes.push(first..first + episode.samples);
        self.proprioception.extend_from_slice(&episode.proprioception);
        self.arm.extend_from_slice(&episode.arm);
        self.setpoint.extend_from_slice(&episode.setpoint);
        self.contact_force.extend_from_slice(&episode.contact_force);
        self.contact_force_mean.extend_from_slice(&episode.contact_force_mean);
        let pushed = self.vision.push(&episode.vision);
        pushed.map_err(|source| DatasetError::Frames { folder: self.folder.clone(), source })
    }

    /// Samples in all.
    pub fn len(&self) -> usize {
        self.arm.len() / ARM_JOINTS
    }

    /// Whether its frames were loaded.
    pub fn has_frames(&self) -> bool {
        !self.frames().is_empty()
    }

    /// Whether the frames show the simulated robot, whose parts are told by their colours.
    pub fn is_simulated(&self) -> bool {
        self.recording.is_simulated
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
    pub fn vectors(&self, modality: Modality) -> &[f32] {
        match modality {
            Modality::Proprioception => &self.proprioception,
            Modality::Arm => &self.arm,
            Modality::ContactForce => &self.contact_force,
            Modality::ContactForceMean => &self.contact_force_mean,
            Modality::Vision | Modality::FrameDifference => unreachable!("frames are read by `frame_bytes`"),
        }
    }

    /// A vector modality of one sample, in physical units.
    pub fn vector(&self, modality: Modality, sample: usize) -> &[f32] {
        &self.vectors(modality)[sample * modality.width()..][..modality.width()]
    }

    /// The arm's commanded setpoint at all samples, in the units of `arm`, `[samples, 3]`.
    pub fn setpoints(&self) -> &[f32] {
        &self.setpoint
    }

    /// The camera's frames of all samples, `[samples, channel, row, column]`; empty if they weren't loaded.
    pub fn frames(&self) -> &[u8] {
        self.vision.bytes()
    }

    /// The camera frame of one sample as bytes, `[channel, row, column]`.
    pub fn frame_bytes(&self, sample: usize) -> &[u8] {
        &self.frames()[sample * FRAME_LEN..][..FRAME_LEN]
    }

    /// Says that the frames of these samples, and of those before them, are about to be read. It changes nothing but the
    /// time that frames on disk take, and the memory: those that were read long ago are let go.
    pub fn prefetch(&self, samples: &[usize]) {
        self.vision.prefetch(samples);
    }

    /// The frame before `sample` in its episode; at the start, the frame itself, since nothing moved before.
    pub fn previous_frame_bytes(&self, sample: usize) -> &[u8] {
        let (_, place) = self.place(sample);
        self.frame_bytes(if place == 0 { sample } else { sample - 1 })
    }

    /// What the decoder is told about the step from `sample` to the next.
    pub fn action(&self, action: Action, sample: usize) -> [f32; ARM_JOINTS] {
        let setpoint = |sample: usize, joint: usize| self.setpoint[sample * ARM_JOINTS + joint];
        std::array::from_fn(|joint| match action {
            Action::Target => setpoint(sample + 1, joint),
            Action::Increment => setpoint(sample + 1, joint) - setpoint(sample, joint),
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
