//! Dropout (Srivastava et al., 2014, JMLR 15): a training step that leaves values out keeps a network from knowing
//! its training samples by heart.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Which values one training step leaves out.
#[derive(Debug, Clone, Copy)]
pub struct Dropout {
    /// Of 65536 values, how many are left out on average.
    left_out: u16,
    seed: u64,
}

impl Dropout {
    /// Leaves each value out with probability `share` in [0, 1), to a 65536th; which ones is decided by `seed`.
    pub fn new(share: f64, seed: u64) -> Self {
        Self { left_out: (share * 65536.0) as u16, seed }
    }

    /// What the remaining values are multiplied with, so that a sum over all keeps its mean.
    pub fn scale(&self) -> f32 {
        (1.0 / (1.0 - f64::from(self.left_out) / 65536.0)) as f32
    }

    /// Leaves values of one sample of the batch out, and raises the others.
    pub fn apply(&self, sample: usize, values: &mut [f32]) {
        let (scale, mut random) = (self.scale(), ChaCha8Rng::seed_from_u64(self.seed));
        random.set_stream(sample as u64);
        for pair in values.chunks_mut(2) {
            let draw = random.next_u32();
            for (value, draw) in pair.iter_mut().zip([draw as u16, (draw >> 16) as u16]) {
                *value = if draw < self.left_out { 0.0 } else { *value * scale };
            }
        }
    }
}
