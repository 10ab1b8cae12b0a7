//! A predictive distribution, as an ensemble of equally likely values.

use super::error::{MetricsError, check_finite};
use rayon::prelude::*;

/// How the members of an ensemble came about. The formulas of CRPS, quantiles and PIT depend on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Members {
    /// Independent draws from the distribution.
    Draws,
    /// The quantiles of the distribution at (i - 0.5) / M, for i from 1 to M.
    Quantiles,
}

/// The predictive distributions of several values, each with the same number of members.
#[derive(Debug, Clone, PartialEq)]
pub struct Ensemble {
    members: Members,
    size: usize,
    /// `[predicted values, members]`, in ascending order for each value.
    sorted: Vec<f32>,
}

impl Ensemble {
    /// Takes the members of each predicted value, `[predicted values, size]`, in any order and in the values' unit.
    ///
    /// # Errors
    /// When the members are not a whole number of rows, or a member isn't finite.
    pub fn new(members: Members, size: usize, mut values: Vec<f32>) -> Result<Self, MetricsError> {
        const WHAT: &str = "the ensemble";
        if size == 0 || !values.len().is_multiple_of(size) {
            return Err(MetricsError::shape(WHAT, values.len(), size));
        }
        check_finite(WHAT, &values, size)?;
        values.par_chunks_exact_mut(size).for_each(|row| row.sort_unstable_by(f32::total_cmp));
        Ok(Self { members, size, sorted: values })
    }

    /// Returns the number of predicted values.
    pub fn values(&self) -> usize {
        self.sorted.len() / self.size
    }

    /// Returns the distribution of a predicted value, counted from 0.
    pub fn at(&self, value: usize) -> Distribution<'_> {
        Distribution { members: self.members, sorted: &self.sorted[value * self.size..][..self.size] }
    }

    /// Returns the mean of each predicted value.
    pub fn means(&self) -> Vec<f32> {
        self.of_each(|distribution| distribution.mean(f64::from))
    }

    /// Returns the median of each predicted value.
    pub fn medians(&self) -> Vec<f32> {
        self.of_each(|distribution| distribution.quantile(0.5))
    }

    fn of_each(&self, of: impl Fn(Distribution) -> f64 + Sync) -> Vec<f32> {
        (0..self.values()).into_par_iter().map(|value| of(self.at(value)) as f32).collect()
    }
}

/// The predictive distribution of one value.
#[derive(Debug, Clone, Copy)]
pub struct Distribution<'a> {
    members: Members,
    sorted: &'a [f32],
}

impl<'a> Distribution<'a> {
    /// Returns the distribution that is certain of a value.
    pub fn certain(value: &'a f32) -> Self {
        Self { members: Members::Quantiles, sorted: std::slice::from_ref(value) }
    }

    /// Returns the continuous ranked probability score in the values' unit: `mean |x - y| - 1/2 mean |x - x'|`, over
    /// the members x and pairs of members. With one member, it is the absolute error.
    ///
    /// For draws, the second mean is over the M (M - 1) pairs of different members, so that the score is unbiased. For
    /// quantiles, it is over all M² pairs (Zamo and Naveau, 2018, *Estimation of the continuous ranked probability
    /// score with limited information*, Mathematical Geosciences 50).
    pub fn crps(self, reference: f32) -> f64 {
        let (y, size) = (f64::from(reference), self.sorted.len() as f64);
        let pairs = match self.members {
            Members::Draws => size * (size - 1.0).max(1.0),
            Members::Quantiles => size * size,
        };
        let (mut error, mut spread) = (0.0, 0.0);
        for (place, &member) in self.sorted.iter().enumerate() {
            let from_reference = f64::from(member) - y;
            error += from_reference.abs();
            // The sum over all pairs i < j of x_j - x_i, which are in ascending order.
            spread += (2.0 * place as f64 + 1.0 - size) * from_reference;
        }
        error / size - spread / pairs
    }

    /// Returns a quantile, interpolated linearly and bounded by the members: for draws, the i-th of M members is the
    /// quantile at i / (M + 1), which a further draw stays below with this probability; for quantiles, that at
    /// (i - 0.5) / M (types 6 and 5 of Hyndman and Fan, 1996, *Sample quantiles in statistical packages*).
    pub fn quantile(self, share: f64) -> f64 {
        let size = self.sorted.len() as f64;
        let place = match self.members {
            Members::Draws => share * (size + 1.0),
            Members::Quantiles => share * size + 0.5,
        };
        let place = (place - 1.0).clamp(0.0, size - 1.0);
        let (below, above) = (self.sorted[place.floor() as usize], self.sorted[place.ceil() as usize]);
        f64::from(below) + (f64::from(above) - f64::from(below)) * place.fract()
    }

    /// Returns the bounds of the central interval with this probability.
    pub fn interval(self, probability: f64) -> [f64; 2] {
        [(1.0 - probability) / 2.0, (1.0 + probability) / 2.0].map(|share| self.quantile(share))
    }

    /// Returns the probability integral transform of the reference, from 0 to 1: the probability of a smaller value.
    /// `random`, from 0 to 1, chooses a place between the neighboring members, and among members that equal the
    /// reference. If the reference is from the distribution, the result is uniform, also with a point mass (Czado,
    /// Gneiting and Held, 2009, *Predictive model assessment for count data*, Biometrics 65).
    pub fn pit(self, reference: f32, random: f64) -> f64 {
        let size = self.sorted.len() as f64;
        let below = self.sorted.partition_point(|member| *member < reference) as f64;
        let equal = self.sorted.partition_point(|member| *member <= reference) as f64 - below;
        match self.members {
            Members::Draws => (below + random * (equal + 1.0)) / (size + 1.0),
            Members::Quantiles => {
                let half = if equal == 0.0 { 0.5 } else { 0.0 };
                let (low, high) = ((below - half).max(0.0), (below + equal + half).min(size));
                (low + random * (high - low)) / size
            }
        }
    }

    /// Returns the probability of a value above `threshold`.
    pub fn above(self, threshold: f32) -> f64 {
        let at_most = self.sorted.partition_point(|member| *member <= threshold);
        1.0 - at_most as f64 / self.sorted.len() as f64
    }

    /// Returns the distribution given that the value is above `threshold`: its members above it; `None` without any.
    pub fn given_above(self, threshold: f32) -> Option<Self> {
        let above = &self.sorted[self.sorted.partition_point(|member| *member <= threshold)..];
        (!above.is_empty()).then_some(Self { sorted: above, ..self })
    }

    /// Returns the mean of a function of the value.
    pub fn mean(self, of: impl Fn(f32) -> f64) -> f64 {
        self.sorted.iter().map(|&member| of(member)).sum::<f64>() / self.sorted.len() as f64
    }
}
