//! Products of a few rows with the same matrix, again and again.

// Sums that are indexed by constants stay in registers. With iterators they would not.
#![allow(clippy::needless_range_loop)]

use crate::matrix::{Accumulate, Matrix};
use crate::product::{Arithmetic, Precision, product};
use crate::simd;
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

/// Number of columns that are packed together.
const PANEL: usize = 64;
/// Most rows that are multiplied at once, so that their sums stay in registers.
const ROWS: usize = 6;
/// Number of columns of a row that are packed before the next row, so that the panel's part stays in the nearest cache.
const BLOCK: usize = 64;

/// A matrix that is multiplied with a few rows at a time. A general product packs its operands each time. With few
/// rows, this costs as much as the product, so the matrix is packed only once, and multiplied on the vector units.
pub struct Repeated<'a> {
    matrix: Matrix<'a>,
    arithmetic: Arithmetic,
    /// Each panel has `PANEL` columns of the matrix, `[panel, row, column]`. Without panels, the products are general
    /// ones.
    panels: Vec<[f32; PANEL]>,
}

impl<'a> Repeated<'a> {
    /// Prepares `times` products with a matrix.
    pub fn new(matrix: Matrix<'a>, times: usize, arithmetic: Arithmetic) -> Self {
        let packed = times > 1 && arithmetic.precision == Precision::F32;
        Self { matrix, arithmetic, panels: if packed { panels(matrix) } else { Vec::new() } }
    }

    /// Returns the number of parts that rows should be divided into for `threads` threads. Each thread then multiplies
    /// the rows of one part. A sum does not depend on the other rows, so the parts do not change results.
    pub fn parts(&self, threads: usize) -> usize {
        if self.panels.is_empty() { 1 } else { threads }
    }

    /// Adds the product of `rows` `[n, inner]` with the matrix `[inner, columns]` to `out` `[n, columns]`. A general
    /// product uses `threads` threads.
    pub fn add_product(&self, rows: &[f32], out: &mut [f32], threads: usize) {
        let (inner, columns) = self.matrix.shape();
        let count = rows.len() / inner;
        assert_eq!((rows.len(), out.len()), (count * inner, count * columns), "sizes of a repeated product");
        if self.panels.is_empty() {
            let rows = Matrix::plain(rows, count, inner);
            return product(rows, self.matrix, out, Accumulate::Add, self.arithmetic, threads);
        }
        simd(AddProduct { rows, panels: &self.panels, inner, columns, out });
    }
}

/// Packs a matrix into panels. Columns past the last one are zero.
fn panels(matrix: Matrix) -> Vec<[f32; PANEL]> {
    let (inner, columns) = matrix.shape();
    let (column_stride, row_stride) = matrix.strides();
    let (column_stride, row_stride) = (column_stride.unsigned_abs(), row_stride.unsigned_abs());
    let mut panels = vec![[0.0; PANEL]; columns.div_ceil(PANEL) * inner];
    panels.par_chunks_exact_mut(inner).enumerate().for_each(|(index, panel)| {
        let first = index * PANEL;
        for (block, rows) in panel.chunks_mut(BLOCK).enumerate() {
            for column in 0..PANEL.min(columns - first) {
                let start = (first + column) * column_stride + block * BLOCK * row_stride;
                let values = matrix.values[start..].iter().step_by(row_stride);
                rows.iter_mut().zip(values).for_each(|(row, value)| row[column] = *value);
            }
        }
    });
    panels
}

struct AddProduct<'a> {
    rows: &'a [f32],
    panels: &'a [[f32; PANEL]],
    inner: usize,
    columns: usize,
    out: &'a mut [f32],
}

impl WithSimd for AddProduct<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // The number of vectors of a row whose sums fit in the registers.
        if S::F32_LANES == 16 { self.run::<S, 4>(simd) } else { self.run::<S, 2>(simd) }
    }
}

impl AddProduct<'_> {
    #[inline(always)]
    fn run<S: Simd, const N: usize>(self, simd: S) {
        let Self { rows, panels, inner, columns, out } = self;
        let count = rows.len() / inner;
        // As equal as possible: ten rows are two times five.
        let tile = count.div_ceil(count.div_ceil(ROWS).max(1));
        for (panel, first) in panels.chunks_exact(inner).zip((0..columns).step_by(PANEL)) {
            let width = PANEL.min(columns - first);
            let tiles = rows.chunks(tile * inner).zip(out.chunks_mut(tile * columns));
            for (rows, out) in tiles {
                match rows.len() / inner {
                    1 => add::<S, N, 1>(simd, rows, panel, out, [first, width]),
                    2 => add::<S, N, 2>(simd, rows, panel, out, [first, width]),
                    3 => add::<S, N, 3>(simd, rows, panel, out, [first, width]),
                    4 => add::<S, N, 4>(simd, rows, panel, out, [first, width]),
                    5 => add::<S, N, 5>(simd, rows, panel, out, [first, width]),
                    _ => add::<S, N, ROWS>(simd, rows, panel, out, [first, width]),
                }
            }
        }
    }
}

/// Adds the product of `R` rows with a panel to `width` columns of `out` from `first` on, `N` vectors at a time.
#[inline(always)]
fn add<S: Simd, const N: usize, const R: usize>(
    simd: S,
    rows: &[f32],
    panel: &[[f32; PANEL]],
    out: &mut [f32],
    [first, width]: [usize; 2],
) {
    let (inner, columns) = (panel.len(), out.len() / R);
    let mut rows_of = [rows; R];
    for row in 0..R {
        rows_of[row] = &rows[row * inner..][..inner];
    }
    let mut sums = [[0.0; PANEL]; R];
    for row in 0..R {
        sums[row][..width].copy_from_slice(&out[row * columns + first..][..width]);
    }
    for group in 0..PANEL / (N * S::F32_LANES) {
        let mut vectors = [[simd.splat_f32s(0.0); N]; R];
        for row in 0..R {
            for vector in 0..N {
                vectors[row][vector] = S::as_simd_f32s(&sums[row]).0[group * N + vector];
            }
        }
        for index in 0..inner {
            let values: &[S::f32s; N] = match S::as_simd_f32s(&panel[index]).0[group * N..].first_chunk() {
                Some(values) => values,
                None => unreachable!("a panel has whole groups of vectors"),
            };
            for row in 0..R {
                let factor = simd.splat_f32s(rows_of[row][index]);
                for vector in 0..N {
                    vectors[row][vector] = simd.mul_add_f32s(factor, values[vector], vectors[row][vector]);
                }
            }
        }
        for row in 0..R {
            for vector in 0..N {
                S::as_mut_simd_f32s(&mut sums[row]).0[group * N + vector] = vectors[row][vector];
            }
        }
    }
    for row in 0..R {
        out[row * columns + first..][..width].copy_from_slice(&sums[row][..width]);
    }
}
