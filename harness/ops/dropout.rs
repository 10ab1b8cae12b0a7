//! Dropout (Srivastava et al., 2014, JMLR 15): each training step sets random values to zero, which reduces
//! overfitting.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Decides which values one training step sets to zero.
#[derive(Debug, Clone, Copy)]
pub struct Dropout {
    /// Of 65,536 values, the number that is set to zero on average.
    left_out: u16,
    seed: u64,
}

impl Dropout {
    /// Sets each value to zero with probability `share`, which is in [0, 1) and rounded down to a multiple of 1/65536.
    /// `seed` determines which values these are.
    pub fn new(share: f64, seed: u64) -> Self {
        Self { left_out: (share * 65536.0) as u16, seed }
    }

    /// Returns the factor of the other values. It keeps the mean of a sum over all values.
    pub fn scale(&self) -> f32 {
        (1.0 / (1.0 - f64::from(self.left_out) / 65536.0)) as f32
    }

    /// Returns the number of values that are set to zero on average, of 65,536.
    pub fn left_out(&self) -> u16 {
        self.left_out
    }

    /// Returns the key of the random generator, as words of 32 bits.
    pub fn key(&self) -> Vec<u32> {
        let bytes = ChaCha8Rng::seed_from_u64(self.seed).get_seed();
        bytes.chunks_exact(4).map(|word| u32::from_le_bytes([word[0], word[1], word[2], word[3]])).collect()
    }

    /// Sets some values of sample `sample` of the batch to zero, and scales the others.
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
