//! Adam, element by element, and the sum of squares for a gradient's norm.

use crate::simd;
use rayon::prelude::*;

/// Number of values that one thread processes at a time. It is fixed, so that sums always have the same order.
const PART: usize = 1 << 16;

/// The factors of one step of Adam (Kingma & Ba, 2015, algorithm 1; with weight decay Loshchilov & Hutter, 2019,
/// algorithm 2).
#[derive(Debug, Clone, Copy)]
pub struct AdamStep {
    /// Factor of the gradient; below 1 if the gradient is clipped.
    pub gradient_scale: f32,
    /// Share of the parameter that remains after weight decay.
    pub kept: f32,
    /// Learning rate.
    pub learning_rate: f32,
    /// Decay rate of the gradient's running mean.
    pub beta_mean: f32,
    /// Decay rate of the running mean of the gradient's square.
    pub beta_square: f32,
    /// Added to the root of the mean square, so that the divisor is not zero.
    pub epsilon: f32,
    /// Bias correction of the mean, `1 / (1 - beta_mean^t)`.
    pub mean_correction: f32,
    /// Bias correction of the mean square, `1 / (1 - beta_square^t)`.
    pub square_correction: f32,
}

/// Takes one step of Adam over a parameter and its two moments, in place.
pub fn adam(step: AdamStep, parameter: &mut [f32], grad: &[f32], mean: &mut [f32], square: &mut [f32]) {
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
                let grad = grad * step.gradient_scale;
                *mean += (1.0 - step.beta_mean) * (grad - *mean);
                *square += (1.0 - step.beta_square) * (grad * grad - *square);
                let scale = (*square * step.square_correction).sqrt() + step.epsilon;
                *parameter =
                    *parameter * step.kept - step.learning_rate * *mean * step.mean_correction / scale;
            }
        },
    );
}

/// Returns the sum of the squares of `values`. The order of the additions depends only on the number of values.
pub fn sum_of_squares(values: &[f32]) -> f64 {
    let parts: Vec<f64> = values.par_chunks(PART).map(sum_of_squares_of_part).collect();
    parts.into_iter().sum()
}

fn sum_of_squares_of_part(values: &[f32]) -> f64 {
    const LANES: usize = 16;
    simd(
        #[inline(always)]
        || {
            let mut lanes = [0.0; LANES];
            let add = |lanes: &mut [f64; LANES], values: &[f32]| {
                for (lane, value) in lanes.iter_mut().zip(values) {
                    *lane += f64::from(*value) * f64::from(*value);
                }
            };
            let (whole, rest) = values.as_chunks::<LANES>();
            for values in whole {
                add(&mut lanes, values);
            }
            add(&mut lanes, rest);
            lanes.into_iter().sum()
        },
    )
}
