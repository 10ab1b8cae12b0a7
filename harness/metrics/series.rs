//! The sums from which metrics are computed. r is a reference value, p its prediction, and n the number of pairs.

use super::Metric;

/// The relative precision of recorded values: a 32-bit number differs from the value by up to half of this part of it
/// (Higham, 2002, *Accuracy and Stability of Numerical Algorithms*, section 2.2).
const PRECISION: f64 = f32::EPSILON as f64;

/// A robot's positions, angles and forces are computed with numbers of at least this size, m, rad, N. What varies by less
/// than [`PRECISION`] of it is the round-off of these, even if nothing larger was recorded.
const SMALLEST: f64 = 1e-5;

/// Returns the mean square of the smallest numbers that values with this unit are computed with; 0 for a unit that a
/// simulation of mechanics does not have, such as that of an imported sensor.
pub(super) fn smallest_mean_square(unit: Option<&str>) -> f64 {
    let is_mechanical = |part: &str| ["m", "rad", "s", "N", "m^2", "s^2"].contains(&part);
    let is_of_all = unit.is_some_and(|unit| unit.split([' ', '/']).all(is_mechanical));
    if is_of_all { SMALLEST.powi(2) } else { 0.0 }
}

/// Sums over the pairs (r, p) of one joint, link or pixel value, in f64.
///
/// Pairs can be collected from an iterator, or added one at a time if they don't fit in memory.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Series {
    count: f64,
    absolute_error: f64,
    squared_error: f64,
    /// Σ |r - p| / (|r| + |p|)
    symmetric_error: f64,
    absolute_reference: f64,
    squared_reference: f64,
    reference_mean: f64,
    /// Σ (r - mean of r)²
    squared_deviation: f64,
}

impl Series {
    /// Adds one pair. Both values must be finite.
    pub fn add(&mut self, reference: f32, predicted: f32) {
        self.add_points(reference, predicted, predicted);
    }

    /// Adds one pair whose prediction is a distribution with this mean and median. The squared error is that of the
    /// mean, and the absolute errors are those of the median, which have the smallest expected errors.
    pub fn add_points(&mut self, reference: f32, mean: f32, median: f32) {
        let (r, p) = (f64::from(reference), f64::from(median));
        let (error, of_mean) = ((r - p).abs(), r - f64::from(mean));
        let magnitude = r.abs() + p.abs();
        self.count += 1.0;
        self.absolute_error += error;
        self.squared_error += of_mean * of_mean;
        self.symmetric_error += if magnitude > 0.0 { error / magnitude } else { 0.0 };
        self.absolute_reference += r.abs();
        self.squared_reference += r * r;
        // Welford's update gives exactly zero for a constant reference, which `r2` requires.
        let from_old_mean = r - self.reference_mean;
        self.reference_mean += from_old_mean / self.count;
        self.squared_deviation += from_old_mean * (r - self.reference_mean);
    }

    /// Returns the sums of some series together. Its deviations are those from the mean of each.
    pub(super) fn total(all: &[Series]) -> Self {
        all.iter().fold(Self::default(), |total, one| Self {
            count: total.count + one.count,
            absolute_error: total.absolute_error + one.absolute_error,
            squared_error: total.squared_error + one.squared_error,
            symmetric_error: total.symmetric_error + one.symmetric_error,
            absolute_reference: total.absolute_reference + one.absolute_reference,
            squared_reference: total.squared_reference + one.squared_reference,
            reference_mean: 0.0,
            squared_deviation: total.squared_deviation + one.squared_deviation,
        })
    }

    /// Returns the sums of the pairs that were added to `before` to get this series. The deviations are those from the
    /// mean of `whole`.
    pub(super) fn since(&self, before: &Series, whole: &Series) -> Self {
        let deviation =
            |s: &Series| s.squared_deviation + s.count * (s.reference_mean - whole.reference_mean).powi(2);
        Self {
            count: self.count - before.count,
            absolute_error: self.absolute_error - before.absolute_error,
            squared_error: self.squared_error - before.squared_error,
            symmetric_error: self.symmetric_error - before.symmetric_error,
            absolute_reference: self.absolute_reference - before.absolute_reference,
            squared_reference: self.squared_reference - before.squared_reference,
            reference_mean: whole.reference_mean,
            squared_deviation: (deviation(self) - deviation(before)).max(0.0),
        }
    }

