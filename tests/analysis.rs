//! Intervals over seeds against a printed table and simulated draws.

use harness_analysis::{Interval, mean_interval};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn assert_close(a: f64, b: f64) {
    assert!((a - b).abs() < 1e-12 * b.abs().max(1.0), "{a} is not {b}");
}

#[test]
fn intervals_are_those_of_students_t() {
    // Quantiles at 97.5 % and 95 % from a printed table: 4.3027 and 2.9200 with 2 degrees of freedom, 2.7764 with 4.
    let half = |values: &[f64], level| {
        let Interval { mean, bounds } = mean_interval(values, level).unwrap();
        let (low, high) = bounds.unwrap();
        assert_close(mean - low, high - mean);
        high - mean
    };
    assert!((half(&[1.0, 2.0, 3.0], 0.95) - 4.3027 / 3.0_f64.sqrt()).abs() < 1e-4);
    assert!((half(&[1.0, 2.0, 3.0], 0.90) - 2.9200 / 3.0_f64.sqrt()).abs() < 1e-4);
    assert!((half(&[4.0, 8.0, 6.0, 5.0, 7.0], 0.95) - 2.7764 * 0.5_f64.sqrt()).abs() < 1e-4);
    assert_eq!(mean_interval(&[4.0, 8.0, 6.0], 0.95).unwrap().mean, 6.0);
    let same = mean_interval(&[0.5, 0.5], 0.95).unwrap();
    assert_eq!(same, Interval { mean: 0.5, bounds: Some((0.5, 0.5)) });
}

#[test]
fn one_seed_has_no_interval_and_none_no_mean() {
    let one = mean_interval(&[0.7], 0.95).unwrap();
    assert_eq!(one, Interval { mean: 0.7, bounds: None });
    assert_eq!((one.low(), one.high()), (0.7, 0.7));
    assert_eq!(mean_interval(&[], 0.95), None);
}

#[test]
fn an_interval_does_not_depend_on_the_order_of_its_seeds() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut values: [f32; 7] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
    let of =
        |values: &[f32]| mean_interval(&values.iter().map(|&v| f64::from(v) / 3.0).collect::<Vec<_>>(), 0.95);
    let expected = of(&values);
    for seed in 0..20 {
        values.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        assert_eq!(of(&values), expected);
    }
}

#[test]
fn an_interval_covers_the_mean_as_often_as_its_level_says() {
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    let normal = rand_distr::Normal::new(3.0, 2.0).unwrap();
    let covered = (0..20_000).filter(|_| {
        let values: [f64; 3] = std::array::from_fn(|_| rng.sample(normal));
        let interval = mean_interval(&values, 0.95).unwrap();
        (interval.low()..=interval.high()).contains(&3.0)
    });
    // The standard deviation of this share is 0.0015.
    let share = covered.count() as f64 / 20_000.0;
    assert!((share - 0.95).abs() < 0.006, "{share}");
}
