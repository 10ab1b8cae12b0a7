//! Heads: what a decoder says of the distribution of each value of a vector.

use super::{Architecture, Hurdle, Spread};
use candle_core::{DType, Result, Tensor};
use candle_nn::ops::sigmoid;
use harness_ops::{
    cross_entropy, gaussian_crps, interval_score, softplus, truncated_laplace_crps, truncated_laplace_mean,
    truncated_laplace_quantiles,
};
use harness_spec::{Family, Modality};
use std::collections::BTreeMap;

/// The least scale, in normalized units. It bounds the gradients of a score where a value is certain.
pub(super) const LEAST_SCALE: f64 = 1e-3;

/// The greatest logarithm of a scale, in normalized units. Without it, a single step of training can overflow a scale.
pub(super) const GREATEST_LOGARITHM: f64 = 3.0;

/// Half the width of the central 90 % interval of a standard Gaussian.
const GAUSSIAN_90: f64 = 1.644_853_626_951_472_7;

/// Returns the heads of those vectors of which a distribution is predicted, and the number of columns of all vectors:
/// first their values, and then what the heads have besides.
pub(super) fn heads(architecture: &Architecture, vectors: &[Modality]) -> (BTreeMap<Modality, Head>, usize) {
    let (mut heads, mut start, mut parameters) = (BTreeMap::new(), 0, architecture.width(vectors));
    for modality in vectors {
        let width = architecture.layout[*modality].width();
        let family = architecture.distributions.get(modality).copied().unwrap_or_default();
        if family != Family::None {
            heads.insert(*modality, Head { family, width, start, parameters, bounds: None });
        }
        start += width;
        parameters += match family {
            Family::None => 0,
            Family::Gaussian => width,
            Family::Hurdle => 2 * width,
        };
    }
    (heads, parameters)
}

/// The columns of a vector and its distribution in a decoder's last layer.
#[derive(Debug, Clone)]
pub(super) struct Head {
    pub family: Family,
    /// Number of values.
    pub width: usize,
    /// The first of the values: the means, or the raw locations of a hurdle.
    pub start: usize,
    /// The first of the other parameters: a raw scale for each value, and then its logit for a hurdle.
    pub parameters: usize,
    /// Zero and the threshold of a contact, normalized, `[width]` each; `None` if the scales are not known.
    pub bounds: Option<[Tensor; 2]>,
}

impl Head {
    /// Returns the distribution in the outputs of the last layer, `[batch, columns]`.
    pub fn spread(&self, outputs: &Tensor) -> Result<Spread> {
        let raw = self.columns(outputs, self.parameters)?;
        let scale = (raw.minimum(GREATEST_LOGARITHM)?.exp()? + LEAST_SCALE)?;
        let hurdle = match self.family {
            Family::Hurdle => {
                Some(Hurdle { location: self.location(outputs)?, touches: sigmoid(&self.logits(outputs)?)? })
            }
            Family::None | Family::Gaussian => None,
        };
        Ok(Spread { scale, hurdle })
    }

    /// Returns the means, normalized, `[batch, width]`.
    pub fn means(&self, outputs: &Tensor) -> Result<Tensor> {
        let Spread { scale, hurdle } = self.spread(outputs)?;
        let Some(Hurdle { location, touches }) = hurdle else { return self.columns(outputs, self.start) };
        let [zero, threshold] = self.bounds()?;
        let given_contact = truncated_laplace_mean(&location, &scale, threshold)?;
        (touches * given_contact.broadcast_sub(zero)?)?.broadcast_add(zero)
    }

    /// Returns the mean score over each of the equal `parts` of the batch, `[parts]`. `values` are the values of all
    /// vectors, to which something may have been added, and `target` what they should be.
    pub fn losses(&self, outputs: &Tensor, values: &Tensor, target: &Tensor, parts: usize) -> Result<Tensor> {
        let (target, Spread { scale, hurdle }) = (self.columns(target, self.start)?, self.spread(outputs)?);
        let scores = match hurdle {
            None => gaussian_crps(&self.columns(values, self.start)?, &scale, &target)?,
            Some(Hurdle { location, .. }) => {
                let [_, threshold] = self.bounds()?;
                let touches = target.broadcast_gt(threshold)?.to_dtype(DType::F32)?;
                let given_contact = truncated_laplace_crps(&location, &scale, threshold, &target)?;
                (cross_entropy(&self.logits(outputs)?, &touches)? + (given_contact * touches)?)?
            }
        };
        scores.reshape((parts, ()))?.mean(1)
    }

    /// Returns the mean score of the central 90 % intervals over each of the equal `parts` of the batch, `[parts]`. Only
    /// values with a contact count in a hurdle. The arguments are those of [`losses`](Self::losses).
    pub fn intervals(
        &self,
        outputs: &Tensor,
        values: &Tensor,
        target: &Tensor,
        parts: usize,
    ) -> Result<Tensor> {
        let (target, Spread { scale, hurdle }) = (self.columns(target, self.start)?, self.spread(outputs)?);
        let scores = match hurdle {
            None => {
                let (means, half) = (self.columns(values, self.start)?, (scale * GAUSSIAN_90)?);
                interval_score(&(&means - &half)?, &(means + half)?, 0.9, &target)?
            }
            Some(Hurdle { location, .. }) => {
                let [_, threshold] = self.bounds()?;
                let [upper, lower] = truncated_laplace_quantiles(&location, &scale, threshold, 0.95)?;
                let touches = target.broadcast_gt(threshold)?.to_dtype(DType::F32)?;
                (interval_score(&lower, &upper, 0.9, &target)? * touches)?
            }
        };
        scores.reshape((parts, ()))?.mean(1)
    }

    /// Returns the location of a hurdle: at least the threshold, and about the raw location above it.
    fn location(&self, outputs: &Tensor) -> Result<Tensor> {
        let [_, threshold] = self.bounds()?;
        let raw = self.columns(outputs, self.start)?;
        softplus(&raw.broadcast_sub(threshold)?)?.broadcast_add(threshold)
    }

    fn logits(&self, outputs: &Tensor) -> Result<Tensor> {
        self.columns(outputs, self.parameters + self.width)
    }

    fn bounds(&self) -> Result<&[Tensor; 2]> {
        match &self.bounds {
            Some(bounds) => Ok(bounds),
            None => candle_core::bail!("a hurdle needs the scales of its values"),
        }
    }

    fn columns(&self, of: &Tensor, first: usize) -> Result<Tensor> {
        of.narrow(1, first, self.width)?.contiguous()
    }
}
