//! Adam, element by element, and the sum of squares that a gradient's norm is made of.

use crate::simd;
use rayon::prelude::*;

/// Values that one thread takes at a time; fixed, so that sums are always taken in the same order.
const PART: usize = 1 << 16;

/// What one step of Adam multiplies by (Kingma & Ba, 2015, algorithm 1; with decay Loshchilov & Hutter, 2019,
/// algorithm 2).
#[derive(Debug, Clone, Copy)]
pub struct AdamStep {
    /// Of the gradient, before anything else; below 1 where it is clipped.
    pub gradient_scale: f32,
    /// Share of the parameter that weight decay leaves.
    pub kept: f32,
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

/// The sum of the squares of `values`, in an order that depends on their number alone.
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
