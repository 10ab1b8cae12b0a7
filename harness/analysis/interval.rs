//! Confidence intervals and tests for means over datasets and seeds.

use harness_shared::numbers::rounded;
use statrs::distribution::{ContinuousCDF, StudentsT};
use std::collections::BTreeMap;
use std::fmt;

/// The confidence level of the intervals in figures and tables.
pub const LEVEL: f64 = 0.95;

/// A mean over datasets and seeds, with a confidence interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// The mean.
    pub mean: f64,
    /// Lower and upper bound; `None` for a single value, which has no standard deviation.
    pub bounds: Option<(f64, f64)>,
}

impl Interval {
    /// The lower bound, or the mean without bounds.
    pub fn low(&self) -> f64 {
        self.bounds.map_or(self.mean, |(low, _)| low)
    }

    /// The upper bound, or the mean without bounds.
    pub fn high(&self) -> f64 {
        self.bounds.map_or(self.mean, |(_, high)| high)
    }
}

/// Writes the mean and, if the bounds differ, the bounds in brackets: `0.9552 [0.9510, 0.9594]`.
impl fmt::Display for Interval {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&rounded(self.mean))?;
        match self.bounds {
            Some((low, high)) if low < high => write!(f, " [{}, {}]", rounded(low), rounded(high)),
            _ => Ok(()),
        }
    }
}

/// The mean of `values` and its confidence interval at `level`, by Student's t: `mean ± t s / √n`. Here t is the
/// quantile at `(1 + level) / 2` with n - 1 degrees of freedom, and s is the sample standard deviation. `None` without
/// values.
///
/// The bootstrap is not used, because there are few seeds. A bootstrap's 95 % interval of three values is their range,
/// which misses the mean of a symmetric distribution in a quarter of all cases. Student's t has the right level for
/// normal values. The result does not depend on the order of the values, to the last bit.
///
/// # Panics
/// When `level` is not between 0 and 1.
pub fn mean_interval(values: &[f64], level: f64) -> Option<Interval> {
    Some(Estimate::of(values)?.interval(level))
}

/// A mean, or a difference between two means, with its standard error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The mean, or the difference.
    pub mean: f64,
    /// `None` for a single value, which has no standard deviation.
    spread: Option<Spread>,
    /// The number of values or, of a difference, the smaller one of both numbers.
    count: usize,
}

/// What an interval is to contain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Over {
    /// The mean over all datasets: a confidence interval.
    #[default]
    Mean,
    /// The value on one more dataset: a prediction interval. It needs several datasets.
    NextDataset,
}

impl Over {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Mean, Self::NextDataset];

    /// The name, as options have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mean => "mean",
            Self::NextDataset => "next-dataset",
        }
    }

    /// What an interval is, given what its values are of, such as `6 datasets`.
    pub fn described(self, replicates: &str) -> String {
        match self {
            Self::Mean => format!("95 % interval over {replicates}"),
            Self::NextDataset => format!("95 % prediction interval for one more dataset, from {replicates}"),
        }
    }
}

/// The standard error of an estimate, and the degrees of freedom of Student's t.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Spread {
    error: f64,
    freedom: f64,
}

impl Estimate {
    /// The mean of values. `None` without values.
    pub fn of(values: &[f64]) -> Option<Self> {
        let (mean, error) = mean_and_error(values)?;
        let spread = error.map(|error| Spread { error, freedom: values.len() as f64 - 1.0 });
        Some(Self { mean, spread, count: values.len() })
    }

    /// The mean of `values` minus the mean of `others`, which are independent of `values`, by the method of Welch
    /// (1947): the variances of both add up, and may differ. `None` if there are no values or no others.
    pub fn difference(values: &[f64], others: &[f64]) -> Option<Self> {
        let (a, b) = (Self::of(values)?, Self::of(others)?);
        let spread = a.spread.zip(b.spread).map(|(a, b)| a.and(b));
        Some(Self { mean: a.mean - b.mean, spread, count: a.count.min(b.count) })
    }

