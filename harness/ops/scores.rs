//! Scores of predicted distributions, from candle's operations.

use candle_core::{Result, Tensor};
use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// Returns ln(1 + e^x), which is positive and about x for large x. No intermediate result overflows.
///
/// # Errors
/// When candle can't compute an operation.
pub fn softplus(x: &Tensor) -> Result<Tensor> {
    x.relu()? + (x.abs()?.neg()?.exp()? + 1.0)?.log()?
}

/// Returns the continuous ranked probability score of a Gaussian, in the unit of the target (Gneiting, Raftery,
/// Westveld and Goldman, 2005, *Calibrated probabilistic forecasting using ensemble model output statistics and minimum
/// CRPS estimation*, equation 5). All tensors have the same shape.
///
/// # Errors
/// When candle can't compute an operation.
pub fn gaussian_crps(mean: &Tensor, scale: &Tensor, target: &Tensor) -> Result<Tensor> {
    let z = ((target - mean)? / scale)?;
    let central = (&z * FRAC_1_SQRT_2)?.erf()?; // 2 Φ(z) - 1
    let density = twice_density(&z)?;
    scale * (((z * central)? + density)? - PI.sqrt().recip())?
}

/// Returns the continuous ranked probability score of a Gaussian of which only the values above `least` are left, in the
/// unit of the target (Jordan, Krüger and Lerch, 2019, *Evaluating probabilistic forecasts with scoringRules*, appendix
/// A). `mean` is that of the whole Gaussian, and at least `least`. All tensors have the same shape, but `least` may have
/// fewer dimensions.
///
/// # Errors
/// When candle can't compute an operation.
pub fn truncated_gaussian_crps(
    mean: &Tensor,
    scale: &Tensor,
    least: &Tensor,
    target: &Tensor,
) -> Result<Tensor> {
    let (z, above) = (((target - mean)? / scale)?, (mean.broadcast_sub(least)? / scale)?);
    // Twice the distribution functions at `z`, at the bound, and at √2 times the bound.
    let at = |x: &Tensor, factor: f64| (x * factor)?.erf()? + 1.0;
    let (twice, left, wider) =
        (at(&z, FRAC_1_SQRT_2)?, (at(&above, FRAC_1_SQRT_2)? * 0.5)?, at(&above, 1.0)?);
    let density = twice_density(&z)?;
    let first = (z * ((twice + &left)? - 2.0)?)?;
    let score = (((first + density)? * &left)? - (wider * (0.5 / PI.sqrt()))?)?;
    scale * (score / left.sqr()?)?
}

/// Returns the mean of a Gaussian of which only the values above `least` are left. The arguments are those of
/// [`truncated_gaussian_crps`].
///
/// # Errors
/// When candle can't compute an operation.
pub fn truncated_gaussian_mean(mean: &Tensor, scale: &Tensor, least: &Tensor) -> Result<Tensor> {
    let above = (mean.broadcast_sub(least)? / scale)?;
    let left = ((&above * FRAC_1_SQRT_2)?.erf()? + 1.0)?;
    let density = twice_density(&above)?;
    mean + (scale * (density / left)?)?
}

/// Twice the density of the standard normal distribution.
fn twice_density(z: &Tensor) -> Result<Tensor> {
    (z.sqr()? * -0.5)?.exp()? * (2.0 / PI).sqrt()
}

/// Returns the cross-entropy of an event that occurs (1) or not (0), in nats. Its probability is 1 / (1 + e^-x), with
/// the logit x. Both tensors have the same shape.
///
/// # Errors
/// When candle can't compute an operation.
pub fn cross_entropy(logit: &Tensor, event: &Tensor) -> Result<Tensor> {
    softplus(logit)? - (logit * event)?
}
