//! Predicted distributions in physical units.

use super::network::{Hurdle, Spread};
use super::random::Random;
use candle_core::Result;
use harness_metrics::force::THRESHOLD_N;
use harness_metrics::{Ensemble, Members, MetricsError};
use harness_samples::Normalizers;
use harness_spec::Modality;
use rayon::prelude::*;
use statrs::function::erf::{erfc, erfc_inv};
use std::f64::consts::SQRT_2;

/// Number of quantiles as which a predicted distribution is judged.
pub const QUANTILES: usize = 100;

/// The predicted distribution of each value of a vector, in physical units, `[batch, width]` each.
pub(crate) struct Marginals {
    /// The means of Gaussians, or of Laplace distributions given a contact.
    locations: Vec<f32>,
    /// Their standard deviations, or mean absolute deviations.
    scales: Vec<f32>,
    /// The probabilities of contacts. Without one, a force is 0, and with one, it is above the threshold of a contact.
    /// `None` for Gaussians, whose values below the minimum are set to it.
    touches: Option<Vec<f32>>,
    minimum: Option<f32>,
    /// What recalibrates the quantiles, given a contact for a hurdle: see [`Normalizers::levels`].
    levels: Option<Vec<f32>>,
}

impl Marginals {
    /// Converts the distributions of a modality. `means` are those of Gaussians, in physical units already.
    pub fn new(
        normalizers: &Normalizers,
        modality: Modality,
        means: Vec<f32>,
        spread: &Spread,
    ) -> Result<Self> {
        let value = &normalizers.modalities[&modality];
        let mut scales = spread.scale.flatten_all()?.to_vec1()?;
        normalizers.changes.get(&modality).unwrap_or(value).denormalize_deviations(&mut scales);
        let (mut locations, mut touches) = (means, None);
        if let Some(Hurdle { location, touches: of_contact }) = &spread.hurdle {
            locations = location.flatten_all()?.to_vec1()?;
            value.denormalize_unbounded(&mut locations);
            touches = Some(of_contact.flatten_all()?.to_vec1()?);
        }
        let levels = normalizers.levels.get(&modality).cloned();
        Ok(Self { locations, scales, touches, minimum: value.minimum, levels })
    }

    /// Returns the quantiles at (i - 0.5) / [`QUANTILES`], for i from 1.
    pub fn ensemble(&self) -> std::result::Result<Ensemble, MetricsError> {
        let at = |i: usize| normal_quantile((i as f64 - 0.5) / QUANTILES as f64);
        let places: Vec<f64> = (1..=QUANTILES).map(at).collect();
        let of = |index: usize| places.iter().map(move |place| self.at(index, *place));
        let members = (0..self.scales.len()).into_par_iter().flat_map_iter(of).collect();
        Ensemble::new(Members::Quantiles, QUANTILES, members)
    }

    /// Draws one value from each distribution, with a generator for each row.
    pub fn draw(&self, generators: &mut [Random]) -> Vec<f32> {
        let width = self.scales.len() / generators.len();
        let noise = generators.iter_mut().flat_map(|random| random.normal(width));
        noise.enumerate().map(|(index, place)| self.at(index, place.into())).collect()
    }

    /// Whether the means are not those that the network predicts, because the quantiles are recalibrated, or values below
    /// the minimum are set to it.
    pub fn moves_means(&self) -> bool {
        self.levels.is_some() || (self.touches.is_none() && self.minimum.is_some())
    }

    /// Returns the quantile of a value that the standard normal distribution has at `place`.
    fn at(&self, index: usize, place: f64) -> f32 {
        let [location, scale] = [self.locations[index], self.scales[index]].map(f64::from);
        let Some(touches) = &self.touches else {
            let place = match &self.levels {
                Some(levels) => normal_quantile(predicted_at(levels, normal_probability(place))),
                None => place,
            };
            let value = (location + scale * place) as f32;
            // `f32::max` would replace NaN with the minimum.
            return self.minimum.filter(|minimum| value < *minimum).unwrap_or(value);
        };
        // The probability of a higher value, given a contact.
        let higher = normal_probability(-place) / f64::from(touches[index]);
        if higher >= 1.0 {
            return 0.0;
        }
        let higher = self.levels.as_ref().map_or(higher, |levels| 1.0 - predicted_at(levels, 1.0 - higher));
        let left = 1.0 - 0.5 * ((f64::from(THRESHOLD_N) - location) / scale).exp();
        let higher = higher * left;
        let distance = if higher < 0.5 { -(2.0 * higher).ln() } else { (2.0 * (1.0 - higher)).ln() };
        (location + scale * distance) as f32
    }
}

/// Returns the probability at which the network predicts the quantile at `probability`. `shares` are those of the values
/// below the quantiles that it predicts at equally spaced probabilities.
fn predicted_at(shares: &[f32], probability: f64) -> f64 {
    let above = shares.partition_point(|share| f64::from(*share) <= probability).clamp(1, shares.len() - 1);
    let [low, high] = [above - 1, above].map(|place| f64::from(shares[place]));
    let within = if high > low { (probability - low) / (high - low) } else { 1.0 };
    ((above - 1) as f64 + within) / (shares.len() - 1) as f64
}

/// Returns the probability that a standard normal value is below `place`.
fn normal_probability(place: f64) -> f64 {
    erfc(-place / SQRT_2) / 2.0
}

/// Returns a quantile of the standard normal distribution.
fn normal_quantile(probability: f64) -> f64 {
    -SQRT_2 * erfc_inv(2.0 * probability)
}