    /// The estimate of a difference between two models on the folds of one dataset, whose training data overlap, by the
    /// correction of Nadeau & Bengio (2003, *Inference for the generalization error*): the variance of the mean is s²
    /// (1/n + r) instead of s²/n, where r is the number of test samples for each training sample.
    pub fn of_folds(self, test_to_training: f64) -> Self {
        let factor = (1.0 + self.count as f64 * test_to_training).sqrt();
        let spread = self.spread.map(|spread| Spread { error: factor * spread.error, ..spread });
        Self { spread, ..self }
    }

    /// The number of values or, of a difference, the smaller one of both numbers.
    pub fn count(&self) -> usize {
        self.count
    }

    /// The confidence interval at `level`, by Student's t.
    ///
    /// # Panics
    /// When `level` is not between 0 and 1.
    pub fn interval(&self, level: f64) -> Interval {
        assert!(level > 0.0 && level < 1.0, "the level of an interval is between 0 and 1, not {level}");
        let half = self.spread.and_then(|spread| Some(spread.quantile(level)? * spread.error));
        Interval { mean: self.mean, bounds: half.map(|half| (self.mean - half, self.mean + half)) }
    }

    /// The prediction interval at `level` for one more value, by Student's t: `mean ± t s √(1 + 1/n)` (Hahn & Meeker,
    /// *Statistical Intervals*, 1991, section 4.7). It supposes normal values.
    ///
    /// # Panics
    /// When `level` is not between 0 and 1.
    pub fn prediction(&self, level: f64) -> Interval {
        let Interval { mean, bounds } = self.interval(level);
        // The standard error is s / √n.
        let wider = (self.count as f64 + 1.0).sqrt();
        Interval {
            mean,
            bounds: bounds.map(|(low, high)| (mean - (mean - low) * wider, mean + (high - mean) * wider)),
        }
    }

    /// The two-sided p-value of Student's t-test: the probability of an estimate at least as far from `bound`, if the
    /// true value were `bound`. `None` for fewer than two values, and for equal values, such as numbers of parameters:
    /// they are not a sample, so nothing is tested.
    pub fn p_value(&self, bound: f64) -> Option<f64> {
        let Spread { error, freedom } = self.spread.filter(|spread| spread.error > 0.0)?;
        let student = StudentsT::new(0.0, 1.0, freedom).ok()?;
        Some(2.0 * student.cdf(-(self.mean - bound).abs() / error))
    }

    /// The number of values that the interval at `level` needs to exclude `bound`, if the mean and the standard
    /// deviation stay the same. A difference needs as many of both. `None` if it is more than `most`, or if there are
    /// fewer than two values.
    pub fn needed(&self, bound: f64, level: f64, most: usize) -> Option<usize> {
        let spread = self.spread?;
        let excludes = |count: &usize| {
            let spread = spread.with(self.count, *count);
            spread.quantile(level).is_some_and(|t| t * spread.error < (self.mean - bound).abs())
        };
        (2..=most).find(excludes)
    }
}

impl Spread {
    /// The spread of the difference between two independent means.
    fn and(self, other: Self) -> Self {
        let (a, b) = (self.error.powi(2), other.error.powi(2));
        let freedom = (a + b).powi(2) / (a.powi(2) / self.freedom + b.powi(2) / other.freedom);
        // Without any variance, the quotient is undefined.
        let freedom = if freedom.is_nan() { self.freedom + other.freedom } else { freedom };
        Self { error: (a + b).sqrt(), freedom }
    }

    /// The quantile of Student's t for an interval at `level`.
    fn quantile(self, level: f64) -> Option<f64> {
        two_sided(level, self.freedom)
    }

    /// The spread with another number of values of the same standard deviation.
    fn with(self, there: usize, count: usize) -> Self {
        let (there, count) = (there as f64, count as f64);
        Self {
            error: self.error * (there / count).sqrt(),
            freedom: self.freedom * (count - 1.0) / (there - 1.0),
        }
    }
}

/// The quantile of Student's t for an interval at `level`. `None` if the degrees of freedom are not positive.
pub(super) fn two_sided(level: f64, freedom: f64) -> Option<f64> {
    let student = StudentsT::new(0.0, 1.0, freedom).ok()?;
    Some(student.inverse_cdf(0.5 + level / 2.0))
}

