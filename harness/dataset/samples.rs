//! A dataset in memory, and what a network sees of it.

use crate::simulation::Episode;
use crate::spec::{ARM_JOINTS, Action, FRAME_CHANNELS, FRAME_LEN, FRAME_SIDE, JOINTS, Modality, Split};
use std::ops::Range;

/// Values of one channel of a frame.
pub const FRAME_PLANE: usize = FRAME_SIDE * FRAME_SIDE;

/// All samples of a dataset, episode after episode.
#[derive(Debug, Clone)]
pub struct Samples {
    pub(super) is_simulated: bool,
    /// Where each episode's samples lie, in the order of the episodes.
    episodes: Vec<Range<usize>>,
    proprioception: Vec<f32>,
    arm: Vec<f32>,
    setpoint: Vec<f32>,
    contact_force: Vec<f32>,
    contact_force_mean: Vec<f32>,
    /// `[sample, channel, row, column]`; empty where no frames were asked for.
    vision: Vec<u8>,
}

impl Samples {
    /// Memory that so many samples take, bytes, with frames if `frames`.
    pub fn bytes(samples: usize, frames: bool) -> u64 {
        let numbers = 3 * JOINTS + 2 * ARM_JOINTS;
        let sample = numbers * size_of::<f32>() + if frames { FRAME_LEN } else { 0 };
        (samples as u64).saturating_mul(sample as u64)
    }

    /// An empty dataset with room for `samples`, with frames if `frames`.
    pub fn with_capacity(samples: usize, frames: bool) -> Self {
        Self {
            is_simulated: true,
            episodes: Vec::new(),
            proprioception: Vec::with_capacity(samples * JOINTS),
            arm: Vec::with_capacity(samples * ARM_JOINTS),
            setpoint: Vec::with_capacity(samples * ARM_JOINTS),
            contact_force: Vec::with_capacity(samples * JOINTS),
            contact_force_mean: Vec::with_capacity(samples * JOINTS),
            vision: Vec::with_capacity(if frames { samples * FRAME_LEN } else { 0 }),
        }
    }

    /// Appends an episode; its frames, if it has any, are laid out channel by channel.
    pub fn push(&mut self, episode: &Episode) {
        let first = self.len();
        self.episodes.push(first..first + episode.samples);
        self.proprioception.extend_from_slice(&episode.proprioception);
        self.arm.extend_from_slice(&episode.arm);
        self.setpoint.extend_from_slice(&episode.setpoint);
        self.contact_force.extend_from_slice(&episode.contact_force);
        self.contact_force_mean.extend_from_slice(&episode.contact_force_mean);
        for frame in episode.vision.chunks_exact(FRAME_LEN) {
            for channel in 0..FRAME_CHANNELS {
                self.vision.extend(frame.iter().skip(channel).step_by(FRAME_CHANNELS));
            }
        }
    }

    /// Samples in all.
    pub fn len(&self) -> usize {
        self.arm.len() / ARM_JOINTS
    }

    /// Whether its frames were loaded.
    pub fn has_frames(&self) -> bool {
        !self.vision.is_empty()
    }

    /// Whether the frames show the simulated robot, whose parts are told by their colours.
    pub fn is_simulated(&self) -> bool {
        self.is_simulated
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
        &self.vision
    }

    /// The camera frame of one sample as bytes, `[channel, row, column]`.
    pub fn frame_bytes(&self, sample: usize) -> &[u8] {
        &self.vision[sample * FRAME_LEN..][..FRAME_LEN]
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

    /// Splits the episodes: the last for the test, those before for validation, the rest for training.
    ///
    /// Episodes are independent and alike, so their order carries nothing; splitting by episode keeps
    /// neighbours of a test sample out of training. `None` where no episode would be left for training.
    pub fn partition(&self, split: &Split) -> Option<Partition> {
        let counts = split.counts(self.episodes.len())?;
        let transitions = |episodes: &[Range<usize>]| -> Vec<usize> {
            episodes.iter().flat_map(|range| range.start..range.end.saturating_sub(1)).collect()
        };
        let (training, others) = self.episodes.split_at(counts.training);
        let (validation, test) = others.split_at(counts.validation);
        Some(Partition {
            training: transitions(training),
            validation: transitions(validation),
            test: transitions(test),
        })
    }
}

/// Transitions by split: each is a sample whose next sample belongs to the same episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Partition {
    pub training: Vec<usize>,
    pub validation: Vec<usize>,
    pub test: Vec<usize>,
}
