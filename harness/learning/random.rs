//! The random numbers of a run. candle's own CPU generator is not used, because it can't be seeded.

use harness_spec::Task;
use rand::seq::SliceRandom;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal, Uniform};

/// Independent random streams of a run's seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stream {
    /// Initial parameters of the networks that a task trains.
    Parameters(Task),
    /// Order of the samples, latent noise and dropout of one epoch.
    Epoch {
        /// What is trained.
        task: Task,
        /// The epoch, counted from 0.
        index: usize,
    },
    /// Which inputs each training window of one epoch lacks.
    Missing {
        /// The epoch, counted from 0.
        epoch: usize,
    },
    /// Initial parameters of a network that is not trained.
    Untrained,
    /// Latent states that are drawn for the present sample with this index in its dataset.
    Draws(usize),
    /// Values that are drawn from distributions predicted from the present sample with this index in its dataset.
    Members(usize),
}

/// A generator for one purpose of a run. Its numbers depend only on the seed and the stream.
#[derive(Clone)]
pub struct Random(ChaCha8Rng);

impl Random {
    /// Creates the generator of `stream` for a run with this `seed`.
    pub fn new(seed: u64, stream: Stream) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let block = |task: Task| match task {
            Task::Prediction => 0,
            Task::Reconstruction => 1 << 32,
        };
        generator.set_stream(match stream {
            Stream::Parameters(task) => block(task),
            Stream::Epoch { task, index } => block(task) + 1 + index as u64,
            Stream::Missing { epoch } => (1 << 35) + epoch as u64,
            Stream::Untrained => 1 << 36,
            Stream::Draws(sample) => (1 << 33) + sample as u64,
            Stream::Members(sample) => (1 << 34) + sample as u64,
        });
        Self(generator)
    }

    /// Draws `len` values from the standard normal distribution.
    pub fn normal(&mut self, len: usize) -> Vec<f32> {
        StandardNormal.sample_iter(&mut self.0).take(len).collect()
    }

    /// Draws `len` values from the uniform distribution on `[-bound, bound]`.
    pub fn uniform(&mut self, len: usize, bound: f32) -> Vec<f32> {
        match Uniform::new_inclusive(-bound, bound) {
            Ok(uniform) => uniform.sample_iter(&mut self.0).take(len).collect(),
            Err(_) => vec![0.0; len],
        }
    }

    /// Draws a seed for another generator.
    pub fn seed(&mut self) -> u64 {
        self.0.next_u64()
    }

    /// Returns whether something with this probability happens.
    pub fn happens(&mut self, probability: f64) -> bool {
        self.0.random_bool(probability)
    }

    /// Draws an integer from 0 to `most`.
    pub fn up_to(&mut self, most: usize) -> usize {
        self.0.random_range(0..=most)
    }

    /// Shuffles `values`.
    pub fn shuffle<T>(&mut self, values: &mut [T]) {
        values.shuffle(&mut self.0);
    }
}
