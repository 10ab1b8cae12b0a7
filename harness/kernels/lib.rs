//! The arithmetic of the networks' custom ops, on plain slices. All matrices are row-major.
//!
//! Every reduction has a fixed number of parts and a fixed order. Results therefore depend neither on the number of
//! threads nor on their scheduling.

pub mod adam;
#[cfg(target_arch = "x86_64")]
mod amx;
pub mod convolution;
mod matrix;
pub mod product;
pub mod repeated;

use pulp::{Arch, WithSimd};
use rayon::prelude::*;
use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, OnceLock};

/// Number of parts that a reduction over a batch is divided into. It is fixed, so that sums always have the same order.
pub const PARTS: usize = 16;
/// Number of values from which on a pass uses several threads.
const PARALLEL_LEN: usize = 1 << 18;

/// Runs `op`, compiled for the widest vectors that the processor has.
pub fn simd<Op: WithSimd>(op: Op) -> Op::Output {
    static ARCH: OnceLock<Arch> = OnceLock::new();
    ARCH.get_or_init(Arch::new).dispatch(op)
}

/// Returns a vector of `len` values. The caller must write each value before reading it.
pub fn scratch(len: usize) -> Vec<f32> {
    // The allocator gets zeroed memory from the system without a pass over it.
    vec![0.0; len]
}

/// A large vector for the duration of an op. The next buffer of the same length reuses its memory.
///
/// A new buffer has arbitrary values, so each must be written before it is read. Without reuse, the allocator or the
/// system would clear hundreds of megabytes in every training step.
pub struct Buffer(Vec<f32>);

/// Buffers that can be reused.
static IDLE: Mutex<Vec<Vec<f32>>> = Mutex::new(Vec::new());
/// Most buffers that are kept for reuse: as many as a training step needs.
const MAX_IDLE: usize = 8;

impl Buffer {
    /// Returns a buffer of `len` arbitrary values.
    pub fn new(len: usize) -> Self {
        let mut idle = IDLE.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let found = idle.iter().position(|values| values.len() == len);
        Self(found.map_or_else(|| vec![0.0; len], |index| idle.swap_remove(index)))
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        let mut idle = IDLE.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if idle.len() == MAX_IDLE {
            idle.remove(0);
        }
        idle.push(std::mem::take(&mut self.0));
    }
}

impl Deref for Buffer {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.0
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.0
    }
}

/// Adds `bias` `[width]` to every row of `rows` `[n, width]`. If `relu`, negative sums become zero.
pub fn add_bias(rows: &mut [f32], bias: &[f32], relu: bool) {
    for_each_part(rows, bias.len(), |_, part| add_bias_to_rows(part, bias, relu));
}

/// Does the same as [`add_bias`] on the calling thread.
pub fn add_bias_to_rows(rows: &mut [f32], bias: &[f32], relu: bool) {
    let floor = if relu { 0.0 } else { f32::NEG_INFINITY };
    simd(
        #[inline(always)]
        || {
            for row in rows.chunks_exact_mut(bias.len()) {
                for (value, bias) in row.iter_mut().zip(bias) {
                    *value = (*value + bias).max(floor);
                }
            }
        },
    );
}

/// Calls `work` with the index of the first value and the values of each part of `rows` `[n, width]`. Many values are
/// processed in parallel.
fn for_each_part(rows: &mut [f32], width: usize, work: impl Fn(usize, &mut [f32]) + Sync) {
    if rows.len() < PARALLEL_LEN {
        return work(0, rows);
    }
    let part = rows.len().div_ceil(PARTS).next_multiple_of(width);
    rows.par_chunks_mut(part).enumerate().for_each(|(index, rows)| work(index * part, rows));
}

/// Sets `grad` to zero where a ReLU's `output` is zero. This turns the gradient of the output into that of the input.
pub fn mask(grad: &mut [f32], output: &[f32]) {
    for_each_part(grad, 1, |first, grad| {
        let output = &output[first..];
        simd(
            #[inline(always)]
            || {
                for (grad, output) in grad.iter_mut().zip(output) {
                    *grad = if *output > 0.0 { *grad } else { 0.0 };
                }
            },
        );
    });
}

/// Returns the sums of the columns of `rows` `[n, width]`.
pub fn column_sums(rows: &[f32], width: usize) -> Vec<f32> {
    let part = rows.len().div_ceil(PARTS).next_multiple_of(width).max(width);
    let sum_rows = |part: &[f32]| {
        let mut sums = vec![0.0; width];
        part.chunks_exact(width).for_each(|row| add_to(&mut sums, row));
        sums
    };
    let sums = if rows.len() < PARALLEL_LEN {
        rows.chunks(part).map(sum_rows).collect()
    } else {
        rows.par_chunks(part).map(sum_rows).collect()
    };
    sum_in_order(sums, width)
}

/// Adds `values` to `sum`, element by element.
pub fn add_to(sum: &mut [f32], values: &[f32]) {
    simd(
        #[inline(always)]
        || {
            for (sum, value) in sum.iter_mut().zip(values) {
                *sum += value;
            }
        },
    );
}

/// Returns the sum of vectors of length `len`, added from the first to the last.
pub fn sum_in_order(parts: Vec<Vec<f32>>, len: usize) -> Vec<f32> {
    parts
        .into_iter()
        .reduce(|mut sum, part| {
            add_to(&mut sum, &part);
            sum
        })
        .unwrap_or_else(|| vec![0.0; len])
}

/// Returns `e^x`, exact to two units in the last place. Unlike libm's function, which is called for each value, it can
/// be vectorized.
///
/// It computes `x = n ln 2 + r`, a polynomial for `e^r` (the coefficients of Cephes' expf, Moshier 1992), and adds `n`
/// to the exponent. Arguments are clamped to -87 and 88, so the result is always a normal f32.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    const COEFFICIENTS: [f32; 6] =
        [1.987_569_1e-4, 1.398_2e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5];
    /// Adding and subtracting this number rounds to an integer.
    const ROUND: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 88.0);
    let rounded = x * std::f32::consts::LOG2_E + ROUND;
    let n = rounded - ROUND;
    let r = x - n * LN_2[0] - n * LN_2[1];
    let polynomial = COEFFICIENTS.iter().fold(0.0, |sum, coefficient| sum * r + coefficient);
    // The lowest bits of `rounded` are those of the integer `n`. A conversion of `n` would not be vectorized.
    let exponent = rounded.to_bits().wrapping_add(127) << 23;
    (polynomial * r * r + r + 1.0) * f32::from_bits(exponent)
}

/// Returns the sum of all values.
pub fn sum(values: &[f32]) -> f32 {
    // Each sum waits for its last addition. Four of the widest vectors of sums keep the processor busy.
    const LANES: usize = 64;
    let mut lanes = [0.0f32; LANES];
    simd(
        #[inline(always)]
        || {
            let (chunks, rest) = values.as_chunks::<LANES>();
            for chunk in chunks {
                for (lane, value) in lanes.iter_mut().zip(chunk) {
                    *lane += value;
                }
            }
            lanes.iter().chain(rest).sum()
        },
    )
}
