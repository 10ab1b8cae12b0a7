//! The formulas of the metrics, as functions of running sums.
//!
//! r is a reference value, p its prediction, and n the number of pairs. Each function takes one series or several.
//! Several series are pooled: their sums are added before the formula is applied. The result is `None` where the
//! formula would divide by zero, so it is never infinite.

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

/// Symmetric mean absolute percentage error, in % from 0 to 100: `100/n Σ |r - p| / (|r| + |p|)`.
///
/// This is the paper's form, without the factor 2 that other forms have. A pair of zeros has no error. Returns `None`
/// without pairs.
pub fn smape(series: &[Series]) -> Option<f64> {
    ratio(sum(series, |s| s.symmetric_error), sum(series, |s| s.count)).map(|value| 100.0 * value)
}

/// Weighted mean absolute percentage error, in %, unbounded above: `100 Σ |r - p| / Σ |r|`.
///
/// This is the paper's form. Returns `None` if every reference is zero, such as the force on a link that is never
/// touched.
pub fn wmape(series: &[Series]) -> Option<f64> {
    ratio(sum(series, |s| s.absolute_error), sum(series, |s| s.absolute_reference)).map(|value| 100.0 * value)
}

/// Coefficient of determination, at most 1, without unit: `1 - Σ (r - p)² / Σ (r - mean of r)²`.
///
/// Each series has its own mean. Series with a constant reference are left out. With several series this is
/// scikit-learn's `r2_score(multioutput="variance_weighted")`, in which a link that is rarely touched has little
/// weight. Returns `None` if every reference is constant.
pub fn r2(series: &[Series]) -> Option<f64> {
    let varying = series.iter().filter(|s| s.squared_deviation > 0.0);
    let (error, deviation) = varying
        .fold((0.0, 0.0), |(error, deviation), s| (error + s.squared_error, deviation + s.squared_deviation));
    ratio(error, deviation).map(|unexplained| 1.0 - unexplained)
}

/// Root mean squared error, in the values' unit: `sqrt(1/n Σ (r - p)²)`. Returns `None` without pairs.
pub fn rmse(series: &[Series]) -> Option<f64> {
    ratio(sum(series, |s| s.squared_error), sum(series, |s| s.count)).map(f64::sqrt)
}

/// Mean absolute error, in the values' unit: `1/n Σ |r - p|`. Returns `None` without pairs.
pub fn mae(series: &[Series]) -> Option<f64> {
    ratio(sum(series, |s| s.absolute_error), sum(series, |s| s.count))
}

/// Squared error relative to predicting zero everywhere, without unit: `Σ (r - p)² / Σ r²`.
///
/// Returns `None` if every reference is zero.
pub fn error_relative_to_zero(series: &[Series]) -> Option<f64> {
    ratio(sum(series, |s| s.squared_error), sum(series, |s| s.squared_reference))
}

/// Squared error relative to predicting the mean of each series, without unit: `Σ (r - p)² / Σ (r - mean of r)²`.
///
/// Unlike `1 - r2`, it includes the errors of series with a constant reference. Returns `None` if every reference is
/// constant.
pub fn error_relative_to_mean(series: &[Series]) -> Option<f64> {
    ratio(sum(series, |s| s.squared_error), sum(series, |s| s.squared_deviation))
}

fn sum(series: &[Series], term: impl Fn(&Series) -> f64) -> f64 {
    series.iter().map(term).sum()
}

fn ratio(numerator: f64, denominator: f64) -> Option<f64> {
    (denominator > 0.0).then(|| numerator / denominator)
}