    /// Whether the reference is not constant.
    pub(super) fn varies(&self) -> bool {
        self.squared_deviation > 0.0
    }

    /// Returns the mean square of the reference; 0 without pairs.
    pub(super) fn mean_square(&self) -> f64 {
        ratio(self.squared_reference, self.count).unwrap_or(0.0)
    }

    /// Returns the series, with a constant reference if its standard deviation is only round-off: at most `PRECISION`
    /// of the magnitude of what was computed with it, whose mean square is `mean_square`.
    pub(super) fn without_round_off(self, mean_square: f64) -> Self {
        let is_round_off = self.squared_deviation <= self.count * mean_square * PRECISION.powi(2);
        Self { squared_deviation: if is_round_off { 0.0 } else { self.squared_deviation }, ..self }
    }
}

impl FromIterator<(f32, f32)> for Series {
    /// Collects pairs (reference, predicted).
    fn from_iter<I: IntoIterator<Item = (f32, f32)>>(pairs: I) -> Self {
        let mut series = Self::default();
        pairs.into_iter().for_each(|(reference, predicted)| series.add(reference, predicted));
        series
    }
}

/// The sums whose ratio a metric of some series is computed from: a numerator and a denominator, see
/// [`Metric::of_sums`]. Several series are pooled. `None` for a metric that is no such ratio.
///
/// | metric | numerator | denominator |
/// |---|---|---|
/// | SMAPE, the paper's form without a factor 2; a pair of zeros has no error | Σ \|r - p\| / (\|r\| + \|p\|) | n |
/// | WMAPE, the paper's form | Σ \|r - p\| | Σ \|r\| |
/// | R2, of series whose reference is not constant | Σ (r - p)² | Σ (r - mean of r)² |
/// | RMSE | Σ (r - p)² | n |
/// | MAE | Σ \|r - p\| | n |
/// | relative error, if the reference is a change | Σ (r - p)² | Σ r² |
/// | relative error otherwise | Σ (r - p)² | Σ (r - mean of r)² |
///
/// Each series has its own mean. R2 of several series is then scikit-learn's
/// `r2_score(multioutput="variance_weighted")`, in which a link that is rarely touched has little weight. The relative
/// error includes the errors of series with a constant reference.
pub fn sums(metric: Metric, is_change: bool, series: &[Series]) -> Option<[f64; 2]> {
    let sum = |term: fn(&Series) -> f64| series.iter().map(term).sum::<f64>();
    let numerator = match metric {
        Metric::R2 => {
            let varying = series.iter().filter(|s| s.varies());
            return Some(varying.fold([0.0; 2], |[error, deviation], s| {
                [error + s.squared_error, deviation + s.squared_deviation]
            }));
        }
        Metric::Smape => sum(|s| s.symmetric_error),
        Metric::Wmape | Metric::Mae => sum(|s| s.absolute_error),
        Metric::Rmse | Metric::RelativeError => sum(|s| s.squared_error),
        _ => return None,
    };
    let denominator = match metric {
        Metric::Wmape => sum(|s| s.absolute_reference),
        Metric::RelativeError if is_change => sum(|s| s.squared_reference),
        Metric::RelativeError => sum(|s| s.squared_deviation),
        _ => sum(|s| s.count),
    };
    Some([numerator, denominator])
}

/// The metric of some series, pooled; `None` if it isn't defined.
pub fn value(metric: Metric, is_change: bool, series: &[Series]) -> Option<f64> {
    metric.of_sums(sums(metric, is_change, series)?)
}

/// A ratio; `None` if its denominator is 0.
pub(super) fn ratio(numerator: f64, denominator: f64) -> Option<f64> {
    (denominator > 0.0).then(|| numerator / denominator)
}
