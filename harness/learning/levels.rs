//! Recalibration of the quantiles that a network predicts.
//!
//! Values need not lie below a predicted quantile as often as its probability says. So each quantile is taken from where
//! the network predicts it: at the probability that it gives to those values below which the validation samples lie this
//! often (Kuleshov, Fenner and Ermon, 2018, *Accurate uncertainties for deep learning using calibrated regression*).

use super::predict::TrainedNetwork;
use harness_judge::{BATCH, JudgeError, Predictor};
use harness_metrics::force::THRESHOLD_N;
use harness_samples::{Sample, after};
use harness_spec::{Family, Modality};
use std::collections::BTreeMap;

/// Number of equal parts of the network's probabilities. Quantiles between their bounds are interpolated.
pub const PARTS: usize = 20;

/// Returns for each output with a distribution the shares of the values of the windows at the present samples `at` that
/// lie below the quantiles which `network` predicts at 0, 1 / [`PARTS`], up to 1: its values at all judged horizons, or
/// the contacts among them for a hurdle. Outputs without any of these are left out.
///
/// # Errors
/// When the network fails.
pub fn levels(
    network: &TrainedNetwork,
    families: &BTreeMap<Modality, Family>,
    at: &[Sample],
) -> Result<BTreeMap<Modality, Vec<f32>>, JudgeError> {
    let mut counts: BTreeMap<Modality, (f64, [f64; PARTS + 1])> = BTreeMap::new();
    for part in at.chunks(BATCH) {
        network.predict(part, &mut |predicted| {
            let (Some(ensemble), modality) = (&predicted.ensemble, predicted.modality) else { return Ok(()) };
            let is_hurdle = families.get(&modality) == Some(&Family::Hurdle);
            let (count, below) = counts.entry(modality).or_default();
            let samples = after(part, predicted.horizon);
            let references = samples.iter().flat_map(|at| network.data.samples.vector(modality, *at));
            for (value, &reference) in references.enumerate() {
                let judged = match is_hurdle {
                    false => Some(ensemble.at(value)),
                    true if reference > THRESHOLD_N => ensemble.at(value).given_above(THRESHOLD_N),
                    true => None,
                };
                let Some(judged) = judged else { continue };
                // Between neighboring members, every probability is equally likely.
                let [low, high] = [0.0, 1.0].map(|end| judged.pit(reference, end));
                *count += 1.0;
                for (place, below) in below.iter_mut().enumerate() {
                    *below += ((place as f64 / PARTS as f64 - low) / (high - low)).clamp(0.0, 1.0);
                }
            }
            Ok(())
        })?;
    }
    let shares = |(modality, (count, below)): (Modality, (f64, [f64; PARTS + 1]))| {
        (count > 0.0).then(|| (modality, below.map(|below| (below / count) as f32).to_vec()))
    };
    Ok(counts.into_iter().filter_map(shares).collect())
}

/// Returns the probability at which the network predicts the quantile at `probability`, with the shares that [`levels`]
/// returns.
pub(crate) fn predicted_at(shares: &[f32], probability: f64) -> f64 {
    let above = shares.partition_point(|share| f64::from(*share) <= probability).clamp(1, shares.len() - 1);
    let [low, high] = [above - 1, above].map(|place| f64::from(shares[place]));
    let within = if high > low { (probability - low) / (high - low) } else { 1.0 };
    ((above - 1) as f64 + within) / (shares.len() - 1) as f64
}
