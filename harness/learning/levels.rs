//! Recalibration of the quantiles that a network predicts.
//!
//! Values need not lie below a predicted quantile as often as its probability says. So the quantile at p is taken at the
//! probability of the network below which a share p of the validation values lies (Kuleshov, Fenner and Ermon, 2018,
//! *Accurate uncertainties for deep learning using calibrated regression*).

use super::predict::TrainedNetwork;
use harness_judge::{BATCH, JudgeError, Predictor};
use harness_metrics::force::THRESHOLD_N;
use harness_samples::{Sample, after};
use harness_spec::{Family, Modality};
use std::collections::BTreeMap;

/// Number of equal parts of the network's probabilities. Quantiles between their bounds are interpolated.
pub const PARTS: usize = 20;

/// The fewest values from which the shares of the parts can be told.
const FEWEST: usize = 10 * PARTS;

/// Number of times that the shares are estimated, each from the last.
const PASSES: usize = 10;

/// Returns for each output with a distribution the shares of the values of the windows at the present samples `at` that
/// lie below the quantiles which `network` predicts at 0, 1 / [`PARTS`], up to 1: its values at all judged horizons, or
/// the contacts among them that a member reaches for a hurdle. Outputs with less than 200 of them are left out.
///
/// # Errors
/// When the network fails.
pub fn levels(
    network: &TrainedNetwork,
    families: &BTreeMap<Modality, Family>,
    at: &[Sample],
) -> Result<BTreeMap<Modality, Vec<f32>>, JudgeError> {
    let mut found: BTreeMap<Modality, Vec<[f64; 2]>> = BTreeMap::new();
    for part in at.chunks(BATCH) {
        network.predict(part, &mut |predicted| {
            let (Some(ensemble), modality) = (&predicted.ensemble, predicted.modality) else { return Ok(()) };
            let is_hurdle = families.get(&modality) == Some(&Family::Hurdle);
            let samples = after(part, predicted.horizon);
            let references = samples.iter().flat_map(|at| network.data.samples.vector(modality, *at));
            let places = references.enumerate().filter_map(|(value, &reference)| {
                let judged = match is_hurdle {
                    false => Some(ensemble.at(value)),
                    true if reference > THRESHOLD_N => ensemble.at(value).given_above(THRESHOLD_N),
                    true => None,
                };
                judged.map(|judged| [0.0, 1.0].map(|end| judged.pit(reference, end)))
            });
            found.entry(modality).or_default().extend(places);
            Ok(())
        })?;
    }
    found.retain(|_, places| places.len() >= FEWEST);
    Ok(found.into_iter().map(|(modality, places)| (modality, shares(&places))).collect())
}

/// Returns the shares below 0, 1 / [`PARTS`], up to 1, of probabilities of which only the bounds are known: between two
/// members, and for a value at the minimum. Between its bounds, a probability is as likely as the shares themselves say
/// (self-consistency; Turnbull, 1976, *The empirical distribution function with arbitrarily grouped, censored and
/// truncated data*, JRSS B 38).
pub fn shares(bounds: &[[f64; 2]]) -> Vec<f32> {
    let mut shares: Vec<f32> = (0..=PARTS).map(|place| place as f32 / PARTS as f32).collect();
    for _ in 0..PASSES {
        let below = |place: usize| {
            let level = place as f64 / PARTS as f64;
            let of_each = bounds.iter().map(|[low, high]| match (level <= *low, level >= *high) {
                (true, _) => 0.0,
                (_, true) => 1.0,
                _ => {
                    let [low, level, high] = [*low, level, *high].map(|level| share_below(&shares, level));
                    if high > low { (level - low) / (high - low) } else { 0.5 }
                }
            });
            (of_each.sum::<f64>() / bounds.len() as f64) as f32
        };
        shares = (0..=PARTS).map(below).collect();
    }
    shares
}

/// Returns the share of the values below the quantile that the network predicts at `level`.
pub fn share_below(shares: &[f32], level: f64) -> f64 {
    let place = level * (shares.len() - 1) as f64;
    let [low, high] = [place.floor(), place.ceil()].map(|place| f64::from(shares[place as usize]));
    low + (high - low) * place.fract()
}
