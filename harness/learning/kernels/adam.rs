//! Adam, element by element.

use super::simd;
use rayon::prelude::*;

/// Adam's constants for one step (Kingma & Ba, 2015, algorithm 1).
#[derive(Debug, Clone, Copy)]
pub struct AdamStep {
    pub learning_rate: f32,
    pub beta_mean: f32,
    pub beta_square: f32,
    pub epsilon: f32,
    /// `1 / (1 - beta_mean^t)`.
    pub mean_correction: f32,
    /// `1 / (1 - beta_square^t)`.
    pub square_correction: f32,
}

/// One step of Adam over a parameter and its two moments, in place.
pub fn adam(step: AdamStep, parameter: &mut [f32], grad: &[f32], mean: &mut [f32], square: &mut [f32]) {
    const PART: usize = 1 << 16;
    if parameter.len() <= PART {
        return adam_part(step, parameter, grad, mean, square);
    }
    parameter
        .par_chunks_mut(PART)
        .zip(grad.par_chunks(PART))
        .zip(mean.par_chunks_mut(PART).zip(square.par_chunks_mut(PART)))
        .for_each(|((parameter, grad), (mean, square))| adam_part(step, parameter, grad, mean, square));
}

fn adam_part(step: AdamStep, parameter: &mut [f32], grad: &[f32], mean: &mut [f32], square: &mut [f32]) {
    simd(
        #[inline(always)]
        || {
            for (((parameter, grad), mean), square) in parameter.iter_mut().zip(grad).zip(mean).zip(square) {
                *mean += (1.0 - step.beta_mean) * (grad - *mean);
                *square += (1.0 - step.beta_square) * (grad * grad - *square);
                let scale = (*square * step.square_correction).sqrt() + step.epsilon;
                *parameter -= step.learning_rate * *mean * step.mean_correction / scale;
            }
        },
    );
}
