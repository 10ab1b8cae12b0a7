//! How far a mean over datasets and seeds can be trusted.

use harness_shared::numbers::rounded;
use statrs::distribution::{ContinuousCDF, StudentsT};
use std::collections::BTreeMap;
use std::fmt;

/// The level of the intervals in figures and tables.
pub const LEVEL: f64 = 0.95;

/// A mean of several runs that differ only in their seed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    pub mean: f64,
    /// Lower and upper end; `None` of a single value, which says nothing about its spread.
    pub bounds: Option<(f64, f64)>,
}

impl Interval {
    /// Lower end, or the mean where there are no bounds.
    pub fn low(&self) -> f64 {
        self.bounds.map_or(self.mean, |(low, _)| low)
    }

    /// Upper end, or the mean where there are no bounds.
    pub fn high(&self) -> f64 {
        self.bounds.map_or(self.mean, |(_, high)| high)
    }
}

/// The mean and, in brackets, the bounds if they differ: `0.9552 [0.9510, 0.9594]`.
impl fmt::Display for Interval {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&rounded(self.mean))?;
        match self.bounds {
            Some((low, high)) if low < high => write!(f, " [{}, {}]", rounded(low), rounded(high)),
            _ => Ok(()),
        }
    }
}

/// The mean of `values` and its interval of confidence at `level`, by Student's t: `mean ± t s / √n`, with t the
/// quantile at `(1 + level) / 2` of n - 1 degrees of freedom and s the sample's standard deviation. `None` without
/// values.
///
/// Student's t rather than the bootstrap, because seeds are few: a bootstrap's 95 % interval of three values is their
/// range, which misses the mean of a symmetric distribution in a quarter of all cases. Student's t keeps to its level
/// for values that are about normal. The order of the values doesn't matter, to the last bit.
///
/// # Panics
/// `level` isn't between 0 and 1.
pub fn mean_interval(values: &[f64], level: f64) -> Option<Interval> {
    assert!(level > 0.0 && level < 1.0, "the level of an interval is between 0 and 1, not {level}");
    let (mean, error) = mean_and_error(values)?;
    let student = StudentsT::new(0.0, 1.0, values.len() as f64 - 1.0).ok();
    let bounds = student.zip(error).map(|(student, error)| {
        let half = student.inverse_cdf(0.5 + level / 2.0) * error;
        (mean - half, mean + half)
    });
    Some(Interval { mean, bounds })
}

/// What the interval of a mean is made of: the mean of each dataset or, where there is one alone, its values.
///
/// A value depends on the dataset and on the seed: it is a mean plus a deviation of the dataset plus one of the seed
/// (a random-effects model with two levels). The means of the datasets are independent of each other, and normal if the
/// deviations are; so Student's t of them has its level whatever the two variances are. More seeds on each dataset make
/// these means more alike, but only more datasets add degrees of freedom. Approximations that do add some
/// (Satterthwaite's with variances of restricted maximum likelihood) fall short of their level where the datasets are
/// few, because they take the variance between datasets for none whenever it is estimated so.
///
/// With one dataset, the interval is about other seeds on that dataset.
pub fn replicates(values: impl IntoIterator<Item = (u64, f64)>) -> Vec<f64> {
    let mut datasets: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for (dataset, value) in values {
        datasets.entry(dataset).or_default().push(value);
    }
    if datasets.len() == 1 {
        return datasets.into_values().flatten().collect();
    }
    datasets.into_values().map(|values| values.iter().sum::<f64>() / values.len() as f64).collect()
}

/// The probability of a mean as far from `bound` as that of `values`, or farther, if `bound` were the true one:
/// two-sided, by Student's t. `None` for fewer than two values.
pub fn p_value(values: &[f64], bound: f64) -> Option<f64> {
    let (mean, error) = mean_and_error(values)?;
    let (error, distance) = (error?, (mean - bound).abs());
    if error == 0.0 {
        return Some(if distance > 0.0 { 0.0 } else { 1.0 });
    }
    let student = StudentsT::new(0.0, 1.0, values.len() as f64 - 1.0).ok()?;
    Some(2.0 * student.cdf(-distance / error))
}

/// The p-values of several tests, corrected for their number (Holm, 1979): those below 0.05 are so with a probability
/// of 95 % that none of them is by chance.
pub fn holm(p_values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p_values.len()).collect();
    order.sort_by(|a, b| p_values[*a].total_cmp(&p_values[*b]));
    let mut corrected = vec![0.0; p_values.len()];
    let mut largest: f64 = 0.0;
    for (rank, index) in order.into_iter().enumerate() {
        largest = largest.max(p_values[index] * (p_values.len() - rank) as f64).min(1.0);
        corrected[index] = largest;
    }
    corrected
}

/// How many values there must be for the interval at `level` to exclude `bound`, if mean and spread stay as they are
/// with these; `None` if more than `most`, or if there are fewer than two values.
pub fn replicates_needed(values: &[f64], bound: f64, level: f64, most: usize) -> Option<usize> {
    let (mean, error) = mean_and_error(values)?;
    let spread = error? * (values.len() as f64).sqrt();
    let excludes = |count: &usize| {
        let student = StudentsT::new(0.0, 1.0, *count as f64 - 1.0).ok();
        student.is_some_and(|student| {
            student.inverse_cdf(0.5 + level / 2.0) * spread / (*count as f64).sqrt() < (mean - bound).abs()
        })
    };
    (2..=most).find(excludes)
}

/// The mean and its standard error, which a single value has none of; `None` without values.
fn mean_and_error(values: &[f64]) -> Option<(f64, Option<f64>)> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let count = sorted.len() as f64;
    let mean = sorted.iter().sum::<f64>() / count;
    let squares: f64 = sorted.iter().map(|value| (value - mean).powi(2)).sum();
    let error = (sorted.len() > 1).then(|| (squares / (count - 1.0) / count).sqrt());
    (!sorted.is_empty()).then_some((mean, error))
}

/// Means over datasets and seeds: values with the same key become one interval, in the order of the keys. A value comes
/// with its dataset's seed; nulls are left out.
pub fn intervals<K: Ord>(values: impl IntoIterator<Item = (K, u64, Option<f64>)>) -> BTreeMap<K, Interval> {
    let mut by_key: BTreeMap<K, Vec<(u64, f64)>> = BTreeMap::new();
    for (key, dataset, value) in values {
        by_key.entry(key).or_default().extend(value.map(|value| (dataset, value)));
    }
    let interval = |(key, values)| Some((key, mean_interval(&replicates(values), LEVEL)?));
    by_key.into_iter().filter_map(interval).collect()
}
