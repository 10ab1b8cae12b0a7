//! How far a mean over seeds can be trusted.

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
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let count = sorted.len() as f64;
    let degrees = count - 1.0;
    if sorted.is_empty() {
        return None;
    }
    let mean = sorted.iter().sum::<f64>() / count;
    let bounds = StudentsT::new(0.0, 1.0, degrees).ok().map(|student| {
        let squares: f64 = sorted.iter().map(|value| (value - mean).powi(2)).sum();
        let half = student.inverse_cdf(0.5 + level / 2.0) * (squares / degrees / count).sqrt();
        (mean - half, mean + half)
    });
    Some(Interval { mean, bounds })
}

/// Means over seeds: values with the same key become one interval, in the order of the keys. Nulls are left out.
pub fn intervals<K: Ord>(values: impl IntoIterator<Item = (K, Option<f64>)>) -> BTreeMap<K, Interval> {
    let mut by_key: BTreeMap<K, Vec<f64>> = BTreeMap::new();
    for (key, value) in values {
        by_key.entry(key).or_default().extend(value);
    }
    by_key.into_iter().filter_map(|(key, values)| Some((key, mean_interval(&values, LEVEL)?))).collect()
}
