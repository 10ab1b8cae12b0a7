//! The arithmetic under the network's own ops, on plain slices. Row-major matrices throughout.
//!
//! Every reduction runs over a fixed number of parts in a fixed order, so that results depend neither on the
//! number of threads nor on how work happens to be scheduled.

pub mod adam;
#[cfg(target_arch = "x86_64")]
mod amx;
pub mod convolution;
pub mod product;

use pulp::{Arch, WithSimd};
use rayon::prelude::*;
use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, OnceLock};

/// Parts that a reduction over a batch is cut into; fixed, so that sums are always taken in the same order.
pub const PARTS: usize = 16;
/// Values from which on a pass is worth several threads.
const PARALLEL_LEN: usize = 1 << 18;

/// Runs `op` compiled for the widest vectors that the processor has.
pub fn simd<Op: WithSimd>(op: Op) -> Op::Output {
    static ARCH: OnceLock<Arch> = OnceLock::new();
    ARCH.get_or_init(Arch::new).dispatch(op)
}

/// A vector of `len` values that the caller writes before reading any.
pub fn scratch(len: usize) -> Vec<f32> {
    // Zeroed memory comes from the allocator without a pass over it.
    vec![0.0; len]
}

/// A large vector for the time of an op, whose memory the next one of the same length takes over.
///
/// Its values are whatever they were: the holder writes each before it reads it. Fresh memory would be cleared by
/// the allocator or the system first, hundreds of megabytes in every training step.
pub struct Buffer(Vec<f32>);

/// Buffers that wait for their next use.
static IDLE: Mutex<Vec<Vec<f32>>> = Mutex::new(Vec::new());
/// Buffers that wait at most: those of a training step.
const MAX_IDLE: usize = 4;

impl Buffer {
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

/// Adds `bias` `[width]` to every row of `rows` `[n, width]`, then cuts negative values where `relu` says so.
pub fn add_bias(rows: &mut [f32], bias: &[f32], relu: bool) {
    for_each_part(rows, bias.len(), |_, part| add_bias_to_rows(part, bias, relu));
}

/// The same on this thread alone.
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

/// Calls `work` with the place and the values of parts of `rows` `[n, width]`, in parallel if there are many.
fn for_each_part(rows: &mut [f32], width: usize, work: impl Fn(usize, &mut [f32]) + Sync) {
    if rows.len() < PARALLEL_LEN {
        return work(0, rows);
    }
    let part = rows.len().div_ceil(PARTS).next_multiple_of(width);
    rows.par_chunks_mut(part).enumerate().for_each(|(index, rows)| work(index * part, rows));
}

/// Cuts `grad` to zero where a ReLU's `output` is zero: the gradient before it, given the one after it.
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

/// Sums of the columns of `rows` `[n, width]`.
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

/// `sum += values`.
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

/// The sum of equally long vectors, from the first to the last.
pub fn sum_in_order(parts: Vec<Vec<f32>>, len: usize) -> Vec<f32> {
    parts
        .into_iter()
        .reduce(|mut sum, part| {
            add_to(&mut sum, &part);
            sum
        })
        .unwrap_or_else(|| vec![0.0; len])
}

/// `e^x`, to two units in the last place, in arithmetic that vectorises; libm's is a call for each value.
///
/// By `x = n ln 2 + r`, a polynomial for `e^r` (the coefficients of Cephes' expf, Moshier 1992), and `n` put into the
/// exponent. Below -87 and above 88 the result stays at the ends of f32's normal range.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    const COEFFICIENTS: [f32; 6] =
        [1.987_569_1e-4, 1.398_2e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5];
    /// Adding it rounds to a whole number.
    const ROUND: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 88.0);
    let n = (x * std::f32::consts::LOG2_E + ROUND) - ROUND;
    let r = x - n * LN_2[0] - n * LN_2[1];
    let polynomial = COEFFICIENTS.iter().fold(0.0, |sum, coefficient| sum * r + coefficient);
    let exponent = ((n as i32 + 127) << 23) as u32;
    (polynomial * r * r + r + 1.0) * f32::from_bits(exponent)
}

/// The sum of all values.
pub fn sum(values: &[f32]) -> f32 {
    // As many sums as four of the widest vectors hold: each waits for its last addition.
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
