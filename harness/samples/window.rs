//! Samples, and the division of windows into training, validation and test.

use super::Samples;
use harness_spec::{Division, Part, Split, Window};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};
use std::iter::repeat;
use std::ops::Range;

/// A sample of a dataset, by its position among the samples of all episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Sample(u32);

impl Sample {
    /// Returns the sample at a position, counted from 0.
    ///
    /// # Panics
    /// When the position is at least 2^32. So many samples of a single number would take 17 GB.
    pub fn at(position: usize) -> Self {
        Self(u32::try_from(position).expect("a dataset has fewer than 2^32 samples"))
    }

    /// Returns the position, counted from 0.
    pub fn index(self) -> usize {
        self.0 as usize
    }

    /// Returns the sample that follows `steps` later.
    pub fn after(self, steps: usize) -> Self {
        Self::at(self.index() + steps)
    }

    /// Returns the sample that came `steps` before.
    ///
    /// # Panics
    /// When the dataset begins later.
    pub fn before(self, steps: usize) -> Self {
        Self::at(self.index().checked_sub(steps).expect("the dataset begins before the sample"))
    }
}

/// Returns the samples that follow those in `at` `steps` later.
pub fn after(at: &[Sample], steps: usize) -> Vec<Sample> {
    at.iter().map(|sample| sample.after(steps)).collect()
}

/// Returns the samples that came `steps` before those in `at`.
///
/// # Panics
/// When the dataset begins later.
pub fn before(at: &[Sample], steps: usize) -> Vec<Sample> {
    at.iter().map(|sample| sample.before(steps)).collect()
}

/// Returns the ranges of consecutive samples in `samples`, which are in ascending order.
fn runs(samples: &[Sample]) -> impl Iterator<Item = Range<usize>> {
    let parts = samples.chunk_by(|one, next| one.index() + 1 == next.index());
    parts.map(|part| part[0].index()..part[part.len() - 1].index() + 1)
}

/// Returns sequences of `length` consecutive samples that share none of them, so that together they cover nearly all.
/// Each is named by its last sample. `samples` are in ascending order. `offset` says how many samples are left out
/// before the first sequence of consecutive samples, given how many are left over.
pub fn sequences(samples: &[Sample], length: usize, mut offset: impl FnMut(usize) -> usize) -> Vec<Sample> {
    if length == 1 {
        return samples.to_vec();
    }
    let mut taken = Vec::new();
    for run in runs(samples) {
        let first = run.start + offset(run.len() % length) + length - 1;
        taken.extend((0..run.len() / length).map(|index| Sample::at(first + index * length)));
    }
    taken
}

/// Returns the last sample of each sequence of `length` consecutive samples, also of those that share samples.
/// `samples` are in ascending order.
pub fn ends(samples: &[Sample], length: usize) -> Vec<Sample> {
    runs(samples).flat_map(|run| (run.start + length - 1..run.end).map(Sample::at)).collect()
}

/// Returns the present samples of all windows within a range of consecutive samples.
fn within(window: &Window, samples: &Range<usize>) -> impl Iterator<Item = Sample> + use<> {
    let first = samples.start + window.context - 1;
    (first..samples.end.saturating_sub(window.horizon)).map(Sample::at)
}

/// Windows by split, each named by its present sample.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Partition {
    /// Windows for training. If episodes or times are split, their context is one sample, and [`sequences`] joins them.
    pub training: Vec<Sample>,
    /// Windows for validation, like those for training.
    pub validation: Vec<Sample>,
    /// Windows for the test.
    pub test: Vec<Sample>,
}

impl Samples {
    /// Returns the present samples of all windows, in their order. A window never leaves its episode.
    pub fn windows(&self, window: &Window) -> Vec<Sample> {
        self.episodes().iter().flat_map(|range| within(window, range)).collect()
    }

    /// Divides the windows into training, validation and test; `None` if one of them would have no whole window. A
    /// window never leaves its episode. If episodes or times are split, it never leaves its part.
    pub fn partition(&self, split: &Split, window: &Window) -> Option<Partition> {
        let split = &self.split(split);
        let partition = match split.by {
            Division::Episode | Division::Label(_) => self.partition_by_episode(split, window),
            Division::Time => self.partition_by_time(split, window),
            Division::Sample => self.partition_by_sample(split, window),
        }?;
        let least = if split.by == Division::Sample { 1 } else { window.context };
        let is_whole = |part: &Vec<Sample>, least| runs(part).any(|run| run.len() >= least);
        let Partition { training, validation, test } = &partition;
        let are_whole = is_whole(training, least) && is_whole(validation, least) && is_whole(test, 1);
        are_whole.then_some(partition)
    }

    /// The episodes of each group are in one part. Without groups, the last episodes are for the test, those before them
    /// for validation, and the rest for training. If the test has a dataset of its own, all episodes of that dataset are
    /// for the test, and no others.
    ///
    /// Episodes are independent and have the same distribution, so their order does not matter. Splitting by episode
    /// keeps the neighbors of a test sample out of the training data.
    fn partition_by_episode(&self, split: &Split, window: &Window) -> Option<Partition> {
        let own: Vec<usize> = self.own_episodes().iter().map(Range::len).collect();
        let parts = self.labels().parts(split, &own, self.has_own_test()).ok()?;
        let parts: Vec<Part> =
            parts.into_iter().chain(repeat(Part::Test)).take(self.episodes().len()).collect();
        let of = |wanted: Part, window: Window| {
            let all = self.episodes().iter().zip(&parts).filter(|(_, part)| **part == wanted);
            all.flat_map(|(range, _)| within(&window, range)).collect()
        };
        Some(Partition {
            training: of(Part::Training, window.of_one_sample()),
            validation: of(Part::Validation, window.of_one_sample()),
            test: of(Part::Test, window.judged()),
        })
    }

    /// In each episode, the last part is for the test, the part before it for validation, and the first part for
    /// training. A gap separates the parts. An episode that is too short for them is left out.
    fn partition_by_time(&self, split: &Split, window: &Window) -> Option<Partition> {
        let mut parts = [(); 3].map(|()| Vec::new());
        let windows = [window.of_one_sample(), window.of_one_sample(), window.clone()];
        for episode in self.episodes() {
            let rate = self.recording().sample_rate_hz;
            let Some(times) = split.times(episode.len(), window.samples(), rate) else { continue };
            for ((part, time), window) in parts.iter_mut().zip(times).zip(&windows) {
                part.extend(within(window, &(episode.start + time.start..episode.start + time.end)));
            }
        }
        let [training, validation, test] = parts;
        Some(Partition { training, validation, test })
    }

    /// Windows are drawn at random. The seed is that of the dataset, so all runs on the dataset have the same split.
    /// Windows of different parts share samples.
    fn partition_by_sample(&self, split: &Split, window: &Window) -> Option<Partition> {
        let mut drawn = self.windows(window);
        let counts = split.counts(drawn.len(), false)?;
        let identity = format!("harness split by sample: seed {}", self.recording().seed);
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
