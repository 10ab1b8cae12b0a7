//! Matrix products of row-major f32 matrices.

#[cfg(target_arch = "x86_64")]
use crate::amx;
pub use crate::matrix::{Accumulate, Matrix};
use gemm::Parallelism;

/// The unit of the processor that computes a product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// The tile unit (see the module `amx`).
    Tiles,
    /// The vector units, through the gemm crate, which candle uses too.
    Vectors,
}

impl Unit {
    /// Returns the fastest unit that this processor has.
    pub fn best() -> Self {
        #[cfg(target_arch = "x86_64")]
        if amx::available() {
            return Self::Tiles;
        }
        Self::Vectors
    }
}

/// How the operands of a product are rounded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Precision {
    /// They are not rounded.
    F32,
    /// They are rounded to bf16, which has 8 significant bits. The result remains f32.
    Bf16,
    /// As [`Precision::F32`] on a processor. A GPU's matrix units round them to TF32, which has 11 significant bits.
    Tf32,
}

/// How products are computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arithmetic {
    /// The unit that computes them.
    pub unit: Unit,
    /// How the operands are rounded.
    pub precision: Precision,
}

impl Arithmetic {
    /// Returns the processor's best unit, in single precision.
    pub fn best() -> Self {
        Self { unit: Unit::best(), precision: Precision::F32 }
    }
}

/// Computes `out = a b`, or `out += a b` if `into` is [`Accumulate::Add`], on `threads` threads.
///
/// With [`Precision::Bf16`], the operands are rounded to bf16 before they are multiplied. Sums are always f32.
pub fn product(
    a: Matrix,
    b: Matrix,
    out: &mut [f32],
    into: Accumulate,
    Arithmetic { unit, precision }: Arithmetic,
    threads: usize,
) {
    let ((m, k), (k_b, n)) = (a.shape(), b.shape());
    assert_eq!(k, k_b, "inner sizes of a product");
    assert_eq!(out.len(), m * n, "size of a product's destination");
    match (unit, precision) {
        #[cfg(target_arch = "x86_64")]
        (Unit::Tiles, Precision::F32 | Precision::Tf32) => amx::product::<3>(a, b, out, into, threads),
        #[cfg(target_arch = "x86_64")]
        (Unit::Tiles, Precision::Bf16) => amx::product::<1>(a, b, out, into, threads),
        (_, Precision::F32 | Precision::Tf32) => by_gemm(a, b, out, into, threads),
        (_, Precision::Bf16) => {
            let (a_values, b_values) = (rounded(a.values), rounded(b.values));
            by_gemm(a.with_values(&a_values), b.with_values(&b_values), out, into, threads);
        }
    }
}

fn by_gemm(a: Matrix, b: Matrix, out: &mut [f32], into: Accumulate, threads: usize) {
    let ((m, k), (_, n)) = (a.shape(), b.shape());
    let ((a_columns, a_rows), (b_columns, b_rows)) = (a.strides(), b.strides());
    let parallelism = if threads > 1 { Parallelism::Rayon(threads) } else { Parallelism::None };
    // SAFETY: the lengths of all three slices were compared with the sizes that the strides cover. `out` is borrowed
    // mutably, so it overlaps neither operand.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            into == Accumulate::Add,
            a.values.as_ptr(),
            a_columns,
            a_rows,
            b.values.as_ptr(),
            b_columns,
            b_rows,
            1.0,
            1.0,
            false,
            false,
            false,
            parallelism,
        );
    }
}

/// Returns the values rounded to the nearest bf16, with ties to even.
fn rounded(values: &[f32]) -> Vec<f32> {
    values.iter().map(|value| half::bf16::from_f32(*value).to_f32()).collect()
}
