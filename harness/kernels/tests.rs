//! Products, convolutions and reductions are precise, and give the same bits with any number of threads.

use harness_kernels::adam::sum_of_squares;
use harness_kernels::convolution::{Convolution, Images, KernelSums, LANES};
use harness_kernels::exp;
use harness_kernels::product::{Accumulate, Arithmetic, Matrix, Precision, Unit, product};
use harness_kernels::repeated::Repeated;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Normally distributed values from a seed.
struct Normals(ChaCha8Rng);

impl Normals {
    fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    fn draw(&mut self, count: usize) -> Vec<f32> {
        (0..count).map(|_| StandardNormal.sample(&mut self.0)).collect()
    }
}

#[test]
fn convolving_spreading_and_the_gradient_are_one_bilinear_form() {
    // Sizes that are not multiples of the groups of places or channels, and sizes of the networks.
    let square = [(2, 1, [2; 2]), (2, 3, [6; 2]), (3, 9, [20; 2]), (32, 32, [8; 2]), (6, 16, [64; 2])];
    let oblong = [(2, 3, [6, 14]), (3, 5, [20, 2]), (6, 4, [64, 96])];
    for (fine_channels, coarse_channels, size) in square.into_iter().chain(oblong) {
        let sizes = Convolution { fine_channels, coarse_channels, size };
        let mut random = Normals::new(4);
        let image = random.draw(LANES * sizes.fine_len());
        let (kernel, grad) = (random.draw(sizes.kernel_len()), random.draw(LANES * sizes.coarse_len()));
        let values = |images: &Images, len: usize| {
            let mut values = vec![0.0; LANES * len];
            images.write(&mut values);
            values
        };
        let (mut fine, mut coarse) = (sizes.fine(), sizes.coarse());
        fine.set(&image);
        coarse.set(&grad);
        assert!(values(&fine, sizes.fine_len()) == image, "setting and writing at {size:?}");
        let mut sums = KernelSums::new(sizes);
        sizes.add_kernel_gradient(&fine, &coarse, &mut sums);
        let (mut convolved, mut spread) = (sizes.coarse(), sizes.fine());
        sizes.convolve(&fine, &sizes.convolving(&kernel), &mut convolved);
        sizes.spread(&coarse, &sizes.spreading(&kernel), &mut spread);
        let (convolved, spread) = (values(&convolved, sizes.coarse_len()), values(&spread, sizes.fine_len()));
        let dot = |a: &[f32], b: &[f32]| -> f64 { a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum() };
        let expected = dot(&convolved, &grad);
        let scale = dot(&convolved, &convolved).sqrt() * dot(&grad, &grad).sqrt();
        assert!((dot(&image, &spread) - expected).abs() < 1e-5 * scale, "spreading at {size:?}");
        assert!((dot(&kernel, &sums.total()) - expected).abs() < 1e-5 * scale, "the gradient at {size:?}");
    }
}

/// Returns the largest error of a product on `unit`, relative to the sum of the terms' absolute values.
fn product_error(
    unit: Unit,
    precision: Precision,
    shape: [usize; 3],
    views: [bool; 2],
    threads: usize,
) -> f64 {
    let [m, n, k] = shape;
    let mut random = Normals::new((m * n * k) as u64);
    let (a, b) = (random.draw(m * k), random.draw(k * n));
    let view = |values, rows, columns, transposed| {
        if transposed {
            Matrix::transposed(values, columns, rows)
        } else {
            Matrix::plain(values, rows, columns)
        }
    };
    let mut out = vec![1.0; m * n];
    let (left, right) = (view(&a, m, k, views[0]), view(&b, k, n, views[1]));
    product(left, right, &mut out, Accumulate::Add, Arithmetic { unit, precision }, threads);
    let mut worst: f64 = 0.0;
    for row in 0..m {
        for column in 0..n {
            let (mut sum, mut size) = (1.0, 1.0);
            for at in 0..k {
                let left = f64::from(a[if views[0] { at * m + row } else { row * k + at }]);
                let right = f64::from(b[if views[1] { column * k + at } else { at * n + column }]);
                sum += left * right;
                size += (left * right).abs();
            }
            worst = worst.max((f64::from(out[row * n + column]) - sum).abs() / size);
        }
    }
    worst
}

