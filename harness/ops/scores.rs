//! Scores of predicted distributions, from candle's operations.

use candle_core::{Result, Tensor};
use harness_spec::AXES;
use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// What is added to the length of a predicted vector, as the side of a right triangle.
const SHORTEST: f64 = 1e-6;

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

/// Returns the continuous ranked probability score of a Laplace distribution of which only the values above `least` are
/// left, in the unit of the target. `location` is the mode, and at least `least`, and `scale` the mean absolute
/// deviation of the whole distribution. All tensors have the same shape, but `least` may have fewer dimensions.
///
/// With z = (target - location) / scale and the share c below `least`, it is the integral of (F - 1)² above the target,
/// and of F² below it, of the distribution function F.
///
/// # Errors
/// When candle can't compute an operation.
pub fn truncated_laplace_crps(
    location: &Tensor,
    scale: &Tensor,
    least: &Tensor,
    target: &Tensor,
) -> Result<Tensor> {
    let (z, above) = (((target - location)? / scale)?, (location.broadcast_sub(least)? / scale)?);
    let below = (above.neg()?.exp()? * 0.5)?;
    let (left, square) = ((1.0 - &below)?, below.sqr()?);
    // The score at the mode, what a distance from it adds on either side, and what its growth lacks near the mode.
    let at_mode = ((((&above + 1.5)? * &square)? - below)? + 0.25)?;
    let higher = (left.sqr()? * z.relu()?)?;
    let lower = ((1.0 - square)? * z.neg()?.relu()?)?;
    let near = (&left * (1.0 - z.abs()?.neg()?.exp()?)?)?;
    scale * ((((at_mode + higher)? + lower)? - near)? / left.sqr()?)?
}

/// Returns the mean of a Laplace distribution of which only the values above `least` are left. The arguments are those
/// of [`truncated_laplace_crps`].
///
/// # Errors
/// When candle can't compute an operation.
pub fn truncated_laplace_mean(location: &Tensor, scale: &Tensor, least: &Tensor) -> Result<Tensor> {
    let above = (location.broadcast_sub(least)? / scale)?;
    let below = (above.neg()?.exp()? * 0.5)?;
    let share = (((above + 1.0)? * &below)? / (1.0 - below)?)?;
    location + (scale * share)?
}

/// Returns the quantile of this probability, at least one half, and that of the probability which it lacks to 1, of a
/// Laplace distribution of which only the values above `least` are left. The other arguments are those of
/// [`truncated_laplace_crps`].
///
/// # Errors
/// When candle can't compute an operation.
pub fn truncated_laplace_quantiles(
    location: &Tensor,
    scale: &Tensor,
    least: &Tensor,
    probability: f64,
) -> Result<[Tensor; 2]> {
    let below = ((location.broadcast_sub(least)? / scale)?.neg()?.exp()? * 0.5)?;
    // Twice the probabilities of higher values in the whole distribution.
    let higher = |share: f64| (1.0 - &below)? * (2.0 * share);
    let above = |share: f64| location - (scale * higher(share)?.log()?)?;
    let [upper, lower] = [1.0 - probability, probability];
    let is_below = higher(lower)?.gt(1.0)?;
    let lower =
        is_below.where_cond(&(location + (scale * (2.0 - higher(lower)?)?.log()?)?)?, &above(lower)?)?;
    Ok([above(upper)?, lower])
}

/// Returns the interval score of an interval that contains a value with this probability, in the unit of the target
/// (Gneiting and Raftery, 2007, *Strictly proper scoring rules, prediction, and estimation*, equation 43). All tensors
/// have the same shape.
///
/// # Errors
/// When candle can't compute an operation.
pub fn interval_score(lower: &Tensor, upper: &Tensor, probability: f64, target: &Tensor) -> Result<Tensor> {
    let outside = ((lower - target)?.relu()? + (target - upper)?.relu()?)?;
    (upper - lower)? + (outside * (2.0 / (1.0 - probability)))?
}

/// Twice the density of the standard normal distribution.
fn twice_density(z: &Tensor) -> Result<Tensor> {
    (z.sqr()? * -0.5)?.exp()? * (2.0 / PI).sqrt()
}

/// Returns the cross-entropy of the category of each row, in nats, `[batch]`. The probabilities of the categories are
/// the softmax of the logits. In each row of `target`, a category is 1, and all others are 0. Both tensors are `[batch,
/// categories]`.
///
/// # Errors
/// When candle can't compute an operation.
pub fn categorical_cross_entropy(logits: &Tensor, target: &Tensor) -> Result<Tensor> {
    // Subtracting the largest logit changes no probability, so it needs no gradient.
    let logits = logits.broadcast_sub(&logits.detach().max_keepdim(1)?)?;
    let of_category = (&logits * target)?.sum(1)?;
    logits.exp()?.sum(1)?.log()? - of_category
}

/// Returns 1 minus the cosine of the angle between predicted vectors and those of the target, times the square of the
/// target's length, `[batch, vectors]`. Where the target is 0, there is no direction, and its loss is 0. If the mean square
/// of all targets' lengths is 1, the mean loss is a mean over those that have a direction. Both arguments are `[batch,
/// 3 * vectors]`.
///
/// # Errors
/// When candle can't compute an operation.
pub fn cosine_losses(predicted: &Tensor, target: &Tensor) -> Result<Tensor> {
    let (batch, width) = predicted.dims2()?;
    let vectors = |values: &Tensor| values.reshape((batch, width / AXES, AXES));
    let (predicted, target) = (vectors(predicted)?, vectors(target)?);
    let square = target.sqr()?.sum(2)?;
    // A prediction without a length has no direction, but its loss needs a gradient.
    let length = (predicted.sqr()?.sum(2)? + SHORTEST.powi(2))?.sqrt()?;
    let along = ((predicted * target)?.sum(2)? / length)?;
    &square - (along * square.sqrt()?)?
}

/// Returns the cross-entropy of an event that occurs (1) or not (0), in nats. Its probability is 1 / (1 + e^-x), with
/// the logit x. Both tensors have the same shape.
///
/// # Errors
/// When candle can't compute an operation.
pub fn cross_entropy(logit: &Tensor, event: &Tensor) -> Result<Tensor> {
    softplus(logit)? - (logit * event)?
}