/// The values that an interval is computed from: the mean of each dataset or, if there is only one dataset, its values.
/// Each item of `values` is the seed of a dataset and a value on it.
///
/// A value depends on the dataset and on the seed: it is a mean plus a deviation of the dataset plus a deviation of the
/// seed (a random-effects model with two levels). The means of the datasets are independent of each other, and normal
/// if the deviations are. If each dataset has the same number of seeds, the means have the same variance, so Student's
/// t of these means has the right level for any two variances. With different numbers of seeds, its level is
/// approximate. More seeds on each dataset reduce the variance of these means, but only more datasets add degrees of
/// freedom. Approximations with more degrees of freedom (Satterthwaite's, with variances estimated by restricted
/// maximum likelihood) miss their level with few datasets, because the variance between datasets is often estimated as
/// zero.
///
/// With one dataset, the interval is valid only for other seeds on that dataset.
pub fn replicates(values: impl IntoIterator<Item = (u64, f64)>) -> Vec<f64> {
    let datasets = by_dataset(values);
    if datasets.len() == 1 {
        return datasets.into_values().flatten().collect();
    }
    means(&datasets)
}

/// The values that the interval of an unpaired difference is computed from, of both groups. They are the datasets'
/// means if one of the groups has several datasets, and the groups' values otherwise.
pub fn unpaired_replicates(groups: [impl IntoIterator<Item = (u64, f64)>; 2]) -> [Vec<f64>; 2] {
    let groups = groups.map(by_dataset);
    if groups.iter().all(|datasets| datasets.len() <= 1) {
        return groups.map(|datasets| datasets.into_values().flatten().collect());
    }
    groups.map(|datasets| means(&datasets))
}

/// The values of each dataset.
fn by_dataset(values: impl IntoIterator<Item = (u64, f64)>) -> BTreeMap<u64, Vec<f64>> {
    let mut datasets: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for (dataset, value) in values {
        datasets.entry(dataset).or_default().push(value);
    }
    datasets
}

/// The mean of each dataset.
fn means(datasets: &BTreeMap<u64, Vec<f64>>) -> Vec<f64> {
    datasets.values().filter_map(|values| mean_of(values)).collect()
}

/// The p-values of several tests, corrected for their number by the method of Holm (1979). If all tests with a
/// corrected p-value below 0.05 are called significant, the probability of one or more false positives is at most 5 %.
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

/// The mean and its standard error, which is `None` for a single value. `None` without values.
fn mean_and_error(values: &[f64]) -> Option<(f64, Option<f64>)> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let mean = mean_of(&sorted)?;
    let count = sorted.len() as f64;
    let squares: f64 = sorted.iter().map(|value| (value - mean).powi(2)).sum();
    let error = (sorted.len() > 1).then(|| (squares / (count - 1.0) / count).sqrt());
    Some((mean, error))
}

/// The mean; `None` without values. The mean of equal values is their value, without a rounding error.
pub(super) fn mean_of(values: &[f64]) -> Option<f64> {
    let first = *values.first()?;
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    Some(if values.iter().all(|value| *value == first) { first } else { mean })
}

/// The mean over datasets and seeds with its interval, from the [`replicates`] of `values`. `None` without values.
pub fn interval(values: impl IntoIterator<Item = (u64, f64)>) -> Option<Interval> {
    mean_interval(&replicates(values), LEVEL)
}

/// The mean and interval of the values with the same key, for each key. An item of `values` is a key, the seed of a
/// dataset, and a value. Values that are `None` are ignored.
pub fn intervals<K: Ord>(values: impl IntoIterator<Item = (K, u64, Option<f64>)>) -> BTreeMap<K, Interval> {
    let mut by_key: BTreeMap<K, Vec<(u64, f64)>> = BTreeMap::new();
    for (key, dataset, value) in values {
        by_key.entry(key).or_default().extend(value.map(|value| (dataset, value)));
    }
    by_key.into_iter().filter_map(|(key, values)| Some((key, interval(values)?))).collect()
}