#[test]
fn the_exponential_is_exact_to_two_units_in_the_last_place() {
    for step in -860..=870 {
        let x = step as f32 / 10.0 + 0.037;
        let (found, expected) = (f64::from(exp(x)), f64::from(x).exp());
        assert!((found / expected - 1.0).abs() < 2.4e-7, "exp({x}) = {found} instead of {expected}");
    }
    assert!(exp(1e9).is_finite() && exp(-1e9) > 0.0 && exp(f32::NAN).is_nan());
}

#[test]
fn products_are_as_exact_on_tiles_as_on_vectors() {
    for shape in [[1, 1, 1], [33, 17, 5], [64, 64, 64], [100, 300, 257], [16, 1100, 1500]] {
        for views in [[false, false], [true, false], [false, true], [true, true]] {
            for unit in [Unit::Vectors, Unit::best()] {
                let error = product_error(unit, Precision::F32, shape, views, 2);
                assert!(error < 4e-7, "{unit:?} {shape:?} {views:?}: {error}");
                let error = product_error(unit, Precision::Bf16, shape, views, 2);
                assert!(error < 5e-3, "bf16 on {unit:?} {shape:?} {views:?}: {error}");
            }
        }
    }
}

#[test]
fn products_are_the_same_bits_at_any_number_of_threads() {
    let mut random = Normals::new(33);
    let (a, b) = (random.draw(300 * 700), random.draw(700 * 500));
    for precision in [Precision::F32, Precision::Bf16] {
        let bits = |threads: usize| -> Vec<u32> {
            let mut out = vec![0.0; 300 * 500];
            let (a, b) = (Matrix::plain(&a, 300, 700), Matrix::plain(&b, 700, 500));
            let arithmetic = Arithmetic { precision, ..Arithmetic::best() };
            product(a, b, &mut out, Accumulate::Overwrite, arithmetic, threads);
            out.into_iter().map(f32::to_bits).collect()
        };
        assert_eq!(bits(1), bits(2));
        assert_eq!(bits(1), bits(5));
    }
}

#[test]
fn repeated_products_are_the_same_bits_for_any_rows() {
    for [rows, inner, columns] in [[1, 1, 1], [7, 3, 65], [20, 256, 768], [20, 768, 256], [31, 70, 130]] {
        let mut random = Normals::new((rows * inner * columns) as u64);
        let (left, matrix) = (random.draw(rows * inner), random.draw(inner * columns));
        for matrix in [Matrix::plain(&matrix, inner, columns), Matrix::transposed(&matrix, columns, inner)] {
            let in_parts = |part: usize, times: usize, unit: Unit| {
                let arithmetic = Arithmetic { unit, precision: Precision::F32 };
                let repeated = Repeated::new(matrix, times, arithmetic);
                let mut out = vec![1.0; rows * columns];
                for (left, out) in left.chunks(part * inner).zip(out.chunks_mut(part * columns)) {
                    repeated.add_product(left, out, 1);
                }
                out
            };
            let (all, general) = (in_parts(rows, 2, Unit::Vectors), in_parts(rows, 1, Unit::Vectors));
            // They are multiplied on the vector units in any case.
            assert!(in_parts(rows, 2, Unit::best()) == all, "{rows} x {inner} x {columns} on the best unit");
            for part in 1..rows {
                assert!(
                    in_parts(part, 2, Unit::Vectors) == all,
                    "{rows} x {inner} x {columns} in parts of {part}"
                );
            }
            let worst = all.iter().zip(&general).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1e-6 * inner as f32, "{rows} x {inner} x {columns}: {worst}");
        }
    }
}

#[test]
fn a_sum_of_squares_is_the_same_bits_at_any_number_of_threads() {
    let values = Normals::new(3).draw(1_000_003);
    let expected: f64 = values.iter().map(|value| f64::from(*value).powi(2)).sum();
    let with_threads = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| sum_of_squares(&values))
    };
    assert!((with_threads(1) - expected).abs() < 1e-9 * expected);
    assert_eq!(with_threads(1).to_bits(), with_threads(3).to_bits());
}
